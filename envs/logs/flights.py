"""Recorded flights from files: read by column names, projected to the radar's plane, cleaned and cut into pieces.

:mod:`.flight_tables` lists the accepted columns. Latitude and longitude become metres east and north of the radar's
site, in the plane that touches the ellipsoid there.

:mod:`.flight_cleaning` checks every file: a flight with an impossible speed is an error with the likely cause, a
single position far off the track is removed, and a track is cut where it jumps or has a long gap. Notes list these
changes.
"""

import difflib
import glob
import importlib.util
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ...filters.geodesy import east_north
from ..contract.parameters import ParameterLimits, check, quote_shortened
from ..data.foreign_files import is_folder
from ..data.scenario_data import FlightData
from ..data.trajectory import Trajectory, trajectory_of
from .flight_cleaning import CLEANING_COUNTS, Cleaning, clean_flight
from .flight_tables import (
    FLIGHT_SUFFIXES,
    FOOT,
    flight_columns,
    is_true,
    numbers,
    read_table,
    seconds,
    suffix_of,
)
from .plausibility import check_degrees
from .receiver_logs import count_of

if TYPE_CHECKING:
    import pandas


class FlightSource(NamedTuple):
    """One file, or one trajectory of a sequence, with the flights in it and notes on their use."""

    name: str
    trajectories: tuple[Trajectory, ...]
    notes: tuple[str, ...] = ()
    """Cuts and removed rows, such as "2 gaps over 60 s"."""
    reason: str = ""
    """Reason why nothing of it is used; empty if something is."""


@dataclass(frozen=True)
class Flights(FlightData):
    """Set of recorded flights, of which every episode flies one, drawn with equal probability.

    Args:
        trajectories: the pieces that can be flown.
        name: name of the set in reports.
        fewest_scans: pieces that last fewer sampling intervals are dropped.
        sources: files or trajectories that the pieces come from.
    """

    trajectories: tuple[Trajectory, ...]
    name: str = "flights"
    fewest_scans: int = 10
    sources: tuple[FlightSource, ...] = ()

    def __post_init__(self) -> None:
        check("fewest_scans", self.fewest_scans, int, ParameterLimits(at_least=2))
        if not all(isinstance(flight, Trajectory) for flight in self.trajectories):
            raise ValueError(
                "trajectories of Flights are a sequence of Trajectory; filtergym.read_flights reads files"
            )
        if not self.trajectories:
            raise ValueError("a set of flights needs at least one trajectory")
        object.__setattr__(self, "trajectories", tuple(_number_namesakes(self.trajectories)))
        if not self.sources:
            by_name: dict[str, list[Trajectory]] = {}
            for trajectory in self.trajectories:
                by_name.setdefault(flight_of(trajectory), []).append(trajectory)
            found = tuple(FlightSource(name, tuple(pieces)) for name, pieces in by_name.items())
            object.__setattr__(self, "sources", found)

    def fields(self) -> dict[str, Any]:
        """Return the trajectories and other constructor arguments of the set, by name."""
        flown = [trajectory.fields() for trajectory in self.trajectories]
        return {"trajectories": flown, "name": self.name, "fewest_scans": self.fewest_scans}

    def flyable(self, interval: float, farthest: float) -> tuple[list[Trajectory], list[str]]:
        """Return the pieces of flights within range and long enough, and a note for each source with a loss."""
        used, lines = [], []
        for source in self.sources:
            kept, dropped = [], 0
            far = ""
            for piece in source.trajectories:
                distance = float(numpy.hypot(*piece.position.T).max())
                if distance > farthest:
                    far = f"goes {distance / 1e3:,.0f} km from the radar, whose range ends at {farthest / 1e3:,.0f} km"
                elif piece.intervals(interval) < self.fewest_scans:
                    dropped += 1
                else:
                    kept.append(piece)
            notes = [*source.notes]
            if source.notes or dropped:
                notes.append(count_of(len(source.trajectories), "piece"))
            if dropped:
                notes.append(f"{dropped} dropped (shorter than {self.fewest_scans} scans of {interval:g} s)")
            if far:
                notes.append(f"{far}: left out (positions are metres)")
            if source.reason:
                notes = [f"left out: {source.reason}"]
            elif not kept:
                notes = [f"left out: {', '.join(notes)}"]
            if notes:
                lines.append(f"{source.name}: {', '.join(notes)}")
            used += kept
        if not used:
            raise ValueError(_nothing(self.name, lines))
        return used, lines


