"""The contract that every task keeps.

A *task* is one estimation problem, written once for N independent episodes side by side. ``gym.Env`` is the
task with N = 1, the vector environment is the task with N, an evaluation is the task with N = Monte Carlo
runs. A task knows nothing of Gymnasium and owns no random generator: numbers come in, states come out.

It is made of two halves, and the :class:`Measurement <Episode>` is the only door between them:

* the :class:`World` draws the episode, moves the truth and says what the sensors say;
* a :class:`~.filter.Filter` predicts and estimates. A task brings a :class:`~.filter.Bank` for each control, which
  also shows what it has found and is steered by an action; :meth:`Task.with_filter` puts any other filter in its
  place. No filter that competes receives the truth, nor anything else that the world keeps.

The clock of every task:

====  ==============================================================  =========================
 1    the truth moves on; the sensors say where it seems to be        :meth:`World.advance`
 2    the filter predicts to that time; innovations and likelihoods   :meth:`Filter.predict`
 3    the agent is shown them                                         :meth:`Task.observe`
 4    the filter takes *that same* measurement in, by the action      :meth:`Filter.update`
 5    the estimate is compared with the truth                         :meth:`World.cost`
====  ==============================================================  =========================

``begin`` makes the episode at the start of the track, as if step 4 had just happened: :meth:`World.begin`
gives the initial estimate, :meth:`Filter.start` takes it. A reset is ``begin``, 1, 2, 3; an
environment step is 4, 5, 1, 2, 3. So K actions need K + 1 measurements, and the last observation shows a
real measurement that is not acted on.

Arrays inside a task have the batch as their last axis and belong to the namespace ``task.xp`` (NumPy or
torch). Truth, measurement and the filter's state are NamedTuples of arrays ``(..., N)`` and are never changed
in place.

A closed loop adds one arrow back, from the estimate to the world, and names it: what :meth:`Filter.feedback`
returns is given to the next :meth:`World.advance`. Each filter then flies a truth of its own, on the same noise.
"""

import copy
import importlib
from abc import ABC
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy

from .draws import Draws
from .filter import Bank, Filter, Input
from .log_format import LogFormat
from .observation import Array, Blocks, Field, Reader
from .world import World


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
    flights: tuple[str, ...] = ()
    """Where every episode flies one of several: name of each, and where pieces of one flight are flown, that several
    times."""
    notes: tuple[str, ...] = ()
    """Notes on where it comes from, a line each."""
    recording: Any = None
    """A :class:`~.recording.Recording` that is replayed in place of a simulated world."""


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


class Episode(NamedTuple):
    """N episodes at one moment: all that the engine keeps between steps."""

    truth: Any
    """What is; the world's NamedTuple."""
    measurement: Any
    """What the sensors say; between ``begin`` and the first measurement the initial estimate."""
    filter: Any
    """State of the filter."""


