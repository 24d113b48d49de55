"""LLVM text of a program: vector code for blocks of lanes.

The entry ``@program(table, first, last)`` iterates over the blocks between two lanes and calls ``@part0``, ``@part1``,
... for each block. A long straight line is cut into parts, because LLVM's time grows faster than the length of a
function. Values that cross a cut are stored in a scratch array on the stack. ``table`` contains the address of the
constants, then two integers for each argument, address and stride. In a program with loops every loop is a part
(:mod:`.loop_emission`).
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from .block import LaneBlock
from .instructions import HEADER, INTRINSIC, Instructions
from .library import BINARY, Library
from .loop_emission import DistanceTables, LoopText
from .parts import cut_parts, product_places, scratch_slots
from .program import BAND, FUNCTIONS, OPERATIONS, StraightLineProgram
from .rolling import roll_where_shorter

LONG = 5000
"""Number of steps from which on loops take LLVM half the time of a straight line; below it the times are equal."""


class _Places(NamedTuple):
    slots: dict[int, int]
    """Index for each step that crosses a cut."""
    products: dict[int, int]
    """Index for the results of each product."""
    vector: int
    """Index for the vector of a product."""


class _Part(Instructions):
    """LLVM text of one part of a program; values are named by their steps."""

    def __init__(
        self, program: StraightLineProgram, lane_first: Sequence[bool], places: "_Places", block: LaneBlock
    ) -> None:
        super().__init__(lane_first, block)
        self.steps, self.places = program.steps.all(), places
        self.known: set[int] = set()

    def value(self, step: int) -> str:
        """Return the LLVM name of a step's value; inputs, constants and scratch values are loaded at first use."""
        operation, arguments, logical = self.steps[step]
        name = f"%v{step}"
        if step not in self.known:
            self.known.add(step)
            if operation == "input":
                self.read(arguments[0], arguments[1], name)
            elif operation == "constant":
                address = self.new(f"getelementptr double, ptr {self.constants}, i64 {arguments[0]}")
                if logical:
                    self.as_truth(self.constant(address), name)
                else:
                    self.constant(address, name)
            elif operation == "entry":
                row, product = arguments
                address = self.scratch(self.places.products[product] + row)
                self.new(f"load {self.numbers}, ptr {address}", name)
            else:
                kind = self.truths if logical else self.numbers
                self.new(f"load {kind}, ptr {self.scratch(self.places.slots[step])}", name)
        return name

    def step(self, index: int) -> None:
        step = self.steps[index]
        self.known.add(index)
        if step.operation == "product":
            self._product(index)
            return
        values = [self.value(part) for part in step.parts]
        if step.operation == "take":
            self.take(step.arguments[0], step.arguments[1], values[0], f"%v{index}")
            return
        known = [self.steps[part].operation == "constant" for part in step.parts]
        self.operate(step.operation, values, step.logical, known, f"%v{index}")

    def _product(self, index: int) -> None:
        table, rows, *vector = self.steps[index].arguments
        for place, step in enumerate(vector):
            value = self.value(step)
            address = self.scratch(self.places.vector + place)
            self.lines.append(f"store {self.numbers} {value}, ptr {address}")
        matrix = self.new(f"getelementptr double, ptr {self.constants}, i64 {table}")
        given, found = self.scratch(self.places.vector), self.scratch(self.places.products[index])
        sizes = f"i64 {len(vector)}, i64 {-(-rows // BAND)}"
        self.lines.append(
            f"call void @{product_symbol(self.block)}(ptr {matrix}, ptr {given}, ptr {found}, {sizes})"
        )

    def store(self, argument: int, row: int, step: int) -> None:
        value = self.value(step)
        self.write(argument, row, self.as_number(value) if self.steps[step].logical else value)

    def scratch(self, place: int) -> str:
        return self.new(f"getelementptr i8, ptr %scratch, i64 {place * self.block.alignment}")

    def store_scratch(self, step: int) -> None:
        kind = self.truths if self.steps[step].logical else self.numbers
        address = self.scratch(self.places.slots[step])
        self.lines.append(f"store {kind} {self.value(step)}, ptr {address}")


