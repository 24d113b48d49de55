"""A program as text of C99, of one lane in double or float; the same statements are the body of a kernel of CUDA.

Every step is one statement, or, in a loop, every array operation (:mod:`.rolling`); numbers that cross from one static
function or loop to the next lie in a scratch array ``w``.
Comparisons with what is no number, and what ``maximum``, ``minimum``, ``sign``, ``remainder`` and ``take`` make of it,
are those of the code of :mod:`.emission`; of the two zeros a ``maximum`` may return either.

No name and no sentence gets into the text but through :func:`identifier` and :func:`comment`.
"""

import math
import re
import struct
import textwrap
import unicodedata
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy

from .interpretation import first_steps
from .parts import FREE, Statement, cut_parts, scratch_slots
from .program import Program
from .rolling import CONSTANTS, SCRATCH, TURN, Loop, Operand, roll_where_shorter, steady

PART = 200
"""Statements of a function."""
ROWS = 32
"""Entries of tables that a second loop must save."""
WIDTH = 100
"""Characters of a line of a comment."""
_INFIX = {
    "add": "+",
    "subtract": "-",
    "multiply": "*",
    "divide": "/",
    "logical_and": "&&",
    "logical_or": "||",
}
_INFIX |= {
    "less": "<",
    "less_equal": "<=",
    "greater": ">",
    "greater_equal": ">=",
    "equal": "==",
    "not_equal": "!=",
}
_RESERVED = frozenset(
    re.findall(
        r"\w+",
        "auto break case char const continue default do double else enum extern float for goto if inline int long "
        "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
        "asm typeof bool true false class new delete this private public template namespace operator main "
        "NAN INFINITY FLT_MAX FLT_MIN DBL_MAX sign_of remainder_of place_of",
    )
)
"""Words that mean something to C, to its neighbours, or to the text made here."""


@dataclass(frozen=True)
class Scalar:
    """A kind of number in C."""

    name: str
    suffix: str
    """Of its functions and literals."""
    dtype: type
    largest: str
    """Macro of ``float.h``."""
    smallest: str


DOUBLE = Scalar("double", "", numpy.float64, "DBL_MAX", "DBL_MIN")
FLOAT = Scalar("float", "f", numpy.float32, "FLT_MAX", "FLT_MIN")


class Parameter(NamedTuple):
    """A parameter of a function."""

    type: str
    """Whatever stands before the name."""
    name: str


class Source(NamedTuple):
    """A program as text."""

    functions: str
    """Tables and static functions that stand before."""
    body: list[str]
    """Statements of the function itself."""
    operations: int
    """Steps that compute something."""
    scratch: int
    """Numbers in the scratch array."""
    replaced: tuple[float, ...]
    """Constants beyond the range of the kind of number, in whose place its nearest ones stand."""


def identifier(words: str, taken: Collection[str] = ()) -> str:
    """Return a name of C for some words: letters, digits and single underscores, and none that means something already.

    Args:
        words: anything.
        taken: names that it must not be.
    """
    plain = unicodedata.normalize("NFKD", words).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[:60] or "x"
    if not name[0].isalpha():
        name = f"n{name}"
    # Temporaries are called v and r with a number, the scratch array w.
    if name in _RESERVED or re.fullmatch(r"[vrw]\d*", name):
        name += "_"
    unique, number = name, 2
    while unique in taken:
        unique, number = f"{name}_{number}", number + 1
    return unique


def plain_words(text: str) -> str:
    """Return text that is safe within a comment of C: printable ASCII in one line that neither ends nor begins one."""
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "replace").decode()
    line = " ".join("".join(c if c.isprintable() else " " for c in ascii_text).split()).replace("\\", "|")
    # No end, no beginning, and no trigraph.
    return re.sub(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)", " ", line)


def comment(*paragraphs: str, indent: str = "") -> str:
    """Return a comment of C, a paragraph for each text; one that begins with blanks keeps them.

    Args:
        *paragraphs: of anything.
        indent: blanks before every line.
    """
    lines: list[str] = []
    for text in paragraphs:
        before = " " * (len(text) - len(text.lstrip(" ")))
        wide = WIDTH - len(indent)
        lines += textwrap.wrap(
            plain_words(text), wide, initial_indent=before, subsequent_indent=before, break_on_hyphens=False
        ) or [""]
    return f"{indent}/* " + "\n".join(f"{indent}   {line}".rstrip() for line in lines).lstrip() + " */"


