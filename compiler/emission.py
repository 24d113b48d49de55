"""A program as text of LLVM: vector code for blocks of lanes.

The entry ``@program(table, first, last)`` goes through the blocks between two lanes and calls for each one
``@part0``, ``@part1``, ...: a long straight line is cut into parts, because the time that LLVM takes grows faster
than the length of a function. What crosses a cut lies in a scratch array on the stack. ``table`` holds the address
of the constants, then two integers for each argument, address and stride.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from .block import Block
from .library import BINARY, Library
from .parts import cut_parts, product_places, scratch_slots
from .program import BAND, FUNCTIONS, OPERATIONS, Program

_INFIX = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}
_COMPARE = {"less": "olt", "less_equal": "ole", "greater": "ogt", "greater_equal": "oge"}
_COMPARE |= {"equal": "oeq", "not_equal": "une"}
_INTRINSIC = {name: name for name in ("sqrt", "floor", "ceil", "trunc", "rint", "maximum", "minimum")}
_INTRINSIC["absolute"] = "fabs"


class _Places(NamedTuple):
    """What lies where in the scratch array."""

    slots: dict[int, int]
    """Of steps that cross a cut."""
    products: dict[int, int]
    """Of what comes out of products."""
    vector: int
    """Of the vector that is multiplied."""


class _Part:
    """Text of one part; values are named by the steps that they come from."""

    def __init__(self, program: Program, lane_first: Sequence[bool], places: "_Places", block: Block) -> None:
        self.program, self.lane_first, self.places = program, lane_first, places
        self.block, self.numbers, self.truths = block, block.numbers, block.truths
        self.lines: list[str] = []
        self.known: set[int] = set()
        self._arguments: dict[int, tuple[str, str]] = {}
        self._first_rows: dict[int, str] = {}
        self._names = 0
        self.constants = self._entry("ptr", 0)

    def new(self, expression: str, name: str | None = None) -> str:
        """Name of a new value."""
        if name is None:
            self._names += 1
            name = f"%t{self._names}"
        self.lines.append(f"{name} = {expression}")
        return name

    def place(self, argument: int, row: int) -> str:
        """Address of the block's numbers in a row of an argument."""
        address, stride = self.argument(argument)
        if argument not in self._first_rows:
            self._first_rows[argument] = self.new(f"getelementptr double, ptr {address}, i64 %lane")
        start = self.new(f"mul i64 {stride}, {row}")
        return self.new(f"getelementptr double, ptr {self._first_rows[argument]}, i64 {start}")

    def argument(self, argument: int) -> tuple[str, str]:
        """Address and stride of an argument."""
        if argument not in self._arguments:
            self._arguments[argument] = (
                self._entry("ptr", 1 + 2 * argument),
                self._entry("i64", 2 + 2 * argument),
            )
        return self._arguments[argument]

    def _entry(self, kind: str, place: int) -> str:
        address = self.new(f"getelementptr i64, ptr %table, i64 {place}")
        return self.new(f"load {kind}, ptr {address}, !invariant.load !0")

    def constant(self, place: int, name: str | None = None) -> str:
        """Constant, in every lane."""
        address = self.new(f"getelementptr double, ptr {self.constants}, i64 {place}")
        value = self.new(f"load double, ptr {address}, !invariant.load !0")
        one = self.new(f"insertelement {self.numbers} poison, double {value}, i32 0")
        return self.new(self.block.repeat(one, self.numbers), name)

    def choice(
        self, condition: str, one: str, other: str, kind: str | None = None, name: str | None = None
    ) -> str:
        """One of two values in each lane."""
        kind = kind or self.numbers
        return self.new(f"select {self.truths} {condition}, {kind} {one}, {kind} {other}", name)

    def compare(self, how: str, one: str, other: str, name: str | None = None) -> str:
        """Truth of a comparison in each lane."""
        return self.new(f"fcmp {how} {self.numbers} {one}, {other}", name)

    def call(self, function: str, *values: str, name: str | None = None) -> str:
        """Answer of a function of numbers."""
        listed = ", ".join(f"{self.numbers} {value}" for value in values)
        return self.new(f"call {self.numbers} {function}({listed})", name)

    def value(self, step: int) -> str:
        """Name of a step's value; what is free, or lies in the scratch array, is fetched where it is first needed."""
        operation, arguments, logical = self.program.steps[step]
        if step not in self.known:
            self.known.add(step)
            if operation == "input" and self.lane_first[arguments[0]]:
                self._read_by_lanes(arguments[0], arguments[1], f"%v{step}")
            elif operation == "input":
                self.new(f"load {self.numbers}, ptr {self.place(*arguments)}, align 8", f"%v{step}")
            elif operation == "constant" and logical:
                self.compare("une", self.constant(arguments[0]), self.block.zero, f"%v{step}")
            elif operation == "constant":
                self.constant(arguments[0], f"%v{step}")
            elif operation == "entry":
                row, product = arguments
                address = self.scratch(self.places.products[product] + row)
                self.new(f"load {self.numbers}, ptr {address}", f"%v{step}")
            else:
                kind = self.truths if logical else self.numbers
                self.new(f"load {kind}, ptr {self.scratch(self.places.slots[step])}", f"%v{step}")
        return f"%v{step}"

    def step(self, index: int) -> None:
        """Compute a step."""
        operation, arguments, logical = self.program.steps[index]
        name, kind = f"%v{index}", self.truths if logical else self.numbers
        self.known.add(index)
        if operation == "take":
            self._take(arguments, name)
            return
        if operation == "product":
            self._product(index)
            return
        a, *rest = (self.value(argument) for argument in arguments)
        if operation in _INFIX:
            self.new(f"{_INFIX[operation]} {self.numbers} {a}, {rest[0]}", name)
        elif operation in _COMPARE:
            self.compare(_COMPARE[operation], a, rest[0], name)
        elif operation in ("logical_and", "logical_or"):
            self.new(f"{operation.removeprefix('logical_')} {self.truths} {a}, {rest[0]}", name)
        elif operation == "logical_not":
            self.new(f"xor {self.truths} {a}, {self.block.true}", name)
        elif operation == "negative":
            self.new(f"fneg {self.numbers} {a}", name)
        elif operation == "where":
            self.choice(a, rest[0], rest[1], kind, name)
        elif operation == "number":
            self.choice(a, self.block.one, self.block.zero, name=name)
        elif operation == "sign":  # of what is no number: itself
            low = self.choice(self.compare("olt", a, self.block.zero), self.block.minus_one, a)
            sign = self.choice(self.compare("ogt", a, self.block.zero), self.block.one, low)
            self.new(f"fadd {self.numbers} {sign}, {self.block.zero}", name)  # zero for minus zero
        elif operation == "remainder":
            self._remainder(a, rest[0], name)
        elif operation in ("maximum", "minimum") and (limited := self._constant_first(arguments)):
            # One instruction: where the comparison is false, also for what is no number, the second is taken.
            how = "ogt" if operation == "maximum" else "olt"
            self.choice(self.compare(how, *limited), *limited, name=name)
        else:
            callee = (
                self.block.intrinsic(_INTRINSIC[operation])
                if operation in _INTRINSIC
                else f"@all_{operation}"
            )
            self.call(callee, a, *rest, name=name)

    def _remainder(self, a: str, b: str, name: str) -> None:
        """With the sign of the divisor, rounded once as long as the quotient is below ``2^53``."""
        quotient = self.new(f"fdiv {self.numbers} {a}, {b}")
        whole = self.call(self.block.intrinsic("floor"), quotient)
        minus = self.new(f"fneg {self.numbers} {whole}")
        rest = self.call(self.block.intrinsic("fma"), b, minus, a)
        # The quotient may have been rounded up to a whole number: then the rest is on the other side of zero.
        above = self.new(f"fadd {self.numbers} {rest}, {b}")
        opposite = self.compare("olt", self.new(f"fmul {self.numbers} {rest}, {b}"), self.block.zero)
        self.choice(opposite, above, rest, name=name)

    def _constant_first(self, arguments: tuple[int, ...]) -> tuple[str, str] | None:
        for one, other in (arguments, arguments[::-1]):
            if self.program.steps[one].operation == "constant":
                return self.value(one), self.value(other)
        return None

    def _take(self, arguments: tuple[int, ...], name: str) -> None:
        start, length, index = arguments
        place = self.value(index)
        size, last = self.block.constant(f"{length}.0"), self.block.constant(f"{length - 1}.0")
        from_end = self.new(f"fadd {self.numbers} {place}, {size}")
        place = self.choice(self.compare("olt", place, self.block.zero), from_end, place)
        # An index outside, or one that is no number, reads within the table all the same.
        place = self.choice(self.compare("ogt", place, self.block.zero), place, self.block.zero)
        place = self.choice(self.compare("olt", place, last), place, last)
        whole = self.new(f"fptosi {self.numbers} {place} to {self.block.words}")
        table = self.new(f"getelementptr double, ptr {self.constants}, i64 {start}")
        places = self.new(f"getelementptr double, ptr {table}, {self.block.words} {whole}")
        everywhere = f"{self.truths} {self.block.true}"
        self.new(
            f"call {self.numbers} {self.block.gather}({self.block.addresses} {places}, i32 8, {everywhere}, "
            f"{self.numbers} poison)",
            name,
        )

    def _product(self, index: int) -> None:
        """Put the vector where the loop reads it, and let the loop write what comes out."""
        table, rows, *vector = self.program.steps[index].arguments
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
        """Write a result."""
        value = self.value(step)
        if self.program.steps[step].logical:
            value = self.choice(value, self.block.one, self.block.zero)
        if not self.lane_first[argument]:
            self.lines.append(f"store {self.numbers} {value}, ptr {self.place(argument, row)}, align 8")
            return
        for lane, address in enumerate(self._lane_places(argument, row)):
            number = self.new(f"extractelement {self.numbers} {value}, i32 {lane}")
            self.lines.append(f"store double {number}, ptr {address}, align 8")

    def _read_by_lanes(self, argument: int, row: int, name: str) -> None:
        """Read a row of an argument that is written lane by lane."""
        value = "poison"
        for lane, address in enumerate(self._lane_places(argument, row)):
            number = self.new(f"load double, ptr {address}, align 8")
            last = name if lane == self.block.lanes - 1 else None
            value = self.new(f"insertelement {self.numbers} {value}, double {number}, i32 {lane}", last)

    def _lane_places(self, argument: int, row: int) -> Iterator[str]:
        """Addresses of the block's numbers in an argument that is written lane by lane."""
        start, stride = self.argument(argument)
        first = self.new(f"mul i64 %lane, {stride}")
        first = self.new(f"add i64 {first}, {row}")
        for lane in range(self.block.lanes):
            offset = self.new(f"mul i64 {stride}, {lane}")
            offset = self.new(f"add i64 {offset}, {first}")
            yield self.new(f"getelementptr double, ptr {start}, i64 {offset}")

    def scratch(self, place: int) -> str:
        """Address of a place in the scratch array."""
        return self.new(f"getelementptr i8, ptr %scratch, i64 {place * self.block.alignment}")

    def hand_on(self, step: int) -> None:
        """Put a value into the scratch array."""
        kind = self.truths if self.program.steps[step].logical else self.numbers
        address = self.scratch(self.places.slots[step])
        self.lines.append(f"store {kind} {self.value(step)}, ptr {address}")


