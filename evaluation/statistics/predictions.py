"""How well measurements of a recording were predicted, with intervals that one recording has, too.

Neighbouring measurements are not independent: intervals come from resampling whole stretches of them.
"""

import math
from collections.abc import Callable

import numpy

from .bootstrap import Bootstrap, IntervalEstimate, ratio

STRETCHES = 30
"""Into which measurements are cut for intervals, at most; a stretch has at least ``SHORTEST_STRETCH``."""
SHORTEST_STRETCH = 8
UNKNOWN = IntervalEstimate(math.nan, math.nan, math.nan)


def correlation(errors: numpy.ndarray, mask: numpy.ndarray) -> IntervalEstimate:
    """Correlation of successive prediction errors; zero where they are white.

    Args:
        errors: ``(m, episodes, time)``.
        mask: of the measurements, ``(episodes, time)``.
    """
    before = numpy.roll(errors, 1, axis=2)
    before[:, :, 0] = math.nan
    values = numpy.stack([(errors * before).sum(axis=0), 0.5 * (errors**2 + before**2).sum(axis=0)], axis=-1)
    return stretch_interval(mask, values, ratio)


def stretch_interval(
    mask: numpy.ndarray, values: numpy.ndarray, function: Callable[[numpy.ndarray], numpy.ndarray]
) -> IntervalEstimate:
    """Value and 95 % interval of a function of two means over measurements, by resampling stretches of them.

    Args:
        mask: of the measurements, ``(episodes, time)``.
        values: ``(episodes, time, 2)``; a measurement with a NaN is left out.
        function: of means ``(n, 2)``.
    """
    there = mask & numpy.isfinite(values).all(axis=-1)
    stretch = stretches_of(mask)
    number, count = stretch[there], int(stretch.max()) + 1
    sums = numpy.stack(
        [numpy.bincount(number, values[there][:, i], minlength=count) for i in range(2)], axis=1
    )
    return interval_of_sums(sums, numpy.bincount(number, minlength=count), function)


def stretches_of(mask: numpy.ndarray) -> numpy.ndarray:
    """Return the number of the stretch of each measurement of a mask, and -1 of the others, ``(episodes, time)``."""
    total = int(mask.sum())
    stretch = numpy.full(mask.shape, -1, dtype=numpy.int16)
    stretch[mask] = numpy.arange(total) // max(SHORTEST_STRETCH, -(-total // STRETCHES))
    return stretch


def interval_of_sums(
    sums: numpy.ndarray, counts: numpy.ndarray, function: Callable[[numpy.ndarray], numpy.ndarray]
) -> IntervalEstimate:
    """Value and 95 % interval of a function of two means, by resampling stretches.

    Args:
        sums: over each stretch, ``(stretches, 2)``.
        counts: measurements that were added up in each; a stretch without any is left out.
        function: of means ``(n, 2)``.
    """
    sums = sums[counts > 0]
    if not len(sums):
        return UNKNOWN
    if len(sums) < 2:
        return IntervalEstimate(float(function(sums)[0]), math.nan, math.nan)
    bootstrap = Bootstrap(len(sums))
    return bootstrap.interval(function(bootstrap.means(sums)))
