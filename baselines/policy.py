"""What a policy, a reference estimator and a bound are.

A **policy** sees observations and returns actions; learned or classical, it answers Stable-Baselines3's
call. A **reference** estimates from the measurements, never through actions, and may be told what no
competitor knows; it is never ranked with policies. A **bound** is computed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy

from ..envs.task import Array, Task


class PolicyLoader(NamedTuple):
    """Where policies come from that are not an environment's own."""

    load: Callable[[str, str], Any]
    """From an environment's id and a name to what makes a policy for a task; None for a name not its own."""
    names: Callable[[str], list[str]]
    """From an environment's id to the names that it has for it."""


LOADERS: list[PolicyLoader] = []
"""Asked, in order, for a policy that is not among an environment's own; whoever has policies adds to it."""


class Policy:
    """Base of the classical policies: made for a task, deterministic unless it says otherwise.

    Subclasses set ``control`` and answer :meth:`predict`; those with memory keep it in the ``state`` that
    goes in and out, so that one object serves any number of episodes.
    """

    control: ClassVar[str]
    """The control that the policy's actions are meant for."""

    def __init__(self, task: Task) -> None:
        self.task = task

    def predict(
        self,
        observation: numpy.ndarray,
        state: Any = None,
        episode_start: numpy.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[numpy.ndarray, Any]:
        """Choose actions.

        Args:
            observation: ``(N, len(task.fields))``, or one observation without the batch axis.
            state: what the last call returned; None at the first.
            episode_start: ``(N,)`` booleans, true where a new episode begins.
            deterministic: as in Stable-Baselines3; classical policies ignore it.

        Returns:
            Actions, batch first, and the state for the next call.
        """
        single = observation.ndim == 1
        batch = observation[None] if single else observation
        start = numpy.zeros(len(batch), dtype=bool) if episode_start is None else numpy.asarray(episode_start)
        if state is None:
            start = numpy.ones(len(batch), dtype=bool)
        action, state = self.act(batch, state, start.reshape(-1))
        return (action[0] if single else action), state

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Answer a batch; ``start`` is true where memory must begin anew."""
        raise NotImplementedError


class ConstantPolicy(Policy):
    """The same action always."""

    action: tuple[float, ...]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Repeat the action for every episode."""
        return numpy.tile(numpy.asarray(self.action, dtype=float), (len(observation), 1)), None


class RandomPolicy(Policy):
    """Uniform actions; the floor that any policy should beat."""

    seed = 0

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.control = task.control  # type: ignore[misc]  # it suits every control

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Draw from the action space with a generator of the policy's own."""
        generator = numpy.random.default_rng(self.seed) if state is None else state
        space: Any = self.task.action_space
        if hasattr(space, "n"):
            return generator.integers(0, space.n, len(observation)), generator
        return generator.uniform(space.low, space.high, (len(observation), *space.shape)), generator


class Reference(Protocol):
    """An estimator that runs on the episode's measurements and may know what no competitor does.

    It starts where everyone starts. In a closed loop it flies a truth of its own, on the same noise.
    """

    knows: ClassVar[str]
    """What it is told, in words; printed wherever it is reported."""

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Memory at the start of the track.

        Args:
            initial: what everyone is told of it.
            truth: at that time.
        """

    def update(self, measurement: Any, truth: Any, memory: Any) -> tuple[Array, Array, Any]:
        """Estimate after a measurement: mean ``(C, N)``, covariance ``(C, C, N)``, and the memory."""


class Bound(Protocol):
    """A computed limit of the mean square error."""

    knows: ClassVar[str]

    def __init__(self, task: Task) -> None: ...

    def start(self, initial: Any, truth: Any) -> Any:
        """Memory at the start of the track; arguments as of :meth:`Reference.start`."""

    def update(self, measurement: Any, truth: Any, memory: Any) -> tuple[Array, Any]:
        """Bound of the mean square of ``task.components``, ``(C, N)``, and the memory."""


@dataclass(frozen=True)
class Tunable:
    """What can be tuned in a policy, and what a choice of values means."""

    control: str
    """The control of the policy."""
    limits: Mapping[str, tuple[float, float]]
    """Lower and upper limit of each value, in the order of the search."""
    start: Mapping[str, float]
    """The values in force without tuning."""
    apply: Callable[[Mapping[str, float]], tuple[dict[str, Any], Callable[[Any], Policy]]]
    """From values to keywords of the task and what makes the policy for it."""


@dataclass(frozen=True)
class Baselines:
    """What an environment is compared with: the table at the end of each module in :mod:`.policies`."""

    policies: Mapping[str, Callable[[Any], Policy]]
    references: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    bounds: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    score_paper: str = ""
    """The policy whose score is 0."""
    score_bound: str = ""
    """The reference estimator or bound whose score is 1."""
    benchmark: tuple[str, ...] = ()
    """Names that the quick benchmark runs, in the order of the table."""
    compared: tuple[str, ...] = ()
    """Untuned policies that learned agents are compared with, beside the paper's and the tuned ones."""
    physical: tuple[str, str] = ("rmse", "position")
    """Metric and component that the comparison shows beside the cost."""
    measurement_seconds: float = 5e-6
    """Time that a policy takes for one measurement, on one core; dear environments get fewer episodes in the
    full benchmark."""
    tunable: Mapping[str, Tunable] = field(default_factory=dict)
    """Policies that :mod:`.tuning` can tune; ``NAME-tuned`` is the tuned one."""
    best_constant: str = ""
    """The tunable policy that stands for the best constant action in the room table."""
    metrics: Callable[[Any, Any], list[Any]] | None = None
    """The environment's own metrics: from one policy's dataset and a ``Bootstrap`` to ``Measure`` tuples."""

    def kind(self, name: str) -> str:
        """Return "policy", "reference" or "bound"."""
        return "reference" if name in self.references else "bound" if name in self.bounds else "policy"

    @property
    def names(self) -> tuple[str, ...]:
        """Every name, policies first."""
        return (*self.policies, *self.references, *self.bounds)
