"""Recorded flights from files: read by the names of their columns, put around the radar, cleaned and cut into pieces.

What a file may hold stands in ``COLUMNS``. Latitude and longitude become metres east and north of the radar's site, in
the plane that touches the ellipsoid there (:mod:`...filters.geodesy`). Own code, because it is a rotation of Earth-fixed
coordinates that the satellites need anyway; a geodesy library is the oracle of its tests.

A file is never believed: a flight whose speed cannot be that of a target is refused with the likely cause, a single
position far off the track is taken out, and a track is cut where it jumps or where nothing was received for long.
What was done is told in one line a file.
"""

import csv
import glob
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy

from ..filters.geodesy import earth_fixed, east_north_up
from .parameters import Limits, check
from .trajectory import Trajectory, trajectory_of

FLIGHT_SUFFIXES = (".csv", ".nc", ".parquet")
"""Files that can be read."""
MOST_ROWS = 1_000_000
"""Of a file: a day of one target at ten a second; more would not leave room for anything else in memory."""
MOST_BYTES = 1_000_000_000
"""Of a file."""

COLUMNS: Mapping[str, tuple[str, ...]] = {
    "time": ("time", "timestamp"),
    "x": ("x",),
    "y": ("y",),
    "vx": ("vx",),
    "vy": ("vy",),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon"),
    "altitude": ("geoaltitude", "altitude", "baroaltitude"),
    "flight": ("flight_id", "icao24", "callsign"),
}
"""What is read, and the names under which it is known, the first one that a file has; upper and lower case are alike.

``time`` in seconds, in ISO 8601 or as dates of any resolution; ``x``, ``y`` in metres, ``vx``, ``vy`` in m/s; or latitude
and longitude in degrees, altitude in metres. The state vectors of OpenSky are of this form. Of the Python package
``traffic``, known by its ``groundspeed``, altitudes are feet. Rows of one ``flight`` belong together.
"""
FOOT = 0.3048
UNITS: Mapping[str, tuple[str, ...]] = {
    "time": ("s", "second", "seconds", "sec"),
    "x": ("m", "metre", "metres", "meter", "meters"),
    "y": ("m", "metre", "metres", "meter", "meters"),
    "vx": ("m/s", "m s-1", "m s^-1", "m s**-1"),
    "vy": ("m/s", "m s-1", "m s^-1", "m s**-1"),
    "altitude": ("m", "metre", "metres", "meter", "meters"),
}
"""Units that a NetCDF variable may say it has."""


class Source(NamedTuple):
    """One file, or one trajectory of a sequence, and what has become of it."""

    name: str
    trajectories: tuple[Trajectory, ...]
    said: tuple[str, ...] = ()
    """What was cut: "2 gaps over 60 s"."""
    wrong: str = ""
    """Why nothing of it is used; empty if something is."""


@dataclass(frozen=True)
class Flights:
    """A set of flights of which every episode flies one, drawn with equal probability.

    Args:
        trajectories: the pieces that can be flown.
        name: what reports call the set.
        fewest_scans: pieces that last fewer sampling intervals are dropped.
        sources: what they were read from.
    """

    trajectories: tuple[Trajectory, ...]
    name: str = "flights"
    fewest_scans: int = 10
    sources: tuple[Source, ...] = ()

    def __post_init__(self) -> None:
        check("fewest_scans", self.fewest_scans, int, Limits(at_least=2))
        if not all(isinstance(flight, Trajectory) for flight in self.trajectories):
            raise ValueError(
                "trajectories of Flights are a sequence of Trajectory; filtergym.read_flights reads files"
            )
        if not self.trajectories:
            raise ValueError("a set of flights needs at least one trajectory")
        object.__setattr__(self, "trajectories", tuple(_told_apart(self.trajectories)))
        if not self.sources:
            by_name: dict[str, list[Trajectory]] = {}
            for trajectory in self.trajectories:
                by_name.setdefault(flight_of(trajectory), []).append(trajectory)
            found = tuple(Source(name, tuple(pieces)) for name, pieces in by_name.items())
            object.__setattr__(self, "sources", found)

    def flyable(self, interval: float, farthest: float) -> tuple[list[Trajectory], list[str]]:
        """Return the pieces that can be flown, and what is to be told of every source, a line each.

        Args:
            interval: sampling interval, s.
            farthest: from the radar, m.

        Raises:
            ValueError: if there are none.
        """
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
            said = [*source.said]
            if source.said or dropped:
                said.append(_counted(len(source.trajectories), "piece"))
            if dropped:
                said.append(f"{dropped} dropped (shorter than {self.fewest_scans} scans of {interval:g} s)")
            if far:
                said.append(f"{far}: left out (positions are metres)")
            if source.wrong:
                said = [f"left out: {source.wrong}"]
            elif not kept:
                said = [f"left out: {', '.join(said)}"]
            if said:
                lines.append(f"{source.name}: {', '.join(said)}")
            used += kept
        if not used:
            raise ValueError(_nothing(self.name, lines))
        return used, lines