def flight_of(trajectory: Trajectory) -> str:
    """Return the name of the flight of which a trajectory is a piece, or else its own name."""
    return trajectory.flight or trajectory.name


def _number_namesakes(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    names = [flight_of(trajectory) for trajectory in trajectories]
    return [
        replace(trajectory, name=f"{trajectory.name} {i}")
        if not trajectory.flight and names.count(trajectory.name) > 1
        else trajectory
        for i, trajectory in enumerate(trajectories, 1)
    ]


def _nothing(name: str, reasons: Sequence[str]) -> str:
    if len(reasons) == 1:
        return reasons[0].replace(": left out: ", ": ", 1)
    further = f"; and {len(reasons) - 3} more" if len(reasons) > 3 else ""
    return f"nothing of {name!r} can be flown: {'; '.join(reasons[:3])}{further}"


def flights_from(fields: Mapping[str, Any]) -> Flights:
    """Return a :class:`Flights` from a dictionary of its fields, as read from JSON.

    Raises:
        ValueError: if there is an unknown field, or no valid list of trajectories.
    """
    known = {"trajectories", "name", "fewest_scans"}
    if not {"trajectories"} <= set(fields) <= known:
        raise ValueError(
            f"flights as a dictionary have trajectories and optionally name and fewest_scans, got "
            f"{', '.join(map(repr, fields))}"
        )
    given = fields["trajectories"]
    if not isinstance(given, list | tuple) or not all(isinstance(item, Mapping) for item in given):
        raise ValueError(
            f"trajectories of flights as a dictionary are a list of dictionaries, got {given!r:.80}"
        )
    return Flights(
        tuple(map(trajectory_of, given)), **{n: v for n, v in fields.items() if n != "trajectories"}
    )


# --- which files


def names_flights(source: Any) -> bool:
    """Return whether a scenario is a path or pattern of flight files, a folder of them, or a sequence."""
    if isinstance(source, Path):
        return True
    if isinstance(source, str):
        if source.startswith(TRAFFIC):
            return True
        is_path = bool(suffix_of(Path(source))) or glob.has_magic(source) or is_folder(Path(source))
        return bool(source) and is_path
    return isinstance(source, list | tuple) and len(source) > 0


TRAFFIC = "traffic:"
"""Prefix of the name of a sample of the Python package ``traffic``."""


def traffic_samples() -> dict[str, Path]:
    """Return the sample files of the Python package ``traffic`` by name; empty if it is not installed.

    The package, which needs many libraries, is not imported.
    """
    found = importlib.util.find_spec("traffic")
    folders = list(found.submodule_search_locations or ()) if found else []
    return {
        file.name.removesuffix(".json.gz"): file
        for folder in folders
        for file in sorted(Path(folder, "data", "samples").glob("*/*.json.gz"))
    }


def _traffic_sample(name: str) -> Path:
    samples = traffic_samples()
    if not samples:
        raise ValueError(
            f"scenario {TRAFFIC + name!r} is in the Python package traffic, which is not installed; its samples need "
            "nothing else: pip install --no-deps traffic"
        )
    if name not in samples:
        close = difflib.get_close_matches(name, samples, n=3, cutoff=0.5)
        meant = f"did you mean {' or '.join(close)}?" if close else f"choose from {', '.join(samples)}"
        raise ValueError(f"the package traffic has no sample {name!r}: {meant}")
    return samples[name]


def files_of(source: str | Path) -> list[Path]:
    """Return the files of a path, folder or pattern, sorted by name.

    Raises:
        ValueError: if it is no path, or matches no files.
    """
    if not isinstance(source, str | Path):
        raise ValueError(
            f"files are named by a path or a pattern such as 'plots/*.csv', got {quote_shortened(source)}"
        )
    if isinstance(source, str) and source.startswith(TRAFFIC):
        return [_traffic_sample(source.removeprefix(TRAFFIC))]
    path = Path(source)
    if is_folder(path):
        found = sorted(file for file in path.iterdir() if suffix_of(file))
        if not found:
            raise ValueError(
                f"folder {path} holds no flights: files that end in {', '.join(FLIGHT_SUFFIXES)}"
            )
        return found
    if glob.has_magic(str(source)) and not path.exists():
        found = sorted(
            Path(file) for file in glob.glob(str(source), recursive=True) if not is_folder(Path(file))
        )
        if not found:
            raise ValueError(f"no file matches {str(source)!r}")
        return found
    return [path]


def read_flights(
    source: Any,
    site: tuple[float, float] | None = None,
    *,
    longest_gap: float = 60.0,
    speeds: tuple[float, float] = (1.0, 1000.0),
    reach: float = 500e3,
    smoothing: float = 0.0,
    fewest_scans: int = 10,
) -> Flights:
    """Return recorded flights, read from files, cleaned and cut into pieces without gaps.

    Args:
        source: a file (CSV, NetCDF, Parquet), a folder of such, a pattern such as ``"flights/*.csv"``, a
            :class:`~.trajectory.Trajectory`, or a sequence of these. Trajectories are used unchanged.
            ``"traffic:quickstart"`` is a sample of the Python package ``traffic``.
        site: latitude and longitude of the radar, degrees; needed for files without x and y. The default for a
            sample is the median of its positions.
        longest_gap: longest time between two positions, s; a track is cut at longer ones.
        speeds: limits of the median speed of a flight, m/s; a flight outside is an error. Where it is faster from one
            position to the next, one position is removed, or the track is cut.
        reach: largest distance of latitudes and longitudes from the site, m; farther ones are removed.
        smoothing: half the width, s, of the window of positions for a parabola, which gives position and velocity. Zero
            leaves positions unchanged.
        fewest_scans: pieces that last fewer sampling intervals of the environment are dropped.

    Returns:
        A set of flights for the argument ``scenario``: every episode replays one piece.

    Raises:
        ValueError: if nothing can be used, or an argument is out of its limits. One broken file of several is skipped,
            and the notes name it.
    """
    limits = Cleaning(_check_site(site), longest_gap, speeds, reach, smoothing)
    limits.check()
    at_median = isinstance(source, str) and source.startswith(TRAFFIC)
    given: list[Any]
    if isinstance(source, str | Path):
        name, given = str(source), [source]
    elif isinstance(source, Trajectory):
        name, given = source.name, [source]
    elif isinstance(source, list | tuple) and source:
        name, given = count_of(len(source), "flight"), list(source)
    else:
        raise ValueError(
            f"flights are a file, a folder, a pattern such as 'flights/*.csv', or a sequence of them, got {source!r}"
        )
    sources: list[FlightSource] = []
    files: list[Path] = []
    own: list[Trajectory] = []
    for item in given:
        if isinstance(item, Trajectory):
            own.append(item)
        elif isinstance(item, Mapping):
            own.append(trajectory_of(item))
        elif isinstance(item, str | Path):
            files += files_of(item)
        else:
            raise ValueError(f"a set of flights holds files and trajectories, got {item!r}")
    sources += [FlightSource(trajectory.name, (trajectory,)) for trajectory in _number_namesakes(own)]
    stems = [file.name.removesuffix(suffix_of(file)) for file in files]
    for file, stem in zip(files, stems, strict=True):
        label = stem if stems.count(stem) == 1 else str(file)
        try:
            sources += _read(file, label, limits, at_median)
        except ValueError as error:
            if len(files) + len(sources) == 1:
                raise
            reason = str(error).partition(f"trajectory {file}: ")[2]
            sources.append(FlightSource(_short(file, files), (), reason=reason))
    trajectories = tuple(t for s in sources for t in s.trajectories)
    if not trajectories:
        raise ValueError(_nothing(name, [f"{s.name}: {s.reason}" for s in sources]))
    return Flights(trajectories, name, fewest_scans, tuple(sources))


def _short(file: Path, files: Sequence[Path]) -> str:
    return file.name if [f.name for f in files].count(file.name) == 1 else str(file)


def _check_site(site: Any) -> tuple[float, float] | None:
    if site is None:
        return None
    check("site", site, tuple[float, float], ParameterLimits())
    latitude, longitude = map(float, site)
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise ValueError(f"site is a latitude and a longitude in degrees, got {site!r}")
    return latitude, longitude


# --- one file


def _read(file: Path, label: str, limits: Cleaning, at_median: bool) -> list[FlightSource]:
    try:
        table = read_table(file)
    except ValueError as error:
        raise ValueError(f"cannot read trajectory {file}: {error}") from error
    try:
        columns, feet = flight_columns(table)
        return _flights_of(file, label, columns, feet, limits, at_median)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"trajectory {file}: {error}") from error