def emit(
    program: StraightLineProgram,
    lane_first: Sequence[bool],
    library: Library,
    block: LaneBlock,
    part: int,
    loops: bool = False,
) -> str:
    """Return LLVM text that computes a program for a range of lanes.

    A part of the text has ``part`` statements: computed steps and stored results. An argument that is ``lane_first``
    has layout ``(N, rows)``, else ``(rows, N)``. No function of the library takes more lanes than the block has.
    """
    text = [*_declarations(program, library, block)]
    rolled = roll_where_shorter(program) if loops and len(program.steps) >= LONG else None
    if rolled is None:
        functions, slots = _parts(program, lane_first, block, part)
    else:
        tables = DistanceTables()
        functions = [
            LoopText(loop, lane_first, block, tables).text(number) for number, loop in enumerate(rolled.loops)
        ]
        slots, text = rolled.scratch, [*tables.text(), *text]
    text += [line for function in functions for line in function]
    text += _entry(block, len(functions), max(1, slots))
    return "\n".join([*text, "!0 = !{}"])


def _parts(
    program: StraightLineProgram, lane_first: Sequence[bool], block: LaneBlock, size: int
) -> tuple[list[list[str]], int]:
    parts, _ = cut_parts(program, size)
    slots = scratch_slots(program, parts)
    places = _Places(slots, *product_places(program, max(slots.values(), default=-1) + 1))
    vectors = [len(step.parts) for step in program.steps.named("product")]
    functions = []
    for number, statements in enumerate(parts):
        own = _Part(program, lane_first, places, block)
        for statement in statements:
            if not isinstance(statement, int):
                own.store(*statement)
                continue
            own.step(statement)
            if statement in slots:
                own.store_scratch(statement)
        functions.append([f"define internal void @part{number}({HEADER}) {{", *own.lines, "ret void", "}"])
    return functions, places.vector + max(vectors, default=0)


def _entry(block: LaneBlock, parts: int, slots: int) -> Iterator[str]:
    yield "define void @program(ptr %table, i64 %first, i64 %last) {"
    yield "entry:"
    yield f"%scratch = alloca {block.numbers}, i64 {slots}, align {block.alignment}"
    yield "br label %head"
    yield "head:"
    yield "%lane = phi i64 [%first, %entry], [%next, %body]"
    yield "%more = icmp slt i64 %lane, %last"
    yield "br i1 %more, label %body, label %exit"
    yield "body:"
    for number in range(parts):
        yield f"call void @part{number}(ptr %table, ptr %scratch, i64 %lane)"
    yield f"%next = add i64 %lane, {block.lanes}"
    yield "br label %head"
    yield "exit:"
    yield "ret void"
    yield "}"


def product_symbol(block: LaneBlock) -> str:
    """Return the name of the LLVM function that multiplies a constant matrix with a vector."""
    return f"filtergym_product_{block.lanes}"


@functools.cache
def product_text(block: LaneBlock) -> str:
    """Return the LLVM text of ``@program(matrix, vector, result, columns, bands)``, a matrix-vector product.

    The rows of a band are computed in parallel; each row's terms are added in order. The code is separate and
    always optimised, as programs spend most of their time in it.
    """
    return "\n".join(_product_lines(block))


