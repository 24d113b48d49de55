"""Readers that turn tables of real measurements into recordings.

An environment declares its columns and makes measurements of them (:class:`.LogFormat`). Common to all tables are
times, missing values, duplicate rows, several recordings in one file, latitude and longitude, and true values,
``truth_NAME``.
"""

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ...filters.angles import PERIODS
from ...filters.geodesy import PlaneOrigin
from ..contract.companions import find_companion
from ..contract.live_input import LARGEST
from ..contract.log_format import RECORDING, TIME, TRUTH, LogFormat, TrackLog, check_deviations
from ..contract.task import Component, Task
from ..data.recorded_world import measure_once
from ..data.recording import Recording, stack_recordings
from .flight_tables import (
    COLUMNS,
    FLIGHT_SUFFIXES,
    ColumnNames,
    check_order,
    list_names,
    numbers,
    read_table,
    seconds,
    sort_by_time,
)
from .plausibility import WARNING_PREFIX, check_degrees, check_interval, limit_notes, unknown_column_notes
from .truth_files import match_truth, offset_note, read_truth

if TYPE_CHECKING:
    import pandas

GEODETIC = ("latitude", "longitude", "altitude")
"""Columns of a geodetic position, the last optional; the aliases of flights are accepted."""
LEFT_OUT = "-"
"""New name of a column that is to be ignored."""
TURN_SHARE = 0.05
"""Largest difference of a jump of an angle from a whole turn, as a share of a turn."""
MOST_TWICE = 0.1
"""Largest share of rows that may have the time of the previous row and other values."""
UNEVEN = 0.01
"""Largest deviation of a time of regular measurements, as a share of the sampling interval."""