def flight_of(trajectory: Trajectory) -> str:
    """Name of the flight that a trajectory is, or is a piece of."""
    return trajectory.flight or trajectory.name


def _told_apart(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Number whole flights that have the same name: they are not pieces of one."""
    names = [flight_of(trajectory) for trajectory in trajectories]
    return [
        replace(trajectory, name=f"{trajectory.name} {i}")
        if not trajectory.flight and names.count(trajectory.name) > 1
        else trajectory
        for i, trajectory in enumerate(trajectories, 1)
    ]


def _counted(count: int, what: str, plural: str = "") -> str:
    return f"{count:,} {what if count == 1 else plural or what + 's'}"


def _nothing(name: str, reasons: Sequence[str]) -> str:
    if len(reasons) == 1:
        return reasons[0].replace(": left out: ", ": ", 1)
    further = f"; and {len(reasons) - 3} more" if len(reasons) > 3 else ""
    return f"nothing of {name!r} can be flown: {'; '.join(reasons[:3])}{further}"


def flights_from(fields: Mapping[str, Any]) -> Flights:
    """Return the set of flights whose fields a dictionary holds, as they come out of JSON.

    Raises:
        ValueError: if there is an unknown field, or the trajectories are none.
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
    """Whether a scenario is the path of a file or folder of flights, a pattern of such paths, or a sequence of flights."""
    if isinstance(source, Path):
        return True
    if isinstance(source, str):
        return Path(source).suffix in FLIGHT_SUFFIXES or glob.has_magic(source) or _is_folder(Path(source))
    return isinstance(source, list | tuple) and len(source) > 0


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # a name that no file can have
        return False


def _files(source: str | Path) -> list[Path]:
    """Files that a path or a pattern stands for, in the order of their names."""
    path = Path(source)
    if _is_folder(path):
        found = sorted(file for file in path.iterdir() if file.suffix in FLIGHT_SUFFIXES)
        if not found:
            raise ValueError(
                f"folder {path} holds no flights: files that end in {', '.join(FLIGHT_SUFFIXES)}"
            )
        return found
    if glob.has_magic(str(source)) and not path.exists():
        found = sorted(
            Path(file) for file in glob.glob(str(source), recursive=True) if not _is_folder(Path(file))
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
    fewest_scans: int = 10,
) -> Flights:
    """Read recorded flights, clean them and cut them into pieces without gaps.

    Args:
        source: a file (CSV, NetCDF, Parquet), a folder of such, a pattern such as ``"flights/*.csv"``, a
            :class:`~.trajectory.Trajectory`, or a sequence of these. Trajectories are taken as they are.
        site: latitude and longitude of the radar, degrees; needed where files hold these and not x and y.
        longest_gap: s; a track is cut where two positions are farther apart in time.
        speeds: m/s; a flight whose median speed is outside is refused, and where it is faster from one position to
            the next, the one position is taken out, or the track is cut.
        reach: m; latitudes and longitudes farther from the site are taken out.
        fewest_scans: pieces that last fewer sampling intervals of the environment are dropped.

    Returns:
        What can be given as scenario: every episode flies one piece.

    Raises:
        ValueError: if nothing can be used, or an argument is out of its limits. One broken file of several is left out
            and named in the notes.
    """
    limits = _Limits(_checked_site(site), longest_gap, speeds, reach)
    limits.check()
    if isinstance(source, str | Path):
        name, given = str(source), [source]
    elif isinstance(source, Trajectory):
        name, given = source.name, [source]
    elif isinstance(source, list | tuple) and source:
        name, given = _counted(len(source), "flight"), list(source)
    else:
        raise ValueError(
            f"flights are a file, a folder, a pattern such as 'flights/*.csv', or a sequence of them, got {source!r}"
        )
    sources: list[Source] = []
    files: list[Path] = []
    own = [trajectory_of(item) if isinstance(item, Mapping) else item for item in given]
    own = [item for item in own if isinstance(item, Trajectory)]
    for trajectory in _told_apart(own):
        sources.append(Source(trajectory.name, (trajectory,)))
    for item in given:
        if isinstance(item, Trajectory | Mapping):
            continue
        if isinstance(item, str | Path):
            files += _files(item)
        else:
            raise ValueError(f"a set of flights holds files and trajectories, got {item!r}")
    stems = [file.stem for file in files]
    for file in files:
        label = file.stem if stems.count(file.stem) == 1 else str(file)
        try:
            sources += _read(file, label, limits)
        except ValueError as error:
            if len(files) + len(sources) == 1:
                raise
            reason = str(error).partition(f"trajectory {file}: ")[2]
            sources.append(Source(_short(file, files), (), wrong=reason))
    trajectories = tuple(t for s in sources for t in s.trajectories)
    if not trajectories:
        raise ValueError(_nothing(name, [f"{s.name}: {s.wrong}" for s in sources]))
    return Flights(trajectories, name, fewest_scans, tuple(sources))


def _short(file: Path, files: Sequence[Path]) -> str:
    return file.name if [f.name for f in files].count(file.name) == 1 else str(file)


class _Limits(NamedTuple):
    site: tuple[float, float] | None
    longest_gap: float
    speeds: tuple[float, float]
    reach: float

    def check(self) -> None:
        check("longest_gap", self.longest_gap, float, Limits(above=0.0))
        check("speeds", tuple(self.speeds), tuple[float, float], Limits(at_least=0.0, ascending=True))
        check("reach", self.reach, float, Limits(above=0.0))


def _checked_site(site: Any) -> tuple[float, float] | None:
    if site is None:
        return None
    check("site", site, tuple[float, float], Limits())
    latitude, longitude = map(float, site)
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise ValueError(f"site is a latitude and a longitude in degrees, got {site!r}")
    return latitude, longitude


# --- one file


def _read(file: Path, label: str, limits: _Limits) -> list[Source]:
    """Read one file: a source for it, and one more for every flight in it that cannot be used.

    Raises:
        ValueError: if nothing of it can be used.
    """
    try:
        if file.stat().st_size > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES / 1e9:g} GB: split it")
        table = _TABLES[file.suffix](file) if file.suffix in _TABLES else None
        if table is None:
            raise ValueError(f"files of flights end in {', '.join(FLIGHT_SUFFIXES)}")
    except UnicodeDecodeError as error:
        raise ValueError(f"cannot read trajectory {file}: it is no text in UTF-8") from error
    except Exception as error:  # readers raise whatever a broken file makes them stumble over
        raise ValueError(f"cannot read trajectory {file}: {str(error) or type(error).__name__}") from error
    try:
        columns, feet = _known(table)
        return _flights_of(file, label, columns, feet, limits)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"trajectory {file}: {error}") from error


