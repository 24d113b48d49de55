"""Readers of tables of flights and of recordings, by the names of their columns.

A file is read completely or rejected, with the limits of :mod:`.foreign_files`.
"""

import csv
import gzip
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

import numpy

from ..contract.parameters import quote_shortened
from ..data.clock import SINCE_1970, time_unit
from ..data.foreign_files import (
    MOST_NUMBERS,
    limits,
    memory_limit_error,
    open_foreign,
    parse_apart,
    parse_json,
    read_content,
)
from ..data.foreign_parsers import MOST_COLUMNS, check_cells, check_column_names, check_rows
from .receiver_logs import RECEIVER_READERS, receiver_columns

if TYPE_CHECKING:  # imported where they are used: `import filtergym` takes neither
    import pandas
    import xarray

FLIGHT_SUFFIXES = (".csv", ".nc", ".parquet", ".json", ".json.gz", *RECEIVER_READERS)
"""Suffixes of the files that can be read."""
MOST_ROWS = 1_000_000
"""Largest number of rows of a file: a day of one target at ten a second; more would fill the memory."""
LONGEST_LINE = 1_000_000
"""Longest row of CSV, characters."""
EXTRA = "pip install 'filtergym[flights]'"

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
"""Columns and their accepted names: the first that a file has is read; case does not matter.

``time`` in seconds, in ISO 8601 or as dates of any resolution; ``x``, ``y`` in metres, ``vx``, ``vy`` in m/s; or
latitude and longitude in degrees, altitude in metres. The state vectors of OpenSky have this form. Files of the Python
package ``traffic``, recognised by ``groundspeed``, have altitudes in feet. Rows of one ``flight`` belong together, in
the order of their times; rows on the ``ground`` are left out."""
FOOT = 0.3048
DELIMITERS = ",;\t"
"""Delimiters of cells in CSV: the first of these in the line of names applies."""
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
DATE = re.compile(
    r"(?:(?P<y>\d{4})/(?P<m>\d{1,2})/(?P<d>\d{1,2})|(?P<D>\d{1,2})\.(?P<M>\d{1,2})\.(?P<Y>\d{4}))(?=[ T]|$)"
)
"""Dates as year/month/day or day.month.year."""
CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:\.\d+)?)")
OFFSET = r":\d{2}.*(?:[Zz]|[+-]\d{2}(?::?\d{2})?)$"
"""Offset of local time from UTC, at the end of a date."""
DAY = 86400.0
COUNTERS = (2.0**32, 2.0**32 / 1e3, 2.0**32 / 1e6)
"""Ranges after which counters of 32 bits restart, in their unit, or in s for milli- and microseconds."""
COUNTER_SHARE = 0.01
"""Largest step between two rows at a restart, as a share of the range."""
UNITS: Mapping[str, tuple[str, ...]] = {
    "time": ("s", "second", "seconds", "sec"),
    "x": ("m", "metre", "metres", "meter", "meters"),
    "y": ("m", "metre", "metres", "meter", "meters"),
    "vx": ("m/s", "m s-1", "m s^-1", "m s**-1"),
    "vy": ("m/s", "m s-1", "m s^-1", "m s**-1"),
    "altitude": ("m", "metre", "metres", "meter", "meters"),
}
"""Accepted units of NetCDF variables."""


class FlightTable(NamedTuple):
    """Columns read from a file, names of all its columns, and notes."""

    columns: "pandas.DataFrame"
    """Known columns by their names in lower case; empty cells are missing values."""
    names: list[str]
    """Names of all columns of the file."""
    notes: tuple[str, ...] = ()
    """Notes on the reading, one line each."""


