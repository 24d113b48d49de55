"""Alarms: what says from observations alone that something is wrong.

An alarm weighs at every decision how much better what is shown is explained by something wrong than by filters and
sensors that are as modelled: a log-likelihood ratio for each kind of wrong. Each is summed as long as the sum is
positive (Page's cumulative sum, 1954); the alarm speaks where a sum reaches its limit. Where nothing is wrong a sum
with limit h reaches it once in exp(h) decisions or less (Lorden, 1971), so the limit follows from how many false alarms
one may cost.

What is wrong may be innovations that are larger than a filter expects, smaller, or to one side; a reading that repeats
itself. A measurement that is missing is wrong where the filter is not made for it, as one of fixed gains; a Kalman
filter is told of it and knows what to do.

An environment says in ``Baselines.alarm`` what it looks at; for others there is :class:`InnovationAlarm`.
"""

import math
from typing import Any, ClassVar, NamedTuple

import numpy

from ..envs.contract.model import Model
from ..envs.contract.observation import Reader

LARGER = 3.0
"""Factor on the variance of innovations that an alarm looks for; others are found too, some decisions later."""
SMALLER = 1.0 / 3.0
"""Likewise for innovations that are smaller than expected."""
SHIFT = 0.5
"""Likewise mean of normalised innovations, to either side."""
CERTAIN = math.inf
"""Log-likelihood ratio of what nothing but a fault explains."""


def scale_ratio(squares: Any, degrees: Any, factor: float) -> Any:
    """Return the log-likelihood ratio of innovations whose variance is ``factor`` times the expected one.

    Args:
        squares: normalised innovation squared, chi-square if nothing is wrong.
        degrees: of freedom.
        factor: on the variance.
    """
    return 0.5 * squares * (1.0 - 1.0 / factor) - 0.5 * degrees * math.log(factor)


def shift_ratio(normalised: Any, mean: float) -> Any:
    """Return the log-likelihood ratio of normalised innovations with that mean in place of zero."""
    return mean * (normalised - 0.5 * mean)


def innovation_evidence(normalised: numpy.ndarray, there: numpy.ndarray) -> numpy.ndarray:
    """Return the log-likelihood ratios of innovations that are larger, smaller, or to one side, ``(N, 4 C)``.

    Args:
        normalised: innovations over their predicted deviation, ``(N, C)``.
        there: whether each is one; what stands for a missing one says nothing.
    """
    ratios = [scale_ratio(normalised**2, 1.0, factor) for factor in (LARGER, SMALLER)]
    ratios += [shift_ratio(normalised, mean) for mean in (SHIFT, -SHIFT)]
    return numpy.where(numpy.tile(there, 4), numpy.concatenate(ratios, axis=1), 0.0)


def certain(wrong: numpy.ndarray) -> numpy.ndarray:
    """Return the evidence of what nothing but a fault explains, ``(N, 1)``; ``wrong`` is ``(N,)``."""
    return numpy.where(wrong, CERTAIN, 0.0)[:, None]


class Sums(NamedTuple):
    """What an alarm remembers."""

    sums: numpy.ndarray
    """Of each log-likelihood ratio, ``(N, kinds)``."""
    shown: numpy.ndarray
    """Last observation, ``(N, fields)``."""


class Alarm:
    """Base of the alarms: subclasses say how likely something is wrong.

    Args:
        model: whose observations it is shown.
    """

    window: ClassVar[int] = 30
    """Decisions for which an alarm is worth heeding: the memory of the filters that it disturbs."""
    false_alarms: ClassVar[float] = 0.02
    """Most false alarms in an episode, where filters and sensors are as modelled."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.task: Any = model.task
        self.decisions: int = max(self.task.horizon // self.task.decision_interval, 1)

    def measurements(self, before: numpy.ndarray) -> numpy.ndarray:
        """Return the measurements that an observation tells of, ``(N, 1)``: since the last one, or at an episode's
        start, one.

        Args:
            before: the last observation; NaN where an episode begins.
        """
        return numpy.where(numpy.isnan(before[:, :1]), 1, self.task.decision_interval)

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of something wrong to nothing wrong, a column for each kind, ``(N,
        kinds)``.

        Args:
            observation: ``(N, fields)``.
            before: the last one; NaN where an episode begins.
        """
        raise NotImplementedError

    def hear(
        self, observation: numpy.ndarray, memory: Sums | None, start: numpy.ndarray
    ) -> tuple[numpy.ndarray, Sums]:
        """Say where something is wrong.

        Args:
            observation: ``(N, fields)``.
            memory: what the last call returned; None at the first.
            start: true where an episode begins, ``(N,)``.

        Returns:
            Booleans ``(N,)``, and memory.
        """
        before = numpy.full_like(observation, math.nan) if memory is None else memory.shown
        evidence = self.evidence(observation, numpy.where(start[:, None], math.nan, before))
        sums = numpy.zeros_like(evidence) if memory is None else memory.sums
        limit = math.log(self.decisions * evidence.shape[1] / self.false_alarms)
        # Never beyond the limit: what is over is forgotten as fast as it was found.
        sums = numpy.clip(numpy.where(start[:, None], 0.0, sums) + evidence, 0.0, limit)
        wrong: Any = (sums >= limit).any(axis=1)  # NumPy's declaration allows for a scalar
        return wrong, Sums(sums, observation)


class InnovationAlarm(Alarm):
    """For any task that shows a block or quantity ``innovation``, each component over its predicted deviation: one that
    is too large, or for a while too large, too small, or to one side. Where ``available`` is shown as zero there is
    none, which is not held against the filter.

    Raises:
        ValueError: if the task shows no ``innovation``.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        try:
            self.innovation: Reader = model.reader("innovation")
        except ValueError as error:
            raise ValueError(
                f"{self.task.id} shows no 'innovation' under control {model.control!r} that tells whether something is "
                "wrong: give an alarm, in its baselines or to the gate"
            ) from error
        try:
            self.available: Any = model.reader("available")
        except ValueError:
            self.available = lambda observation: numpy.ones((len(observation), 1))

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Weigh every component for itself."""
        innovation, available = self.innovation(observation), self.available(observation)
        there = numpy.broadcast_to(available > 0.0, innovation.shape)
        return innovation_evidence(innovation, there)
