"""Text of the C program that reads a user's log, with the formats and limits of the Python reader."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ..compiler.c_text import DOUBLE, Scalar, identifier, literal
from ..envs.contract.live_input import LARGEST
from ..envs.contract.log_format import RECORDING, TIME, LogFormat, LogSetup, PlainRows, PlotRows, is_assumed
from ..envs.data.clock import SINCE_1970, TIME_UNITS
from ..envs.data.foreign_parsers import LONGEST_CELL, MOST_COLUMNS
from ..envs.logs.flight_tables import DAY, DELIMITERS
from ..envs.logs.own_models import MOST_MISSED
from ..envs.logs.recorded_tables import MOST_TWICE, UNEVEN
from .c_filter import FilterText
from .c_log_programs import (
    CHECK_SIGMA,
    LOG,
    ODOMETRY,
    PLAIN_ROWS,
    PLOTS,
    POSITIONS,
    PROJECT,
    READ_FIXES,
    READ_LOOKS,
    READ_ODOMETRY,
    READER,
    REGULAR_ROWS,
)
from .traced_filter import TracedFilter

if TYPE_CHECKING:
    from .request import ExportRequest

READING: dict[str, float] = {
    "SINCE_1970": SINCE_1970,
    "DAY": DAY,
    "LARGEST": LARGEST,
    "LONGEST_CELL": LONGEST_CELL,
    "MOST_COLUMNS": MOST_COLUMNS,
    "MOST_TWICE": MOST_TWICE,
}
"""Numbers of the reader of tables, by their names there and in C."""
PLOT_VALUES = {
    "scan": "scan + 1.0",
    "position_0": "p[0]",
    "position_1": "p[1]",
    "variance_0": "v[0]",
    "variance_1": "v[1]",
    "available": "available",
    "interval": "interval",
    "elapsed": "elapsed",
    "odometry_displacement_0": "row->odometry ? row->moved[0] / scans : 0.0",
    "odometry_displacement_1": "row->odometry ? row->moved[1] / scans : 0.0",
    "odometry_available": "row->odometry ? 1.0 : 0.0",
}
"""Expressions of a measurement's numbers from a plot."""
LOOK_VALUES = {
    "scan": "(double)i",
    "radar_0": "cell[0]",
    "radar_1": "cell[1]",
    "looked": "found[1]",
    "decision": "found[2]",
    "bearing_difference": "found[3]",
}
"""Expressions of a measurement's numbers from a row of radar and ESM."""


