"""Policies of RadarEsmTracking, and the table of its baselines.

Equation numbers and readings are those of the task's paper (Ivanov, Seliverstov).
"""

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ...envs.radar_esm_tracking.banks import COUNT_UNIT
from ...envs.radar_esm_tracking.exact_bayes import FEW, TRAINING, VAGUE, ClassPrior, ExactBayes
from ...evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy
from ...filters import class_fusion, imm
from ...filters.small_matrices import apply
from ..table import Baselines, ConstantMode, PaperAction, Tunable, Variant, tunable
from .alarm import make_alarm
from .metrics import METRICS
from .references import Ideal, KnownDrawBound


class QuasiOptimal(PaperAction):
    """The paper's algorithm (8)-(12): no evidence added to its rule."""

    control = "evidence"


class FixedWeights(ConstantPolicy):
    """Policy of equal, constant weights of all filters."""

    control = "weights"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.action: tuple[float, ...] = (1.0,) * len(self.task.modes)


class _Posterior(Policy):
    """Base of the policies whose weights are class probabilities, from log-likelihoods in the observation."""

    control = "weights"
    traceable = True
    task_keywords: ClassVar[dict[str, Any]] = {"decision_interval": 1}
    """An action at every scan, since the posterior changes."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        p = self.task.parameters
        self.accumulated: Reader = model.reader("accumulated_log_likelihood")
        self.used_count: Reader = model.reader("used_count")
        self.refused_count: Reader = model.reader("refused_count")
        self.log_prior = imm.log_probabilities(numpy.array(p.prior))[:, None]
        self.log_recognition = imm.log_probabilities(numpy.array(p.recognition))
        self.log_composition = imm.log_probabilities(numpy.array(p.composition))
        self.log_esm = imm.log_probabilities(
            class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
        )

    def radar(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood of each class by all radar measurements so far, up to a constant,
        ``(M, N)``.
        """
        return self.accumulated(observation).T

    def counts(self, observation: numpy.ndarray, refused: float = 0.0) -> numpy.ndarray:
        """Return the number of ESM decisions on each type, rejected ones with weight ``refused``, ``(J, N)``."""
        shown = self.used_count(observation) + refused * self.refused_count(observation)
        return COUNT_UNIT * shown.T

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the log-probability of each class, up to a constant, ``(M, N)``, from an observation."""
        raise NotImplementedError

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        return imm.softmax(self.log_posterior(observation)).T, None


class RadarOnly(_Posterior):
    """Policy of class probabilities from the radar's innovations alone."""

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the log-probability of each class by prior and radar, up to a constant, ``(M, N)``."""
        return self.log_prior + self.radar(observation)


class EsmOnly(_Posterior):
    """Policy of class probabilities from the ESM decisions alone, each taken as new evidence, as in (8)."""

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the log-probability of each class by prior and ESM decisions, up to a constant, ``(M, N)``."""
        return self.log_prior + self.log_esm @ self.counts(observation)


class Ungated(_Posterior):
    """The paper's rule with every ESM decision, also those that the gate rejects.

    With a single emitter a rejected decision is as good as any: on ``paper`` this is the exact posterior given the
    observations, which no policy can beat. With a second emitter the gate is needed.
    """

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the log-probability of each class by prior, radar and all ESM decisions, up to a constant,
        ``(M, N)``.
        """
        return self.log_prior + self.radar(observation) + self.log_esm @ self.counts(observation, 1.0)


class JointType(_Posterior):
    """Policy of the joint posterior of type and class: right where a target has one type.

    Args:
        refused: weight of a decision that the gate rejects, 0 to 1.
        esm: weight of any decision, 0 to 1.
    """

    def __init__(self, model: Model, refused: float = 0.0, esm: float = 1.0) -> None:
        super().__init__(model)
        self.refused = refused
        self.esm = esm

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return each class's log-probability by prior, radar and one type's decisions, ``(M, N)``."""
        counts = self.esm * self.counts(observation, self.refused)
        esm = class_fusion.constant_class_log_likelihood(counts, self.log_recognition, self.log_composition)
        return self.log_prior + self.radar(observation) + esm


