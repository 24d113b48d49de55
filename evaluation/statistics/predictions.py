"""How well measurements of a recording were predicted, with intervals that one recording has, too.

Neighbouring measurements are not independent: intervals come from resampling whole stretches of them.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy

from ...envs.contract.task import Task
from .bootstrap import Bootstrap, IntervalEstimate, ratio

if TYPE_CHECKING:
    import xarray

STRETCHES = 30
"""Into which measurements are cut for intervals, at most; a stretch has at least ``SHORTEST_STRETCH``."""
SHORTEST_STRETCH = 8
UNKNOWN = IntervalEstimate(math.nan, math.nan, math.nan)


class Predictions:
    """Predictions and estimates of all competitors on a recording.

    Args:
        dataset: of an evaluation; for predicted measurements with tracks, see :mod:`.innovations`.
        task: of the recording.
    """

    def __init__(self, dataset: "xarray.Dataset", task: Task) -> None:
        self.dataset, self.task = dataset, task
        self.names = [str(name) for name in dataset["policy"].values]
        self.shape = dataset.sizes["episode"], dataset.sizes["time"]
        self.has_truth = bool(dataset.attrs["truth"])

    def log_likelihood(self, name: str) -> numpy.ndarray:
        """Of every measurement, ``(episodes, time)``, nats; NaN where it is not known."""
        if "log_likelihood" not in self.dataset:
            return numpy.full(self.shape, math.nan)
        found: numpy.ndarray = self.dataset["log_likelihood"].sel(policy=name).values
        return found

    def squared_error(self, name: str) -> numpy.ndarray:
        """Squared error of the first group of components, ``(episodes, time)``."""
        groups = self.task.groups
        parts = list(next(iter(groups.values()))) if groups else [self.task.components[0].name]
        error = self.dataset["error"].sel(policy=name, component=parts)
        found: numpy.ndarray = (error**2).sum("component", skipna=False).values
        return found

    def prediction_error(self, name: str) -> numpy.ndarray | None:
        """Measured less predicted, ``(m, episodes, time)``, of the first group of what is measured; None without."""
        if "prediction_error" not in self.dataset:
            return None
        groups = self.dataset["measured_group"].values
        values = self.dataset["prediction_error"].sel(policy=name).values[..., groups == groups[0]]
        found: numpy.ndarray = numpy.moveaxis(values, -1, 0)
        return found

    def correlations(self, name: str, mask: numpy.ndarray) -> dict[str, IntervalEstimate]:
        """Correlation of the successive prediction errors of each number that is measured, each received one with the
        last received before; empty where all are of one group.

        Args:
            name: of a competitor.
            mask: of the measurements, ``(episodes, time)``.
        """
        if "prediction_error" not in self.dataset or len({*self.dataset["measured_group"].values}) < 2:
            return {}
        values = self.dataset["prediction_error"].sel(policy=name).values
        found = {}
        for number, errors in zip(
            self.dataset["measured"].values, numpy.moveaxis(values, -1, 0), strict=True
        ):
            before = _last_before(errors)
            pairs = numpy.stack([errors * before, 0.5 * (errors**2 + before**2)], axis=-1)
            found[str(number)] = stretch_interval(mask, pairs, ratio)
        return found

    def nis(self, name: str, mask: numpy.ndarray) -> float:
        """Mean normalised innovation squared of some measurements over its dimension; NaN where it is not known."""
        if "nis" not in self.dataset:
            return math.nan
        nis, degrees = (self.dataset[key].sel(policy=name).values for key in ("nis", "nis_degrees"))
        there = mask & (degrees > 0.0) & numpy.isfinite(nis)
        return float(nis[there].sum() / degrees[there].sum()) if there.any() else math.nan

    def difference(self, name: str, other: str, mask: numpy.ndarray | None = None) -> IntervalEstimate:
        """Mean difference of log-likelihoods per measurement, paired.

        Args:
            name: of a competitor.
            other: that it is compared with.
            mask: of the measurements, ``(episodes, time)``; default: all.
        """
        values = self.log_likelihood(name) - self.log_likelihood(other)
        chosen = numpy.ones(self.shape, dtype=bool) if mask is None else mask
        return stretch_interval(chosen, numpy.stack([values, numpy.ones_like(values)], axis=-1), ratio)


def mean_of(values: numpy.ndarray, mask: numpy.ndarray) -> float:
    """Mean of what is finite and in a mask; NaN where nothing is."""
    there = mask & numpy.isfinite(values)
    return float(values[there].mean()) if there.any() else math.nan


def relative_error(squares: numpy.ndarray, others: numpy.ndarray, mask: numpy.ndarray) -> IntervalEstimate:
    """Root mean square over that of another, less one, paired.

    Args:
        squares: squared errors, ``(episodes, time)``.
        others: of the other.
        mask: of the measurements, likewise.
    """
    return stretch_interval(
        mask, numpy.stack([squares, others], axis=-1), lambda means: numpy.sqrt(ratio(means)) - 1.0
    )


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


def _last_before(errors: numpy.ndarray) -> numpy.ndarray:
    """Of each error ``(episodes, time)`` the last finite one before it; NaN where there is none."""
    times = numpy.arange(errors.shape[1])
    last = numpy.maximum.accumulate(numpy.where(numpy.isfinite(errors), times, -1), axis=1)
    last = numpy.concatenate([numpy.full((len(errors), 1), -1), last[:, :-1]], axis=1)
    return numpy.where(last >= 0, numpy.take_along_axis(errors, numpy.maximum(last, 0), axis=1), math.nan)


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
