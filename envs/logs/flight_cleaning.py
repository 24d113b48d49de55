"""Cleaning of one recorded flight: implausible units, positions far off the track, gaps and jumps."""

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ..contract.parameters import ParameterLimits, check, freeze
from ..data.trajectory import Trajectory
from .plausibility import check_speed, check_velocity, find_outliers, speeds_of

if TYPE_CHECKING:
    import pandas


class Cleaning(NamedTuple):
    """Site of the radar and limits for the cleaning of a flight; see :func:`~.flights.read_flights`."""

    site: tuple[float, float] | None
    longest_gap: float
    speeds: tuple[float, float]
    reach: float
    smoothing: float

    def check(self) -> None:
        """Raise ValueError if a limit of the cleaning is out of its range."""
        check("longest_gap", self.longest_gap, float, ParameterLimits(above=0.0))
        check(
            "speeds", freeze(self.speeds), tuple[float, float], ParameterLimits(at_least=0.0, ascending=True)
        )
        check("reach", self.reach, float, ParameterLimits(above=0.0))
        check("smoothing", self.smoothing, float, ParameterLimits(at_least=0.0))


CLEANING_COUNTS: dict[str, Any] = {
    "ground": (("row on the ground", "rows on the ground"), lambda limits: ""),
    "missing": (("row without position", "rows without position"), lambda limits: ""),
    "repeated": (("repeated position",), lambda limits: ""),
    "far": (("row", "rows"), lambda limits: f" beyond {limits.reach / 1e3:g} km"),
    "outliers": (("outlier",), lambda limits: f" over {limits.speeds[1]:g} m/s"),
    "gaps": (("gap",), lambda limits: f" over {limits.longest_gap:g} s"),
    "jumps": (("jump",), lambda limits: f" over {limits.speeds[1]:g} m/s"),
}
"""Kinds of removed rows and cuts that the cleaning of a flight counts, with their words in notes."""


LONGEST_PAUSE = 1800.0
"""Longest gap within one flight, s; after a longer one an aircraft is on another flight."""


def clean_flight(
    name: str, rows: "pandas.DataFrame", limits: Cleaning
) -> tuple[list[Trajectory], dict[str, int]]:
    """Clean one recorded flight: return its valid pieces, and the counts of removed rows and cuts.

    Args:
        name: that of the flight.
        rows: table with the columns time (s), x, y (m), ground (true for rows on the ground), optionally vx, vy (m/s),
            and latitude and longitude if positions were given so.
        limits: limits of a flight.

    Raises:
        ValueError: if the rows cannot be a flight, with the likely cause.
    """
    counts = dict.fromkeys(CLEANING_COUNTS, 0)

    def keep(good: Any, what: str) -> None:
        nonlocal rows
        counts[what] += int((~good).sum())
        rows = rows[good]

    degrees = [column for column in ("latitude", "longitude") if column in rows]
    rates = [column for column in ("vx", "vy") if column in rows]
    if degrees:
        # A receiver repeats the last position where it has no new one, while the altitude changes.
        rows = rows.assign(repeated=(rows[degrees].diff() == 0.0).all(axis=1))
    keep(~rows["ground"], "ground")
    keep(rows[["x", "y", *rates]].notna().all(axis=1), "missing")
    time = rows["time"].to_numpy()
    steps = numpy.diff(time)
    if (steps <= 0.0).any():
        row = int((steps <= 0.0).argmax()) + 1
        raise ValueError(f"times must increase, but row {row} has {time[row]:g} s after {time[row - 1]:g} s")
    if degrees:
        keep(~rows["repeated"], "repeated")
        keep(numpy.hypot(rows["x"], rows["y"]) <= limits.reach, "far")
        if rows.empty:
            raise ValueError(f"it never comes within {limits.reach / 1e3:g} km of the site")
    if len(rows) < 2:
        raise ValueError(f"a flight needs at least two positions, got {len(rows)}")
    _check_units(*_arrays(rows), limits)
    highest = limits.speeds[1]

    time, position, _ = _arrays(rows)
    keep(~find_outliers(time, position, lambda elapsed: highest * elapsed), "outliers")
    time, position, velocity = _arrays(rows)
    gaps, jumps = numpy.diff(time) > limits.longest_gap, speeds_of(time, position) > highest
    counts["gaps"], counts["jumps"] = int(gaps.sum()), int((jumps & ~gaps).sum())
    ends = [0, *(numpy.flatnonzero(gaps | jumps) + 1).tolist(), len(time)]
    parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
    long = [part for part in parts if part.stop - part.start > 1]
    begins = [True, *(time[b.start] - time[a.stop - 1] > LONGEST_PAUSE for a, b in itertools.pairwise(long))]
    flights = numpy.cumsum(begins).tolist()
    pieces = []
    for number, (part, flight) in enumerate(zip(long, flights, strict=True), 1):
        flown, moving = position[part], None if velocity is None else velocity[part]
        if limits.smoothing and len(flown) >= FEWEST_IN_WINDOW:
            flown, moving = fit_parabolas(time[part], flown, limits.smoothing)
        own = name if len(parts) == 1 else f"{name} {number}/{len(long)}"
        whole = name if flights[-1] == 1 else f"{name} flight {flight}"
        pieces.append(Trajectory(time[part], flown, moving, own, whole))
    return pieces, counts