def emit(program: Program, lane_first: Sequence[bool], library: Library, block: Block, part: int) -> str:
    """Text of a program.

    Args:
        program: to emit.
        lane_first: of every argument whether it is written lane by lane, ``(N, rows)``, instead of ``(rows, N)``.
        library: where functions come from; none takes more lanes than the block has.
        block: lanes that are computed at a time.
        part: statements of a part: steps that are computed, results that are written.

    Raises:
        KeyError: for a function that the library lacks.
    """
    parts, _ = cut_parts(program, part)
    slots = scratch_slots(program, parts)
    places = _Places(slots, *product_places(program, max(slots.values(), default=-1) + 1))
    vectors = [len(step.parts) for step in program.steps if step.operation == "product"]
    text = list(_declarations(program, library, block))
    for number, statements in enumerate(parts):
        own = _Part(program, lane_first, places, block)
        for statement in statements:
            if not isinstance(statement, int):
                own.store(*statement)
                continue
            own.step(statement)
            if statement in slots:
                own.hand_on(statement)
        header = "ptr noalias readonly %table, ptr noalias %scratch, i64 %lane"
        text += [f"define internal void @part{number}({header}) {{", *own.lines, "ret void", "}"]
    text += _entry(block, len(parts), max(1, places.vector + max(vectors, default=0)))
    return "\n".join([*text, "!0 = !{}"])