def literal(value: float, scalar: Scalar = DOUBLE) -> str:
    """Return a number as C reads it again to the last bit, of ``float`` its nearest one.

    What is beyond the range of ``float`` is the largest or the smallest normal number that it has.
    """
    if value != value:
        return f"({scalar.name})NAN"  # of C they are float
    if math.isinf(value):
        return f"({'-' * (value < 0.0)}({scalar.name})INFINITY)"
    if is_beyond(value, scalar):
        text = scalar.largest if abs(value) > 1.0 else scalar.smallest
    else:
        text = f"{scalar.dtype(abs(value))!s}{scalar.suffix}"
    return text if math.copysign(1.0, value) > 0.0 else f"(-{text})"


def is_beyond(value: float, scalar: Scalar) -> bool:
    """Whether a finite number is beyond the range of normal numbers of ``float``; of ``double`` none is."""
    limits = numpy.finfo(scalar.dtype)
    size = abs(value)
    return scalar.dtype is not numpy.float64 and (
        bool(size > float(limits.max)) or 0.0 < size < float(limits.tiny)
    )


def array_text(
    name: str, values: numpy.ndarray, scalar: Scalar = DOUBLE, qualifier: str = "static const"
) -> str:
    """Return the definition of a constant array; rows of a matrix stand in lines."""

    def braces(part: numpy.ndarray) -> str:
        if part.ndim == 1:
            inside = textwrap.fill(", ".join(literal(float(v), scalar) for v in part), WIDTH)
        else:
            inside = ",\n".join(braces(row) for row in part)
        return "{\n" + inside + "\n}"

    shape = "".join(f"[{size}]" for size in values.shape)
    return f"{qualifier} {scalar.name} {name}{shape} = {braces(values)};\n"


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


def helper_functions(programs: Sequence[Program], scalar: Scalar = DOUBLE, qualifier: str = "static ") -> str:
    """Return the functions that statements of these programs call beside those of ``math.h``."""
    used = {step.operation for program in programs for step in program.steps}
    words = {
        "real": scalar.name,
        "f": scalar.suffix,
        "zero": literal(0.0, scalar),
        "one": literal(1.0, scalar),
    }
    return "\n".join(qualifier + text.format(**words) for name, text in _HELPERS.items() if name in used)


class _Text:
    """Statements of a program; values are named by the steps that they come from."""

    def __init__(
        self, program: Program, read: Callable[[int, int], str], scalar: Scalar, tables: Mapping[int, str]
    ) -> None:
        self.program, self.read, self.scalar, self.tables = program, read, scalar, tables

    def literal(self, value: float) -> str:
        return literal(value, self.scalar)

    def value(self, step: int) -> str:
        """Return an expression for a step's value where it is used."""
        operation, arguments, logical = self.program.steps[step]
        if operation == "input":
            return self.read(*arguments)
        if operation == "constant":
            value = float(self.program.constants[arguments[0]])
            return str(int(value != 0.0)) if logical else self.literal(value)
        return f"v{step}"

    def as_number(self, step: int) -> str:
        """Return an expression for a step's value that is a number, one for true and zero for false."""
        value = self.value(step)
        if not self.program.steps[step].logical:
            return value
        return f"({value} ? {self.literal(1.0)} : {self.literal(0.0)})"

    def declaration(self, step: int, expression: str) -> str:
        kind = "int" if self.program.steps[step].logical else self.scalar.name
        return f"const {kind} v{step} = {expression};"

    def expression(self, index: int) -> str:
        """Return what computes a step."""
        operation, arguments, _ = self.program.steps[index]
        parts = self.program.steps[index].parts
        known = [self.program.steps[part].operation == "constant" for part in parts]
        table = (self.tables[arguments[0]], arguments[1]) if operation == "take" else None
        return _expression(operation, [self.value(part) for part in parts], known, self.scalar, table)


