"""Alarm of RadarEsmTracking: the class or the ESM decisions are not as the paper's rule assumes."""

import math
from typing import ClassVar

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ...envs.radar_esm_tracking.banks import COUNT_UNIT
from ...filters import class_fusion, imm
from ..alarm import Alarm, innovation_evidence

REFUSAL_SHARE = 0.5
"""Share of decisions that the gate rejects where a second emitter is received; our choice."""
NIS_LIMIT = 9.2
"""Normalised innovation squared of two channels that one scan in a hundred exceeds: beyond it no class explains the
innovation.
"""
MOST = 2.0
"""Largest log-likelihood ratio of one scan for another class, nats; our choice, so that one outlier raises no alarm."""
LEAST = 1e-300
"""Smallest likelihood whose logarithm is taken."""


class ClassAlarm(Alarm):
    """Alarm for a wrong class, for ESM decisions that are all on one type, and for too many rejected decisions.

    A class is wrong where another one explains the radar better than the weights in force.

    Radar errors that no class explains raise no alarm.
    """

    window = 1000  # a detected condition lasts as long as the episode
    false_alarms: ClassVar[float] = 1.0  # of a bound that is far from tight; measured: 0.03 in ``paper``

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        p = self.task.parameters
        self.decisions: int = p.horizon  # an episode's ESM decisions, however long an action holds
        self.squared: Reader = model.reader("log_squared_innovation")
        self.log_likelihood: Reader = model.reader("log_likelihood")
        self.last_weight: Reader = model.reader("last_weight")
        self.used_count: Reader = model.reader("used_count")
        self.refused_count: Reader = model.reader("refused_count")
        self.log_prior = imm.log_probabilities(numpy.array(p.prior))[:, None]
        recognition, composition = numpy.array(p.recognition), numpy.array(p.composition)
        self.log_recognition, self.log_composition = (
            imm.log_probabilities(table) for table in (recognition, composition)
        )
        self.log_esm = imm.log_probabilities(class_fusion.decision_probabilities(recognition, composition))
        self.refusal: float = p.association_error

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of a wrong class, of ESM decisions on one type, and of rejected ones."""
        likelihood = numpy.exp(self.log_likelihood(observation))
        expected = (self.last_weight(observation) * likelihood).sum(axis=1)
        another = numpy.log(likelihood.mean(axis=1) / numpy.maximum(expected, LEAST))
        explained = self.squared(observation).min(axis=1) < NIS_LIMIT
        another = numpy.where(explained, numpy.minimum(another, MOST), 0.0)
        used, refused = (numpy.nan_to_num(read(before)) for read in (self.used_count, self.refused_count))
        new_used, new_refused = self.used_count(observation), self.refused_count(observation)
        one_type = self._one_type(new_used) - self._one_type(used)
        refusals = COUNT_UNIT * (
            (new_refused - refused).sum(axis=1) * math.log(REFUSAL_SHARE / self.refusal)
            + (new_used - used).sum(axis=1) * math.log((1.0 - REFUSAL_SHARE) / (1.0 - self.refusal))
        )
        return numpy.stack([another, one_type, refusals], axis=1)

    def _one_type(self, used_count: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratio, from all ESM decisions so far, of one constant type to types drawn
        anew.
        """
        counts = COUNT_UNIT * used_count.T
        fixed = class_fusion.constant_class_log_likelihood(counts, self.log_recognition, self.log_composition)
        redrawn = self.log_esm @ counts
        return numpy.logaddexp.reduce(self.log_prior + fixed) - numpy.logaddexp.reduce(
            self.log_prior + redrawn
        )


class InnovationsAlarm(Alarm):
    """Alarm for innovations of all hypotheses together that are larger, smaller or to one side (``hypotheses``)."""

    window = 50

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.innovation: Reader = model.reader("innovation")

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of faulty innovations of range and range rate, ``(N, kinds)``."""
        innovation = self.innovation(observation)
        return innovation_evidence(innovation, numpy.ones_like(innovation, dtype=bool))


def make_alarm(model: Model) -> Alarm:
    """Make the alarm for a model: :class:`InnovationsAlarm` under ``hypotheses``, else :class:`ClassAlarm`."""
    return InnovationsAlarm(model) if model.control == "hypotheses" else ClassAlarm(model)
