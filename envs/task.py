"""The contract that every task keeps.

A *task* is one estimation problem, written once for N independent episodes side by side. ``gym.Env`` is the
task with N = 1, the vector environment is the task with N, an evaluation is the task with N = Monte Carlo
runs. A task knows nothing of Gymnasium and owns no random generator: numbers come in, states come out.

The clock of every task:

====  ==============================================================  ======================
 1    the filter bank predicts to the next measurement time           :meth:`Task.measure`
 2    the measurement arrives; innovations and likelihoods follow     :meth:`Task.measure`
 3    the agent is shown them                                         :meth:`Task.observe`
 4    the agent's action is applied to *that same* measurement        :meth:`Task.act`
 5    the estimate is compared with the truth                         :meth:`Task.cost`
====  ==============================================================  ======================

``begin`` makes the state at the start of the track, as if step 4 had just happened. A reset is ``begin``, 1,
2, 3; an environment step is 4, 5, 1, 2, 3. So K actions need K + 1 measurements, and the last observation
shows a real measurement that is not acted on.

Arrays inside a task have the batch as their last axis and belong to the namespace ``task.xp`` (NumPy or
torch). A state is a NamedTuple of arrays ``(..., N)`` and is never changed in place.

In a closed loop the truth follows from the estimate: the control is computed from the state's estimate when
the next measurement is made. A reference estimator that replaces the estimate then flies a truth of its own,
on the same noise.

**No truth at any distance:** nothing that ``observe`` returns, and nothing that it is computed from, may
depend on the truth except through the measurements.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

import gymnasium
import numpy

Array = Any
"""A NumPy array or a torch tensor."""


class Field(NamedTuple):
    """One component of the observation."""

    name: str
    unit: str
    """Unit of the value as shown; "1" for a pure number."""
    description: str
    """What it is and how it is scaled."""
    over_interval: Literal["last", "mean"] = "last"
    """How the component is shown when one action holds for several measurements: the value at the last
    one, or the mean over all of them."""


class Component(NamedTuple):
    """One component of the estimation error."""

    name: str
    unit: str


@dataclass(frozen=True)
class Scenario:
    """An immutable set of parameters with a name, and the windows in which its errors are reported."""

    name: str
    description: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    windows: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """First and last measurement of each window, both included; measurement 1 is the first one acted on. An
    evaluation adds the window ``all``, the whole episode."""
    training: bool = False
    """Whether agents may be trained and policies tuned on it."""


class NoiseLayout(NamedTuple):
    """How many random numbers an episode takes, in the order in which they are drawn.

    The generator of the episode first gives ``uniforms`` numbers on [0, 1) for the scenario, then
    ``initial_normals`` standard normal ones for the start of the track, then one row for each measurement:
    ``normals`` standard normal numbers followed by ``row_uniforms`` uniform ones.
    """

    uniforms: int
    initial_normals: int
    normals: int
    row_uniforms: int = 0


class PaperPolicy(NamedTuple):
    """The paper's algorithm as a constant action."""

    control: str
    action: tuple[float, ...]


State = TypeVar("State")


