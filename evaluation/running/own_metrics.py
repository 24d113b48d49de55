"""Metrics of an environment, beside those of every one, from as many episodes as there are.

They come in two steps, so that no more than a block of episodes need be in memory: what they need of each episode, a
few numbers of it or what is only averaged over the episodes; and what follows from that of all of them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ..statistics.bootstrap import Bootstrap, IntervalEstimate
from ..statistics.statistic import ALL, Key, Statistic

if TYPE_CHECKING:
    import xarray

Arrays = Mapping[str, numpy.ndarray]


class Measure(NamedTuple):
    """A record before it is told whose it is; what an environment's own metrics return."""

    metric: str
    component: str
    window: str
    estimate: IntervalEstimate
    unit: str


class MetricInputs(NamedTuple):
    """What the metrics of an environment need of episodes of one competitor; empty where there is nothing to tell."""

    each: Arrays = {}  # noqa: RUF012  (nobody writes to it)
    """Numbers of every episode, ``(episodes, ...)``: all of them are kept, so let them be few."""
    averaged: Arrays = {}  # noqa: RUF012
    """Of one episode each, ``(episodes, ...)``; of all of them means, ``(1 + resamples, ...)``."""
    common: Arrays = {}  # noqa: RUF012
    """The same in every episode."""


@dataclass(frozen=True)
class OwnMetrics:
    """The metrics of an environment."""

    gather: "Callable[[xarray.Dataset], MetricInputs]"
    """From one policy's part of some episodes of an evaluation to what is needed of each."""
    measures: "Callable[[MetricInputs, Bootstrap, xarray.Dataset], list[Measure]]"
    """From what was gathered of all episodes, and the evaluation, of whose variables none is needed."""

    def statistics(self, run: "xarray.Dataset") -> Iterator[Statistic]:
        """Declare what was gathered.

        Args:
            run: some episodes of one competitor.
        """
        each, averaged, common = self.gather(run)
        for key, values in averaged.items():
            yield Statistic(("averaged", key), values)
        for key, values in each.items():
            yield Statistic(("each", key), values, sample=ALL)
        for key, values in common.items():
            yield Statistic(("common", key), values[None], itemgetter(0), sample=1)

    def measures_of(
        self, results: Mapping[Key, Any], bootstrap: Bootstrap, evaluation: "xarray.Dataset"
    ) -> list[Measure]:
        """Return the measures of one competitor.

        Args:
            results: of :meth:`statistics` of all episodes.
            bootstrap: over them.
            evaluation: its part of the evaluation, of whose variables none is needed.
        """
        gathered = MetricInputs(
            *({key[1]: results[key] for key in results if key[0] == f} for f in MetricInputs._fields)
        )
        return self.measures(gathered, bootstrap, evaluation)
