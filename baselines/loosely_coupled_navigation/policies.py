"""Policies, the reference estimator and the bound of LooselyCoupledNavigation.

Equation numbers are those of the task's paper (Benkafo, Lobaty).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy
import xarray

from ...envs.catalogue import task_class
from ...envs.controls import signed_exponential
from ...envs.loosely_coupled_navigation.task import (
    LooselyCoupledNavigation,
    LooselyCoupledNavigationState,
    within,
)
from ...envs.task import Array
from ...evaluation.bootstrap import Bootstrap
from ...evaluation.competitors import ConstantPolicy, Policy, RandomPolicy
from ...evaluation.metrics import Measure, mean_of_present
from ...filters import loosely_coupled as ins_gnss
from ..table import Baselines, Tunable

# --- the plain scheme with a constant gain


class FixedGain(ConstantPolicy):
    """The plain scheme (3) with one gain for every sample."""

    control = "gain"

    def __init__(self, task: LooselyCoupledNavigation, gain: float) -> None:
        super().__init__(task)
        self.action = (task.action_of_gain(gain),) * task.parameters.axes


class InsOnly(FixedGain):
    """The INS alone: no measurement is used."""

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        super().__init__(task, 0.0)


class GnssOnly(FixedGain):
    """The receiver alone: the estimate is the measurement, and the INS increment where there is none."""

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        super().__init__(task, 1.0)


class PlainWhite(FixedGain):
    """Settled gain for the white part of the INS noise only, ``Ge = G``."""

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        super().__init__(task, task.settled_gains[0])


class PlainReduced(ConstantPolicy):
    """The paper's scheme: settled gain with the coloured part reduced to white noise."""

    control = "gain"

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        super().__init__(task)
        self.action = task.paper_policy.action


class BestConstant(FixedGain):
    """The constant gain of least mean square error under the modelled noise levels, exact."""

    def __init__(self, task: LooselyCoupledNavigation, gain: float | None = None) -> None:
        if gain is None:
            p = task.parameters
            levels = (p.drift, p.coloured, p.correlation_time, p.white_intensity, p.receiver_intensity)
            K = ins_gnss.best_constant_gain(*levels)
            gain = float(ins_gnss.settled_gain(K * K * p.receiver_intensity * p.step, p.receiver_variance))
        super().__init__(task, gain)


# --- the plain scheme with a gain that varies


class _Variances(NamedTuple):
    """Memory of the gain schedules."""

    P: numpy.ndarray
    """Variance of the estimate after the last sample, ``(N, axes)``, m^2."""
    squares: numpy.ndarray
    """Average square of the innovation, ``(N, axes)``, m^2."""
    weight: numpy.ndarray
    """Measurements that this average has seen, ``(N,)``."""


