"""The contract that every task keeps.

A *task* is one estimation problem, written once for N independent episodes side by side. ``gym.Env`` is the
task with N = 1, the vector environment is the task with N, an evaluation is the task with N = Monte Carlo
runs. A task knows nothing of Gymnasium and owns no random generator: numbers come in, states come out.

It is made of two halves, and the :class:`Measurement <.model.Episode>` is the only door between them:

* the :class:`World` draws the episode, moves the truth and says what the sensors say;
* a :class:`~.filter.Filter` predicts and estimates. A task brings a :class:`~.filter.Bank` for each control, which
  also shows what it has found and is steered by an action; :meth:`.Model.with_filter` puts any other filter in its
  place. No filter that competes receives the truth, nor anything else that the world keeps.

The clock of every task:

====  ==============================================================  =========================
 1    the truth moves on; the sensors say where it seems to be        :meth:`World.advance`
 2    the filter predicts to that time; innovations and likelihoods   :meth:`Filter.predict`
 3    the agent is shown them                                         :meth:`.Model.observe`
 4    the filter takes *that same* measurement in, by the action      :meth:`Filter.update`
 5    the estimate is compared with the truth                         :meth:`World.cost`
====  ==============================================================  =========================

``begin`` makes the episode at the start of the track, as if step 4 had just happened: :meth:`World.begin`
gives the initial estimate, :meth:`Filter.start` takes it. A reset is ``begin``, 1, 2, 3; an
environment step is 4, 5, 1, 2, 3. So K actions need K + 1 measurements, and the last observation shows a
real measurement that is not acted on.

A :class:`Task` is what an author declares; :class:`TaskBase` holds what follows from it, the parameters,
the constants computed of them and its world. What goes with a problem beside its declaration, such as the format of its
logs or its picture, is a companion, see :mod:`~.companions`. What runs is a :class:`~.model.Model`: a task with a filter
in the loop.

Arrays inside a task have the batch as their last axis and belong to the namespace ``task.xp`` (NumPy or
torch). Truth, measurement and the filter's state are NamedTuples of arrays ``(..., N)`` and are never changed
in place.

A closed loop adds one arrow back, from the estimate to the world, and names it: what :meth:`Task.feedback`
returns is given to the next :meth:`World.advance`. Each filter then flies a truth of its own, on the same noise.
"""

import ast
import functools
import importlib
import inspect
import re
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, Self

import numpy

from ...filters.angles import shorten
from ...filters.array_namespace import lane_arrays, stack_nested
from .draws import Draws
from .filter import Bank
from .observation import Array
from .world import World


class Component(NamedTuple):
    """One component of the estimation error."""

    name: str
    unit: str
    period: float | None = None
    """Of an angle, in its unit: errors are the shortest differences. None: it is no angle."""
    group: str = ""
    """Of components taken together, such as ``position``: the root of their summed squares; empty where alone."""


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
    flights: tuple[str, ...] = ()
    """Where every episode flies one of several: name of each, and where pieces of one flight are flown, that several
    times."""
    notes: tuple[str, ...] = ()
    """Notes on where it comes from, a line each."""
    recording: Any = None
    """A :class:`~.recording.Recording` that is replayed in place of a simulated world."""


class PaperPolicy(NamedTuple):
    """The paper's algorithm as a constant action."""

    control: str
    action: tuple[float, ...]


class Reward(NamedTuple):
    """What an estimate costs, and how agents are rewarded for it."""

    cost: str
    """What the cost is and its unit, in words."""
    kind: str = "cost"
    """Of the reward that agents get unless another one is asked for, see :mod:`.reward`."""
    unit: float = 1.0
    """Mean cost of the paper's algorithm in the default scenario, as far as it counts: one in the reward. Where few lost
    tracks rule that mean, something between them and the median."""
    log_unit: float | None = None
    """Unit of the reward ``log-relative``, about the cost of an ordinary episode, where that is far below ``unit``;
    None where it is the same."""


class NoiseLayout(NamedTuple):
    """How many random numbers an episode takes.

    At its start these are ``uniforms`` numbers between 0 and 1 for the scenario and ``initial_normals`` standard normal
    ones for the start of the track, then one row for each measurement: ``normals`` standard normal numbers followed by
    ``row_uniforms`` uniform ones. Each is a function of the episode's identity, see :mod:`.episode_noise`.
    """

    uniforms: int
    initial_normals: int
    normals: int
    row_uniforms: int = 0


