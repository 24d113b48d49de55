"""Metrics that one environment adds to those of all environments, computed block by block of episodes.

The first step gathers a few numbers of each episode, or arrays to be averaged over episodes; the second
computes the metrics from those of all episodes.
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
    """A record without its competitor: metric, component, window, value with interval, and unit."""

    metric: str
    component: str
    window: str
    estimate: IntervalEstimate
    unit: str


class MetricInputs(NamedTuple):
    """Inputs of an environment's metrics, gathered from episodes of one competitor."""

    each: Arrays = {}  # noqa: RUF012  (never written to)
    """Numbers of every episode, ``(episodes, ...)``: all are stored, so they should be few."""
    averaged: Arrays = {}  # noqa: RUF012
    """Arrays of each episode, ``(episodes, ...)``; for all episodes their means, ``(1 + resamples, ...)``."""
    common: Arrays = {}  # noqa: RUF012
    """Arrays that are the same in every episode."""


@dataclass(frozen=True)
class OwnMetrics:
    """The two functions that compute an environment's own metrics: gather inputs, then compute."""

    gather: "Callable[[xarray.Dataset], MetricInputs]"
    """Function from one competitor's part of some episodes of an evaluation to the inputs."""
    measures: "Callable[[MetricInputs, Bootstrap, xarray.Dataset], list[Measure]]"
    """Function from the inputs of all episodes, and the evaluation's coordinates and attributes, to the measures."""

    def statistics(self, run: "xarray.Dataset") -> Iterator[Statistic]:
        """Gather the metrics' inputs from some episodes of one competitor; yield them as declarations of
        statistics.
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
        """Return the environment's metrics of one competitor."""
        gathered = MetricInputs(
            *({key[1]: results[key] for key in results if key[0] == f} for f in MetricInputs._fields)
        )
        return self.measures(gathered, bootstrap, evaluation)
