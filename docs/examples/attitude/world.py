"""A sensor that is turned, shaken and laid down, in a field that iron disturbs."""

import math
from typing import Any, NamedTuple

from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.observation import Array
from filtergym.envs.contract.world import World

from . import motion, quaternions
from .parameters import AttitudeParameters

RADIAN = math.pi / 180.0
GRAVITY = 9.81
"""m/s^2."""
EDGE = 4.0
"""Slope of the beginning and end of a break, in fractions of motion for one radian of its period."""


class Start(NamedTuple):
    """The initial estimate given to every filter."""

    mean: Array
    """Direction cosines, ``(9, N)``."""
    covariance: Array
    """``(9, 9, N)``."""
    quaternion: Array
    """The same attitude, ``(4, N)``."""


class Measurement(NamedTuple):
    """What the three sensors say, in the sensor's frame."""

    rate: Array
    """Mean angular rate since the measurement before, rad/s, ``(3, N)``."""
    force: Array
    """Specific force, m/s^2: upwards at rest, ``(3, N)``."""
    field: Array
    """Magnetic field, microtesla, ``(3, N)``."""


class Truth(NamedTuple):
    """The sensor, and what was drawn for the episode."""

    number: Array
    """Of the measurement, ``(N,)``; likewise where nothing else is said."""
    attitude: Array
    """Quaternion to the world's frame, ``(4, N)``."""
    turning: Array
    """Of the oscillators of the angular rate, ``(2, 3, N)``."""
    shaking: Array
    """Of those of the acceleration, ``(2, 3, N)``."""
    iron: Array
    """What iron adds to the field in the world's frame, in units of its level, ``(3, N)``."""
    turning_step: motion.Oscillator
    shaking_step: motion.Oscillator
    rate_level: Array
    """rad/s."""
    acceleration_level: Array
    """m/s^2."""
    first_rest: Array
    """s."""
    break_threshold: Array
    """The sensor rests while a sine is below it."""
    break_frequency: Array
    """rad/s."""
    break_phase: Array
    """rad."""
    earth: Array
    """Undisturbed field in the world's frame, microtesla, ``(3, N)``."""
    levels: Array
    """Of the disturbance before and after the change, microtesla, ``(2, N)``."""
    change: Array
    """Number of the measurement at which it changes."""
    field_time: Array
    """s."""
    magnet: Array
    """Field of the magnet at the sensor, microtesla, ``(3, N)``."""
    gyroscope_bias: Array
    """rad/s, ``(3, N)``."""
    gyroscope_scale: Array
    """Relative, ``(3, N)``."""
    accelerometer_bias: Array
    """m/s^2, ``(3, N)``."""


