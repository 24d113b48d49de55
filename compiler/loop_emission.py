"""LLVM text of the loops of a program: one function for each loop.

The location of a member's number depends on the turn: its distance from the first is a multiple of the turn's number,
or an entry of a table.
"""

from collections.abc import Sequence

from .block import LaneBlock
from .instructions import HEADER, Instructions
from .rolling import CONSTANTS, SCRATCH, TURN, Loop, Operand, Statement, common_difference


class DistanceTables:
    """LLVM constant tables with the irregular distances between elements that loops access."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, ...], int] = {}

    def find(self, distances: tuple[int, ...]) -> tuple[str, str]:
        """Return the name of the table with these distances, made if new, and the LLVM type of its entries."""
        number = self._found.setdefault(distances, len(self._found))
        return f"@places{number}", _kind(distances)

    def text(self) -> list[str]:
        """Return the LLVM lines that define the tables."""
        return [
            f"@places{number} = internal constant [{len(distances)} x {kind}] ["
            + ", ".join([f"{kind} {distance}" for distance in distances])
            + "]"
            for distances, number in self._found.items()
            for kind in [_kind(distances)]
        ]


def _kind(distances: Sequence[int]) -> str:
    return "i8" if max(distances) < 2**8 else "i16" if max(distances) < 2**16 else "i32"


class LoopText(Instructions):
    """Writer of the LLVM text of one loop.

    Args:
        lane_first: for every argument whether its layout is lane by lane.
        tables: tables of all loops.
    """

    def __init__(
        self, loop: Loop, lane_first: Sequence[bool], block: LaneBlock, tables: DistanceTables
    ) -> None:
        super().__init__(lane_first, block, [])
        self.loop = loop
        self.tables = tables
        self._values: dict[Operand, str] = {}
        self._ways: dict[int | tuple[int, ...], str] = {}
        self._bases: dict[tuple[str, str], str] = {}
        for statement in loop.body:
            self._compute(statement)

    def text(self, number: int) -> list[str]:
        """Return the LLVM lines of the loop as the function ``@partN`` of this number."""
        lines = [f"define internal void @part{number}({HEADER}) {{", "entry:", *self.head]
        if self.loop.turns == 1:
            return [*lines, *self.lines, "ret void", "}"]
        return [
            *lines,
            "br label %turn",
            "turn:",
            "%k = phi i64 [0, %entry], [%next, %turn]",
            *self.lines,
            "%next = add i64 %k, 1",
            f"%more = icmp slt i64 %next, {self.loop.turns}",
            "br i1 %more, label %turn, label %done",
            "done:",
            "ret void",
            "}",
        ]

    def _compute(self, statement: Statement) -> None:
        values = [self._value(operand) for operand in statement.operands]
        name = f"%v{statement.number}"
        if statement.operation == "copy":
            name = values[0]
        elif statement.operation == "take":
            self.take(*statement.table, values[0], name)
        else:
            known = [operand.array == CONSTANTS for operand in statement.operands]
            self.operate(statement.operation, values, statement.logical, known, name)
        if not statement.kept:
            return
        number = self.as_number(name) if statement.logical else name
        for array, places, _ in statement.kept:
            if array == SCRATCH:
                self.lines.append(f"store {self.numbers} {number}, ptr {self._scratch(places)}")
            else:
                self.write(array, self._row(places), number)

    def _value(self, operand: Operand) -> str:
        array, places, logical = operand
        if array == TURN:
            return f"%v{places[0]}"
        if operand not in self._values:
            if array == SCRATCH:
                value = self.new(f"load {self.numbers}, ptr {self._scratch(places)}")
            elif array == CONSTANTS:
                value = self.constant(self._address("double", self.constants, places))
            else:
                value = self.read(array, self._row(places))
            self._values[operand] = self.as_truth(value) if logical else value
        return self._values[operand]

    def _scratch(self, places: tuple[int, ...]) -> str:
        return self._address(self.numbers, "%scratch", places)

    def _address(self, kind: str, array: str, places: tuple[int, ...]) -> str:
        first, way = self._way(places)
        if way is not None:
            if (array, way) not in self._bases:
                self._bases[array, way] = self.new(f"getelementptr {kind}, ptr {array}, i64 {way}")
            array = self._bases[array, way]
        return self.new(f"getelementptr {kind}, ptr {array}, i64 {first}")

    def _row(self, places: tuple[int, ...]) -> int | str:
        first, way = self._way(places)
        return first if way is None else way if first == 0 else self.new(f"add i64 {way}, {first}")

    def _way(self, places: tuple[int, ...]) -> tuple[int, str | None]:
        """Return an offset, and the LLVM name of a turn's distance from it; None: always zero."""
        step = common_difference(places)
        if step == 0:
            return places[0], None
        if step is not None:
            if step not in self._ways:
                self._ways[step] = "%k" if step == 1 else self.new(f"mul i64 %k, {step}")
            return places[0], self._ways[step]
        least = min(places)
        distances = tuple([place - least for place in places])
        if distances not in self._ways:
            table, kind = self.tables.find(distances)
            address = self.new(f"getelementptr {kind}, ptr {table}, i64 %k")
            entry = self.new(f"load {kind}, ptr {address}, !invariant.load !0")
            self._ways[distances] = self.new(f"zext {kind} {entry} to i64")
        return least, self._ways[distances]
