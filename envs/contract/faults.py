"""Disturbances of sensors: their base class, the list that a world has, and errors shared by several environments."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

from .causes import Cause
from .draws import Draws
from .observation import Array
from .task_base import TaskBase


class DisturbanceInput(NamedTuple):
    """Input of a disturbance at one measurement, such as time and random numbers."""

    number: Array
    """Number of the measurement, from 1 on, ``(N,)``."""
    interval: Array | float
    """Time since the previous measurement, s, ``(N,)``, or one number where all are equal."""
    normals: Array
    """Standard normal numbers that it uses, ``(normals, N)``."""
    uniforms: Array
    """Uniform numbers that it uses, ``(row_uniforms, N)``."""
    feedback: Any = None
    """Feedback of a closed loop, see :meth:`.World.advance`."""


def draw_undisturbed(draws: Draws, parameters: Any) -> Array | None:
    """Draw which episodes have no hidden disturbance, booleans ``(N,)``; None if every episode may have one.

    The first call takes a random number. Disturbances that a measurement reports are drawn in these episodes by the
    same law as in all others, so that no report reveals whether an episode is one of them.

    Args:
        draws: random quantities of each episode.
        parameters: of the task, with the probability ``undisturbed``.
    """
    if not parameters.undisturbed:
        return None
    drawn = draws.drawn.get("undisturbed")
    return draws.event("undisturbed", parameters.undisturbed) if drawn is None else drawn


class Disturbance(ABC):
    """Base class of a sensor disturbance, such as outliers or an outage: draws, effect, causes of cost.

    It is drawn with the episode, advances with every measurement, and acts through the methods that it overrides. Its
    state contains draws and current values, nested NamedTuples of arrays ``(..., N)``. The default methods draw and
    change nothing.

    Attributes:
        name: name of its state in the truth; a reference declares by it that it knows the disturbance.
        causes: circumstances by which an evaluation splits costs.
        initial_normals: standard normal numbers that it uses at the start of the track.
        normals: standard normal numbers that it uses at each measurement.
        row_uniforms: uniform numbers that it uses at each measurement.
    """

    name: ClassVar[str]
    causes: ClassVar[tuple[Cause, ...]] = ()
    initial_normals: int = 0
    normals: int = 0
    row_uniforms: int = 0

    def __init__(self, task: TaskBase) -> None:
        self.parameters: Any = task.parameters
        self.xp: ModuleType = task.xp

    @classmethod
    def is_enabled(cls, parameters: Any) -> bool:
        """Return whether the parameters of a task switch the disturbance on; by default True."""
        return True

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Any:
        """Draw the disturbance of each episode; return its state at the start, by default None.

        Args:
            draws: random quantities of each episode.
            normals: ``(initial_normals, N)``.
            zero: ``(N,)``.
        """
        return None

    def draw_further(self, state: Any, draws: Draws) -> Any:
        """Return the state of :meth:`begin` with draws added that only some scenarios have; by default none.

        They come after the draws of all scenarios, so that the other scenarios use the same numbers as without them.
        """
        return state

    def switch_off(self, state: Any, undisturbed: Array) -> Any:
        """Return the state with the disturbance switched off in episodes without hidden ones; by default unchanged.

        A disturbance that the measurement reports leaves it unchanged, see :func:`draw_undisturbed`.
        """
        return state

    def advance(self, state: Any, step: DisturbanceInput) -> Any:
        """Return the disturbance's state at the next measurement, by default unchanged."""
        return state

    def change_deviations(self, state: Any, deviations: Array) -> Array:
        """Return the white errors' relative deviations, ``(..., N)``, as disturbed; by default unchanged."""
        return deviations

    def change_errors(self, state: Any, errors: Array) -> Array:
        """Return the sensor errors, ``(n, N)`` in the world's units, as disturbed; by default unchanged."""
        return errors

    def change_reading(self, state: Any, reading: Array) -> tuple[Any, Array]:
        """Return the state, and the sensor reading ``(n, N)`` as disturbed; by default unchanged."""
        return state, reading

    def change_measurement(self, state: Any, measurement: Any, step: DisturbanceInput) -> tuple[Any, Any]:
        """Return the state, and the whole measurement as disturbed; by default unchanged."""
        return state, measurement

    def context(self, state: Any) -> dict[str, Array]:
        """Return the random draws of the disturbance by name, for the context of an episode; by default none."""
        return {}

    def records(self, state: Any) -> dict[str, Array]:
        """Return further values to record at each measurement, by name; by default none."""
        return {}


