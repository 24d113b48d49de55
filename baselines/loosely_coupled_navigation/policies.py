"""Policies of LooselyCoupledNavigation, and the table of all it is compared with.

Equation numbers are those of the task's paper (Benkafo, Lobaty).
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ...envs.catalogue import task_class
from ...envs.loosely_coupled_navigation.banks import SCHEMES, GainBank
from ...envs.model import Model
from ...evaluation.bootstrap import Bootstrap, ratio
from ...evaluation.competitors import ConstantPolicy, Policy, RandomPolicy
from ...evaluation.dataset import keywords_of
from ...evaluation.metrics import Measure, sums_of_present
from ...evaluation.own_metrics import MetricInputs, OwnMetrics
from ...filters import loosely_coupled as ins_gnss
from ...filters.array_namespace import select_nested
from ..measurement_noise import MeasurementNoise
from ..table import Baselines, ConstantMode, PaperAction, Variant, tunable
from .alarm import FusionAlarm
from .augmented import AugmentedFilter, AugmentedMemory, with_rules
from .estimators import AugmentedEstimator
from .fault_bank import TRAINING, VAGUE, FaultBank
from .references import Matched, MatchedCovariance

if TYPE_CHECKING:
    import xarray


def gain_bank(model: Model) -> GainBank:
    """Bank of a task under control ``gain``."""
    assert isinstance(model.filter, GainBank)
    return model.filter


# --- the plain scheme with a constant gain


class FixedGain(ConstantPolicy):
    """The plain scheme (3) with one gain for every sample.

    Raises:
        ValueError: for a gain outside [0, 1].
    """

    control = "gain"

    def __init__(self, model: Model, gain: float) -> None:
        super().__init__(model)
        if not 0.0 <= gain <= 1.0:
            raise ValueError(f"gain must lie in [0, 1], got {gain!r}")
        self.action = (float(gain_bank(model).action_for_gain(gain)),) * self.task.parameters.axes


class PlainReduced(PaperAction):
    """The paper's scheme: settled gain with the coloured part reduced to white noise."""

    control = "gain"


class PlainWhite(FixedGain):
    """Settled gain for the white part of the INS noise only, ``Ge = G``."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, model.task.parameters.steady_state_gains[0])


class BestConstant(FixedGain):
    """The constant gain of least mean square error under the modelled noise levels, exact."""

    def __init__(self, model: Model, gain: float | None = None) -> None:
        if gain is None:
            p = model.task.parameters
            levels = (p.drift, p.coloured, p.correlation_time, p.white_intensity, p.receiver_intensity)
            K = ins_gnss.best_constant_gain(*levels)
            growth = K * K * p.receiver_intensity * p.sampling_interval
            gain = float(ins_gnss.steady_state_gain(growth, p.receiver_variance))
        super().__init__(model, gain)


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
    traceable = True

    def __init__(self, model: Model, intensity: float | None = None) -> None:
        super().__init__(model)
        p = self.task.parameters
        self.loose = self.task
        self.growth = (p.equivalent_intensities[1] if intensity is None else intensity) * p.sampling_interval
        self.available = model.reader("available")
        self.reported_variance = model.reader("reported_variance")
        self.innovation = model.reader("innovation_in_metres")

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
        available = self.available(observation) > 0.5
        P = memory.P + self.growth
        memory, R = self.noise(memory, P, self.reported_variance(observation), available, observation)
        gain = numpy.where(available, P / (P + R), 0.0)
        return gain_bank(self.model).action_for_gain(gain), memory._replace(P=(1.0 - gain) * P)

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

    def __init__(self, model: Model) -> None:
        super().__init__(model, model.task.parameters.equivalent_intensities[0])


class InnovationAdaptive(TimeVarying):
    """The Riccati gain with the receiver noise taken from the innovations instead of the report.

    An innovation has the variance ``P + R``; so R is the average square over a window, less P. The window
    begins with the reported noise as its first values.
    """

    def __init__(self, model: Model, intensity: float | None = None, window: float = 0.25) -> None:
        super().__init__(model, intensity)
        self.rate = -math.expm1(-self.task.parameters.sampling_interval / window)

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
        innovation = self.innovation(observation)
        squares = before + numpy.where(available, self.rate, 0.0) * (innovation**2 - before)
        R = numpy.maximum(squares - P, 0.1 * squares)
        return memory._replace(squares=squares, weight=memory.weight + 1.0), R


class _Offset(NamedTuple):
    """Memory of :class:`AugmentedGain`."""

    offset: numpy.ndarray
    """Estimate of the augmented filter less the steered one, ``(axes, N)``, m."""
    rates: AugmentedMemory


class AugmentedGain(TimeVarying):
    """An augmented filter inside the policy, which steers the plain scheme towards its own estimate.

    The correction of a sample is gain times innovation, and the agent sees the innovation before it chooses:
    with ``gain = wanted correction / innovation``, where that lies in [0, 1], the estimate goes where it is
    wanted; otherwise it waits for an innovation of the other sign, which comes after two samples on average.
    So one gain can do more than weigh two sensors, at the price of a covariance that knows nothing of it.
    """

    traceable = True

    def __init__(
        self, model: Model, rule: type[MeasurementNoise] = MeasurementNoise, **values: float
    ) -> None:
        super().__init__(model)
        self.filter = AugmentedFilter(self.task.parameters, rule(**values))

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Run the augmented filter and choose the gain that brings the estimate nearest to its own."""
        p = self.loose.parameters
        none = numpy.zeros((p.axes, len(observation)))
        memory = _Offset(none, self.filter.start(none))
        if state is not None:
            memory = select_nested(start, memory, state)
        reported = self.reported_variance(observation)[:, 0]
        available = numpy.where(self.available(observation)[:, 0] > 0.5, 1.0, 0.0)
        innovation = self.innovation(observation).T

        displacement, rates = self.filter.predict(memory.rates)
        offset = memory.offset - displacement
        own = available * (innovation - offset)
        correction, rates = self.filter.update(rates, own, reported, available)
        wanted = offset + correction
        usable = (available > 0.0) & (innovation != 0.0)
        gain = numpy.where(usable, wanted / numpy.where(usable, innovation, 1.0), 0.0)
        gain = numpy.clip(gain, 0.0, 1.0)
        gain = numpy.where(gain <= p.smallest_gain, 0.0, gain)
        return gain_bank(self.model).action_for_gain(gain.T), _Offset(wanted - gain * innovation, rates)