class Task(ABC):
    """One estimation problem for N independent episodes; see the module's description.

    Subclasses declare the class attributes below and compute in :meth:`set_up` the constants that world and
    banks share. Their class docstring is the environment's documentation.
    """

    id: ClassVar[str]
    """Gymnasium id, with version."""
    interface: ClassVar[int] = 1
    """Raised whenever fields or actions come to mean something else under the same names: agents that were trained
    before are then refused."""
    paper_source: ClassVar[str]
    """Reference of the paper."""
    Parameters: ClassVar[type]
    """Frozen dataclass of every constant; its fields are keywords of ``gym.make``."""
    World: ClassVar[type[World]]
    banks: ClassVar[Mapping[str, type[Bank]]]
    """What the action can steer, and the bank that it steers; the first is the default."""
    controls: ClassVar[tuple[str, ...]]
    """Names of ``banks``."""
    trained_banks: ClassVar[Mapping[str, type[Bank]]] = {}
    """Filters that a network of their own steers, by the algorithm that trains it: learned estimators. An environment
    steers them like any bank, to train them; no other policy acts in them."""
    actions: ClassVar[Mapping[str, str]] = {}
    """What an action means under each control, in words."""
    log_format: ClassVar[LogFormat | None] = None
    """Tables of real measurements that can be read; None where they cannot."""
    scenarios: ClassVar[Mapping[str, Scenario]]
    default_scenario: ClassVar[str] = "random"
    components: tuple[Component, ...]
    """What is estimated. This and the four attributes below may be set for each instance."""
    groups: Mapping[str, tuple[str, ...]] = {}
    """Names for several components taken together, such as ``position``: the root of their summed squares."""
    modes: tuple[str, ...] = ()
    """Names of the hypotheses of the bank; their probabilities are recorded when a bank reports them."""
    cost_description: ClassVar[str]
    """What the cost is and its unit, in words."""
    reward_unit: float = 1.0
    """What the paper's algorithm is charged on average in the default scenario: one in the reward. Where few lost
    tracks rule that mean, something between them and the median."""
    reward: ClassVar[str] = "cost"
    """Kind of reward that agents get unless another one is asked for, see :mod:`.reward`."""
    paper_policy: PaperPolicy

    parameters: Any
    control: str
    horizon: int
    """Measurements acted on in one episode."""
    decision_interval: int
    """Measurements for which one action holds."""
    recording: Any
    """The :class:`~.recording.Recording` that is replayed in place of a simulated world; None where there is none."""
    has_truth: bool
    """Whether the true values are known: a recording may lack them, and then there are no errors and no costs."""
    flights: tuple[int, ...] = ()
    """Where every episode flies one of several, measurements acted on in each of them, all multiples of
    ``decision_interval``; the longest is the horizon. The first uniform number of the episode draws it."""
    noise: NoiseLayout
    fields: tuple[Field, ...]
    action_space: gymnasium.Space
    backend: str
    """What computes its steps: "numpy", "torch", or "compiled"."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if hasattr(cls, "banks"):
            cls.controls = tuple(cls.banks)

    def __init__(
        self,
        parameters: Any,
        control: str,
        xp: ModuleType = numpy,
        device: Any = None,
        recording: Any = None,
    ) -> None:
        self.parameters = parameters
        self.recording = recording
        self.has_truth = recording is None or recording.truth is not None
        self.control = control
        self.horizon = parameters.horizon
        self.decision_interval = parameters.decision_interval
        self.xp = xp
        self.device = device
        self.backend = "torch" if "torch" in xp.__name__ else "numpy"
        self.set_up()
        if recording is None:
            self.world = self.World(self)
        else:
            self.flights = recording.lengths_within(self.horizon, self.decision_interval)
            self.world = recording.world(self)
        self.bank = {**self.banks, **self.trained_banks}[control](self)
        self.noise = self._noise_layout()
        self._take_filter(self.bank)

    def _take_filter(self, filter: Filter) -> None:
        self.filter = filter
        self._blocks = Blocks(filter.blocks, filter.quantities, self.xp)
        self.fields = self._blocks.fields
        self.action_space = filter.action_space

    def __copy__(self) -> "Task":
        """Another with the same attributes, to change one of them."""
        other: Task = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> "Task":
        """Share the task: nothing in it changes."""
        return self

    def __reduce__(self) -> Any:
        """Pickle what it is made of; a module, its array namespace, cannot be."""
        named = (self.parameters, self.control, self.xp.__name__, self.device, self.recording)
        return _remake, (type(self), *named)

    def set_up(self) -> None:  # noqa: B027  (most tasks have something to compute, none must)
        """Compute the constants that world and banks share."""

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
            times = seconds * numpy.arange(1, self.recording.seconds.shape[1] + 1)
            late = numpy.abs(self.recording.seconds - times)
            # NaN beyond the end of a shorter episode. Times in a file are rounded.
            return seconds if numpy.nanmax(late, initial=0.0) <= 1e-6 * seconds + 1e-9 * times[-1] else None
        return seconds

    def _sampling_interval(self) -> float | None:
        """What the parameters say of the time between measurements, s; None where it differs."""
        return getattr(self.parameters, "sampling_interval", None)

    def picture(self) -> Any:
        """Return the :class:`~.rendering.Picture` that draws an episode of this task; None for the general one."""
        return None

    @classmethod
    def scenario_of_flights(cls, flights: Any, keywords: Mapping[str, Any]) -> Scenario:
        """Make a scenario in which every episode flies one of some flights; few tasks can.

        Args:
            flights: a :class:`~.trajectory.Trajectory`, or :class:`~.flights.Flights`.
            keywords: of ``gym.make``, beside the scenario.

        Raises:
            ValueError: if they cannot be flown, as by default.
        """
        raise ValueError(f"{cls.id} does not take flights as scenario")

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

    def feedback(self, mean: Array, measurement: Any) -> Any:
        """Report what an estimate gives back to the world; None in an open loop. A filter may give back something
        else, see :meth:`Filter.feedback`.

        Args:
            mean: of the estimate, ``(C, N)``.
            measurement: that it has taken in, or the initial estimate.
        """
        return None

    def constant(self, values: Any) -> Array:
        """Turn numbers into a float64 array of the task's namespace and device."""
        return self.xp.asarray(values, dtype=self.xp.float64, device=self.device)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Positions of named fields in the observation.

        Raises:
            ValueError: for a name that is no field.
        """
        return self._blocks.columns(names)

    def reader(self, name: str) -> Reader:
        """Return what reads a block or quantity of the observation by its name, uncompressed.

        Raises:
            ValueError: for a name that is neither.
        """
        return self._blocks.reader(name)

    def under(self, control: str) -> "Task":
        """Return the same problem with another control."""
        return type(self)(self.parameters, control, self.xp, self.device, self.recording)

    def on_numpy(self) -> "Task":
        """Return the same problem on NumPy arrays, not compiled."""
        return type(self)(self.parameters, self.control, numpy, None, self.recording)

    def run(self, function: Callable[..., Any], *parts: Any) -> Any:
        """Call ``function(task, *parts)`` on this task's backend.

        Args:
            function: of this module or another, not made anew for each call: it may be compiled, once.
            *parts: nested tuples of arrays ``(..., N)``.

        Returns:
            Nested tuples or dictionaries of arrays ``(..., N)``.
        """
        return function(self, *parts)

    def with_filter(self, make: Callable[["Task"], Filter]) -> "Task":
        """Return the same problem with another filter in place of the bank.

        Args:
            make: makes the filter for a task; not made anew for each call, since what is compiled is kept by it.
        """
        other = copy.copy(self)
        other._take_filter(make(self))
        return other

    def truth_for_filter(self, truth: Any) -> Any:
        """Truth as the filter is given it: None unless it ``knows`` something."""
        return truth if self.filter.knows else None

    # --- what the engine calls

    def begin(self, uniforms: Array, normals: Array) -> Episode:
        """Episode at the start of the track.

        Args:
            uniforms: ``(noise.uniforms, N)``.
            normals: ``(noise.initial_normals, N)``.
        """
        truth, initial = self.world.begin(Draws(uniforms, self.xp), normals)
        return Episode(truth, initial, self.filter.begin(Input(initial, self.truth_for_filter(truth))))

    def measure(self, episode: Episode, noise: Array) -> Episode:
        """Steps 1 and 2; ``noise`` is ``(noise.normals + noise.row_uniforms, N)``."""
        feedback = self.filter.feedback(episode.filter, episode.measurement)
        truth, measurement = self.world.advance(episode.truth, noise, feedback)
        return Episode(truth, measurement, self.filter.predict(episode.filter, measurement))

    def observe(self, episode: Episode) -> Array:
        """Step 3: what the agent is shown, ``(len(fields), N)``."""
        if not self.fields:  # nothing steers the filter
            N = next(named_arrays(episode.measurement))[1].shape[-1]
            return self.xp.zeros((0, N), dtype=self.xp.float64, device=self.device)
        return self._blocks.observe(episode.filter, episode.measurement)

    def act(self, episode: Episode, action: Array) -> Episode:
        """Step 4: the filter takes the measurement in, a bank with the action."""
        given = Input(episode.measurement, self.truth_for_filter(episode.truth), action)
        return episode._replace(filter=self.filter.update(episode.filter, given))

    def mean(self, episode: Episode) -> Array:
        """Estimate, ``(len(components), N)``, in the units of ``components``."""
        return self.filter.mean(episode.filter)

    def context(self, episode: Episode) -> dict[str, Array]:
        """What was drawn for the episode, and what of it holds now: arrays of floats ``(..., N)``."""
        context = self.world.context(episode.truth)
        return {name: self.xp.astype(values, self.xp.float64) for name, values in context.items()}

    def cost(self, episode: Episode) -> Array:
        """Step 5: what the estimate costs, uncapped, ``(N,)``."""
        return self.world.cost(episode.truth, self.filter.mean(episode.filter))

    def charge(self, episode: Episode) -> Array:
        """Part of the cost that the reward counts, ``(N,)``; see :meth:`World.charge`."""
        return self.world.charge(episode.truth, self.filter.mean(episode.filter))

    def error(self, episode: Episode) -> Array:
        """Estimate minus truth, ``(len(components), N)``, in the units of ``components``."""
        return self.filter.mean(episode.filter) - self.world.state(episode.truth)

    def covariance(self, episode: Episode) -> Array:
        """Covariance that the estimator reports for its error, ``(C, C, N)``."""
        return self.filter.covariance(episode.filter)

    def track(self, episode: Episode) -> dict[str, Array]:
        """What a track is drawn from: ``truth`` (where it is known) and ``estimate`` ``(C, N)``, ``covariance``
        ``(C, C, N)``, and every array of the measurement, named ``measurement_NAME``.
        """
        said = {f"measurement_{name}": values for name, values in named_arrays(episode.measurement)}
        return {**self._estimated(episode), **said}

    def drawn(self, episode: Episode) -> dict[str, Array]:
        """What a picture of a track shows: as :meth:`track`, but of the measurement what is ``seen`` of the components
        ``(C, N)``, where anything is; NaN where it says nothing.
        """
        seen = self.world.seen(episode.measurement)
        return {**self._estimated(episode), **({} if seen is None else {"seen": seen})}

    def _estimated(self, episode: Episode) -> dict[str, Array]:
        true = {"truth": self.world.state(episode.truth)} if self.has_truth else {}
        return {**true, "estimate": self.mean(episode), "covariance": self.covariance(episode)}

    def records(self, episode: Episode) -> dict[str, Array]:
        """What else an evaluation keeps of each measurement."""
        own = self.filter.records(episode.filter, episode.measurement)
        return {**own, **self.world.records(episode.truth)}


def _remake(
    cls: type[Task], parameters: Any, control: str, namespace: str, device: Any, recording: Any
) -> Task:
    return cls(parameters, control, importlib.import_module(namespace), device, recording)


def named_arrays(part: Any, prefix: str = "") -> Iterator[tuple[str, Array]]:
    """Arrays of nested NamedTuples, with the names that lead to them."""
    for name, value in part._asdict().items():
        if isinstance(value, tuple):
            yield from named_arrays(value, f"{prefix}{name}_")
        elif value is not None:
            yield prefix + name, value
