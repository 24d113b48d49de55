"""A whole filter as C99: header and source, a program that reads a table, and a test with its vectors.

:mod:`.c_filter` writes the filter itself; the programs around it are templates of :mod:`.c_programs`.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy

from ..compiler.c_text import (
    DOUBLE,
    FLOAT,
    Parameter,
    Scalar,
    comment,
    function_text,
    identifier,
    literal,
)
from ..envs.contract.companions import array_meanings, find_companion
from ..envs.contract.log_format import LogFormat
from ..evaluation.storage.files import whole_files
from .c_log import LogText, name_list
from .c_programs import INITIAL_IN_ROW, INITIAL_OF_MODEL, MAIN, TEST
from .figures import Figures, operation_words
from .replay import Replay, mean_rows, replay, run_filter
from .request import ExportRequest
from .traced_filter import FEEDBACK, LIKELIHOODS, TracedFilter

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic")
"""Compiler flags under which the text compiles without a warning."""
MOST_OPTIMISED = 10_000
"""Largest number of operations of an update whose text is compiled with ``-O2``; beyond it ``-O1`` halves the compile
time and makes the code a tenth slower.
"""
WORST = {"double": 1e-3, "float": 0.1}
"""Largest accepted difference of the C filter's mean to the Python competitor's, in its standard deviations."""
EPISODES, MEASUREMENTS = 8, 200
"""Largest number of episodes and measurements that are compared before the export is written."""
STEER = """
            for (i = 0; steers && i < FEEDBACK; ++i) *answer++ = (double)estimate.feedback[i];"""
"""C text that writes the feedback of a filter in a closed loop."""
VECTORS = 2, 50
"""Largest number of episodes and measurements among the test's vectors."""


