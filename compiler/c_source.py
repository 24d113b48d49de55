"""C99 text of a program for one lane, in double or float; the statements also form a CUDA kernel.

Every step is one statement, or, in a loop, every array operation (:mod:`.rolling`). Numbers that pass from one static
function or loop to the next are stored in a scratch array ``w``. Results for NaN are those of :mod:`.emission`; of the
two zeros a ``maximum`` may return either.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from typing import NamedTuple

import numpy

from .c_loops import Arrays, Loops
from .c_text import (
    DOUBLE,
    Parameter,
    Scalar,
    array_text,
    expression,
    function_text,
    is_beyond,
    literal,
)
from .interpretation import first_steps
from .parts import FREE, Statement, cut_parts, scratch_slots
from .program import StraightLineProgram
from .rolling import roll_where_shorter

PART = 200
"""Maximal number of statements of a function."""
INLINED = 8_000
"""Number of operations above which CUDA's compiler must not inline the functions of a program. Inlined, 23,000
operations compile in more than three minutes in place of half a minute, and 9,500 run a quarter slower; 2,700 run
twice as fast.
"""


class ProgramSource(NamedTuple):
    """C text of a program: static functions, statements, and what they need."""

    functions: str
    """Tables and static functions, to be placed before the function."""
    body: list[str]
    """Statements of the function."""
    operations: int
    """Number of computed steps."""
    scratch: int
    """Length of the scratch array."""
    replaced: tuple[float, ...]
    """Constants beyond the range of the floating-point type, which were replaced by the nearest ones."""


_HELPERS = {
    "sign": """{real} sign_of({real} x) {{ /* of what is no number: itself */
    return x > {zero} ? {one} : x < {zero} ? -{one} : x + {zero};
}}
""",
    "remainder": """{real} remainder_of({real} a, {real} b) {{ /* with the sign of b */
    const {real} rest = fmod{f}(a, b);
    return rest != {zero} && (rest < {zero}) != (b < {zero}) ? rest + b : rest;
}}
""",
    "take": """int place_of({real} index, int length) {{ /* in a table; from the end where negative */
    if (index < {zero}) index += ({real})length;
    if (!(index > {zero})) return 0;
    return index < ({real})(length - 1) ? (int)index : length - 1;
}}
""",
}


def helper_functions(
    programs: Sequence[StraightLineProgram], scalar: Scalar = DOUBLE, qualifier: str = "static "
) -> str:
    """Return the C text of the helper functions that the statements of some programs call, beyond ``math.h``."""
    used = {name for program in programs for name in program.steps.operations}
    words = {
        "real": scalar.name,
        "f": scalar.suffix,
        "zero": literal(0.0, scalar),
        "one": literal(1.0, scalar),
    }
    return "\n".join(qualifier + text.format(**words) for name, text in _HELPERS.items() if name in used)


class _ProgramText:
    def __init__(
        self,
        program: StraightLineProgram,
        read: Callable[[int, int], str],
        scalar: Scalar,
        tables: Mapping[int, str],
    ) -> None:
        self.program, self.read, self.scalar, self.tables = program, read, scalar, tables
        self.steps = program.steps.all()

    def literal(self, value: float) -> str:
        return literal(value, self.scalar)

    def value(self, step: int) -> str:
        operation, arguments, logical = self.steps[step]
        if operation == "input":
            return self.read(*arguments)
        if operation == "constant":
            value = float(self.program.constants[arguments[0]])
            return str(int(value != 0.0)) if logical else self.literal(value)
        return f"v{step}"

    def as_number(self, step: int) -> str:
        """Return the C expression of a value as a number: one for true, zero for false."""
        value = self.value(step)
        if not self.steps[step].logical:
            return value
        return f"({value} ? {self.literal(1.0)} : {self.literal(0.0)})"

    def declaration(self, step: int, expression: str) -> str:
        kind = "int" if self.steps[step].logical else self.scalar.name
        return f"const {kind} v{step} = {expression};"

    def expression(self, index: int) -> str:
        operation, arguments, _ = self.steps[index]
        parts = self.steps[index].parts
        known = [self.steps[part].operation == "constant" for part in parts]
        table = (self.tables[arguments[0]], arguments[1]) if operation == "take" else None
        return expression(operation, [self.value(part) for part in parts], known, self.scalar, table)


def write_program(
    program: StraightLineProgram,
    name: str,
    parameters: Sequence[Parameter],
    read: Callable[[int, int], str],
    write: Callable[[int, int], str],
    scalar: Scalar = DOUBLE,
    qualifier: str = "static ",
    between: Sequence[str] = (),
    results: int = 0,
    arrays: Arrays | None = None,
) -> ProgramSource:
    """Return the C text of a program for one lane, with loops where they make the text shorter.

    A result is written as soon as it is computed, so results must not overwrite inputs. ``read`` and ``write`` are
    functions from argument and row to a C expression; no result is written to ``""``. ``name`` is that of the
    function, and prefix of the static functions that it calls. ``between`` are statements after the first ``results``
    results, before any other input is read. Without ``arrays``, the pointers and offsets of all arguments, there are
    no loops.
    """
    if "product" in program.steps.operations:
        raise ValueError("a product that is a loop cannot be written in C: trace it with Graph(loops=False)")
    starts = sorted({step.arguments[:2] for step in program.steps.named("take")})
    tables = {start: f"{name}_table_{i}" for i, (start, _) in enumerate(starts)}
    count_operations = int(numpy.count_nonzero(~program.steps.which(*FREE)))
    defined = [
        array_text(tables[start], program.constants[start : start + length], scalar, f"{qualifier}const")
        for start, length in starts
    ]
    rolled = None if arrays is None else roll_where_shorter(program, results if between else 0)
    if arrays is not None and rolled is not None:
        loops = Loops(program, name, read, write, arrays, scalar, tables, qualifier)
        blocks, before = _merge_blocks([loops.loop(loop) for loop in rolled.loops], rolled.before)
        defined += loops.defined
        count, together = rolled.scratch, len(blocks) == 1
    else:
        together = count_operations <= PART
        text = _ProgramText(program, read, scalar, tables)
        parts, before = cut_parts(program, PART, first_steps(program, results) if between else 0)
        slots = {} if together else scratch_slots(program, parts)
        everything: set[Statement] = set(range(len(program.steps)))
        blocks = [
            _statements(text, part, everything if together else set(part), write, slots) for part in parts
        ]
        count = max(slots.values(), default=-1) + 1
    lines = blocks
    if not together:
        listed = [*parameters, Parameter(f"{scalar.name} *", "w")]
        apart = "__device__" in qualifier and count_operations > INLINED
        own = f"{qualifier}__noinline__ " if apart else qualifier
        defined += [_function(f"{name}_part_{i}", listed, block, own) for i, block in enumerate(blocks)]
        names = ", ".join(parameter.name for parameter in listed)
        lines = [[f"{name}_part_{i}({names});"] for i in range(len(blocks))]
    body = [line for block in lines[:before] for line in block]
    body += [*between, *(line for block in lines[before:] for line in block)]
    if count or not together:
        body.insert(0, f"{scalar.name} w[{max(count, 1)}];")
    constants = [
        float(program.constants[step.arguments[0]])
        for step in program.steps.named("constant")
        if not step.logical
    ]
    replaced = tuple(sorted({value for value in constants if is_beyond(value, scalar)}))
    return ProgramSource("\n".join(defined), body, count_operations, count, replaced)


def _merge_blocks(blocks: Sequence[list[str]], pause: int) -> tuple[list[list[str]], int]:
    packed: list[list[str]] = []
    before = 0
    for i, block in enumerate(blocks):
        if not packed or i == pause or len(packed[-1]) + len(block) > PART:
            packed.append([])
        packed[-1] += block
        before = len(packed) if i < pause else before
    return packed or [[]], before


def _statements(
    text: _ProgramText,
    part: Sequence[Statement],
    own: Set[Statement],
    write: Callable[[int, int], str],
    slots: Mapping[int, int],
) -> list[str]:
    lines: list[str] = []
    fetched: set[int] = set()
    steps = text.steps
    for statement in part:
        used = steps[statement].parts if isinstance(statement, int) else (statement.node,)
        for step in used:
            if step not in own and steps[step].operation not in FREE and step not in fetched:
                fetched.add(step)
                truth = f" != {text.literal(0.0)}" if steps[step].logical else ""
                lines.append(text.declaration(step, f"w[{slots[step]}]{truth}"))
        if not isinstance(statement, int):
            if place := write(statement.argument, statement.row):
                lines.append(f"{place} = {text.as_number(statement.node)};")
            continue
        lines.append(text.declaration(statement, text.expression(statement)))
        if statement in slots:
            lines.append(f"w[{slots[statement]}] = {text.as_number(statement)};")
    return lines


def _function(name: str, parameters: Sequence[Parameter], body: Sequence[str], qualifier: str) -> str:
    return function_text(f"{qualifier}void", name, parameters, body)


def write_lanes(
    program: StraightLineProgram, name: str, lane_first: Sequence[bool], cuda: bool = False
) -> str:
    """Return the C text of a function that runs a program over lanes, in double; or a CUDA kernel.

    The function takes ``a``, the addresses of the arrays, ``stride``, the distance from row to row of each, and the
    lanes ``first`` to ``last``; the kernel, which has a thread for each lane, takes ``a``, ``stride`` and the number
    of lanes. An argument that is ``lane_first`` has layout ``(N, rows)``, else ``(rows, N)``.
    """

    def place(argument: int, row: int) -> str:
        if lane_first[argument]:
            return f"a[{argument}][lane * stride[{argument}] + {row}]"
        return f"a[{argument}][{row} * stride[{argument}] + lane]"

    arrays = [Parameter("double *const *", "a"), Parameter("const long long *", "stride")]
    qualifier = "static __device__ " if cuda else "static "
    source = write_program(
        program, name, [*arrays, Parameter("long long", "lane")], place, place, qualifier=qualifier
    )
    before = [helper_functions([program], qualifier=qualifier), source.functions]
    if cuda:
        head = [
            "const long long lane = blockIdx.x * (long long)blockDim.x + threadIdx.x;",
            "if (lane >= lanes) return;",
        ]
        kernel = function_text(
            'extern "C" __global__ void',
            name,
            [*arrays, Parameter("long long", "lanes")],
            [*head, *source.body],
        )
        return "\n".join([_CUDA_HEAD, *before, kernel])
    loop = ["for (lane = first; lane < last; ++lane) {", *(f"    {line}" for line in source.body), "}"]
    bounds = [Parameter("long long", "first"), Parameter("long long", "last")]
    whole = function_text("void", name, [*arrays, *bounds], ["long long lane;", *loop])
    return "\n".join(["#include <math.h>\n", *before, whole])


_CUDA_HEAD = """#ifndef NAN
#define NAN __longlong_as_double(0x7ff8000000000000LL)
#define INFINITY __longlong_as_double(0x7ff0000000000000LL)
#endif
"""
