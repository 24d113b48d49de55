"""The flight of TightlyCoupledNavigation and the sensors on board; equations in ``filters/gnss_ins.py``. Its course
is a part of its own (:mod:`.course`).
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy

from ...filters import gnss_ins
from ...filters.ordered_sums import ordered_sum
from ..contract.draws import Draws, draw_between
from ..contract.faults import GaussMarkov
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.task import Task
from ..contract.world import World
from .course import Course, Legs
from .parameters import DEGREE, SINGER, TightlyCoupledNavigationParameters

if TYPE_CHECKING:
    from .task import TightlyCoupledNavigation

KNOWN_AT_START = (1.0,) * 3 + (0.0,) + (1.0,) * 3 + (0.0,) + (1.0,) * 3 + (0.0,) * 6
"""One for what is exact and known with errors, position, velocity and acceleration; clock and attitude errors
are drawn and unknown."""
QUANTILE_95 = 1.6448536269514722
"""Of the standard normal distribution."""
CLEAR_ERROR = 19.0
"""95 % quantile of the multipath error, the positive part of a normal one, at 44 dB-Hz and more, m."""
OFF = 5.0
"""Standard deviations from which an error of a pseudorange is a fault."""
MULTIPATH = ((44.0, 7.0, 49.0), (38.0, 25.0, 79.0), (30.0, 50.0, 152.0))
"""Below a C/N0, dB-Hz, the error is lognormal: its median and 95 % quantile, m."""


class Faults(NamedTuple):
    """First and last step of what goes wrong, ``(2, N)`` each, and where; -1 where it does not."""

    noisy: Array
    """One satellite's rate is noisy."""
    noisy_satellite: Array
    """Place of that satellite, ``(N,)``."""
    stuck: Array
    """The accelerometers repeat their last reading."""
    no_rates: Array
    """No satellite has a rate."""
    hidden: Array
    """Two satellites are gone."""
    hidden_satellites: Array
    """Places of those two, ``(2, N)``."""
    rate_factor: Array
    """How much noisier the noisy rate is, ``(N,)``."""
    ramp: Array
    """First step at which a pseudorange is off, and the last step of all."""
    ramp_satellite: Array
    """Place of that satellite, ``(N,)``."""
    ramp_jump: Array
    """Bias with which the drift begins, ``(N,)``, m."""
    urban: Array
    """One between houses, else zero, ``(N,)``."""
    aperture: Array
    """One where the tracking loops lose what they do not expect, else zero, ``(N,)``."""
    calm: Array
    """One where nothing goes wrong, else zero, ``(N,)``."""


FAULT_WINDOWS = ("noisy", "stuck", "no_rates", "hidden", "ramp")
"""Which of these are first and last steps."""


class Truth(NamedTuple):
    """The user, and what its sensors remember; S satellites, m = 2 S + 6 readings."""

    step: Array
    """Measurements so far, ``(N,)`` integers."""
    legs: Legs
    faults: Faults
    state: Array
    """``(17, N)``, in the order of filters.gnss_ins."""
    mode: Array
    """True hypothesis, ``(N,)`` integers."""
    jumped: Array
    """One where the acceleration has just taken the value with which the next leg begins, ``(N,)``."""
    noise_factor: Array
    """True standard deviation of each reading over the nominal one, ``(m, N)``."""
    stuck: Array
    """One where the accelerometers hold an old reading, ``(N,)``."""
    accelerometers: Array
    """Their last reading, ``(3, N)``, m/s^2."""
    cn0: Array
    """``(S, N)``, dB-Hz."""
    multipath: Array
    """Held error of each pseudorange, ``(S, N)``, m."""
    hold: Array
    """Steps for which it still holds, ``(S, N)``."""
    range_error: Array
    """What every pseudorange is off by beside its noise: multipath, ramp and coloured error, ``(S, N)``, m."""
    heading: Array
    """Of the level aircraft, ``(N,)``, rad."""
    coloured_deviation: Array
    """Stationary standard deviation of the coloured error of every pseudorange, ``(N,)``, m."""
    coloured_decay: Array
    """What is left of it from one measurement to the next, ``(N,)``."""
    coloured: Array
    """That error, ``(S, N)``, m."""


