"""The aircraft of UavAutopilot, what disturbs it, and its sensors; equations (8) and (9)."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy

from ...filters import linear_systems
from ..contract.draws import Draws
from ..contract.faults import GaussMarkov
from ..contract.observation import Array
from ..contract.schedules import Steps, within
from ..contract.world import World
from .parameters import UavAutopilotParameters

if TYPE_CHECKING:
    from .task import UavAutopilot

FARTHEST = 1e4
"""Where a coordinate of a lost loop stops, in its own unit: far beyond what any stable loop reaches, and
small enough for squares to stay numbers."""


class Truth(NamedTuple):
    """The aircraft, the noise, and the course of the episode."""

    number: Array
    """Measurements so far, ``(N,)``."""
    state: Array
    """In the units of the task's components, ``(n, N)``."""
    reading: Array
    """Last valid reading of each sensor, which it holds during a dropout, ``(m, N)``."""
    command: Array
    """r at this measurement, ``(N,)``."""
    level: Array
    """Of the disturbance in the interval before this measurement, ``(N,)``."""
    sensor_level: Array
    """Factor on the sensors' noise at this measurement, ``(m, N)``."""
    commands: Steps
    """Values ``(J + 1, N)``."""
    levels: Steps
    """Values ``(J + 1, N)``."""
    sensor_levels: Steps
    """Values ``(J + 1, m, N)``."""
    sensor_bias: Array
    """Constant error of each sensor, in its unit, ``(m, N)``."""
    sensor_coloured: Array
    """Coloured error of each sensor at this measurement, in its unit, ``(m, N)``."""
    coloured_decay: Array
    """What is left of it at the next measurement, ``(m, N)``."""
    coloured_kick: Array
    """Standard deviation of what it gains, ``(m, N)``; zero: there is no such error."""
    dropout_starts: Array
    """First measurement without a reading, ``(D, m, N)``."""
    dropout_stops: Array
    """First measurement with a reading again, ``(D, m, N)``."""


class Start(NamedTuple):
    """The initial estimate given to every filter."""

    mean: Array
    """Zero, ``(n, N)``."""
    covariance: Array
    """That of ``initial_sigmas``, ``(n, n, N)``."""
    command: Array
    """Zero: nothing is commanded before the first measurement, ``(N,)``."""


class Measurement(NamedTuple):
    """What the sensors say, and what the autopilot knows: its command and its control.

    The nominal standard deviations of the sensors are the parameter ``sensor_sigmas``; by how much their noise
    differs from it nobody says.
    """

    number: Array
    """Measurements since the start, ``(N,)``; one comes every ``sampling_interval`` seconds."""
    reading: Array
    """Of each sensor, in the unit of its coordinate, ``(m, N)``; in a dropout the last valid one, zero if there
    was none yet, where an estimator gets NaN."""
    available: Array
    """1 where a sensor answered, 0 in a dropout, ``(m, N)``."""
    command: Array
    """r at this measurement, in the unit of the output, ``(N,)``."""
    control: Array
    """u in force since the measurement before: what was fed back, m/s^2 (plant P) or deg (U), ``(N,)``."""