def _flights_of(
    file: Path, label: str, columns: "pandas.DataFrame", feet: bool, limits: Cleaning, at_median: bool
) -> list[FlightSource]:
    plane = "x" in columns and "y" in columns and not (limits.site and "latitude" in columns)
    names = ["x", "y"] if plane else ["latitude", "longitude"]
    if plane and {"vx", "vy"} <= {*columns}:
        names += ["vx", "vy"]
    if not plane and "altitude" in columns:
        names.append("altitude")
    rows = columns[["time", *names]].copy()
    rows["time"] = seconds(columns["time"])
    for name in names:
        rows[name] = numbers(name, columns[name])
    for name in names if feet else ():
        rows[name] *= FOOT if name == "altitude" else 1.0
    for name in rows:
        wrong = rows[name].isin([numpy.inf, -numpy.inf]) | (rows[name].isna() & (name == "time"))
        if wrong.any():
            raise ValueError(f"{name} has a value that is not finite in row {wrong.idxmax()}")
    placed = ""
    if not plane:
        if limits.site is None and at_median:
            limits = limits._replace(site=_median_site(rows))
            placed = "radar at {:.2f}, {:.2f}".format(*limits.site or ())
        _check_degrees(limits.site, rows)
    rows["ground"] = is_true(columns["ground"]) if "ground" in columns else False
    good: list[Trajectory] = []
    counts = dict.fromkeys(CLEANING_COUNTS, 0)
    bad: list[FlightSource] = []
    groups = _by_flight(rows, columns.get("flight"))
    for flight, own in groups.items():
        name = f"{label}:{flight}" if flight else label
        try:
            if not plane and limits.site:
                own = _around(limits.site, own)
            pieces, found = clean_flight(name, own, limits)
        except ValueError as error:
            if len(groups) == 1:
                raise
            bad.append(FlightSource(f"{file.name}:{flight}", (), reason=str(error)))
            continue
        good += pieces
        for what, count in found.items():
            counts[what] += count
    if not good:
        raise ValueError(_nothing(label, [f"{s.name}: {s.reason}" for s in bad]))
    notes = [
        f"{count_of(count, *words)}{tail(limits)}"
        for (words, tail), count in zip(CLEANING_COUNTS.values(), counts.values(), strict=True)
        if count
    ]
    if len(groups) > 1 and notes:
        notes = [f"{len(groups) - len(bad)} flights", *notes]
    if placed:
        notes = [placed, *notes]
    return [FlightSource(file.name, tuple(good), tuple(notes)), *bad]


