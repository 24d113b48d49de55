"""Tables of what sensors really said, made into recordings.

An environment says which columns it knows and makes measurements of them (:class:`.LogFormat`). What every table has
in common is here: times, missing values, several recordings in one file, and true values, ``truth_NAME`` for every
component of the environment.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy

from .flight_tables import FLIGHT_SUFFIXES, numbers, read_table, seconds
from .log_format import TrackLog
from .plausibility import check_interval, unknown_column_notes
from .recording import Recording, measure_once, side_by_side
from .task import Task

if TYPE_CHECKING:
    import pandas

TIME = ("time", "timestamp", "seconds")
RECORDING = "recording"
TRUTH = "truth_"
UNEVEN = 0.01
"""Share of the sampling interval by which a time may be off where measurements must be regular."""


class Columns:
    """Columns of one recording, in the order of its times.

    Args:
        name: of the recording.
        table: numbers by the names of the columns, missing where a cell is empty, with ``time`` in seconds. Its index
            counts the rows of the file.
        given: parameters that the user has named.
    """

    def __init__(self, name: str, table: "pandas.DataFrame", given: Mapping[str, Any]) -> None:
        self.name, self.table, self.given = name, table, given

    def has(self, *names: str) -> bool:
        """Whether all of these columns are there."""
        return {*names} <= {*self.table}

    @property
    def time(self) -> numpy.ndarray:
        """Times, s, ``(rows,)``."""
        return self["time"]

    @property
    def true(self) -> list[str]:
        """Names of the columns that say what is true."""
        return [name for name in self.table if name.startswith(TRUTH)]

    def __getitem__(self, name: str) -> numpy.ndarray:
        """Column, NaN where a cell is empty."""
        return self.table[name].to_numpy()

    def only(self, rows: numpy.ndarray) -> "Columns":
        """Some rows of the same."""
        return Columns(self.name, self.table[rows], self.given)

    def whole(self, *names: str) -> numpy.ndarray:
        """Columns without an empty cell, ``(rows, columns)``.

        Raises:
            ValueError: if there is one.
        """
        for name in names:
            missing = self.table[name].isna()
            if missing.any():
                raise ValueError(
                    f"{name} has no value in row {missing.idxmax()}, and here nothing may be missing"
                )
        return numpy.ascontiguousarray(self.table[[*names]].to_numpy())

    def sigmas(self, *names: str) -> numpy.ndarray:
        """Standard deviations without an empty cell, ``(rows, columns)``.

        Raises:
            ValueError: if one is not above zero.
        """
        found = self.whole(*names)
        for name in names:
            values = self.table[name]
            if (values <= 0.0).any():
                row = (values <= 0.0).idxmax()
                raise ValueError(
                    f"{name} is a standard deviation, above zero, and row {row} has {values[row]:g}"
                )
        return found

    def interval(self) -> float:
        """Sampling interval, s: the one that the user has named, or the median of those in the table."""
        if "sampling_interval" in self.given:
            return float(self.given["sampling_interval"])
        # Rounded as times are: files of one sensor have the same then.
        return float(f"{numpy.median(numpy.diff(self.time)):.6g}")

    def regular(self, why: str) -> float:
        """Sampling interval of measurements that must be regular, s.

        Args:
            why: who needs that, at the end of the sentence.

        Raises:
            ValueError: if they are not.
        """
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


def read_columns(path: Path, cls: type[Task], keywords: Mapping[str, Any]) -> Recording:
    """Read a table of what sensors said.

    Args:
        path: of a file.
        cls: the environment.
        keywords: parameters of it.

    Raises:
        ValueError: if it cannot be read, or lacks what the environment needs.
    """
    log_format = cls.log_format
    if log_format is None:
        measure_once(cls(cls.Parameters(**keywords)))  # says what a closed loop is
        raise ValueError(f"{cls.id} reads recordings from NetCDF only, in the form of filtergym record")
    known = _ColumnNames({*TIME, RECORDING, *log_format.columns})
    if not path.name.endswith(FLIGHT_SUFFIXES):
        raise ValueError(f"a recording ends in {', '.join(FLIGHT_SUFFIXES)}")
    read, names = read_table(path, known)
    names = [name.lower() for name in names]
    time_name = next((name for name in TIME if name in read), None)
    if time_name is None or not any(name in read for name in log_format.columns):
        raise ValueError(
            f"it has the columns {', '.join(names) or 'none'}, and {cls.id} reads time and "
            f"{', '.join(log_format.columns)}"
        )
    table = read.drop(columns=[*TIME, RECORDING], errors="ignore")
    for name in table:
        table[name] = numbers(name, table[name])
        if numpy.isinf(table[name]).any():
            raise ValueError(f"{name} is not finite in row {numpy.isinf(table[name]).idxmax()}")
    table.insert(0, "time", seconds(read[time_name]))
    parts = []
    for name, rows in _by_recording(table, read.get(RECORDING)).items():
        own = Columns(name or path.name.partition(".")[0], rows, keywords)
        try:
            _check_times(own.time)
            if "sampling_interval" not in keywords:
                check_interval(own.interval(), log_format.longest_interval)
            parts.append((own, log_format.read(own)))
        except ValueError as error:
            if not name:
                raise
            raise ValueError(f"recording {name!r}: {error}") from error
    return _side_by_side(path, cls, keywords, parts, names, log_format.columns)


class _ColumnNames(set[str]):
    """Names of columns; and all that begin with ``truth_``, because components follow from the parameters."""

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or str(name).startswith(TRUTH)


def _by_recording(table: "pandas.DataFrame", names: "pandas.Series | None") -> dict[str, "pandas.DataFrame"]:
    """Rows of every recording of a table, in their order."""
    if names is None:
        return {"": table}
    words = names.astype(object).where(names.notna(), "").astype(str)
    return {str(name): rows.reset_index(drop=True) for name, rows in table.groupby(words, sort=False)}


def _check_times(time: numpy.ndarray) -> None:
    if len(time) < 2:
        raise ValueError(f"it has {len(time)} row{'s' * (len(time) != 1)}, and a recording needs several")
    if not numpy.isfinite(time).all():
        raise ValueError(f"time has no value in row {int((~numpy.isfinite(time)).argmax())}")
    steps = numpy.diff(time)
    if (steps <= 0.0).any():
        row = int((steps <= 0.0).argmax())
        what = "is the same in rows" if steps[row] == 0.0 else "decreases between rows"
        hint = ", in UTC if the clock was changed" if steps[row] <= -1800.0 else ""
        raise ValueError(f"time {what} {row} and {row + 1}: rows must be in the order of their times{hint}")


def _side_by_side(
    path: Path,
    cls: type[Task],
    keywords: Mapping[str, Any],
    parts: list[tuple[Columns, TrackLog]],
    names: list[str],
    columns: Iterable[str],
) -> Recording:
    """Put the recordings of a file, whose columns have these names, side by side; the environment reads ``columns``."""
    first, known = parts[0][0], parts[0][1].parameters
    task = cls(cls.Parameters(**{**known, **keywords}))
    true = [TRUTH + component.name for component in task.components]
    notes = tuple(unknown_column_notes(names, [*TIME, RECORDING, *columns, *true]))
    with_truth = first.has(*true)
    if first.true and not with_truth:
        raise ValueError(f"truth needs every component of {cls.id}: {', '.join(true)}")
    recordings = []
    for own, found in parts:
        if found.parameters != known:
            raise ValueError(
                f"recording {own.name!r} needs the parameters {dict(found.parameters)} and {first.name!r} "
                f"{dict(known)}: put them into files of their own"
            )
        if with_truth and (found.rows < 0).any():
            raise ValueError(
                f"recording {own.name!r} has scans without a row, of which nobody knows the truth: add rows "
                "without plots, or leave out the truth"
            )
        recordings.append(
            Recording(
                environment=cls.id,
                measurements={name: numpy.asarray(v)[None] for name, v in found.measurements.items()},
                initial={name: numpy.asarray(v)[None] for name, v in found.initial.items()},
                seconds=(found.time - found.start)[None],
                lengths=numpy.array([len(found.rows)]),
                truth=own.whole(*true)[found.rows][None] if with_truth else None,
                names=(own.name,),
                parameters={**known, **keywords},
                name=path.name.partition(".")[0],
                source=str(path),
                notes=notes,
            )
        )
    return side_by_side(recordings)