def _rows_refused(rows: int) -> ValueError:
    return ValueError(f"it has more than {MOST_ROWS:,} rows ({rows:,}): split it, or keep fewer a second")


def _csv(file: Path) -> dict[str, Any]:
    with file.open(encoding="utf-8-sig", newline="") as lines:
        header = lines.readline()
        delimiter = next((d for d in ",;\t" if d in header), ",")
        names = [name.strip().strip('"') for name in header.strip().split(delimiter)]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"it has the column {', '.join(sorted(twice))} more than once")
        wanted = [i for i, name in enumerate(names) if name.lower() in _WANTED]
        rows: list[list[str]] = []
        for number, row in enumerate(csv.reader(lines, delimiter=delimiter)):
            if not row:
                continue
            if len(row) != len(names):
                raise ValueError(f"{len(names)} column names but {len(row)} columns in row {number}")
            if number >= MOST_ROWS:
                raise ValueError(f"it has more than {MOST_ROWS:,} rows: split it, or keep fewer a second")
            rows.append([row[i] for i in wanted])
    table: dict[str, Any] = dict.fromkeys(names)
    table |= {names[i]: numpy.array([row[k] for row in rows], dtype=object) for k, i in enumerate(wanted)}
    return table


def _netcdf(file: Path) -> dict[str, Any]:
    import xarray

    # From memory: a mapped file stays open where its reading fails.
    content = file.read_bytes()
    engine: Any = "h5netcdf" if content.startswith(b"\x89HDF") else "scipy"
    if engine == "h5netcdf" and engine not in xarray.backends.list_engines():
        raise ValueError("NetCDF-4 needs one more package: pip install 'filtergym[flights]'")
    with xarray.open_dataset(io.BytesIO(content), engine=engine) as data:
        table: dict[str, Any] = dict.fromkeys(map(str, data.variables))
        for name in table:
            known = _WANTED.get(name.lower())
            if known is None:
                continue
            if data[name].size > MOST_ROWS:
                raise _rows_refused(data[name].size)
            unit = str(data[name].attrs.get("units", ""))
            if unit and known in UNITS and unit not in UNITS[known]:
                raise ValueError(f"{name} is in {unit!r}, and {UNITS[known][0]!r} is expected")
            table[name] = data[name].values
    return table


