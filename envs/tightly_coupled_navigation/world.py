"""World of TightlyCoupledNavigation: flight and sensors on board; equations in ``filters/gnss_ins.py``.

The motion of the user is in :mod:`.course`.
"""

import math
from typing import Any, NamedTuple

import numpy

from ...filters import gnss_ins
from ...filters.ordered_sums import ordered_sum
from ..contract.draws import Draws
from ..contract.faults import Disturbances, draw_undisturbed
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.task import Task
from ..contract.world import World
from .course import Course, Legs
from .disturbances import DISTURBANCES, DRAWN_FIRST
from .parameters import DEGREE, SINGER, TightlyCoupledNavigationParameters
from .problem import NavigationProblem

KNOWN_AT_START = (1.0,) * 3 + (0.0,) + (1.0,) * 3 + (0.0,) + (1.0,) * 3 + (0.0,) * 6
"""Ones for states whose initial estimate is the truth plus an error (position, velocity, acceleration), zeros for clock
and attitude errors, whose initial truth is drawn around zero."""
OFF = 5.0
"""Error of a pseudorange in standard deviations above which it counts as a fault."""


class Truth(NamedTuple):
    """The true state of the user and of the sensors; S satellites, m = 2 S + 6 readings."""

    step: Array
    """Number of measurements so far, ``(N,)`` integers."""
    legs: Legs
    state: Array
    """True state, ``(17, N)``, in the order of filters.gnss_ins."""
    mode: Array
    """Index of the true hypothesis, ``(N,)`` integers."""
    jumped: Array
    """One where the acceleration has just jumped to the initial value of the next leg, ``(N,)``."""
    noise_factor: Array
    """True standard deviation of each reading over the nominal one, ``(m, N)``."""
    range_error: Array
    """Error of every pseudorange beside its noise: multipath, ramp and coloured error, ``(S, N)``, m."""
    heading: Array
    """Heading of the level aircraft, ``(N,)``, rad."""
    disturbances: dict[str, Any]
    """State of each disturbance by its name, see :mod:`.disturbances`."""


class Measurement(NamedTuple):
    """Readings of receiver and inertial system; S satellites, m = 2 S + 6 readings."""

    number: Array
    """Number of the measurement, counted from 1, ``(N,)`` integers; the interval is ``sampling_interval`` seconds."""
    readings: Array
    """S pseudoranges, m; S pseudorange rates, m/s; accelerometers forward, right and down, m/s^2; differences of
    heading, pitch and roll from the attitude reference, rad; ``(m, N)``. Their nominal standard deviations are
    those of ``task.sensors``."""
    available: Array
    """One where a reading is available, zero where it is not and its value is meaningless (NaN for an estimator), ``(m,
    N)``."""
    ins_angles: Array
    """Heading, pitch and roll by the inertial system, ``(3, N)``, rad."""
    cn0: Array
    """Carrier to noise density of each satellite, ``(S, N)``, dB-Hz."""
    satellite_position: Array
    """Satellite positions from the ephemerides, east, north, up of the site, ``(3, S, N)``, m."""
    satellite_velocity: Array
    """Satellite velocities from the ephemerides, ``(3, S, N)``, m/s."""


