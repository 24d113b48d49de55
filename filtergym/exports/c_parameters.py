"""Parameters of a filter in C: their struct, their limits, and their use at the start of a track."""

import math
from collections.abc import Sequence

import numpy

from ..compiler.c_loops import Arrays, Rows
from ..compiler.c_source import write_program
from ..compiler.c_text import DOUBLE, Parameter, Scalar, array_text, function_text, literal
from ..compiler.program import StraightLineProgram
from ..envs.contract.parameters import LARGEST, ParameterLimits
from .c_structs import Structure
from .parameters import PARAMETER, SUMMED, Declared
from .traced_filter import DERIVED, FreeParameters, Member


def parameter_members(declarations: Sequence[Declared]) -> list[Member]:
    """Return the members of the parameters' struct, with the meaning, default and limits of each."""
    found = []
    for one in declarations:
        values = [f"{value:.6g}" for value in one.values]
        if one.limits == ParameterLimits():
            limits = [f"from {one.low:.6g} to {one.high:.6g}"] if abs(one.high) < LARGEST else []
        else:
            limits = [f"{word} {limit:g}" for word, limit in _limit_words(one.limits) if limit is not None]
        default = ", ".join([f"Default {', '.join(values)}", *limits])
        also = ", ascending" * one.limits.ascending + ", each row sums to 1" * one.limits.stochastic
        words = f"{one.words.strip(' .')}. {default}{also}."
        found += [Member(one.name, one.shape, place, words) for place in range(len(one.values))]
    return found


def _limit_words(limits: ParameterLimits) -> list[tuple[str, float | None]]:
    return [
        ("above", limits.above),
        ("at least", limits.at_least),
        ("below", limits.below),
        ("at most", limits.at_most),
    ]


def parameter_words(free: FreeParameters) -> str:
    """Return the sentences on a filter's parameters for the comment of its C header."""
    text = (
        "Parameters, given at the start of a track. They have the names and limits of filtergym."
        if free.declared
        else "Parameters: this filter has none."
    )
    if free.condition is not None:
        text += (
            " Values that decide a branch of the filter's own code otherwise than the defaults, such as their order, "
            "are also rejected: they would need another program."
        )
    if free.constant:
        text += (
            " Constant here, since the form of the program depends on them, or they enter through a computation "
            f"that is not exported, such as the solution of a matrix equation: {', '.join(free.constant)}."
        )
    return text


def parameter_text(
    name: str, free: FreeParameters, scalar: Scalar, struct: Structure
) -> tuple[str, list[str]]:
    """Return the C tables and functions of the parameters, and the first statements of ``start``.

    The statements reject values outside the limits, and compute the numbers ``own`` that the filter derives.
    """
    if free.derive is None:
        return "", []
    real, refused, count = scalar.name, f"return {name.upper()}_REFUSED;", len(free.usual)
    listed = [Parameter(f"const {name}_parameters *", "parameters"), Parameter(f"{real} *", "own")]
    values = ", ".join(_value(one, scalar) for one in free.declared)
    before = [f"const {name}_parameters {name}_defaults = {{{values}}};\n"]
    before.append(
        array_text(f"{name}_limits", numpy.array([_limits(one, scalar) for one in free.declared]), scalar)
    )
    lengths = [len(one.values) for one in free.declared]
    inner = f"if (!(*number >= {name}_limits[k][0] && *number <= {name}_limits[k][1])) {refused}"
    loop = [f"    {inner}", "    ++number;"]
    if len(set(lengths)) > 1:
        inside = ", ".join(map(str, lengths))
        before.append(f"static const unsigned short {name}_lengths[{len(lengths)}] = {{{inside}}};\n")
    length = f"{name}_lengths[k]" if len(set(lengths)) > 1 else str(lengths[0])
    if length != "1":
        loop = [f"    for (int i = 0; i < {length}; ++i, ++number)", f"        {inner}"]
    body = [
        f"const {real} *number;",
        f"{real} own[{max(count, 1)}];",
        "const int usual = !parameters;" if _stored_rows(free, scalar) else "",
        f"if (!parameters) parameters = &{name}_defaults;",
        f"number = (const {real} *)parameters;",
        f"for (int k = 0; k < {len(lengths)}; ++k) {{",
        *loop,
        "}",
        *_row_checks(free, scalar, struct, refused),
    ]

    def read(_: int, row: int) -> str:
        return f"parameters->{struct.places[row]}"

    if free.condition is not None:
        source = write_program(free.condition, f"{name}_holds", listed, read, lambda *_: "own[0]", scalar)
        before += [source.functions, function_text("static void", f"{name}_holds", listed, source.body)]
        body += [f"{name}_holds(parameters, own);", f"if (own[0] == {literal(0.0, scalar)}) {refused}"]
    rows = Rows(f"((const {real} *)parameters)", struct.numbers), Rows("own", range(count))
    arrays = Arrays({PARAMETER: rows[0]}, {DERIVED: rows[1]})
    sources = [
        write_program(
            code, f"{name}_derive", listed, read, lambda _, row: f"own[{row}]", scalar, arrays=arrays
        )
        for code in (free.derive, _merge_by_depth(free.derive))
    ]
    texts = [[s.functions, function_text("static void", f"{name}_derive", listed, s.body)] for s in sources]
    before += min(texts, key=lambda parts: sum(map(len, parts)))
    body.append(f"{name}_derive(parameters, own);")
    if stated := _stored_rows(free, scalar):
        # The same bits for every library of functions.
        numbers = numpy.array([free.usual[row] for row in stated])
        before.append(array_text(f"{name}_usual", numbers, scalar))
        place = f"own[{stated.start} + k]" if stated.start else "own[k]"
        body.append(f"for (int k = 0; usual && k < {len(stated)}; ++k) {place} = {name}_usual[k];")
    if free.kept:
        body.append(f"for (int k = 0; k < {free.kept}; ++k) state->derived[k] = own[k];")
    return "\n".join(before), [line for line in body if line]


