"""Statistics over the episodes of one competitor, declared one by one and computed block by block of episodes.

A :class:`Statistic` declares the contribution of an episode and the function of all contributions;
:func:`reduce_run` reduces some episodes to a :class:`Reduction`; reductions are merged in the order of the
episodes.
"""

import functools
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from .bootstrap import Bootstrap, block_of, mean_of_sums
from .time_blocks import BlockBootstrap, TimeUnits

if TYPE_CHECKING:
    import xarray

ALL = sys.maxsize
"""Value of ``sample`` for all episodes."""
COLUMNS = 512
"""Approximate number of columns in one matrix product: large enough to be fast, small enough for the memory."""

Key = tuple[str, ...]
Function = Callable[[numpy.ndarray], Any]


def identity(values: numpy.ndarray) -> numpy.ndarray:
    """Return the array unchanged."""
    return values


class Statistic(NamedTuple):
    """Declaration of a statistic: a contribution of each episode, and a function of their means or of a
    sample.
    """

    key: Key
    values: numpy.ndarray
    """Contributions, ``(episodes, ...)``."""
    function: Function = identity
    """Function from the means, ``(1 + resamples, ...)``, or the sample, ``(episodes, ...)``, to the statistic."""
    resamples: int | None = None
    """Number of bootstrap resamples; None: those of the bootstrap."""
    sample: int = 0
    """Number of first episodes whose values are stored instead of a mean; zero: the mean is computed."""
    optional: bool = False
    """Whether blocks without this statistic are left out of the mean; otherwise one such block removes the statistic.
    """
    of_units: Callable[[TimeUnits], numpy.ndarray] | None = None
    """Contribution of each unit of time where one episode is resampled over time, ``(units, ...)``: that of an episode,
    or for a mean the sum and the number of terms; None: it is one number of the whole episode."""


class Reduction(NamedTuple):
    """Sums and samples of one competitor's statistics over some episodes, which can be merged."""

    functions: dict[Key, Function]
    sums: dict[Key, numpy.ndarray]
    """Weighted sums, from :meth:`.bootstrap.Bootstrap.sums`."""
    samples: dict[Key, list[numpy.ndarray]]
    """Samples, ``(episodes, ...)``, each as a list of arrays."""
    optional: set[Key]
    of_units: dict[Key, numpy.ndarray]
    """Contributions of the units of time of one episode, for statistics that can be resampled over time."""
    known: dict[Key, Any]
    """Values of the statistics of one episode that cannot be resampled over time."""

    def merge(self, later: "Reduction") -> "Reduction":
        """Return these sums and samples with those of the next episodes added."""
        optional = self.optional | later.optional
        sums = {key: own for key, own in (self.sums | later.sums).items() if key in optional}
        sums |= {key: own + later.sums[key] for key, own in self.sums.items() if key in later.sums}
        samples = {k: own + later.samples[k] for k, own in self.samples.items() if k in later.samples}
        return Reduction(self.functions | later.functions, sums, samples, optional, {}, {})

    def results(self, blocks: BlockBootstrap | None = None) -> dict[Key, Any]:
        """Return the value of each statistic by key; call it once, since it empties the samples."""
        found = {}
        for key, function in self.functions.items():
            if key in self.known:
                found[key] = self.known[key]
            elif key in self.sums:
                found[key] = function(mean_of_sums(self.sums[key]))
            elif key in self.samples:
                values = numpy.concatenate(self.samples[key])
                self.samples[key].clear()  # so that memory does not contain them twice
                if blocks is not None and key in self.of_units:
                    values = blocks.resample(values, self.of_units[key])
                found[key] = function(values)
        return found


def reduce_run(
    run: "xarray.Dataset",
    declare: "Callable[[xarray.Dataset], Iterable[Statistic]]",
    bootstrap: Bootstrap | TimeUnits,
    first: int = 0,
) -> Reduction:
    """Reduce some episodes of one competitor to the sums and samples of declared statistics."""
    block = block_of(run.sizes["time"])
    parts = (
        _reduce_block(declare(run.isel(episode=slice(i, i + block))), bootstrap, first + i)
        for i in range(0, run.sizes["episode"], block)
    )
    return functools.reduce(Reduction.merge, parts)


def _reduce_block(statistics: Iterable[Statistic], bootstrap: Bootstrap | TimeUnits, first: int) -> Reduction:
    found = Reduction({}, {}, {}, set(), {}, {})
    columns = 0

    def means() -> Iterator[Statistic]:
        for s in statistics:
            found.functions[s.key] = s.function
            found.optional.update([s.key] * s.optional)
            if s.sample:
                found.samples[s.key] = [s.values[: max(0, s.sample - first)].copy()]
            elif isinstance(bootstrap, Bootstrap):
                yield s
            elif s.of_units is not None:
                found.samples[s.key], found.of_units[s.key] = [s.values], s.of_units(bootstrap)
            else:  # at once, since it may contain every measurement
                found.known[s.key] = s.function(s.values)

    def product(s: Statistic) -> tuple[int | None, int]:
        """Return a key that is equal for statistics computed in one matrix product."""
        nonlocal columns
        columns += s.values[0].size
        return s.resamples, columns // COLUMNS

    for (resamples, _), group in itertools.groupby(means(), product):
        assert isinstance(bootstrap, Bootstrap)
        together = list(group)
        sums = bootstrap.sums([s.values for s in together], first, resamples)
        found.sums.update(zip((s.key for s in together), sums, strict=True))
    return found
