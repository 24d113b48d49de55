"""Disturbances of the sensors of TightlyCoupledNavigation: one class each."""

import math
from typing import Any, ClassVar, NamedTuple

from ...filters import gnss_ins
from ..contract.causes import Cause, Moment, context_flag
from ..contract.draws import Draws, draw_between
from ..contract.faults import (
    ColouredErrors,
    ColouredErrorsState,
    Disturbance,
    DisturbanceInput,
    draw_undisturbed,
)
from ..contract.observation import Array
from .problem import NavigationProblem

QUANTILE_95 = 1.6448536269514722
"""95 % quantile of the standard normal distribution."""
CLEAR_ERROR = 19.0
"""95 % quantile of the multipath error, the positive part of a normal one, at 44 dB-Hz and more, m."""
MULTIPATH = ((44.0, 7.0, 49.0), (38.0, 25.0, 79.0), (30.0, 50.0, 152.0))
"""Median and 95 % quantile, m, of the lognormal multipath error below each C/N0, dB-Hz."""
PULLED = 5.0
"""Error of a pseudorange, m, above which it counts as wrong; noise is some metres."""


def _is_noisy(moment: Moment) -> Array | None:
    if not moment.has_context("noise_factor"):
        return None
    noisy: Array = moment.xp.any(moment.context["noise_factor"] > 1.0, axis=0)
    return noisy


def _lacks_range(moment: Moment) -> Array:
    count = moment.measurement.satellite_position.shape[1]
    lacking: Array = moment.xp.any(moment.measurement.available[:count] < 0.5, axis=0)
    return lacking


def _lacks_rate(moment: Moment) -> Array:
    count = moment.measurement.satellite_position.shape[1]
    lacking: Array = moment.xp.any(moment.measurement.available[count : 2 * count] < 0.5, axis=0)
    return lacking


def _is_pulled(moment: Moment) -> Array | None:
    if not moment.has_context("range_error"):
        return None
    pulled: Array = moment.xp.any(moment.xp.abs(moment.context["range_error"]) > PULLED, axis=0)
    return pulled


class _OfSatellites(Disturbance):
    """Base class of disturbances of S satellites, whose readings are pseudoranges, then their rates."""

    def __init__(self, task: NavigationProblem) -> None:
        super().__init__(task)
        self.task = task
        self.satellites: int = task.satellites
        self.places: Array = task.constant(range(task.satellites))[:, None]

    def change_rows(self, values: Array, first: int, changed: Array) -> Array:
        """Return the values of all readings, ``(m, N)``, with ``changed`` from row ``first`` on."""
        return self.xp.concat([values[:first], changed, values[first + changed.shape[0] :]])

    def change_available(self, measurement: Any, first: int, factor: Array) -> Any:
        available = measurement.available
        changed = available[first : first + factor.shape[0]] * factor
        return measurement._replace(available=self.change_rows(available, first, changed))


class Fault(NamedTuple):
    """State of a temporary sensor disturbance: its window, satellites, strength, whether it occurs now."""

    window: Array
    """First and last step of the disturbance, ``(2, N)``; -1 where it does not occur."""
    satellites: Array
    """Indices of the affected satellites, ``(n, N)``; None where it affects none."""
    own: Array
    """Further state, which depends on the disturbance."""
    now: Array
    """One where it occurs at this step, else zero, ``(N,)``."""


class _Once(_OfSatellites):
    """Temporary disturbance that occurs at most once in an episode, with a probability."""

    title: ClassVar[str]
    """Prefix of the parameters of its probability and duration."""

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Fault:
        """Draw the first and last step of the disturbance, if it occurs, and its satellites.

        The start is uniform over the times that leave room for the duration.
        """
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        happens = draws.event(self.name, getattr(p, f"{self.title}_probability"))
        start = draws.unit(f"{self.name}_start")
        seconds = draws.uniform(f"{self.name}_duration", getattr(p, f"{self.title}_duration"))
        first = 1.0 + xp.floor(start * xp.clip(p.horizon * T - seconds, 0.0, None) / T)
        window = xp.stack([first, first + xp.round(seconds / T) - 1.0])
        return Fault(xp.where(happens, window, -1.0), self.draw_satellites(draws), zero, zero)

    def draw_satellites(self, draws: Draws) -> Array:
        return None

    def advance(self, state: Fault, step: DisturbanceInput) -> Fault:
        happens = (step.number >= state.window[0]) & (step.number <= state.window[1])
        return state._replace(now=self.xp.astype(happens, state.now.dtype))

    def is_at(self, state: Fault) -> Array:
        """Return booleans ``(S, N)``: whether the disturbance affects each satellite now."""
        chosen = self.places == state.satellites[0]
        for i in range(1, state.satellites.shape[0]):
            chosen = chosen | (self.places == state.satellites[i])
        return chosen & (state.now > 0.0)

    def context(self, state: Fault) -> dict[str, Array]:
        window = state.window
        return {self.name: self.xp.where(window[1] >= window[0], window, -1.0)}