class Disturbances:
    """List of a world's disturbances, in the order in which they act and use random numbers.

    Their states are a mapping by name.

    Args:
        drawn: the same in the order in which they are drawn with an episode; default: that order.

    Attributes:
        initial_normals: standard normal numbers of all disturbances together at the start of the track.
        normals: standard normal numbers of a measurement.
        row_uniforms: uniform numbers of a measurement.
    """

    def __init__(self, parts: Sequence[Disturbance], drawn: Sequence[Disturbance] | None = None) -> None:
        self.parts: tuple[Disturbance, ...] = tuple(parts)
        self.drawn: tuple[Disturbance, ...] = tuple(parts if drawn is None else drawn)
        self.initial_normals: int = sum(part.initial_normals for part in parts)
        self.normals: int = sum(part.normals for part in parts)
        self.row_uniforms: int = sum(part.row_uniforms for part in parts)

    @classmethod
    def of(
        cls,
        task: TaskBase,
        kinds: Sequence[type[Disturbance]],
        drawn: Sequence[type[Disturbance]] = (),
    ) -> "Disturbances":
        """Return the disturbances of these kinds that a task's parameters switch on.

        ``kinds`` are in the order in which they act. Those ``drawn`` are drawn first, the others in the order of
        ``kinds``.
        """
        parts = [kind(task) for kind in kinds if kind.is_enabled(task.parameters)]
        order = *drawn, *kinds
        return cls(parts, sorted(parts, key=lambda part: order.index(type(part))))

    def begin(self, draws: Draws, normals: Array, zero: Array) -> dict[str, Any]:
        """Draw all disturbances of each episode; return their states at the start of the track, by name."""
        shares, used = {}, 0
        for part in self.parts:
            shares[part.name] = normals[used : used + part.initial_normals]
            used += part.initial_normals
        return self._draw(lambda part: part.begin(draws, shares[part.name], zero))

    def draw_further(self, states: Mapping[str, Any], draws: Draws) -> dict[str, Any]:
        """Return the states with the quantities added that only some scenarios draw."""
        return self._draw(lambda part: part.draw_further(states[part.name], draws))

    def _draw(self, draw: Callable[[Disturbance], Any]) -> dict[str, Any]:
        states = {part.name: draw(part) for part in self.drawn}
        return {part.name: states[part.name] for part in self.parts}

    def switch_off(self, states: dict[str, Any], undisturbed: Array | None) -> dict[str, Any]:
        """Return the states with hidden disturbances switched off in the episodes where ``undisturbed``."""
        if undisturbed is None:
            return states
        return {part.name: part.switch_off(states[part.name], undisturbed) for part in self.parts}

    def split_noise(
        self, number: Array, interval: Array | float, normals: Array, uniforms: Array, feedback: Any = None
    ) -> dict[str, DisturbanceInput]:
        """Return each disturbance's input by name: its share of a measurement's random numbers, and the time."""
        steps, n, u = {}, 0, 0
        for part in self.parts:
            own = normals[n : n + part.normals], uniforms[u : u + part.row_uniforms]
            steps[part.name] = DisturbanceInput(number, interval, *own, feedback)
            n, u = n + part.normals, u + part.row_uniforms
        return steps

    def advance(self, states: Mapping[str, Any], steps: Mapping[str, DisturbanceInput]) -> dict[str, Any]:
        """Return the states of all disturbances at the next measurement."""
        return {part.name: part.advance(states[part.name], steps[part.name]) for part in self.parts}

    def change_deviations(self, states: Mapping[str, Any], deviations: Array) -> Array:
        """Return the white errors' relative deviations, ``(..., N)``, changed by every disturbance in turn."""
        for part in self.parts:
            deviations = part.change_deviations(states[part.name], deviations)
        return deviations

    def change_errors(self, states: Mapping[str, Any], errors: Array) -> Array:
        """Return the sensor errors, ``(n, N)``, changed by every disturbance in turn."""
        for part in self.parts:
            errors = part.change_errors(states[part.name], errors)
        return errors

    def change_reading(self, states: Mapping[str, Any], reading: Array) -> tuple[dict[str, Any], Array]:
        """Return the states, and the sensor reading ``(n, N)`` changed by every disturbance in turn."""
        changed = dict(states)
        for part in self.parts:
            changed[part.name], reading = part.change_reading(changed[part.name], reading)
        return changed, reading

    def change_measurement(
        self, states: Mapping[str, Any], measurement: Any, steps: Mapping[str, DisturbanceInput]
    ) -> tuple[dict[str, Any], Any]:
        """Return the states, and the measurement changed by every disturbance in turn."""
        changed = dict(states)
        for part in self.parts:
            own = changed[part.name], measurement, steps[part.name]
            changed[part.name], measurement = part.change_measurement(*own)
        return changed, measurement

    def context(self, states: Mapping[str, Any]) -> dict[str, Array]:
        """Return the random draws of all disturbances by name, for the context of an episode."""
        return {name: v for part in self.parts for name, v in part.context(states[part.name]).items()}

    def records(self, states: Mapping[str, Any]) -> dict[str, Array]:
        """Return the values of all disturbances to record at each measurement, by name."""
        return {name: v for part in self.parts for name, v in part.records(states[part.name]).items()}