class AttitudeWorld(World[Any, Truth, Measurement]):
    """A sensor in somebody's hand."""

    parameters: AttitudeParameters
    initial_normals = 30
    normals = 24

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Start]:
        """Any attitude, at rest for a while; everyone starts from one that is a few degrees off."""
        p, xp = self.parameters, self.xp
        three = [normals[3 * i : 3 * i + 3] for i in range(10)]
        attitude = quaternions.random_quaternion(draws.unit("attitude", 3))
        breaks = draws.event("breaks", p.break_probability)
        share = draws.uniform("break share", p.break_shares)
        dip = RADIAN * draws.uniform("dip", p.dips)
        strength = draws.uniform("field strength", p.field_strengths)
        magnet = draws.event("magnet", p.magnet_probability)
        magnet_level = draws.log_uniform("magnet level", p.magnet_levels)
        truth = Truth(
            number=0.0 * normals[0],
            attitude=attitude,
            turning=xp.stack(three[:2]),
            shaking=xp.stack(three[2:4]),
            iron=three[4],
            turning_step=motion.oscillator(
                draws.log_uniform("rate frequency", p.rate_frequencies), p.sampling_interval
            ),
            shaking_step=motion.oscillator(
                draws.log_uniform("acceleration frequency", p.acceleration_frequencies), p.sampling_interval
            ),
            rate_level=RADIAN * draws.log_uniform("rate level", p.rate_levels),
            acceleration_level=draws.log_uniform("acceleration level", p.acceleration_levels),
            first_rest=draws.uniform("first rest", p.first_rests),
            # A sine is below -cos(pi s) for the share s of the time; without breaks it never is.
            break_threshold=xp.where(breaks, -xp.cos(math.pi * share), -3.0),
            break_frequency=2.0 * math.pi / draws.uniform("break period", p.break_periods),
            break_phase=draws.uniform("break phase", (0.0, 2.0 * math.pi)),
            earth=strength * xp.stack([xp.cos(dip), 0.0 * dip, -xp.sin(dip)]),
            levels=xp.stack(
                [draws.log_uniform(f"field level {when}", p.field_levels) for when in ("before", "after")]
            ),
            change=draws.integer("field change", (1, p.horizon)),
            field_time=draws.log_uniform("field time", p.field_times),
            magnet=xp.where(magnet, magnet_level, 0.0) * three[5],
            gyroscope_bias=RADIAN * p.gyroscope_bias * three[6],
            gyroscope_scale=p.gyroscope_scale * three[7],
            accelerometer_bias=p.accelerometer_bias * three[8],
        )
        deviations = self.task.constant([[p.initial_tilt], [p.initial_tilt], [p.initial_heading]])
        error = quaternions.exponential(RADIAN * deviations * three[9])
        estimate = quaternions.multiply(error, attitude)
        return truth, Start(
            quaternions.direction_cosines(estimate), self.task.stated_covariance(normals[0]), estimate
        )

    def moving(self, truth: Truth) -> Array:
        """How much of its motion the sensor makes, 0 in a break, 1 outside, ``(N,)``."""
        time = self.parameters.sampling_interval * truth.number
        wave = self.xp.sin(truth.break_frequency * time + truth.break_phase)
        moving = self.xp.clip(0.5 + EDGE * (wave - truth.break_threshold), 0.0, 1.0)
        return moving * self.xp.clip(time - truth.first_rest, 0.0, 1.0)

    def rate(self, truth: Truth) -> Array:
        """True angular rate in the interval before this measurement, rad/s, ``(3, N)``."""
        return self.moving(truth) * truth.rate_level * truth.turning[0]

    def acceleration(self, truth: Truth) -> Array:
        """True acceleration in the world's frame, m/s^2, ``(3, N)``."""
        return self.moving(truth) * truth.acceleration_level * truth.shaking[1]

    def disturbance(self, truth: Truth) -> Array:
        """What iron adds to the field in the world's frame, microtesla, ``(3, N)``."""
        return self.xp.where(truth.number < truth.change, truth.levels[0], truth.levels[1]) * truth.iron

    def advance(self, truth: Truth, noise: Array, feedback: None) -> tuple[Truth, Measurement]:
        """Move for one interval, then read the sensors."""
        p, xp, T = self.parameters, self.xp, self.parameters.sampling_interval
        truth = truth._replace(
            number=truth.number + 1.0,
            turning=motion.move(truth.turning_step, truth.turning, xp.reshape(noise[0:6], (2, 3, -1))),
            shaking=motion.move(truth.shaking_step, truth.shaking, xp.reshape(noise[6:12], (2, 3, -1))),
        )
        # Iron stands in the room: the field changes where the sensor moves.
        kept = xp.exp(-T * self.moving(truth) / truth.field_time)
        iron = kept * truth.iron + xp.sqrt(1.0 - kept * kept) * noise[12:15]
        rate = self.rate(truth)
        attitude = quaternions.multiply(truth.attitude, quaternions.exponential(T * rate))
        truth = truth._replace(iron=iron, attitude=quaternions.normalise(attitude))
        cosines = quaternions.direction_cosines(truth.attitude)
        up = self.task.constant([[0.0], [0.0], [GRAVITY]])
        force = quaternions.to_sensor(cosines, self.acceleration(truth) + up)
        field = quaternions.to_sensor(cosines, truth.earth + self.disturbance(truth))
        return truth, Measurement(
            (1.0 + truth.gyroscope_scale) * rate
            + truth.gyroscope_bias
            + RADIAN * p.gyroscope_sigma * noise[15:18],
            force + truth.accelerometer_bias + p.accelerometer_sigma * noise[18:21],
            field + truth.magnet + p.magnetometer_sigma * noise[21:24],
        )

    def state(self, truth: Truth) -> Array:
        """True direction cosines, ``(9, N)``."""
        return quaternions.direction_cosines(truth.attitude)

    def error_cost(self, error: Array) -> Array:
        """Square of the total angle, deg^2, ``(N,)``."""
        angle = quaternions.total_angle(error)
        return angle * angle

    def context(self, truth: Truth) -> dict[str, Array]:
        """What was drawn, in the units of the parameters, and what of it holds now."""
        return {
            "rate_level": truth.rate_level / RADIAN,
            "acceleration_level": truth.acceleration_level,
            "gyroscope_bias": truth.gyroscope_bias / RADIAN,
            "magnet": truth.magnet,
            "moving": self.moving(truth),
            "rate": quaternions.length(self.rate(truth)) / RADIAN,
            "acceleration": quaternions.length(self.acceleration(truth)),
            "disturbance": quaternions.length(self.disturbance(truth)),
        }