class Measurement(NamedTuple):
    """What receiver and inertial system say; S satellites, m = 2 S + 6 readings."""

    number: Array
    """Of the measurement, counted from 1, ``(N,)`` integers; one takes ``sampling_interval`` seconds."""
    readings: Array
    """S pseudoranges, m; S pseudorange rates, m/s; accelerometers forward, right and down, m/s^2; differences of
    heading, pitch and roll from the attitude reference, rad; ``(m, N)``. Their nominal standard deviations are
    those of ``task.sensors``."""
    available: Array
    """One where a reading is there, zero where it is not and its value means nothing, where an estimator gets
    NaN, ``(m, N)``."""
    ins_angles: Array
    """Heading, pitch, roll shown by the inertial system, ``(3, N)``, rad."""
    cn0: Array
    """Carrier to noise density of each satellite, ``(S, N)``, dB-Hz."""
    satellite_position: Array
    """From the ephemerides, east, north, up of the site, ``(3, S, N)``, m."""
    satellite_velocity: Array
    """``(3, S, N)``, m/s."""


class NavigationWorld(World[Task, Truth, Measurement]):
    """An aircraft with a satellite receiver and an inertial system."""

    task: "TightlyCoupledNavigation"
    parameters: TightlyCoupledNavigationParameters
    received_field = "readings"
    initial_normals = gnss_ins.SIZE

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        p, task, constant, S = self.parameters, self.task, self.task.constant, self.task.satellites
        self.normals = gnss_ins.SIZE + len(task.sensor_variance) + (2 * S if p.urban else 0)
        self.coloured = p.pseudorange_coloured[1] > 0.0
        if self.coloured:
            self.normals, self.initial_normals = self.normals + S, self.initial_normals + S
        self.row_uniforms = S if p.urban else 0
        self.course = Course(task)
        self.clock_root = constant(numpy.linalg.cholesky(task.common.clock_noise))
        sigmas = [p.initial_position_sigma] * 3 + [p.initial_clock_sigma]
        sigmas += [p.initial_velocity_sigma] * 3 + [p.initial_drift_sigma]
        sigmas += [p.initial_acceleration_sigma] * 3
        sigmas += [p.initial_attitude_sigma * DEGREE] * 3 + [p.attitude_rate_sigma * DEGREE] * 3
        self.initial_sigma = constant(sigmas)[:, None]
        self.known = constant(KNOWN_AT_START)[:, None]
        self.places = constant(range(S))[:, None]

    # --- the episode

    def reading_deviations(self, measurement: Measurement) -> Array:
        """The nominal ones."""
        return self.task.sensor_sigma + 0.0 * measurement.readings

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw legs and faults; what is known of the start has errors."""
        xp, p, S = self.xp, self.parameters, self.task.satellites
        zeros = xp.zeros_like(normals[0])
        legs, velocity, heading = self.course.begin(draws, zeros)
        faults = self._faults(draws)
        # Drawn in open country too: every scenario takes the same numbers.
        cn0 = draws.uniform("cn0", p.cn0_limits, S)
        faults = self._further_faults(draws, faults)
        between_houses = faults.urban > 0.0
        cn0 = xp.where(between_houses, cn0, p.clear_cn0)
        velocity = xp.where(between_houses, p.urban_speed * velocity, velocity)
        slower = xp.where(between_houses, p.urban_strength * legs.acceleration, legs.acceleration)
        legs = legs._replace(acceleration=slower)
        none = zeros[None]
        moving = xp.concat([none] * 4 + [velocity, none, legs.acceleration[:, 0]] + [none] * 6)
        deviation, lasting = self._coloured_error(draws, zeros, faults)
        coloured = GaussMarkov.sampled(deviation, lasting, p.sampling_interval, xp)
        spread = self.initial_sigma * normals[: gnss_ins.SIZE]
        state = moving + (1.0 - self.known) * spread
        identity = xp.eye(gnss_ins.SIZE, dtype=normals.dtype, device=self.task.device)
        truth = Truth(
            step=xp.astype(zeros, xp.int64),
            legs=legs,
            faults=faults,
            state=state,
            mode=xp.astype(legs.kind[0], xp.int64),
            jumped=zeros,
            noise_factor=xp.stack([zeros + 1.0] * len(self.task.sensor_variance)),
            stuck=zeros,
            accelerometers=xp.stack([zeros] * 3),
            cn0=cn0,
            multipath=xp.stack([zeros] * S),
            hold=xp.stack([zeros] * S),
            range_error=xp.stack([zeros] * S),
            heading=heading,
            coloured_deviation=deviation,
            coloured_decay=coloured.decay,
            coloured=deviation * normals[gnss_ins.SIZE :] if self.coloured else xp.stack([zeros] * S),
        )
        covariance = (identity * self.initial_sigma**2)[:, :, None] + zeros
        return truth, Initial(moving + self.known * spread, covariance)

    def _faults(self, draws: Draws) -> Faults:
        """Draw what goes wrong, and when."""
        xp, p, S, T = self.xp, self.parameters, self.task.satellites, self.parameters.sampling_interval

        def window(start: Array, seconds: Array) -> Array:
            """First and last step, from a start that is a share of the time left free."""
            first = 1.0 + xp.floor(start * xp.clip(p.horizon * T - seconds, 0.0, None) / T)
            return xp.stack([first, first + xp.round(seconds / T) - 1.0])

        def sometimes(name: str, probability: float, seconds: tuple[float, float]) -> Array:
            happens, start = draws.event(name, probability), draws.unit(f"{name}_start")
            return xp.where(happens, window(start, draws.uniform(f"{name}_duration", seconds)), -1.0)

        noisy = sometimes("noisy", p.rate_fault_probability, p.rate_fault_duration)
        noisy_satellite = draws.integer("noisy_satellite", (0, S - 1))
        stuck = sometimes("stuck", p.stick_probability, p.stick_duration)
        no_rates = sometimes("no_rates", p.rates_outage_probability, p.rates_outage_duration)
        hidden = sometimes("hidden", p.satellites_outage_probability, p.satellites_outage_duration)
        first = draws.integer("hidden_satellite", (0, S - 1))
        second = (first + 1.0 + draws.integer("other_hidden_satellite", (0, max(S - 2, 0)))) % S
        zero = 0.0 * first
        return Faults(
            noisy=noisy,
            noisy_satellite=noisy_satellite,
            stuck=stuck,
            no_rates=no_rates,
            hidden=hidden,
            hidden_satellites=xp.stack([first, second]),
            rate_factor=zero + p.rate_fault_factor[0],
            ramp=xp.stack([zero, zero]) - 1.0,
            ramp_satellite=zero,
            ramp_jump=zero,
            urban=zero + float(p.urban),
            aperture=zero + float(p.aperture),
            calm=zero,
        )

    def _further_faults(self, draws: Draws, faults: Faults) -> Faults:
        """Draw what only some scenarios draw: the others take as many numbers as ever."""
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        zero = 0.0 * faults.rate_factor
        factor = zero + draw_between(draws.log_uniform, "rate_fault_factor", p.rate_fault_factor)
        faults = faults._replace(rate_factor=factor)
        if p.ramp_probability:
            happens = draws.event("ramp", p.ramp_probability)
            first = 1.0 + xp.round(draws.uniform("ramp_start", p.ramp_start) / T)
            ramp = xp.where(happens, xp.stack([first, zero + p.horizon + 1.0]), -1.0)
            satellite = draws.integer("ramp_satellite", (0, self.task.satellites - 1))
            jump = zero + draw_between(draws.uniform, "ramp_jump", p.ramp_jump)
            faults = faults._replace(ramp=ramp, ramp_satellite=satellite, ramp_jump=jump)
        for name in ("urban", "aperture"):
            share = getattr(p, f"{name}_probability")
            if getattr(p, name) and share < 1.0:
                here = xp.astype(draws.event(name, share), zero.dtype)
                faults = faults._replace(**{name: here})
        if p.undisturbed:
            calm = draws.event("undisturbed", p.undisturbed)
            windows = {name: xp.where(calm, -1.0, getattr(faults, name)) for name in FAULT_WINDOWS}
            places = {name: xp.where(calm, 0.0, getattr(faults, name)) for name in ("urban", "aperture")}
            faults = faults._replace(**windows, **places, calm=xp.astype(calm, zero.dtype))
        return faults

    def _coloured_error(self, draws: Draws, zeros: Array, faults: Faults) -> tuple[Array, Array]:
        """Draw standard deviation, m, and correlation time, s, of the coloured error, ``(N,)`` each."""
        p = self.parameters
        if not self.coloured:
            return zeros, zeros + p.pseudorange_correlation_time[0]
        deviation = zeros + draw_between(draws.uniform, "pseudorange_coloured", p.pseudorange_coloured)
        lasting = draw_between(
            draws.log_uniform, "pseudorange_correlation_time", p.pseudorange_correlation_time
        )
        return (1.0 - faults.calm) * deviation, zeros + lasting

    # --- one measurement

    def advance(self, truth: Truth, noise: Array, feedback: Array | None) -> tuple[Truth, Measurement]:
        """Move the user, and measure with noise, faults, outages and multipath.

        Args:
            truth: at the measurement before.
            noise: see :class:`.World`.
            feedback: where tracking loops have an aperture, the state ``(17, N)`` that they expect.
        """
        xp, p, task, m = self.xp, self.parameters, self.task, len(self.task.sensor_variance)
        step = truth.step + 1
        k = xp.astype(step, noise.dtype)
        state, mode, jumped = self._move(truth, k, noise[: gnss_ins.SIZE])
        noise = noise[gnss_ins.SIZE :]
        level = 0.0 * truth.heading
        ins_angles = xp.stack([truth.heading, level, level]) + state[gnss_ins.ATTITUDE_ERROR]
        position, velocity = task.satellites_at(step)
        exact, _ = gnss_ins.observe(state, position, velocity, ins_angles, p.gravity)

        ones, faults = xp.ones_like(noise[:m]), truth.faults
        noisy = self._during(faults.noisy, k) & (self.places == faults.noisy_satellite)
        gone = faults.hidden_satellites
        hidden = self._during(faults.hidden, k) & ((self.places == gone[0]) | (self.places == gone[1]))
        seen = xp.where(hidden, 0.0, ones[: task.satellites])
        factor = self._each(ones, rates=xp.where(noisy, faults.rate_factor, ones[: task.satellites]))
        available = self._each(
            ones, pseudoranges=seen, rates=xp.where(self._during(faults.no_rates, k), 0.0, seen)
        )
        if self.coloured:
            kick = truth.coloured_deviation * xp.sqrt(1.0 - truth.coloured_decay * truth.coloured_decay)
            process = GaussMarkov(truth.coloured_decay, kick)
            error = process.advance(truth.coloured, noise[m : m + task.satellites])
            truth = truth._replace(coloured=error)
        if p.urban:
            truth = self._reflect(truth, noise[noise.shape[0] - 3 * task.satellites :])
        # A stick at the first measurement has no last reading to hold.
        stuck = self._during(faults.stuck, k) & (k > 1.0)
        measured = exact + task.sensor_sigma * factor * noise[:m]
        ranges, rates, forces, attitude = (measured[sensor.readings] for sensor in task.sensors)
        forces = xp.where(stuck, truth.accelerometers, forces)
        error = truth.multipath + truth.coloured
        if p.ramp_probability:
            off = self._during(faults.ramp, k) & (self.places == faults.ramp_satellite)
            run = faults.ramp_jump + (p.ramp_rate * p.sampling_interval) * (k - faults.ramp[0] + 1.0)
            error = error + xp.where(off, run, 0.0)
        readings = xp.concat([ranges + error, rates, forces, attitude])
        if feedback is not None:
            expected = gnss_ins.ranges(feedback, gnss_ins.geometry(feedback, position, velocity))
            innovation = readings[task.tracked] - xp.concat(expected)
            kept = (xp.abs(innovation) <= task.apertures) | (faults.aperture < 0.5)
            kept = xp.astype(kept, noise.dtype)
            available = xp.concat([available[task.tracked] * kept, available[task.tracked.stop :]])
        truth = truth._replace(
            step=step,
            state=state,
            mode=mode,
            jumped=jumped,
            noise_factor=factor,
            stuck=xp.astype(stuck, noise.dtype),
            accelerometers=forces,
            range_error=error,
        )
        return truth, Measurement(step, readings, available, ins_angles, truth.cn0, position, velocity)

    def _during(self, window: Array, k: Array) -> Array:
        """Whether step k lies in a window, ``(N,)``."""
        return (k >= window[0]) & (k <= window[1])

    def _each(self, ones: Array, **groups: Array) -> Array:
        """One number for each reading: what is said of its group of sensors, else one."""
        return self.xp.concat([groups.get(s.name, ones[s.readings]) for s in self.task.sensors])

    def _move(self, truth: Truth, k: Array, normals: Array) -> tuple[Array, Array, Array]:
        """State at step k, the hypothesis it follows, and whether its acceleration has jumped."""
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

    def _reflect(self, truth: Truth, noise: Array) -> Truth:
        """C/N0 walks between its limits; where a multipath error has run out, a new one is drawn by the C/N0 now.

        Args:
            truth: before.
            noise: S normals of the walk, S of the errors, S uniforms of how long they hold, ``(3 S, N)``.
        """
        xp, p, S = self.xp, self.parameters, self.task.satellites
        walk, normal, uniform = noise[:S], noise[S : 2 * S], noise[2 * S :]
        low, high = p.cn0_limits
        cn0 = truth.cn0 + p.urban_cn0_walk * walk
        cn0 = xp.clip(xp.where(cn0 < low, 2.0 * low - cn0, cn0), low, None)
        cn0 = xp.clip(xp.where(cn0 > high, 2.0 * high - cn0, cn0), low, high)
        error = xp.clip((CLEAR_ERROR / QUANTILE_95) * normal, 0.0, None)
        for limit, median, upper in MULTIPATH:
            drawn = median * xp.exp((math.log(upper / median) / QUANTILE_95) * normal)
            error = xp.where(cn0 < limit, drawn, error)
        ended = truth.hold <= 0.0
        shortest, longest = p.urban_hold
        steps = xp.round((shortest + (longest - shortest) * uniform) / p.sampling_interval)
        outside = truth.faults.urban < 0.5
        return truth._replace(
            cn0=xp.where(outside, truth.cn0, cn0),
            multipath=xp.where(outside, 0.0, xp.where(ended, error, truth.multipath)),
            hold=xp.where(ended, steps, truth.hold) - 1.0,
        )

    # --- judgement

    def error_cost(self, error: Array) -> Array:
        """Squared position and velocity errors over those of a single-epoch fix."""
        p, x, v = self.parameters, error[gnss_ins.POSITION], error[gnss_ins.VELOCITY]
        return ordered_sum(x * x) / p.position_unit**2 + ordered_sum(v * v) / p.velocity_unit**2

    def records(self, truth: Truth) -> dict[str, Array]:
        """Time, true hypothesis, and one where a sensor fails: a rate that is noisier than stated, stuck
        accelerometers, a pseudorange that is off by more than five standard deviations.
        """
        xp, p = self.xp, self.parameters
        seconds = p.sampling_interval * xp.astype(truth.step, truth.state.dtype)
        off = xp.any(xp.abs(truth.range_error) > OFF * p.pseudorange_sigma, axis=0)
        failing = xp.any(truth.noise_factor > 1.0, axis=0) | (truth.stuck > 0.0) | off
        return {
            "seconds": seconds,
            "true_mode": truth.mode,
            "sensor_fails": xp.astype(failing, truth.state.dtype),
        }

    def context(self, truth: Truth) -> dict[str, Array]:
        """Legs and faults with the steps of each (first and last, -1 where there is none), and what holds now: the true
        hypothesis, the noise of every reading over the nominal one, stuck accelerometers, and what pseudoranges are
        off by.
        """
        legs, faults = truth.legs, truth.faults

        def window(steps: Array) -> Array:
            return self.xp.where(steps[1] >= steps[0], steps, -1.0)

        return {
            "leg_start": legs.start,
            "leg_kind": legs.kind,
            "leg_acceleration": legs.acceleration,
            "noisy": window(faults.noisy),
            "noisy_satellite": faults.noisy_satellite,
            "stuck": window(faults.stuck),
            "no_rates": window(faults.no_rates),
            "hidden": window(faults.hidden),
            "hidden_satellites": faults.hidden_satellites,
            "ramp": window(faults.ramp),
            "ramp_satellite": faults.ramp_satellite,
            "ramp_jump": faults.ramp_jump,
            "coloured_deviation": truth.coloured_deviation,
            "coloured_decay": truth.coloured_decay,
            "urban": faults.urban,
            "aperture": faults.aperture,
            "mode": truth.mode,
            "noise_factor": truth.noise_factor,
            "stuck_now": truth.stuck,
            "range_error": truth.range_error,
        }