class ColumnNames(frozenset[str]):
    """Set of the names of columns to read, in lower case, and a prefix of further ones."""

    prefix: str

    def __new__(cls, names: Iterable[str], prefix: str = "") -> "ColumnNames":
        """Return a set of names, and a prefix of further ones."""
        found = super().__new__(cls, names)
        found.prefix = prefix
        return found

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or bool(self.prefix and str(name).startswith(self.prefix))

    @property
    def request(self) -> dict[str, Any]:
        """Names and prefix as arguments of a parser in a subprocess."""
        return {"names": sorted(self), "prefix": self.prefix}


def _csv(file: Path, known: ColumnNames) -> FlightTable:
    import pandas

    with open_foreign(file) as content, io.TextIOWrapper(content, encoding="utf-8-sig", newline="") as text:
        lines = _bounded_lines(text)
        header = next(lines, "")
        delimiter = next((d for d in DELIMITERS if d in header), DELIMITERS[0])
        names = [name.strip() for row in csv.reader([header], delimiter=delimiter) for name in row]
        lower = check_column_names(names)
        wanted = {name: i for i, name in enumerate(lower) if name in known}
        rows = []
        # Not read_csv of pandas, which fills up rows that are too short, and before its version 3.1 rounds numbers.
        for number, row in enumerate(csv.reader(lines, delimiter=delimiter)):
            if row and len(row) != len(names):
                raise ValueError(f"{len(names)} column names but {len(row)} columns in row {number}")
            check_rows(number + 1, MOST_ROWS)
            if row:
                rows.append([row[i] for i in wanted.values()])
    if delimiter != ",":
        rows = [[*row] for row in zip(*map(_replace_decimal_commas, zip(*rows, strict=True)), strict=True)]
    columns = pandas.DataFrame(rows, columns=list(wanted), dtype=object)
    return FlightTable(columns.mask(columns.eq("")), names)


def _bounded_lines(text: TextIO) -> Iterator[str]:
    while line := text.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise ValueError(f"it has a line of more than {LONGEST_LINE:,} characters, and no row is so long")
        yield line


def _replace_decimal_commas(cells: Sequence[str]) -> Sequence[str]:
    """Return the cells with decimal points in place of commas, if the column has no points."""
    if not any("," in cell for cell in cells) or any("." in cell for cell in cells):
        return cells
    return [cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell.strip()) else cell for cell in cells]


def open_netcdf(file: Path, wanted: ColumnNames | None = None, **decoding: Any) -> "xarray.Dataset":
    """Return the content of a NetCDF file, version 3 or 4, as a decoded dataset.

    Args:
        file: its path.
        wanted: names of the variables that are read, others are empty; None: all are read.
        **decoding: arguments of ``xarray.decode_cf``, which applies the attributes for offsets, dates, missing values.

    Raises:
        ValueError: if the file is not NetCDF, exceeds a limit, or needs a package that is not installed.
    """
    import xarray

    return xarray.decode_cf(_read_netcdf_variables(file, wanted), **decoding)


def _is_hdf(file: Path) -> bool:
    with open_foreign(file) as content:
        start = content.read(4)
    if not start:
        raise ValueError("it is empty")
    if start != b"\x89HDF" and start[:3] != b"CDF":
        raise ValueError("it is no NetCDF")
    return start == b"\x89HDF"


def netcdf_attribute_names(file: Path) -> list[str]:
    """Return the names of the attributes in a NetCDF file.

    Raises:
        ValueError: if the file is not NetCDF, or needs a package that is not installed.
    """
    if _is_hdf(file):
        found: list[str] = parse_apart("netcdf4_names", file, EXTRA)["names"]
        return found
    return [str(name) for name in _read_netcdf_variables(file).attrs]


