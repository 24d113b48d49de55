"""Bootstrap intervals over episodes, or over clusters of them, for many statistics at once.

A bootstrap sample of M episodes is a vector of multinomial counts, and the mean of anything over the sample
is a product with it. So one matrix of counts serves every statistic, and those computed from one sample are
paired. ``scipy.stats.bootstrap`` gives the same intervals, a hundred times slower.

For more than ``SEPARATE`` episodes, groups of successive ones are resampled: independent episodes make
independent groups, whose mean varies as that of the episodes.

Episodes of one recorded flight are no independent samples of all flights. Where episodes belong to flights, whole
flights are resampled (cluster bootstrap; Davison and Hinkley, Bootstrap Methods and their Application, 1997, 3.8): the
interval then covers other flights of the same kind. It requires many flights: with fewer than ten it is too narrow.
"""

import functools
import math
import operator
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy

RESAMPLES = 1000
BLOCK = 2048
"""Maximal number of episodes in one block of weights."""
SEPARATE = 2**15
"""Maximal number of resampled episodes or groups of them: each takes a byte in every resample."""
AT_ONCE, SEGMENTS = 32, 64
"""Number of resamples in one search of quantiles, and number of segments of the sorted values in the search."""
FEWEST, MEASUREMENTS = 256, 2**20
"""Minimal number of episodes in one block of a run, and number of their measurements."""
CONFIDENCE = 0.95


class IntervalEstimate(NamedTuple):
    """A value and the ends of its 95 % bootstrap interval; NaN where there is none."""

    value: float
    low: float
    high: float


def ratio(sums: numpy.ndarray) -> numpy.ndarray:
    """Divide the first entry of the second axis by the second, ``(n, 2, ...)`` to ``(n, ...)``; NaN over
    zero.
    """
    first, second = sums[:, 0], sums[:, 1]
    return numpy.divide(first, second, out=numpy.full(first.shape, numpy.nan), where=second > 0.0)


def mean_of_sums(sums: numpy.ndarray) -> numpy.ndarray:
    """Return means ``(1 + resamples, ...)`` from the sums of :meth:`Bootstrap.sums` over all episodes; NaN for
    none.
    """
    return sums[:, 0] if sums.shape[1] == 1 else ratio(sums)


def percentile_interval(samples: numpy.ndarray) -> numpy.ndarray:
    """Return value and 95 % interval from ``samples``: the value in the data and every resample,
    ``(1 + resamples, ...)``.
    """
    if len(samples) == 1:
        return numpy.concatenate([samples, numpy.full((2, *samples.shape[1:]), numpy.nan)])
    tail = 50.0 * (1.0 - CONFIDENCE)
    with numpy.errstate(invalid="ignore"):
        ends = numpy.percentile(samples[1:], [tail, 100.0 - tail], axis=0)
    ends = numpy.where(numpy.isfinite(samples[1:]).all(axis=0), ends, numpy.nan)
    return numpy.concatenate([samples[:1], ends])


def share_interval(share: float, number: int) -> IntervalEstimate:
    """Return a share of independent episodes with its 95 % Wilson score interval.

    Wilson's score interval (E. B. Wilson, Probable inference, the law of succession, and statistical inference, Journal
    of the American Statistical Association 22, 1927): all shares p with ``|share - p| <= z sqrt(p (1 - p) / n)``.

    Args:
        share: the observed share.
        number: number of episodes.
    """
    z = statistics.NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE)
    middle = (share + 0.5 * z * z / number) / (1.0 + z * z / number)
    half = z / (1.0 + z * z / number) * math.sqrt(share * (1.0 - share) / number + (0.5 * z / number) ** 2)
    # The ends are exact there except for rounding.
    low, high = 0.0 if share == 0.0 else middle - half, 1.0 if share == 1.0 else middle + half
    return IntervalEstimate(share, low, high)


