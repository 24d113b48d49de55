"""A whole filter as C99: one header and one source, a program that reads a table, and a test with its vectors.

No allocation, and nothing but ``math.h``; parameters and weights are constants. Whatever a stranger's file calls its
parts gets into the text as identifiers and comments only, see :mod:`..compiler.c_source`.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy

from ..baselines.fitted_filters import LogSetup
from ..compiler.c_loops import Arrays, Rows
from ..compiler.c_source import helper_functions, write_program
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
from ..evaluation.storage.files import whole_files
from .c_network import memory_size, network_operations, network_text, scratch_size
from .c_programs import LOG, MAIN, POSITIONS, PROJECT, TEST
from .c_structs import struct_text, structure
from .figures import Figures, operation_words
from .replay import Replay, mean_rows, replay, run_filter
from .request import ExportRequest
from .traced_filter import (
    ANSWER,
    ESTIMATE,
    FEEDBACK,
    INITIAL,
    LIKELIHOODS,
    MEASUREMENT,
    SHOWN,
    STATE,
    TracedFilter,
    count_answers,
)

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic")
"""Under which the text compiles without a warning."""
MOST_OPTIMISED = 10_000
"""Operations of an update, at most, that the compiler optimises when it tries the text: of 57,000 that takes it ten
seconds."""
WORST = {"double": 1e-3, "float": 0.1}
"""Largest difference to the competitor itself, in its standard deviations, with which a filter leaves."""
TAKEN = ("rows", "vectors", "test", "log", "math", "float", "stdio", "stdlib", "string", "time")
"""Names that a filter's files must not have: those of the others."""
EPISODES, MEASUREMENTS = 8, 200
"""That are compared before anything is written, at most."""
STEER = """
            for (i = 0; steers && i < FEEDBACK; ++i) *answer++ = (double)estimate.feedback[i];"""
"""In the program around a filter that reports what steers the world."""
VECTORS = 2, 50
"""Episodes and measurements among the test's vectors, at most."""


def file_stem(name: str) -> str:
    """Return what the files and functions of a filter are called."""
    return identifier(name, TAKEN)