class LogText(FilterText):
    """Writer of a filter in C, and of the C program that runs it over a user's log.

    ``columns`` are the names in the log of renamed columns.
    """

    def __init__(
        self,
        name: str,
        traced: TracedFilter,
        scalar: Scalar,
        components: Sequence[tuple[str, str]],
        log_format: LogFormat | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(name, traced, scalar, components)
        self.plain_rows: PlainRows | None = log_format.plain_rows if log_format else None
        self.log_format: LogFormat | None = log_format
        self.log_columns: Mapping[str, str] = columns or {}

    def columns(self, part: str) -> list[str]:
        """Return the column names of a struct in a table, in the order of its numbers."""
        names = self.structs[part].columns
        begin = "initial_" if part == "initial" else ""
        return [f"{begin}{names[row]}" for row in sorted(names)]

    @property
    def initial_estimate(self) -> list[float]:
        """Initial estimate of a state-space model, as flat mean and covariance; empty for logs of other kinds."""
        rows = self.plain_rows
        return [] if rows is None else [*rows.mean.tolist(), *rows.covariance.ravel().tolist()]

    def source_of(self, name: str) -> tuple[str, int]:
        """Return the place of a measurement's number in a row of a log: kind of column, and index in that kind."""
        kind, _, place = name.rpartition("_") if name[-1].isdigit() else (name, "", "0")
        kinds = {"values": "received", "available": "there", "inputs": "held", "interval": "interval"}
        return (kinds[kind], int(place)) if kind in kinds else ("other", 0)

    def fill(self, received: str, inputs: str, interval: str, others: Sequence[str] = ()) -> str:
        """Return the C statements that fill the measurement ``given`` from a row of a log.

        ``received`` and ``inputs`` are C expressions of the first such number, ``others`` of all other
        numbers.
        """
        lines, rest = [], iter(others)
        for row, name in enumerate(self.columns("measurement")):
            kind, place = self.source_of(name)
            cell = f"{received}[{place}]"
            value = {
                "received": f"{cell} == {cell} ? {cell} : 0.0",
                "there": f"{cell} == {cell} ? 1.0 : 0.0",
                "held": f"{inputs}[{place}]",
                "interval": interval,
            }.get(kind) or next(rest, "0.0")
            lines.append(f"given[{row}] = {value};")
        return "\n    ".join(lines)

    # --- the program

    def log_program(self, request: "ExportRequest") -> str:
        """Return the text of the C program that reads a user's log; empty for an unsupported format."""
        if self.plain_rows is not None:
            return self._plain_log(self.plain_rows, request.keywords.get("sampling_interval"))
        log, log_format = request.log, self.log_format
        if log is None or log_format is None:
            return ""
        if log_format.plot_rows is not None:
            return self._plot_log(log_format.plot_rows, log)
        if log_format.regular_rows is None:
            return ""
        parameters = {**log.scenario(request.problem.task).parameters, **request.keywords}
        return self._regular_log(log_format.regular_rows(request.problem.task.Parameters(**parameters)), log)

    def _log(
        self,
        about: str,
        follow: str,
        names: Sequence[str],
        needed: int,
        limits: Mapping[str, float],
    ) -> str:
        shown = [identifier(name) for name, _ in self.components]
        header = ["time", "status", *(f"estimate_{n}" for n in shown), *(f"sigma_{n}" for n in shown)]
        defined = {**READING, **limits}
        time = self.log_columns.get("time")
        C = len(self.components)
        text = LOG.format(
            own=self.name,
            about=about,
            reading="\n".join(f"#define {name} {_number(value)}" for name, value in defined.items()),
            count=len(names),
            needed=needed,
            times=", ".join(_quote(name.lower()) for name in (TIME if time is None else [time])),
            names=", ".join(_quote(name) for name in names),
            recording=_quote(self.log_columns.get(RECORDING, RECORDING).lower()),
            delimiters=_quote(DELIMITERS),
            units=", ".join(map(literal, TIME_UNITS)),
            header=name_list(",".join(header)),
            C=C,
            digits=17 if self.scalar is DOUBLE else 9,
            mean="" if C == 1 else "[i]",
            covariance="" if C == 1 else "[i][i]",
        )
        return f"{text}{READER}\n{follow}"

    def _plain_log(self, rows: PlainRows, interval: float | None) -> str:
        """Return the text of the C program for a log whose rows are measurements without conversion."""
        names = [self.log_columns.get(name.lower(), name).lower() for name in (*rows.received, *rows.inputs)]
        follow = PLAIN_ROWS.format(
            own=self.name,
            interval=literal(0.0 if rows.interval is None else interval or rows.interval),
            first=literal(interval or 0.0),
            measurement=len(self.columns("measurement")),
            estimate=", ".join(map(literal, self.initial_estimate)),
            fill=self.fill("row", "held", "interval"),
        )
        about = """A track starts with the initial estimate of the model one interval before the first row. An
   empty cell was not received; of an input the last number holds on."""
        limits = {"RECEIVED": len(rows.received), "UNEVEN": UNEVEN, "MOST_MISSED": MOST_MISSED}
        return self._log(about, follow, names, len(names), limits)

    def _plot_log(self, rows: PlotRows, log: LogSetup) -> str:
        """Return the text of the C program for a log of plots (x, y or polar); empty for other logs."""
        names = next((names for names in POSITIONS if {*names[:2]} <= {*log.columns}), None)
        measured = {*self.structs["measurement"].columns.values()}
        second = next((pair for pair in ODOMETRY if {*pair} <= {*log.columns}), None)
        moves = "odometry_available" in measured
        if names is None or not measured <= {*PLOT_VALUES} or moves > (second is not None):
            return ""
        deviations = (
            ["sigma_x", "sigma_y"] if "sigma_x" in log.deviations else ["range_sigma", "azimuth_sigma"]
        )
        first = [*names[:2], *deviations, *names[2:], *(second or ())]
        # The other columns of the log decide which rows supply each other.
        others = [name for name in log.columns if name not in (*first, "time", RECORDING)]
        columns = [log.columns.get(name, name).lower() for name in (*first, *others)]
        usual = [log.deviations[name] for name in deviations]
        geodetic = names[0] == "latitude"
        follow = PLOTS.format(
            own=self.name,
            interval=literal(float(log.parameters.get("sampling_interval", log.interval))),
            first=literal(usual[0]),
            second=literal(usual[1]),
            nominal=literal((usual[0] if is_assumed(log.deviations_from) else rows.deviation) ** 2),
            project=PROJECT if geodetic else "",
            locate="if (find_origin(n) != 0) return 2;\n    " if geodetic else "",
            fix=" && !(a == 0.0 && b == 0.0)" if geodetic else "",
            both=int(names[0] == "x"),
            position=POSITIONS[names],
            odometry=READ_ODOMETRY.format(displacement=ODOMETRY[second]) if moves and second else "",
            read_odometry="if (read_odometry(n) != 0) return 2;\n    " if moves else "",
            stated_polar=int(deviations[0] == "range_sigma"),
            measurement=len(self.structs["measurement"].columns),
            initial=len(self.structs["initial"].columns),
            fill=self._assign("measurement", PLOT_VALUES, "    "),
            start=self._plot_start(),
        )
        about = """A track starts from the first two plots, the second of which is before the first row that is
   written; scans without a row have missed the target."""
        limits = {"FARTHEST": rows.farthest, "MOST_MISSED": rows.most_missed, "FINER": rows.finer}
        if moves and second:
            limits["FIRST_ODOMETRY"] = first.index(second[0])
        return self._log(about, follow, columns, 2, limits)

    def _regular_log(self, numbers: Mapping[str, float], log: LogSetup) -> str:
        """Return the text of the C program for a log of rows at one rate; empty for other logs."""
        if "range_rate" in log.columns:
            rows = _rows_with_looks(log.columns, numbers)
        elif {"ins", "ins_x"} & {*log.columns}:
            rows = _rows_with_fixes(log.columns, numbers["usual_sigma"])
        else:
            return ""
        sizes = [len(self.structs[part].columns) for part in ("measurement", "initial")]
        follow = REGULAR_ROWS.format(
            own=self.name,
            interval=literal(float(log.parameters.get("sampling_interval", log.interval))),
            reading=rows.reading,
            most=max(sizes),
            start=self._assign("initial", rows.start, 12 * " "),
            fill=self._assign("measurement", rows.values, 8 * " "),
        )
        about = "A track starts with its first row, which has no estimate; all rows are one interval apart."
        columns = [log.columns[name].lower() for name in rows.names]
        return self._log(about, follow, columns, rows.needed, {"UNEVEN": UNEVEN, **rows.limits})

    def _assign(self, part: str, values: Mapping[str, str], indent: str) -> str:
        """Return the C statements that set all numbers of a struct; those not in ``values`` become zero."""
        columns = sorted(self.structs[part].columns.items())
        return f"\n{indent}".join(f"given[{row}] = {values.get(name, '0.0')};" for row, name in columns)

    def _plot_start(self) -> str:
        """Return the C statements that compute the ``initial`` estimate from the first two plots of a track."""
        values = {"mean_0": "p[0]", "mean_1": "p[1]"}
        values |= {f"mean_{i + 2}": f"(p[{i}] - p0[{i}]) / lasted" for i in range(2)}
        for i in range(2):
            values[f"covariance_{i}_{i}"] = f"v[{i}]"
            values[f"covariance_{i}_{i + 2}"] = values[f"covariance_{i + 2}_{i}"] = f"v[{i}] / lasted"
            values[f"covariance_{i + 2}_{i + 2}"] = f"(v0[{i}] + v[{i}]) / (lasted * lasted)"
        return self._assign("initial", values, 16 * " ")


class RegularReading(NamedTuple):
    """Parts of the C program that reads a log of rows at one rate."""

    names: list[str]
    """Names of the columns that the program reads."""
    needed: int
    """Number of required columns, which are the first ones."""
    reading: str
    """Text of the function ``read_values``."""
    values: Mapping[str, str]
    """Expressions of the numbers of a measurement."""
    start: Mapping[str, str]
    """Expressions of the numbers of the initial estimate in the first row; zero where none is named."""
    limits: Mapping[str, float]
    """Numbers of the reading; the first ``WHOLE`` columns have no empty cell."""


def _all_columns(first: list[str], columns: Mapping[str, str]) -> list[str]:
    return [*first, *(name for name in columns if name not in (*first, "time", RECORDING))]


def _rows_with_fixes(columns: Mapping[str, str], usual: float) -> RegularReading:
    """Return how C reads a log of INS and receiver positions; ``usual`` is the default deviation, m."""
    ends = [""] if "ins" in columns else sorted(name[3:] for name in columns if name.startswith("ins_"))
    A, stated = len(ends), int("sigma" in columns)
    first = [*(f"ins{end}" for end in ends), *["sigma"] * stated, *(f"fix{end}" for end in ends)]
    deviation = f"cell[{A}]" if stated else literal(usual)
    values, start = {"number": "(double)i", "available": "found[0]", "reported_deviation": deviation}, {}
    for axis in range(A):
        end = f"_{axis}" * (A > 1)
        values[f"ins{end}"] = start[f"mean{end}"] = f"cell[{axis}]"
        values[f"increment{end}"] = f"cell[{axis}] - before[{axis}]"
        values[f"fix{end}"] = f"found[0] > 0.0 ? cell[{A + stated + axis}] : 0.0"
    return RegularReading(
        _all_columns(first, columns),
        len(first),
        READ_FIXES.format(axes=A, check=CHECK_SIGMA.format(sigma=A) if stated else ""),
        values,
        start,
        {"WHOLE": A + stated},
    )


def _rows_with_looks(columns: Mapping[str, str], numbers: Mapping[str, float]) -> RegularReading:
    """Return how C reads a log of a radar with ESM reports; ``numbers`` are constants of the format."""
    first = ["range", "range_rate", *(name for name in columns if name == "looked")]
    names = _all_columns(first, columns)
    optional = ("looked", "decision", "bearing_difference", "radar_bearing", "esm_bearing")
    cells = {name: f"row->cell[{names.index(name)}]" if name in names else "(double)NAN" for name in optional}
    start = {"mean_0": "cell[0]", "mean_1": "cell[1]"}
    start |= {f"covariance_{i}_{i}": literal(numbers[f"variance_{i}"]) for i in range(3)}
    start |= {f"first_{name}": value for name, value in LOOK_VALUES.items()}
    limits = {name.upper(): numbers[name] for name in ("types", "esm_period", "horizon")}
    return RegularReading(
        names, len(first), READ_LOOKS.format(**cells), LOOK_VALUES, start, {"WHOLE": len(first), **limits}
    )


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else literal(value)


def _quote(text: str) -> str:
    """Return a text as a string literal of C, with all but letters, digits and plain signs in octal."""
    return (
        '"'
        + "".join(
            chr(byte) if (chr(byte).isalnum() and byte < 128) or chr(byte) in " _-./()[]" else f"\\{byte:03o}"
            for byte in text.encode()
        )
        + '"'
    )


def name_list(text: str) -> str:
    """Return comma-separated identifiers as a C string literal, broken into lines."""
    assert re.fullmatch(r"[A-Za-z0-9_,]*", text)
    pieces = [text[i : i + 80] for i in range(0, len(text), 80)] or [""]
    return "\n    ".join(f'"{piece}"' for piece in pieces)
