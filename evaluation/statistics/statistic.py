"""Statistics of the episodes of one competitor: declared once, reduced block by block of episodes by one engine.

Records, curves and the metrics of an environment are made of means over episodes, of which every bootstrap resample has
its own, and of samples: values kept of every episode, as quantiles need them. A :class:`Statistic` declares what an
episode contributes and what follows from all of them; :func:`reduce_run` reduces some episodes to a :class:`Reduction`,
with one matrix product for all means of a block, and reductions are merged in the order of the episodes.
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
"""Sample of all episodes."""
COLUMNS = 512
"""Columns of one matrix product, about: enough to be fast, few enough to stay in memory."""

Key = tuple[str, ...]
Function = Callable[[numpy.ndarray], Any]


def identity(values: numpy.ndarray) -> numpy.ndarray:
    """Return the means, or the sample, as they are."""
    return values


class Statistic(NamedTuple):
    """A statistic before it is reduced: what each of some episodes contributes."""

    key: Key
    values: numpy.ndarray
    """``(episodes, ...)``."""
    function: Function = identity
    """From the means, ``(1 + resamples, ...)``, or from the sample, ``(episodes, ...)``, to the statistic."""
    resamples: int | None = None
    """Resamples that have a mean of their own; None: those of the bootstrap."""
    sample: int = 0
    """Number of the first episodes whose values are kept, in place of means of all; zero: means."""
    optional: bool = False
    """A block that lacks it adds nothing to its means; otherwise it is then known of no episode."""
    of_units: Callable[[TimeUnits], numpy.ndarray] | None = None
    """What each unit of time contributes where one episode is resampled over time, ``(units, ...)``: as an episode
    does, or of a mean its sum and how many numbers; None: it is one number of the whole episode."""


class Reduction(NamedTuple):
    """What some episodes of one competitor contribute to its statistics."""

    functions: dict[Key, Function]
    sums: dict[Key, numpy.ndarray]
    """As of :meth:`.bootstrap.Bootstrap.sums`."""
    samples: dict[Key, list[numpy.ndarray]]
    """``(episodes, ...)``, piece by piece."""
    optional: set[Key]
    of_units: dict[Key, numpy.ndarray]
    """Of one episode what its units of time contribute, where a statistic can be resampled over time."""
    known: dict[Key, Any]
    """Of one episode statistics that cannot."""

    def merge(self, later: "Reduction") -> "Reduction":
        """Add the episodes that come next."""
        optional = self.optional | later.optional
        sums = {key: own for key, own in (self.sums | later.sums).items() if key in optional}
        sums |= {key: own + later.sums[key] for key, own in self.sums.items() if key in later.sums}
        samples = {k: own + later.samples[k] for k, own in self.samples.items() if k in later.samples}
        return Reduction(self.functions | later.functions, sums, samples, optional, {}, {})

    def results(self, blocks: BlockBootstrap | None = None) -> dict[Key, Any]:
        """Return every statistic of all episodes; once, since samples are given away.

        Args:
            blocks: of one episode, over whose units it was reduced.
        """
        found = {}
        for key, function in self.functions.items():
            if key in self.known:
                found[key] = self.known[key]
            elif key in self.sums:
                found[key] = function(mean_of_sums(self.sums[key]))
            elif key in self.samples:
                values = numpy.concatenate(self.samples[key])
                self.samples[key].clear()  # so that little is held twice
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
    """Reduce some episodes of one competitor.

    Args:
        run: one policy's part of an evaluation.
        declare: from a block of its episodes to their statistics.
        bootstrap: over the episodes of the whole evaluation; of one episode its units of time.
        first: number of the run's first episode among them; a multiple of :func:`.bootstrap.block_of`.
    """
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
            else:  # at once, since it may hold every measurement
                found.known[s.key] = s.function(s.values)

    def product(s: Statistic) -> tuple[int | None, int]:
        """Tell the matrix products apart."""
        nonlocal columns
        columns += s.values[0].size
        return s.resamples, columns // COLUMNS

    for (resamples, _), group in itertools.groupby(means(), product):
        assert isinstance(bootstrap, Bootstrap)
        together = list(group)
        sums = bootstrap.sums([s.values for s in together], first, resamples)
        found.sums.update(zip((s.key for s in together), sums, strict=True))
    return found
