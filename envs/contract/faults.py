"""What a world may do to its sensors: the parts that it lists, and the errors that more than one environment has."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from .causes import Cause
from .draws import Draws
from .observation import Array

if TYPE_CHECKING:
    from .task import Task


class Numbers(NamedTuple):
    """Random numbers of one measurement that a disturbance takes."""

    normals: Array
    """``(normals, N)``."""
    uniforms: Array
    """``(row_uniforms, N)``."""


class Disturbance(ABC):
    """One thing that a world may do to its sensors, with a name, a draw, an effect and a cause.

    It is drawn with the episode, moves on with every measurement, and acts where a method says so: on errors, on what
    is read, or on the whole measurement. What it has drawn and where it stands is its state, nested NamedTuples of
    arrays ``(..., N)``. By default nothing is drawn, nothing moves and nothing is changed.

    Args:
        task: with its parameters.

    Attributes:
        name: under which the truth holds its state.
        cause: circumstance by which an evaluation splits costs; None where others, such as ``OUTLIER``, say it.
        initial_normals: standard normal numbers that it takes at the start of the track.
        normals: standard normal numbers that it takes at each measurement.
        row_uniforms: uniform numbers that it takes at each measurement.
    """

    name: ClassVar[str]
    cause: ClassVar[Cause | None] = None
    initial_normals: int = 0
    normals: int = 0
    row_uniforms: int = 0

    def __init__(self, task: "Task") -> None:
        self.parameters, self.xp = task.parameters, task.xp

    @classmethod
    @abstractmethod
    def is_in(cls, parameters: Any) -> bool:
        """Whether a task of these parameters has it."""

    def begin(self, draws: Draws, normals: Array, truth: Any) -> Any:
        """Draw what holds for an episode, and return the state at the start of the track.

        Args:
            draws: what fixes the scenario of each episode.
            normals: ``(initial_normals, N)``.
            truth: of the world, without disturbances.
        """
        return None

    def advance(self, state: Any, interval: Array | float, numbers: Numbers) -> Any:
        """State at a measurement, from that at the one before.

        Args:
            state: of :meth:`begin`, or the one before.
            interval: s since the measurement before, ``(N,)``, or one number where all are the same.
            numbers: that it takes.
        """
        return state

    def change_errors(self, state: Any, errors: Array) -> Array:
        """Errors in units of the stated standard deviations, ``(n, N)``, with what it does to them."""
        return errors

    def change_reading(self, state: Any, reading: Array) -> tuple[Any, Array]:
        """State and what the sensor reads, ``(n, N)`` in its own coordinates, with what it does to them."""
        return state, reading

    def change_measurement(
        self, state: Any, measurement: Any, numbers: Numbers, feedback: Any
    ) -> tuple[Any, Any]:
        """State and measurement with what it does to them.

        Args:
            state: of :meth:`advance`.
            measurement: the world's NamedTuple, with what was missed.
            numbers: that :meth:`advance` was given.
            feedback: of a closed loop, see :meth:`.World.advance`.
        """
        return state, measurement

    def context(self, state: Any) -> dict[str, Array]:
        """Report what was drawn, see :meth:`.World.context`."""
        return {}

    def records(self, state: Any) -> dict[str, Array]:
        """Report what an evaluation keeps, see :meth:`.World.records`."""
        return {}


class Disturbances:
    """All that a world may do to its sensors, in the order in which it takes random numbers and acts.

    States are a mapping from names.

    Args:
        parts: the disturbances.

    Attributes:
        initial_normals: standard normal numbers that all take together at the start of the track.
        normals: standard normal numbers of a measurement.
        row_uniforms: uniform numbers of a measurement.
    """

    def __init__(self, parts: Sequence[Disturbance]) -> None:
        self.parts = tuple(parts)
        self.initial_normals = sum(part.initial_normals for part in parts)
        self.normals = sum(part.normals for part in parts)
        self.row_uniforms = sum(part.row_uniforms for part in parts)

    @classmethod
    def of(cls, task: "Task", kinds: Sequence[type[Disturbance]]) -> "Disturbances":
        """Return those of some kinds that a task has."""
        return cls([kind(task) for kind in kinds if kind.is_in(task.parameters)])

    def begin(self, draws: Draws, normals: Array, truth: Any) -> dict[str, Any]:
        """Draw each: the states at the start of the track."""
        states, used = {}, 0
        for part in self.parts:
            states[part.name] = part.begin(draws, normals[used : used + part.initial_normals], truth)
            used += part.initial_normals
        return states

    def share(self, normals: Array, uniforms: Array) -> dict[str, Numbers]:
        """Hand out the random numbers of a measurement, ``(normals, N)`` and ``(row_uniforms, N)``, by name."""
        shares, n, u = {}, 0, 0
        for part in self.parts:
            shares[part.name] = Numbers(normals[n : n + part.normals], uniforms[u : u + part.row_uniforms])
            n, u = n + part.normals, u + part.row_uniforms
        return shares

    def advance(
        self, states: Mapping[str, Any], interval: Array | float, numbers: Mapping[str, Numbers]
    ) -> dict[str, Any]:
        """States at a measurement."""
        return {
            part.name: part.advance(states[part.name], interval, numbers[part.name]) for part in self.parts
        }

    def change_errors(self, states: Mapping[str, Any], errors: Array) -> Array:
        """Errors with what each does to them."""
        for part in self.parts:
            errors = part.change_errors(states[part.name], errors)
        return errors

    def change_reading(self, states: Mapping[str, Any], reading: Array) -> tuple[dict[str, Any], Array]:
        """States and what the sensor reads, with what each does to them."""
        changed = dict(states)
        for part in self.parts:
            changed[part.name], reading = part.change_reading(changed[part.name], reading)
        return changed, reading

    def change_measurement(
        self, states: Mapping[str, Any], measurement: Any, numbers: Mapping[str, Numbers], feedback: Any
    ) -> tuple[dict[str, Any], Any]:
        """States and measurement with what each does to them."""
        changed = dict(states)
        for part in self.parts:
            changed[part.name], measurement = part.change_measurement(
                changed[part.name], measurement, numbers[part.name], feedback
            )
        return changed, measurement

    def context(self, states: Mapping[str, Any]) -> dict[str, Array]:
        """What all report of what was drawn."""
        return {name: v for part in self.parts for name, v in part.context(states[part.name]).items()}

    def records(self, states: Mapping[str, Any]) -> dict[str, Array]:
        """What all report for an evaluation to keep."""
        return {name: v for part in self.parts for name, v in part.records(states[part.name]).items()}


class Outliers(NamedTuple):
    """Measurements whose errors are larger than stated, each one on its own, as by glint; nobody says so."""

    probability: float
    factor: float
    """Standard deviation of their errors over that of the others."""

    @property
    def row_uniforms(self) -> int:
        """Uniform numbers that a measurement takes: one, or none where there are no outliers."""
        return 1 if self.probability else 0

    def amplify(self, deviation: Array, uniforms: Array, xp: ModuleType) -> Array:
        """Return standard deviations, or errors, multiplied by the factor where a measurement is an outlier.

        Args:
            deviation: ``(..., N)``.
            uniforms: ``(row_uniforms, N)``.
            xp: array namespace.
        """
        if not self.probability:
            return deviation
        return xp.where(uniforms[0] < self.probability, self.factor, xp.ones_like(uniforms[0])) * deviation


class Glint(Disturbance):
    """Measurements whose errors are larger than stated, each one on its own, by ``glint_factor`` with
    ``glint_probability``; nobody says so. Its state is the standard deviation of this measurement's errors over that of
    usual ones, ``(N,)``; the world's truth counts ``scan``.
    """

    name = "glint"

    def __init__(self, task: "Task") -> None:
        super().__init__(task)
        self.outliers = Outliers(self.parameters.glint_probability, self.parameters.glint_factor)
        self.row_uniforms = self.outliers.row_uniforms

    @classmethod
    def is_in(cls, parameters: Any) -> bool:
        """Whether any measurement may be one."""
        return bool(parameters.glint_probability > 0.0)

    def begin(self, draws: Draws, normals: Array, truth: Any) -> Array:
        """Start with a usual one."""
        return self.xp.ones_like(truth.scan, dtype=self.xp.float64)

    def advance(self, state: Array, interval: Array | float, numbers: Numbers) -> Array:
        """Draw whether this is one."""
        return self.outliers.amplify(self.xp.ones_like(state), numbers.uniforms, self.xp)

    def change_errors(self, state: Array, errors: Array) -> Array:
        """Enlarge them."""
        return state * errors


class GaussMarkov(NamedTuple):
    """Coloured error of a sensor, ``e_k = psi e_{k-1} + sigma sqrt(1 - psi^2) n`` (first-order Gauss-Markov):
    multipath, the atmosphere, a reference that wanders. It is stationary from the start.
    """

    decay: Array
    """psi, what is left of the error from one measurement to the next, ``(N,)``."""
    kick: Array
    """Standard deviation of what it gains, ``sigma sqrt(1 - psi^2)``, ``(N,)``."""

    @classmethod
    def sampled(
        cls, deviation: Array, correlation_time: Array, interval: float, xp: ModuleType
    ) -> "GaussMarkov":
        """Return the error of a stationary deviation, sampled exactly.

        Args:
            deviation: sigma, ``(N,)``.
            correlation_time: s, ``(N,)``.
            interval: from one measurement to the next, s.
            xp: array namespace.
        """
        decay = xp.exp(-interval / correlation_time)
        return cls(decay, deviation * xp.sqrt(1.0 - decay * decay))

    def advance(self, error: Array, normals: Array) -> Array:
        """Return the errors of the next measurement, ``(..., N)``."""
        return self.decay * error + self.kick * normals
