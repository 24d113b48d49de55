"""Alarms, which detect faults from observations alone.

An alarm computes at every decision the log-likelihood ratio of each kind of fault to no fault. Each ratio is summed as
long as the sum is positive (Page's cumulative sum, 1954); the alarm sounds where a sum reaches its limit. Without a
fault a sum with limit h reaches it once in exp(h) decisions or less (Lorden, 1971), so the limit follows from the
tolerated number of false alarms.

Signs of a fault are innovations that are larger than expected, smaller, or to one side, and a reading that
repeats itself. A missing measurement counts where the filter does not model it, as with fixed gains.

An environment names its alarm in ``Baselines.alarm``; the default is :class:`InnovationAlarm`.
"""

import math
from typing import Any, ClassVar, NamedTuple

import numpy

from ..envs.contract.model import Model
from ..envs.contract.observation import Reader

LARGER = 3.0
"""Factor on the variance of innovations that an alarm tests for; other factors are detected some decisions later."""
SMALLER = 1.0 / 3.0
"""Factor on the variance of innovations that are smaller than expected."""
SHIFT = 0.5
"""Mean of normalised innovations that an alarm tests for, to either side."""
CERTAIN = math.inf
"""Log-likelihood ratio of an observation that only a fault explains."""


def scale_ratio(squares: Any, degrees: Any, factor: float) -> Any:
    """Return the log-likelihood ratio of ``factor`` times the expected variance to the expected one.

    Args:
        squares: normalised innovation squared, chi-square without a fault.
        degrees: degrees of freedom.
        factor: factor on the variance.
    """
    return 0.5 * squares * (1.0 - 1.0 / factor) - 0.5 * degrees * math.log(factor)


def shift_ratio(normalised: Any, mean: float) -> Any:
    """Return the log-likelihood ratio of normalised innovations of mean ``mean`` to those of mean zero."""
    return mean * (normalised - 0.5 * mean)


def innovation_evidence(normalised: numpy.ndarray, there: numpy.ndarray) -> numpy.ndarray:
    """Return log-likelihood ratios of too large, too small and shifted innovations to expected ones,
    ``(N, 4 C)``.
    """
    ratios = [scale_ratio(normalised**2, 1.0, factor) for factor in (LARGER, SMALLER)]
    ratios += [shift_ratio(normalised, mean) for mean in (SHIFT, -SHIFT)]
    return numpy.where(numpy.tile(there, 4), numpy.concatenate(ratios, axis=1), 0.0)


def fault_evidence(wrong: numpy.ndarray) -> numpy.ndarray:
    """Return ``CERTAIN`` as log-likelihood ratio where ``wrong`` ``(N,)`` is true, else zero, ``(N, 1)``."""
    return numpy.where(wrong, CERTAIN, 0.0)[:, None]


class Sums(NamedTuple):
    """Memory of an alarm: its cumulative sums, and the last observation."""

    sums: numpy.ndarray
    """Sums of each log-likelihood ratio, ``(N, kinds)``."""
    observation: numpy.ndarray
    """Last observation, ``(N, fields)``."""


class Alarm:
    """Base of the alarms, by cumulative sums; subclasses compute the evidence of each kind of fault."""

    window: ClassVar[int] = 30
    """Decisions for which an alarm remains relevant: the memory of the disturbed filters."""
    false_alarms: ClassVar[float] = 0.02
    """Largest mean number of false alarms in an episode, where filters and sensors are as modelled."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.task: Any = model.task
        self.decisions: int = max(self.task.horizon // self.task.decision_interval, 1)

    def measurements(self, before: numpy.ndarray) -> numpy.ndarray:
        """Return the number of measurements since the last observation ``before``, ``(N, 1)``; one at the
        start.
        """
        return numpy.where(numpy.isnan(before[:, :1]), 1, self.task.decision_interval)

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratio of each kind of fault to no fault, ``(N, kinds)``.

        ``before`` is the last observation; NaN where an episode begins.
        """
        raise NotImplementedError

    def update(
        self, observation: numpy.ndarray, memory: Sums | None, start: numpy.ndarray
    ) -> tuple[numpy.ndarray, Sums]:
        """Update the cumulative sums; return a mask ``(N,)`` of episodes with a fault, and the memory."""
        before = numpy.full_like(observation, math.nan) if memory is None else memory.observation
        evidence = self.evidence(observation, numpy.where(start[:, None], math.nan, before))
        sums = numpy.zeros_like(evidence) if memory is None else memory.sums
        limit = math.log(self.decisions * evidence.shape[1] / self.false_alarms)
        # Never beyond the limit, so that a fault that ended is forgotten as fast as it was found.
        sums = numpy.clip(numpy.where(start[:, None], 0.0, sums) + evidence, 0.0, limit)
        wrong: Any = (sums >= limit).any(axis=1)  # NumPy's declaration allows for a scalar
        return wrong, Sums(sums, observation)


class InnovationAlarm(Alarm):
    """Alarm for faulty innovations: one that is too large, or several that are too large, too small or to one side.

    It reads the block or quantity ``innovation`` of the observation, each component over its predicted deviation. Where
    ``available`` is zero there is no innovation, which is no evidence.

    Raises:
        ValueError: if the observation has no ``innovation``.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        try:
            self.innovation: Reader = model.reader("innovation")
        except ValueError as error:
            raise ValueError(
                f"{self.task.id} has no 'innovation' in its observation under control {model.control!r}, from which to "
                "detect faults: give an alarm, in its baselines or to the gate"
            ) from error
        try:
            self.available: Any = model.reader("available")
        except ValueError:
            self.available = lambda observation: numpy.ones((len(observation), 1))

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of an innovation that is too large, too small or shifted, ``(N, 4 C)``."""
        innovation, available = self.innovation(observation), self.available(observation)
        there = numpy.broadcast_to(available > 0.0, innovation.shape)
        return innovation_evidence(innovation, there)
