"""Bootstrap intervals over episodes, for many statistics at once.

A bootstrap sample of M episodes is a vector of multinomial counts, and the mean of anything over the sample
is a product with it. So one matrix of counts serves every statistic, and those computed from one sample are
paired. ``scipy.stats.bootstrap`` gives the same intervals (tested) but resamples by index for each statistic,
which is a hundred times slower here.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy

RESAMPLES = 1000
CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A value and its bootstrap interval; NaN where there is none."""

    value: float
    low: float
    high: float


class Bootstrap:
    """Resampling of M episodes, the same for every statistic.

    Args:
        episodes: M.
        resamples: number of bootstrap samples.
        seed: of the resampling; fixed, so that a table can be made again.
    """

    def __init__(self, episodes: int, resamples: int = RESAMPLES, seed: int = 0) -> None:
        generator = numpy.random.default_rng(seed)
        counts = generator.multinomial(episodes, numpy.full(episodes, 1.0 / episodes), size=resamples)
        observed = numpy.ones((1, episodes))
        self.weights = numpy.concatenate([observed, counts]) / episodes

    def means(self, values: numpy.ndarray) -> numpy.ndarray:
        """Means over the episodes and over every resample of them.

        Args:
            values: ``(episodes, ...)``.

        Returns:
            ``(1 + resamples, ...)``; the first row is the data's own.
        """
        flat = values.reshape(len(values), -1)
        return (self.weights @ flat).reshape(-1, *values.shape[1:])

    def medians(self, values: numpy.ndarray) -> numpy.ndarray:
        """Medians over the episodes and over every resample of them, ``(1 + resamples,)``.

        Args:
            values: one for each episode, ``(episodes,)``.
        """
        order = numpy.argsort(values)
        # The smallest value that at least half of the sample does not exceed; a little off for rounding.
        below = numpy.cumsum(self.weights[:, order], axis=1)
        return values[order][(below >= 0.5 - 1e-9).argmax(axis=1)]

    def interval(self, statistics: numpy.ndarray) -> Estimate:
        """Percentile interval of a statistic computed from :meth:`means`, ``(1 + resamples,)``."""
        tail = 50.0 * (1.0 - CONFIDENCE)
        value, resampled = statistics[0], statistics[1:]
        if not numpy.isfinite(resampled).all():
            return Estimate(float(value), float("nan"), float("nan"))
        low, high = numpy.percentile(resampled, [tail, 100.0 - tail])
        return Estimate(float(value), float(low), float(high))

    def estimate(
        self, values: numpy.ndarray, of_means: Callable[[numpy.ndarray], numpy.ndarray] = lambda m: m
    ) -> Estimate:
        """Interval of a function of the means of ``values`` over the episodes."""
        return self.interval(of_means(self.means(values)))
