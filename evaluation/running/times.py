"""Processor times of competitors, as coordinates of an evaluation, and the Pareto front of cost and time.

The time of a measurement is that of the competitor up to its estimate, on one core, of many episodes side by side
(:func:`.rollout.measure_time`). It excludes the simulated world, tracing, compilation, and the computation of errors.
It differs from run to run, by as much as its rounds show (:func:`net_time`): an evaluation contains it only on request;
all other results have the same bits in every run.
"""

import math
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from ..competitors.kinds import RANKED

if TYPE_CHECKING:
    import xarray

COORDINATES = ("nanoseconds", "compiled", "nanoseconds_low", "nanoseconds_high")
"""Names of the coordinates over policy."""
METRIC = "nanoseconds"
"""Metric of the records with the time."""
IN_PYTHON, COMPILED, OWN = WAYS = ("python", "compiled", "own")
"""Components of these records; the coordinate ``compiled`` is 0, 1 or 2."""
PYTHON_MARK, OWN_MARK, FRONT_MARK = "py", "own", "*"
"""Marks in tables: times mostly of Python, times of a program alone, and competitors on the front."""
TIME_TITLE = "ns"
"""Title of the column of times."""
TIME_NOTE = (
    f"{TIME_TITLE} is the processor time of a competitor for a measurement on one core, without the simulated world. "
    "An asterisk marks the front, where no other ranked competitor has a lower error cost in as much time or less. "
    f"{PYTHON_MARK} marks competitors that run in Python, which takes most of their time."
)
OWN_NOTE = (
    f"{OWN_MARK} marks programs: the time of their own process with its messages, which is on no front."
)
LEAST_NANOSECONDS = 1.0
"""Least time of a competitor, ns: a difference of two measured times is no more precise."""
EQUAL_TIMES, EQUAL_NANOSECONDS = 1.1, 3.0
"""Ratio, and difference in ns, up to which two times count as equal: those from run to run."""


class ProcessorTime(NamedTuple):
    """Processor time of a competitor for one measurement on one core, without the simulated world."""

    nanoseconds: float
    """Time of a measurement of one of many episodes side by side, ns."""
    compiled: bool
    """Whether all code is native; otherwise the time is mostly that of the steps in Python."""
    own: bool = False
    """Whether it is the time of a program's own process, which includes the exchange of messages."""
    low: float = math.nan
    """Shortest time that the rounds of the measurement allow, ns; NaN: unknown."""
    high: float = math.nan
    """Longest of these times, ns; NaN: unknown."""

    @property
    def is_certain(self) -> bool:
        """Whether the times that the rounds allow count as equal."""
        return not self.high > longest_equal(self.low)


def net_time(together: Sequence[float], world: Sequence[float], compiled: bool) -> ProcessorTime:
    """Return the time of a competitor alone, at least :data:`LEAST_NANOSECONDS`, from several rounds.

    Other processes only add time, also to processor time, since they use the same cache: so the quickest rounds count.
    Each of the two may still be too long by as much as the middle round exceeds it.

    Args:
        together: times of world and competitor together, ns.
        world: times of the world alone, ns.
        compiled: whether the competitor is native code.
    """
    net = min(together) - min(world)
    ends = net - (median(together) - min(together)), net + (median(world) - min(world))
    net, low, high = (max(time, LEAST_NANOSECONDS) for time in (net, *ends))
    return ProcessorTime(net, compiled, low=low, high=high)


def longest_equal(nanoseconds: float) -> float:
    """Return the longest time, ns, that counts as equal to a time."""
    return max(EQUAL_TIMES * nanoseconds, nanoseconds + EQUAL_NANOSECONDS)


def is_quicker(one: ProcessorTime, other: ProcessorTime) -> bool:
    """Return whether a time is shorter than another one and neither equal nor possibly longer."""
    return other.nanoseconds > longest_equal(one.nanoseconds) and not one.high >= other.low