class Columns:
    """Columns of one recording in a table, sorted by time.

    Args:
        table: numbers by column name, NaN where a cell is empty, with ``time`` in seconds. Its index
            counts the rows of the file.
        user_parameters: parameters that the user has set.
        log_time: times as written in the file, numbers or text, ``(rows,)``; default: those of the table.
    """

    def __init__(
        self,
        name: str,
        table: "pandas.DataFrame",
        user_parameters: Mapping[str, Any],
        log_time: numpy.ndarray | None = None,
    ) -> None:
        self.name = name
        self.table = table
        self.user_parameters = user_parameters
        self.log_time: numpy.ndarray = self.time if log_time is None else log_time
        self.notes: list[str] = []
        """Changes that were made to the table, one line each."""
        self.origin: PlaneOrigin | None = None
        """Origin of x (east) and y (north); None where the table has x and y itself."""

    def has(self, *names: str) -> bool:
        """Return whether the table has a column under each of these names."""
        return {*names} <= {*self.table}

    @property
    def time(self) -> numpy.ndarray:
        """Times of the rows, s, ``(rows,)``."""
        return self["time"]

    @property
    def true(self) -> list[str]:
        """Names of the columns with true values."""
        return [name for name in self.table if name.startswith(TRUTH)]

    def __getitem__(self, name: str) -> numpy.ndarray:
        return self.table[name].to_numpy()

    def place(self, number: int) -> str:
        """Return the place of a row in the file as text, such as ``row 12``."""
        return f"row {self.table.index[number]}"

    def only(self, rows: numpy.ndarray) -> "Columns":
        """Return a copy of the columns with only these rows."""
        return Columns(self.name, self.table[rows], self.user_parameters, self.log_time[rows])

    def drop_duplicates(self) -> None:
        """Merge rows of one time that fill each other's empty cells, drop further rows of that time, and note how many.

        Raises:
            ValueError: if many of them have other values than the previous row.
        """
        self._join_rows()
        same = numpy.append(False, numpy.diff(self.time) == 0.0)
        if not same.any():
            return
        kept = self.table[~same]
        first = kept.iloc[numpy.cumsum(~same) - 1].set_axis(self.table.index)
        other = same & ~((self.table == first) | (self.table.isna() & first.isna())).all(axis=1).to_numpy()
        row, count = int(same.argmax()), int(same.sum())
        if other.sum() > MOST_TWICE * len(same):
            raise ValueError(
                f"time is the same in rows {row - 1} and {row}: {other.sum():,} of {len(same):,} rows have the time of "
                "the row before and other values; write times with their fractions of a second"
            )
        what = "row has" if count == 1 else "rows have"
        differing = f", {other.sum():,} of them with other values" if other.any() else ""
        self.notes.append(
            f"{count:,} {what} the time of the row before{differing}: left out, the first is row {row}"
        )
        self.table, self.log_time = kept, self.log_time[~same]

    def _join_rows(self) -> None:
        begins = numpy.append(True, numpy.diff(self.time) != 0.0)
        if begins.all():
            return
        number = numpy.cumsum(begins) - 1
        groups, heads = self.table.groupby(number), self.table[begins]
        joined = groups.first()  # of each column the first value that is not missing
        differ = (groups.max() != groups.min()) & joined.notna()
        supplied = joined.notna().to_numpy().sum(axis=1) > heads.notna().to_numpy().sum(axis=1)
        supplied &= ~differ.any(axis=1).to_numpy()
        if not supplied.any():
            return
        whole = self.table.copy()
        whole.loc[heads.index[supplied]] = joined[supplied].set_axis(heads.index[supplied])
        kept = begins | ~supplied[number]
        self.notes.append(
            f"{(~kept).sum():,} rows joined with one of the same time, each with what the other lacks"
        )
        self.table, self.log_time = whole[kept], self.log_time[kept]

    def project_to_plane(self, plane: tuple[str, ...]) -> None:
        """Replace latitude and longitude by metres east and north of the first position; note the origin.

        The plane touches the ellipsoid there.

        Args:
            plane: names of the new columns, see :attr:`.LogFormat.plane`.

        Raises:
            ValueError: if the table has one of them already, or an angle is out of range.
        """
        for true, names in (("", plane[:2]), (TRUTH, plane[2:])):
            latitude, longitude, altitude = (true + name for name in GEODETIC)
            if not (self.has(latitude) or self.has(longitude)):
                continue
            for name in (latitude, longitude):
                if not self.has(name):
                    raise ValueError(
                        f"it lacks the column {name}: {latitude} and {longitude} are needed together"
                    )
            for name in names:
                if self.has(name):
                    raise ValueError(f"it has {name} and {latitude}: leave one of them out")
            self._drop_null_positions(latitude, longitude)
            check_degrees(latitude, self[latitude], 90.0)
            check_degrees(longitude, self[longitude], 360.0)
            there = numpy.isfinite(self[latitude]) & numpy.isfinite(self[longitude])
            if self.origin is None:
                if true:
                    raise ValueError(
                        f"it has {latitude} and no latitude, without which the origin of x and y is not known"
                    )
                if not there.any():
                    raise ValueError(f"no row has {latitude} and {longitude}")
                first = int(there.argmax())
                self.origin = PlaneOrigin(
                    float(self[latitude][first]), float(self[longitude][first]), self._usual_height(altitude)
                )
                self.notes.append(
                    f"x is east and y north of latitude {self.origin.latitude:.8f}, longitude "
                    f"{self.origin.longitude:.8f}, the first position"
                )
            name = altitude if self.has(altitude) else GEODETIC[2]
            usual = self.origin._replace(altitude=self._usual_height(name))
            height = self[name] if self.has(name) else numpy.full(len(self.time), numpy.nan)
            found = usual.east_north(self[latitude], self[longitude], height)
            self.table = self.table.assign(**dict(zip(names, found, strict=True)))

    def note_turns(self, angles: Collection[str]) -> None:
        """Add a note if true values jump by a whole turn, although they are not among the declared ``angles``."""
        for name in (name for name in self.true if name not in angles):
            steps = numpy.abs(numpy.diff(self[name]))
            for unit, period in PERIODS.items():
                jumps = numpy.abs(steps - period) < TURN_SHARE * period
                if jumps.any() and numpy.nanmedian(steps) < TURN_SHARE * period:
                    self.notes.append(
                        f"{name} jumps by a turn after row {jumps.argmax()}, and errors of whole turns count: declare "
                        f"angles={{{name.removeprefix(TRUTH)!r}: {unit!r}}}"
                    )

    def _drop_null_positions(self, latitude: str, longitude: str) -> None:
        """Replace positions at latitude and longitude 0, which receivers write without a fix, by NaN."""
        null = ((self.table[latitude] == 0.0) & (self.table[longitude] == 0.0)).to_numpy()
        if not null.any():
            return
        self.table = self.table.assign(
            **{name: self.table[name].mask(null) for name in (latitude, longitude)}
        )
        count = int(null.sum())
        self.notes.append(
            f"{count:,} position{'s' * (count > 1)} at {latitude} 0, {longitude} 0, the first in row {null.argmax()}: "
            "a receiver without a fix, no measurement"
        )

    def note_offset(self, plane: tuple[str, ...]) -> None:
        """Add a note if a clock offset of the truth would bring it nearer to the measurements in ``plane``."""
        if self.has(*plane):
            x, y, true_x, true_y = (self[name] for name in plane)
            found = offset_note(self.time, numpy.stack([x, y], axis=1), numpy.stack([true_x, true_y], axis=1))
            self.notes += [found] * bool(found)

    def _usual_height(self, name: str) -> float:
        height = self[name] if self.has(name) else numpy.zeros(0)
        there = numpy.isfinite(height)
        return float(numpy.median(height[there])) if there.any() else 0.0

    def whole(self, *names: str) -> numpy.ndarray:
        """Return some columns as an array, ``(rows, columns)``; ValueError for an empty cell."""
        for name in names:
            missing = self.table[name].isna()
            if missing.any():
                raise ValueError(
                    f"{name} has no value in row {missing.idxmax()}, and this column must not have empty cells"
                )
        return numpy.ascontiguousarray(self.table[[*names]].to_numpy())

    def sigmas(self, *names: str) -> numpy.ndarray:
        """Return columns of standard deviations, ``(rows, columns)``; ValueError unless all are above zero."""
        found = self.whole(*names)
        for name in names:
            check_deviations(self, name, self[name])
        return found

    def interval(self) -> float:
        """Return the sampling interval, s: the user's parameter, or the median of the table."""
        if "sampling_interval" in self.user_parameters:
            return float(self.user_parameters["sampling_interval"])
        # Rounded as times are, so that files of one sensor have the same interval.
        return float(f"{numpy.median(numpy.diff(self.time)):.6g}")

    def regular(self, why: str) -> float:
        """Return the sampling interval, s; raise ValueError, with the reason ``why``, if it varies."""
        interval = self.interval()
        steps = numpy.diff(self.time)
        off = numpy.abs(steps - interval) > UNEVEN * interval
        if off.any():
            row = int(off.argmax())
            raise ValueError(
                f"times are {steps[row]:g} s apart after row {row} and {interval:g} s elsewhere: {why}, so resample "
                "it, or cut it at the gap"
            )
        return interval


