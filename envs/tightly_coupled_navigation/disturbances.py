"""Disturbances of the sensors of TightlyCoupledNavigation: a class for each."""

import math
from typing import Any, ClassVar, NamedTuple

from ...filters import gnss_ins
from ..contract.causes import Cause, Moment, context_flag
from ..contract.draws import Draws, draw_between
from ..contract.faults import ColouredErrors, ColouredErrorsState, Disturbance, DisturbanceInput, undisturbed
from ..contract.observation import Array
from .problem import NavigationProblem

QUANTILE_95 = 1.6448536269514722
"""Of the standard normal distribution."""
CLEAR_ERROR = 19.0
"""95 % quantile of the multipath error, the positive part of a normal one, at 44 dB-Hz and more, m."""
MULTIPATH = ((44.0, 7.0, 49.0), (38.0, 25.0, 79.0), (30.0, 50.0, 152.0))
"""Below a C/N0, dB-Hz, the error is lognormal: its median and 95 % quantile, m."""
PULLED = 5.0
"""m by which a pseudorange is off from which it is wrong: noise is some metres."""


def _is_noisy(moment: Moment) -> Array | None:
    if not moment.knows("noise_factor"):
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
    if not moment.knows("range_error"):
        return None
    pulled: Array = moment.xp.any(moment.xp.abs(moment.context["range_error"]) > PULLED, axis=0)
    return pulled


class _OfSatellites(Disturbance):
    """Disturbance of satellites, S of them; pseudoranges come first in the readings, then their rates."""

    def __init__(self, task: NavigationProblem) -> None:
        super().__init__(task)
        self.task = task
        self.satellites: int = task.satellites
        self.places: Array = task.constant(range(task.satellites))[:, None]

    def change_rows(self, values: Array, first: int, changed: Array) -> Array:
        """Return the values of the readings, ``(m, N)``, with some of them changed, from the first on."""
        return self.xp.concat([values[:first], changed, values[first + changed.shape[0] :]])

    def change_available(self, measurement: Any, first: int, kept: Array) -> Any:
        """Return the measurement of which some readings are there only if one more number is above zero."""
        available = measurement.available
        changed = available[first : first + kept.shape[0]] * kept
        return measurement._replace(available=self.change_rows(available, first, changed))


class Fault(NamedTuple):
    """State of what goes wrong for a while, once in an episode."""

    window: Array
    """First and last step of it, ``(2, N)``; -1 where it does not happen."""
    satellites: Array
    """Places of the satellites that it concerns, ``(n, N)``; None where it concerns none."""
    own: Array
    """What else it has."""
    now: Array
    """One where it happens at this step, else zero, ``(N,)``."""


class _Once(_OfSatellites):
    """Temporary disturbance, once in an episode, with a probability."""

    title: ClassVar[str]
    """Of the parameters of its probability and duration."""

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Fault:
        """Draw whether it happens, and when: the start is a share of the time left free."""
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        happens = draws.event(self.name, getattr(p, f"{self.title}_probability"))
        start = draws.unit(f"{self.name}_start")
        seconds = draws.uniform(f"{self.name}_duration", getattr(p, f"{self.title}_duration"))
        first = 1.0 + xp.floor(start * xp.clip(p.horizon * T - seconds, 0.0, None) / T)
        window = xp.stack([first, first + xp.round(seconds / T) - 1.0])
        return Fault(xp.where(happens, window, -1.0), self.draw_satellites(draws), zero, zero)

    def draw_satellites(self, draws: Draws) -> Array:
        """Draw which satellites it concerns: here none."""
        return None

    def advance(self, state: Fault, step: DisturbanceInput) -> Fault:
        """Look whether it happens."""
        happens = (step.number >= state.window[0]) & (step.number <= state.window[1])
        return state._replace(now=self.xp.astype(happens, state.now.dtype))

    def is_at(self, state: Fault) -> Array:
        """Return whether it affects each satellite now, booleans ``(S, N)``."""
        chosen = self.places == state.satellites[0]
        for i in range(1, state.satellites.shape[0]):
            chosen = chosen | (self.places == state.satellites[i])
        return chosen & (state.now > 0.0)

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the first and last step, -1 where there is none."""
        window = state.window
        return {self.name: self.xp.where(window[1] >= window[0], window, -1.0)}


class _Hidden(_Once):
    """A disturbance that the measurement does not report."""

    def quiet(self, state: Fault, calm: Array) -> Fault:
        """Remove it."""
        return state._replace(window=self.xp.where(calm, -1.0, state.window))


class StuckAccelerometers(_Hidden):
    """The accelerometers repeat their last reading, its own state, m/s^2, ``(3, N)``."""

    name, title = "stuck", "stick"
    causes = (Cause("stuck accelerometers", "while the accelerometers are stuck", context_flag("stuck_now")),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Fault:
        """Draw it; nothing was read yet."""
        return super().begin(draws, normals, zero)._replace(own=self.xp.stack([zero] * 3))

    def change_reading(self, state: Fault, reading: Array) -> tuple[Fault, Array]:
        """Hold it. One that sticks at the first measurement has no last reading to hold."""
        rows = self.task.sensors[2].readings
        forces = self.xp.where(state.now > 0.0, state.own, reading[rows])
        return state._replace(own=forces), self.change_rows(reading, rows.start, forces)

    def advance(self, state: Fault, step: DisturbanceInput) -> Fault:
        """Look whether it happens; the first measurement is never one."""
        state = super().advance(state, step)
        return state._replace(now=self.xp.where(step.number > 1.0, state.now, 0.0))

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window, and whether it happens."""
        return {**super().context(state), "stuck_now": state.now}