class Task(ABC, Generic[State]):
    """One estimation problem for N independent episodes; see the module's description.

    Subclasses declare the class attributes below, set the instance attributes in ``__init__`` and write the
    six methods. Their class docstring is the environment's documentation.
    """

    id: ClassVar[str]
    """Gymnasium id, with version."""
    paper_source: ClassVar[str]
    """Reference of the paper."""
    controls: ClassVar[tuple[str, ...]]
    """What the action can steer; the first is the default."""
    Parameters: ClassVar[type]
    """Frozen dataclass of every constant; its fields are keywords of ``gym.make``."""
    scenarios: ClassVar[Mapping[str, Scenario]]
    default_scenario: ClassVar[str] = "random"
    components: tuple[Component, ...]
    """What :meth:`error` returns. This and the four attributes below may be set for each instance."""
    groups: Mapping[str, tuple[str, ...]] = {}
    """Names for several components taken together, such as ``position``: the root of their summed squares."""
    modes: tuple[str, ...] = ()
    """Names of the hypotheses of the bank; their probabilities are recorded when a state reports them."""
    cost_description: ClassVar[str]
    """What :meth:`cost` is and its unit, in words."""
    huber_bound: float
    """Root of the cost beyond which the reward is linear; see :func:`huber`."""
    paper_policy: PaperPolicy

    parameters: Any
    control: str
    horizon: int
    """Measurements acted on in one episode."""
    decision_interval: int
    """Measurements for which one action holds."""
    noise: NoiseLayout
    fields: tuple[Field, ...]
    action_space: gymnasium.Space

    def __init__(self, parameters: Any, control: str, xp: ModuleType = numpy, device: Any = None) -> None:
        """Keep what every task has; subclasses add their own constants, noise layout, fields and space."""
        self.parameters = parameters
        self.control = control
        self.horizon = parameters.horizon
        self.decision_interval = parameters.decision_interval
        self.xp = xp
        self.device = device

    def picture(self) -> Any:
        """Return the :class:`~.rendering.Picture` that draws an episode of this task; None for the general one."""
        return None

    @classmethod
    def scenario_from_trajectory(cls, trajectory: Any, keywords: Mapping[str, Any]) -> Scenario:
        """Make a scenario of a user's trajectory, given the other keywords; few tasks can."""
        raise ValueError(f"{cls.id} does not take a trajectory as scenario")

    def constant(self, values: Any) -> Array:
        """Turn numbers into a float64 array of the task's namespace and device."""
        return self.xp.asarray(values, dtype=self.xp.float64, device=self.device)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Positions of named fields in the observation."""
        positions = {f.name: i for i, f in enumerate(self.fields)}
        return [positions[name] for name in names]

    @abstractmethod
    def begin(self, uniforms: Array, normals: Array) -> State:
        """State at the start of the track.

        Args:
            uniforms: ``(noise.uniforms, N)``, what fixes the scenario of each episode.
            normals: ``(noise.initial_normals, N)``, the errors of the track's start.
        """

    @abstractmethod
    def measure(self, state: State, noise: Array) -> State:
        """Steps 1 and 2: truth moves on, filters predict, the measurement arrives.

        Args:
            state: after :meth:`begin` or :meth:`act`.
            noise: ``(noise.normals + noise.row_uniforms, N)``.
        """

    @abstractmethod
    def observe(self, state: State) -> Array:
        """Step 3: what the agent is shown, ``(len(fields), N)``."""

    @abstractmethod
    def act(self, state: State, action: Array) -> State:
        """Step 4: apply the action to the measurement of ``state``.

        Args:
            state: after :meth:`measure`.
            action: ``(A, N)`` floats for a box, ``(N,)`` integers for a discrete space.
        """

    @abstractmethod
    def cost(self, state: State) -> Array:
        """Step 5: what the estimate costs, uncapped, ``(N,)``.

        A squared error in units of the sensor's nominal variance, or, where the estimate drives a control
        loop, the quadratic cost of the loop in a fixed unit.
        """

    @abstractmethod
    def error(self, state: State) -> Array:
        """Estimate minus truth, ``(len(components), N)``, in the units of ``components``."""

    @abstractmethod
    def covariance(self, state: State) -> Array:
        """Covariance that the estimator reports for its error, ``(C, C, N)``."""

    def records(self, state: State) -> dict[str, Array]:
        """Report what else an evaluation keeps of each measurement: arrays ``(N,)``, or ``(M, N)`` for
        ``mode_probability``.
        """
        return {}


def huber(cost: Array, bound: float, xp: ModuleType) -> Array:
    """Cost that grows linearly with the error beyond ``bound``, and is never flat.

    With ``d = sqrt(cost)``: ``d^2`` up to the bound, ``2 bound d - bound^2`` beyond it (Huber, 1964, scaled
    by two), so that a lost track always pays to be found again without ruling the gradient.
    """
    # The maximum keeps the square root away from zero, where its derivative is infinite.
    beyond = xp.sqrt(xp.clip(cost, bound**2, None))
    return xp.where(cost <= bound**2, cost, 2.0 * bound * beyond - bound**2)
