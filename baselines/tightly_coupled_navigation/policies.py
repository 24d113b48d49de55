"""Policies of TightlyCoupledNavigation, and the table of its baselines.

The paper is Moroz, adaptive multi-hypothesis measurer of an inertial-satellite navigation system.
"""

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ...envs.tightly_coupled_navigation.fault_hypotheses import (
    TRAINING,
    VAGUE,
    FaultHypotheses,
    FaultPrior,
)
from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES, LINE, REST, SINGER
from ...envs.tightly_coupled_navigation.satellite_faults import SatelliteFaults
from ...evaluation.competitors.kinds import ConstantPolicy, Policy, RandomPolicy
from ..table import Baselines, ConstantMode, PaperAction, Tunable, Variant, tunable
from .alarm import SensorAlarm
from .estimators import Huber, HuberStuckCheck
from .metrics import METRICS
from .references import KnownMode, KnownModeBound


class MultiHypothesis(PaperAction):
    """The paper's algorithm, steps 1 to 8: no evidence added to Bayes' rule."""

    control = "evidence"


def chain(stay: float) -> tuple[tuple[float, ...], ...]:
    """Return a transition matrix of the hypotheses, with ``stay`` on the diagonal and equal other entries."""
    leave = (1.0 - stay) / (len(HYPOTHESES) - 1)
    return tuple(
        tuple(stay if i == j else leave for j in range(len(HYPOTHESES))) for i in range(len(HYPOTHESES))
    )


class Sticky(MultiHypothesis):
    """The paper's algorithm for a task whose chain leaves a hypothesis once in 100 s, not once in 5 s.

    An evaluation sets the task's ``transition``; elsewhere the user sets it.
    """

    task_keywords: ClassVar[dict[str, Any]] = {"transition": chain(0.9999)}


class FixedRobust(ConstantPolicy):
    """The paper's probabilities over a robust update, always; accelerometers are left out while they repeat their
    reading.

    See ``HuberBank``.

    Args:
        accelerometers: constant action that raises their noise, at the whole reach (`noise_reach` of one).
        pseudoranges: strength of the robust update of these, 0 to 1.
        rates: strength of the robust update of their rates, 0 to 1.
    """

    control = "robust"

    def __init__(
        self, model: Model, accelerometers: float = 0.0, pseudoranges: float = 1.0, rates: float = 1.0
    ) -> None:
        super().__init__(model)
        throughout = min(accelerometers / self.task.parameters.noise_reach, 1.0)
        self.action: tuple[float, ...] = (0.0, 0.0, throughout, 0.0, 1.0, pseudoranges, rates)


class NisAdaptive(Policy):
    """Policy of innovation-based adaptation of the sensors' noise, under the paper's probabilities.

    Where the short average of the normalised innovation squared exceeds ``threshold`` under every hypothesis,
    an excess of the pseudoranges raises their noise. One of the rates raises theirs, or that of the
    accelerometers, which may stick; one of the accelerometers may also be a manoeuvre.

    Args:
        threshold: threshold of the average per observation; a consistent filter has 1.
        rates: power of the rates' excess in their own variance.
        accelerometers: power of the rates' excess in the variance of the accelerometers.
        own: power of the accelerometers' excess in their own variance.
        base: constant part of the action of the accelerometers.
    """

    control = "gain"
    traceable = True

    def __init__(
        self,
        model: Model,
        threshold: float = 3.0,
        rates: float = 1.0,
        accelerometers: float = 1.0,
        own: float = 1.0,
        base: float = 0.0,
    ) -> None:
        super().__init__(model)
        self.average_nis: Reader = model.reader("average_nis")
        self.nats: float = 2.0 * math.log(self.task.parameters.noise_scale)
        self.threshold = threshold
        self.rates = rates
        self.accelerometers = accelerometers
        self.own = own
        self.base = base

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return logarithms of factors on the sensors' noise as action, from the excess of their NIS."""
        nis = self.average_nis(observation).reshape(len(observation), -1, len(HYPOTHESES)).min(axis=2)
        ranges, rates, forces, attitude = numpy.log(numpy.maximum(nis.T / self.threshold, 1.0)) / self.nats
        action = [
            ranges,
            self.rates * rates,
            self.base + self.own * forces + self.accelerometers * rates,
            attitude,
        ]
        return numpy.clip(numpy.stack(action, axis=1), -1.0, 1.0), None


# --- tunable values


HYPOTHESES_ON_FAULTS = {
    "fault-hypotheses": Variant(
        FaultHypotheses,
        "Bank over motion and faults: legs, errors of pseudoranges that last and jump, noise levels of rates; the "
        "prior of the training distribution.",
    ),
    "fault-hypotheses-vague": Variant(
        FaultHypotheses, "The bank over motion and faults with one vague prior for all flights.", prior=VAGUE
    ),
}


def _tunable_hypotheses(name: str, prior: FaultPrior) -> Tunable:
    found = tunable(
        HYPOTHESES_ON_FAULTS[name],
        leg=(1.0, prior.leg, 10.0),
        acceleration=(3.0, prior.acceleration, 40.0),
        log10_noisy_rate=(-3.0, math.log10(prior.noisy_rate), -0.5),
        coloured=(0.3, prior.coloured, 5.0),
    )
    return replace(found, in_lanes=False)


TUNABLE = {
    "fixed-robust": tunable(
        FixedRobust, accelerometers=(0.0, 0.0, 0.5), pseudoranges=(0.0, 1.0, 1.0), rates=(0.0, 1.0, 1.0)
    ),
    "fault-hypotheses": _tunable_hypotheses("fault-hypotheses", TRAINING),
    "fault-hypotheses-vague": _tunable_hypotheses("fault-hypotheses-vague", VAGUE),
}

BASELINES = Baselines(
    environment="filtergym/TightlyCoupledNavigation-v0",
    policies={
        "multi-hypothesis": MultiHypothesis,
        "sticky": Sticky,
        "nis-adaptive": NisAdaptive,
        "fixed-robust": FixedRobust,
        "stuck-exclusion": Variant(
            FixedRobust,
            "The paper's algorithm without accelerometers while they repeat their last reading.",
            pseudoranges=0.0,
            rates=0.0,
        ),
        "singer": Variant(
            ConstantMode,
            "The paper's non-adaptive measurer: Singer's model alone, as in the third filter of the bank.",
            mode=SINGER,
        ),
        "constant-velocity": Variant(ConstantMode, "Hypothesis 2 alone.", mode=LINE),
        "rest": Variant(ConstantMode, "Hypothesis 1 alone.", mode=REST),
        "random": RandomPolicy,
    },
    estimators={
        "huber": Huber,
        "huber-stuck-check": HuberStuckCheck,
        **HYPOTHESES_ON_FAULTS,
        "satellite-fault-bank": SatelliteFaults,
    },
    references={"known-mode": KnownMode},
    bounds={"known-mode-bound": KnownModeBound},
    score_paper="multi-hypothesis",
    score_reference="known-mode",
    headline_episodes=5000,
    tunable=TUNABLE,
    fallback="stuck-exclusion",
    alarm=SensorAlarm,
    # The most informative ones: a policy takes seconds here, and the quick benchmark has two minutes in all.
    benchmark=(
        "multi-hypothesis",
        "nis-adaptive",
        "singer",
        "fault-hypotheses",
        "known-mode",
        "known-mode-bound",
    ),
    physical=("rmse", "velocity"),
    measurement_seconds=4e-5,
    metrics=METRICS,
)
