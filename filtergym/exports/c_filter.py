"""A filter as a header and a source of C99: its structs, its two functions, and its cost.

No allocation, and no library but ``math.h``; parameters and weights are constants. Names in a file from others enter
the text as identifiers and comments only, see :mod:`..compiler.c_source`.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy

from ..compiler.c_loops import Arrays, Rows
from ..compiler.c_source import helper_functions, write_program
from ..compiler.c_text import Parameter, Scalar, comment, function_text, identifier, literal
from .c_network import memory_size, network_operations, network_text, scratch_size
from .c_parameters import parameter_members, parameter_text, parameter_words
from .c_structs import struct_text, structure
from .traced_filter import (
    ANSWER,
    DERIVED,
    ESTIMATE,
    INITIAL,
    MEASUREMENT,
    SHOWN,
    STATE,
    TracedFilter,
    action_size,
)

TAKEN = ("rows", "vectors", "test", "log", "math", "float", "stdio", "stdlib", "string", "time")
"""Names that a filter cannot have, since other files or functions of an export have them."""


def file_stem(name: str) -> str:
    """Return a competitor's name as a C identifier, which begins the names of its files and functions."""
    return identifier(name, TAKEN)


class FilterText:
    """Writer of a filter's header and source in C, with the functions ``start`` and ``update``.

    Attributes:
        about: paragraphs for the comment of the header.
    """

    def __init__(
        self, name: str, traced: TracedFilter, scalar: Scalar, components: Sequence[tuple[str, str]]
    ) -> None:
        self.traced = traced
        self.scalar = scalar
        self.components = components
        self.about: list[str] = []
        self.name: str = file_stem(name)
        own = self.name
        parts = {"state": traced.state, "initial": traced.initial, "measurement": traced.measurement}
        parts |= {"estimate": traced.estimate, "parameters": parameter_members(traced.free.declared)}
        self.structs = {key: structure(f"{own}_{key}", members) for key, members in parts.items()}
        self.memory: int = memory_size(traced.network) if traced.network is not None else 0
        self.has_state: bool = bool(traced.state or self.memory)
        self.start, self.start_source = self._start()
        self.update, self.update_source = self._update()

    def _parameters(self, *parts: str) -> list[Parameter]:
        """Return C function parameters that point to the structs ``parts``, ``const`` where only read."""
        return [
            Parameter(
                f"{'const ' * (part in ('initial', 'measurement', 'parameters'))}{self.structs[part].name} *",
                part,
            )
            for part in parts
        ]

    def _rows(self, part: str, name: str = "", qualifier: str = "const ") -> Rows:
        """Return a struct of C seen as one array, with its numbers in the order of a program's argument."""
        pointer = f"(({qualifier}{self.scalar.name} *){name or part})"
        return Rows(pointer, self.structs[part].numbers)

    def _start(self) -> tuple[str, Any]:
        to, given = self.structs["state"].places, self.structs["initial"].places
        parameters, own, free = (
            self._parameters("state", "initial", "parameters"),
            self.name,
            self.traced.free,
        )
        own_rows = Rows("own", range(len(free.usual)))
        inner = [*parameters, Parameter(f"const {self.scalar.name} *", "own")] if free.usual else parameters

        def read(argument: int, row: int) -> str:
            if argument == INITIAL:
                return f"initial->{given[row]}"
            return f"state->{to[row]}" if argument == STATE else f"own[{row}]"

        source = write_program(
            self.traced.start,
            f"{own}_start",
            inner,
            read,
            lambda _, row: f"state->{to[row]}",
            self.scalar,
            arrays=Arrays(
                {INITIAL: self._rows("initial"), STATE: self._rows("state"), DERIVED: own_rows},
                {STATE: self._rows("state", qualifier="")},
            ),
        )
        body = list(source.body)
        if self.memory:
            zero = literal(0.0, self.scalar)
            body += [f"for (int k = 0; k < {self.memory}; ++k) state->network[k] = {zero};"]
        before, derived = parameter_text(own, free, self.scalar, self.structs["parameters"])
        body = [*derived, *body, f"return {own.upper()}_TAKEN;"]
        return f"{before}{source.functions}\n{function_text('int', f'{own}_start', parameters, body)}", source

    def _update(self) -> tuple[str, Any]:
        traced, real, own = self.traced, self.scalar.name, self.name
        state, places = self.structs["state"], self.structs["state"].places
        given, reported = self.structs["measurement"].places, self.structs["estimate"].places
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
            return f"next->{places[row]}" if argument == STATE else f"estimate->{reported[row]}"

        read_rows = {STATE: self._rows("state"), MEASUREMENT: self._rows("measurement")}
        written = {STATE: self._rows("state", "next", ""), ESTIMATE: self._rows("estimate", qualifier="")}
        if traced.network is not None:
            read_rows[ANSWER] = Rows("answer", range(action_size(traced.network)))
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
            # The written struct differs from the read one.
            start = " = *state" if self.memory or traced.free.kept else ""
            body = [
                f"{state.name} after{start};",
                f"{state.name} *const next = &after;",
                *body,
                *self._guard(),
                "*state = after;",
                self._return_statement(),
            ]
        else:
            if "next" in " ".join(body):
                body = [f"{state.name} *const next = state;", *body]
            body.append(self._return_statement())
        if traced.network is not None:
            zero = literal(0.0, self.scalar)
            answers = f"{real} answer[{action_size(traced.network)}] = {{{zero}}};"
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
        """Return the C statements that reject an estimate that is not finite and leave the state unchanged."""
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

    def _return_statement(self) -> str:
        """Return the C statement that returns ``TAKEN`` if a part of the measurement was received, else ``MISSED``."""
        own, zero = self.name.upper(), literal(0.0, self.scalar)
        there = [
            p for p in self.structs["measurement"].places.values() if re.fullmatch(r"available(\[\d+\])*", p)
        ]
        if not there:
            return f"return {own}_TAKEN;"
        received = " || ".join(f"measurement->{place} > {zero}" for place in there)
        return f"return {received} ? {own}_TAKEN : {own}_MISSED;"

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Number of operations of an update, and bytes of state, network weights and stack."""
        size = numpy.dtype(self.scalar.dtype).itemsize
        network = self.traced.network
        weights = 0 if network is None else network_text(network, self.name, self.scalar)[1]
        after = (len(self.traced.state) + self.memory) * size
        asked = 0 if network is None else scratch_size(network) + action_size(network)
        scratch = (self.update_source.scratch + self.traced.shown + asked) * size + after
        return self.update_source.operations, after, weights, scratch

    @property
    def network_operations(self) -> int:
        """Multiplications and additions of one evaluation of the network; 0 without one."""
        return 0 if self.traced.network is None else network_operations(self.traced.network)

    @property
    def replaced(self) -> tuple[float, ...]:
        """Constants of the filter that the C type cannot represent, which the text replaces."""
        return tuple(sorted({*self.start_source.replaced, *self.update_source.replaced}))

    # --- files

    def header(self, notes: Sequence[str] = ()) -> str:
        """Return the text of the C header file; ``notes`` are paragraphs for its comment."""
        own, scalar, structs = self.name, self.scalar, self.structs
        guard = f"{own.upper()}_H"
        listed = ", ".join(f"{i} {name} [{unit}]" for i, (name, unit) in enumerate(self.components))
        remembered = f"{self.scalar.name} network[{self.memory}]; /* memory of the network */"
        memory = [remembered] if self.memory else []
        timed = "interval" in structs["measurement"].places.values()
        predicts = (
            "predicts over its interval"
            if timed
            else "predicts from the one before (a call for every measurement, also where nothing was received)"
        )
        refused = "its interval is negative or no number" if timed else "never, without an interval"
        functions = {
            "start": (
                "Begins a track with an initial estimate and parameters; NULL in place of parameters: those of "
                f"{own}_defaults. Returns {own.upper()}_TAKEN, or {own.upper()}_REFUSED where a parameter is outside "
                "its limits: the state stays as it was.",
                ("state", "initial", "parameters"),
            ),
            "update": (
                f"Takes in a measurement: {predicts}, and updates. The members of the measurement state what was "
                "received, as in the environment. Returns the result; the state stays as it was where a "
                "measurement is rejected or refused, and the estimate is then invalid.",
                ("state", "measurement", "estimate"),
            ),
        }
        text = [
            comment(*self.about, *notes),
            f"#ifndef {guard}\n#define {guard}\n",
            '#ifdef __cplusplus\nextern "C" {\n#endif\n',
            struct_text(structs["initial"], scalar, "The estimate at the start of a track."),
            struct_text(structs["parameters"], scalar, parameter_words(self.traced.free)),
            *([f"extern const {own}_parameters {own}_defaults;\n"] if self.traced.free.declared else []),
            struct_text(structs["measurement"], scalar, "Measurement of the sensors at one time."),
            struct_text(structs["estimate"], scalar, f"Estimate. Components: {listed}."),
            struct_text(
                structs["state"],
                scalar,
                "State between two measurements, one struct for each track; members are named by the attributes that "
                "lead to them in the filter. Copy it to save it.",
                memory,
            ),
        ]
        statuses = ("TAKEN", "MISSED", "REJECTED", "REFUSED")
        text.append(
            comment(
                "Result of a measurement: taken in; missed, nothing was received; rejected, the estimate would not be "
                f"finite; refused, {refused}."
            )
            + "\nenum { "
            + ", ".join(f"{own.upper()}_{name} = {i}" for i, name in enumerate(statuses))
            + " };\n"
        )
        for name, (words, parts) in functions.items():
            arguments = ", ".join(f"{p.type}{p.name}" for p in self._parameters(*parts))
            text.append(f"{comment(words)}\nint {own}_{name}({arguments});\n")
        text.append(f"#ifdef __cplusplus\n}}\n#endif\n\n#endif /* {guard} */\n")
        return "\n".join(text)

    def source(self) -> str:
        """Return the text of the C source file: network, ``start`` and ``update``."""
        parts = [
            comment(
                "See the header. A loop goes over the members of array operations, k is the member; tables, whose "
                "names end in at and a number, contain their places. The array w passes values from loop to loop. A "
                "comment names the functions whose operations the loops below it have."
            ),
            f'#include "{self.name}.h"\n\n#include <float.h>\n#include <math.h>\n',
            helper_functions([self.traced.start, self.traced.update], self.scalar),
        ]
        if self.traced.network is not None:
            parts.append(network_text(self.traced.network, self.name, self.scalar)[0])
        return _without_blank_runs("\n".join([*parts, self.start, self.update]))


def _without_blank_runs(text: str) -> str:
    return re.sub(r"\n{3,}", "\n\n", text)
