"""Bootstrap intervals over episodes, or over clusters of them, for many statistics at once.

A bootstrap sample of M episodes is a vector of multinomial counts, and the mean of anything over the sample
is a product with it. So one matrix of counts serves every statistic, and those computed from one sample are
paired. ``scipy.stats.bootstrap`` gives the same intervals (tested) but resamples by index for each statistic,
which is a hundred times slower here.

Episodes of one recorded flight are no independent samples of what there is to fly. Where episodes belong to flights,
whole flights are resampled (cluster bootstrap; Davison and Hinkley, Bootstrap Methods and their Application, 1997,
3.8): the interval then says what other flights of the kind would give. It needs many flights: of fewer than ten it is
too narrow.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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
        clusters: what each episode belongs to, ``(episodes,)``; whole clusters are resampled then, unless all episodes
            are of one. Values may be NaN then where an episode is over, and means are of those that are there.
    """

    def __init__(
        self, episodes: int, resamples: int = RESAMPLES, seed: int = 0, clusters: Sequence[Any] | None = None
    ) -> None:
        generator = numpy.random.default_rng(seed)
        self.ragged = clusters is not None
        of = numpy.arange(episodes)
        if clusters is not None and len(set(clusters)) > 1:
            of = numpy.unique(numpy.asarray(clusters), return_inverse=True)[1]
        number = int(of.max()) + 1
        counts = generator.multinomial(number, numpy.full(number, 1.0 / number), size=resamples)[:, of]
        observed = numpy.ones((1, episodes))
        weights = numpy.concatenate([observed, counts])
        # Clusters may differ in size: the mean is over the episodes of those that were drawn.
        self.weights = weights / weights.sum(axis=1, keepdims=True)

    def means(self, values: numpy.ndarray) -> numpy.ndarray:
        """Means over the episodes and over every resample of them.

        Args:
            values: ``(episodes, ...)``.

        Returns:
            ``(1 + resamples, ...)``; the first row is the data's own.
        """
        flat = values.reshape(len(values), -1)
        present = ~numpy.isnan(flat)
        if self.ragged and not present.all():
            sums, weights = self.weights @ numpy.where(present, flat, 0.0), self.weights @ present
            nobody = numpy.full(sums.shape, numpy.nan)
            means = numpy.divide(sums, weights, out=nobody, where=weights > 0.0)
        else:
            means = self.weights @ flat
        return means.reshape(-1, *values.shape[1:])

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