def _expression(
    operation: str,
    values: Sequence[str],
    known: Sequence[bool],
    scalar: Scalar,
    table: tuple[str, int] | None = None,
) -> str:
    """Return what computes an operation.

    Args:
        operation: of a step.
        values: its arguments.
        known: which of them are constants.
        scalar: kind of numbers.
        table: of ``take``, its name and its length.
    """
    if table is not None:
        return f"{table[0]}[place_of({values[0]}, {table[1]})]"
    if operation == "copy":
        return values[0]
    if operation in _INFIX:
        return f"{values[0]} {_INFIX[operation]} {values[1]}"
    if operation == "logical_not":
        return f"!{values[0]}"
    if operation == "negative":
        return f"-{values[0]}"
    if operation == "where":
        return f"{values[0]} ? {values[1]} : {values[2]}"
    if operation == "number":
        return f"{values[0]} ? {literal(1.0, scalar)} : {literal(0.0, scalar)}"
    if operation in ("maximum", "minimum"):
        return _extreme(values, known, ">" if operation == "maximum" else "<")
    name = {"absolute": "fabs", "sign": "sign_of", "remainder": "remainder_of"}.get(operation, operation)
    suffix = "" if name.endswith("_of") else scalar.suffix
    return f"{name}{suffix}({', '.join(values)})"


def _extreme(values: Sequence[str], known: Sequence[bool], sign: str) -> str:
    """The larger or smaller of two; what is no number stays that."""
    one, other = values if known[0] or not known[1] else values[::-1]
    # A constant is a number: see Graph.
    unordered = "" if any(known) else f" || {one} != {one}"
    return f"{one} {sign} {other}{unordered} ? {one} : {other}"


class Rows(NamedTuple):
    """Where the rows of an argument lie, for loops over them."""

    array: str
    """Expression of a pointer to numbers."""
    places: Mapping[int, int] | Sequence[int]
    """Place of every row behind it."""


class Arrays(NamedTuple):
    """Where the rows of all arguments lie."""

    read: Mapping[int, Rows]
    written: Mapping[int, Rows]


