"""Cost and consistency of a competitor split by cause, such as turns, the start or outliers.

Causes are those that the environment declares (:mod:`.contract.causes`), the start of the track, and ``other``
for all other measurements. Several may hold together, so shares need not add up to one. Comparisons are
paired.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy

from ...envs.contract.causes import RESERVED
from .bootstrap import Bootstrap, IntervalEstimate, ratio
from .time_blocks import TimeUnits

if TYPE_CHECKING:
    import xarray

EVERYTHING, START, OTHER = RESERVED
"""Name for all measurements in place of a cause, and names of the causes that every evaluation adds."""
CAUSE_METRICS = "cause_"
"""Prefix of the names of metrics by cause."""
VARIABLE = "causes"
"""Name of the dataset variable with the active causes as a bit field, see :func:`.contract.causes.cause_number`."""
COUNT, COST, NEES, JUDGED = range(4)
"""Columns of the sums over the measurements under a cause: their number, cost, NEES over its dimension, number with a
NEES.
"""


class CauseMeasure(NamedTuple):
    """A statistic of one competitor over the measurements under one cause."""

    metric: str
    cause: str
    estimate: IntervalEstimate
    opponent: str = ""
    """Name of the competitor with which it is compared; empty without comparison."""


class CauseCosts(NamedTuple):
    """Mean cost of a measurement under each cause, in the data and in every bootstrap resample."""

    names: list[str]
    """Names of the causes that occur; the first is ``EVERYTHING``."""
    means: numpy.ndarray
    """Mean costs, ``(1 + resamples, causes)``."""

    def of(self, cause: str) -> numpy.ndarray:
        """Return the mean costs under one cause, ``(1 + resamples,)``."""
        found: numpy.ndarray = self.means[:, self.names.index(cause)]
        return found


def phrases_of(dataset: "xarray.Dataset") -> dict[str, str]:
    """Return a phrase for tables for each cause of an evaluation, by name; empty without causes."""
    if "cause" not in dataset.coords:
        return {}
    declared = zip(dataset["cause"].values.tolist(), dataset["cause_phrase"].values.tolist(), strict=True)
    first = f"in the first {int(dataset['start_measurements'])} measurements"
    return {**dict(declared), START: first, OTHER: "where none of the causes holds"}


def active_causes(run: "xarray.Dataset") -> Iterator[tuple[str, numpy.ndarray]]:
    """Yield the name of each cause and the measurements at which it is active, booleans ``(episodes, time)``."""
    numbers = numpy.nan_to_num(run[VARIABLE].values).astype(numpy.int64)
    yield EVERYTHING, numpy.ones(numbers.shape, dtype=bool)
    early = run["time"].values <= int(run["start_measurements"])
    start = numpy.broadcast_to(early, numbers.shape)
    for place, name in enumerate(run["cause"].values.tolist()):
        yield name, (numbers >> place) & 1 > 0
    yield START, start
    yield OTHER, (numbers == 0) & ~start


def cause_sums(
    run: "xarray.Dataset", nees: numpy.ndarray | None, units: TimeUnits | None = None
) -> numpy.ndarray:
    """Sum costs and NEES, and count them, under each cause over every episode or unit of time.

    Args:
        run: one competitor's part of some episodes.
        nees: NEES over its dimension, ``(episodes, time)``, NaN where there is none; None without NEES.
        units: units of time of one episode, in place of episodes.

    Returns:
        ``(episodes, causes, 4)``, in the order of :func:`active_causes`.
    """
    cost = run["cost"].values
    known = ~numpy.isnan(cost)
    judged = numpy.zeros(cost.shape, dtype=bool) if nees is None else ~numpy.isnan(nees)
    values = numpy.stack([known, numpy.where(known, cost, 0.0), numpy.zeros(cost.shape), judged])
    if nees is not None:
        values[NEES] = numpy.where(judged, nees, 0.0)
    holding = (held for _, held in active_causes(run))
    if units is not None:
        values, holding = units.cut(values[:, 0]), (units.cut(held)[0] for held in holding)
    return numpy.stack([numpy.einsum("set,et->es", values, held) for held in holding], axis=1, dtype=float)


def split_by_cause(
    sums: numpy.ndarray, run: "xarray.Dataset", bootstrap: Bootstrap
) -> tuple[list[CauseMeasure], CauseCosts]:
    """Compute statistics such as share of the cost, mean cost and ANEES under each cause that occurs.

    Args:
        sums: means over the episodes of :func:`cause_sums`, ``(1 + resamples, causes, 4)``.
        run: the competitor's part of an evaluation, of which only coordinates and attributes are needed.
        bootstrap: bootstrap over the episodes.

    Returns:
        For every cause ``cause_measurement_share``, ``cause_cost_share``, ``cause_cost`` (mean cost of a measurement)
        and ``cause_anees`` (mean NEES over its dimension), with intervals; and the costs, for comparisons.
    """
    names = [EVERYTHING, *run["cause"].values.tolist(), START, OTHER]
    measures, present, costs = [], [], []
    for name, own in zip(names, numpy.moveaxis(sums, 1, 0), strict=True):
        if own[0, COUNT] <= 0.0:
            continue
        found = {
            "cause_measurement_share": (own[:, COUNT], sums[:, 0, COUNT]),
            "cause_cost_share": (own[:, COST], sums[:, 0, COST]),
            "cause_cost": (own[:, COST], own[:, COUNT]),
            "cause_anees": (own[:, NEES], own[:, JUDGED]),
        }
        ratios = {metric: ratio(numpy.stack(both, axis=1)) for metric, both in found.items()}
        measures += [CauseMeasure(metric, name, bootstrap.interval(each)) for metric, each in ratios.items()]
        present.append(name)
        costs.append(ratios["cause_cost"])
    return measures, CauseCosts(present, numpy.stack(costs, axis=1))


def reason_weight(cost_share: numpy.ndarray, measurement_share: numpy.ndarray) -> numpy.ndarray:
    """Return weights that order causes: share of the cost times log of the relative mean cost.

    A large cost in few measurements has the largest weight.
    """
    some = (cost_share > 0.0) & (measurement_share > 0.0)
    dearer = numpy.divide(cost_share, measurement_share, out=numpy.ones_like(cost_share), where=some)
    return numpy.where(some, cost_share, 0.0) * numpy.log(dearer)


def opponent_of(name: str, costs: Mapping[str, float], ranked: Sequence[str]) -> str:
    """Return the competitor of lowest cost among the others, a ranked one if there is any; empty without
    others.
    """
    others = [other for other in costs if other != name]
    return min([other for other in others if other in ranked] or others, key=costs.__getitem__, default="")


def compare_by_cause(
    costs: CauseCosts, opponent_costs: CauseCosts, opponent: str, bootstrap: Bootstrap
) -> Iterator[CauseMeasure]:
    """Yield the paired ratio of a competitor's mean cost to its opponent's, for each cause that both have."""
    for name in costs.names:
        if name in opponent_costs.names:
            both = numpy.stack([costs.of(name), opponent_costs.of(name)], axis=1)
            yield CauseMeasure("cause_cost_ratio", name, bootstrap.interval(ratio(both)), opponent)
