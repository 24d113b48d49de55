"""Base class of a task: constants, arrays, episodes and random numbers, derived from its declaration."""

import functools
import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, Self

import numpy

from ...filters.angles import shorten
from ...filters.array_namespace import lane_arrays, stack_nested
from .draws import Draws
from .observation import Array


class NoiseLayout(NamedTuple):
    """Counts of uniform and normal random numbers at the start and at each measurement of an episode.

    At its start these are ``uniforms`` numbers between 0 and 1 for the scenario and ``initial_normals`` standard normal
    ones for the start of the track, then one row for each measurement: ``normals`` standard normal numbers followed by
    ``row_uniforms`` uniform ones. Each is a function of the episode's identity, see :mod:`.episode_noise`.
    """

    uniforms: int
    initial_normals: int
    normals: int
    row_uniforms: int = 0


class TaskBase(ABC):
    """Base class of a task: makes its world, simulated or replayed, and fixes lengths and random numbers of episodes.

    The author of a task writes only the declaration, :class:`~.task.Task`.

    Args:
        xp: array namespace, NumPy or torch.
        recording: replayed in place of a simulated world.
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
    """Whether the true value of every component is known at every measurement. A recording may lack some, which are
    NaN: the errors then omit these components, and rewards, which need all of them, are zero."""
    flights: tuple[int, ...] = ()
    """Measurements acted on in each flight, of which every episode flies one, all multiples of ``decision_interval``;
    the longest is the horizon. The first uniform number of the episode draws the flight."""
    closes_loop: bool
    """Whether an estimate changes the next measurement: where :meth:`.Task.feedback` is defined, unless ``set_up``
    sets it otherwise; never in a recording."""
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

    # attributes of the declaration, see :class:`~.task.Task`
    World: ClassVar[Any]
    components: tuple[Any, ...]

    @abstractmethod
    def set_up(self) -> None:
        """Compute the constants that the world and the banks of a task share; an author defines it."""

    @abstractmethod
    def _writes_feedback(self) -> bool:
        """Return whether the task overrides :meth:`.Task.feedback`."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def __reduce__(self) -> Any:
        return _remake, (type(self), self.parameters, self.xp.__name__, self.device, self.recording)

    def on(self, xp: ModuleType, device: Any = None) -> Self:
        """Return the same task with its arrays in another namespace and on another device."""
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
        """Period of each component that is an angle, by its index."""
        return {i: one.period for i, one in enumerate(self.components) if one.period is not None}

    def subtract(self, estimate: Array, truth: Array) -> Array:
        """Return estimate minus truth, ``(C, ...)`` each; for an angle the shortest difference."""
        return shorten(estimate - truth, self.periods)

    def _noise_layout(self) -> NoiseLayout:
        world = self.world
        average = 0.5 + self.xp.zeros((1, 8), dtype=self.xp.float64, device=self.device)
        draws = Draws.counting(average, self.xp)
        world.begin(draws, self.xp.concat([0.0 * average] * world.initial_normals))
        return NoiseLayout(draws.used, world.initial_normals, world.normals, world.row_uniforms)

    @property
    def interval(self) -> float | None:
        """Constant time between measurements, s, also before the first; None where it varies or is unknown.

        It is the parameter ``sampling_interval`` where there is one, unless a recording has another.
        """
        seconds: float | None = self._sampling_interval()
        if seconds is not None and self.recording is not None:
            return seconds if self.recording.has_interval(seconds) else None
        return seconds

    def _sampling_interval(self) -> float | None:
        return getattr(self.parameters, "sampling_interval", None)

    def flight_of(self, uniforms: numpy.ndarray) -> numpy.ndarray:
        """Return the index of the flight that each episode flies, ``(N,)``, by its uniform numbers.

        Args:
            uniforms: ``(noise.uniforms, N)``; the first row draws the flight.
        """
        return numpy.floor(len(self.flights) * uniforms[0]).astype(int)

    def lengths(self, uniforms: numpy.ndarray) -> numpy.ndarray:
        """Return the number of measurements acted on in each episode, ``(N,)``, by its uniform numbers."""
        if not self.flights:
            return numpy.full(uniforms.shape[1], self.horizon)
        return numpy.asarray(self.flights)[self.flight_of(uniforms)]

    def constant(self, values: Any) -> Array:
        """Return numbers as a float64 array of the task's namespace and device.

        Nested lists may contain arrays ``(N,)`` beside numbers, where episodes differ; the result then has a last
        axis of N.
        """
        if isinstance(values, list | tuple):
            arrays = lane_arrays(values)
            if arrays:
                return stack_nested(values, 0.0 * sum(arrays[1:], arrays[0]), self.xp)
        return self.xp.asarray(values, dtype=self.xp.float64, device=self.device)


def _remake(cls: type[TaskBase], parameters: Any, namespace: str, device: Any, recording: Any) -> TaskBase:
    return cls(parameters, importlib.import_module(namespace), device, recording)