class TaskBase(ABC):
    """What is computed of a task that is declared: its parameters on arrays, its world, and how its episodes run.

    An author writes none of it; the declaration is :class:`~.task.Task`.

    Args:
        parameters: an instance of the task's ``Parameters``.
        xp: array namespace, NumPy or torch.
        device: of its arrays.
        recording: that is replayed in place of a simulated world.
    """

    controls: ClassVar[tuple[str, ...]]
    """Names of the task's ``banks``."""
    parameters: Any
    horizon: int
    """Measurements acted on in one episode."""
    decision_interval: int
    """Measurements for which one action holds."""
    recording: Any
    """The :class:`~.recording.Recording` that is replayed in place of a simulated world; None where there is none."""
    has_truth: bool
    """Whether true values are known: a recording may lack them, and then there are no errors and no costs."""
    has_whole_truth: bool
    """Whether every component's is, at every measurement: a recording may lack some, which are NaN. What they would be
    compared with is then left out of errors, and rewards, which need all, are zero."""
    flights: tuple[int, ...] = ()
    """Where every episode flies one of several, measurements acted on in each of them, all multiples of
    ``decision_interval``; the longest is the horizon. The first uniform number of the episode draws it."""
    closes_loop: bool
    """Whether an estimate decides what is measured next: where :meth:`.Task.feedback` is written, unless ``set_up``
    says otherwise of the parameters; never in a recording."""
    world: Any
    """The :class:`~.world.World`, simulated or replayed."""
    noise: NoiseLayout

    def __init__(
        self, parameters: Any, xp: ModuleType = numpy, device: Any = None, recording: Any = None
    ) -> None:
        self.parameters = parameters
        self.recording = recording
        self.has_truth = recording is None or recording.truth is not None
        self.has_whole_truth = recording is None or recording.has_whole_truth
        self.horizon = parameters.horizon
        self.decision_interval = parameters.decision_interval
        self.xp = xp
        self.device = device
        self.closes_loop = self._writes_feedback()
        self.set_up()
        if recording is None:
            self.world = self.World(self)
        else:
            self.closes_loop = False
            self.flights = recording.lengths_within(self.horizon, self.decision_interval)
            self.world = recording.world(self)
        self.noise = self._noise_layout()

    # what the declaration gives, see :class:`~.task.Task`
    World: ClassVar[Any]
    components: tuple[Any, ...]

    @abstractmethod
    def set_up(self) -> None:
        """Compute the constants that world and banks share."""

    @abstractmethod
    def _writes_feedback(self) -> bool:
        """Whether the declaration gives something back to the world."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Share the task: nothing in it changes."""
        return self

    def __reduce__(self) -> Any:
        """Pickle what it is made of; a module, its array namespace, cannot be."""
        return _remake, (type(self), self.parameters, self.xp.__name__, self.device, self.recording)

    def on(self, xp: ModuleType, device: Any = None) -> Self:
        """Return the same problem on other arrays."""
        return type(self)(self.parameters, xp, device, self.recording)

    @functools.cached_property
    def groups(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the components of each group, such as those of the ``position``."""
        found: dict[str, tuple[str, ...]] = {}
        for component in self.components:
            if component.group:
                found[component.group] = (*found.get(component.group, ()), component.name)
        return found

    @functools.cached_property
    def periods(self) -> dict[int, float]:
        """Periods of the components that are angles, by their numbers."""
        return {i: one.period for i, one in enumerate(self.components) if one.period is not None}

    def subtract(self, estimate: Array, truth: Array) -> Array:
        """Estimate minus truth, ``(C, ...)`` each; of an angle the shortest difference."""
        return shorten(estimate - truth, self.periods)

    def _noise_layout(self) -> NoiseLayout:
        world = self.world
        average = 0.5 + self.xp.zeros((1, 8), dtype=self.xp.float64, device=self.device)
        draws = Draws.counting(average, self.xp)
        world.begin(draws, self.xp.concat([0.0 * average] * world.initial_normals))
        return NoiseLayout(draws.used, world.initial_normals, world.normals, world.row_uniforms)

    @property
    def interval(self) -> float | None:
        """Seconds from one measurement to the next, where all of them are that far apart, and the first that far from
        the start of the track; None where they come at times of their own, or the times are not known.

        It is the parameter ``sampling_interval`` where there is one, unless a recording says otherwise.
        """
        seconds: float | None = self._sampling_interval()
        if seconds is not None and self.recording is not None:
            return seconds if self.recording.has_interval(seconds) else None
        return seconds

    def _sampling_interval(self) -> float | None:
        """What the parameters say of the time between measurements, s; None where it differs."""
        return getattr(self.parameters, "sampling_interval", None)

    def flight_of(self, uniforms: numpy.ndarray) -> numpy.ndarray:
        """Number of the flight that each episode flies, where there are :attr:`flights`, ``(N,)``.

        Args:
            uniforms: of the scenario, ``(noise.uniforms, N)``; the first row draws the flight.
        """
        return numpy.floor(len(self.flights) * uniforms[0]).astype(int)

    def lengths(self, uniforms: numpy.ndarray) -> numpy.ndarray:
        """Measurements acted on in each episode, ``(N,)``.

        Args:
            uniforms: of the scenario, ``(noise.uniforms, N)``.
        """
        if not self.flights:
            return numpy.full(uniforms.shape[1], self.horizon)
        return numpy.asarray(self.flights)[self.flight_of(uniforms)]

    def constant(self, values: Any) -> Array:
        """Turn numbers into a float64 array of the task's namespace and device; nested lists may hold arrays ``(N,)``
        beside numbers, where episodes differ, and then get a last axis of N.
        """
        if isinstance(values, list | tuple):
            arrays = lane_arrays(values)
            if arrays:
                return stack_nested(values, 0.0 * sum(arrays[1:], arrays[0]), self.xp)
        return self.xp.asarray(values, dtype=self.xp.float64, device=self.device)


def _remake(cls: type[TaskBase], parameters: Any, namespace: str, device: Any, recording: Any) -> TaskBase:
    return cls(parameters, importlib.import_module(namespace), device, recording)


class Task(TaskBase):
    """One estimation problem for N independent episodes; see the module's description.

    Subclasses declare the class attributes below and compute in :meth:`set_up` the constants that world and
    banks share. Their class docstring is the environment's documentation. What follows from the declaration stands in
    :class:`TaskBase`.
    """

    id: ClassVar[str]
    """Gymnasium id, with version."""
    interface: ClassVar[int] = 1
    """Raised whenever fields or actions come to mean something else under the same names: agents that were trained
    before are then refused."""
    Parameters: ClassVar[type]
    """Frozen dataclass of every constant; its fields are keywords of ``gym.make``."""
    World: ClassVar[type[World]]
    """Truth and sensors."""
    banks: ClassVar[Mapping[str, type[Bank]]]
    """What the action can steer, and the bank that it steers; the first is the default."""
    scenarios: ClassVar[Mapping[str, Scenario]]
    default_scenario: ClassVar[str] = "random"
    reward: ClassVar[Reward]
    """What an estimate costs, and how agents are rewarded for it."""
    components: tuple[Component, ...]
    """What is estimated. This and the two attributes below may be set for each instance."""
    modes: tuple[str, ...] = ()
    """Names of the hypotheses of the bank; their probabilities are recorded when a bank reports them."""
    paper_policy: PaperPolicy
    companions: tuple[Any, ...] = ()
    """Objects that go with the problem, each found by its type (:func:`~.companions.find_companion`), such as the
    format of its logs or its picture. The first of a type counts, so that an instance may put another one in front."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if hasattr(cls, "banks"):
            cls.controls = tuple(cls.banks)

    def set_up(self) -> None:
        """Compute the constants that world and banks share; most tasks have some, none must."""

    def feedback(self, mean: Array, covariance: Array, measurement: Any) -> Any:
        """Report what an estimate gives back to the world, in a closed loop. A filter may give back something else, see
        :meth:`.Filter.feedback`.

        Args:
            mean: of the estimate, ``(C, N)``.
            covariance: that is reported for it, ``(C, C, N)``.
            measurement: that it has taken in, or the initial estimate.
        """
        return None

    def _writes_feedback(self) -> bool:
        return type(self).feedback is not Task.feedback


def named_arrays(part: Any, prefix: str = "") -> Iterator[tuple[str, Array]]:
    """Arrays of nested NamedTuples, with the names that lead to them."""
    for name, value in part._asdict().items():
        if isinstance(value, tuple):
            yield from named_arrays(value, f"{prefix}{name}_")
        elif value is not None:
            yield prefix + name, value


def field_texts(cls: type) -> dict[str, str]:
    """What the text of a class says below each of its own fields, in one line; nothing where there is no text."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):
        return {}
    lines = tree.body if isinstance(tree, ast.ClassDef) else []
    return {
        field.target.id: " ".join(below.value.value.split())
        for field, below in pairwise(lines)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        and isinstance(below.value.value, str)
    }  # fmt: skip


def field_words(cls: type) -> dict[str, str]:
    """The same of a single track in which the field exists: without shapes such as ``(2, N)``, and without a clause on
    where it is None.
    """
    found = {}
    for name, text in field_texts(cls).items():
        words = re.sub(r"(, |^)``\([^`]*\)``\.?", "", text)
        words = re.sub(r"(^|[;.] ?)[^;.]*\bNone where [^;.]*", "", words)
        found[name] = words.lstrip(" ,;").replace("`", "")
    return found