def _read_netcdf_variables(file: Path, wanted: ColumnNames | None = None) -> "xarray.Dataset":
    import xarray

    if not _is_hdf(file):
        # From memory: a mapped file stays open where its reading fails.
        content = io.BytesIO(read_content(file))
        with xarray.open_dataset(content, engine="scipy", decode_cf=False) as data:
            numbers = sum(variable.size for variable in data.variables.values())
            if numbers > MOST_NUMBERS:
                raise ValueError(
                    f"it holds {numbers:,} numbers, more than the limit of {MOST_NUMBERS:,}: split it"
                )
            return data.load()
    found = parse_apart(
        "netcdf4",
        file,
        EXTRA,
        wanted=None if wanted is None else wanted.request,
        bytes_limit=limits().memory,
        numbers_limit=MOST_NUMBERS,
    )
    variables = {}
    for name, dimensions, values, attributes in found["variables"]:
        if isinstance(values, dict):
            cells = numpy.array(values["words"], dtype=object)
            values = cells.reshape(values["shape"])
        if values is None:  # only the name is needed
            dimensions, values = [], numpy.nan
        variables[name] = (dimensions, values, _plain_attributes(attributes))
    return xarray.Dataset(variables, attrs=_plain_attributes(found["attrs"]))


def _plain_attributes(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    return {
        name: value[()] if isinstance(value, numpy.ndarray) and value.ndim == 0 else value
        for name, value in pairs
    }


def _netcdf(file: Path, known: ColumnNames) -> FlightTable:
    import pandas

    with open_netcdf(file, known, decode_timedelta=False) as data:
        names = list(map(str, data.variables))
        columns: dict[str, Any] = {}
        for name, lower in zip(names, check_column_names(names), strict=True):
            if lower not in known:
                continue
            check_rows(data[name].size, MOST_ROWS)
            unit, meant = str(data[name].attrs.get("units", "")), UNITS.get(_COLUMN_OF_ALIAS.get(lower, ""))
            if unit and meant and unit not in meant:
                raise ValueError(f"{name} is in {quote_shortened(unit)}, and {meant[0]!r} is expected")
            values = data[name].values
            first = next(iter(columns.values()), values)
            if values.ndim != 1 or values.shape != first.shape:
                raise ValueError(
                    f"{name} must be one row of numbers, as many as of time, got shape {values.shape}"
                )
            columns[lower] = values.astype(values.dtype.newbyteorder("="))
    return FlightTable(pandas.DataFrame(columns), names)


def _parquet(file: Path, known: ColumnNames) -> FlightTable:
    import pandas

    found = parse_apart(
        "parquet", file, EXTRA, wanted=known.request, rows_limit=MOST_ROWS, bytes_limit=limits().memory
    )
    columns = {name.lower(): _parquet_column(column) for name, column in found["columns"]}
    return FlightTable(pandas.DataFrame(columns), found["names"])


def _parquet_column(column: Mapping[str, Any]) -> Any:
    import pandas

    if "codes" in column:
        words = numpy.array([*column["words"], None], dtype=object)
        return words[column["codes"]]
    if "numbers" in column:
        return column["numbers"]
    dates = pandas.Series(column["dates"])
    return dates.dt.tz_localize("UTC").dt.tz_convert(column["zone"]) if column["zone"] else dates


def _json(file: Path, known: ColumnNames) -> FlightTable:
    import pandas

    most = limits().memory // 3  # the text and the objects made from it
    with open_foreign(file, limits().memory) as content:
        text = (gzip.GzipFile(fileobj=content) if file.suffix == ".gz" else content).read(most + 1)
    if len(text) > most:
        raise memory_limit_error(f"its text has more than {most / 1e6:,.0f} MB")
    rows = parse_json(text)
    # A list of rows, or columns, each with the numbers of its rows.
    parts = list(rows.values()) if isinstance(rows, dict) else rows
    if not isinstance(rows, list | dict) or not rows or not all(isinstance(part, dict) for part in parts):
        raise ValueError("JSON of flights is a list of rows, each with the names of its columns")
    check_rows(len(rows) if isinstance(rows, list) else max(map(len, parts)), MOST_ROWS)
    seen: dict[str, None] = {}
    for part in parts if isinstance(rows, list) else [rows]:
        seen.update(dict.fromkeys(part))
        if len(seen) > MOST_COLUMNS:
            break
    names = [*seen]
    # Only known names: a name that a single row has would make a column of a million empty cells.
    chosen = {n: lower for n, lower in zip(names, check_column_names(names), strict=True) if lower in known}
    if isinstance(rows, list):
        found = pandas.DataFrame({n: [row.get(n, math.nan) for row in rows] for n in chosen})
    else:
        found = pandas.DataFrame({n: rows[n] for n in chosen}).reset_index(drop=True)
    return FlightTable(found.rename(columns=chosen), names)


def _receiver(file: Path, known: ColumnNames) -> FlightTable:
    columns, notes = receiver_columns(file, suffix_of(file), MOST_ROWS)
    return FlightTable(columns[[name for name in columns if name in known]], list(columns), notes)


_READERS = {".csv": _csv, ".nc": _netcdf, ".parquet": _parquet, ".json": _json, ".json.gz": _json}
_READERS |= dict.fromkeys(RECEIVER_READERS, _receiver)
_COLUMN_OF_ALIAS = {alias: name for name, aliases in COLUMNS.items() for alias in aliases}


def suffix_of(file: Path) -> str:
    """Return the suffix of a file, such as ``.json.gz``; empty if it is none of ``FLIGHT_SUFFIXES``."""
    return next((suffix for suffix in FLIGHT_SUFFIXES if file.name.endswith(suffix)), "")


def read_table(file: Path, known: Iterable[str] = _COLUMN_OF_ALIAS) -> FlightTable:
    """Read a table from a file: return its known columns, the names of all columns, and notes.

    Args:
        file: path with one of ``FLIGHT_SUFFIXES``.
        known: names in lower case; default: those of flights.

    Raises:
        ValueError: if the file cannot be read, or is too large.
    """
    try:
        if not suffix_of(file):
            raise ValueError(f"files of flights end in {', '.join(FLIGHT_SUFFIXES)}")
        wanted = known if isinstance(known, ColumnNames) else ColumnNames(known)
        table = _READERS[suffix_of(file)](file, wanted)
        for name, cells in table.columns.items():
            if cells.dtype.kind == "O":  # text, in any dtype of pandas
                check_cells(str(name), cells)
        return table
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8: save it as such (a spreadsheet: CSV UTF-8)") from error
    except Exception as error:  # readers raise any error for a broken file
        raise ValueError(str(error) or type(error).__name__) from error


def list_names(names: Sequence[str], most: int = 20) -> str:
    """Return the first names as one text, with the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most:,} more" if len(names) > most else "")


def flight_columns(table: FlightTable) -> tuple["pandas.DataFrame", bool]:
    """Return the columns of a flight under their standard names, and whether altitudes are in feet.

    Raises:
        ValueError: if a column is missing.
    """
    there = {
        name: [alias for alias in aliases if alias in table.columns] for name, aliases in COLUMNS.items()
    }
    found = {aliases[0]: name for name, aliases in there.items() if aliases}
    columns = table.columns[[*found]].rename(columns=found)
    missing = [] if "time" in columns else ["time"]
    position = [("x", "y"), ("latitude", "longitude")]
    if not any({*pair} <= {*columns} for pair in position):
        geodetic = {"latitude", "longitude"} & {*columns}
        missing += [name for name in position[bool(geodetic)] if name not in columns]
    if missing:
        raise ValueError(
            f"it lacks the column {', '.join(missing)}; it has {list_names(table.names)} and needs time, x, y (m) and "
            "optionally vx, vy (m/s), or time, latitude, longitude (degrees)"
        )
    return columns, "groundspeed" in map(str.lower, table.names)


def numbers(name: str, values: "pandas.Series") -> "pandas.Series":
    """Return a column of numbers or text as numbers; empty cells are NaN.

    Raises:
        ValueError: for a cell that is no number.
    """
    import pandas

    if pandas.api.types.is_numeric_dtype(values):
        return values.astype(float)
    cells = values.astype(object).where(values.notna() & values.ne(""), math.nan)
    try:
        return cells.map(float)
    except (ValueError, TypeError, OverflowError):
        row = next(row for row, cell in cells.items() if not _is_number(cell))
        raise ValueError(
            f"{name} has {quote_shortened(cells[row])} in row {row}, which is no number"
        ) from None


def _is_number(cell: Any) -> bool:
    try:
        float(cell)
    except (ValueError, TypeError, OverflowError):
        return False
    return True


def is_true(values: "pandas.Series") -> "pandas.Series":
    """Return a mask of the rows with a true value, as text or as a number; an empty cell is false."""
    return values.astype(str).str.strip().str.lower().isin(["true", "1", "1.0"])


def _rewrite_date(date: Any) -> str:
    word = re.sub(r"(:\d{2}),(\d)", r"\1.\2", str(date).strip())
    found = DATE.match(word)
    if found is None:
        return word
    year, month, day = (found[name] or found[name.swapcase()] for name in "ymd")
    return f"{year}-{month:>02}-{day:>02}{word[found.end() :]}"


def _parse_times_of_day(values: "pandas.Series") -> "pandas.Series":
    found = values.map(CLOCK.fullmatch)
    if found.isna().any():
        row = found.isna().idxmax()
        raise ValueError(
            f"time has {quote_shortened(values[row])} in row {row}, which is no time of day such as 12:00:00"
        )
    time = found.map(lambda parts: 3600.0 * int(parts[1]) + 60.0 * int(parts[2]) + float(parts[3]))
    return time + DAY * (time.diff() < -0.5 * DAY).cumsum()


def clock_seconds(values: "pandas.Series") -> tuple[str, numpy.ndarray]:
    """Return the kind of clock and the times in seconds, which are comparable between files.

    The kinds are ``dates``, since 1970, to a microsecond; ``times of day``, since midnight; and ``seconds`` as given.

    Args:
        values: times in any form of :func:`seconds`; numbers from 1e8 on count since 1970.

    Raises:
        ValueError: for a value that is no time.
    """
    import pandas

    found, unit = _parse_times(values)
    if pandas.api.types.is_datetime64_any_dtype(found):
        since = pandas.Timestamp(0, tz="UTC" if found.dt.tz is not None else None)
        return "dates", ((found - since) / pandas.Timedelta(seconds=1)).to_numpy()
    if pandas.api.types.is_timedelta64_dtype(found):
        return "seconds", (found / pandas.Timedelta(seconds=1)).to_numpy()
    first = next(iter(values.dropna()), None)
    if isinstance(first, str) and CLOCK.fullmatch(first.strip()):
        return "times of day", found.to_numpy()
    if not numpy.isfinite(found).all():
        raise ValueError(f"time has no value in row {found.isna().idxmax()}")
    dates = unit > 1.0 or (len(found) > 0 and found.iloc[0] >= SINCE_1970)
    return "dates" if dates else "seconds", (found / unit).to_numpy()


def describe_time(clock: str, time: float) -> str:
    """Return a time of :func:`clock_seconds` as readable text."""
    if clock != "dates":
        return f"{time:g} s"
    return str(numpy.datetime64(round(time), "s"))


def check_order(time: numpy.ndarray, written: numpy.ndarray | None = None) -> None:
    """Raise ValueError, with advice, if times decrease.

    Args:
        time: s, ``(rows,)``.
        written: times as written in the file, ``(rows,)``; default: ``time``.
    """
    steps = numpy.diff(time)
    if (steps < 0.0).any():
        row = int((steps < 0.0).argmax())
        turn = _counter_turn(steps[row])
        before, after = (
            t if isinstance(t, str) else numpy.format_float_positional(t, trim="-")
            for t in (time if written is None else written)[row : row + 2]
        )
        hint = "--sort (sort=True of read_recording) sorts the rows by time"
        if turn is not None:
            hint = f"a counter that starts again: add {turn:.10g} to the times from row {row + 1} on"
        elif steps[row] <= -1800.0 and (steps < 0.0).sum() <= 2:
            hint += ", or write times in UTC if the clock was changed"
        raise ValueError(f"time decreases from {before} in row {row} to {after} in row {row + 1}: {hint}")


def _counter_turn(step: float) -> float | None:
    """Return the range of a counter that wraps around at a step of time, s; None for other steps."""
    return next((turn for turn in COUNTERS if abs(step + turn) < COUNTER_SHARE * turn), None)


def sort_by_time(
    table: "pandas.DataFrame", times: "pandas.Series", group: numpy.ndarray | None = None
) -> tuple["pandas.DataFrame", tuple[str, ...]]:
    """Return a table's rows sorted by time, unless a counter wraps around, and a note on rows out of order.

    Args:
        table: rows, numbered from zero.
        times: times of the rows, as written.
        group: number of the recording of each row, ``(rows,)``; default: one recording.

    Returns:
        The rows, grouped by recording, and a note with the number of rows out of order, if any.
    """
    import pandas

    group = numpy.zeros(len(table), dtype=int) if group is None else group
    time = pandas.Series(seconds(times).to_numpy(dtype=float))
    each = time.groupby(group)
    late = int((time < each.cummax()).sum())
    if not late or any(_counter_turn(step) for step in each.diff().dropna().to_numpy()):
        return table, ()
    note = f"sorted by time: {late:,} of {len(table):,} rows stood after later ones"
    return table.iloc[numpy.lexsort((time.to_numpy(), group))].reset_index(drop=True), (note,)


def seconds(values: "pandas.Series") -> "pandas.Series":
    """Return times in seconds: numbers as they are, dates since the first of them, times of day since midnight.

    Times of day that decrease by more than half a day are those of the next day. Dates are ISO 8601, with an offset
    from UTC or without, or year/month/day or day.month.year and a time of day. Numbers too large for seconds since 1970
    are milli-, micro- or nanoseconds since then.

    Raises:
        ValueError: for a value in none of these forms.
    """
    import pandas

    found, unit = _parse_times(values)
    if not pandas.api.types.is_numeric_dtype(found):
        # Not total_seconds of pandas, which can be wrong in the last bit.
        return (found - found.iloc[:1].squeeze()) / pandas.Timedelta(seconds=1)
    return found if unit == 1.0 else (found - found.iloc[0]) / unit


def _parse_times(values: "pandas.Series") -> tuple["pandas.Series", float]:
    """Return the dates, time differences or numbers in a column, and how many of these units are a second."""
    import pandas

    types = pandas.api.types
    first = next(iter(values.dropna()), None)
    if isinstance(first, str) and first and pandas.isna(pandas.to_numeric(first, errors="coerce")):
        values = values.astype(object).where(values.notna(), "").map(_rewrite_date)
        if CLOCK.fullmatch(values.iloc[0]):
            return _parse_times_of_day(values), 1.0
        offset = values.str.contains(OFFSET)
        if offset.any() and not offset.all():
            raise ValueError(
                f"time has {quote_shortened(values[offset.idxmin()])} in row {offset.idxmin()}, without the offset "
                "from UTC that other rows have: write it in all of them"
            )
        dates = pandas.to_datetime(values, utc=True, format="ISO8601", errors="coerce")
        if dates.isna().any():
            row = dates.isna().idxmax()
            raise ValueError(
                f"time has {quote_shortened(values[row])} in row {row}, which is neither seconds nor a date such as "
                "2026-05-01T12:00:00Z"
            )
        values = dates
    if types.is_datetime64_any_dtype(values) or types.is_timedelta64_dtype(values):
        if values.isna().any():
            raise ValueError(f"time has no value in row {values.isna().idxmax()}")
        return values, 1.0
    found = numbers("time", values)
    return found, time_unit(found.iloc[0] if len(found) else 0.0)