def _median_site(rows: "pandas.DataFrame") -> tuple[float, float]:
    """Return the median latitude and longitude of all positions, to a hundredth of a degree."""
    latitude, longitude = (round(float(rows[name].median()), 2) for name in ("latitude", "longitude"))
    return latitude, longitude


def _by_flight(rows: "pandas.DataFrame", flight: "pandas.Series | None") -> dict[str, "pandas.DataFrame"]:
    if flight is None:
        return {"": rows}
    names = flight.astype(object).where(flight.notna(), "").astype(str).str.strip()
    groups = {str(name): own for name, own in rows.sort_values("time", kind="stable").groupby(names)}
    return groups if len(groups) > 1 else dict.fromkeys([""], *groups.values())


def _check_degrees(site: tuple[float, float] | None, rows: "pandas.DataFrame") -> None:
    for name, most in (("latitude", 90.0), ("longitude", 360.0)):
        check_degrees(name, rows[name].to_numpy(), most)
    if site is None:
        raise ValueError(
            "it has latitude and longitude: give the radar's, --site LATITUDE,LONGITUDE, or in Python "
            "filtergym.read_flights(..., site=(latitude, longitude))"
        )


def _around(site: tuple[float, float], rows: "pandas.DataFrame") -> "pandas.DataFrame":
    latitude, longitude = (numpy.radians(rows[name].to_numpy()) for name in ("latitude", "longitude"))
    altitude = numpy.zeros_like(latitude)
    if "altitude" in rows:
        # A few rows have no altitude, and a kilometre of height moves a target by 0.016 % of its range.
        filled = rows["altitude"].reset_index(drop=True).interpolate(limit_direction="both")
        altitude = filled.fillna(0.0).to_numpy()
    x, y = east_north(latitude, longitude, altitude, (math.radians(site[0]), math.radians(site[1])))
    return rows.assign(x=x, y=y)