class ForgettingJointType(JointType):
    """Policy of the joint posterior of type and class where both may change: old evidence fades.

    Args:
        change: probability that the class changes from one decision to the next; by default once in 500
            scans, four times the length of an episode.
        refused: weight of a decision that the gate rejects, 0 to 1.
        esm: weight of any decision, 0 to 1.
    """

    traceable = True

    def __init__(self, model: Model, change: float = 0.002, refused: float = 0.0, esm: float = 1.0) -> None:
        super().__init__(model, refused, esm)
        self.change = change
        self.log_start: numpy.ndarray = self.log_prior[:, None] + self.log_composition[..., None]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Update the joint posterior of type and class; return the class probabilities, and the posterior as
        memory.
        """
        radar, counts = self.radar(observation), self.esm * self.counts(observation, self.refused)
        joint, last_radar, last_counts = (self.log_start, 0.0, 0.0) if state is None else state
        joint = numpy.where(start, self.log_start, joint)
        joint = joint + (radar - numpy.where(start, 0.0, last_radar))[:, None]
        joint = class_fusion.change_class_and_type(joint, self.log_composition, self.change)
        new_counts = counts - numpy.where(start, 0.0, last_counts)
        joint = joint + apply(self.log_recognition[..., None], new_counts)
        weights = imm.softmax(joint.reshape(-1, joint.shape[-1])).reshape(joint.shape).sum(axis=1)
        return weights.T, (joint, radar, counts)


class Leaky(_Posterior):
    """The paper's rule (8) with class transitions, so that a change of class is detected.

    Only the weights leak; the filters stay as they are (``class_transition`` would mix them too).

    Args:
        leak: probability that the class changes in one scan, shared equally by the others.
        esm: weight of a decision, 0 to 1.
    """

    def __init__(self, model: Model, leak: float = 0.01, esm: float = 1.0) -> None:
        super().__init__(model)
        classes = len(self.task.modes)
        others = (1.0 - numpy.eye(classes)) / (classes - 1)
        self.transition: numpy.ndarray = (1.0 - leak) * numpy.eye(classes) + leak * others
        self.last_weight: Reader = model.reader("last_weight")
        self.log_likelihood: Reader = model.reader("log_likelihood")
        self.decision: Reader = model.reader("decision")
        self.refused: Reader = model.reader("decision_refused")
        self.esm = esm

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return the log of last weights after radar, class transition and ESM decision, up to a constant,
        ``(M, N)``.
        """
        last = imm.log_probabilities(self.last_weight(observation).T)
        this_scan = self.log_likelihood(observation).T
        predicted = self.transition.T @ imm.mode_posterior(last, this_scan)
        usable = self.decision(observation)[:, :-1] * (1.0 - self.refused(observation))
        return imm.log_probabilities(predicted) + self.esm * (self.log_esm @ usable.T)


ESTIMATORS = {
    "exact-bayes": Variant(
        ExactBayes,
        "Bayes' rule over class, its change, emitter types, silences and a second emitter, a Kalman filter for each "
        "class and time of its change, by the prior of the training distribution.",
        prior=TRAINING,
    ),
    "exact-bayes-9": Variant(
        ExactBayes,
        "`exact-bayes` with 9 filters in place of 12: one time of a change of class, one share and one distance of the "
        "second emitter.",
        prior=FEW,
    ),
    "exact-bayes-vague": Variant(
        ExactBayes,
        "`exact-bayes` by one prior for all targets: the class may change again, types may be drawn anew for every "
        "decision, and measurements of the radar may be outliers.",
        prior=VAGUE,
    ),
}


def _tunable_bayes(name: str, prior: ClassPrior, **limits: tuple[float, float, float]) -> Tunable:
    change = (-4.0, math.log10(prior.change_rate), -1.0)
    found = tunable(
        ESTIMATORS[name], log10_change_rate=change, coloured=(0.05, prior.coloured, 0.7), **limits
    )
    return replace(found, in_lanes=False)


TUNABLE = {
    "exact-bayes": _tunable_bayes("exact-bayes", TRAINING, calm=(0.05, TRAINING.calm, 0.7)),
    "exact-bayes-vague": _tunable_bayes(
        "exact-bayes-vague",
        VAGUE,
        redrawn=(0.01, VAGUE.redrawn, 0.9),
        log10_outliers=(-4.0, math.log10(VAGUE.outliers), -0.7),
    ),
    "forgetting-joint-type": tunable(
        ForgettingJointType,
        log10_change=(-6.0, math.log10(0.002), -0.5),
        refused=(0.0, 0.0, 1.0),
        esm=(0.0, 1.0, 1.0),
    ),
}

BASELINES = Baselines(
    environment="filtergym/RadarEsmTracking-v0",
    policies={
        "quasi-optimal": QuasiOptimal,
        "joint-type": JointType,
        "forgetting-joint-type": ForgettingJointType,
        "leaky": Leaky,
        "ungated": Ungated,
        "radar-only": RadarOnly,
        "esm-only": EsmOnly,
        "non-adaptive": Variant(
            ConstantMode,
            "The paper's comparator: the filter of the most agile class for every target.",
            mode=-1,
        ),
        "fixed-weights": FixedWeights,
        "random": RandomPolicy,
    },
    estimators=ESTIMATORS,
    references={"ideal": Ideal},
    bounds={"known-class-bound": KnownDrawBound},
    score_paper="quasi-optimal",
    score_reference="ideal",
    tunable=TUNABLE,
    fallback="exact-bayes-vague",
    alarm=make_alarm,
    physical=("rmse", "acceleration"),
    benchmark=(
        "quasi-optimal",
        "joint-type",
        "forgetting-joint-type",
        "leaky",
        "ungated",
        "radar-only",
        "esm-only",
        "non-adaptive",
        "exact-bayes",
        "exact-bayes-9",
        "exact-bayes-vague",
        "random",
        "ideal",
        "known-class-bound",
    ),
    metrics=METRICS,
)
