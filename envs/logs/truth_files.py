"""Truth of a log in a separate file, matched by time.

The times of both files are used as written; only the user's offset shifts them. The truth is interpolated between two
true positions that are close in time, and unknown elsewhere.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy

from ...filters.angles import shorten
from ..contract.log_format import LogFormat
from .flight_tables import (
    COLUMNS,
    check_order,
    clock_seconds,
    describe_time,
    list_names,
    numbers,
    read_table,
    sort_by_time,
)

if TYPE_CHECKING:
    import pandas

LONGEST_GAP = 1.5
"""Longest time between two rows of the truth for interpolation, s: one row a second, with some jitter."""
SAME_TIME = 1e-3
"""Largest difference of equal times, s."""
OFFSETS = numpy.arange(-30.0, 30.01, 0.1)
"""Clock offsets that are tried for a note, s."""
LARGEST_REMAINDER = 0.7
"""Largest share of the distance between positions and truth that an offset must leave to be noted."""
OFFSET_TOLERANCE = 0.3
"""Largest difference between the offsets of both halves of a log, s."""


class TruthTable(NamedTuple):
    """True values of a separate file, with their times, kind of clock, and notes."""

    clock: str
    """Kind of the times: dates, times of day, or seconds."""
    time: numpy.ndarray
    """Times by that clock, s, ``(n,)``, increasing."""
    columns: Mapping[str, numpy.ndarray]
    """Values by their names ``truth_...``, ``(n,)``; NaN where a cell is empty."""
    notes: tuple[str, ...]
    """Notes on the reading, one line each."""


def read_truth(
    path: Path,
    log_format: LogFormat,
    components: Sequence[str],
    prefix: str,
    times: Sequence[str],
    sort: bool = False,
) -> TruthTable:
    """Return the true positions in a file, a table or a receiver's log, by time.

    Args:
        path: path of the file, with a time and x and y (m), latitude and longitude (degrees), or components.
        log_format: the environment's format.
        components: names of the estimated components.
        prefix: prefix of the names of true columns.
        times: accepted names of the column of times.
        sort: sort the rows by time.

    Raises:
        ValueError: if the file cannot be read.
    """
    geodetic = {alias: name for name in ("latitude", "longitude", "altitude") for alias in COLUMNS[name]}
    meant = {name: prefix + name for name in components}
    if log_format.plane:
        meant |= dict(zip(("x", "y"), log_format.plane[2:], strict=True))
        meant |= {alias: prefix + name for alias, name in geodetic.items()}
    meant |= {true: true for true in list(meant.values())}
    if not path.is_file():
        raise ValueError("there is no such file")
    table, names, notes = read_table(path, {*times, *meant})
    time_name = next((name for name in times if name in table), None)
    if sort and time_name is not None:
        table, added = sort_by_time(table, table[time_name])
        notes = (*notes, *added)
    found: dict[str, numpy.ndarray] = {}
    for name in table:
        if name in meant and meant[name] not in found:
            found[meant[name]] = numbers(name, table[name]).to_numpy()
    if time_name is None or not found:
        raise ValueError(
            f"it has the columns {list_names(names) or 'none'}, and needs time and {_wanted(log_format)}"
        )
    clock, time = clock_seconds(table[time_name])
    first = numpy.append(True, numpy.diff(time) != 0.0)
    check_order(time)
    return TruthTable(clock, time[first], {name: values[first] for name, values in found.items()}, notes)


def _wanted(log_format: LogFormat) -> str:
    if log_format.plane:
        return "x and y (m), or latitude and longitude (degrees)"
    return "components of the environment by their names"


def match_truth(
    truth: TruthTable, times: "pandas.Series", offset: float, periods: Mapping[str, float]
) -> tuple[dict[str, numpy.ndarray], str]:
    """Interpolate the truth at the times of a log, NaN where unknown; return also a note on the matched rows.

    Args:
        truth: result of :func:`read_truth`.
        times: those of the log, as written.
        offset: offset added to the times of the truth, s.
        periods: periods of the columns that are angles, which are interpolated the shorter way round.

    Raises:
        ValueError: if both clocks differ, or no time has a truth.
    """
    clock, now = clock_seconds(times)
    if clock != truth.clock:
        raise ValueError(
            f"the times of the log are {clock} and those of the truth {truth.clock}: use the same form in both"
        )
    then = truth.time + offset
    after = numpy.clip(numpy.searchsorted(then, now), 1, max(len(then) - 1, 1))
    if len(then) < 2:
        raise ValueError("it has one row, and a truth needs several")
    before = after - 1
    gap = then[after] - then[before]
    share = (now - then[before]) / gap
    between = (share >= 0.0) & (share <= 1.0) & (gap <= LONGEST_GAP)
    near = numpy.where(numpy.abs(now - then[before]) < numpy.abs(now - then[after]), before, after)
    same = numpy.abs(now - then[near]) <= SAME_TIME
    columns = {}
    for name, values in truth.columns.items():
        step = values[after] - values[before]
        if name in periods:
            step = shorten(step[None], {0: periods[name]})[0]
        inside = values[before] + share * step
        columns[name] = numpy.where(same, values[near], numpy.where(between, inside, numpy.nan))
    known = numpy.logical_and.reduce([numpy.isfinite(values) for values in columns.values()])
    if not known.any():
        raise ValueError(
            f"no measurement has a truth: the log's times are from {describe_time(clock, now[0])} to "
            f"{describe_time(clock, now[-1])}, those of the truth from {describe_time(clock, then[0])} to "
            f"{describe_time(clock, then[-1])}"
        )
    exact = int((same & known).sum())
    note = (
        f"{int(known.sum()):,} of {len(now):,} rows have a truth: {exact:,} at the same time, "
        f"{int(known.sum()) - exact:,} between two that are at most {LONGEST_GAP:g} s apart"
    )
    return columns, note + (f"; {offset:+g} s were added to its times" if offset else "")


def offset_note(time: numpy.ndarray, position: numpy.ndarray, truth: numpy.ndarray) -> str:
    """Return a note on a constant clock offset that would bring positions nearer to the truth; else empty.

    Args:
        time: times of the log, s, ``(n,)``.
        position: measured positions, m, ``(n, k)``; NaN where there is none.
        truth: true positions at these times, m, ``(n, k)``; NaN where unknown.
    """
    known = numpy.isfinite(truth).all(axis=1)
    if known.sum() < 2:
        return ""

    def distances(rows: slice) -> numpy.ndarray:
        found = []
        for offset in OFFSETS:
            at = [
                numpy.interp(time[rows] - offset, time[known], axis, left=numpy.nan, right=numpy.nan)
                for axis in truth[known].T
            ]
            apart = numpy.hypot.reduce(position[rows] - numpy.stack(at, axis=1), axis=1)
            there = numpy.isfinite(apart)
            found.append(numpy.median(apart[there]) if there.mean() > 0.3 else numpy.inf)
        return numpy.array(found)

    half = len(time) // 2
    parts = [distances(rows) for rows in (slice(0, half), slice(half, None))]
    if not all(numpy.isfinite(part).any() for part in parts):
        return ""
    one, other = (OFFSETS[part.argmin()] for part in parts)
    whole = distances(slice(None))
    best, now = whole.argmin(), whole[len(OFFSETS) // 2]
    if abs(one - other) > OFFSET_TOLERANCE or whole[best] > LARGEST_REMAINDER * now:
        return ""
    return (
        f"positions are {now:.3g} m from the truth in the median, and would be {whole[best]:.3g} m if "
        f"{OFFSETS[best]:+.1f} s were added to its times, in both halves alike: are its clock and the log's the same "
        "(GPS time is 18 s ahead of UTC)? Nothing was shifted"
    )
