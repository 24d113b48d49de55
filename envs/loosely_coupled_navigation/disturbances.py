"""Disturbances of the receiver of LooselyCoupledNavigation: a class for each."""

import math
from typing import Any, ClassVar, NamedTuple

from ...filters.array_namespace import namespace
from ..contract.causes import MISSED, OUTLIER, Cause, Moment
from ..contract.draws import Draws, StepSignal, draw_between, within
from ..contract.faults import ColouredErrors, ColouredErrorsState, Disturbance, DisturbanceInput, Outliers
from ..contract.observation import Array
from ..contract.task import Task
from .parameters import LooselyCoupledNavigationParameters

NEVER = 1e9
"""Number of the measurement at which happens what does not; finite, so that arithmetic on it stays finite."""
UNREPORTED = 1.2
"""Noise of the receiver over what it reports, from which it is not reported."""
AFTERMATH = 25.0
"""Measurements after an outage: a quarter of a second."""


def _follows_outage(moment: Moment) -> Array | None:
    if not moment.knows("outage"):
        return None
    end = moment.context["outage"][1]
    since = moment.measurement.number - end
    return (end >= 0.0) & (since >= 0.0) & (since < AFTERMATH)


def _is_unreported(moment: Moment) -> Array | None:
    if not moment.knows("receiver_deviation"):
        return None
    return moment.context["receiver_deviation"] > UNREPORTED * moment.measurement.reported_deviation


def _within(window: str, phrase: str) -> Cause:
    """Return the cause that holds in a window of the context."""

    def holds(moment: Moment) -> Array | None:
        return within(moment.measurement.number, moment.context[window]) if moment.knows(window) else None

    return Cause(window, phrase, holds)


def number_at(time: Array, parameters: LooselyCoupledNavigationParameters) -> Array:
    """Return the number of the measurement nearest to a time in s."""
    return namespace(time).round(time / parameters.sampling_interval)


class Levels(NamedTuple):
    """State of :class:`NoiseChanges`."""

    true: Array
    """Standard deviation of the receiver noise before, between and after its changes, m, ``(3, N)``."""
    reported: Array
    """What the receiver reports in its place, m, ``(3, N)``."""
    change: Array
    """First measurement after each change, ``(2, N)``."""
    level: Array
    """True one of this measurement, ``(N,)``."""
    report: Array
    """Report of it, ``(N,)``."""


class NoiseChanges(Disturbance):
    """The noise of the receiver is another one in each episode, and changes in it up to twice, reported or not."""

    name = "noise_changes"
    causes = (Cause("unreported noise", "where the receiver is noisier than it reports", _is_unreported),)

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Levels:
        """Draw levels, and when they change."""
        xp, p = self.xp, self.parameters
        factor = draws.log_uniform("receiver_factor", p.receiver_factor)
        changes = draws.integer("noise_changes", p.noise_changes)
        first, second = number_at(draws.uniform("change_start", p.change_start, 2), p)
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

    def quiet(self, state: Levels, calm: Array) -> Levels:
        """Return the law of the reports unchanged: the receiver reports its true noise."""
        return state._replace(true=self.xp.where(calm, state.reported, state.true))

    def advance(self, state: Levels, step: DisturbanceInput) -> Levels:
        """Take the levels of this measurement."""
        if not self.parameters.noise_changes[1]:
            return state
        level, report = (
            StepSignal(levels, state.change).at(step.number, self.xp)
            for levels in (state.true, state.reported)
        )
        return state._replace(level=level, report=report)

    def change_deviations(self, state: Levels, deviations: Array) -> Array:
        """Bring them to the level, m."""
        return state.level * deviations

    def change_measurement(
        self, state: Levels, measurement: Any, step: DisturbanceInput
    ) -> tuple[Levels, Any]:
        """Report it."""
        return state, measurement._replace(reported_deviation=state.report)

    def context(self, state: Levels) -> dict[str, Array]:
        """All levels, and the numbers of the measurements from which on they hold, -1 where there is none."""
        return {
            "receiver_levels": state.true,
            "reported_levels": state.reported,
            "change": _shown(state.change),
        }

    def records(self, state: Levels) -> dict[str, Array]:
        """Return the reports."""
        return {"reported_deviation": state.report}


def _shown(window: Array) -> Array:
    return namespace(window).where(window < NEVER, window, -1.0)


class ReceiverColour(ColouredErrors):
    """Errors of the receiver that last, on each axis its own."""

    def __init__(self, task: Task) -> None:
        p = task.parameters
        super().__init__(task, p.sampling_interval, p.axes, p.receiver_coloured[1] > 0.0)

    def draw(self, draws: Draws, zero: Array) -> tuple[Array, Array]:
        """Draw deviation, m, and correlation time, s."""
        p = self.parameters
        deviation = draw_between(draws.uniform, "receiver_coloured", p.receiver_coloured)
        lasting = draw_between(draws.log_uniform, "receiver_correlation_time", p.receiver_correlation_time)
        return zero + deviation, zero + lasting

    def change_reading(self, state: ColouredErrorsState, reading: Array) -> tuple[ColouredErrorsState, Array]:
        """Add them."""
        return state, reading + state.level if self.normals else reading

    def context(self, state: ColouredErrorsState) -> dict[str, Array]:
        """Return their decay from one measurement to the next, and the standard deviation of their gain, m."""
        return {"receiver_decay": state.process.decay, "receiver_kick": state.process.kick}


