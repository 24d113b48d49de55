"""Intervals for log-likelihoods and correlations of innovations, also for a single recording.

Neighbouring measurements are not independent, so whole stretches of them are resampled for intervals.
"""

import math
import zlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy

from .bootstrap import Bootstrap, IntervalEstimate, ratio

if TYPE_CHECKING:
    import xarray

STRETCHES = 30
"""Maximal number of stretches of measurements for intervals; a stretch has at least ``SHORTEST_STRETCH``."""
SHORTEST_STRETCH = 8
UNKNOWN = IntervalEstimate(math.nan, math.nan, math.nan)


def correlation(errors: numpy.ndarray, mask: numpy.ndarray) -> IntervalEstimate:
    """Return the lag-one correlation of innovations with its 95 % interval; zero if they are white."""
    before = numpy.roll(errors, 1, axis=2)
    before[:, :, 0] = math.nan
    values = numpy.stack([(errors * before).sum(axis=0), 0.5 * (errors**2 + before**2).sum(axis=0)], axis=-1)
    return stretch_interval(mask, values, ratio)


def stretch_interval(
    mask: numpy.ndarray, values: numpy.ndarray, function: Callable[[numpy.ndarray], numpy.ndarray]
) -> IntervalEstimate:
    """Return a function of two means over measurements, with a 95 % interval by resampled stretches.

    Args:
        mask: true for the measurements to use, ``(episodes, time)``.
        values: values to average, ``(episodes, time, 2)``; a measurement with a NaN is left out.
        function: function of means ``(n, 2)``.
    """
    there = mask & numpy.isfinite(values).all(axis=-1)
    stretch = stretches_of(mask)
    number, count = stretch[there], int(stretch.max()) + 1
    sums = numpy.stack(
        [numpy.bincount(number, values[there][:, i], minlength=count) for i in range(2)], axis=1
    )
    return interval_of_sums(sums, numpy.bincount(number, minlength=count), function)


def stretches_of(mask: numpy.ndarray) -> numpy.ndarray:
    """Divide the measurements of a mask into stretches; return each one's number, ``(episodes, time)``, or
    -1.
    """
    total = int(mask.sum())
    stretch = numpy.full(mask.shape, -1, dtype=numpy.int16)
    stretch[mask] = numpy.arange(total) // max(SHORTEST_STRETCH, -(-total // STRETCHES))
    return stretch


def interval_of_sums(
    sums: numpy.ndarray, counts: numpy.ndarray, function: Callable[[numpy.ndarray], numpy.ndarray]
) -> IntervalEstimate:
    """Return a function of two means with a 95 % interval, from sums over stretches of measurements.

    Args:
        sums: sums over each stretch, ``(stretches, 2)``.
        counts: number of measurements in each stretch; a stretch without any is left out.
        function: function of means ``(n, 2)``.
    """
    sums = sums[counts > 0]
    if not len(sums):
        return UNKNOWN
    if len(sums) < 2:
        return IntervalEstimate(float(function(sums)[0]), math.nan, math.nan)
    bootstrap = Bootstrap(len(sums))
    return bootstrap.interval(function(bootstrap.means(sums)))


class LikelihoodSums(NamedTuple):
    """Log-likelihoods of one competitor, summed over each stretch of measurements."""

    sums: numpy.ndarray
    counts: numpy.ndarray
    """Number of measurements in each stretch."""
    known: int
    """Checksum of the mask of measurements with a log-likelihood."""

    @property
    def mean(self) -> float:
        """Mean log-likelihood of a measurement."""
        return float(self.sums.sum() / self.counts.sum())


def likelihood_sums(run: "xarray.Dataset") -> LikelihoodSums | None:
    """Sum one competitor's log-likelihoods over stretches of measurements; None if it reports none."""
    if "log_likelihood" not in run:
        return None
    values = run["log_likelihood"].values
    there = numpy.isfinite(values)
    if not there.any():
        return None
    number = stretches_of(numpy.ones(values.shape, dtype=bool))
    count = int(number.max()) + 1
    sums = numpy.bincount(number[there], values[there], minlength=count)
    counts = numpy.bincount(number[there], minlength=count)
    return LikelihoodSums(sums, counts, zlib.crc32(numpy.packbits(there).tobytes()))


def likelihood_differences(sums_by_name: Mapping[str, LikelihoodSums]) -> dict[str, IntervalEstimate]:
    """Return each competitor's mean log-likelihood of a measurement minus the best one's, by name.

    The interval is paired; there is none if the two have log-likelihoods of different measurements.
    """
    if not sums_by_name:
        return {}
    best = max(sums_by_name.values(), key=lambda one: one.mean)
    differences = {}
    for name, one in sums_by_name.items():
        if one.known == best.known:
            sums = numpy.stack([one.sums - best.sums, best.counts], axis=1)
            differences[name] = interval_of_sums(sums, best.counts, ratio)
        else:
            differences[name] = IntervalEstimate(one.mean - best.mean, math.nan, math.nan)
    return differences