def _product_lines(block: LaneBlock) -> Iterator[str]:
    sums = range(BAND)
    yield "define void @program(ptr noalias readonly %matrix, ptr noalias readonly %vector, "
    yield "                     ptr noalias %result, i64 %columns, i64 %bands) {"
    yield "entry:"
    yield "br label %band"
    yield "band:"
    yield "%number = phi i64 [0, %entry], [%following, %written]"
    yield "%start = phi ptr [%matrix, %entry], [%ahead, %written]"
    yield "br label %term"
    yield "term:"
    yield "%column = phi i64 [0, %band], [%next, %term]"
    yield "%place = phi ptr [%start, %band], [%ahead, %term]"
    for i in sums:
        yield f"%sum{i} = phi {block.numbers} [{block.zero}, %band], [%more{i}, %term]"
    yield f"%address = getelementptr {block.numbers}, ptr %vector, i64 %column"
    yield f"%factor = load {block.numbers}, ptr %address, align {block.alignment}"
    for i in sums:
        yield f"%at{i} = getelementptr double, ptr %place, i64 {i}"
        yield f"%number{i} = load double, ptr %at{i}, align 8"
        yield f"%one{i} = insertelement {block.numbers} poison, double %number{i}, i32 0"
        yield f"%all{i} = {block.repeat(f'%one{i}', block.numbers)}"
        yield f"%term{i} = fmul {block.numbers} %all{i}, %factor"
        yield f"%more{i} = fadd {block.numbers} %sum{i}, %term{i}"
    yield f"%ahead = getelementptr double, ptr %place, i64 {BAND}"
    yield "%next = add i64 %column, 1"
    yield "%left = icmp slt i64 %next, %columns"
    yield "br i1 %left, label %term, label %written"
    yield "written:"
    yield f"%first = mul i64 %number, {BAND}"
    for i in sums:
        yield f"%row{i} = add i64 %first, {i}"
        yield f"%to{i} = getelementptr {block.numbers}, ptr %result, i64 %row{i}"
        yield f"store {block.numbers} %more{i}, ptr %to{i}, align {block.alignment}"
    yield "%following = add i64 %number, 1"
    yield "%again = icmp slt i64 %following, %bands"
    yield "br i1 %again, label %band, label %exit"
    yield "exit:"
    yield "ret void"
    yield "}"


def _declarations(program: StraightLineProgram, library: Library, block: LaneBlock) -> Iterator[str]:
    used = program.steps.operations
    if "product" in used:
        yield f"declare void @{product_symbol(block)}(ptr, ptr, ptr, i64, i64)"
    yield f"declare {block.numbers} {block.gather}({block.addresses}, i32, {block.truths}, {block.numbers})"
    yield f"declare {block.numbers} {block.intrinsic('fma')}({', '.join([block.numbers] * 3)})"
    for name in sorted(set(INTRINSIC.values())):
        operands = ", ".join([block.numbers] * (2 if name in ("maximum", "minimum") else 1))
        yield f"declare {block.numbers} {block.intrinsic(name)}({operands})"
    for name in sorted(used & FUNCTIONS.keys() - OPERATIONS.keys()):
        if name not in library.functions:
            raise KeyError(f"{library.name} has no function {name}")
        yield from _block_function(block, name, *library.functions[name][:2])


def _block_function(block: LaneBlock, name: str, symbol: str, lanes: int) -> Iterator[str]:
    width, numbers = block.lanes, block.numbers
    kind = "double" if lanes == 1 else f"<{lanes} x double>"
    operands = ("%a", "%b") if name in BINARY else ("%a",)
    yield f"declare {kind} @{symbol}({', '.join([kind] * len(operands))})"
    header = ", ".join(f"{numbers} {operand}" for operand in operands)
    yield f"define internal {numbers} @all_{name}({header}) {{"
    if lanes == width:
        yield f"%all = call {numbers} @{symbol}({header})"
    whole = "poison"
    for first in range(0, width, lanes) if lanes < width else ():
        parts = [f"{operand}{first}" for operand in operands]
        for operand, part in zip(operands, parts, strict=True):
            if lanes == 1:
                yield f"{part} = extractelement {numbers} {operand}, i32 {first}"
            else:
                chosen = ", ".join(f"i32 {first + i}" for i in range(lanes))
                yield f"{part} = shufflevector {numbers} {operand}, {numbers} poison, <{lanes} x i32> <{chosen}>"
        listed = ", ".join(f"{kind} {part}" for part in parts)
        yield f"%result{first} = call {kind} @{symbol}({listed})"
        target = "%all" if first + lanes == width else f"%whole{first}"
        if lanes == 1:
            yield f"{target} = insertelement {numbers} {whole}, double %result{first}, i32 {first}"
        else:
            spread = ", ".join(f"i32 {i}" if i < lanes else "i32 poison" for i in range(width))
            yield f"%wide{first} = shufflevector {kind} %result{first}, {kind} poison, <{width} x i32> <{spread}>"
            mixed = ", ".join(
                f"i32 {width + i - first}" if first <= i < first + lanes else f"i32 {i}" for i in range(width)
            )
            yield f"{target} = shufflevector {numbers} {whole}, {numbers} %wide{first}, <{width} x i32> <{mixed}>"
        whole = target
    yield f"ret {numbers} %all"
    yield "}"
