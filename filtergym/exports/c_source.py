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
from typing import Any, NamedTuple

import numpy

from ..baselines.fitted_filters import LogSetup
from ..compiler.c_source import (
    DOUBLE,
    FLOAT,
    Parameter,
    Scalar,
    comment,
    function_text,
    helper_functions,
    identifier,
    literal,
    write_program,
)
from ..evaluation.storage.files import whole_files
from .c_network import memory_size, network_text
from .replay import Replay, mean_rows, replay, run_filter
from .request import ExportRequest
from .traced_filter import (
    ANSWER,
    LIKELIHOODS,
    SHOWN,
    STATE,
    Member,
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
VECTORS = 2, 50
"""Episodes and measurements among the test's vectors, at most."""


def file_stem(name: str) -> str:
    """Return what the files and functions of a filter are called."""
    return identifier(name, TAKEN)


class Figures(NamedTuple):
    """What is known of an exported filter."""

    operations: int
    """Of an update, without those of a network."""
    state_bytes: int
    constant_bytes: int
    """Of a network's weights."""
    scratch_bytes: int
    """On the stack, beside the state."""
    difference: float
    """Largest one to the competitor itself, in its standard deviations, see :func:`~.replay.run_filter`."""
    replaced: tuple[float, ...]
    """Constants that float does not have."""
    test: str = ""
    """What the compiled test has said; empty without a compiler."""


class Structure(NamedTuple):
    """A struct of C."""

    name: str
    arrays: list[tuple[str, tuple[int, ...], str, list[int]]]
    """Of every array its name, its shape, what it is, and the rows of the argument in its order."""
    places: dict[int, str]
    """Row of the argument to the expression that follows the variable."""
    columns: dict[int, str]
    """Row of the argument to a name in a table."""


def structure(name: str, members: Sequence[Member]) -> Structure:
    """Give numbers their places in a struct: an array of which every entry is there stays one, of others the entries
    that are there get names of their own.
    """
    groups: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for row, member in enumerate(members):
        groups.setdefault((member.name, member.shape), []).append(row)
    arrays: list[tuple[str, tuple[int, ...], str, list[int]]] = []
    places, columns = {}, {}
    taken: set[str] = set()
    for (words, shape), rows in groups.items():
        whole = len(rows) == int(numpy.prod(shape, dtype=int))
        if whole:
            own = identifier(words, taken)
            taken.add(own)
            arrays.append((own, shape, members[rows[0]].words, rows))
        for row in rows:
            index = [int(i) for i in numpy.unravel_index(members[row].place, shape)] if shape else []
            if not whole:
                own = identifier("_".join([words, *map(str, index)]), taken)
                taken.add(own)
                arrays.append((own, (), members[row].words, [row]))
            places[row] = own + ("".join(f"[{i}]" for i in index) if whole else "")
            columns[row] = "_".join([own, *map(str, index)]) if whole else own
    return Structure(name, arrays, places, columns)


def _struct_text(struct: Structure, scalar: Scalar, title: str, extra: Sequence[str] = ()) -> str:
    lines = [comment(title), "typedef struct {"]
    words = ""
    for name, shape, text, _ in struct.arrays:
        if text and text != words:
            lines.append(comment(text, indent="    "))
        words = text
        lines.append(f"    {scalar.name} {name}{''.join(f'[{size}]' for size in shape)};")
    lines += [f"    {line}" for line in extra]
    if not struct.arrays and not extra:
        lines.append("    char nothing; /* C has no empty struct */")
    return "\n".join([*lines, f"}} {struct.name};\n"])


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

        source = write_program(
            traced.update,
            f"{own}_update",
            inner,
            read,
            write,
            self.scalar,
            between=between,
            results=traced.shown,
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
        rows = [
            row for row, member in enumerate(self.traced.estimate) if member.name in ("mean", "covariance")
        ]
        places = self.structs["estimate"].places
        terms = " + ".join(f"{zero} * estimate->{places[row]}" for row in rows)
        return [
            "/* Zero times what is not finite is not zero. */",
            f"if (!({terms} == {zero})) return {self.name.upper()}_REJECTED;",
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
        scratch = (self.update_source.scratch + self.traced.shown) * size + after
        return self.update_source.operations, after, weights, scratch

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
            _struct_text(structs["initial"], scalar, "The estimate at the start of a track."),
            _struct_text(structs["measurement"], scalar, "What the sensors say at one time."),
            _struct_text(structs["estimate"], scalar, f"What is estimated of it. Components: {listed}."),
            _struct_text(
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
            comment("See the header. Temporaries are numbered in the order in which they are computed."),
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
        return _MAIN.format(
            own=self.name,
            columns=_string(",".join(given)),
            header=_string(",".join(header)),
            initial=len(self.columns("initial")),
            count=len(given),
            C=C,
            digits=digits,
            mean="" if C == 1 else "[i]",
            covariance="" if C == 1 else "[i][i]",
            told="".join(f'\n        printf(",%.{digits}g", (double)estimate.{name});' for name in told),
        )

    def log_program(self, log: LogSetup) -> str:
        """Text of a program that reads a log as it was read when the filter was advised; empty where it was no table of
        plots.
        """
        polar = {"range", "azimuth"} <= {*log.columns}
        if not polar and ("x" not in log.columns or "latitude" in log.columns):
            return ""
        names = ["range", "azimuth"] if polar else ["x", "y"]
        deviations = (
            ["sigma_x", "sigma_y"] if "sigma_x" in log.deviations else ["range_sigma", "azimuth_sigma"]
        )
        columns = [log.columns.get(name, name).lower() for name in ("time", *names, *deviations)]
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
        return _LOG.format(
            own=self.name,
            columns=", ".join(_string(name) for name in columns),
            header=_string(",".join(header)),
            polar=int(polar),
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
        return _TEST.format(
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
        first = len(self.columns("initial"))
        lines = [",".join([*self.columns("initial"), *self.columns("measurement")])]
        for episode in range(replayed.initial.shape[1]):
            for k, measured in enumerate(replayed.measurements[:, :, episode]):
                initial = replayed.initial[:, episode] if k == 0 else [""] * first
                lines.append(
                    ",".join(str(x) if isinstance(x, str) else repr(float(x)) for x in [*initial, *measured])
                )
        return "\n".join([*lines, ""])


def _string(text: str) -> str:
    """A literal of C of words that are identifiers already."""
    assert re.fullmatch(r"[A-Za-z0-9_,]*", text)
    pieces = [text[i : i + 80] for i in range(0, len(text), 80)] or [""]
    return "\n    ".join(f'"{piece}"' for piece in pieces)


def _without_blank_runs(text: str) -> str:
    return re.sub(r"\n{3,}", "\n\n", text)


_MAIN = """/* Reads a table of measurements (CSV, a file or standard input) and writes the estimates.
   A row whose initial columns are filled begins a new track. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rows.h"

#define COLUMNS {count}
static const char columns[] =
    {columns};

static char line[32 * COLUMNS + sizeof columns];

/* The numbers of a line; an empty one is NaN. Returns how many there are. */
static int numbers(const char *text, double *row) {{
    int count = 0;
    for (;;) {{
        char *end;
        double value = strtod(text, &end);
        if (end == text) value = (double)NAN;
        if (count < COLUMNS) row[count] = value;
        ++count;
        while (*end != ',' && *end != '\\0' && *end != '\\n' && *end != '\\r') ++end;
        if (*end != ',') return count;
        text = end + 1;
    }}
}}

int main(int argc, char **argv) {{
    static {own}_state state;
    static double row[COLUMNS];
    long track = 0, measurement = 0, number = 1;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : stdin;
    if (file == NULL) {{
        fprintf(stderr, "cannot read %s\\n", argv[1]);
        return 2;
    }}
    if (fgets(line, (int)sizeof line, file) == NULL || strncmp(line, columns, strlen(columns)) != 0 ||
        strcspn(line, "\\r\\n") != strlen(columns)) {{
        fprintf(stderr, "the first line must be %s\\n", columns);
        return 2;
    }}
    puts({header});
    while (fgets(line, (int)sizeof line, file) != NULL) {{
        {own}_measurement measurement_now;
        {own}_estimate estimate;
        int i;
        ++number;
        if (line[strspn(line, "\\r\\n")] == '\\0') continue;
        if (numbers(line, row) != COLUMNS) {{
            fprintf(stderr, "line %ld must have %d numbers\\n", number, COLUMNS);
            return 2;
        }}
        if (row[0] == row[0]) {{
            {own}_initial initial;
            set_initial(&initial, row);
            {own}_start(&state, &initial);
            ++track;
            measurement = 0;
        }}
        if (track == 0) {{
            fprintf(stderr, "line 2 must begin a track\\n");
            return 2;
        }}
        set_measurement(&measurement_now, row + {initial});
        {own}_update(&state, &measurement_now, &estimate);
        printf("%ld,%ld", track, ++measurement);{told}
        for (i = 0; i < {C}; ++i) printf(",%.{digits}g", (double)estimate.mean{mean});
        for (i = 0; i < {C}; ++i) printf(",%.{digits}g", sqrt((double)estimate.covariance{covariance}));
        putchar('\\n');
    }}
    if (file != stdin) fclose(file);
    return 0;
}}
"""
_LOG = """/* Reads a log (CSV, a file or standard input) as it was read when this filter was advised, and writes an
   estimate for each row: the track starts from the first two plots, and scans without a row have missed the target. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "{own}.h"

#define INTERVAL {interval} /* s */
#define DEGREE (3.14159265358979323846 / 180.0)

/* Time, two coordinates, and their deviations, which a log may lack. */
static const char *const names[5] = {{{columns}}};
static const double usual[2] = {{{first}, {second}}};
static int place[5] = {{-1, -1, -1, -1, -1}};
static char line[65536];

static {own}_state state;
static double p0[2], v0[2], last, last_plot, scan;

/* Number in a column of a row; NaN where there is none. */
static double number(const char *row, int column) {{
    char *end;
    double value;
    if (column < 0) return (double)NAN;
    for (; column > 0; --column) {{
        row = strchr(row, ',');
        if (row == NULL) return (double)NAN;
        ++row;
    }}
    value = strtod(row, &end);
    return end == row ? (double)NAN : value;
}}

/* Finds the columns in the first line; names are read without regard to case. */
static void find_columns(char *row) {{
    int column = 0;
    char *word = row;
    for (;; ++column) {{
        size_t length = strcspn(word, ",\\r\\n"), i;
        const char after = word[length];
        int k;
        word[length] = '\\0';
        for (i = 0; i < length; ++i)
            if (word[i] >= 'A' && word[i] <= 'Z') word[i] = (char)(word[i] - 'A' + 'a');
        for (k = 0; k < 5; ++k)
            if (strcmp(word, names[k]) == 0) place[k] = column;
        if (after != ',') return;
        word += length + 1;
    }}
}}

/* Position and variances of a row, in metres east and north; returns whether there is a plot. */
static int read_plot(const char *row, double *p, double *v) {{
    const double a = number(row, place[1]), b = number(row, place[2]);
    double s = number(row, place[3]), r = number(row, place[4]);
    if (!(a - a == 0.0 && b - b == 0.0)) return 0;
    if (!(s > 0.0)) s = usual[0];
    if (!(r > 0.0)) r = usual[1];
    p[0] = {polar} ? a * sin(b * DEGREE) : a;
    p[1] = {polar} ? a * cos(b * DEGREE) : b;
    v[0] = s * s;
    v[1] = r * r;
    if ({stated_polar}) {{
        /* Range and azimuth, rotated into east and north; the diagonal of the covariance. */
        const double square = p[0] * p[0] + p[1] * p[1];
        const double along = square > 0.0 ? p[0] * p[0] / square : 0.5;
        const double across = square * (r * DEGREE) * (r * DEGREE);
        v[0] = along * s * s + (1.0 - along) * across;
        v[1] = (1.0 - along) * s * s + along * across;
    }}
    return 1;
}}

static int step(double at, double available, const double *p, const double *v, {own}_estimate *estimate) {{
    {own}_measurement m;
    const double interval = at - last, elapsed = at - last_plot;
    int status;
    scan += 1.0;
    (void)interval;
    (void)elapsed;
    (void)available;
    (void)p;
    (void)v;
    {fill}
    status = {own}_update(&state, &m, estimate);
    if (status == {upper}_REFUSED) return status;
    last = at;
    if (available > 0.0) last_plot = at;
    return status;
}}

int main(int argc, char **argv) {{
    static const char *const words[4] = {{"taken", "missed", "rejected", "refused"}};
    static const double none[2] = {{0.0, 0.0}}, one[2] = {{1.0, 1.0}};
    long plots = 0;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : stdin;
    if (file == NULL) {{
        fprintf(stderr, "cannot read %s\\n", argv[1]);
        return 2;
    }}
    if (fgets(line, (int)sizeof line, file) != NULL) find_columns(line);
    if (place[0] < 0 || place[1] < 0 || place[2] < 0) {{
        fprintf(stderr, "the first line must name %s, %s and %s, separated by commas\\n", names[0], names[1], names[2]);
        return 2;
    }}
    puts({header});
    while (fgets(line, (int)sizeof line, file) != NULL) {{
        double p[2] = {{0.0, 0.0}}, v[2] = {{1.0, 1.0}};
        const double at = number(line, place[0]);
        const int there = read_plot(line, p, v);
        {own}_estimate estimate;
        double scans, k;
        int i, status;
        if (!(at - at == 0.0)) continue;
        if (plots < 2) {{
            if (!there) continue;
            if (plots == 1) {{
                const double lasted = at - last;
                {own}_initial initial;
                if (!(lasted > 0.0)) continue;
                {start}
                {own}_start(&state, &initial);
            }}
            ++plots;
            memcpy(p0, p, sizeof p0);
            memcpy(v0, v, sizeof v0);
            last = last_plot = at;
            continue;
        }}
        scans = floor((at - last) / INTERVAL + 0.5);
        if (scans > 1.0 && scans <= 1001.0) {{
            const double begun = last;
            for (k = 1.0; k < scans; k += 1.0) (void)step(begun + (at - begun) * k / scans, 0.0, none, one, &estimate);
        }}
        status = step(at, there ? 1.0 : 0.0, p, v, &estimate);
        printf("%.17g,%s", at, words[status]);
        for (i = 0; i < {C}; ++i)
            if (status < 2)
                printf(",%.{digits}g", (double)estimate.mean[i]);
            else
                printf(",");
        for (i = 0; i < {C}; ++i)
            if (status < 2)
                printf(",%.{digits}g", sqrt((double)estimate.covariance[i][i]));
            else
                printf(",");
        putchar('\\n');
    }}
    if (file != stdin) fclose(file);
    return 0;
}}
"""
_TEST = """/* Compares the filter with what the competitor itself estimated, and says how long an update takes. */
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "rows.h"
#include "vectors.h"

#define LIMIT {limit} /* standard deviations */

static double run(double worst) {{
    int track, k, i;
    for (track = 0; track < TRACKS; ++track) {{
        {own}_state state;
        {own}_initial initial;
        set_initial(&initial, initials[track]);
        {own}_start(&state, &initial);
        for (k = track * MEASUREMENTS; k < (track + 1) * MEASUREMENTS; ++k) {{
            {own}_measurement measurement;
            {own}_estimate estimate;
            set_measurement(&measurement, measurements[k]);
            {own}_update(&state, &measurement, &estimate);
            for (i = 0; i < {C}; ++i) {{
                const double off = fabs((double)estimate.mean{mean} - means[k][i]);
                const double difference = off == 0.0 ? 0.0 : off / sigmas[k][i];
                if (!(difference <= worst)) worst = difference;
            }}
        }}
    }}
    return worst;
}}

int main(void) {{
    const double worst = run(0.0);
    const clock_t begin = clock();
    long updates = 0;
    double seconds;
    volatile double kept;
    do {{
        kept = run(0.0);
        updates += TRACKS * MEASUREMENTS;
        seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
    }} while (seconds < 0.2);
    (void)kept;
    printf("largest difference %.1e standard deviations, %.0f ns an update\\n", worst, 1e9 * seconds / (double)updates);
    return worst <= LIMIT ? 0 : 1;
}}
"""


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
    figures = Figures(*writer.sizes, difference, writer.replaced)
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
        f"{figures.operations:,} operations an update; bytes: {figures.state_bytes:,} of state"
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