class _Hidden(_Once):
    """Temporary disturbance that the measurement does not report."""

    def switch_off(self, state: Fault, undisturbed: Array) -> Fault:
        return state._replace(window=self.xp.where(undisturbed, -1.0, state.window))


class StuckAccelerometers(_Hidden):
    """Disturbance by accelerometers that repeat their last reading for a time; unreported.

    The further state is the last reading, m/s^2, ``(3, N)``.
    """

    name, title = "stuck", "stick"
    causes = (Cause("stuck accelerometers", "while the accelerometers are stuck", context_flag("stuck_now")),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Fault:
        """Draw whether and when the accelerometers stick; the last reading is zero."""
        return super().begin(draws, normals, zero)._replace(own=self.xp.stack([zero] * 3))

    def change_reading(self, state: Fault, reading: Array) -> tuple[Fault, Array]:
        """Return the state with the last reading, and the readings, in which stuck accelerometers repeat it."""
        rows = self.task.sensors[2].readings
        forces = self.xp.where(state.now > 0.0, state.own, reading[rows])
        return state._replace(own=forces), self.change_rows(reading, rows.start, forces)

    def advance(self, state: Fault, step: DisturbanceInput) -> Fault:
        """Return the state with ``now`` set for this step; never at the first measurement."""
        state = super().advance(state, step)
        return state._replace(now=self.xp.where(step.number > 1.0, state.now, 0.0))

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window of the fault, and whether the accelerometers stick now, by name."""
        return {**super().context(state), "stuck_now": state.now}


class NoisyRate(_Hidden):
    """Disturbance by a noisier rate channel of one satellite for a time; unreported.

    The further state is the factor on its standard deviation, ``(N,)``.
    """

    name, title = "noisy", "rate_fault"
    causes = (Cause("noisy rate", "while a pseudorange rate is too noisy", _is_noisy),)

    def draw_satellites(self, draws: Draws) -> Array:
        """Draw the index of the satellite with a noisy rate, ``(1, N)``."""
        return draws.integer("noisy_satellite", (0, self.satellites - 1))[None]

    def draw_further(self, state: Fault, draws: Draws) -> Fault:
        """Return the state with the drawn factor on the standard deviation of the satellite's rate."""
        factor = draw_between(draws.log_uniform, "rate_fault_factor", self.parameters.rate_fault_factor)
        return state._replace(own=state.own + factor)

    def change_deviations(self, state: Fault, deviations: Array) -> Array:
        """Return the standard deviations, with that of the satellite's rate times its factor."""
        S = self.satellites
        factor = self.xp.where(self.is_at(state), state.own, 1.0)
        return self.change_rows(deviations, S, factor * deviations[S : 2 * S])

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window and satellite of the noisy rate, by name."""
        return {**super().context(state), "noisy_satellite": state.satellites[0]}


class HiddenSatellites(_Once):
    """Disturbance by an outage of two satellites for a time."""

    name, title = "hidden", "satellites_outage"
    causes = (Cause("range lost", "where a pseudorange is missing", _lacks_range),)

    def draw_satellites(self, draws: Draws) -> Array:
        """Draw the indices of the two hidden satellites, ``(2, N)``."""
        S = self.satellites
        first = draws.integer("hidden_satellite", (0, S - 1))
        second = (first + 1.0 + draws.integer("other_hidden_satellite", (0, max(S - 2, 0)))) % S
        return self.xp.stack([first, second])

    def change_measurement(self, state: Fault, measurement: Any, step: DisturbanceInput) -> tuple[Fault, Any]:
        """Return the state, and the measurement without both satellites' pseudoranges and rates."""
        seen = self.xp.where(self.is_at(state), 0.0, self.xp.ones_like(state.now))
        return state, self.change_available(measurement, 0, self.xp.concat([seen, seen]))

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window and satellites of the outage, by name."""
        return {**super().context(state), "hidden_satellites": state.satellites}


class LostRates(_Once):
    """Disturbance by an outage of all rates for a time."""

    name, title = "no_rates", "rates_outage"
    causes = (Cause("rate lost", "where a pseudorange rate is missing", _lacks_rate),)

    def change_measurement(self, state: Fault, measurement: Any, step: DisturbanceInput) -> tuple[Fault, Any]:
        """Return the state, and the measurement without the rates of all satellites."""
        kept = self.xp.stack([1.0 - state.now] * self.satellites)
        return state, self.change_available(measurement, self.satellites, kept)


class RangeColour(ColouredErrors):
    """Disturbance by pseudorange errors that are correlated in time, such as of the atmosphere."""

    def __init__(self, task: NavigationProblem) -> None:
        p = task.parameters
        super().__init__(task, p.sampling_interval, task.satellites, p.pseudorange_coloured[1] > 0.0)

    def draw(self, draws: Draws, zero: Array) -> tuple[Array, Array]:
        """Draw the standard deviation, m, and correlation time, s, of pseudorange errors, ``(N,)`` each."""
        p = self.parameters
        draw_undisturbed(draws, p)  # comes first among the random numbers
        if not self.normals:
            return zero, zero + p.pseudorange_correlation_time[0]
        lasting = p.pseudorange_correlation_time
        return (
            zero + draw_between(draws.uniform, "pseudorange_coloured", p.pseudorange_coloured),
            zero + draw_between(draws.log_uniform, "pseudorange_correlation_time", lasting),
        )

    def change_errors(self, state: ColouredErrorsState, errors: Array) -> Array:
        """Return the errors with the correlated ones added to the pseudoranges."""
        return errors + state.level

    def context(self, state: ColouredErrorsState) -> dict[str, Array]:
        """Return standard deviation, m, and decay of the pseudorange errors, by name."""
        return {"coloured_deviation": state.deviation, "coloured_decay": state.process.decay}


class Reception(NamedTuple):
    """State of the reception between houses: C/N0, multipath errors and their durations."""

    urban: Array
    """One for reception between houses, else zero, ``(N,)``."""
    cn0: Array
    """Carrier-to-noise density C/N0, ``(S, N)``, dB-Hz."""
    multipath: Array
    """Present multipath error of each pseudorange, ``(S, N)``, m."""
    hold: Array
    """Remaining steps of that error, ``(S, N)``."""


class Reflections(_OfSatellites):
    """Disturbance by reception between houses: C/N0 walks randomly, pseudoranges have multipath errors.

    The random numbers of a measurement: S normals of the walk, S of the errors, S uniforms of their durations.
    """

    name = "reflections"

    def __init__(self, task: NavigationProblem) -> None:
        super().__init__(task)
        self.row_uniforms: int = self.satellites if self.parameters.urban else 0
        self.normals: int = 2 * self.row_uniforms

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Reception:
        """Draw the initial C/N0 of each satellite.

        It is drawn under an open sky, too, so that all scenarios use the same random numbers.
        """
        cn0 = draws.uniform("cn0", self.parameters.cn0_limits, self.satellites)
        none = self.xp.stack([zero] * self.satellites)
        return Reception(zero, cn0, none, none)

    def draw_further(self, state: Reception, draws: Draws) -> Reception:
        """Return the state with the drawn choice whether the episode is between houses."""
        urban = _draw_share(draws, "urban", self.parameters, state.urban)
        return state._replace(
            urban=urban, cn0=self.xp.where(urban < 0.5, self.parameters.clear_cn0, state.cn0)
        )

    def advance(self, state: Reception, step: DisturbanceInput) -> Reception:
        """Return the state with C/N0 walked between limits, and multipath errors renewed where old ones ended."""
        xp, p, S = self.xp, self.parameters, self.satellites
        if not p.urban:
            return state
        walk, normal = step.normals[:S], step.normals[S:]
        low, high = p.cn0_limits
        cn0 = state.cn0 + p.urban_cn0_walk * walk
        cn0 = xp.clip(xp.where(cn0 < low, 2.0 * low - cn0, cn0), low, None)
        cn0 = xp.clip(xp.where(cn0 > high, 2.0 * high - cn0, cn0), low, high)
        error = xp.clip((CLEAR_ERROR / QUANTILE_95) * normal, 0.0, None)
        for limit, median, upper in MULTIPATH:
            drawn = median * xp.exp((math.log(upper / median) / QUANTILE_95) * normal)
            error = xp.where(cn0 < limit, drawn, error)
        ended = state.hold <= 0.0
        shortest, longest = p.urban_hold
        steps = xp.round((shortest + (longest - shortest) * step.uniforms) / p.sampling_interval)
        outside = state.urban < 0.5
        return Reception(
            state.urban,
            xp.where(outside, state.cn0, cn0),
            xp.where(outside, 0.0, xp.where(ended, error, state.multipath)),
            xp.where(ended, steps, state.hold) - 1.0,
        )

    def change_errors(self, state: Reception, errors: Array) -> Array:
        """Return the errors with the multipath errors added to the pseudoranges."""
        return errors + state.multipath

    def change_measurement(
        self, state: Reception, measurement: Any, step: DisturbanceInput
    ) -> tuple[Reception, Any]:
        """Return the state, and the measurement with the C/N0 filled in."""
        return state, measurement._replace(cn0=state.cn0)

    def context(self, state: Reception) -> dict[str, Array]:
        """Return whether the episode is between houses, by name."""
        return {"urban": state.urban}


def _draw_share(draws: Draws, name: str, parameters: Any, zero: Array) -> Array:
    """Draw ones with the probability ``name_probability``, else zeros, ``(N,)``; 0 and 1 need no random number."""
    share = getattr(parameters, f"{name}_probability")
    if not getattr(parameters, name) or share == 1.0:
        return zero + float(getattr(parameters, name))
    return draws.xp.astype(draws.event(name, share), zero.dtype)


class Ramp(_Hidden):
    """Disturbance by a pseudorange that drifts off from some time to the end; unreported.

    The further state is its initial and its present error, m, ``(2, N)``.
    """

    name = "ramp"
    causes = (Cause("wrong range", f"where a pseudorange is off by more than {PULLED:g} m", _is_pulled),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Fault:
        """Return the state without a ramp, which :meth:`draw_further` draws."""
        return Fault(self.xp.stack([zero - 1.0] * 2), zero[None], self.xp.stack([zero] * 2), zero)

    def draw_further(self, state: Fault, draws: Draws) -> Fault:
        """Return the state with the drawn start, satellite and initial error of the ramp."""
        xp, p, zero = self.xp, self.parameters, state.now
        if not p.ramp_probability:
            return state
        happens = draws.event("ramp", p.ramp_probability)
        first = 1.0 + xp.round(draws.uniform("ramp_start", p.ramp_start) / p.sampling_interval)
        window = xp.where(happens, xp.stack([first, zero + p.horizon + 1.0]), -1.0)
        satellite = draws.integer("ramp_satellite", (0, self.satellites - 1))
        jump = zero + draw_between(draws.uniform, "ramp_jump", p.ramp_jump)
        return Fault(window, satellite[None], xp.stack([jump, zero]), zero)

    def advance(self, state: Fault, step: DisturbanceInput) -> Fault:
        """Return the state with the ramp's error at this step."""
        p, jump = self.parameters, state.own[0]
        run = jump + (p.ramp_rate * p.sampling_interval) * (step.number - state.window[0] + 1.0)
        return super().advance(state._replace(own=self.xp.stack([jump, run])), step)

    def change_errors(self, state: Fault, errors: Array) -> Array:
        """Return the errors with the ramp's error added to its pseudorange."""
        if not self.parameters.ramp_probability:
            return errors
        return errors + self.xp.where(self.is_at(state), state.own[1], 0.0)

    def context(self, state: Fault) -> dict[str, Array]:
        """Return window, satellite and initial error of the ramp, by name."""
        own = {"ramp_satellite": state.satellites[0], "ramp_jump": state.own[0]}
        return {**super().context(state), **own}


class Aperture(_OfSatellites):
    """Disturbance by tracking loops that lose signals far from the prediction; state: one where they do, ``(N,)``."""

    name = "aperture"

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Array:
        """Return zeros: the state without an aperture, which :meth:`draw_further` draws."""
        return zero

    def draw_further(self, state: Array, draws: Draws) -> Array:
        """Draw the state: one in episodes whose tracking loops have an aperture, else zero, ``(N,)``."""
        return _draw_share(draws, "aperture", self.parameters, state)

    def change_measurement(self, state: Array, measurement: Any, step: DisturbanceInput) -> tuple[Array, Any]:
        """Return the state, and the measurement without ranges and rates outside the aperture.

        The aperture is centred on the predicted state ``(17, N)``.
        """
        feedback = step.feedback
        if feedback is None:
            return state, measurement
        sight = gnss_ins.geometry(feedback, measurement.satellite_position, measurement.satellite_velocity)
        expected = self.xp.concat(gnss_ins.ranges(feedback, sight))
        innovation = measurement.readings[self.task.tracked] - expected
        kept = (self.xp.abs(innovation) <= self.task.apertures) | (state < 0.5)
        return state, self.change_available(measurement, 0, self.xp.astype(kept, feedback.dtype))

    def context(self, state: Array) -> dict[str, Array]:
        """Return whether the tracking loops have an aperture, by name."""
        return {"aperture": state}


DISTURBANCES: tuple[type[Disturbance], ...] = (
    StuckAccelerometers,
    NoisyRate,
    HiddenSatellites,
    LostRates,
    RangeColour,
    Reflections,
    Ramp,
    Aperture,
)
"""Disturbances in the order in which they act. New ones are appended, so that episodes do not change."""
DRAWN_FIRST = (NoisyRate, StuckAccelerometers, LostRates, HiddenSatellites, Ramp, Reflections, Aperture)
"""Disturbances that are drawn before the others, in this order, which fixes the random numbers of episodes."""