def _merge_by_depth(code: StraightLineProgram) -> StraightLineProgram:
    """Return a program whose equal operations at equal depth are marked as one array operation, a loop in C."""
    depths: list[int] = []
    groups: dict[tuple[int, str], int] = {}
    own = []
    for step in code.steps:
        depths.append(1 + max((depths[part] for part in step.parts), default=0))
        own.append(groups.setdefault((depths[-1], step.operation), len(groups)))
    return code._replace(origins=numpy.column_stack([own, range(len(own))]), callers={})


def _stored_rows(free: FreeParameters, scalar: Scalar) -> range:
    """Return the rows of derived numbers that the C text stores as constants for default parameters."""
    return free.stated if scalar is DOUBLE else range(len(free.usual))


def _row_checks(free: FreeParameters, scalar: Scalar, struct: Structure, refused: str) -> list[str]:
    """Return C statements that reject pairs that do not ascend and probabilities that do not sum to one."""
    checks, row = [], 0
    for one in free.declared:
        rows = [f"parameters->{struct.places[row + i]}" for i in range(len(one.values))]
        row += len(rows)
        if one.limits.ascending:
            checks.append(f"if ({rows[0]} > {rows[-1]}) {refused}")
        if one.limits.stochastic:
            width, real = one.shape[-1], scalar.name
            least = literal(SUMMED if scalar is DOUBLE else 1e-6, scalar)
            first = f"&{rows[0]} + {width} * k" if len(rows) > width else f"&{rows[0]}"
            sums = [
                f"const {real} *const row = {first};",
                f"{real} sum = {literal(-1.0, scalar)};",
                f"for (int i = 0; i < {width}; ++i) sum += row[i];",
                f"if (!(fabs{scalar.suffix}(sum) <= {least})) {refused}",
            ]
            checks += [
                f"for (int k = 0; k < {len(rows) // width}; ++k) {{",
                *(f"    {line}" for line in sums),
                "}",
            ]
    return checks


def _value(one: Declared, scalar: Scalar) -> str:

    def braces(part: numpy.ndarray) -> str:
        if part.ndim == 0:
            return literal(float(part), scalar)
        return "{" + ", ".join(braces(row) for row in part) + "}"

    return braces(numpy.array(one.values).reshape([size for size in one.shape if size != 1]))


def _limits(one: Declared, scalar: Scalar) -> tuple[float, float]:
    if scalar is DOUBLE:
        return one.low, one.high
    largest = float(numpy.finfo(scalar.dtype).max)
    found = []
    with numpy.errstate(all="ignore"):
        for limit, towards in ((one.low, math.inf), (one.high, -math.inf)):
            near = scalar.dtype(min(max(limit, -largest), largest))
            inside = near >= limit if towards > 0.0 else near <= limit
            found.append(float(near if inside else numpy.nextafter(near, scalar.dtype(towards))))
    return found[0], found[1]
