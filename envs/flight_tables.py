"""Tables of recorded flights in files, read by the names of their columns.

Read whole or not at all: more rows than ``MOST_ROWS`` are refused before they fill the memory.
"""

import csv
import gzip
import io
import json
import math
from collections.abc import Container, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy

if TYPE_CHECKING:
    import xarray

FLIGHT_SUFFIXES = (".csv", ".nc", ".parquet", ".json", ".json.gz")
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
    "ground": ("onground", "on_ground"),
}
"""What is read, and the names under which it is known, the first one that a file has; upper and lower case are alike.

``time`` in seconds, in ISO 8601 or as dates of any resolution; ``x``, ``y`` in metres, ``vx``, ``vy`` in m/s; or
latitude and longitude in degrees, altitude in metres. The state vectors of OpenSky are of this form. Of the Python
package ``traffic``, known by its ``groundspeed``, altitudes are feet. Rows of one ``flight`` belong together, in the
order of their times; rows on the ``ground`` are not flown.
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


def _rows_refused(rows: int) -> ValueError:
    return ValueError(f"it has more than {MOST_ROWS:,} rows ({rows:,}): split it, or keep fewer a second")


def _csv(file: Path, known: Container[str]) -> dict[str, Any]:
    with file.open(encoding="utf-8-sig", newline="") as lines:
        header = lines.readline()
        delimiter = next((d for d in ",;\t" if d in header), ",")
        names = [name.strip().strip('"') for name in header.strip().split(delimiter)]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"it has the column {', '.join(sorted(twice))} more than once")
        wanted = [i for i, name in enumerate(names) if name.lower() in known]
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


def opened_netcdf(file: Path, **decoding: Any) -> "xarray.Dataset":
    """Open a NetCDF file, of the third or the fourth version.

    Args:
        file: its path.
        **decoding: as of ``xarray.open_dataset``.

    Raises:
        ValueError: if it is none, or needs a package that is not installed.
    """
    import xarray

    # From memory: a mapped file stays open where its reading fails.
    content = file.read_bytes()
    if not content:
        raise ValueError("it is empty")
    engine: Any = "h5netcdf" if content.startswith(b"\x89HDF") else "scipy"
    if engine == "scipy" and not content.startswith(b"CDF"):
        raise ValueError("it is no NetCDF")
    if engine == "h5netcdf" and engine not in xarray.backends.list_engines():
        raise ValueError("NetCDF-4 needs one more package: pip install 'filtergym[flights]'")
    return xarray.open_dataset(io.BytesIO(content), engine=engine, **decoding)


def _netcdf(file: Path, known: Container[str]) -> dict[str, Any]:
    with opened_netcdf(file, decode_timedelta=False) as data:
        table: dict[str, Any] = dict.fromkeys(map(str, data.variables))
        for name in table:
            if name.lower() not in known:
                continue
            meant = _WANTED.get(name.lower(), "")
            if data[name].size > MOST_ROWS:
                raise _rows_refused(data[name].size)
            unit = str(data[name].attrs.get("units", ""))
            if unit and meant in UNITS and unit not in UNITS[meant]:
                raise ValueError(f"{name} is in {unit!r}, and {UNITS[meant][0]!r} is expected")
            table[name] = data[name].values
    return table


def _parquet(file: Path, known: Container[str]) -> dict[str, Any]:
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise ValueError("Parquet needs one more package: pip install 'filtergym[flights]'") from error
    with parquet.ParquetFile(file) as data:
        table: dict[str, Any] = dict.fromkeys(data.schema_arrow.names)
        if data.metadata.num_rows > MOST_ROWS:
            raise _rows_refused(data.metadata.num_rows)
        wanted = [name for name in table if name.lower() in known]
        found = data.read(columns=wanted)
    return table | {name: found.column(name).to_numpy() for name in wanted}


def _json(file: Path, known: Container[str]) -> dict[str, Any]:
    with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as content:
        text = content.read(MOST_BYTES + 1)
    if len(text) > MOST_BYTES:
        raise ValueError(f"it is larger than {MOST_BYTES / 1e9:g} GB: split it")
    rows = json.loads(text)
    if isinstance(rows, dict) and all(isinstance(column, dict) for column in rows.values()):
        # By columns, each with the numbers of its rows.
        rows = [
            dict(zip(rows, row, strict=True))
            for row in zip(*(c.values() for c in rows.values()), strict=True)
        ]
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise ValueError("JSON of flights is a list of rows, each with the names of its columns")
    if len(rows) > MOST_ROWS:
        raise _rows_refused(len(rows))
    table: dict[str, Any] = dict.fromkeys(name for row in rows for name in row)
    for name in table:
        if name.lower() in known:
            table[name] = numpy.array([row.get(name) for row in rows], dtype=object)
    return table


_TABLES = {".csv": _csv, ".nc": _netcdf, ".parquet": _parquet, ".json": _json, ".json.gz": _json}
_WANTED = {alias: name for name, aliases in COLUMNS.items() for alias in aliases}


def suffix_of(file: Path) -> str:
    """Last part of a file's name, ``.json.gz`` for one; empty if it is not of a file of flights."""
    return next((suffix for suffix in FLIGHT_SUFFIXES if file.name.endswith(suffix)), "")


def read_table(file: Path, known: Container[str] | None = None) -> dict[str, Any]:
    """Return all columns of a file by their names; those that are not known are None.

    Args:
        file: of one of ``FLIGHT_SUFFIXES``.
        known: names in lower case; default: those of flights.

    Raises:
        ValueError: if it cannot be read, or is too large.
    """
    try:
        if not suffix_of(file):
            raise ValueError(f"files of flights end in {', '.join(FLIGHT_SUFFIXES)}")
        if file.stat().st_size > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES / 1e9:g} GB: split it")
        return _TABLES[suffix_of(file)](file, _WANTED if known is None else known)
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8") from error
    except Exception as error:  # readers raise whatever a broken file makes them stumble over
        raise ValueError(str(error) or type(error).__name__) from error


def known_columns(table: Mapping[str, Any]) -> tuple[dict[str, numpy.ndarray], bool]:
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


def numbers(name: str, values: Any) -> numpy.ndarray:
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


def on_ground(values: Any) -> numpy.ndarray:
    """Whether each row says that the aircraft is on the ground; what says nothing is in the air."""
    return numpy.array(
        [str(value).strip().lower() in ("true", "1", "1.0") for value in numpy.asarray(values).tolist()]
    )


def seconds(values: Any) -> numpy.ndarray:
    """Times in seconds: numbers as they are, dates since the first of them.

    Numbers too large for seconds since 1970 are milli-, micro- or nanoseconds since then.

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
    found = numbers("time", array)
    first = found[0] if len(found) else 0.0
    # 1e11 seconds after 1970 is the year 5138, 1e11 milliseconds 1973; and so on in steps of a thousand.
    unit = next((unit for unit in (1e9, 1e6, 1e3) if first > 1e8 * unit), 1.0)
    return found if unit == 1.0 else (found - first) / unit