class Writer(LogText):
    """Writer of all C files of an exported filter: header, source, programs, test and its vectors.

    ``columns`` are the names in the log of renamed columns.

    Attributes:
        limit: largest difference with which the test passes, standard deviations.
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
        super().__init__(name, traced, scalar, components, log_format, columns)
        self.limit: float = WORST[scalar.name]

    def rows(self) -> str:
        """Return the text of rows.h: functions that fill the structs from rows of a table."""
        own, real = self.name, self.scalar.name
        text = [
            comment("Structs from rows of a table."),
            f"#ifndef {own.upper()}_ROWS_H\n#define {own.upper()}_ROWS_H\n",
        ]
        text.append(f'#include "{own}.h"\n')
        for part in ("initial", "measurement"):
            struct = self.structs[part]
            body = [f"{part}->{place} = ({real})row[{row}];" for row, place in sorted(struct.places.items())]
            listed = [Parameter(f"{struct.name} *", part), Parameter("const double *", "row")]
            text.append(function_text("static void", f"set_{part}", listed, body))
        text.append(f"#endif /* {own.upper()}_ROWS_H */\n")
        return "\n".join(text)

    def main(self) -> str:
        """Return the text of main.c, which runs the filter from a table of measurements to one of estimates."""
        C, digits = len(self.components), 17 if self.scalar is DOUBLE else 9
        initial, measurement = self.columns("initial"), self.columns("measurement")
        given = self.table_columns()
        names = [identifier(name) for name, _ in self.components]
        likelihoods = [member.name for member in self.traced.estimate if member.name in LIKELIHOODS]
        header = [
            "track",
            "measurement",
            *likelihoods,
            *(f"estimate_{n}" for n in names),
            *(f"sigma_{n}" for n in names),
        ]
        return MAIN.format(
            own=self.name,
            columns=name_list(",".join(given)),
            header=name_list(",".join(header)),
            initial=len(initial),
            measurement=len(measurement),
            count=len(given),
            begins="A row whose initial columns are filled begins a new track."
            if self.plain_rows is None
            else "A row with another number of a recording begins a new track.",
            layout=self._layout(),
            C=C,
            digits=digits,
            upper=self.name.upper(),
            available="".join(
                f"{i}, "
                for i, column in enumerate(self.columns("measurement"))
                if column.startswith("available")
            ),
            mean="" if C == 1 else "[i]",
            covariance="" if C == 1 else "[i][i]",
            entry="" if C == 1 else "[i][j]",
            feedback=sum(member.name == FEEDBACK for member in self.traced.estimate),
            steer=STEER if any(member.name == FEEDBACK for member in self.traced.estimate) else "",
            likelihoods="".join(
                f"\n        print_number(there ? (double)estimate.{name} : (double)NAN);"
                for name in likelihoods
            ),
        )

    def table_columns(self) -> list[str]:
        """Return the names of the columns of the table that main.c reads."""
        rows = self.plain_rows
        if rows is None:
            return [*self.columns("initial"), *self.columns("measurement")]
        own = [name for name in self.columns("measurement") if self.source_of(name) == ("other", 0)]
        timed = ["interval"] * (rows.interval is None)
        return [*map(identifier, ["recording", *timed, *rows.received, *rows.inputs]), *own]

    def _layout(self) -> str:
        """Return the C functions of main.c that read the initial estimate and the measurement of a row."""
        rows = self.plain_rows
        if rows is None:
            return INITIAL_IN_ROW.format()
        first = 1 + (rows.interval is None)
        count, held = first + len(rows.received), first + len(rows.received) + len(rows.inputs)
        others = [f"row[{place}]" for place in range(held, len(self.table_columns()))]
        hold = [
            f"if (row[{place}] == row[{place}]) last[{place - count}] = row[{place}];"
            for place in range(count, held)
        ]
        fill = self.fill(f"(row + {first})", "last", "row[1]", others)
        if hold:
            fill = "\n    ".join([f"static double last[{len(hold)}];", *hold, fill])
        return INITIAL_OF_MODEL.format(estimate=", ".join(map(literal, self.initial_estimate)), fill=fill)

    def test(self) -> str:
        """Return the text of test.c, which compares the filter's estimates with the stored ones."""
        return TEST.format(
            own=self.name,
            upper=self.name.upper(),
            limit=literal(self.limit),
            C=len(self.components),
            mean="" if len(self.components) == 1 else "[i]",
        )

    def vectors(self, replayed: Replay) -> str:
        """Return the text of vectors.h: measurements of the test, and the expected estimates."""
        E, T = min(VECTORS[0], replayed.initial.shape[1]), min(VECTORS[1], len(replayed.measurements))
        arrays = {
            "initials": replayed.initial[:, :E].T,
            "measurements": numpy.moveaxis(replayed.measurements[:T, :, :E], -1, 0).reshape(E * T, -1),
            "means": numpy.moveaxis(replayed.mean[:T, :, :E], -1, 0).reshape(E * T, -1),
            "sigmas": numpy.moveaxis(replayed.sigma[:T, :, :E], -1, 0).reshape(E * T, -1),
        }
        text = [
            comment("Measurements of simulated episodes, and what the competitor itself estimated in double.")
        ]
        text.append(f"#define TRACKS {E}\n#define MEASUREMENTS {T}\n")
        for name, values in arrays.items():
            rows = ",\n".join("{" + ", ".join(literal(float(x)) for x in row) + "}" for row in values)
            text.append(f"static const double {name}[{len(values)}][{values.shape[1]}] = {{\n{rows}\n}};\n")
        return "\n".join(text)

    def table(self, replayed: Replay) -> str:
        """Return replayed measurements as a CSV table, as main.c reads it."""
        lines = [",".join(self.table_columns())]
        if self.plain_rows is not None:
            for episode in range(replayed.initial.shape[1]):
                rows = replayed.measurements[:, :, episode].tolist()
                lines += [",".join([str(episode + 1), *self._plain_row(row)]) for row in rows]
            return "\n".join([*lines, ""])
        blank = "," * len(self.columns("initial"))
        for episode, initial in enumerate(replayed.initial.T.tolist()):
            rows = [",".join(map(repr, row)) for row in replayed.measurements[:, :, episode].tolist()]
            lines.append(",".join([*map(repr, initial), rows[0]]))
            lines += [blank + row for row in rows[1:]]
        return "\n".join([*lines, ""])

    def _plain_row(self, row: Sequence[float]) -> list[str]:
        """Return the cells of a measurement in a table with a log's columns, without the first, the recording."""
        found: dict[str, list[str]] = {"interval": [], "received": [], "held": [], "other": []}
        there = [
            value > 0.0
            for value, name in zip(row, self.columns("measurement"), strict=True)
            if self.source_of(name)[0] == "there"
        ]
        for value, name in zip(row, self.columns("measurement"), strict=True):
            kind, place = self.source_of(name)
            if kind != "there":
                found[kind].append("" if kind == "received" and not there[place] else repr(value))
        return [cell for cells in found.values() for cell in cells]


def export_c(request: ExportRequest, folder: Path, precision: str = "double", command: str = "") -> Figures:
    """Compare a competitor's program with its Python form, and write it as C99; return cost and accuracy.

    ``precision`` is "double" or "float".

    Raises:
        ValueError: for a competitor that cannot be exported, or differs in this precision.
    """
    scalar = {"double": DOUBLE, "float": FLOAT}[precision]
    traced, replayed = replay(request, EPISODES, MEASUREMENTS)
    difference = replayed.largest_difference(run_filter(traced, replayed, scalar.dtype)[:, mean_rows(traced)])
    if not difference <= WORST[precision]:
        raise ValueError(
            f"{request.name!r} in {precision} is off by {difference:.1e} of the standard deviations that it reports, "
            f"more than {WORST[precision]:g}, within {len(replayed.measurements)} measurements: "
            + ("export it in double" if scalar is FLOAT else "please report it")
        )
    log_format = find_companion(request.problem.task, LogFormat)
    writer = Writer(
        request.name,
        traced,
        scalar,
        replayed.components,
        log_format,
        {**getattr(request.scenario, "columns", {}), **(request.log.columns if request.log else {})},
    )
    writer.about = _about(request, writer, precision, command)
    figures = Figures(*writer.sizes, difference, writer.replaced, writer.network_operations)
    level = "-O1" if figures.operations > MOST_OPTIMISED else "-O2"
    test = compile_and_test(writer, replayed, flags=(*FLAGS, level))
    if test:
        test += f" with cc {level}"
    figures = figures._replace(test=test)
    folder.mkdir(parents=True, exist_ok=True)
    with whole_files(folder) as waiting:
        texts = files_of(writer, replayed, _notes(figures, replayed, precision))
        program = writer.log_program(request)
        figures = figures._replace(reads_log=bool(program))
        for file, text in {**texts, **({"log.c": program} if program else {})}.items():
            (waiting / file).write_text(text, encoding="ascii")
    return figures