class NoisyRate(_Hidden):
    """The rate of one satellite is noisier than stated, by a factor of its own, ``(N,)``."""

    name, title = "noisy", "rate_fault"
    causes = (Cause("noisy rate", "while a pseudorange rate is too noisy", _is_noisy),)

    def draw_satellites(self, draws: Draws) -> Array:
        """Draw one."""
        return draws.integer("noisy_satellite", (0, self.satellites - 1))[None]

    def complete(self, state: Fault, draws: Draws) -> Fault:
        """Draw how much noisier."""
        factor = draw_between(draws.log_uniform, "rate_fault_factor", self.parameters.rate_fault_factor)
        return state._replace(own=state.own + factor)

    def change_deviations(self, state: Fault, deviations: Array) -> Array:
        """Multiply that of its rate."""
        S = self.satellites
        factor = self.xp.where(self.is_at(state), state.own, 1.0)
        return self.change_rows(deviations, S, factor * deviations[S : 2 * S])

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window and satellite."""
        return {**super().context(state), "noisy_satellite": state.satellites[0]}


class HiddenSatellites(_Once):
    """Two satellites are gone."""

    name, title = "hidden", "satellites_outage"
    causes = (Cause("range lost", "where a pseudorange is missing", _lacks_range),)

    def draw_satellites(self, draws: Draws) -> Array:
        """Draw two."""
        S = self.satellites
        first = draws.integer("hidden_satellite", (0, S - 1))
        second = (first + 1.0 + draws.integer("other_hidden_satellite", (0, max(S - 2, 0)))) % S
        return self.xp.stack([first, second])

    def change_measurement(self, state: Fault, measurement: Any, step: DisturbanceInput) -> tuple[Fault, Any]:
        """Take their pseudoranges and rates away."""
        seen = self.xp.where(self.is_at(state), 0.0, self.xp.ones_like(state.now))
        return state, self.change_available(measurement, 0, self.xp.concat([seen, seen]))

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window and satellites."""
        return {**super().context(state), "hidden_satellites": state.satellites}


class LostRates(_Once):
    """No satellite has a rate."""

    name, title = "no_rates", "rates_outage"
    causes = (Cause("rate lost", "where a pseudorange rate is missing", _lacks_rate),)

    def change_measurement(self, state: Fault, measurement: Any, step: DisturbanceInput) -> tuple[Fault, Any]:
        """Take them away."""
        kept = self.xp.stack([1.0 - state.now] * self.satellites)
        return state, self.change_available(measurement, self.satellites, kept)


class RangeColour(ColouredErrors):
    """Errors of the pseudoranges that last: diffuse multipath, atmosphere, ephemerides."""

    def __init__(self, task: NavigationProblem) -> None:
        p = task.parameters
        super().__init__(task, p.sampling_interval, task.satellites, p.pseudorange_coloured[1] > 0.0)

    def draw(self, draws: Draws, zero: Array) -> tuple[Array, Array]:
        """Draw deviation, m, and correlation time, s, ``(N,)`` each."""
        p = self.parameters
        undisturbed(draws, p)  # comes first among the random numbers
        if not self.normals:
            return zero, zero + p.pseudorange_correlation_time[0]
        lasting = p.pseudorange_correlation_time
        return (
            zero + draw_between(draws.uniform, "pseudorange_coloured", p.pseudorange_coloured),
            zero + draw_between(draws.log_uniform, "pseudorange_correlation_time", lasting),
        )

    def change_errors(self, state: ColouredErrorsState, errors: Array) -> Array:
        """Add them."""
        return errors + state.level

    def context(self, state: ColouredErrorsState) -> dict[str, Array]:
        """Their deviation, m, and what is left of them from one measurement to the next."""
        return {"coloured_deviation": state.deviation, "coloured_decay": state.process.decay}


class Reception(NamedTuple):
    """State of :class:`Reflections`."""

    urban: Array
    """One between houses, else zero, ``(N,)``."""
    cn0: Array
    """``(S, N)``, dB-Hz."""
    multipath: Array
    """Held error of each pseudorange, ``(S, N)``, m."""
    hold: Array
    """Steps for which it still holds, ``(S, N)``."""


