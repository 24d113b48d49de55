"""World of UavAutopilot: the aircraft, its disturbances and its sensors; equations (8) and (9)."""

import math
from typing import Any, NamedTuple

import numpy

from ...filters import linear_systems
from ...filters.linear_systems import Regulator
from ..contract.draws import Draws, StepSignal
from ..contract.faults import Disturbances, draw_undisturbed
from ..contract.observation import Array
from ..contract.world import World
from .disturbances import DISTURBANCES, DRAWN_FIRST, draw_steps
from .parameters import UavAutopilotParameters
from .problem import AutopilotProblem

FARTHEST = 1e4
"""Limit of a coordinate of a diverged loop, in its own unit: far beyond any stable loop, and small enough for squares
to be finite."""


class Truth(NamedTuple):
    """True state of the aircraft, of noise levels and commands."""

    number: Array
    """Number of measurements so far, ``(N,)``."""
    state: Array
    """State in the units of the task's components, ``(n, N)``."""
    command: Array
    """Command r at this measurement, ``(N,)``."""
    level: Array
    """Level of the disturbance in the interval before this measurement, ``(N,)``."""
    sensor_level: Array
    """Factor on the sensors' noise at this measurement, ``(m, N)``."""
    commands: StepSignal
    """Command in each part of the episode, values ``(J + 1, N)``."""
    levels: StepSignal
    """Level of the disturbance in each part of the episode, values ``(J + 1, N)``."""
    disturbances: dict[str, Any]
    """States of the sensors' disturbances by name, see :mod:`.disturbances`."""


class Start(NamedTuple):
    """Initial estimate given to every filter, with the first command."""

    mean: Array
    """Mean, zero, ``(n, N)``."""
    covariance: Array
    """Covariance from ``initial_sigmas``, ``(n, n, N)``."""
    command: Array
    """Command before the first measurement, zero, ``(N,)``."""


class Measurement(NamedTuple):
    """Readings of the sensors, with command and control of the autopilot.

    The nominal standard deviations of the sensors are the parameter ``sensor_sigmas``; differences of the true noise
    from them are unreported.
    """

    number: Array
    """Number of measurements since the start, ``(N,)``; one comes every ``sampling_interval`` seconds."""
    reading: Array
    """Reading of each sensor, in the unit of its coordinate, ``(m, N)``; in a dropout the last valid one, zero before
    the first. An estimator gets NaN in a dropout."""
    available: Array
    """1 where a sensor gave a reading, 0 in a dropout, ``(m, N)``."""
    command: Array
    """Command r at this measurement, in the unit of the output, ``(N,)``."""
    control: Array
    """Control u since the previous measurement, as fed back, m/s^2 (plant P) or deg (U), ``(N,)``."""