class TruthFile(NamedTuple):
    """Path and options of a file of the truth, see :mod:`.truth_files`."""

    path: Path
    offset: float = 0.0
    """Offset added to its times, s."""
    sort: bool = False
    """Whether its rows are sorted by time."""


def read_columns(
    path: Path,
    cls: type[Task],
    keywords: Mapping[str, Any],
    truth: TruthFile | None = None,
    rename: Mapping[str, str | Sequence[str]] | None = None,
    sort: bool = False,
) -> Recording:
    """Return the :class:`.Recording` made of a table of measurements.

    Args:
        path: that of the table.
        cls: the environment.
        keywords: parameters of the environment.
        truth: separate file of the truth.
        rename: new names for columns of the file; one column may have several, and the name ``LEFT_OUT`` ignores it.
        sort: sort the rows by time.

    Raises:
        ValueError: if the file cannot be read, or lacks columns that the environment needs.
    """
    import pandas

    log_format = find_companion(cls, LogFormat)
    if log_format is None:
        measure_once(cls(cls.Parameters(**keywords)))  # raises for a closed loop
        raise ValueError(f"{cls.id} reads recordings from NetCDF only, in the form of filtergym record")
    known = {*TIME, RECORDING, *log_format.columns}
    if log_format.plane:
        known |= {true + alias for true in ("", TRUTH) for name in GEODETIC for alias in COLUMNS[name]}
    if not path.name.endswith(FLIGHT_SUFFIXES):
        raise ValueError(f"a recording ends in {', '.join(FLIGHT_SUFFIXES)}")
    # All columns with the prefix truth_, because components depend on the parameters.
    renamed = [
        (old.lower(), each.lower())
        for old, new in (rename or {}).items()
        for each in ([new] if isinstance(new, str) else new)
    ]
    read, names, notes = read_table(path, ColumnNames({*known, *(old for old, _ in renamed)}, TRUTH))
    pairs = [(name.lower(), name.lower()) for name in names]
    if renamed:
        read, pairs = _rename(read, [name for name, _ in pairs], renamed, ColumnNames(known, TRUTH))
    names = [name for _, name in pairs]
    if log_format.plane:
        read, names = _rename_aliases(read, names)
    original = {new: old for (old, _), new in zip(pairs, names, strict=True) if new != old}
    time_name = next((name for name in TIME if name in read), None)
    if not names:
        raise ValueError("it is empty: a recording needs a line of columns, and rows below it")
    if time_name is None or not any(name in read for name in log_format.columns):
        raise ValueError(
            f"it has the columns {list_names(names)}, and {cls.id} reads time and "
            f"{', '.join(log_format.columns)}{_suggest(names, ['time'] * (time_name is None), log_format.columns)}"
        )
    if not len(read):
        raise ValueError("it has no rows below its columns, and a recording needs several")
    if sort:
        group = pandas.factorize(_names_of_rows(read[RECORDING]))[0] if RECORDING in read else None
        read, added = sort_by_time(read, read[time_name], group)
        notes = (*notes, *added)
    table = read.drop(columns=[*TIME, RECORDING], errors="ignore")
    for name in table:
        table[name] = numbers(name, table[name])
        if numpy.isinf(table[name]).any():
            raise ValueError(f"{name} is not finite in row {numpy.isinf(table[name]).idxmax()}")
        if (large := table[name].abs() > LARGEST).any():
            row = large.idxmax()
            raise ValueError(f"{name} is {table[name][row]:g} in row {row}, and {LARGEST:g} at most")
    table.insert(0, "time", seconds(read[time_name]))
    components = cls(cls.Parameters(**keywords)).components
    if truth is not None:
        table, added = _add_truth(table, read[time_name], log_format, components, truth)
        notes = (*notes, *added)
    parts = []
    angles = {TRUTH + one.name for one in components if one.period is not None}
    log_time = _times_as_written(read[time_name])
    for name, rows in _by_recording(table, read.get(RECORDING)).items():
        own = Columns(
            name or path.name.partition(".")[0], rows.reset_index(drop=True), keywords, log_time[rows.index]
        )
        try:
            _check_times(own)
            own.drop_duplicates()
            own.note_turns(angles)
            if log_format.plane:
                own.project_to_plane(log_format.plane)
                if truth is not None:
                    own.note_offset(log_format.plane)
            if "sampling_interval" not in keywords:
                check_interval(own.interval(), log_format.longest_interval)
            parts.append((own, log_format.read(own)))
        except ValueError as error:
            if not name:
                raise
            raise ValueError(f"recording {name!r}: {error}") from error
    original["time"] = original.get(time_name, time_name)
    return _side_by_side(path, cls, keywords, parts, names, notes, original)