class Reflections(_OfSatellites):
    """Between houses C/N0 walks, and pseudoranges have the errors of reflections.

    Its numbers: S normals of the walk, S of the errors, S uniforms of how long they hold.
    """

    name = "reflections"

    def __init__(self, task: NavigationProblem) -> None:
        super().__init__(task)
        self.row_uniforms: int = self.satellites if self.parameters.urban else 0
        self.normals: int = 2 * self.row_uniforms

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Reception:
        """Draw C/N0, in open country too: every scenario takes the same numbers."""
        cn0 = draws.uniform("cn0", self.parameters.cn0_limits, self.satellites)
        none = self.xp.stack([zero] * self.satellites)
        return Reception(zero, cn0, none, none)

    def complete(self, state: Reception, draws: Draws) -> Reception:
        """Draw whether the episode is between houses."""
        urban = _draw_share(draws, "urban", self.parameters, state.urban)
        return state._replace(
            urban=urban, cn0=self.xp.where(urban < 0.5, self.parameters.clear_cn0, state.cn0)
        )

    def advance(self, state: Reception, step: DisturbanceInput) -> Reception:
        """Return the C/N0 walks between its limits; where a multipath error has run out, a new one is drawn by the
        C/N0 now.
        """
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
        """Add them."""
        return errors + state.multipath

    def change_measurement(
        self, state: Reception, measurement: Any, step: DisturbanceInput
    ) -> tuple[Reception, Any]:
        """Change the C/N0."""
        return state, measurement._replace(cn0=state.cn0)

    def context(self, state: Reception) -> dict[str, Array]:
        """Return whether the episode is between houses."""
        return {"urban": state.urban}


def _draw_share(draws: Draws, name: str, parameters: Any, zero: Array) -> Array:
    """Draw in which share of the episodes there is something, one or zero, ``(N,)``; no number where in all or none."""
    share = getattr(parameters, f"{name}_probability")
    if not getattr(parameters, name) or share == 1.0:
        return zero + float(getattr(parameters, name))
    return draws.xp.astype(draws.event(name, share), zero.dtype)


class Ramp(_Hidden):
    """One pseudorange drifts off from some time to the end; its own state, by how much, ``(2, N)``, m: the bias with
    which that begins, and now.
    """

    name = "ramp"
    causes = (Cause("wrong range", f"where a pseudorange is off by more than {PULLED:g} m", _is_pulled),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Fault:
        """Never, until it is drawn."""
        return Fault(self.xp.stack([zero - 1.0] * 2), zero[None], self.xp.stack([zero] * 2), zero)

    def complete(self, state: Fault, draws: Draws) -> Fault:
        """Draw time, satellite and bias."""
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
        """Return the drift on."""
        p, jump = self.parameters, state.own[0]
        run = jump + (p.ramp_rate * p.sampling_interval) * (step.number - state.window[0] + 1.0)
        return super().advance(state._replace(own=self.xp.stack([jump, run])), step)

    def change_errors(self, state: Fault, errors: Array) -> Array:
        """Add it."""
        if not self.parameters.ramp_probability:
            return errors
        return errors + self.xp.where(self.is_at(state), state.own[1], 0.0)

    def context(self, state: Fault) -> dict[str, Array]:
        """Return the window, satellite and the bias with which it begins."""
        own = {"ramp_satellite": state.satellites[0], "ramp_jump": state.own[0]}
        return {**super().context(state), **own}


class Aperture(_OfSatellites):
    """Tracking loops, steered by the combined prediction, lose what they do not expect; one where they do, ``(N,)``."""

    name = "aperture"

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Array:
        """Keep what :meth:`complete` takes."""
        return zero

    def complete(self, state: Array, draws: Draws) -> Array:
        """Draw whether they do."""
        return _draw_share(draws, "aperture", self.parameters, state)

    def change_measurement(self, state: Array, measurement: Any, step: DisturbanceInput) -> tuple[Array, Any]:
        """Take away what is too far from the state ``(17, N)`` that they expect."""
        feedback = step.feedback
        if feedback is None:
            return state, measurement
        sight = gnss_ins.geometry(feedback, measurement.satellite_position, measurement.satellite_velocity)
        expected = self.xp.concat(gnss_ins.ranges(feedback, sight))
        innovation = measurement.readings[self.task.tracked] - expected
        kept = (self.xp.abs(innovation) <= self.task.apertures) | (state < 0.5)
        return state, self.change_available(measurement, 0, self.xp.astype(kept, feedback.dtype))

    def context(self, state: Array) -> dict[str, Array]:
        """Return whether rates are outside the aperture."""
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
"""In the order in which they act; a further one comes last, so that episodes stay."""
DRAWN_FIRST = (NoisyRate, StuckAccelerometers, LostRates, HiddenSatellites, Ramp, Reflections, Aperture)
"""Those that are drawn with an episode before the others, in this order: episodes have taken their numbers so."""