class TimeVarying(Policy):
    """The plain scheme with the Riccati gain (5): high at the start of an error, settled later.

    The variance follows from the equivalent intensity ``Ge``, from the noise that the receiver reports and
    from the gaps in the data; innovations do not matter. Without gaps and changes only time does.
    """

    control = "gain"

    def __init__(self, task: LooselyCoupledNavigation, intensity: float | None = None) -> None:
        super().__init__(task)
        p = task.parameters
        self.loose = task
        self.growth = (p.equivalent_intensities[1] if intensity is None else intensity) * p.step
        self.available = task.columns(["available"])[0]
        self.reported = task.columns(["reported_noise"])[0]
        suffixes = ("",) if p.axes == 1 else tuple(f"_{c.name[-1]}" for c in task.components)
        self.innovation = task.columns([f"innovation_over_reported{s}" for s in suffixes])

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Set the gain ``P / (P + R)``."""
        axes = self.loose.parameters.axes
        zero = numpy.zeros((len(observation), axes))
        if state is None:
            state = _Variances(zero, zero, zero[:, 0])
        fresh = start[:, None]
        memory = _Variances(
            numpy.where(fresh, 0.0, state.P),
            numpy.where(fresh, 0.0, state.squares),
            numpy.where(start, 0.0, state.weight),
        )
        reported = self.loose.parameters.receiver_variance * numpy.exp(2.0 * observation[:, self.reported])
        available = observation[:, self.available] > 0.5
        P = memory.P + self.growth
        memory, R = self.noise(memory, P, reported[:, None], available, observation)
        gain = numpy.where(available[:, None], P / (P + R), 0.0)
        return self.loose.actions_of_gains(gain), memory._replace(P=(1.0 - gain) * P)

    def noise(
        self,
        memory: _Variances,
        P: numpy.ndarray,
        reported: numpy.ndarray,
        available: numpy.ndarray,
        observation: numpy.ndarray,
    ) -> tuple[_Variances, numpy.ndarray]:
        """Memory and variance of the measurement noise, ``(N, axes)`` or ``(N, 1)``: here as reported."""
        return memory, reported


class TimeVaryingWhite(TimeVarying):
    """The same for the white part of the INS noise only, ``Ge = G``."""

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        super().__init__(task, task.parameters.equivalent_intensities[0])


class InnovationAdaptive(TimeVarying):
    """The Riccati gain with the receiver noise taken from the innovations instead of the report.

    An innovation has the variance ``P + R``; so R is the average square over a window, less P. The window
    begins with the reported noise as its first values.
    """

    def __init__(
        self, task: LooselyCoupledNavigation, intensity: float | None = None, window: float = 0.25
    ) -> None:
        super().__init__(task, intensity)
        self.rate = -math.expm1(-task.parameters.step / window)

    def noise(
        self,
        memory: _Variances,
        P: numpy.ndarray,
        reported: numpy.ndarray,
        available: numpy.ndarray,
        observation: numpy.ndarray,
    ) -> tuple[_Variances, numpy.ndarray]:
        """Average the squared innovations; R is at least a tenth of what that average leaves of it."""
        first = (memory.weight == 0)[:, None]
        before = numpy.where(first, P + reported, memory.squares)
        innovation = signed_exponential(observation[:, self.innovation], numpy) * numpy.sqrt(reported)
        squares = before + numpy.where(available[:, None], self.rate, 0.0) * (innovation**2 - before)
        R = numpy.maximum(squares - P, 0.1 * squares)
        return memory._replace(squares=squares, weight=memory.weight + 1.0), R


class _Offset(NamedTuple):
    """Memory of :class:`AugmentedGain`."""

    offset: numpy.ndarray
    """Estimate of the augmented filter less the steered one, ``(axes, N)``, m."""
    drift: numpy.ndarray
    """Estimate of beta, ``(axes, N)``, m/s."""
    coloured: numpy.ndarray
    """Estimate of eta, ``(axes, N)``, m/s."""
    covariance: ins_gnss.AugmentedCovariance
    """``(N,)`` each."""


class AugmentedGain(TimeVarying):
    """An augmented filter inside the policy, which steers the plain scheme towards its own estimate.

    The correction of a sample is gain times innovation, and the agent sees the innovation before it chooses:
    with ``gain = wanted correction / innovation``, where that lies in [0, 1], the estimate goes where it is
    wanted; otherwise it waits for an innovation of the other sign, which comes after two samples on average.
    So one gain can do more than weigh two sensors, at the price of a covariance that knows nothing of it.
    """

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Run the augmented filter and choose the gain that brings the estimate nearest to its own."""
        task, p = self.loose, self.loose.parameters
        s = task.sampling
        none = numpy.zeros((p.axes, len(observation)))
        zero = none[0]
        first = ins_gnss.AugmentedCovariance(zero, zero, zero, zero + p.drift**2, zero, zero + p.coloured**2)
        memory = _Offset(none, none, none, first)
        if state is not None:
            covariance = ins_gnss.AugmentedCovariance(
                *(numpy.where(start, a, b) for a, b in zip(first, state.covariance, strict=True))
            )
            offset, drift, coloured = (numpy.where(start, 0.0, row) for row in state[:3])
            memory = _Offset(offset, drift, coloured, covariance)
        R = p.receiver_variance * numpy.exp(2.0 * observation[:, self.reported])
        available = numpy.where(observation[:, self.available] > 0.5, 1.0, 0.0)
        innovation = signed_exponential(observation[:, self.innovation].T, numpy) * numpy.sqrt(R)

        offset = memory.offset - (s.step * memory.drift + s.drive * memory.coloured)
        P = ins_gnss.predict_augmented(memory.covariance, s, *task.modelled_growth)
        K, P = ins_gnss.update_augmented(P, R, available)
        own = available * (innovation - offset)
        wanted = offset + K.position * own
        usable = (available > 0.0) & (innovation != 0.0)
        gain = numpy.where(usable, wanted / numpy.where(usable, innovation, 1.0), 0.0)
        gain = numpy.clip(gain, 0.0, 1.0)
        gain = numpy.where(gain <= p.smallest_gain, 0.0, gain)
        after = _Offset(
            wanted - gain * innovation,
            memory.drift - K.drift * own,
            s.decay * memory.coloured - K.coloured * own,
            P,
        )
        return task.actions_of_gains(gain.T), after


# --- the bank