def _arrays(rows: "pandas.DataFrame") -> tuple[numpy.ndarray, numpy.ndarray, numpy.ndarray | None]:
    # In the order of rows in memory, on which the last bit of a fit depends.
    pairs = [
        numpy.ascontiguousarray(rows[[*pair]].to_numpy())
        for pair in (("x", "y"), ("vx", "vy"))
        if pair[0] in rows
    ]
    return rows["time"].to_numpy(), pairs[0], pairs[1] if len(pairs) > 1 else None


FEWEST_IN_WINDOW = 5
"""Smallest number of positions in a fit of a parabola."""


def fit_parabolas(
    time: numpy.ndarray, position: numpy.ndarray, half_width: float
) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return position and velocity of parabolas fitted by least squares to the positions around each time.

    Args:
        time: s, ``(n,)``, n >= ``FEWEST_IN_WINDOW``.
        position: m, ``(n, 2)``.
        half_width: half the width of the window, s; a window with few positions is widened.
    """
    count = len(time)
    row = numpy.arange(count)
    first = numpy.minimum(numpy.searchsorted(time, time - half_width), row - FEWEST_IN_WINDOW // 2)
    first = first.clip(0, count - FEWEST_IN_WINDOW)
    last = numpy.maximum(numpy.searchsorted(time, time + half_width, side="right"), first + FEWEST_IN_WINDOW)
    widest = int((last - first).max())
    found = numpy.empty((count, 3, 2))
    portion = max(1_000_000 // widest, 1)  # bounded memory
    for begin in range(0, count, portion):
        some = slice(begin, begin + portion)
        index = first[some, None] + numpy.arange(widest)
        inside = (index < last[some, None]).astype(float)
        index = index.clip(None, count - 1)
        away = (time[index] - time[some, None]) / half_width
        powers = inside[..., None] * numpy.stack([away**0, away, away**2], axis=-1)
        turned = powers.swapaxes(-1, -2)
        found[some] = numpy.linalg.solve(turned @ powers, turned @ position[index])
    return found[:, 0], found[:, 1] / half_width


def _check_units(
    time: numpy.ndarray, position: numpy.ndarray, velocity: numpy.ndarray | None, limits: Cleaning
) -> None:
    check_speed(time, position, limits.speeds)
    step = float(numpy.median(numpy.diff(time)))
    if step > limits.longest_gap:
        raise ValueError(
            f"its positions are {step:g} s apart, longer than the longest gap of {limits.longest_gap:g} s: allow a "
            "longer gap"
        )
    if velocity is not None:
        check_velocity("vx, vy", time, position, velocity)
