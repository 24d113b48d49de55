"""Policies of ManeuveringTarget, and the table of its baselines.

Equation numbers and readings are those of the task's paper (Bakulev, Sychev, Nguyen).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ...envs.maneuvering_target.banks import GainBank
from ...evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy
from ...filters import imm
from ..table import Baselines, PaperAction, tunable
from .alarm import RadarAlarm
from .log_families import log_families
from .metrics import METRICS
from .references import KnownInputBound, KnownTurn
from .smoothers import SMOOTHERS
from .tunable_estimators import ESTIMATORS
from .tunable_estimators import TUNABLE as TUNABLE_ESTIMATORS


class InteractingMultipleModel(Policy):
    """The paper's algorithm: weights by Bayes' rule, equations (12)-(14).

    Reading: S = P + R in the likelihood (11), P the covariance that belongs to the gains in use. Of five readings it is
    the one that reproduces the paper's claim about the best gains, and not the strongest.
    """

    control = "weights"
    traceable = True

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.log_likelihood: Reader = model.reader("log_likelihood")
        self.log_predicted: Reader = model.reader("log_predicted")

    def probabilities(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the posterior mode probabilities ``(N, M)`` by Bayes' rule."""
        log_predicted, log_likelihood = self.log_predicted(observation), self.log_likelihood(observation)
        return imm.mode_posterior(log_predicted.T, log_likelihood.T).T

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the posterior mode probabilities as action (weights of the filters), and no memory."""
        return self.probabilities(observation), None


class SteadyStateInteractingMultipleModel(InteractingMultipleModel):
    """The paper's algorithm under the stronger reading: S = R / (1 - alpha) in the likelihood (11).

    The paper does not print this covariance. It is that of a Kalman filter that has settled to the gain alpha.
    """

    task_keywords: ClassVar[dict[str, Any]] = {"likelihood_covariance": "steady-state"}


class ZeroEvidence(PaperAction):
    """No evidence added to Bayes' rule: the paper's IMM, inside the task."""

    control = "evidence"


def gain_bank(model: Model) -> GainBank:
    """Return the model's bank with its type; the model's control must be ``gain``."""
    assert isinstance(model.filter, GainBank)
    return model.filter


class FixedGain(ConstantPolicy):
    """One alpha-beta filter of constant gain ``alpha``."""

    control = "gain"

    def __init__(self, model: Model, alpha: float) -> None:
        super().__init__(model)
        self.action: tuple[float, ...] = (gain_bank(model).action_for_alpha(alpha),)


class FixedLow(FixedGain):
    """The smallest of the bank's gains, as constant action."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, min(model.task.parameters.gains))


class FixedHigh(FixedGain):
    """The largest of the bank's gains, as constant action."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, max(model.task.parameters.gains))


class FixedBest(FixedGain):
    """The constant gain of least whole-run error on the paper's flight, exact: alpha = 0.65."""

    def __init__(self, model: Model, alpha: float = 0.65) -> None:
        super().__init__(model, alpha)