class AircraftWorld(World[AutopilotProblem, Truth, Measurement]):
    """World of an aircraft under the control that is fed back, with gusts and sensors."""

    parameters: UavAutopilotParameters
    received_field = "reading"

    def __init__(self, task: AutopilotProblem) -> None:
        super().__init__(task)
        p, constant, plant = self.parameters, task.constant, task.design.true_model
        scaled, other = (
            factor[:, numpy.any(factor != 0.0, axis=0)]
            for factor in map(linear_systems.noise_factor, (plant.scaled_noise, plant.other_noise))
        )
        self.scaled_drives: int = scaled.shape[1]
        """Normal numbers that the level of the disturbance multiplies; they come first."""
        self.drives: int = scaled.shape[1] + other.shape[1]
        """Normal numbers that drive the plant; those of the sensors follow."""
        self.disturbances: Disturbances = Disturbances.of(task, DISTURBANCES, DRAWN_FIRST)
        self.own_normals: int = self.drives + len(task.sensors)
        self.initial_normals: int = len(task.components) + self.disturbances.initial_normals
        self.normals: int = self.own_normals + self.disturbances.normals
        self.row_uniforms: int = self.disturbances.row_uniforms
        self.noise_factor: Array = constant(numpy.hstack([scaled, other]))
        self.F, self.B = constant(plant.F), constant(plant.B)
        self.sensor_sigmas: Array = constant(p.value("sensor_sigmas"))[:, None]
        self.initial_sigmas: Array = constant(p.value("initial_sigmas"))[:, None]
        variances = numpy.square(p.value("initial_sigmas"))
        self.initial_covariance: Array = constant(numpy.diag(variances))[:, :, None]
        self.weights: list[Any] = [(i, w) for i, w in enumerate(task.design.weight.diagonal().tolist()) if w]
        """Coordinate and weight of every square in the cost."""
        self.optimal: Regulator | None = task.design.optimal
        self.manoeuvres: int = -(-p.horizon // p.command_period) if p.command_amplitude[1] else 0

    def reading_deviations(self, measurement: Measurement) -> Array:
        """Return the nominal standard deviations of the sensors, ``(m, N)``."""
        return self.task.constant(self.parameters.value("sensor_sigmas"))[:, None] + 0.0 * measurement.reading

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Start]:
        """Draw noise levels, commands, disturbances and initial state; return this truth, and the initial estimate."""
        xp, p, size = self.xp, self.parameters, len(self.task.components)
        state = self.initial_sigmas * normals[:size]
        zero = xp.zeros_like(state[0])
        commands = self._commands(draws, zero)
        levels = draw_steps(draws, "disturbance", p.disturbance_levels, p.disturbance_times, zero)
        states = self.disturbances.begin(draws, normals[size:], zero)
        states = self.disturbances.draw_further(states, draws)
        calm = draw_undisturbed(draws, p)
        if calm is not None:
            levels = levels._replace(values=xp.where(calm, 1.0, levels.values))
        if p.plant == "U":
            state = xp.concat([state[:-1], state[-1:] * levels.values[0]])
        truth = Truth(
            number=zero,
            state=state,
            command=zero,
            level=levels.values[0],
            sensor_level=xp.ones_like(xp.stack([zero] * len(self.task.sensors))),
            commands=commands,
            levels=levels,
            disturbances=self.disturbances.switch_off(states, calm),
        )
        covariance = xp.broadcast_to(self.initial_covariance, (*self.initial_covariance.shape[:2], len(zero)))
        return truth, Start(xp.zeros_like(state), covariance, zero)

    def _commands(self, draws: Draws, zero: Array) -> StepSignal:
        """Draw the command signal: a step, or random manoeuvres.

        Each period of random manoeuvres has a step to a new level or a doublet, with equal probability.
        """
        xp, p = self.xp, self.parameters
        if p.step_size:
            return StepSignal(xp.stack([zero, zero + p.step_size]), (zero + p.step_time)[None])
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
        return StepSignal(xp.stack(values), xp.stack(times)[1:])

    def advance(self, truth: Truth, noise: Array, feedback: Array) -> tuple[Truth, Measurement]:
        """Return the truth after one interval under the control that is fed back, and the measurement."""
        xp = self.xp
        number = truth.number + 1.0
        level = truth.levels.at(number, xp)
        drive, readout = noise[: self.drives], noise[self.drives : self.own_normals]
        drive = xp.concat([drive[: self.scaled_drives] * level, drive[self.scaled_drives :]])
        disturbance = xp.matmul(self.noise_factor, drive)
        state = xp.matmul(self.F, truth.state) + self.B * feedback + disturbance
        state = xp.clip(state, -FARTHEST, FARTHEST)
        further = noise[self.own_normals : self.normals], noise[self.normals :]
        steps = self.disturbances.split_noise(
            number, self.parameters.value("sampling_interval"), *further, feedback
        )
        states = self.disturbances.advance(truth.disturbances, steps)
        sensor_level = self.disturbances.change_deviations(states, xp.ones_like(readout))
        reading = self.task.readings_of(state) + self.sensor_sigmas * sensor_level * readout
        states, reading = self.disturbances.change_reading(states, reading)
        command = truth.commands.at(number, xp)
        measurement = Measurement(number, reading, xp.ones_like(reading), command, feedback)
        states, measurement = self.disturbances.change_measurement(states, measurement, steps)
        truth = truth._replace(
            number=number,
            state=state,
            command=command,
            level=level,
            sensor_level=sensor_level,
            disturbances=states,
        )
        return truth, measurement

    def component_readings(self, measurement: Measurement) -> Array:
        """Return the readings of the coordinates with a sensor, ``(n, N)``; NaN for the others."""
        sensors = list(self.task.sensors)
        reading, nothing = self.mask_missing(measurement).reading, measurement.command * math.nan
        rows = [nothing] * len(self.task.components)
        for i, component in enumerate(self.task.components):
            if component.name in sensors:
                rows[i] = reading[sensors.index(component.name)]
        return self.xp.stack(rows)

    def cost(self, truth: Truth, mean: Array) -> Array:
        """Return the loop's cost, a weighted sum of squared control and distance to the commanded state, ``(N,)``."""
        task = self.task
        control = task.autopilot(mean, truth.command)
        total = task.design.control_weight * control * control
        for i, weight in self.weights:
            deviation = truth.state[i] - truth.command if i == task.output else truth.state[i]
            total = total + weight * deviation * deviation
        return total * (1.0 / task.cost_unit)

    def counted_cost(self, truth: Truth, mean: Array) -> Array:
        """Return the loss of an estimate's control against the optimal control from the true state, ``(N,)``.

        ``(R + B^T S B) (u - u*)^2 / sigma^2`` with S of the Riccati equation (see :class:`.Regulator`). Of two filters
        the sums over an episode differ on average by the difference of their costs, including the value ``x^T S x`` of
        their final states. It excludes the costs of noise and command under any control.
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
        """Return output and command to record at a measurement, by name."""
        return {
            **self.disturbances.records(truth.disturbances),
            "output": truth.state[self.task.output],
            "command": truth.command,
        }

    def context(self, truth: Truth) -> dict[str, Array]:
        """Return noise levels, commands, dropouts with their times, and sensor errors, by name."""
        return {
            "levels": truth.levels.values,
            "level_times": truth.levels.times,
            "commands": truth.commands.values,
            "command_times": truth.commands.times,
            "level": truth.level,
            "sensor_level": truth.sensor_level,
            **self.disturbances.context(truth.disturbances),
        }