def _parquet(file: Path) -> dict[str, Any]:
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise ValueError("Parquet needs one more package: pip install 'filtergym[flights]'") from error
    with parquet.ParquetFile(file) as data:
        table: dict[str, Any] = dict.fromkeys(data.schema_arrow.names)
        if data.metadata.num_rows > MOST_ROWS:
            raise _rows_refused(data.metadata.num_rows)
        wanted = [name for name in table if name.lower() in _WANTED]
        found = data.read(columns=wanted)
    return table | {name: found.column(name).to_numpy() for name in wanted}


_TABLES = {".csv": _csv, ".nc": _netcdf, ".parquet": _parquet}
_WANTED = {alias: name for name, aliases in COLUMNS.items() for alias in aliases}


def _known(table: Mapping[str, Any]) -> tuple[dict[str, numpy.ndarray], bool]:
    """Columns by what they are, and whether altitudes are feet."""
    lower = {name.lower(): name for name in table}
    columns = {}
    for known, aliases in COLUMNS.items():
        name = next((lower[alias] for alias in aliases if alias in lower), None)
        if name is not None:
            columns[known] = table[name]
    position = [("x", "y"), ("latitude", "longitude")]
    missing = [] if "time" in columns else ["time"]
    if not any(set(pair) <= columns.keys() for pair in position):
        geodetic = {"latitude", "longitude"} & columns.keys()
        missing += [name for name in position[bool(geodetic)] if name not in columns]
    if missing:
        raise ValueError(
            f"it lacks the column {', '.join(missing)}; it has {', '.join(table)} and needs time, x, y (m) and "
            "optionally vx, vy (m/s), or time, latitude, longitude (degrees)"
        )
    return columns, "groundspeed" in lower


def _numbers(name: str, values: Any) -> numpy.ndarray:
    """Column of numbers; what is empty is NaN.

    Raises:
        ValueError: for words.
    """
    array = numpy.asarray(values)
    if array.ndim != 1:
        raise ValueError(f"{name} must be one row of numbers, got shape {array.shape}")
    if array.dtype.kind in "mM":
        raise ValueError(f"{name} must be numbers, got {array.dtype}")
    if array.dtype == object:
        try:
            return numpy.array([math.nan if v is None or v == "" else float(v) for v in array.tolist()])
        except (ValueError, TypeError):
            row = next(i for i, v in enumerate(array.tolist()) if not _is_number(v))
            raise ValueError(f"{name} has {array[row]!r} in row {row}, which is no number") from None
    return array.astype(float)


