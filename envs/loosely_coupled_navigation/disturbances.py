"""Disturbances of the receiver of LooselyCoupledNavigation: one class each."""

import math
from typing import Any, ClassVar, NamedTuple

from ...filters.array_namespace import namespace
from ..contract.causes import MISSED, OUTLIER, Cause, Moment
from ..contract.draws import Draws, StepSignal, draw_between, is_within
from ..contract.faults import ColouredErrors, ColouredErrorsState, Disturbance, DisturbanceInput, Outliers
from ..contract.observation import Array
from ..contract.task import Task
from .parameters import LooselyCoupledNavigationParameters

NEVER = 1e9
"""Measurement number of an event that does not occur; finite, so that arithmetic on it stays finite."""
UNREPORTED = 1.2
"""Ratio of true to reported receiver noise above which the noise counts as unreported."""
AFTERMATH = 25.0
"""Number of measurements that count as after an outage: a quarter of a second."""


def _follows_outage(moment: Moment) -> Array | None:
    if not moment.has_context("outage"):
        return None
    end = moment.context["outage"][1]
    since = moment.measurement.number - end
    return (end >= 0.0) & (since >= 0.0) & (since < AFTERMATH)


def _is_unreported(moment: Moment) -> Array | None:
    if not moment.has_context("receiver_deviation"):
        return None
    return moment.context["receiver_deviation"] > UNREPORTED * moment.measurement.reported_deviation


def _within(window: str, phrase: str) -> Cause:
    def holds(moment: Moment) -> Array | None:
        return (
            is_within(moment.measurement.number, moment.context[window])
            if moment.has_context(window)
            else None
        )

    return Cause(window, phrase, holds)


def measurement_number(time: Array, parameters: LooselyCoupledNavigationParameters) -> Array:
    """Return the number of the measurement nearest to a time in s."""
    return namespace(time).round(time / parameters.sampling_interval)


class Levels(NamedTuple):
    """State of the receiver's noise: true and reported levels in each part of the episode, and now."""

    true: Array
    """Standard deviation of the receiver noise before, between and after its changes, m, ``(3, N)``."""
    reported: Array
    """Standard deviation that the receiver reports, m, ``(3, N)``."""
    change: Array
    """First measurement after each change, ``(2, N)``."""
    level: Array
    """True standard deviation at this measurement, m, ``(N,)``."""
    report: Array
    """Reported standard deviation at this measurement, m, ``(N,)``."""


