"""Processor times of competitors, as coordinates of an evaluation, and the Pareto front of cost and time.

The time of a measurement is that of the competitor up to its estimate, on one core, of many episodes side by side
(:func:`.rollout.measure_time`). It excludes the simulated world, tracing, compilation, and the computation of errors.
It differs from run to run: an evaluation contains it only on request; all other results have the same bits in every
run.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ..competitors.kinds import RANKED
from .rollout import ProcessorTime

if TYPE_CHECKING:
    import xarray

COORDINATES = ("nanoseconds", "compiled")
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
EQUAL_TIMES, EQUAL_NANOSECONDS = 1.1, 3.0
"""Ratio, and difference in ns, up to which two times count as equal: those from run to run."""


def longest_equal(nanoseconds: float) -> float:
    """Return the longest time, ns, that counts as equal to a time."""
    return max(EQUAL_TIMES * nanoseconds, nanoseconds + EQUAL_NANOSECONDS)


def with_times(dataset: "xarray.Dataset", times: Sequence[ProcessorTime | None]) -> "xarray.Dataset":
    """Return an evaluation with the time of each of its competitors, or one competitor's part of one."""
    values = [math.nan if time is None else time.nanoseconds for time in times]
    compiled = [0 if time is None else WAYS.index(way_of(time)) for time in times]
    attrs = {"units": "ns", "long_name": "processor time of the competitor for a measurement"}
    of_one = "policy" not in dataset.dims
    nanoseconds, ways = (((), each[0]) if of_one else ("policy", each) for each in (values, compiled))
    return dataset.assign_coords(nanoseconds=(*nanoseconds, attrs), compiled=ways)


def way_of(time: ProcessorTime) -> str:
    """Return which of :data:`WAYS` a time belongs to."""
    return OWN if time.own else COMPILED if time.compiled else IN_PYTHON


def time_of(run: "xarray.Dataset") -> ProcessorTime | None:
    """Return the time of one competitor's part of an evaluation; None where it is not known."""
    if COORDINATES[0] not in run.coords or math.isnan(nanoseconds := float(run[COORDINATES[0]])):
        return None
    way = WAYS[int(run[COORDINATES[1]])]
    return ProcessorTime(nanoseconds, way == COMPILED, way == OWN)


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
        r.policy: ProcessorTime(r.value, r.component == COMPILED, r.component == OWN)
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

    A competitor with an equal time by :func:`longest_equal` and a lower cost also dominates; so noise of the clock puts
    no competitor on the front. Of equal costs the quickest is on the front, of similar times the first by name.
    """
    ranked = [point for point in points if point.kind in RANKED and math.isfinite(point.cost)]
    found = [
        one
        for one in ranked
        if not any(
            other.cost < one.cost and other.time.nanoseconds <= longest_equal(one.time.nanoseconds)
            for other in ranked
        )
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