class AircraftWorld(World["UavAutopilot", Truth, Measurement]):
    """An aircraft that is flown by what is fed back, its gusts, and its sensors."""

    parameters: UavAutopilotParameters
    received_field = "reading"

    def __init__(self, task: "UavAutopilot") -> None:
        super().__init__(task)
        p, constant, plant = self.parameters, task.constant, task.design.true_model
        scaled, other = (
            factor[:, numpy.any(factor != 0.0, axis=0)]
            for factor in map(linear_systems.noise_factor, (plant.scaled_noise, plant.other_noise))
        )
        self.scaled_drives = scaled.shape[1]
        """Normal numbers that the level of the disturbance multiplies; they come first."""
        self.drives = scaled.shape[1] + other.shape[1]
        """Normal numbers that drive the plant; those of the sensors follow."""
        m = len(task.sensors)
        self.sensors_are_coloured = p.sensor_coloured[1] > 0.0
        self.initial_normals = len(task.components) + self.sensors_are_coloured * m
        self.normals = self.drives + (1 + self.sensors_are_coloured) * m
        self.noise_factor = constant(numpy.hstack([scaled, other]))
        self.F, self.B = constant(plant.F), constant(plant.B)
        self.sensor_sigmas = constant(p.value("sensor_sigmas"))[:, None]
        self.initial_sigmas = constant(p.value("initial_sigmas"))[:, None]
        self.initial_covariance = constant(numpy.diag(numpy.square(p.value("initial_sigmas"))))[:, :, None]
        self.changing, self.biased = (
            constant([[float(named is None or s in named)] for s in task.sensors])
            for named in (p.changing_sensors, p.biased_sensors)
        )
        self.weights = [(i, w) for i, w in enumerate(task.design.weight.diagonal().tolist()) if w]
        """Coordinate and weight of every square in the cost."""
        self.optimal = task.design.optimal
        self.manoeuvres = -(-p.horizon // p.command_period) if p.command_amplitude[1] else 0
        self.dropouts = -(-p.horizon // p.dropout_period) if p.dropout_period else 0

    def reading_deviations(self, measurement: Measurement) -> Array:
        """The nominal ones."""
        return self.task.constant(self.parameters.value("sensor_sigmas"))[:, None] + 0.0 * measurement.reading

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Start]:
        """Draw what the episode will be like, and the state at its start."""
        xp, p, m = self.xp, self.parameters, len(self.task.sensors)
        state = self.initial_sigmas * normals[: len(self.task.components)]
        zero = xp.zeros_like(state[0])
        commands = self._commands(draws, zero)
        levels = self._parts(draws, "disturbance", p.disturbance_levels, p.disturbance_times, zero)
        sensor_levels = self._parts(draws, "sensor", p.sensor_levels, p.sensor_times, zero, m)
        sensor_levels = sensor_levels._replace(values=1.0 + self.changing * (sensor_levels.values - 1.0))
        no_dropout = xp.stack([zero] * m)
        starts, stops = [no_dropout], [no_dropout]
        for i in range(self.dropouts):
            length = draws.integer(f"dropout_length_{i}", p.dropout_length, m)
            room = draws.unit(f"dropout_{i}", m) * (p.dropout_period - length)
            starts.append(i * p.dropout_period + 1.0 + xp.floor(room))
            stops.append(starts[-1] + length)
        bias, deviation = no_dropout, no_dropout
        if p.sensor_bias[1]:
            side = xp.where(draws.event("bias_side", 0.5, m), 1.0, -1.0)
            bias = self.sensor_sigmas * self.biased * side * draws.uniform("bias", p.sensor_bias, m)
        lasting = 1.0 + no_dropout
        if self.sensors_are_coloured:
            deviation = self.sensor_sigmas * draws.uniform("coloured", p.sensor_coloured, m)
            lasting = draws.log_uniform("correlation_time", p.sensor_correlation_time, m)
        if p.undisturbed:
            calm = draws.event("undisturbed", p.undisturbed)
            levels = levels._replace(values=xp.where(calm, 1.0, levels.values))
            sensor_levels = sensor_levels._replace(values=xp.where(calm, 1.0, sensor_levels.values))
            stops = [xp.where(calm, start, stop) for start, stop in zip(starts, stops, strict=True)]
            bias, deviation = (xp.where(calm, 0.0, values) for values in (bias, deviation))
        coloured = GaussMarkov.sampled(deviation, lasting, p.value("sampling_interval"), xp)
        if p.plant == "U":
            state = xp.concat([state[:-1], state[-1:] * levels.values[0]])
        truth = Truth(
            number=zero,
            state=state,
            reading=no_dropout,
            command=zero,
            level=levels.values[0],
            sensor_level=sensor_levels.values[0],
            commands=commands,
            levels=levels,
            sensor_levels=sensor_levels,
            sensor_bias=bias,
            sensor_coloured=deviation * normals[len(self.task.components) :]
            if self.sensors_are_coloured
            else no_dropout,
            coloured_decay=coloured.decay,
            coloured_kick=coloured.kick,
            dropout_starts=xp.stack(starts)[1:],
            dropout_stops=xp.stack(stops)[1:],
        )
        covariance = xp.broadcast_to(self.initial_covariance, (*self.initial_covariance.shape[:2], len(zero)))
        return truth, Start(xp.zeros_like(state), covariance, zero)

    def _parts(
        self,
        draws: Draws,
        kind: str,
        levels: Sequence[tuple[float, float]],
        times: Sequence[tuple[int, int]],
        zero: Array,
        count: int | None = None,
    ) -> Steps:
        """Draw the level in each part of the episode, and when the parts begin."""
        values = [draws.log_uniform(f"{kind}_level_{i}", limits, count) for i, limits in enumerate(levels)]
        begins = [draws.integer(f"{kind}_time_{i}", limits) for i, limits in enumerate(times)]
        return Steps(self.xp.stack(values), self.xp.stack([zero, *begins])[1:])

    def _commands(self, draws: Draws, zero: Array) -> Steps:
        """Draw the command.

        In each period of random manoeuvres, at a random time, either a step to a new level or a doublet
        about the present one, as likely.
        """
        xp, p = self.xp, self.parameters
        if p.step_size:
            return Steps(xp.stack([zero, zero + p.step_size]), (zero + p.step_time)[None])
        low, high = p.command_amplitude
        values, times = [zero], [zero]
        for i in range(self.manoeuvres):
            doublet = draws.event(f"doublet_{i}", 0.5)
            limits = i * p.command_period + 1, (i + 1) * p.command_period - 2 * p.doublet_width
            start = draws.integer(f"manoeuvre_time_{i}", limits)
            size = draws.uniform(f"size_{i}", (-1.0, 1.0))
            amplitude = xp.where(size < 0.0, -1.0, 1.0) * (low + (high - low) * xp.abs(size))
            present = values[-1]
            times += [start, start + p.doublet_width, start + 2.0 * p.doublet_width]
            values += [
                xp.where(doublet, present + amplitude, amplitude),
                xp.where(doublet, present - amplitude, amplitude),
                xp.where(doublet, present, amplitude),
            ]
        return Steps(xp.stack(values), xp.stack(times)[1:])

    def advance(self, truth: Truth, noise: Array, feedback: Array) -> tuple[Truth, Measurement]:
        """The control acts for one interval; the sensors that work answer.

        Args:
            truth: at the measurement before.
            noise: ``(normals, N)``.
            feedback: the control u, ``(N,)``.
        """
        xp = self.xp
        number = truth.number + 1.0
        level, sensor_level = truth.levels.at(number, xp), truth.sensor_levels.at(number, xp)
        m = len(self.task.sensors)
        drive, readout = noise[: self.drives], noise[self.drives : self.drives + m]
        drive = xp.concat([drive[: self.scaled_drives] * level, drive[self.scaled_drives :]])
        disturbance = xp.matmul(self.noise_factor, drive)
        state = xp.matmul(self.F, truth.state) + self.B * feedback + disturbance
        state = xp.clip(state, -FARTHEST, FARTHEST)
        reading = self.task.readings_of(state) + self.sensor_sigmas * sensor_level * readout
        coloured = truth.sensor_coloured
        if self.sensors_are_coloured:
            process = GaussMarkov(truth.coloured_decay, truth.coloured_kick)
            coloured = process.advance(coloured, noise[self.drives + m :])
            reading = reading + coloured
        if self.parameters.sensor_bias[1]:
            reading = reading + truth.sensor_bias
        available = xp.ones_like(reading)
        for i in range(truth.dropout_starts.shape[0]):
            out = within(number, (truth.dropout_starts[i], truth.dropout_stops[i]))
            available = xp.where(out, 0.0, available)
        reading = xp.where(available > 0.0, reading, truth.reading)
        command = truth.commands.at(number, xp)
        truth = truth._replace(
            number=number,
            state=state,
            reading=reading,
            command=command,
            level=level,
            sensor_level=sensor_level,
            sensor_coloured=coloured,
        )
        return truth, Measurement(number, reading, available, command, feedback)

    def component_readings(self, measurement: Measurement) -> Array:
        """Every coordinate that has a sensor."""
        sensors = list(self.task.sensors)
        reading, nothing = self.mask_missing(measurement).reading, measurement.command * math.nan
        rows = [nothing] * len(self.task.components)
        for i, component in enumerate(self.task.components):
            if component.name in sensors:
                rows[i] = reading[sensors.index(component.name)]
        return self.xp.stack(rows)

    def cost(self, truth: Truth, mean: Array) -> Array:
        """Weighted squares of deviation from the command's equilibrium and of the control, ``(N,)``."""
        task = self.task
        control = task.autopilot(mean, truth.command)
        total = task.design.control_weight * control * control
        for i, weight in self.weights:
            deviation = truth.state[i] - truth.command if i == task.output else truth.state[i]
            total = total + weight * deviation * deviation
        return total * (1.0 / task.cost_unit)

    def charge(self, truth: Truth, mean: Array) -> Array:
        """What the control that follows from an estimate loses against the optimal one for the true state.

        ``(R + B^T S B) (u - u*)^2 / sigma^2`` with S of the Riccati equation (see :class:`.Regulator`). Of two filters
        the sums over an episode differ on average by what the costs differ, the value ``x^T S x`` of where they end
        included; left out is what noise and command cost any control, and the luck of it. Without that one sees sooner,
        and at once, what an action was worth.
        """
        if self.optimal is None:
            return self.cost(truth, mean)
        task = self.task
        lost = task.autopilot(mean, truth.command)
        for i, gain in enumerate(self.optimal.feedback[0].tolist()):
            deviation = truth.state[i] - truth.command if i == task.output else truth.state[i]
            lost = lost + gain * deviation
        return (float(self.optimal.regret[0, 0]) / task.cost_unit) * lost * lost

    def records(self, truth: Truth) -> dict[str, Array]:
        """Output and command, in the unit of the output."""
        return {"output": truth.state[self.task.output], "command": truth.command}

    def context(self, truth: Truth) -> dict[str, Array]:
        """Levels of the disturbance and of each sensor's noise, commands and dropouts, with the numbers of the
        measurements at which they step, the levels now, and what the sensors' errors have beside white noise.
        """
        return {
            "levels": truth.levels.values,
            "level_times": truth.levels.times,
            "sensor_levels": truth.sensor_levels.values,
            "sensor_level_times": truth.sensor_levels.times,
            "commands": truth.commands.values,
            "command_times": truth.commands.times,
            "dropout_starts": truth.dropout_starts,
            "dropout_stops": truth.dropout_stops,
            "level": truth.level,
            "sensor_level": truth.sensor_level,
            "sensor_bias": truth.sensor_bias,
            "sensor_coloured": truth.sensor_coloured,
        }