class _Loops:
    """Loops of a program as text.

    Args:
        program: that was rolled up.
        name: that tables begin with.
        read: expression of a row of an argument.
        write: where a row of an argument goes.
        arrays: where these rows lie.
        scalar: kind of numbers.
        tables: by where ``take`` finds them.
        qualifier: of tables.
    """

    def __init__(
        self,
        program: Program,
        name: str,
        read: Callable[[int, int], str],
        write: Callable[[int, int], str],
        arrays: Arrays,
        scalar: Scalar,
        tables: Mapping[int, str],
        qualifier: str,
    ) -> None:
        self.program, self.name, self.read, self.write, self.arrays = program, name, read, write, arrays
        self.scalar, self.tables, self.qualifier = scalar, tables, qualifier
        self.defined: list[str] = []
        self._found: dict[tuple[Any, ...], str] = {}
        self._columns = 1

    def loop(self, loop: Loop) -> list[str]:
        """Return the lines of a loop, or of two where rows and columns take shorter tables than all members."""
        self._columns = self._best_columns(loop)
        lines = []
        for number, operation, operands, logical, table, kept in loop.body:
            values = [self._value(operand) for operand in operands]
            known = [operand.array == CONSTANTS for operand in operands]
            taken = (self.tables[table[0]], table[1]) if operation == "take" else None
            text = _expression(operation, values, known, self.scalar, taken)
            if operation == "copy":
                own = self._number(text, logical)
            else:
                kind = "int" if logical else self.scalar.name
                lines.append(f"const {kind} v{number} = {text};")
                own = self._number(f"v{number}", logical)
            for to in kept:
                place = self._place(to, self.write, self.arrays.written)
                if place:
                    lines.append(f"{place} = {own};")
        if loop.turns == 1:
            return lines
        head = [f"for (int k = 0; k < {loop.turns}; ++k) {{"]
        if self._columns > 1:
            head = [
                f"for (int i = 0, k = 0; i < {loop.turns // self._columns}; ++i)",
                f"for (int j = 0; j < {self._columns}; ++j, ++k) {{",
            ]
            if not any(re.search(r"\bk\b", line) for line in lines):
                head = [line.replace(", k = 0", "").replace(", ++k", "") for line in head]
        return [*head, *(f"    {line}" for line in lines), "}"]

    def _best_columns(self, loop: Loop) -> int:
        """Members of a row with which the tables of a loop are shortest; 1: no rows."""
        tables = set()
        for statement in loop.body:
            for operands, rows in (
                (statement.operands, self.arrays.read),
                (statement.kept, self.arrays.written),
            ):
                for operand in operands:
                    if operand.array not in (TURN, CONSTANTS):
                        tables.add(self._own_places(operand, rows))
        open_tables = [places for places in tables if steady(places) is None]
        whole = sum(map(len, open_tables))

        def cost(columns: int) -> int:
            entries = 0
            for places in open_tables:
                for part in _grid(places, columns) or [places]:
                    entries += len(part) if steady(part) is None else 0
            return entries

        divisors = [n for n in range(2, loop.turns // 2 + 1) if loop.turns % n == 0] if open_tables else []
        best = min(divisors, key=cost, default=1)
        return best if best > 1 and cost(best) + ROWS < whole else 1

    def _number(self, value: str, logical: bool) -> str:
        one, zero = literal(1.0, self.scalar), literal(0.0, self.scalar)
        return f"{value} ? {one} : {zero}" if logical else value

    def _value(self, operand: Operand) -> str:
        if operand.array == TURN:
            return f"v{operand.places[0]}"
        if operand.array == CONSTANTS:
            numbers = tuple(float(self.program.constants[place]) for place in operand.places)
            if len({struct.pack("d", number) for number in numbers}) == 1:
                text = literal(numbers[0], self.scalar)
                return str(int(numbers[0] != 0.0)) if operand.logical else text
            text = f"{self._table(numbers)}[k]"
        else:
            text = self._place(operand, self.read, self.arrays.read)
        return f"({text} != {literal(0.0, self.scalar)})" if operand.logical else text

    def _place(self, operand: Operand, single: Callable[[int, int], str], rows: Mapping[int, Rows]) -> str:
        """Expression of a member of an array, in a turn of the loop."""
        array, places = operand.array, operand.places
        if array != SCRATCH and len(set(places)) == 1:
            return single(array, places[0])
        pointer = "w" if array == SCRATCH else rows[array].array
        return f"{pointer}[{self._index(self._own_places(operand, rows))}]"

    def _own_places(self, operand: Operand, rows: Mapping[int, Rows]) -> tuple[int, ...]:
        """Places of the members behind the pointer to their array."""
        if operand.array == SCRATCH:
            return operand.places
        of_row = rows[operand.array].places
        return tuple(of_row[row] for row in operand.places)

    def _index(self, places: tuple[int, ...]) -> str:
        """Expression of the place of member ``k``, which is the one in row ``i`` and column ``j``."""
        grid = _grid(places, self._columns) if steady(places) is None else None
        parts = zip(grid, "ij", strict=True) if grid else [(places, "k")]
        terms = [self._term(part, letter) for part, letter in parts]
        first = sum(least for least, _ in terms)
        return " + ".join([str(first)] * (first != 0) + [text for _, text in terms if text]) or "0"

    def _term(self, places: Sequence[int], letter: str) -> tuple[int, str]:
        """The least of some places, and an expression of how far the others are from it."""
        step, least = steady(places), min(places)
        if step is None:
            return least, f"{self._table(tuple(place - least for place in places))}[{letter}]"
        if step < 0:
            letter = f"({len(places) - 1} - {letter})"
        return least, "" if step == 0 else letter if abs(step) == 1 else f"{abs(step)} * {letter}"

    def _table(self, values: tuple[Any, ...]) -> str:
        """Name of a constant array: of numbers, or of distances."""
        key = (type(values[0]), *(struct.pack("d", value) for value in values))
        if key not in self._found:
            name = self._found[key] = (
                f"{self.name}_{'values' if key[0] is float else 'at'}_{len(self._found)}"
            )
            if key[0] is float:
                text = array_text(name, numpy.array(values), self.scalar, f"{self.qualifier}const")
            else:
                kind = "char" if max(values) < 256 else "short" if max(values) < 65536 else "int"
                inside = textwrap.fill(", ".join(map(str, values)), WIDTH)
                text = f"{self.qualifier}const unsigned {kind} {name}[{len(values)}] = {{\n{inside}\n}};\n"
            self.defined.append(text)
        return self._found[key]


def _grid(places: Sequence[int], columns: int) -> list[tuple[int, ...]] | None:
    """Places of rows and of columns whose sums all places are, row by row; None where there are none."""
    if columns == 1:
        return None
    rows, row = tuple(places[::columns]), tuple(place - places[0] for place in places[:columns])
    alike = all(place == rows[k // columns] + row[k % columns] for k, place in enumerate(places))
    return [rows, row] if alike else None


def write_program(
    program: Program,
    name: str,
    parameters: Sequence[Parameter],
    read: Callable[[int, int], str],
    write: Callable[[int, int], str],
    scalar: Scalar = DOUBLE,
    qualifier: str = "static ",
    between: Sequence[str] = (),
    results: int = 0,
    arrays: Arrays | None = None,
) -> Source:
    """Write a program as statements, in loops where that is shorter.

    A result is written as soon as it is computed: what is written must not be what is read.

    Args:
        program: to write.
        name: of the function that the statements are for, which those before it begin with.
        parameters: of that function; static functions are handed all of them.
        read: from argument and row to the expression of an input.
        write: from argument and row to where a result goes; ``""``: nowhere.
        scalar: kind of numbers.
        qualifier: of static functions.
        between: statements that stand where the first results are known, before any other input is read.
        results: how many these are.
        arrays: where the rows of all arguments lie, for loops; default: no loops.
    """
    if any(step.operation == "product" for step in program.steps):
        raise ValueError("a product that is a loop has no form in C: trace it with Graph(loops=False)")
    starts = sorted({step.arguments[:2] for step in program.steps if step.operation == "take"})
    tables = {start: f"{name}_table_{i}" for i, (start, _) in enumerate(starts)}
    count_operations = sum(step.operation not in FREE for step in program.steps)
    defined = [
        array_text(tables[start], program.constants[start : start + length], scalar, f"{qualifier}const")
        for start, length in starts
    ]
    rolled = None if arrays is None else roll_where_shorter(program, results if between else 0)
    if arrays is not None and rolled is not None:
        loops = _Loops(program, name, read, write, arrays, scalar, tables, qualifier)
        blocks, before = _packed([loops.loop(loop) for loop in rolled.loops], rolled.before)
        defined += loops.defined
        count, together = rolled.scratch, len(blocks) == 1
    else:
        together = count_operations <= PART
        text = _Text(program, read, scalar, tables)
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
        defined += [_function(f"{name}_part_{i}", listed, block, qualifier) for i, block in enumerate(blocks)]
        names = ", ".join(parameter.name for parameter in listed)
        lines = [[f"{name}_part_{i}({names});"] for i in range(len(blocks))]
    body = [line for block in lines[:before] for line in block]
    body += [*between, *(line for block in lines[before:] for line in block)]
    if count or not together:
        body.insert(0, f"{scalar.name} w[{max(count, 1)}];")
    constants = [
        float(program.constants[step.arguments[0]])
        for step in program.steps
        if step.operation == "constant" and not step.logical
    ]
    replaced = tuple(sorted({value for value in constants if is_beyond(value, scalar)}))
    return Source("\n".join(defined), body, count_operations, count, replaced)


def _packed(blocks: Sequence[list[str]], pause: int) -> tuple[list[list[str]], int]:
    """Blocks put together as long as a function is not too long, and how many of them are before a pause."""
    packed: list[list[str]] = []
    before = 0
    for i, block in enumerate(blocks):
        if not packed or i == pause or len(packed[-1]) + len(block) > PART:
            packed.append([])
        packed[-1] += block
        before = len(packed) if i < pause else before
    return packed or [[]], before


def _statements(
    text: _Text,
    part: Sequence[Statement],
    own: Set[Statement],
    write: Callable[[int, int], str],
    slots: Mapping[int, int],
) -> list[str]:
    """Statements of a part."""
    lines: list[str] = []
    fetched: set[int] = set()
    steps = text.program.steps
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


def function_text(returns: str, name: str, parameters: Sequence[Parameter], body: Sequence[str]) -> str:
    """Return the definition of a function; parameters that it does not use are marked as such."""
    listed = ", ".join(_declare(parameter) for parameter in parameters)
    words = set(re.findall(r"\w+", "\n".join(body)))
    unused = [f"(void){parameter.name};" for parameter in parameters if parameter.name not in words]
    inside = "\n".join(f"    {line}" for line in [*unused, *body])
    return f"{returns} {name}({listed or 'void'}) {{\n{inside}\n}}\n"


def _declare(parameter: Parameter) -> str:
    blank = "" if parameter.type.endswith("*") else " "
    return f"{parameter.type}{blank}{parameter.name}"


def write_lanes(program: Program, name: str, lane_first: Sequence[bool], cuda: bool = False) -> str:
    """Write a program as a function that goes through lanes, in double; of CUDA as a kernel, a thread for each lane.

    The function takes ``a``, the arrays one after another, ``stride``, numbers from one row of each to the next, and
    the lanes ``first`` to ``last``; the kernel ``a``, ``stride`` and the number of lanes.

    Args:
        program: to write.
        name: of the function.
        lane_first: of every argument whether it is written lane by lane, ``(N, rows)``, instead of ``(rows, N)``.
        cuda: as CUDA in place of C.
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