def _is_number(value: Any) -> bool:
    try:
        float(value or math.nan)
    except (ValueError, TypeError):
        return False
    return True


def _seconds(values: Any) -> numpy.ndarray:
    """Times in seconds: numbers as they are, dates since the first of them.

    Raises:
        ValueError: for what is neither.
    """
    array = numpy.asarray(values)
    if array.dtype == object and len(array) and isinstance(array[0], str) and not _is_number(array[0]):
        dates = []
        for row, text in enumerate(array.tolist()):
            try:
                date = datetime.fromisoformat(text.strip())
            except (ValueError, AttributeError):
                raise ValueError(
                    f"time has {text!r} in row {row}, which is neither seconds nor a date such as 2026-05-01T12:00:00Z"
                ) from None
            dates.append(date.replace(tzinfo=UTC) if date.tzinfo is None else date)
        return numpy.array([(date - dates[0]).total_seconds() for date in dates])
    if array.dtype.kind in "mM" and array.ndim == 1:
        missing = numpy.isnat(array)
        if missing.any():
            raise ValueError(f"time has no value in row {int(missing.argmax())}")
        return (array - array[:1]) / numpy.timedelta64(1, "s")
    return _numbers("time", array)


def _flights_of(
    file: Path, label: str, columns: Mapping[str, Any], feet: bool, limits: _Limits
) -> list[Source]:
    time = _seconds(columns["time"])
    plane = "x" in columns and "y" in columns and not (limits.site and "latitude" in columns)
    pair = ("x", "y") if plane else ("latitude", "longitude")
    values = {name: _numbers(name, columns[name]) for name in pair}
    velocity = plane and {"vx", "vy"} <= columns.keys()
    if velocity:
        values |= {name: _numbers(name, columns[name]) for name in ("vx", "vy")}
    if not plane and "altitude" in columns:
        values["altitude"] = _numbers("altitude", columns["altitude"]) * (FOOT if feet else 1.0)
    for name, array in values.items():
        if array.shape != time.shape:
            raise ValueError(f"{name} must have shape {time.shape} as time has, got {array.shape}")
        if numpy.isinf(array).any():
            raise ValueError(
                f"{name} has a value that is not finite in row {int(numpy.isinf(array).argmax())}"
            )
    if not numpy.isfinite(time).all():
        raise ValueError(
            f"time has a value that is not finite in row {int((~numpy.isfinite(time)).argmax())}"
        )
    if not plane:
        values = _around(limits.site, values)
    groups = _groups(columns.get("flight"), len(time))
    good: list[Trajectory] = []
    counts = dict.fromkeys(_COUNTED, 0)
    bad: list[Source] = []
    for flight, rows in groups.items():
        name = f"{label}:{flight}" if flight else label
        try:
            pieces, found = _cleaned(
                name, time[rows], {n: v[rows] for n, v in values.items()}, limits, geodetic=not plane
            )
        except ValueError as error:
            if len(groups) == 1:
                raise
            bad.append(Source(f"{file.name}:{flight}", (), wrong=str(error)))
            continue
        good += pieces
        for what, count in found.items():
            counts[what] += count
    if not good:
        raise ValueError(_nothing(label, [f"{s.name}: {s.wrong}" for s in bad]))
    said = [
        f"{_counted(count, *words)}{tail(limits)}"
        for (words, tail), count in zip(_COUNTED.values(), counts.values(), strict=True)
        if count
    ]
    if len(groups) > 1 and said:
        said = [f"{len(groups) - len(bad)} flights", *said]
    return [Source(file.name, tuple(good), tuple(said)), *bad]


_COUNTED: dict[str, Any] = {
    "missing": (("row without position", "rows without position"), lambda limits: ""),
    "repeated": (("repeated position",), lambda limits: ""),
    "far": (("row", "rows"), lambda limits: f" beyond {limits.reach / 1e3:g} km"),
    "outliers": (("outlier",), lambda limits: f" over {limits.speeds[1]:g} m/s"),
    "gaps": (("gap",), lambda limits: f" over {limits.longest_gap:g} s"),
    "jumps": (("jump",), lambda limits: f" over {limits.speeds[1]:g} m/s"),
}
"""What is counted while a flight is cleaned, and how it is told."""