class Writer:
    """The files of a filter.

    Args:
        name: of the competitor.
        traced: its programs.
        scalar: kind of numbers.
        components: what is estimated, name and unit.

    Attributes:
        about: paragraphs for the comment of the header.
        limit: largest difference with which the test passes, standard deviations.
    """

    def __init__(
        self, name: str, traced: TracedFilter, scalar: Scalar, components: Sequence[tuple[str, str]]
    ) -> None:
        self.traced, self.scalar, self.components = traced, scalar, components
        self.about: list[str] = []
        self.limit = WORST[scalar.name]
        self.name = own = file_stem(name)
        parts = {"state": traced.state, "initial": traced.initial, "measurement": traced.measurement}
        parts["estimate"] = traced.estimate
        self.structs = {key: structure(f"{own}_{key}", members) for key, members in parts.items()}
        self.memory = memory_size(traced.network) if traced.network is not None else 0
        self.has_state = bool(traced.state or self.memory)
        self.start, self.start_source = self._start()
        self.update, self.update_source = self._update()

    def _parameters(self, *parts: str) -> list[Parameter]:
        """Parameters that point to structs; ``const`` is what is only read."""
        return [
            Parameter(f"{'const ' * (part in ('initial', 'measurement'))}{self.structs[part].name} *", part)
            for part in parts
        ]

    def _rows(self, part: str, name: str = "", qualifier: str = "const ") -> Rows:
        """Numbers of a struct one after the other: it has no members of another kind."""
        pointer = f"(({qualifier}{self.scalar.name} *){name or part})"
        return Rows(pointer, self.structs[part].numbers)

    def _start(self) -> tuple[str, Any]:
        to, given = self.structs["state"].places, self.structs["initial"].places
        parameters = self._parameters("state", "initial")
        source = write_program(
            self.traced.start,
            f"{self.name}_start",
            parameters,
            lambda _, row: f"initial->{given[row]}",
            lambda _, row: f"state->{to[row]}",
            self.scalar,
            arrays=Arrays({INITIAL: self._rows("initial")}, {STATE: self._rows("state", qualifier="")}),
        )
        body = list(source.body)
        if self.memory:
            zero = literal(0.0, self.scalar)
            body += [f"for (i = 0; i < {self.memory}; ++i) state->network[i] = {zero};"]
            body.insert(0, "int i;")
        return f"{source.functions}\n{function_text('void', f'{self.name}_start', parameters, body)}", source

    def _update(self) -> tuple[str, Any]:
        traced, real, own = self.traced, self.scalar.name, self.name
        state, places = self.structs["state"], self.structs["state"].places
        given, told = self.structs["measurement"].places, self.structs["estimate"].places
        inner = [Parameter(f"const {state.name} *", "state"), *self._parameters("measurement")]
        inner += [Parameter(f"{state.name} *", "next"), *self._parameters("estimate")]
        between = []
        if traced.network is not None:
            inner += [Parameter(f"{real} *", "shown"), Parameter(f"const {real} *", "answer")]
            memory = "next->network" if self.memory else "0"
            between = [
                f"if (shown[0] != {literal(0.0, self.scalar)}) {own}_network(shown + 1, {memory}, answer);"
            ]

        def read(argument: int, row: int) -> str:
            if argument == ANSWER:
                return f"answer[{row}]"
            return f"state->{places[row]}" if argument == STATE else f"measurement->{given[row]}"

        def write(argument: int, row: int) -> str:
            if argument == SHOWN:
                return f"shown[{row}]"
            return f"next->{places[row]}" if argument == STATE else f"estimate->{told[row]}"

        read_rows = {STATE: self._rows("state"), MEASUREMENT: self._rows("measurement")}
        written = {STATE: self._rows("state", "next", ""), ESTIMATE: self._rows("estimate", qualifier="")}
        if traced.network is not None:
            read_rows[ANSWER] = Rows("answer", range(count_answers(traced.network)))
            written[SHOWN] = Rows("shown", range(traced.shown))
        arrays = Arrays(read_rows, written)
        source = write_program(
            traced.update,
            f"{own}_update",
            inner,
            read,
            write,
            self.scalar,
            between=between,
            results=traced.shown,
            arrays=arrays,
        )
        body = list(source.body)
        if self.has_state:
            # What is written is not what is read.
            start = " = *state" if self.memory else ""
            body = [
                f"{state.name} after{start};",
                f"{state.name} *const next = &after;",
                *body,
                *self._guard(),
                "*state = after;",
                self._taken(),
            ]
        else:
            if "next" in " ".join(body):
                body = [f"{state.name} *const next = state;", *body]
            body.append(self._taken())
        if traced.network is not None:
            zero = literal(0.0, self.scalar)
            answers = f"{real} answer[{count_answers(traced.network)}] = {{{zero}}};"
            body = [f"{real} shown[{traced.shown}];", answers, *body]
        interval = next((place for place in given.values() if place == "interval"), None)
        if interval is not None:
            inside = body
            body = [
                f"if (!(measurement->interval >= {literal(0.0, self.scalar)})) return {own.upper()}_REFUSED;",
                "{",
                *inside,
                "}",
            ]
        parameters = self._parameters("state", "measurement", "estimate")
        return f"{source.functions}\n{function_text('int', f'{own}_update', parameters, body)}", source

    def _guard(self) -> list[str]:
        """Statements that leave the state alone where the estimate is no finite number."""
        zero = literal(0.0, self.scalar)
        C = len(self.components)
        mean, covariance = ("", "") if C == 1 else ("[i]", "[i][j]")
        terms = [
            f"sum += {zero} * estimate->mean{mean};",
            f"for (j = 0; j < {C}; ++j) sum += {zero} * estimate->covariance{covariance};",
        ]
        return [
            "{ /* Zero times what is not finite is not zero. */",
            f"    {self.scalar.name} sum = {zero};",
            "    int i, j;",
            f"    for (i = 0; i < {C}; ++i) {{",
            *(f"        {term}" for term in terms),
            "    }",
            f"    if (!(sum == {zero})) return {self.name.upper()}_REJECTED;",
            "}",
        ]

    def _taken(self) -> str:
        """Statement that returns whether there was a measurement."""
        own = self.name.upper()
        if "available" not in self.structs["measurement"].places.values():
            return f"return {own}_TAKEN;"
        zero = literal(0.0, self.scalar)
        return f"return measurement->available > {zero} ? {own}_TAKEN : {own}_MISSED;"

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Operations, and bytes of state, weights and stack."""
        size = numpy.dtype(self.scalar.dtype).itemsize
        network = self.traced.network
        weights = 0 if network is None else network_text(network, self.name, self.scalar)[1]
        after = (len(self.traced.state) + self.memory) * size
        asked = 0 if network is None else scratch_size(network) + count_answers(network)
        scratch = (self.update_source.scratch + self.traced.shown + asked) * size + after
        return self.update_source.operations, after, weights, scratch

    @property
    def network_operations(self) -> int:
        """Operations of a network, where it is asked."""
        return 0 if self.traced.network is None else network_operations(self.traced.network)

    @property
    def replaced(self) -> tuple[float, ...]:
        """Constants that the kind of number does not have."""
        return tuple(sorted({*self.start_source.replaced, *self.update_source.replaced}))

    # --- files

    def header(self, notes: Sequence[str] = ()) -> str:
        """Text of the header."""
        own, scalar, structs = self.name, self.scalar, self.structs
        guard = f"{own.upper()}_H"
        listed = ", ".join(f"{i} {name} [{unit}]" for i, (name, unit) in enumerate(self.components))
        remembered = f"{self.scalar.name} network[{self.memory}]; /* what the network remembers */"
        memory = [remembered] if self.memory else []
        functions = {
            "start": ("Begins a track; the initial estimate is all that it takes.", ("state", "initial")),
            "update": (
                "Takes in a measurement: predicts to its time, and updates. What was not received is said by the "
                "measurement itself, as in the environment. Returns what became of it; the state stays as it was where "
                "a measurement is rejected or refused, and the estimate is then of no use.",
                ("state", "measurement", "estimate"),
            ),
        }
        text = [
            comment(*self.about, *notes),
            f"#ifndef {guard}\n#define {guard}\n",
            '#ifdef __cplusplus\nextern "C" {\n#endif\n',
            struct_text(structs["initial"], scalar, "The estimate at the start of a track."),
            struct_text(structs["measurement"], scalar, "What the sensors say at one time."),
            struct_text(structs["estimate"], scalar, f"What is estimated of it. Components: {listed}."),
            struct_text(
                structs["state"],
                scalar,
                "What is kept from one measurement to the next, one struct for each track; members are named by what "
                "leads to them in the filter. Copy it to save it.",
                memory,
            ),
        ]
        statuses = ("TAKEN", "MISSED", "REJECTED", "REFUSED")
        text.append(
            comment(
                "What became of a measurement: taken in; none was received; rejected, since the estimate would be no "
                "number; refused, since its interval is negative or none."
            )
            + "\nenum { "
            + ", ".join(f"{own.upper()}_{name} = {i}" for i, name in enumerate(statuses))
            + " };\n"
        )
        for name, (words, parts) in functions.items():
            arguments = ", ".join(f"{p.type}{p.name}" for p in self._parameters(*parts))
            answer = "int" if name == "update" else "void"
            text.append(f"{comment(words)}\n{answer} {own}_{name}({arguments});\n")
        text.append(f"#ifdef __cplusplus\n}}\n#endif\n\n#endif /* {guard} */\n")
        return "\n".join(text)

    def source(self) -> str:
        """Text of the source."""
        parts = [
            comment(
                "See the header. A loop goes over the members of array operations, k is the member; where they lie is "
                "said by tables, whose names end in at and a number. The array w holds what one loop leaves to another."
                " A comment names the functions whose operations the loops below it have."
            ),
            f'#include "{self.name}.h"\n\n#include <float.h>\n#include <math.h>\n',
            helper_functions([self.traced.start, self.traced.update], self.scalar),
        ]
        if self.traced.network is not None:
            parts.append(network_text(self.traced.network, self.name, self.scalar)[0])
        return _without_blank_runs("\n".join([*parts, self.start, self.update]))

    def rows(self) -> str:
        """Text of a header that fills structs from rows of numbers, for main.c and the test."""
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

    def columns(self, part: str) -> list[str]:
        """Names of the columns of a table, in the order of the rows of an argument."""
        names = self.structs[part].columns
        begin = "initial_" if part == "initial" else ""
        return [f"{begin}{names[row]}" for row in sorted(names)]

    def main(self) -> str:
        """Text of a program that reads a table of measurements and writes one of estimates."""
        C, digits = len(self.components), 17 if self.scalar is DOUBLE else 9
        given = [*self.columns("initial"), *self.columns("measurement")]
        names = [identifier(name) for name, _ in self.components]
        told = [member.name for member in self.traced.estimate if member.name in LIKELIHOODS]
        header = [
            "track",
            "measurement",
            *told,
            *(f"estimate_{n}" for n in names),
            *(f"sigma_{n}" for n in names),
        ]
        return MAIN.format(
            own=self.name,
            columns=_string(",".join(given)),
            header=_string(",".join(header)),
            initial=len(self.columns("initial")),
            count=len(given),
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
            told="".join(f'\n        printf(",%.{digits}g", (double)estimate.{name});' for name in told),
        )

    def log_program(self, log: LogSetup) -> str:
        """Text of a program that reads a log as it was read when the filter was advised; empty where it was no table of
        plots.
        """
        names = next((names for names in POSITIONS if {*names[:2]} <= {*log.columns}), None)
        if names is None or (names[0] == "latitude") != (log.plane is not None):
            return ""
        deviations = (
            ["sigma_x", "sigma_y"] if "sigma_x" in log.deviations else ["range_sigma", "azimuth_sigma"]
        )
        columns = [
            log.columns.get(name, name).lower() for name in ("time", *names[:2], *deviations, *names[2:])
        ]
        real, C = self.scalar.name, len(self.components)
        values = {
            "scan": "scan", "position_0": "p[0]", "position_1": "p[1]", "variance_0": "v[0]", "variance_1": "v[1]",
            "available": "available", "interval": "interval", "elapsed": "elapsed",
        }  # fmt: skip
        struct = self.structs["measurement"]
        if not {*struct.columns.values()} <= {*values}:
            return ""
        fill = [
            f"m.{struct.places[row]} = ({real}){values[struct.columns[row]]};"
            for row in sorted(struct.places)
        ]
        begin = self.structs["initial"]
        initial = {"mean_0": "p[0]", "mean_1": "p[1]", "mean_2": "(p[0] - p0[0]) / lasted"}
        initial["mean_3"] = "(p[1] - p0[1]) / lasted"
        for i in range(2):
            initial[f"covariance_{i}_{i}"] = f"v[{i}]"
            initial[f"covariance_{i}_{i + 2}"] = initial[f"covariance_{i + 2}_{i}"] = f"v[{i}] / lasted"
            initial[f"covariance_{i + 2}_{i + 2}"] = f"(v0[{i}] + v[{i}]) / (lasted * lasted)"
        start = [
            f"initial.{begin.places[row]} = ({real})({initial.get(begin.columns[row], '0.0')});"
            for row in sorted(begin.places)
        ]
        shown = [identifier(name) for name, _ in self.components]
        header = ["time", "status", *(f"estimate_{n}" for n in shown), *(f"sigma_{n}" for n in shown)]
        return LOG.format(
            own=self.name,
            columns=", ".join(_string(name) for name in columns),
            header=_string(",".join(header)),
            count=len(columns),
            position=POSITIONS[names],
            project=PROJECT.format(origin=", ".join(map(literal, log.plane))) if log.plane else "",
            stated_polar=int(deviations[0] == "range_sigma"),
            first=literal(log.deviations[deviations[0]]),
            second=literal(log.deviations[deviations[1]]),
            interval=literal(log.interval),
            fill="\n    ".join(fill),
            start="\n                ".join(start),
            upper=self.name.upper(),
            C=C,
            digits=17 if self.scalar is DOUBLE else 9,
        )

    def test(self) -> str:
        """Text of a program that compares the filter with the vectors."""
        return TEST.format(
            own=self.name,
            limit=literal(self.limit),
            C=len(self.components),
            mean="" if len(self.components) == 1 else "[i]",
        )

    def vectors(self, replayed: Replay) -> str:
        """Text of the vectors of the test."""
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
        """Text of a table of measurements, as main.c reads it."""
        lines = [",".join([*self.columns("initial"), *self.columns("measurement")])]
        blank = "," * len(self.columns("initial"))
        for episode, initial in enumerate(replayed.initial.T.tolist()):
            rows = [",".join(map(repr, row)) for row in replayed.measurements[:, :, episode].tolist()]
            lines.append(",".join([*map(repr, initial), rows[0]]))
            lines += [blank + row for row in rows[1:]]
        return "\n".join([*lines, ""])


def _string(text: str) -> str:
    """A literal of C of words that are identifiers already."""
    assert re.fullmatch(r"[A-Za-z0-9_,]*", text)
    pieces = [text[i : i + 80] for i in range(0, len(text), 80)] or [""]
    return "\n    ".join(f'"{piece}"' for piece in pieces)


def _without_blank_runs(text: str) -> str:
    return re.sub(r"\n{3,}", "\n\n", text)


def export_c(request: ExportRequest, folder: Path, precision: str = "double", command: str = "") -> Figures:
    """Write a competitor as C99 into a folder, after its programs were compared with the competitor itself.

    Args:
        request: the competitor.
        folder: for the files.
        precision: "double" or "float".
        command: that made it, for the comment of the header.

    Raises:
        ValueError: for what cannot be exported, or answers something else in this precision.
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
    writer = Writer(request.name, traced, scalar, replayed.components)
    writer.about = _about(request, writer, precision, command)
    figures = Figures(*writer.sizes, difference, writer.replaced, writer.network_operations)
    large = figures.operations > MOST_OPTIMISED
    test = compile_and_test(writer, replayed, flags=(*FLAGS, "-O0") if large else FLAGS)
    if test and large:
        test += ", compiled without optimisation"
    figures = figures._replace(test=test)
    folder.mkdir(parents=True, exist_ok=True)
    with whole_files(folder) as waiting:
        texts = files_of(writer, replayed, _notes(figures, replayed, precision))
        program = "" if request.log is None else writer.log_program(request.log)
        for file, text in {**texts, **({"log.c": program} if program else {})}.items():
            (waiting / file).write_text(text, encoding="ascii")
    return figures