def block_of(times: int) -> int:
    """Return the number of episodes to run and reduce in one block, for episodes of ``times`` measurements."""
    return min(BLOCK, max(FEWEST, MEASUREMENTS // times))


class Bootstrap:
    """Bootstrap resamples of M episodes, the same for every statistic, so that differences are paired.

    Args:
        episodes: number M.
        resamples: number of bootstrap samples.
        seed: seed of the resampling; fixed, so that a table can be reproduced.
        clusters: cluster of each episode, ``(episodes,)``; whole clusters are resampled then, unless there is
            only one. Values may then be NaN after the end of an episode, and means leave NaN out.
    """

    def __init__(
        self, episodes: int, resamples: int = RESAMPLES, seed: int = 0, clusters: Sequence[Any] | None = None
    ) -> None:
        self.episodes = episodes
        generator = numpy.random.default_rng(seed)
        self.ragged: bool = clusters is not None
        self._group = 1 if self.ragged else -(-episodes // SEPARATE)
        """Number of successive episodes in a resampled group."""
        self._clusters = None
        number = -(-episodes // self._group)
        if clusters is not None and len(set(clusters)) > 1:
            self._clusters = numpy.unique(numpy.asarray(clusters), return_inverse=True)[1]
            number = int(self._clusters.max()) + 1
        counts = numpy.ones((1 + resamples, number), dtype=numpy.uint8)
        even = numpy.full(number, 1.0 / number)
        for first in range(1, 1 + resamples, 100):  # as one draw, without an array of all in 64 bits
            drawn = generator.multinomial(number, even, size=min(100, 1 + resamples - first))
            if drawn.max() > numpy.iinfo(counts.dtype).max:
                counts = counts.astype(numpy.min_scalar_type(int(drawn.max())))
            counts[first : first + len(drawn)] = drawn
        self._counts = counts
        """Counts of every cluster, group or episode in the data and every resample, ``(1 + resamples, number)``."""
        # Clusters may differ in size: the mean is over the episodes of the drawn clusters.
        self.totals: numpy.ndarray = self._weigh(numpy.bincount(self._resampled(numpy.arange(episodes))))
        self._last: tuple[slice, numpy.ndarray] | None = None

    def _resampled(self, episodes: numpy.ndarray) -> numpy.ndarray:
        """Return the index of the resampled unit (episode, cluster or group) of each of these episodes."""
        return episodes // self._group if self._clusters is None else self._clusters[episodes]

    def _weigh(self, numbers: numpy.ndarray) -> numpy.ndarray:
        """Return sums of integers ``(clusters, ...)`` weighted by the counts of each resample,
        ``(1 + resamples, ...)``.
        """
        numbers = numbers.astype(float)
        parts = (self._counts[i : i + AT_ONCE] for i in range(0, len(self._counts), AT_ONCE))
        return numpy.concatenate([part.astype(float) @ numbers for part in parts])

    @property
    def weights(self) -> numpy.ndarray:
        """Weight of every episode in the mean of the data and of each resample, ``(1 + resamples, episodes)``."""
        return self._counts[:, self._resampled(numpy.arange(self.episodes))] / self.totals[:, None]

    def weights_of(self, part: slice) -> numpy.ndarray:
        """Return the weights of a slice of episodes in the means of data and resamples, ``(1 + resamples, some)``."""
        if self._last is None or self._last[0] != part:
            self._last = None  # so that only one block of weights is in memory
            which = part if self._clusters is None else self._clusters[part]
            self._last = part, self._counts[:, which] / self.totals[:, None]
        return self._last[1]

    def sums(
        self, values: Sequence[numpy.ndarray], first: int = 0, resamples: int | None = None
    ) -> list[numpy.ndarray]:
        """Return weighted sums over some episodes in the data and every resample, for several arrays at once.

        Args:
            values: arrays ``(some, ...)`` of the same episodes, at most ``BLOCK``.
            first: number of the first episode.
            resamples: number of first resamples, equal to those of a bootstrap with fewer; None: all.

        Returns:
            Weighted sums of each array, ``(1 + resamples, 1, ...)``; for ragged episodes of the values
            without NaN and of their weights, ``(1 + resamples, 2, ...)``.
        """
        some = len(values[0])
        flat = numpy.concatenate([each.reshape(some, -1) for each in values], axis=1, dtype=float)
        part = slice(first, first + some)
        if self._group > 1:
            part = slice(first // self._group, (part.stop - 1) // self._group + 1)
            begins = numpy.arange(part.start, part.stop) * self._group - first
            flat = numpy.add.reduceat(flat, numpy.maximum(begins, 0), axis=0)
        weights = self.weights_of(part)
        weights = weights if resamples is None else weights[: 1 + resamples]
        if self.ragged:
            present = ~numpy.isnan(flat)
            total = numpy.stack([weights @ numpy.where(present, flat, 0.0), weights @ present], axis=1)
        else:
            total = (weights @ flat)[:, None]
        ends = numpy.cumsum([each[0].size for each in values])
        return [
            total[..., end - each[0].size : end].reshape(*total.shape[:2], *each.shape[1:])
            for each, end in zip(values, ends, strict=True)
        ]

    def means(self, values: numpy.ndarray) -> numpy.ndarray:
        """Return the means over the episodes in the data and in every resample, ``(1 + resamples, ...)``."""
        return self.means_of(lambda part: values[part])

    def means_of(self, values: Callable[[slice], numpy.ndarray]) -> numpy.ndarray:
        """Return means as :meth:`means`, of values that a function returns for slices of episodes."""
        parts = (self.sums([values(slice(i, i + BLOCK))], i)[0] for i in range(0, self.episodes, BLOCK))
        return mean_of_sums(functools.reduce(operator.add, parts))

    def quantiles(
        self, values: numpy.ndarray, share: float = 0.5, mask: numpy.ndarray | None = None
    ) -> numpy.ndarray:
        """Return a quantile over the episodes of the data and of every resample, ``(1 + resamples,)``.

        Args:
            values: one for each episode, ``(episodes,)``.
            share: share of the weight below the quantile, such as 0.5 for the median.
            mask: true for episodes that count, ``(episodes,)`` booleans; None: all.
        """
        which = numpy.arange(len(values)) if mask is None else numpy.flatnonzero(mask)
        found = numpy.full(len(self._counts), numpy.nan)
        if not len(which):
            return found
        order = which[numpy.argsort(values[which])]
        ordered, owners = values[order], self._resampled(order)
        # First the segment of the quantile, then its place there.
        length = -(-len(order) // SEGMENTS)
        cells = owners * SEGMENTS + numpy.arange(len(order)) // length
        numbers = numpy.bincount(cells, minlength=self._counts.shape[1] * SEGMENTS)
        sums = numpy.cumsum(self._weigh(numbers.reshape(-1, SEGMENTS)), axis=1)
        # Rounding must not move a share that is reached exactly.
        needed = share * sums[:, -1:] * (1.0 - 1e-9)
        segment = (sums >= needed).argmax(axis=1)
        before = numpy.where(segment > 0, sums[numpy.arange(len(sums)), segment - 1], 0.0)
        for i in range(0, len(found), AT_ONCE):
            rows = slice(i, i + AT_ONCE)
            places = segment[rows, None] * length + numpy.arange(length)
            places = numpy.minimum(places, len(order) - 1)
            counts = numpy.take_along_axis(self._counts[rows], owners[places], axis=1)
            enough = before[rows, None] + numpy.cumsum(counts, axis=1, dtype=float) >= needed[rows]
            first = numpy.take_along_axis(places, enough.argmax(axis=1)[:, None], axis=1)[:, 0]
            found[rows] = numpy.where(sums[rows, -1] > 0.0, ordered[first], numpy.nan)
        return found

    def interval(self, statistics: numpy.ndarray) -> IntervalEstimate:
        """Return a statistic with its percentile interval, from its values in data and resamples,
        ``(1 + resamples,)``.
        """
        if self._counts.shape[1] == 1:
            statistics = statistics[:1]
        return IntervalEstimate(*percentile_interval(statistics).tolist())

    def relative_difference(self, means: numpy.ndarray, others: numpy.ndarray) -> IntervalEstimate:
        """Return ``means / others - 1`` of two competitors with its paired interval."""
        return self.interval(means / others - 1.0)

    def geometric_difference(self, costs: numpy.ndarray, others: numpy.ndarray) -> IntervalEstimate:
        """Return the geometric mean of two competitors' cost ratios by episode, minus one, with its interval."""
        return self.estimate(numpy.log(costs / others), numpy.expm1)

    def estimate(
        self, values: numpy.ndarray, of_means: Callable[[numpy.ndarray], numpy.ndarray] = lambda m: m
    ) -> IntervalEstimate:
        """Return a function of the means of ``values`` over the episodes, with its bootstrap interval."""
        return self.interval(of_means(self.means(values)))