def _groups(flight: Any, rows: int) -> dict[str, Any]:
    """Rows of every flight of a file, by its name; one without a name where the file names none."""
    if flight is None:
        return {"": slice(None)}
    names = numpy.array(
        [str(value).strip() if value is not None else "" for value in numpy.asarray(flight).tolist()]
    )
    different, which = numpy.unique(names, return_inverse=True)
    if len(different) == 1:
        return {"": slice(None)}
    order = numpy.argsort(which, kind="stable")
    ends = numpy.cumsum(numpy.bincount(which))[:-1]
    return dict(zip(different.tolist(), numpy.split(order, ends), strict=True))


def _around(
    site: tuple[float, float] | None, values: Mapping[str, numpy.ndarray]
) -> dict[str, numpy.ndarray]:
    """Metres east and north of a site.

    Raises:
        ValueError: without a site, and for what are no degrees.
    """
    latitude, longitude = values["latitude"], values["longitude"]
    for name, array, most in (("latitude", latitude, 90.0), ("longitude", longitude, 360.0)):
        if (numpy.abs(array) > most).any():
            largest = float(numpy.nanmax(numpy.abs(array)))
            raise ValueError(
                f"{name} reaches {largest:g}, and degrees are expected: are they metres, or radians?"
            )
    if site is None:
        raise ValueError(
            "it has latitude and longitude: give the radar's, --site LATITUDE,LONGITUDE, or in Python "
            "filtergym.read_flights(..., site=(latitude, longitude))"
        )
    altitude = values.get("altitude", numpy.zeros_like(latitude))
    known = numpy.isfinite(altitude)
    if not known.all():
        # What lacks is a few rows, and a kilometre of height moves a target by 0.016 % of its range.
        rows = numpy.arange(len(altitude))
        altitude = (
            numpy.interp(rows, rows[known], altitude[known]) if known.any() else numpy.zeros_like(latitude)
        )
    return dict(zip("xy", east_north(numpy.stack([latitude, longitude]), altitude, site), strict=True))


def east_north(degrees: numpy.ndarray, altitude: numpy.ndarray, site: tuple[float, float]) -> numpy.ndarray:
    """Metres east and north of a site on the ellipsoid, in the plane that touches it there, ``(2, n)``.

    Args:
        degrees: latitude and longitude, ``(2, n)``.
        altitude: above the ellipsoid, m, ``(n,)``.
        site: latitude and longitude, degrees.
    """
    origin = numpy.radians(site)
    away = earth_fixed(*numpy.radians(degrees), altitude) - earth_fixed(*origin, 0.0)[:, None]
    return (east_north_up(*origin) @ away)[:2]