def price_of(request: ExportRequest) -> dict[str, int] | None:
    """Return the operations of an update in C, and bytes of state, weights and stack; None: not exportable."""
    try:
        traced, replayed = replay(request, EPISODES, 2)
    except ValueError:
        return None
    operations, state, weights, stack = Writer(request.name, traced, DOUBLE, replayed.components).sizes
    return {"operations": operations, "state_bytes": state, "weight_bytes": weights, "stack_bytes": stack}


def files_of(writer: Writer, replayed: Replay, notes: Sequence[str] = ()) -> dict[str, str]:
    """Return the text of every file of an export, by the file's name."""
    return {
        f"{writer.name}.h": writer.header(notes),
        f"{writer.name}.c": writer.source(),
        "rows.h": writer.rows(),
        "main.c": writer.main(),
        "vectors.h": writer.vectors(replayed),
        "test.c": writer.test(),
        "measurements.csv": writer.table(replayed),
    }


def _about(request: ExportRequest, writer: Writer, precision: str, command: str) -> list[str]:
    own, maker = writer.name, request.maker
    described = maker if isinstance(maker, type) else getattr(maker, "func", None) and maker
    first = (getattr(described, "__doc__", None) or "").strip().split("\n\n")[0].replace("`", "")
    parameters = ", ".join(f"{key} = {value!r}" for key, value in request.keywords.items())
    return [
        f"{request.name} of {request.problem.id}, in {precision}, for one track. {first}".strip(),
        *([f"With parameters of the task: {parameters}."] if parameters else []),
        *([meaning] if (meaning := array_meanings(request.problem.task).measurement) else []),
        f"Made by: {command}" if command else "Made by filtergym.",
        "",
        "No allocation, nothing but math.h. Compare it with the evaluated filter:",
        f"    cc -std=c99 -O2 test.c {own}.c -lm -o test && ./test",
        "Estimates from a table of measurements:",
        f"    cc -std=c99 -O2 main.c {own}.c -lm -o run && ./run measurements.csv",
        *(
            [
                "Estimates from a log of your own:",
                f"    cc -std=c99 -O2 log.c {own}.c -lm -o log && ./log mine.csv",
            ]
            if writer.log_program(request)
            else []
        ),
        "",
    ]


def _notes(figures: Figures, replayed: Replay, precision: str) -> list[str]:
    T, E = len(replayed.measurements), replayed.initial.shape[1]
    notes = [
        f"{operation_words(figures)}; bytes: {figures.state_bytes:,} of state"
        + (f", {figures.constant_bytes:,} of weights" if figures.constant_bytes else "")
        + f", about {figures.scratch_bytes:,} of stack.",
        f"Largest difference to the competitor in {E} episodes of {T} measurements, computed in {precision}: "
        f"{figures.difference:.1e} of the standard deviations that it reports.",
    ]
    if figures.test:
        notes.append(f"Compiled on export: {figures.test}.")
    if figures.replaced:
        listed = ", ".join(f"{value:g}" for value in figures.replaced)
        notes.append(f"Constants that float cannot represent, replaced by the nearest ones: {listed}.")
    return notes


def compile_and_test(
    writer: Writer, replayed: Replay, compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> str:
    """Compile the C test, run it, and return its output; empty without a compiler.

    Raises:
        ValueError: if it does not compile, or the test fails.
    """
    compiler = compiler or shutil.which("cc")
    if compiler is None:
        return ""
    with tempfile.TemporaryDirectory() as place:
        files = {
            f"{writer.name}.h": writer.header(),
            f"{writer.name}.c": writer.source(),
            "rows.h": writer.rows(),
        }
        files |= {"vectors.h": writer.vectors(replayed), "test.c": writer.test()}
        for file, text in files.items():
            (Path(place) / file).write_text(text, encoding="ascii")
        program = [compiler, *flags, "test.c", f"{writer.name}.c", "-lm", "-o", "test"]
        for words in (program, [str(Path(place) / "test")]):
            done = subprocess.run(words, cwd=place, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                output = (done.stderr or done.stdout).strip()[-500:]
                raise ValueError(
                    f"{words[0]} failed on the exported {writer.name!r}, please report it: {output}"
                )
    return done.stdout.strip()