class NavigationWorld(World[Task, Truth, Measurement]):
    """World of an aircraft with a satellite receiver and an inertial system (INS)."""

    task: NavigationProblem
    parameters: TightlyCoupledNavigationParameters
    received_field = "readings"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        p, task, constant = self.parameters, self.task, self.task.constant
        self.disturbances: Disturbances = Disturbances.of(task, DISTURBANCES, DRAWN_FIRST)
        self.own_normals: int = gnss_ins.SIZE + len(task.sensor_variance)
        self.initial_normals: int = gnss_ins.SIZE + self.disturbances.initial_normals
        self.normals: int = self.own_normals + self.disturbances.normals
        self.row_uniforms: int = self.disturbances.row_uniforms
        self.course: Course = Course(task)
        self.clock_root: Array = constant(numpy.linalg.cholesky(task.common.clock_noise))
        sigmas = [p.initial_position_sigma] * 3 + [p.initial_clock_sigma]
        sigmas += [p.initial_velocity_sigma] * 3 + [p.initial_drift_sigma]
        sigmas += [p.initial_acceleration_sigma] * 3
        sigmas += [p.initial_attitude_sigma * DEGREE] * 3 + [p.attitude_rate_sigma * DEGREE] * 3
        self.initial_sigma: Array = constant(sigmas)[:, None]
        self.known: Array = constant(KNOWN_AT_START)[:, None]

    # --- the episode

    def reading_deviations(self, measurement: Measurement) -> Array:
        """Return the nominal standard deviations of the readings, ``(m, N)``."""
        return self.task.sensor_sigma + 0.0 * measurement.readings

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw legs, disturbances and initial errors; return this truth, and the initial estimate."""
        xp, p = self.xp, self.parameters
        zeros = xp.zeros_like(normals[0])
        legs, velocity, heading = self.course.begin(draws, zeros)
        states = self.disturbances.begin(draws, normals[gnss_ins.SIZE :], zeros)
        states = self.disturbances.draw_further(states, draws)
        states = self.disturbances.switch_off(states, draw_undisturbed(draws, p))
        between_houses = states["reflections"].urban > 0.0
        velocity = xp.where(between_houses, p.urban_speed * velocity, velocity)
        slower = xp.where(between_houses, p.urban_strength * legs.acceleration, legs.acceleration)
        legs = legs._replace(acceleration=slower)
        none = zeros[None]
        moving = xp.concat([none] * 4 + [velocity, none, legs.acceleration[:, 0]] + [none] * 6)
        spread = self.initial_sigma * normals[: gnss_ins.SIZE]
        state = moving + (1.0 - self.known) * spread
        identity = xp.eye(gnss_ins.SIZE, dtype=normals.dtype, device=self.task.device)
        truth = Truth(
            step=xp.astype(zeros, xp.int64),
            legs=legs,
            state=state,
            mode=xp.astype(legs.kind[0], xp.int64),
            jumped=zeros,
            noise_factor=xp.stack([zeros + 1.0] * len(self.task.sensor_variance)),
            range_error=xp.stack([zeros] * self.task.satellites),
            heading=heading,
            disturbances=states,
        )
        covariance = (identity * self.initial_sigma**2)[:, :, None] + zeros
        return truth, Initial(moving + self.known * spread, covariance)

    # --- one measurement

    def advance(self, truth: Truth, noise: Array, feedback: Array | None) -> tuple[Truth, Measurement]:
        """Return the truth after one step, and the measurement with noise and disturbances.

        ``feedback`` is the state ``(17, N)`` that tracking loops with an aperture expect.
        """
        xp, p, task = self.xp, self.parameters, self.task
        step = truth.step + 1
        k = xp.astype(step, noise.dtype)
        state, mode, jumped = self._move(truth, k, noise[: gnss_ins.SIZE])
        level = 0.0 * truth.heading
        ins_angles = xp.stack([truth.heading, level, level]) + state[gnss_ins.ATTITUDE_ERROR]
        position, velocity = task.satellites_at(step)
        exact, _ = gnss_ins.observe(state, position, velocity, ins_angles, p.gravity)

        further = noise[self.own_normals : self.normals], noise[self.normals :]
        steps = self.disturbances.split_noise(k, p.sampling_interval, *further, feedback)
        states = self.disturbances.advance(truth.disturbances, steps)
        white, ranges = noise[gnss_ins.SIZE : self.own_normals], task.sensors[0].readings
        ones = xp.ones_like(white)
        factor = self.disturbances.change_deviations(states, ones)
        error = self.disturbances.change_errors(states, 0.0 * white[ranges])
        measured = exact + task.sensor_sigma * factor * white
        readings = xp.concat([measured[ranges] + error, measured[ranges.stop :]])
        states, readings = self.disturbances.change_reading(states, readings)
        measurement = Measurement(step, readings, ones, ins_angles, white[ranges], position, velocity)
        states, measurement = self.disturbances.change_measurement(states, measurement, steps)
        truth = truth._replace(
            step=step,
            state=state,
            mode=mode,
            jumped=jumped,
            noise_factor=factor,
            range_error=error,
            disturbances=states,
        )
        return truth, measurement

    def _move(self, truth: Truth, k: Array, normals: Array) -> tuple[Array, Array, Array]:
        xp, common, c = self.xp, self.task.common, self.clock_root
        moved = gnss_ins.advance(truth.state, self.task.axis[:, :, SINGER], common.T, common.decay)
        w = xp.reshape(normals[:9], (3, 3, *normals.shape[1:]))
        (x, v, a), mode, jumped = self.course.move(truth.legs, k, truth.state, moved, w)
        bias = moved[3] + c[0, 0] * normals[9]
        drift = moved[7] + (c[1, 0] * normals[9] + c[1, 1] * normals[10])
        attitude = moved[11:14] + math.sqrt(common.attitude_variance) * normals[11:14]
        rate = moved[14:17] + math.sqrt(common.attitude_rate_variance) * normals[14:17]
        state = xp.concat([x, bias[None], v, drift[None], a, attitude, rate])
        return state, mode, jumped

    # --- judgement

    def error_cost(self, error: Array) -> Array:
        """Return the squared position and velocity errors over those of a single-epoch fix, ``(N,)``."""
        p, x, v = self.parameters, error[gnss_ins.POSITION], error[gnss_ins.VELOCITY]
        return ordered_sum(x * x) / p.position_unit**2 + ordered_sum(v * v) / p.velocity_unit**2

    def records(self, truth: Truth) -> dict[str, Array]:
        """Return time, true hypothesis, whether a sensor fails, and values of disturbances, to record, by name.

        Failures are a noisier rate, stuck accelerometers, and a pseudorange error above five standard deviations.
        """
        xp, p = self.xp, self.parameters
        seconds = p.sampling_interval * xp.astype(truth.step, truth.state.dtype)
        off = xp.any(xp.abs(truth.range_error) > OFF * p.pseudorange_sigma, axis=0)
        failing = xp.any(truth.noise_factor > 1.0, axis=0) | (truth.disturbances["stuck"].now > 0.0) | off
        return {
            **self.disturbances.records(truth.disturbances),
            "seconds": seconds,
            "true_mode": truth.mode,
            "sensor_fails": xp.astype(failing, truth.state.dtype),
        }

    def context(self, truth: Truth) -> dict[str, Array]:
        """Return legs, disturbances, true hypothesis, and noise and errors of readings, by name."""
        return {
            "leg_start": truth.legs.start,
            "leg_kind": truth.legs.kind,
            "leg_acceleration": truth.legs.acceleration,
            **self.disturbances.context(truth.disturbances),
            "mode": truth.mode,
            "noise_factor": truth.noise_factor,
            "range_error": truth.range_error,
        }