def causes_of(kinds: Sequence[type[Disturbance]]) -> tuple[Cause, ...]:
    """Return the causes of cost that several classes of disturbances declare, as one tuple."""
    return tuple(cause for kind in kinds for cause in kind.causes)


class Outliers(Disturbance):
    """Disturbance by outliers: errors larger than stated, independent of each other and not reported.

    Its state is the standard deviation of this measurement's errors over that of usual ones, ``(N,)``.

    Attributes:
        probability: probability that a measurement is an outlier.
        factor: standard deviation of its errors over that of the others.
    """

    probability: float
    factor: float

    def __init__(self, task: TaskBase) -> None:
        super().__init__(task)
        self.probability, self.factor = self.probability_and_factor(self.parameters)
        self.row_uniforms = 1 if self.probability else 0

    @staticmethod
    @abstractmethod
    def probability_and_factor(parameters: Any) -> tuple[float, float]:
        """Return the probability of an outlier and the factor on its standard deviation, from the parameters."""

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Array:
        """Return factors of one on the standard deviations, ``(N,)``: the first measurement is no outlier."""
        return zero + 1.0

    def advance(self, state: Array, step: DisturbanceInput) -> Array:
        """Return the drawn factor on this measurement's standard deviations, ``(N,)``: one, or an outlier's."""
        if not self.probability:
            return state
        one = self.xp.ones_like(state)
        return self.xp.where(step.uniforms[0] < self.probability, self.factor, one)


class Glint(Outliers):
    """Disturbance by radar glint: errors multiplied by ``glint_factor`` with probability ``glint_probability``."""

    name = "glint"

    @classmethod
    def is_enabled(cls, parameters: Any) -> bool:
        """Return whether the parameters give glint a probability above zero."""
        return bool(parameters.glint_probability > 0.0)

    @staticmethod
    def probability_and_factor(parameters: Any) -> tuple[float, float]:
        """Return the probability and the factor of glint, from the parameters."""
        return parameters.glint_probability, parameters.glint_factor

    def change_errors(self, state: Array, errors: Array) -> Array:
        """Return the errors multiplied by this measurement's glint factor, which is one without glint."""
        return state * errors


