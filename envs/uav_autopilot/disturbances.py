"""Disturbances of the sensors of UavAutopilot, one class each. A measurement reports dropouts only."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from ..contract.causes import MISSED, Cause, Moment
from ..contract.draws import Draws, StepSignal, is_within
from ..contract.faults import ColouredErrors, ColouredErrorsState, Disturbance, DisturbanceInput
from ..contract.observation import Array
from .problem import AutopilotProblem

RAISED = 2.0
"""Factor on the nominal noise above which a noise counts as raised."""


def _has_noisy_sensor(moment: Moment) -> Array | None:
    if not moment.has_context("sensor_level"):
        return None
    noisy: Array = moment.xp.any(moment.context["sensor_level"] >= RAISED, axis=0)
    return noisy


def draw_steps(
    draws: Draws,
    kind: str,
    levels: Sequence[tuple[float, float]],
    times: Sequence[tuple[int, int]],
    zero: Array,
    count: int | None = None,
) -> StepSignal:
    """Draw a step signal: its level in each part of the episode, and the first measurement of each part."""
    values = [draws.log_uniform(f"{kind}_level_{i}", limits, count) for i, limits in enumerate(levels)]
    begins = [draws.integer(f"{kind}_time_{i}", limits) for i, limits in enumerate(times)]
    return StepSignal(draws.xp.stack(values), draws.xp.stack([zero, *begins])[1:])


class _OfSensors(Disturbance):
    def __init__(self, task: AutopilotProblem) -> None:
        super().__init__(task)
        self.task = task
        self.count: int = len(task.sensors)
        self.sigmas: Array = task.constant(task.parameters.value("sensor_sigmas"))[:, None]

    def chosen(self, named: tuple[str, ...] | None) -> Array:
        """Return a mask, one for the named sensors (None: all) and zero for the others, ``(m, 1)``."""
        return self.task.constant([[float(named is None or s in named)] for s in self.task.sensors])


class SensorLevels(NamedTuple):
    """State of the sensors' noise: step signals of factors, and those at this measurement."""

    levels: StepSignal
    """Factors on the sensors' noise in each part, ``(J + 1, m, N)``."""
    level: Array
    """Factors at this measurement, ``(m, N)``."""


class NoisySensors(_OfSensors):
    """Disturbance by white sensor noise that differs from nominal and changes during the episode."""

    name = "noisy_sensors"
    causes: ClassVar[tuple[Cause, ...]] = (
        Cause(
            "sensor noise",
            f"where a sensor's noise is at least {RAISED:g} times the nominal one",
            _has_noisy_sensor,
        ),
    )

    def begin(self, draws: Draws, normals: Array, zero: Array) -> SensorLevels:
        """Draw the factors on the sensors' noise and the times of their changes."""
        p, chosen = self.parameters, self.chosen(self.parameters.changing_sensors)
        levels = draw_steps(draws, "sensor", p.sensor_levels, p.sensor_times, zero, self.count)
        levels = levels._replace(values=1.0 + chosen * (levels.values - 1.0))
        return SensorLevels(levels, levels.values[0])

    def switch_off(self, state: SensorLevels, undisturbed: Array) -> SensorLevels:
        """Return the state with factors of one in the episodes where ``undisturbed``."""
        values = self.xp.where(undisturbed, 1.0, state.levels.values)
        return SensorLevels(state.levels._replace(values=values), values[0])

    def advance(self, state: SensorLevels, step: DisturbanceInput) -> SensorLevels:
        """Return the state with the factors on the sensors' noise at this measurement."""
        return state._replace(level=state.levels.at(step.number, self.xp))

    def change_deviations(self, state: SensorLevels, deviations: Array) -> Array:
        """Return the standard deviations times the factors on the sensors' noise."""
        return deviations * state.level

    def context(self, state: SensorLevels) -> dict[str, Array]:
        """Return all factors on the sensors' noise, and the measurements at which they change, by name."""
        return {"sensor_levels": state.levels.values, "sensor_level_times": state.levels.times}


class Holds(NamedTuple):
    """State of the sensors' dropouts: their starts and ends, and the last valid readings."""

    starts: Array
    """First measurement without a reading, ``(D, m, N)``."""
    stops: Array
    """First measurement with a reading again, ``(D, m, N)``."""
    reading: Array
    """Last valid reading of each sensor, repeated during a dropout, ``(m, N)``."""