def with_times(dataset: "xarray.Dataset", times: Sequence[ProcessorTime | None]) -> "xarray.Dataset":
    """Return an evaluation with the time of each of its competitors, or one competitor's part of one."""
    known = [time or ProcessorTime(math.nan, False) for time in times]
    rows = [(time.nanoseconds, WAYS.index(way_of(time)), time.low, time.high) for time in known]
    attrs = {"units": "ns", "long_name": "processor time of the competitor for a measurement"}
    of_one = "policy" not in dataset.dims
    columns = [((), each[0]) if of_one else ("policy", list(each)) for each in zip(*rows, strict=True)]
    found = dataset.assign_coords(dict(zip(COORDINATES, columns, strict=True)))
    found["nanoseconds"].attrs.update(attrs)
    return found


def way_of(time: ProcessorTime) -> str:
    """Return in which of the :data:`WAYS` a competitor ran."""
    return OWN if time.own else COMPILED if time.compiled else IN_PYTHON


def time_of(run: "xarray.Dataset") -> ProcessorTime | None:
    """Return the time of one competitor's part of an evaluation; None where it is not known."""
    if COORDINATES[0] not in run.coords or math.isnan(nanoseconds := float(run[COORDINATES[0]])):
        return None
    way = WAYS[int(run[COORDINATES[1]])]
    low, high = (float(run[name]) if name in run.coords else math.nan for name in COORDINATES[2:])
    return ProcessorTime(nanoseconds, way == COMPILED, way == OWN, low, high)


class Point(NamedTuple):
    """A competitor in the plane of time and cost."""

    name: str
    kind: str
    time: ProcessorTime
    cost: float
    """Cost, in any unit, the same for all points."""


def times_of_records(records: Sequence[Any]) -> dict[str, ProcessorTime]:
    """Return the times by name, from tidy records of one environment and scenario."""
    return {
        r.policy: ProcessorTime(
            r.value, r.component == COMPILED, r.component == OWN, r.low or math.nan, r.high or math.nan
        )
        for r in records
        if r.metric == METRIC and r.value is not None
    }


def points_of_records(records: Sequence[Any]) -> list[Point]:
    """Return the points of all competitors with known cost and time, except programs.

    The cost is relative to the paper's algorithm, in %. The time of a program includes the exchange of messages.

    Args:
        records: tidy records of one environment and scenario.
    """
    times = times_of_records(records)
    return [
        Point(r.policy, r.kind, times[r.policy], 100.0 * r.value)
        for r in records
        if r.metric == "geometric_cost_difference" and r.value is not None
        if r.policy in times and not times[r.policy].own
    ]


def front(points: Sequence[Point]) -> list[str]:
    """Return the names of the ranked competitors that no other beats in cost and time, the quickest first (Pareto
    front).

    A competitor also dominates all of higher cost that are not surely quicker (:func:`is_quicker`); so noise of the
    clock puts none on the front. Of equal costs the quickest is on the front, of similar times the first by name.
    """
    ranked = [point for point in points if point.kind in RANKED and math.isfinite(point.cost)]
    found = [
        one
        for one in ranked
        if not any(other.cost < one.cost and not is_quicker(one.time, other.time) for other in ranked)
    ]
    chosen = []
    for cost in {point.cost for point in found}:
        equal = [point for point in found if point.cost == cost]
        quickest = min(point.time.nanoseconds for point in equal)
        longest = longest_equal(quickest)
        chosen.append(min((p for p in equal if p.time.nanoseconds <= longest), key=lambda p: p.name))
    return [point.name for point in sorted(chosen, key=lambda point: point.time.nanoseconds)]


def time_text(time: ProcessorTime | None) -> str:
    """Return the nanoseconds in two digits, with a mark where the time is that of Python."""
    if time is None or time.nanoseconds <= 0.0:
        return "-"
    rounded = round(time.nanoseconds, min(1 - math.floor(math.log10(time.nanoseconds)), 0))
    mark = {COMPILED: "", OWN: f" {OWN_MARK}"}.get(way_of(time), f" {PYTHON_MARK}")
    return f"{rounded:,.0f}{mark}"


def column_of_times(records: Sequence[Any]) -> dict[str, str]:
    """Return the texts of a table's column of times by name, with a mark for the front; empty where no time is known.

    Args:
        records: tidy records of one environment and scenario.
    """
    on_front = front(points_of_records(records))
    return {
        name: time_text(time) + (f" {FRONT_MARK}" if name in on_front else "")
        for name, time in times_of_records(records).items()
    }