class Spell(NamedTuple):
    """State of what befalls the receiver once in an episode."""

    window: Array
    """First measurement of it and first one after it, ``(2, N)``."""
    strength: Array
    """Of it, ``(N,)``; zero where it has none."""
    number: Array
    """Of this measurement, ``(N,)``."""


class _Once(Disturbance):
    """Disturbance of the receiver once in an episode, with its probability, limits of its start and of its duration."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.probability, self.start, self.duration = (
            getattr(self.parameters, f"{self.name}_{each}") for each in ("probability", "start", "duration")
        )

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Spell:
        """Draw whether it happens, and when."""
        xp, p = self.xp, self.parameters
        happens = draws.event(self.name, self.probability)
        first = number_at(draws.uniform(f"{self.name}_start", self.start), p)
        beyond = first + number_at(draws.uniform(f"{self.name}_duration", self.duration), p)
        window = xp.stack([xp.where(happens, first, NEVER), xp.where(happens, beyond, NEVER)])
        return Spell(window, zero, zero)

    def advance(self, state: Spell, step: DisturbanceInput) -> Spell:
        """Count."""
        return state._replace(number=step.number)

    def context(self, state: Spell) -> dict[str, Array]:
        """Return the window, -1 where there is none."""
        return {self.name: _shown(state.window)}


class Outage(_Once):
    """The receiver has no fix."""

    name = "outage"
    causes: ClassVar[tuple[Cause, ...]] = (
        MISSED._replace(name="outage", phrase="in outages of the receiver"),
        Cause("after outage", f"in the {AFTERMATH:g} measurements after an outage", _follows_outage),
    )

    def change_measurement(self, state: Spell, measurement: Any, step: DisturbanceInput) -> tuple[Spell, Any]:
        """Take the fix away."""
        if not self.probability:
            return state, measurement
        out = within(step.number, state.window)
        available = self.xp.where(out, 0.0, measurement.available)
        return state, measurement._replace(fix=available * measurement.fix, available=available)


class _Hidden(_Once):
    """A disturbance that the measurement does not report."""

    def quiet(self, state: Spell, calm: Array) -> Spell:
        """Remove it."""
        return state._replace(window=self.xp.where(calm, NEVER, state.window))


class Jamming(_Hidden):
    """The noise of the receiver rises, without a report. Its strength is the standard deviation over that without."""

    name = "jamming"
    causes: ClassVar[tuple[Cause, ...]] = (_within("jamming", "under jamming"),)

    def complete(self, state: Spell, draws: Draws) -> Spell:
        """Draw how much."""
        factor = draw_between(draws.log_uniform, "jamming_factor", self.parameters.jamming_factor)
        return state._replace(strength=self.xp.sqrt(state.strength + factor))

    def change_deviations(self, state: Spell, deviations: Array) -> Array:
        """Raise them."""
        if not self.probability:
            return deviations
        jammed = within(state.number, state.window)
        return self.xp.where(jammed, state.strength * deviations, deviations)

    def context(self, state: Spell) -> dict[str, Array]:
        """Return the window and strength."""
        return {**super().context(state), "jamming_gain": state.strength}


class Spoofing(_Hidden):
    """Every axis is pulled off; its strength is the rate, m/s."""

    name = "spoofing"
    causes: ClassVar[tuple[Cause, ...]] = (_within("spoofing", "under spoofing"),)

    def complete(self, state: Spell, draws: Draws) -> Spell:
        """Draw how fast."""
        rate = draw_between(draws.uniform, "spoofing_rate", self.parameters.spoofing_rate)
        return state._replace(strength=state.strength + rate)

    def pull(self, state: Spell) -> Array:
        """Return the error of every axis at this measurement, m, ``(N,)``."""
        run = (state.strength * self.parameters.sampling_interval) * (state.number - state.window[0] + 1.0)
        return self.xp.where(within(state.number, state.window), run, 0.0)

    def change_reading(self, state: Spell, reading: Array) -> tuple[Spell, Array]:
        """Pull it off."""
        return state, reading + self.pull(state) if self.probability else reading

    def context(self, state: Spell) -> dict[str, Array]:
        """Return the window and rate."""
        return {**super().context(state), "spoofing_rate": state.strength}


class ReceiverOutliers(Outliers):
    """Fixes that are noisier than the others, each one on its own."""

    name = "outliers"
    causes: ClassVar[tuple[Cause, ...]] = (OUTLIER,)

    @staticmethod
    def limits(parameters: LooselyCoupledNavigationParameters) -> tuple[float, float]:
        """Return the limits of the parameters, of an intensity."""
        return parameters.outlier_probability, math.sqrt(parameters.outlier_factor)

    def change_deviations(self, state: Array, deviations: Array) -> Array:
        """Enlarge them."""
        return state * deviations if self.probability else deviations


DISTURBANCES: tuple[type[Disturbance], ...] = (
    ReceiverColour,
    Outage,
    Jamming,
    Spoofing,
    NoiseChanges,
    ReceiverOutliers,
)
"""In the order in which they act; a further one comes last, so that episodes stay."""
DRAWN_FIRST = (NoiseChanges,)
"""Those that are drawn with an episode before the others, in this order: episodes have taken their numbers so."""