def _add_truth(
    table: "pandas.DataFrame",
    times: "pandas.Series",
    log_format: LogFormat,
    components: Sequence[Component],
    truth: TruthFile,
) -> tuple["pandas.DataFrame", tuple[str, ...]]:
    here = [name for name in table if name.startswith(TRUTH)]
    if here:
        raise ValueError(f"it has {', '.join(here)}: leave these columns or the file of the truth out")
    periods = {TRUTH + one.name: one.period for one in components if one.period is not None}
    try:
        found = read_truth(truth.path, log_format, [one.name for one in components], TRUTH, TIME, truth.sort)
        columns, note = match_truth(found, times, truth.offset, periods)
    except ValueError as error:
        raise ValueError(f"truth {truth.path}: {error}") from error
    return table.assign(**columns), (note, *(f"truth: {each}" for each in found.notes))


def _rename(
    read: "pandas.DataFrame", names: list[str], renamed: Sequence[tuple[str, str]], known: ColumnNames
) -> tuple["pandas.DataFrame", list[tuple[str, str]]]:
    for old, new in renamed:
        if old not in names:
            fate = "be left out" if new == LEFT_OUT else f"become {new}"
            raise ValueError(f"it has no column {old}, which was to {fate}; it has {list_names(names)}")
        if new not in known and new != LEFT_OUT:
            raise ValueError(
                f"{old} was to become {new}, which is not read: choose from {list_names(sorted(known))}, or "
                f"{old}={LEFT_OUT} to ignore the column"
            )
    meanings = {name: [new for old, new in renamed if old == name] or [name] for name in names}
    pairs = [(name, new) for name in names for new in meanings[name] if new != LEFT_OUT]
    called = [new for _, new in pairs]
    twice = next((new for _, new in renamed if called.count(new) > 1), None)
    if twice is not None:
        raise ValueError(f"two columns would become {twice}: leave one of them out")
    there = [(old, new) for old, new in pairs if old in read and (old != new or new in known)]
    found = read[[old for old, _ in there]].set_axis([new for _, new in there], axis=1)
    return found, pairs


