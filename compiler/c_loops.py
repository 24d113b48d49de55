"""C99 text of the loops of a program."""

import re
import struct
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy

from .c_text import WIDTH, Scalar, array_text, comment, expression, literal
from .program import StraightLineProgram
from .rolling import CONSTANTS, SCRATCH, TURN, Loop, Operand, common_difference

MOST = 4
"""Maximal number of functions named in the comment before a loop."""
SAVED = 40
"""Number of bytes of tables that a second loop must save, and again for each start of a run."""


class Rows(NamedTuple):
    """C pointer to an argument's array, and the offsets of its rows."""

    array: str
    """C expression of a pointer to numbers."""
    places: Mapping[int, int] | Sequence[int]
    """Offset of every row from the pointer."""


class Arrays(NamedTuple):
    """Pointers and row offsets of all arguments, read and written."""

    read: Mapping[int, Rows]
    written: Mapping[int, Rows]


class Loops:
    """Writer of a program's loops as C text.

    Args:
        name: prefix of the names of tables.
        read: function from argument and row to the C expression of an input.
        write: function from argument and row to the C expression of a destination.
        tables: names of the tables of ``take`` by their index in the constants.
    """

    def __init__(
        self,
        program: StraightLineProgram,
        name: str,
        read: Callable[[int, int], str],
        write: Callable[[int, int], str],
        arrays: Arrays,
        scalar: Scalar,
        tables: Mapping[int, str],
        qualifier: str,
    ) -> None:
        self.program = program
        self.name = name
        self.read = read
        self.write = write
        self.arrays = arrays
        self.scalar = scalar
        self.tables = tables
        self.qualifier = qualifier
        self.defined: list[str] = []
        self._last_words = ""
        self._found: dict[tuple[Any, ...], str] = {}
        self._columns, self._runs = 1, [0]
        self._starts: dict[tuple[int, ...], str] = {}

    def loop(self, loop: Loop) -> list[str]:
        """Return the C lines of a loop; a comment names the functions of its operations if they are new."""
        first, *rest = self._lines(loop)
        callers = dict.fromkeys(self.program.callers.get(statement.origin, "") for statement in loop.body)
        names = [caller for caller in callers if caller]
        others = [f"and {len(names) - MOST} others"] * (len(names) > MOST)
        words = "; ".join([*names[:MOST], *others])
        if words and words != self._last_words:
            self._last_words = words
            first = f"{comment(words, indent='    ').lstrip()}\n    {first}"
        return [first, *rest]

    def _lines(self, loop: Loop) -> list[str]:
        self._choose_form(loop)
        lines = []
        for number, operation, operands, logical, table, kept, _ in loop.body:
            values = [self._value(operand) for operand in operands]
            known = [operand.array == CONSTANTS for operand in operands]
            taken = (self.tables[table[0]], table[1]) if operation == "take" else None
            text = expression(operation, values, known, self.scalar, taken)
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
        uses_k = any(re.search(r"\bk\b", line) for line in lines)
        if len(self._runs) > 1:
            return self._in_runs(lines, loop.turns, uses_k)
        head = [f"for (int k = 0; k < {loop.turns}; ++k) {{"]
        if self._columns > 1:
            first, on = (", k = 0", ", ++k") if uses_k else ("", "")
            head = [
                f"for (int i = 0{first}; i < {loop.turns // self._columns}; ++i)",
                f"for (int j = 0; j < {self._columns}; ++j{on}) {{",
            ]
        return [*head, *(f"    {line}" for line in lines), "}"]

    def _in_runs(self, lines: list[str], turns: int, uses_k: bool) -> list[str]:
        lengths = [end - start for start, end in pairwise([*self._runs, turns])]
        begin, on = [], ["--n", *["++k"] * uses_k]
        for places, name in self._starts.items():
            begin.append(f"    int {name} = {self._entry([places[start] for start in self._runs])};")
            steps = self._entry(_steps(places, self._runs, turns))
            if steps != "0":
                on.append(f"++{name}" if steps == "1" else f"{name} += {steps}")
        return [
            f"for (int i = 0{', k = 0' * uses_k}; i < {len(self._runs)}; ++i) {{",
            *begin,
            f"    for (int n = {self._entry(lengths)}; n > 0; {', '.join(on)}) {{",
            *(f"        {line}" for line in lines),
            "    }",
            "}",
        ]

    def _entry(self, numbers: Sequence[int]) -> str:
        if common_difference(numbers) is None:
            return f"{self._table(tuple(numbers))}[i]"
        least, text = self._term(numbers, "i")
        return " + ".join([str(least)] * (least != 0 or not text) + [text] * (text != ""))

    def _choose_form(self, loop: Loop) -> None:
        self._columns, self._runs, self._starts = 1, [0], {}
        irregular = set()
        for statement in loop.body:
            for operands, rows in (
                (statement.operands, self.arrays.read),
                (statement.kept, self.arrays.written),
            ):
                for operand in operands:
                    if operand.array not in (TURN, CONSTANTS):
                        places = self._own_places(operand, rows)
                        if common_difference(places) is None:
                            irregular.add(_distances(places))
        if not irregular:
            return

        def size(columns: int) -> int:
            parts = [part for places in irregular for part in _grid(places, columns) or [places]]
            return sum(map(_bytes, parts))

        divisors = [n for n in range(2, loop.turns // 2 + 1) if loop.turns % n == 0]
        columns = min(divisors, key=size, default=1)
        runs = _runs(irregular, loop.turns)
        of_runs = _bytes([end - start for start, end in pairwise([*runs, loop.turns])])
        for places in irregular:
            of_runs += _bytes([places[start] for start in runs])
            of_runs += _bytes(_steps(places, runs, loop.turns)) + SAVED
        best = size(1)
        if columns > 1 and size(columns) + SAVED < best:
            self._columns, best = columns, size(columns)
        if of_runs + SAVED < best:
            self._columns, self._runs = 1, runs

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
        array, places = operand.array, operand.places
        if array != SCRATCH and len(set(places)) == 1:
            return single(array, places[0])
        pointer = "w" if array == SCRATCH else rows[array].array
        return f"{pointer}[{self._index(self._own_places(operand, rows))}]"

    def _own_places(self, operand: Operand, rows: Mapping[int, Rows]) -> tuple[int, ...]:
        if operand.array == SCRATCH:
            return operand.places
        of_row = rows[operand.array].places
        return tuple(of_row[row] for row in operand.places)

    def _index(self, places: tuple[int, ...]) -> str:
        if len(self._runs) > 1 and common_difference(places) is None:
            name = self._starts.setdefault(_distances(places), f"r{len(self._starts)}")
            return f"{min(places)} + {name}" if min(places) else name
        grid = _grid(places, self._columns) if common_difference(places) is None else None
        parts = zip(grid, "ij", strict=True) if grid else [(places, "k")]
        terms = [self._term(part, letter) for part, letter in parts]
        first = sum(least for least, _ in terms)
        return " + ".join([str(first)] * (first != 0) + [text for _, text in terms if text]) or "0"

    def _term(self, places: Sequence[int], letter: str) -> tuple[int, str]:
        """Return the smallest offset, and the C expression of the others' distance from it by the loop variable."""
        step, least = common_difference(places), min(places)
        if step is None:
            return least, f"{self._table(_distances(places))}[{letter}]"
        if step < 0:
            letter = f"({len(places) - 1} - {letter})"
        return least, "" if step == 0 else letter if abs(step) == 1 else f"{abs(step)} * {letter}"

    def _table(self, values: tuple[Any, ...]) -> str:
        key = (type(values[0]), *(struct.pack("d", value) for value in values))
        if key not in self._found:
            name = self._found[key] = (
                f"{self.name}_{'values' if key[0] is float else 'at'}_{len(self._found)}"
            )
            if key[0] is float:
                text = array_text(name, numpy.array(values), self.scalar, f"{self.qualifier}const")
            else:
                inside = textwrap.fill(", ".join(map(str, values)), WIDTH)
                text = f"{self.qualifier}const {_kind(values)} {name}[{len(values)}] = {{\n{inside}\n}};\n"
            self.defined.append(text)
        return self._found[key]


def _grid(places: Sequence[int], columns: int) -> list[tuple[int, ...]] | None:
    """Return row and column offsets that sum to the given offsets, row by row; None if there are none."""
    if columns == 1:
        return None
    rows, row = tuple(places[::columns]), tuple(place - places[0] for place in places[:columns])
    alike = all(place == rows[k // columns] + row[k % columns] for k, place in enumerate(places))
    return [rows, row] if alike else None


def _distances(places: Sequence[int]) -> tuple[int, ...]:
    least = min(places)
    return tuple([place - least for place in places])


def _kind(numbers: Sequence[int]) -> str:
    for size, kind in ((8, "char"), (16, "short")):
        if min(numbers) >= 0 and max(numbers) < 2**size:
            return f"unsigned {kind}"
        if min(numbers) >= -(2 ** (size - 1)) and max(numbers) < 2 ** (size - 1):
            return f"signed {kind}"
    return "int"


def _bytes(numbers: Sequence[int]) -> int:
    if common_difference(numbers) is not None:
        return 0
    return len(numbers) * {"char": 1, "short": 2}.get(_kind(numbers).split()[-1], 4)


def _runs(tables: Collection[tuple[int, ...]], turns: int) -> list[int]:
    """Return the starts of runs of loop turns in which the entries of every table have constant distances."""
    apart = numpy.diff(numpy.array(list(tables)), axis=1)
    bends = (apart[:, 1:] != apart[:, :-1]).any(axis=0).tolist()
    starts = [0]
    for member in range(2, turns):
        # Two members always have a constant distance.
        if bends[member - 2] and member - starts[-1] >= 2:
            starts.append(member)
    return starts


def _steps(places: Sequence[int], runs: Sequence[int], turns: int) -> list[int]:
    """Return the distance between entries in every run; a run of one entry takes that of the previous run."""
    steps: list[int] = []
    for start, end in pairwise([*runs, turns]):
        alone = steps[-1] if steps else 1
        steps.append(places[start + 1] - places[start] if end - start > 1 else alone)
    return steps