class Augmented(Policy):
    """Believe the augmented error-state filter, which also estimates the constant and coloured rate errors."""

    control = "mode"

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Name the third filter of the bank."""
        return numpy.full(len(observation), 2), None


# --- reference and bound


class ErrorState(NamedTuple):
    """Memory of the filter that is told the true noise levels."""

    error: tuple[Array, Array, Array]
    """Estimates of delta (m), beta and eta (m/s), ``(axes, N)`` each."""
    covariance: ins_gnss.AugmentedCovariance
    """``(N,)`` each, the same for every axis."""


class Step(NamedTuple):
    """One measurement of that filter."""

    memory: ErrorState
    gain: Array
    """Of the position, ``(N,)``."""
    normalised: Array
    """Innovation over its standard deviation, ``(axes, N)``."""


class Matched:
    """The augmented filter told the true noise levels, sample by sample, and which samples are spoofed.

    The noise of every episode is Gaussian once its levels are known, so this is the filter of least mean
    square error. Spoofed measurements it leaves out, like those of an outage.
    """

    kind = "reference"
    knows = (
        "the true intensities of all noises, every change of the receiver's, and which samples are spoofed"
    )

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        self.task = task

    def start(self, state: LooselyCoupledNavigationState) -> ErrorState:
        """Start where INS and reference agree, with the true prior of the rate errors."""
        zero = 0.0 * state.clock
        coloured = state.coloured_step / self.task.sampling.coloured
        P = ins_gnss.AugmentedCovariance(
            zero, zero, zero, state.drift_deviation**2 + zero, zero, coloured * coloured
        )
        still = 0.0 * state.reference
        return ErrorState((still, still, still), P)

    def step(self, state: LooselyCoupledNavigationState, memory: ErrorState) -> Step:
        """Predict with the true noise levels and update with the true variance of the measurement."""
        xp, s = self.task.xp, self.task.sampling
        delta, beta, eta = memory.error
        delta, eta = delta + s.step * beta + s.drive * eta, s.decay * eta
        P = ins_gnss.predict_augmented(memory.covariance, s, state.coloured_step**2, state.white_step**2)
        used = xp.where(within(state.clock, state.spoofing), 0.0, state.available)
        R = state.deviation**2
        innovation = used * ((state.ins - state.measurement) - delta)
        normalised = innovation / xp.sqrt(P.position + R)
        # No innovation where no measurement is used, so no NIS either.
        normalised = xp.where(used > 0.0, normalised, math.nan)
        gain, P = ins_gnss.update_augmented(P, R, used)
        error = (
            delta + gain.position * innovation,
            beta + gain.drift * innovation,
            eta + gain.coloured * innovation,
        )
        return Step(ErrorState(error, P), gain.position, normalised)

    def update(
        self, state: LooselyCoupledNavigationState, memory: ErrorState
    ) -> tuple[LooselyCoupledNavigationState, ErrorState]:
        """Report the INS less its estimated error."""
        result = self.step(state, memory)
        estimate = state.ins - result.memory.error[0]
        variance = result.memory.covariance.position
        return (
            state._replace(
                position=estimate[None],
                variance=(variance + 0.0 * estimate)[None],
                normalised=result.normalised[None],
                estimate=estimate,
                estimate_covariance=self.task.diagonal(variance + 0.0 * estimate),
                gain=result.gain + 0.0 * estimate,
            ),
            result.memory,
        )


class MatchedCovariance(Matched):
    """The variance of ``matched``: least mean square error of an estimator with the data it uses."""

    kind = "bound"

    def update(  # a bound gives mean squares in place of a state
        self, state: LooselyCoupledNavigationState, memory: ErrorState
    ) -> tuple[Array, ErrorState]:
        """Variance of every axis, ``(axes, N)``."""
        memory = self.step(state, memory).memory
        return memory.covariance.position + 0.0 * state.reference, memory


# --- metrics of one's own

RECOVERED = 0.25
"""Error over the nominal standard deviation of a measurement, for each axis, below which a run has recovered."""
HELD = 0.1
"""Time for which it must stay below, s: shorter than the memory of any sensible gain, long for noise."""
LONGEST = 1.0
"""Time after the outage that is looked at, s; a run that has not recovered by then counts with it."""


def recovery_times(
    error: numpy.ndarray, available: numpy.ndarray, limit: float, held: int, longest: int
) -> numpy.ndarray:
    """Samples from the end of an outage until the error stays small, for each episode.

    Args:
        error: size of the error, ``(episodes, time)``.
        available: one where there is a measurement, same shape.
        limit: what counts as small.
        held: samples for which it must stay small.
        longest: samples looked at; the answer for a run that does not recover in them.

    Returns:
        ``(episodes,)``; zero where the error was small from the first measurement after the outage on; NaN
        for episodes without an outage, or with less than ``longest + held`` samples after it.
    """
    episodes, steps = error.shape
    ends = (available[:, :-1] < 0.5) & (available[:, 1:] > 0.5)
    first = numpy.where(ends.any(axis=1), ends.argmax(axis=1) + 1, steps)
    counted = first + longest + held <= steps
    window = numpy.arange(longest + held)
    index = numpy.minimum(first[:, None] + window, steps - 1)
    small = numpy.take_along_axis(error, index, axis=1) < limit
    runs = numpy.cumsum(numpy.concatenate([numpy.zeros((episodes, 1), int), small], axis=1), axis=1)
    held_from = runs[:, held:] - runs[:, :-held] == held
    found = held_from[:, :longest]
    time = numpy.where(found.any(axis=1), found.argmax(axis=1), longest)
    return numpy.where(counted, time.astype(float), math.nan)


def outage_metrics(run: xarray.Dataset, bootstrap: Bootstrap) -> list[Measure]:
    """``recovery_time`` after an outage and the share of runs that do not recover within a second."""
    if "available" not in run or numpy.isnan(run["available"].values).all():
        return []
    cls = task_class(run.attrs["environment"])
    scenario = cls.scenarios.get(run.attrs["scenario"])
    parameters = cls.Parameters(**{**(scenario.parameters if scenario else {}), **run.attrs["keywords"]})
    size = numpy.sqrt((run["error"].values ** 2).sum(axis=-1))
    limit = RECOVERED * math.sqrt(parameters.receiver_variance * parameters.axes)
    held, longest = (max(round(t / parameters.step), 1) for t in (HELD, LONGEST))
    times = recovery_times(size, run["available"].values, limit, held, longest)
    if numpy.isnan(times).all():
        return []
    lost = numpy.where(numpy.isnan(times), math.nan, times == longest)
    return [
        Measure(
            "recovery_time",
            "position",
            "all",
            mean_of_present(times[:, None] * parameters.step, bootstrap),
            "s",
        ),
        Measure("not_recovered", "position", "all", mean_of_present(lost[:, None], bootstrap), "1"),
    ]


# --- what can be tuned


def _intensity_tuned(
    make: Callable[[Any, float, Mapping[str, float]], Policy],
) -> Callable[[Mapping[str, float]], tuple[dict[str, Any], Callable[[Any], Policy]]]:
    def apply(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
        return {}, lambda task: make(task, 10.0 ** values["log10_intensity"], values)

    return apply


_INTENSITY_LIMITS = (-2.0, 1.0)
_INTENSITY_START = math.log10(0.36)

TUNABLE = {
    "best-constant": Tunable(
        "gain",
        {"log10_gain": (-3.0, -0.5)},
        {"log10_gain": math.log10(0.0462)},
        lambda values: ({}, lambda task: BestConstant(task, 10.0 ** values["log10_gain"])),
    ),
    "time-varying": Tunable(
        "gain",
        {"log10_intensity": _INTENSITY_LIMITS},
        {"log10_intensity": _INTENSITY_START},
        _intensity_tuned(lambda task, intensity, _: TimeVarying(task, intensity)),
    ),
    "innovation-adaptive": Tunable(
        "gain",
        {"log10_intensity": _INTENSITY_LIMITS, "window": (0.05, 2.0)},
        {"log10_intensity": _INTENSITY_START, "window": 0.25},
        _intensity_tuned(lambda task, intensity, v: InnovationAdaptive(task, intensity, v["window"])),
    ),
}

BASELINES = Baselines(
    environment="filtergym/LooselyCoupledNavigation-v0",
    policies={
        "plain-reduced": PlainReduced,
        "plain-white": PlainWhite,
        "best-constant": BestConstant,
        "time-varying": TimeVarying,
        "time-varying-white": TimeVaryingWhite,
        "innovation-adaptive": InnovationAdaptive,
        "augmented-gain": AugmentedGain,
        "augmented": Augmented,
        "ins-only": InsOnly,
        "gnss-only": GnssOnly,
        "random": RandomPolicy,
    },
    references={"matched": Matched},
    bounds={"matched-covariance": MatchedCovariance},
    score_paper="plain-reduced",
    score_bound="matched",
    tunable=TUNABLE,
    best_constant="best-constant",
    compared=("augmented",),
    benchmark=(
        "plain-reduced",
        "plain-white",
        "best-constant",
        "time-varying",
        "innovation-adaptive",
        "augmented-gain",
        "augmented",
        "ins-only",
        "gnss-only",
        "random",
        "matched",
        "matched-covariance",
    ),
    metrics=outage_metrics,
)
"""What the environment is compared with."""