def _cleaned(
    name: str, time: numpy.ndarray, values: Mapping[str, numpy.ndarray], limits: _Limits, geodetic: bool
) -> tuple[list[Trajectory], dict[str, int]]:
    """Cut one flight into pieces.

    Returns:
        The pieces, and how much of what ``_COUNTED`` names there was.

    Raises:
        ValueError: if it cannot be a flight, with the likely cause.
    """
    counts = dict.fromkeys(_COUNTED, 0)
    position = numpy.stack([values["x"], values["y"]], axis=1)
    velocity = numpy.stack([values["vx"], values["vy"]], axis=1) if "vx" in values else None

    def keep(there: numpy.ndarray, what: str) -> None:
        nonlocal time, position, velocity
        counts[what] += int((~there).sum())
        time, position = time[there], position[there]
        velocity = None if velocity is None else velocity[there]

    keep(numpy.isfinite(position).all(axis=1), "missing")
    if velocity is not None:
        keep(numpy.isfinite(velocity).all(axis=1), "missing")
    steps = numpy.diff(time)
    if (steps <= 0.0).any():
        row = int((steps <= 0.0).argmax()) + 1
        raise ValueError(f"times must increase, but row {row} has {time[row]:g} s after {time[row - 1]:g} s")
    if geodetic:
        # A receiver repeats the last position where it has no new one.
        repeated = numpy.zeros(len(time), dtype=bool)
        repeated[1:] = (numpy.diff(position, axis=0) == 0.0).all(axis=1)
        keep(~repeated, "repeated")
        keep(numpy.hypot(*position.T) <= limits.reach, "far")
        if not len(time):
            raise ValueError(f"it never comes within {limits.reach / 1e3:g} km of the site")
    if len(time) < 2:
        raise ValueError(f"a flight needs at least two positions, got {len(time)}")
    _check_units(time, position, velocity, limits)
    lowest, highest = limits.speeds

    def pace(apart: int) -> numpy.ndarray:
        moved = numpy.hypot(*(position[apart:] - position[:-apart]).T)
        return numpy.asarray(moved / (time[apart:] - time[:-apart]))

    too_fast = pace(1) > highest
    if len(time) > 2:
        alone = numpy.zeros(len(time), dtype=bool)
        alone[1:-1] = too_fast[:-1] & too_fast[1:] & (pace(2) <= highest)
        keep(~alone, "outliers")
    gaps, jumps = numpy.diff(time) > limits.longest_gap, pace(1) > highest
    counts["gaps"], counts["jumps"] = int(gaps.sum()), int((jumps & ~gaps).sum())
    ends = [0, *(numpy.flatnonzero(gaps | jumps) + 1).tolist(), len(time)]
    parts = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    long = [part for part in parts if part.stop - part.start > 1]
    return [
        Trajectory(
            time[part],
            position[part],
            None if velocity is None else velocity[part],
            name if len(parts) == 1 else f"{name} {i}/{len(long)}",
            name,
        )
        for i, part in enumerate(long, 1)
    ], counts


def _check_units(
    time: numpy.ndarray, position: numpy.ndarray, velocity: numpy.ndarray | None, limits: _Limits
) -> None:
    """Raise ValueError with the likely cause if a flight cannot be in seconds and metres."""
    steps = numpy.diff(time)
    speed = float(numpy.median(numpy.hypot(*numpy.diff(position, axis=0).T) / steps))
    step = float(numpy.median(steps))
    lowest, highest = limits.speeds
    if speed < lowest:
        inside = (numpy.abs(position) <= (360.0, 90.0)).all() or (numpy.abs(position) <= (90.0, 360.0)).all()
        if inside and 10.0 <= 111e3 * speed <= 400.0:
            cause = "are x, y degrees? then call them longitude and latitude"
        elif lowest <= 1e3 * speed <= highest:
            cause = "are the times milliseconds?" if step >= 100.0 else "are x, y kilometres?"
        else:
            cause = "does it move at all? else allow lower speeds"
        raise ValueError(f"median speed {speed:.2g} m/s: {cause}")
    if speed > highest:
        factors = {"minutes": 60.0, "hours": 3600.0, "days": 86400.0}
        unit = next((unit for unit, factor in factors.items() if 10.0 <= speed / factor <= 400.0), None)
        cause = (
            f"are the times {unit}?"
            if unit
            else "are x, y metres and the times seconds? else allow higher speeds"
        )
        raise ValueError(f"median speed {speed:.4g} m/s: {cause}")
    if step > limits.longest_gap:
        raise ValueError(
            f"its positions are {step:g} s apart, longer than the longest gap of {limits.longest_gap:g} s: allow a "
            "longer gap"
        )
    if velocity is not None:
        ratio = float(numpy.median(numpy.hypot(*velocity.T))) / speed
        if not 0.8 <= ratio <= 1.25:
            usual = {"knots": 1.944, "km/h": 3.6, "feet per second": 3.281, "km/s": 1e-3}
            unit = next((unit for unit, factor in usual.items() if abs(ratio / factor - 1.0) < 0.05), None)
            raise ValueError(
                f"vx, vy are {ratio:.3g} times what the positions say: "
                + (f"are they {unit}?" if unit else "are they m/s, and x and y metres?")
            )