class NoiseChanges(Disturbance):
    """Disturbance by receiver noise that differs between episodes and changes up to twice, reported or not."""

    name = "noise_changes"
    causes = (Cause("unreported noise", "where the receiver is noisier than it reports", _is_unreported),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Levels:
        """Draw the receiver's noise levels, the times of their changes, and which changes are reported."""
        xp, p = self.xp, self.parameters
        factor = draws.log_uniform("receiver_factor", p.receiver_factor)
        changes = draws.integer("noise_changes", p.noise_changes)
        first, second = measurement_number(draws.uniform("change_start", p.change_start, 2), p)
        factors = [factor, *draws.log_uniform("changed_receiver_factor", p.receiver_factor, 2)]
        unreported = draws.event("unreported", p.unreported, 2)
        both = changes == 2
        earlier = xp.where(changes == 0, NEVER, xp.where(both, xp.minimum(first, second), first))
        later = xp.where(both, xp.maximum(first, second), NEVER)
        levels = [xp.sqrt(p.receiver_variance * factor) for factor in factors]
        reported = levels[:1]
        for level, silent in zip(levels[1:], unreported, strict=True):
            reported.append(xp.where(silent, reported[-1], level))
        change = xp.stack([earlier, later])
        return Levels(xp.stack(levels), xp.stack(reported), change, levels[0], reported[0])

    def switch_off(self, state: Levels, undisturbed: Array) -> Levels:
        """Return the state with the true noise as reported in the episodes where ``undisturbed``."""
        return state._replace(true=self.xp.where(undisturbed, state.reported, state.true))

    def advance(self, state: Levels, step: DisturbanceInput) -> Levels:
        """Return the state with the true and reported noise levels at this measurement."""
        if not self.parameters.noise_changes[1]:
            return state
        level, report = (
            StepSignal(levels, state.change).at(step.number, self.xp)
            for levels in (state.true, state.reported)
        )
        return state._replace(level=level, report=report)

    def change_deviations(self, state: Levels, deviations: Array) -> Array:
        """Return the standard deviations times the receiver's true noise level, m."""
        return state.level * deviations

    def change_measurement(
        self, state: Levels, measurement: Any, step: DisturbanceInput
    ) -> tuple[Levels, Any]:
        """Return the state, and the measurement with the reported standard deviation filled in."""
        return state, measurement._replace(reported_deviation=state.report)

    def context(self, state: Levels) -> dict[str, Array]:
        """Return noise levels, and the measurements of their changes (-1: none), by name."""
        return {
            "receiver_levels": state.true,
            "reported_levels": state.reported,
            "change": _shown(state.change),
        }

    def records(self, state: Levels) -> dict[str, Array]:
        """Return the reported standard deviation, to record at a measurement, by name."""
        return {"reported_deviation": state.report}


def _shown(window: Array) -> Array:
    return namespace(window).where(window < NEVER, window, -1.0)


class ReceiverColour(ColouredErrors):
    """Disturbance by receiver errors that are correlated in time, independent on each axis."""

    def __init__(self, task: Task) -> None:
        p = task.parameters
        super().__init__(task, p.sampling_interval, p.axes, p.receiver_coloured[1] > 0.0)

    def draw(self, draws: Draws, zero: Array) -> tuple[Array, Array]:
        """Draw the standard deviation, m, and correlation time, s, of the receiver's coloured errors."""
        p = self.parameters
        deviation = draw_between(draws.uniform, "receiver_coloured", p.receiver_coloured)
        lasting = draw_between(draws.log_uniform, "receiver_correlation_time", p.receiver_correlation_time)
        return zero + deviation, zero + lasting

    def change_reading(self, state: ColouredErrorsState, reading: Array) -> tuple[ColouredErrorsState, Array]:
        """Return the state, and the fix with the correlated errors added."""
        return state, reading + state.level if self.normals else reading

    def context(self, state: ColouredErrorsState) -> dict[str, Array]:
        """Return the decay of the coloured errors between measurements and their driving noise, m, by name."""
        return {"receiver_decay": state.process.decay, "receiver_kick": state.process.kick}


class Spell(NamedTuple):
    """State of a receiver disturbance that occurs at most once: its window, strength, the measurement's number."""

    window: Array
    """First measurement of the disturbance and the first one after it, ``(2, N)``."""
    strength: Array
    """Strength of the disturbance, ``(N,)``; zero where it has none."""
    number: Array
    """Number of the current measurement, ``(N,)``."""


class _Once(Disturbance):
    """Receiver disturbance that occurs at most once in an episode, in a random window of measurements."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.probability, self.start, self.duration = (
            getattr(self.parameters, f"{self.name}_{each}") for each in ("probability", "start", "duration")
        )

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Spell:
        xp, p = self.xp, self.parameters
        happens = draws.event(self.name, self.probability)
        first = measurement_number(draws.uniform(f"{self.name}_start", self.start), p)
        beyond = first + measurement_number(draws.uniform(f"{self.name}_duration", self.duration), p)
        window = xp.stack([xp.where(happens, first, NEVER), xp.where(happens, beyond, NEVER)])
        return Spell(window, zero, zero)

    def advance(self, state: Spell, step: DisturbanceInput) -> Spell:
        return state._replace(number=step.number)

    def context(self, state: Spell) -> dict[str, Array]:
        return {self.name: _shown(state.window)}


class Outage(_Once):
    """Disturbance by a receiver outage, at most one in an episode: there is no fix."""

    name = "outage"
    causes: ClassVar[tuple[Cause, ...]] = (
        MISSED._replace(name="outage", phrase="in outages of the receiver"),
        Cause("after outage", f"in the {AFTERMATH:g} measurements after an outage", _follows_outage),
    )

    def change_measurement(self, state: Spell, measurement: Any, step: DisturbanceInput) -> tuple[Spell, Any]:
        """Return the state, and the measurement without a fix during the outage."""
        if not self.probability:
            return state, measurement
        out = is_within(step.number, state.window)
        available = self.xp.where(out, 0.0, measurement.available)
        return state, measurement._replace(fix=available * measurement.fix, available=available)


class _Hidden(_Once):
    """Receiver disturbance that the measurement does not report."""

    def switch_off(self, state: Spell, undisturbed: Array) -> Spell:
        return state._replace(window=self.xp.where(undisturbed, NEVER, state.window))


class Jamming(_Hidden):
    """Disturbance by jamming, at most once in an episode: the receiver's noise rises, unreported."""

    name = "jamming"
    causes: ClassVar[tuple[Cause, ...]] = (_within("jamming", "under jamming"),)

    def draw_further(self, state: Spell, draws: Draws) -> Spell:
        """Return the state with the jamming's drawn factor on the standard deviation."""
        factor = draw_between(draws.log_uniform, "jamming_factor", self.parameters.jamming_factor)
        return state._replace(strength=self.xp.sqrt(state.strength + factor))

    def change_deviations(self, state: Spell, deviations: Array) -> Array:
        """Return the standard deviations, multiplied by the factor while there is jamming."""
        if not self.probability:
            return deviations
        jammed = is_within(state.number, state.window)
        return self.xp.where(jammed, state.strength * deviations, deviations)

    def context(self, state: Spell) -> dict[str, Array]:
        """Return the window of the jamming and its factor on the standard deviation, by name."""
        return {**super().context(state), "jamming_gain": state.strength}


class Spoofing(_Hidden):
    """Disturbance by spoofing, at most once in an episode: the fix drifts off on every axis."""

    name = "spoofing"
    causes: ClassVar[tuple[Cause, ...]] = (_within("spoofing", "under spoofing"),)

    def draw_further(self, state: Spell, draws: Draws) -> Spell:
        """Return the state with the spoofing's drawn drift rate, m/s."""
        rate = draw_between(draws.uniform, "spoofing_rate", self.parameters.spoofing_rate)
        return state._replace(strength=state.strength + rate)

    def fix_error(self, state: Spell) -> Array:
        """Return the error of the spoofed fix on every axis at this measurement, m, ``(N,)``."""
        run = (state.strength * self.parameters.sampling_interval) * (state.number - state.window[0] + 1.0)
        return self.xp.where(is_within(state.number, state.window), run, 0.0)

    def change_reading(self, state: Spell, reading: Array) -> tuple[Spell, Array]:
        """Return the state, and the fix with the spoofing error added."""
        return state, reading + self.fix_error(state) if self.probability else reading

    def context(self, state: Spell) -> dict[str, Array]:
        """Return the window of the spoofing and its drift rate, m/s, by name."""
        return {**super().context(state), "spoofing_rate": state.strength}


class ReceiverOutliers(Outliers):
    """Disturbance by outliers of the receiver: single fixes with larger noise, independent of each other."""

    name = "outliers"
    causes: ClassVar[tuple[Cause, ...]] = (OUTLIER,)

    @staticmethod
    def probability_and_factor(parameters: LooselyCoupledNavigationParameters) -> tuple[float, float]:
        """Return the probability of an outlier and the factor on its standard deviation."""
        return parameters.outlier_probability, math.sqrt(parameters.outlier_factor)

    def change_deviations(self, state: Array, deviations: Array) -> Array:
        """Return the standard deviations times this measurement's factor: one, or that of an outlier."""
        return state * deviations if self.probability else deviations


DISTURBANCES: tuple[type[Disturbance], ...] = (
    ReceiverColour,
    Outage,
    Jamming,
    Spoofing,
    NoiseChanges,
    ReceiverOutliers,
)
"""Disturbances in the order in which they act. New ones are appended, so that episodes do not change."""
DRAWN_FIRST = (NoiseChanges,)
"""Disturbances that are drawn before the others, in this order, which fixes the random numbers of episodes."""