class GaussMarkov(NamedTuple):
    """Stationary first-order Gauss-Markov error of a sensor, ``e_k = psi e_{k-1} + sigma sqrt(1 - psi^2) n``."""

    decay: Array
    """psi, factor on the error from one measurement to the next, ``(N,)``."""
    kick: Array
    """Standard deviation of the driving noise, ``sigma sqrt(1 - psi^2)``, ``(N,)``."""

    @classmethod
    def sampled(
        cls, deviation: Array, correlation_time: Array, interval: float, xp: ModuleType
    ) -> "GaussMarkov":
        """Return the exact discretisation of a process with a stationary deviation and a correlation time.

        Args:
            deviation: sigma, ``(N,)``.
            correlation_time: s, ``(N,)``.
            interval: from one measurement to the next, s.
            xp: array namespace.
        """
        decay = xp.exp(-interval / correlation_time)
        return cls(decay, deviation * xp.sqrt(1.0 - decay * decay))

    def advance(self, error: Array, normals: Array) -> Array:
        """Return the correlated errors at the next measurement, ``(..., N)``."""
        return self.decay * error + self.kick * normals


class ColouredErrorsState(NamedTuple):
    """State of coloured errors: drawn standard deviation, Gauss-Markov process, current errors."""

    deviation: Array
    """Stationary standard deviation, ``(..., N)``."""
    process: GaussMarkov
    level: Array
    """Errors at this measurement, in the same unit, ``(n, N)``."""


class ColouredErrors(Disturbance):
    """Disturbance by errors that are correlated in time, added to the white ones and not reported.

    Args:
        interval: from one measurement to the next, s.
        count: n, errors of a measurement.
        present: whether there may be any; else they are zero and use no random numbers.
    """

    name = "coloured"

    def __init__(self, task: TaskBase, interval: float, count: int, present: bool) -> None:
        super().__init__(task)
        self.interval = interval
        self.count = count
        self.normals: int = count if present else 0
        self.initial_normals: int = self.normals

    @abstractmethod
    def draw(self, draws: Draws, zero: Array) -> tuple[Array, Array]:
        """Draw the stationary standard deviation and the correlation time, s, each ``(N,)`` or ``(n, N)``."""

    def begin(self, draws: Draws, normals: Array, zero: Array) -> tuple[Array, Array]:
        """Return the normal numbers and zeros from which :meth:`draw_further` makes the initial errors."""
        return normals, zero

    def draw_further(self, state: tuple[Array, Array], draws: Draws) -> ColouredErrorsState:
        """Return the state with drawn deviation and correlation time; the errors are stationary from the start."""
        normals, zero = state
        deviation, lasting = self.draw(draws, zero)
        process = GaussMarkov.sampled(deviation, lasting, self.interval, self.xp)
        level = deviation * normals if self.normals else self.xp.stack([zero] * self.count)
        return ColouredErrorsState(deviation, process, level)

    def switch_off(self, state: ColouredErrorsState, undisturbed: Array) -> ColouredErrorsState:
        """Return the state with errors of zero in the episodes where ``undisturbed``."""
        deviation, kick, level = (
            self.xp.where(undisturbed, 0.0, each)
            for each in (state.deviation, state.process.kick, state.level)
        )
        return ColouredErrorsState(deviation, state.process._replace(kick=kick), level)

    def advance(self, state: ColouredErrorsState, step: DisturbanceInput) -> ColouredErrorsState:
        """Return the state with the coloured errors of the next measurement."""
        return (
            state._replace(level=state.process.advance(state.level, step.normals)) if self.normals else state
        )