def price_of(request: ExportRequest) -> dict[str, int] | None:
    """Return what an update costs in C: operations, and bytes of state and stack; None for what cannot be exported."""
    try:
        traced, replayed = replay(request, EPISODES, 2)
    except ValueError:
        return None
    operations, state, weights, stack = Writer(request.name, traced, DOUBLE, replayed.components).sizes
    return {"operations": operations, "state_bytes": state, "weight_bytes": weights, "stack_bytes": stack}


def files_of(writer: Writer, replayed: Replay, notes: Sequence[str] = ()) -> dict[str, str]:
    """Return the text of every file by its name."""
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
    """Paragraphs that say what the filter is."""
    own, maker = writer.name, request.maker
    described = maker if isinstance(maker, type) else getattr(maker, "func", None) and maker
    first = (getattr(described, "__doc__", None) or "").strip().split("\n\n")[0].replace("`", "")
    parameters = ", ".join(f"{key} = {value!r}" for key, value in request.keywords.items())
    return [
        f"{request.name} of {request.problem.id}, in {precision}, for one track. {first}".strip(),
        *([f"With parameters of the task: {parameters}."] if parameters else []),
        *([request.problem.task.measurement_words] if request.problem.task.measurement_words else []),
        f"Made by: {command}" if command else "Made by filtergym.",
        "",
        "No allocation, nothing but math.h. Compare it with the filter that was judged:",
        f"    cc -std=c99 -O2 test.c {own}.c -lm -o test && ./test",
        "Estimates from a table of measurements:",
        f"    cc -std=c99 -O2 main.c {own}.c -lm -o run && ./run measurements.csv",
        *(
            [
                "Estimates from a log of your own:",
                f"    cc -std=c99 -O2 log.c {own}.c -lm -o log && ./log mine.csv",
            ]
            if request.log is not None and writer.log_program(request.log)
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
        notes.append(f"Compiled where it was made: {figures.test}.")
    if figures.replaced:
        listed = ", ".join(f"{value:g}" for value in figures.replaced)
        notes.append(f"Constants that float does not have, replaced by the nearest that it has: {listed}.")
    return notes


def compile_and_test(
    writer: Writer, replayed: Replay, compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> str:
    """Compile the test and run it.

    Args:
        writer: of the filter.
        replayed: the vectors.
        compiler: default: cc, where there is one.
        flags: of the compiler.

    Returns:
        What the test says; nothing without a compiler.

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
                said = (done.stderr or done.stdout).strip()[-500:]
                raise ValueError(
                    f"{words[0]} failed on the exported {writer.name!r}, please report it: {said}"
                )
    return done.stdout.strip()