def _suggest(names: Sequence[str], first: Sequence[str], columns: Iterable[str]) -> str:
    wanted, pairs = [*first, *columns], []
    for name in names:
        free = [each for each in wanted if each not in names]
        close = difflib.get_close_matches(name, free, 1, 0.65) or [
            w for w in free if name and w.startswith(name)
        ]
        if close and name not in (*TIME, RECORDING, *columns):
            pairs.append(f"{name}={close[0]}")
            wanted.remove(close[0])
    if not names:
        return ""
    return f"; name the columns, such as --rename '{','.join(pairs or [f'NAME={wanted[0]}'])}'"


def _rename_aliases(read: "pandas.DataFrame", names: list[str]) -> tuple["pandas.DataFrame", list[str]]:
    renamed: dict[str, str] = {}
    for true in ("", TRUTH):
        for name in GEODETIC:
            first, *others = [true + alias for alias in COLUMNS[name] if true + alias in read] or [""]
            read = read.drop(columns=others)
            renamed |= {first: true + name} if first else {}
    return read.rename(columns=renamed), [renamed.get(name, name) for name in names]


def _times_as_written(values: "pandas.Series") -> numpy.ndarray:
    try:
        return numbers("time", values).to_numpy()
    except ValueError:
        return values.astype(str).to_numpy(dtype=str)


def _by_recording(table: "pandas.DataFrame", names: "pandas.Series | None") -> dict[str, "pandas.DataFrame"]:
    if names is None:
        return {"": table}
    return {str(name): rows for name, rows in table.groupby(_names_of_rows(names), sort=False)}


def _names_of_rows(names: "pandas.Series") -> "pandas.Series":
    return names.astype(object).where(names.notna(), "").astype(str)


def _check_times(own: Columns) -> None:
    time = own.time
    if len(time) < 2:
        raise ValueError(f"it has {len(time)} row{'s' * (len(time) != 1)}, and a recording needs several")
    if not numpy.isfinite(time).all():
        raise ValueError(f"time has no value in row {int((~numpy.isfinite(time)).argmax())}")
    check_order(time, own.log_time)