class AdaptiveGain(Policy):
    """The paper's comparator: a ramp of the gain after every detected manoeuvre.

    alpha falls linearly from the larger gain to the smaller one over seven scans, at the start (scans 1 to
    8) and after every alarm. Reading: the paper does not describe the detector; here the normalised
    innovation squared of one scan, both axes, against the chi-square limit of ``false_alarm_probability``,
    and no alarm while a ramp runs, the first one included, as the one complete ramp of its figure 3 shows.
    """

    control = "gain"
    traceable = True
    rearm = False

    def __init__(self, model: Model, false_alarm_probability: float = 1e-3, ramp_scans: float = 7.0) -> None:
        super().__init__(model)
        self.threshold: float = -2.0 * math.log(false_alarm_probability)
        self.ramp_scans = ramp_scans
        self.low: float = min(self.task.parameters.gains)
        self.high: float = max(self.task.parameters.gains)
        self.squared: Reader = model.reader("log_squared_innovation")
        self.available: Reader = model.reader("available")

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the next gain of the ramp, which an alarm restarts, as action; the memory is the step of the
        ramp.
        """
        step = numpy.where(start, 0, 0 if state is None else state)
        alarm = self.squared(observation)[:, 0] > self.threshold
        may = (step > 0) if self.rearm else (step >= self.ramp_scans)
        step = numpy.where(alarm & may & ~start, 0, step)
        alpha = self.high - (self.high - self.low) * numpy.minimum(step, self.ramp_scans) / self.ramp_scans
        return gain_bank(self.model).action_for_alpha(alpha)[:, None], step + self.available(observation)[
            :, 0
        ]


class RearmingAdaptiveGain(AdaptiveGain):
    """The paper's comparator with a ramp that an alarm restarts while it runs: an equally ordinary detector.

    Reading: the paper sets alpha to the larger gain "if a manoeuvre is detected" and makes no exception for
    the first ramp, so an alarm restarts that one, too.
    """

    rearm = True


def _gains(values: Mapping[str, float]) -> tuple[float, float]:
    return min(values["low"], values["high"]), max(values["low"], values["high"])


def _make_tuned_imm(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    stay = values["stay_low"], values["stay_high"]
    transition = ((stay[0], 1.0 - stay[0]), (1.0 - stay[1], stay[1]))
    return {"gains": _gains(values), "transition": transition}, InteractingMultipleModel


def _make_tuned_adaptive(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    false_alarm, ramp = 10.0 ** values["log10_false_alarm"], values["ramp_scans"]
    return {"gains": _gains(values)}, lambda model: RearmingAdaptiveGain(model, false_alarm, ramp)


_GAINS = {"low": (0.05, 0.3, 0.5), "high": (0.4, 0.7, 0.95)}

TUNABLE = {
    "imm": tunable(
        InteractingMultipleModel,
        _make_tuned_imm,
        **_GAINS,
        stay_low=(0.5, 0.9, 0.999),
        stay_high=(0.3, 0.9, 0.999),
    ),
    "adaptive-rearm": tunable(
        RearmingAdaptiveGain,
        _make_tuned_adaptive,
        **_GAINS,
        log10_false_alarm=(-5.0, -3.0, -0.5),
        ramp_scans=(1.0, 7.0, 20.0),
    ),
    "fixed-best": tunable(FixedBest, alpha=(0.05, 0.65, 0.95)),
    **TUNABLE_ESTIMATORS,
}

LEFT_OUT = ("semi-markov-3", "semi-markov-5", "semi-markov-15", "semi-markov-wide")
"""Estimators that the quick benchmark leaves out as redundant."""

BASELINES = Baselines(
    environment="filtergym/ManeuveringTarget-v0",
    policies={
        "imm": InteractingMultipleModel,
        "imm-steady-state": SteadyStateInteractingMultipleModel,
        "zero": ZeroEvidence,
        "adaptive": AdaptiveGain,
        "adaptive-rearm": RearmingAdaptiveGain,
        "fixed-low": FixedLow,
        "fixed-high": FixedHigh,
        "fixed-best": FixedBest,
        "random": RandomPolicy,
    },
    estimators=ESTIMATORS,
    smoothers=SMOOTHERS,
    references={"known-turn": KnownTurn},
    bounds={"known-input-bound": KnownInputBound},
    score_paper="imm",
    stronger_paper="imm-steady-state",
    score_reference="known-turn",
    log_families=log_families,
    tunable=TUNABLE,
    fallback="semi-markov-vague-pda",
    alarm=RadarAlarm,
    metrics=METRICS,
    best_constant="fixed-best",
    benchmark=(
        "imm",
        "imm-steady-state",
        "adaptive",
        "adaptive-rearm",
        "fixed-low",
        "fixed-high",
        "fixed-best",
        "random",
        "known-turn",
        *(name for name in ESTIMATORS if name not in LEFT_OUT),
        "imm-smoother",
        "known-input-bound",
    ),
)
