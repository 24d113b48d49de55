"""Parameters of a filter in C: their struct, their limits, and what the start of a track does with them."""

import math
from collections.abc import Sequence

import numpy

from ..compiler.c_source import write_program
from ..compiler.c_text import DOUBLE, Parameter, Scalar, array_text, function_text, literal
from .c_structs import structure
from .parameters import SUMMED, Declared
from .traced_filter import FreeParameters, Member


def parameter_members(declared: Sequence[Declared]) -> list[Member]:
    """Members of the struct, with what each is, its default and its limits."""
    found = []
    for one in declared:
        values = [f"{value:.6g}" for value in one.values]
        default = f"Default {', '.join(values)}, from {one.low:.6g} to {one.high:.6g}"
        also = ", ascending" * one.limits.ascending + ", each row sums to 1" * one.limits.stochastic
        words = f"{one.words.strip(' .')}. {default}{also}."
        found += [Member(one.name, one.shape, place, words) for place in range(len(one.values))]
    return found


def parameter_words(free: FreeParameters) -> str:
    """Sentences about the struct."""
    text = (
        "Parameters, given at the start of a track. They have the names and limits of filtergym."
        if free.declared
        else "Parameters: this filter has none that can be given."
    )
    if free.condition is not None:
        text += (
            " Values that order numbers otherwise than the defaults, or make zero what is not, are refused, too, where "
            "another program would follow."
        )
    if free.constant:
        text += f" Constant here, since they decide the form of the program: {', '.join(free.constant)}."
    return text


def parameter_text(own: str, free: FreeParameters, scalar: Scalar) -> tuple[str, list[str], list[str]]:
    """Return tables and functions of the parameters, and the statements at the beginning and the end of start.

    Args:
        own: name of the filter.
        free: its parameters.
        scalar: kind of numbers.
    """
    if not free.declared:
        return "", [], []
    real, refused, count = scalar.name, f"return {own.upper()}_REFUSED;", len(free.values)
    members = structure("", parameter_members(free.declared))
    values = ", ".join(_value(one, scalar) for one in free.declared)
    limits = numpy.array([_limits(one, scalar) for one in free.declared for _ in one.values])
    before = [f"const {own}_parameters {own}_defaults = {{{values}}};\n"]
    before.append(array_text(f"{own}_limits", limits, scalar))
    checks = [
        f"const {real} *const given = (const {real} *)(parameters ? parameters : &{own}_defaults);",
        "int usual = 1;",
        f"if (!parameters) parameters = &{own}_defaults;",
        f"for (int k = 0; k < {count}; ++k) {{",
        f"    if (!(given[k] >= {own}_limits[k][0] && given[k] <= {own}_limits[k][1])) {refused}",
        f"    if (given[k] != ((const {real} *)&{own}_defaults)[k]) usual = 0;",
        "}",
    ]
    places, row = members.places, 0
    for one in free.declared:
        rows = [f"parameters->{places[row + i]}" for i in range(len(one.values))]
        row += len(rows)
        if one.limits.ascending:
            checks.append(f"if ({rows[0]} > {rows[-1]}) {refused}")
        if one.limits.stochastic:
            width = one.shape[-1]
            summed = literal(SUMMED if scalar is DOUBLE else 1e-6, scalar)
            for first in range(0, len(rows), width):
                terms = " + ".join(rows[first : first + width])
                checks.append(f"if (!(fabs{scalar.suffix}({terms} - {literal(1.0, scalar)}) <= {summed})) {refused}")
    if free.condition is not None:
        given = [Parameter(f"const {own}_parameters *", "parameters")]
        source = write_program(
            free.condition, f"{own}_holds", given, lambda _, r: f"parameters->{places[r]}", lambda *_: "held", scalar
        )
        body = [f"{real} held;", *source.body, f"return held != {literal(0.0, scalar)};"]
        before += [source.functions, function_text("static int", f"{own}_holds", given, body)]
        checks.append(f"if (!{own}_holds(parameters)) {refused}")
    exact = free.exact if scalar is DOUBLE else 0
    library = free.derived[exact:]
    after = []
    if library:
        # The same bits whatever the functions of a library give.
        before.append(array_text(f"{own}_derived", numpy.array(library), scalar))
        after = [
            "if (usual)",
            f"    for (int k = 0; k < {len(library)}; ++k) state->derived[{exact} + k] = {own}_derived[k];",
        ]
    else:
        checks = [line for line in checks if "usual" not in line]
    return "\n".join(before), checks, after


def _value(one: Declared, scalar: Scalar) -> str:
    """Default of a member as C writes it."""

    def braces(part: numpy.ndarray) -> str:
        if part.ndim == 0:
            return literal(float(part), scalar)
        return "{" + ", ".join(braces(row) for row in part) + "}"

    return braces(numpy.array(one.values).reshape([size for size in one.shape if size != 1]))


def _limits(one: Declared, scalar: Scalar) -> tuple[float, float]:
    """Limits that a kind of number has."""
    if scalar is DOUBLE:
        return one.low, one.high
    largest = float(numpy.finfo(scalar.dtype).max)
    found = []
    for limit, towards in ((one.low, math.inf), (one.high, -math.inf)):
        near = scalar.dtype(min(max(limit, -largest), largest))
        inside = near >= limit if towards > 0.0 else near <= limit
        found.append(float(near if inside else numpy.nextafter(near, scalar.dtype(towards))))
    return found[0], found[1]