# --- metrics of one's own

RECOVERY_ERROR = 0.25
"""Error over the nominal standard deviation of a measurement, for each axis, below which a run has recovered."""
HOLD_TIME = 0.1
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


def _recoveries(run: "xarray.Dataset") -> MetricInputs:
    """Seconds to recover of each episode, and whether it does not within a second; NaN without an outage."""
    if "available" not in run or numpy.isnan(run["available"].values).all():
        return MetricInputs()
    cls = task_class(run.attrs["environment"])
    scenario = cls.scenarios.get(run.attrs["scenario"])
    parameters = cls.Parameters(**{**(scenario.parameters if scenario else {}), **keywords_of(run)})
    size = numpy.sqrt((run["error"].values ** 2).sum(axis=-1))
    limit = RECOVERY_ERROR * math.sqrt(parameters.receiver_variance * parameters.axes)
    held, longest = (max(round(t / parameters.sampling_interval), 1) for t in (HOLD_TIME, LONGEST))
    times = recovery_times(size, run["available"].values, limit, held, longest)
    lost = numpy.where(numpy.isnan(times), math.nan, times == longest)
    found = {"time": times * parameters.sampling_interval, "lost": lost}
    return MetricInputs({}, {name: sums_of_present(values[:, None]) for name, values in found.items()})


def _outage_measures(
    gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset"
) -> list[Measure]:
    """``recovery_time`` after an outage and the share of runs that do not recover within a second."""
    means = gathered.averaged
    if not means or not means["time"][0, 1]:
        return []
    time, lost = (bootstrap.interval(ratio(means[name])) for name in ("time", "lost"))
    return [
        Measure("recovery_time", "position", "all", time, "s"),
        Measure("not_recovered", "position", "all", lost, "1"),
    ]


# --- what can be tuned


POLICIES_BY_RULE, TUNABLE_POLICIES = with_rules(
    AugmentedGain, "augmented-gain", "`augmented-gain` with the receiver's noise"
)
ESTIMATORS, TUNABLE_ESTIMATORS = with_rules(
    AugmentedEstimator, "augmented", "The augmented filter, receiver noise"
)
ESTIMATORS |= {
    "fault-bank": Variant(
        FaultBank,
        "Kalman filters over how good the INS is and since when the receiver is pulled off, each with a Gaussian sum "
        "over the receiver's noise, by the prior of the training distribution.",
        prior=TRAINING,
    ),
    "fault-bank-vague": Variant(
        FaultBank,
        "`fault-bank` by a prior that is wider than every scenario and expects outliers.",
        prior=VAGUE,
    ),
}
_RATES = {
    "log10_onset_rate": (-3.0, -1.155, 0.0),
    "log10_level_rate": (-2.0, -0.5229, 1.0),
}
TUNABLE_BANKS = {
    "fault-bank": tunable(ESTIMATORS["fault-bank"], **_RATES, rate=(0.5, 1.732, 4.0)),
    "fault-bank-vague": tunable(ESTIMATORS["fault-bank-vague"], **_RATES, longest=(1.0, 3.0, 5.0)),
}
"""Each candidate runs alone: values decide how many measurements a hypothesis lasts."""
_INTENSITY = (-2.0, math.log10(0.36), 1.0)

TUNABLE = {
    "best-constant": tunable(BestConstant, log10_gain=(-3.0, math.log10(0.0462), -0.5)),
    "time-varying": tunable(TimeVarying, log10_intensity=_INTENSITY),
    "innovation-adaptive": tunable(InnovationAdaptive, log10_intensity=_INTENSITY, window=(0.05, 0.25, 2.0)),
    **TUNABLE_POLICIES,
    **TUNABLE_ESTIMATORS,
    **{name: replace(bank, in_lanes=False) for name, bank in TUNABLE_BANKS.items()},
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
        **POLICIES_BY_RULE,
        "augmented": Variant(
            ConstantMode,
            "Believe the augmented error-state filter, which also estimates the constant and coloured rate errors.",
            mode=SCHEMES.index("augmented"),
        ),
        "ins-only": Variant(FixedGain, "The INS alone: no measurement is used.", gain=0.0),
        "gnss-only": Variant(
            FixedGain,
            "The receiver alone: the estimate is the measurement, and the INS increment where there is none.",
            gain=1.0,
        ),
        "random": RandomPolicy,
    },
    estimators=ESTIMATORS,
    references={"matched": Matched},
    bounds={"matched-covariance": MatchedCovariance},
    score_paper="plain-reduced",
    score_reference="matched",
    tunable=TUNABLE,
    alarm=FusionAlarm,
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
        "augmented-sage-husa",
        "fault-bank",
        "fault-bank-vague",
        "ins-only",
        "gnss-only",
        "random",
        "matched",
        "matched-covariance",
    ),
    metrics=OwnMetrics(_recoveries, _outage_measures),
)
"""What the environment is compared with."""
