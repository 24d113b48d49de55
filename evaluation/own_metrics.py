"""Metrics of an environment, beside those of every one, from as many episodes as there are.

They come in two steps, so that no more than a block of episodes need be in memory: what they need of each episode, a
few numbers of it or what is only averaged over the episodes; and what follows from that of all of them.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy
import xarray

from .bootstrap import Bootstrap, Sums, added, mean_of_sums
from .metrics import Measure, in_blocks

Arrays = Mapping[str, numpy.ndarray]


class Gathered(NamedTuple):
    """What the metrics of an environment need of episodes of one competitor; empty where there is nothing to tell."""

    each: Arrays = {}  # noqa: RUF012  (nobody writes to it)
    """Numbers of every episode, ``(episodes, ...)``: all of them are kept, so let them be few."""
    averaged: Arrays = {}  # noqa: RUF012
    """Of one episode each, ``(episodes, ...)``; of all of them means, ``(1 + resamples, ...)``."""
    common: Arrays = {}  # noqa: RUF012
    """The same in every episode."""


class Taken(NamedTuple):
    """What was gathered of some episodes, to be added to."""

    each: dict[str, list[numpy.ndarray]]
    sums: dict[str, Sums]
    common: dict[str, numpy.ndarray]

    def and_of(self, later: "Taken") -> "Taken":
        """Add the episodes that come next; what these have not is known of none."""
        return Taken(
            {key: own + later.each[key] for key, own in self.each.items() if key in later.each},
            {key: added(own, later.sums[key]) for key, own in self.sums.items() if key in later.sums},
            {key: own for key, own in self.common.items() if key in later.common},
        )

    def gathered(self) -> Gathered:
        """Return what all episodes come to."""
        return Gathered(
            {key: numpy.concatenate(parts) for key, parts in self.each.items()},
            {key: mean_of_sums(sums) for key, sums in self.sums.items()},
            self.common,
        )


@dataclass(frozen=True)
class OwnMetrics:
    """The metrics of an environment."""

    gather: Callable[[xarray.Dataset], Gathered]
    """From one policy's part of some episodes of an evaluation to what is needed of each."""
    measures: Callable[[Gathered, Bootstrap, xarray.Dataset], list[Measure]]
    """From what was gathered of all episodes, and the evaluation, of whose variables none is needed."""

    def take(self, run: xarray.Dataset, bootstrap: Bootstrap, first: int = 0) -> Taken:
        """Gather from some episodes of one competitor.

        Args:
            run: one policy's part of an evaluation.
            bootstrap: over the episodes of the whole evaluation.
            first: number of the run's first episode among them; a multiple of :func:`.bootstrap.block_of`.
        """
        parts = (self._taken(part, bootstrap, first + i) for i, part in in_blocks(run))
        return functools.reduce(Taken.and_of, parts)

    def _taken(self, run: xarray.Dataset, bootstrap: Bootstrap, first: int) -> Taken:
        each, averaged, common = self.gather(run)
        sums = {key: bootstrap.sums(values, first) for key, values in averaged.items()}
        return Taken({key: [values] for key, values in each.items()}, sums, dict(common))

    def __call__(self, run: xarray.Dataset, bootstrap: Bootstrap) -> list[Measure]:
        """Return the measures of one competitor.

        Args:
            run: one policy's part of an evaluation, all of its episodes.
            bootstrap: over them.
        """
        return self.measures(self.take(run, bootstrap).gathered(), bootstrap, run)