class Dropouts(_OfSensors):
    """Disturbance by dropouts of a sensor, one in each period, during which it repeats its last reading."""

    name = "dropouts"
    causes: ClassVar[tuple[Cause, ...]] = (MISSED._replace(name="dropout", phrase="in dropouts of a sensor"),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Holds:
        """Draw the first measurements of the sensors' dropouts, and the first ones after them."""
        xp, p = self.xp, self.parameters
        none = xp.stack([zero] * self.count)
        starts, stops = [none], [none]
        for i in range(-(-p.horizon // p.dropout_period) if p.dropout_period else 0):
            length = draws.integer(f"dropout_length_{i}", p.dropout_length, self.count)
            room = draws.unit(f"dropout_{i}", self.count) * (p.dropout_period - length)
            starts.append(i * p.dropout_period + 1.0 + xp.floor(room))
            stops.append(starts[-1] + length)
        return Holds(xp.stack(starts)[1:], xp.stack(stops)[1:], none)

    def change_measurement(self, state: Holds, measurement: Any, step: DisturbanceInput) -> tuple[Holds, Any]:
        """Return the state, and the measurement in which sensors in a dropout repeat their last valid reading."""
        xp, available = self.xp, measurement.available
        for i in range(state.starts.shape[0]):
            out = is_within(step.number, (state.starts[i], state.stops[i]))
            available = xp.where(out, 0.0, available)
        reading = xp.where(available > 0.0, measurement.reading, state.reading)
        measurement = measurement._replace(reading=reading, available=available)
        return state._replace(reading=reading), measurement

    def context(self, state: Holds) -> dict[str, Array]:
        """Return the first measurements of the dropouts, and the first ones after them, by name."""
        return {"dropout_starts": state.starts, "dropout_stops": state.stops}


class SensorBias(_OfSensors):
    """Disturbance by constant sensor errors, which are its state, in the sensor's unit, ``(m, N)``."""

    name = "bias"

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Array:
        """Draw the constant errors of the sensors, ``(m, N)``."""
        xp, limits = self.xp, self.parameters.sensor_bias
        if not limits[1]:
            return xp.stack([zero] * self.count)
        side = xp.where(draws.event("bias_side", 0.5, self.count), 1.0, -1.0)
        size = draws.uniform("bias", limits, self.count)
        return self.sigmas * self.chosen(self.parameters.biased_sensors) * side * size

    def switch_off(self, state: Array, undisturbed: Array) -> Array:
        """Return the constant errors, zero in the episodes where ``undisturbed``."""
        return self.xp.where(undisturbed, 0.0, state)

    def change_reading(self, state: Array, reading: Array) -> tuple[Array, Array]:
        """Return the state, and the readings with the constant errors added."""
        return state, reading + state if self.parameters.sensor_bias[1] else reading

    def context(self, state: Array) -> dict[str, Array]:
        """Return the sensors' constant errors, by name."""
        return {"sensor_bias": state}


class SensorColour(ColouredErrors):
    """Disturbance by coloured sensor errors: first-order Gauss-Markov processes."""

    def __init__(self, task: AutopilotProblem) -> None:
        p = task.parameters
        super().__init__(task, p.value("sampling_interval"), len(task.sensors), p.sensor_coloured[1] > 0.0)
        self.sigmas: Array = task.constant(p.value("sensor_sigmas"))[:, None]

    def draw(self, draws: Draws, zero: Array) -> tuple[Array, Array]:
        """Draw the standard deviation, in the sensor's unit, and correlation time, s, ``(m, N)`` each."""
        p, none = self.parameters, self.xp.stack([zero] * self.count)
        if not self.normals:
            return none, none + 1.0
        deviation = self.sigmas * draws.uniform("coloured", p.sensor_coloured, self.count)
        return deviation, draws.log_uniform("correlation_time", p.sensor_correlation_time, self.count)

    def change_reading(self, state: ColouredErrorsState, reading: Array) -> tuple[ColouredErrorsState, Array]:
        """Return the state, and the readings with the coloured errors added."""
        return state, reading + state.level if self.normals else reading

    def context(self, state: ColouredErrorsState) -> dict[str, Array]:
        """Return the coloured errors at this measurement, by name."""
        return {"sensor_coloured": state.level}


DISTURBANCES: tuple[type[Disturbance], ...] = (NoisySensors, SensorColour, SensorBias, Dropouts)
"""Disturbances in the order in which they act. New ones are appended, so that episodes do not change."""
DRAWN_FIRST = (NoisySensors, Dropouts, SensorBias)
"""Disturbances that are drawn before the others, in this order, which fixes the random numbers of episodes."""
