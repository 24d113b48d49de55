"""Intervals of one episode: blocks of successive measurements are resampled, as there are no other episodes.

A circular block bootstrap (Politis and Romano: A circular block-resampling procedure for stationary data, in LePage and
Billard, Exploring the Limits of Bootstrap, 1992): a resample is made of blocks that begin anywhere, the last of which
go on at the start, until they are as long as the episode. The length of the blocks follows from the autocorrelation
(Politis and White: Automatic block-length selection for the dependent bootstrap, Econometric Reviews 23, 2004, with the
correction of Patton, Politis and White, Econometric Reviews 28, 2009). It supposes that what is averaged is stationary.
Of long episodes blocks begin at every unit of a few measurements, whose sums are all that is kept of the episode.
"""

import math
from collections.abc import Callable

import numpy

from .bootstrap import RESAMPLES, Bootstrap, ratio

UNITS = 2048
"""Places of an episode at which a block may begin, at most."""
FEWEST = 16
"""Measurements of an episode of which there is an interval."""


class BlockBootstrap(Bootstrap):
    """Resampling of blocks of successive measurements of one episode; the rows of :meth:`sums` are its units.

    Args:
        series: of the episode, ``(series, time)``; the one whose blocks are to be longest decides. NaN: not known.
        resamples: number of bootstrap samples.
        seed: of the resampling.

    Attributes:
        unit: measurements of a unit.
        units: of the episode; the last one may be shorter.
        block: measurements of a block, a multiple of the unit.
    """

    def __init__(self, series: numpy.ndarray, resamples: int = RESAMPLES, seed: int = 0) -> None:
        super().__init__(1, 0)
        times = series.shape[1]
        self.unit: int = -(-times // UNITS)
        self.units: int = -(-times // self.unit)
        known = ~numpy.isnan(series)
        sums, present = (self.cut(each).sum(axis=-1) for each in (numpy.where(known, series, 0.0), known))
        means = numpy.divide(sums, present, out=numpy.full(sums.shape, math.nan), where=present > 0.0)
        length = max(map(block_length, means))
        self.block: int = length * self.unit
        generator = numpy.random.default_rng(seed)
        begins = generator.integers(self.units, size=(resamples, -(-self.units // length)))
        self._counts = numpy.ones((1 + resamples, self.units), dtype=numpy.int64)
        for counts, own in zip(self._counts[1:], begins, strict=True):
            ends = numpy.bincount(own + length, minlength=2 * self.units)
            twice = numpy.cumsum(numpy.bincount(own, minlength=2 * self.units) - ends[: 2 * self.units])
            counts[:] = twice[: self.units] + twice[self.units :]
        self.totals: numpy.ndarray = self._counts.sum(axis=1)

    def cut(self, values: numpy.ndarray) -> numpy.ndarray:
        """Cut values ``(n, time)`` into units, ``(n, units, unit)``; zero beyond the end."""
        beyond = self.units * self.unit - values.shape[1]
        return numpy.pad(values, [(0, 0), (0, beyond)]).reshape(len(values), self.units, self.unit)

    def sums_of_present(self, values: numpy.ndarray, times: slice = slice(None)) -> numpy.ndarray:
        """Sum of every unit, and how many numbers there are, ``(units, 2)``.

        Args:
            values: ``(1, time)``; NaN stands for no measurement, or no event.
            times: those that count.
        """
        within = numpy.zeros(values.shape, dtype=bool)
        within[:, times] = True
        within &= ~numpy.isnan(values)
        both = numpy.stack([numpy.where(within, values, 0.0)[0], within[0]])
        return self.cut(both).sum(axis=-1).T

    def resample(
        self, values: numpy.ndarray, of_units: "Callable[[BlockBootstrap], numpy.ndarray] | None"
    ) -> numpy.ndarray:
        """Mean over the episode and over every resample of its blocks, ``(1 + resamples, ...)``.

        Args:
            values: of the episode, ``(1, ...)``, which are returned alone where they have no units.
            of_units: what each unit contributes, as :attr:`.statistic.Statistic.of_units` has it.
        """
        if of_units is None:
            return values
        (means,) = self.sums([of_units(self)])
        found = means[:, 0] if values.ndim > 1 else ratio(means[:, 0])
        found[0] = values[0]
        return found

    def means_of(self, values: Callable[[slice], numpy.ndarray]) -> numpy.ndarray:
        """Values of the episode, as their means; NaN in every resample."""
        own = values(slice(0, 1))
        return numpy.concatenate([own, numpy.full((len(self._counts) - 1, *own.shape[1:]), math.nan)])

    def quantiles(
        self, values: numpy.ndarray, share: float = 0.5, chosen: numpy.ndarray | None = None
    ) -> numpy.ndarray:
        """Value of the episode, as any quantile; NaN in every resample."""
        return self.means(values if chosen is None else numpy.where(chosen, values, math.nan))

    @property
    def sentence(self) -> str:
        """What the intervals are."""
        return (
            "Of one episode intervals are over time: those of a circular block bootstrap (Politis and Romano, 1992) of "
            f"blocks of {self.block:,} measurements, by the rule of Politis and White (2004) from the autocorrelation; "
            "what is one number of the whole episode has none."
        )


def block_length(series: numpy.ndarray) -> int:
    """Length of the blocks of a circular block bootstrap of the mean, by the rule of Politis and White.

    Args:
        series: ``(n,)``; NaN, which is not known, adds nothing to an autocovariance.
    """
    n, known = len(series), ~numpy.isnan(series)
    centred = numpy.where(known, series - (series[known].mean() if known.any() else 0.0), 0.0)
    quiet = max(5, math.ceil(math.sqrt(math.log10(n))))
    most = min(n - 1, math.ceil(math.sqrt(n)) + quiet)
    size = 1 << (2 * n - 1).bit_length()
    covariance = numpy.fft.irfft(numpy.abs(numpy.fft.rfft(centred, size)) ** 2, size)[: most + 1] / n
    if covariance[0] <= 0.0:
        return 1
    # Lags after which so many autocorrelations in a row are no larger than noise.
    large = numpy.abs(covariance[1:]) >= 2.0 * math.sqrt(math.log10(n) / n) * covariance[0]
    runs = numpy.convolve(large, numpy.ones(quiet), "valid") if len(large) >= quiet else numpy.ones(1)
    last = int(runs.argmin()) if runs.min() < 0.5 else int(numpy.flatnonzero(large).max(initial=0)) + 1
    lags = min(2 * max(last, 1), most)
    k = numpy.arange(1, lags + 1)
    taper = numpy.minimum(1.0, 2.0 * (1.0 - k / lags)) * covariance[1 : lags + 1]
    slope, spectrum = 2.0 * (k * taper).sum(), covariance[0] + 2.0 * taper.sum()
    if (
        spectrum <= 0.0
    ):  # as of what alternates: a mean of any block varies less than one of as many independent ones
        return 1
    length = (1.5 * (slope / spectrum) ** 2 * n) ** (1.0 / 3.0)
    return int(min(max(1, math.ceil(length)), math.ceil(min(3.0 * math.sqrt(n), n / 3.0))))