def _side_by_side(
    path: Path,
    cls: type[Task],
    keywords: Mapping[str, Any],
    parts: list[tuple[Columns, TrackLog]],
    names: list[str],
    reading_notes: Iterable[str],
    original: Mapping[str, str],
) -> Recording:
    first, known = parts[0][0], parts[0][1].parameters
    task = cls(cls.Parameters(**{**known, **keywords}))
    true = _true_columns(task, first)
    log_format: Any = find_companion(cls, LogFormat)
    places = [TRUTH + name for name in GEODETIC if log_format.plane]
    components = [TRUTH + component.name.lower() for component in task.components]
    read = [*TIME, RECORDING, *log_format.columns, *components, *places]
    notes = [*reading_notes, *unknown_column_notes(names, read, log_format.noise_hint)]
    notes.sort(key=lambda note: not note.startswith(WARNING_PREFIX))
    unknown = [component.name for component, name in zip(task.components, true, strict=True) if not name]
    if any(true) and unknown:
        notes.append(f"no truth of {', '.join(unknown)}: errors and NEES are of the other components")
    recordings = []
    for own, found in parts:
        if found.parameters != known:
            raise ValueError(
                f"recording {own.name!r} needs the parameters {dict(found.parameters)} and {first.name!r} "
                f"{dict(known)}: put them into files of their own"
            )
        prefix = f"recording {own.name!r}: " if len(parts) > 1 else ""
        notes += [prefix + note for note in (*own.notes, *found.notes)]
        recordings.append(
            Recording(
                environment=cls.id,
                measurements={name: numpy.asarray(v)[None] for name, v in found.measurements.items()},
                initial={name: numpy.asarray(v)[None] for name, v in found.initial.items()},
                seconds=(found.time - found.start)[None],
                lengths=numpy.array([len(found.rows)]),
                truth=_truth_of_rows(own, found.rows, true)[None] if any(true) else None,
                names=(own.name,),
                parameters={**known, **keywords},
                name=path.name.partition(".")[0],
                source=str(path),
                log_time=_take_rows(own.log_time, found.rows)[None],
                started=numpy.array([found.start - own.time[0]]),
                typical={name: value for name, value in found.typical.items() if name not in keywords},
                columns={
                    name: original.get(name, name)
                    for name in (*own.table, *({RECORDING} & {*original}))
                    if not name.startswith(TRUTH)
                },
                deviations=found.deviations,
                deviations_from=found.deviations_from,
                origin={} if own.origin is None else own.origin._asdict(),
            )
        )
    return stack_recordings(recordings, notes=tuple(limit_notes(notes)))


def _true_columns(task: Task, columns: Columns) -> list[str]:
    """Return the names of the columns with the truth of every component; empty where it has none."""
    names = [TRUTH + component.name.lower() for component in task.components]
    found = [name if columns.has(name) else "" for name in names]
    if columns.true and not any(found):
        raise ValueError(
            f"{', '.join(columns.true)} is no truth of {task.id}, whose components are {', '.join(names)}"
        )
    for group, parts in task.groups.items():
        missing = [TRUTH + part for part in parts if not columns.has(TRUTH + part)]
        if 0 < len(missing) < len(parts):
            raise ValueError(
                f"truth of the {group} needs all of it: the column {', '.join(missing)} is missing"
            )
    return found


def _take_rows(values: numpy.ndarray, rows: numpy.ndarray) -> numpy.ndarray:
    """Return the values ``(T, ...)`` in the measurements' rows; NaN or empty text for a measurement without one."""
    shaped = (rows >= 0).reshape(-1, *[1] * (values.ndim - 1))
    return numpy.where(shaped, values[rows], "" if values.dtype.kind == "U" else numpy.nan)


def _truth_of_rows(columns: Columns, rows: numpy.ndarray, names: list[str]) -> numpy.ndarray:
    unknown = numpy.full(len(columns.time), numpy.nan)
    return _take_rows(numpy.stack([columns[name] if name else unknown for name in names], axis=1), rows)
