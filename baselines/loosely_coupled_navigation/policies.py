"""Policies of LooselyCoupledNavigation, and the table of its baselines.

Equation numbers are those of the task's paper (Benkafo, Lobaty).
"""

import math
from typing import Any, ClassVar, NamedTuple

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ...envs.loosely_coupled_navigation.banks import SCHEMES, GainBank
from ...envs.loosely_coupled_navigation.fault_bank import FaultBank
from ...envs.loosely_coupled_navigation.fault_prior import FEW, TRAINING, VAGUE
from ...evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy
from ...filters import loosely_coupled as ins_gnss
from ...filters.array_namespace import select_nested
from ..measurement_noise import MeasurementNoise
from ..table import Baselines, ConstantMode, PaperAction, Variant, tunable
from .alarm import FusionAlarm
from .augmented import AugmentedFilter, AugmentedMemory, with_rules
from .estimators import AugmentedEstimator
from .metrics import METRICS
from .references import Matched, MatchedCovariance


def gain_bank(model: Model) -> GainBank:
    """Return the model's bank with its type; the model's control must be ``gain``."""
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
        self.action = (gain_bank(model).action_for_gain(gain).item(),) * self.task.parameters.axes


class PlainReduced(PaperAction):
    """The paper's scheme: settled gain with the coloured part reduced to white noise."""

    control = "gain"


class PlainWhite(FixedGain):
    """Settled gain for the white part of the INS noise only, ``Ge = G``."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, model.task.parameters.steady_state_gains[0])


class BestConstant(FixedGain):
    """The constant gain of least mean square error under the modelled noise levels, exact."""

    def __init__(self, model: Model) -> None:
        p = model.task.parameters
        levels = (p.drift, p.coloured, p.correlation_time, p.white_intensity, p.receiver_intensity)
        K = ins_gnss.best_constant_gain(*levels)
        growth = K * K * p.receiver_intensity * p.sampling_interval
        super().__init__(model, float(ins_gnss.steady_state_gain(growth, p.receiver_variance)))


# --- the plain scheme with a gain that varies


class _Variances(NamedTuple):
    """Variances of estimate and innovations that a gain schedule carries from sample to sample."""

    P: numpy.ndarray
    """Variance of the estimate after the last sample, ``(N, axes)``, m^2."""
    squares: numpy.ndarray
    """Mean square of the innovation, ``(N, axes)``, m^2."""
    weight: numpy.ndarray
    """Number of measurements in this mean, ``(N,)``."""


class TimeVarying(Policy):
    """The plain scheme with the Riccati gain (5): high at the start of an error, settled later.

    The variance follows from the equivalent intensity ``Ge``, the receiver's reported noise and gaps in the
    data, not from the innovations.
    """

    control = "gain"
    traceable = True
    task_keywords: ClassVar[dict[str, Any]] = {"decision_interval": 1}
    """An action at every measurement, since the gain follows the Riccati equation."""

    def __init__(self, model: Model, intensity: float | None = None) -> None:
        super().__init__(model)
        p = self.task.parameters
        self.loose: Any = self.task
        self.growth = (p.equivalent_intensities[1] if intensity is None else intensity) * p.sampling_interval
        self.available: Reader = model.reader("available")
        self.reported_variance: Reader = model.reader("reported_variance")
        self.innovation: Reader = model.reader("innovation_in_metres")

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the Riccati gain ``P / (P + R)`` as action, and the variances as memory."""
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
        """Return the memory, and the variance R of the measurement noise as reported, ``(N, axes)`` or
        ``(N, 1)``.
        """
        return memory, reported


class TimeVaryingWhite(TimeVarying):
    """The plain scheme with the Riccati gain (5) for the white part of the INS noise only, ``Ge = G``."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, model.task.parameters.equivalent_intensities[0])


class InnovationAdaptive(TimeVarying):
    """The Riccati gain with the receiver noise estimated from the innovations instead of the report.

    R is the mean square of the innovations over a window, less P. The window starts with the reported noise.
    """

    def __init__(self, model: Model, window: float = 0.25) -> None:
        super().__init__(model)
        self.rate: float = -math.expm1(-self.task.parameters.sampling_interval / window)

    def noise(
        self,
        memory: _Variances,
        P: numpy.ndarray,
        reported: numpy.ndarray,
        available: numpy.ndarray,
        observation: numpy.ndarray,
    ) -> tuple[_Variances, numpy.ndarray]:
        """Return the memory with the mean squared innovation, and R, at least a tenth of it."""
        first = (memory.weight == 0)[:, None]
        before = numpy.where(first, P + reported, memory.squares)
        innovation = self.innovation(observation)
        squares = before + numpy.where(available, self.rate, 0.0) * (innovation**2 - before)
        R = numpy.maximum(squares - P, 0.1 * squares)
        return memory._replace(squares=squares, weight=memory.weight + 1.0), R


class _Offset(NamedTuple):
    """Memory of :class:`AugmentedGain`: its augmented filter, and that filter's distance from the steered
    estimate.
    """

    offset: numpy.ndarray
    """Estimate of the augmented filter less the steered one, ``(axes, N)``, m."""
    rates: AugmentedMemory


class AugmentedGain(TimeVarying):
    """An augmented filter inside the policy, which steers the plain scheme towards its own estimate.

    With ``gain = wanted correction / innovation``, where that lies in [0, 1], the estimate gets the wanted
    correction; otherwise the policy waits for an innovation of the other sign. The reported covariance does
    not include this.
    """

    traceable = True

    def __init__(
        self, model: Model, rule: type[MeasurementNoise] = MeasurementNoise, **values: float
    ) -> None:
        super().__init__(model)
        self.filter: AugmentedFilter = AugmentedFilter(self.task.parameters, rule(**values))

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Update the augmented filter; return the gain that moves the steered estimate nearest to it, and the
        memory.
        """
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


# --- tunable values


POLICIES_BY_RULE, TUNABLE_POLICIES = with_rules(
    AugmentedGain, "augmented-gain", "`augmented-gain` with the receiver's noise", ("mehra", "sage-husa")
)
ESTIMATORS, TUNABLE_ESTIMATORS = with_rules(
    AugmentedEstimator, "augmented", "The augmented filter, receiver noise"
)
ESTIMATORS |= {
    "fault-bank": Variant(
        FaultBank,
        "Kalman filters over the noises of INS and receiver, its coloured error among them, and the onset of "
        "spoofing, each with a Gaussian sum over the receiver's noise, by the prior of the training "
        "distribution.",
        prior=TRAINING,
    ),
    "fault-bank-4": Variant(FaultBank, "`fault-bank` with 4 filters in place of 43.", prior=FEW),
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

TUNABLE = {
    **TUNABLE_POLICIES,
    **TUNABLE_ESTIMATORS,
    **TUNABLE_BANKS,
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
            "The augmented error-state filter alone, which also estimates the constant and coloured rate errors.",
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
        "fault-bank-4",
        "fault-bank-vague",
        "ins-only",
        "gnss-only",
        "random",
        "matched",
        "matched-covariance",
    ),
    metrics=METRICS,
)
"""Baselines of the environment."""