def _entry(block: Block, parts: int, slots: int) -> Iterator[str]:
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


def product_symbol(block: Block) -> str:
    """Name of the function that programs call for the product of a matrix."""
    return f"filtergym_product_{block.lanes}"


@functools.cache
def product_text(block: Block) -> str:
    """Text whose ``@program(matrix, vector, result, columns, bands)`` is the product of a matrix of constants with a
    vector of lane values: bands of rows side by side, each row's terms added one after the other.

    It is code of its own, and always optimised: programs spend their time in it.

    Args:
        block: lanes of the vector.
    """
    return "\n".join(_product_lines(block))


def _product_lines(block: Block) -> Iterator[str]:
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


def _declarations(program: Program, library: Library, block: Block) -> Iterator[str]:
    """Intrinsics, and functions of a block made of the library's."""
    used = {step.operation for step in program.steps}
    if "product" in used:
        yield f"declare void @{product_symbol(block)}(ptr, ptr, ptr, i64, i64)"
    yield f"declare {block.numbers} {block.gather}({block.addresses}, i32, {block.truths}, {block.numbers})"
    yield f"declare {block.numbers} {block.intrinsic('fma')}({', '.join([block.numbers] * 3)})"
    for name in sorted(set(_INTRINSIC.values())):
        operands = ", ".join([block.numbers] * (2 if name in ("maximum", "minimum") else 1))
        yield f"declare {block.numbers} {block.intrinsic(name)}({operands})"
    for name in sorted(used & FUNCTIONS.keys() - OPERATIONS.keys()):
        if name not in library.functions:
            raise KeyError(f"{library.name} has no function {name}")
        yield from _of_block(block, name, *library.functions[name][:2])


def _of_block(block: Block, name: str, symbol: str, lanes: int) -> Iterator[str]:
    """A function of a block, made of one of the library's that takes so many lanes."""
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
