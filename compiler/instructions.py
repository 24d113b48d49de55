"""LLVM instructions for a block of lanes: operations, loads and stores."""

from collections.abc import Iterator, Sequence

from .block import LaneBlock

_INFIX = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}
_COMPARE = {"less": "olt", "less_equal": "ole", "greater": "ogt", "greater_equal": "oge"}
_COMPARE |= {"equal": "oeq", "not_equal": "une"}
INTRINSIC = {name: name for name in ("sqrt", "floor", "ceil", "trunc", "rint", "maximum", "minimum")}
INTRINSIC["absolute"] = "fabs"
HEADER = "ptr noalias readonly %table, ptr noalias %scratch, i64 %lane"
"""LLVM parameters of a part: addresses of arguments, the scratch array, and the first lane of the block."""


class Instructions:
    """Writer of the LLVM instructions of one function.

    Args:
        lane_first: for every argument whether its layout is lane by lane.
        block: block of lanes that are computed together.
        head: list to which loads of arguments' addresses are appended; default: ``lines``.
    """

    def __init__(self, lane_first: Sequence[bool], block: LaneBlock, head: list[str] | None = None) -> None:
        self.lane_first = lane_first
        self.block = block
        self.numbers: str = block.numbers
        self.truths: str = block.truths
        self.lines: list[str] = []
        self.head: list[str] = self.lines if head is None else head
        self._arguments: dict[int, tuple[str, str]] = {}
        self._first_rows: dict[int, str] = {}
        self._names = 0
        self.constants: str = self._entry("ptr", 0)

    def new(self, expression: str, name: str | None = None, lines: list[str] | None = None) -> str:
        """Append an instruction; return the name of its value."""
        if name is None:
            self._names += 1
            name = f"%t{self._names}"
        (self.lines if lines is None else lines).append(f"{name} = {expression}")
        return name

    # --- arguments

    def argument(self, argument: int) -> tuple[str, str]:
        """Return the LLVM names of an argument's address and stride, loaded at first use."""
        if argument not in self._arguments:
            self._arguments[argument] = (
                self._entry("ptr", 1 + 2 * argument),
                self._entry("i64", 2 + 2 * argument),
            )
        return self._arguments[argument]

    def _entry(self, kind: str, place: int) -> str:
        address = self.new(f"getelementptr i64, ptr %table, i64 {place}", lines=self.head)
        return self.new(f"load {kind}, ptr {address}, !invariant.load !0", lines=self.head)

    def place(self, argument: int, row: int | str) -> str:
        """Return the LLVM name of the address of the block's numbers in a row of an argument."""
        address, stride = self.argument(argument)
        if argument not in self._first_rows:
            self._first_rows[argument] = self.new(
                f"getelementptr double, ptr {address}, i64 %lane", lines=self.head
            )
        start = self.new(f"mul i64 {stride}, {row}")
        return self.new(f"getelementptr double, ptr {self._first_rows[argument]}, i64 {start}")

    def read(self, argument: int, row: int | str, name: str | None = None) -> str:
        """Append the load of a row of an argument, for the block's lanes; return the name of the value."""
        if not self.lane_first[argument]:
            return self.new(f"load {self.numbers}, ptr {self.place(argument, row)}, align 8", name)
        value = "poison"
        for lane, address in enumerate(self._lane_places(argument, row)):
            number = self.new(f"load double, ptr {address}, align 8")
            last = name if lane == self.block.lanes - 1 else None
            value = self.new(f"insertelement {self.numbers} {value}, double {number}, i32 {lane}", last)
        return value

    def write(self, argument: int, row: int | str, value: str) -> None:
        """Append the store of a value to a row of an argument."""
        if not self.lane_first[argument]:
            self.lines.append(f"store {self.numbers} {value}, ptr {self.place(argument, row)}, align 8")
            return
        for lane, address in enumerate(self._lane_places(argument, row)):
            number = self.new(f"extractelement {self.numbers} {value}, i32 {lane}")
            self.lines.append(f"store double {number}, ptr {address}, align 8")

    def _lane_places(self, argument: int, row: int | str) -> Iterator[str]:
        start, stride = self.argument(argument)
        first = self.new(f"mul i64 %lane, {stride}")
        first = self.new(f"add i64 {first}, {row}")
        for lane in range(self.block.lanes):
            offset = self.new(f"mul i64 {stride}, {lane}")
            offset = self.new(f"add i64 {offset}, {first}")
            yield self.new(f"getelementptr double, ptr {start}, i64 {offset}")

    def constant(self, address: str, name: str | None = None) -> str:
        """Append the load of one constant into every lane; return the name of the value."""
        value = self.new(f"load double, ptr {address}, !invariant.load !0")
        one = self.new(f"insertelement {self.numbers} poison, double {value}, i32 0")
        return self.new(self.block.repeat(one, self.numbers), name)

    # --- operations

    def as_number(self, truth: str, name: str | None = None) -> str:
        """Append the conversion of a boolean to one or zero; return the name of the value."""
        return self.choice(truth, self.block.one, self.block.zero, name=name)

    def as_truth(self, number: str, name: str | None = None) -> str:
        """Append the comparison of a number with zero; return the name of the boolean."""
        return self.compare("une", number, self.block.zero, name)

    def choice(
        self, condition: str, one: str, other: str, kind: str | None = None, name: str | None = None
    ) -> str:
        """Append the choice between two values in each lane; return the name of the value."""
        kind = kind or self.numbers
        return self.new(f"select {self.truths} {condition}, {kind} {one}, {kind} {other}", name)

    def compare(self, how: str, one: str, other: str, name: str | None = None) -> str:
        """Append a comparison in each lane; return the name of the boolean."""
        return self.new(f"fcmp {how} {self.numbers} {one}, {other}", name)

    def call(self, function: str, *values: str, name: str | None = None) -> str:
        """Append a call of a function, such as exp, in each lane; return the name of the value."""
        listed = ", ".join(f"{self.numbers} {value}" for value in values)
        return self.new(f"call {self.numbers} {function}({listed})", name)

    def operate(
        self, operation: str, values: Sequence[str], logical: bool, known: Sequence[bool], name: str
    ) -> None:
        """Append the instructions of an arithmetic operation.

        It is none of ``take`` and ``product``; ``known`` states whether each argument is a constant.
        """
        a, *rest = values
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
            self.choice(a, rest[0], rest[1], self.truths if logical else self.numbers, name)
        elif operation == "number":
            self.as_number(a, name)
        elif operation == "sign":  # NaN for NaN
            low = self.choice(self.compare("olt", a, self.block.zero), self.block.minus_one, a)
            sign = self.choice(self.compare("ogt", a, self.block.zero), self.block.one, low)
            self.new(f"fadd {self.numbers} {sign}, {self.block.zero}", name)  # zero for minus zero
        elif operation == "remainder":
            self._remainder(a, rest[0], name)
        elif operation in ("maximum", "minimum") and any(known):
            # One instruction: where the comparison is false, also for NaN, the second is chosen.
            how = "ogt" if operation == "maximum" else "olt"
            limited = (a, rest[0]) if known[0] else (rest[0], a)
            self.choice(self.compare(how, *limited), *limited, name=name)
        else:
            callee = (
                self.block.intrinsic(INTRINSIC[operation]) if operation in INTRINSIC else f"@all_{operation}"
            )
            self.call(callee, a, *rest, name=name)

    def _remainder(self, a: str, b: str, name: str) -> None:
        """Append the remainder with the divisor's sign, rounded once for a quotient below ``2^53``."""
        quotient = self.new(f"fdiv {self.numbers} {a}, {b}")
        whole = self.call(self.block.intrinsic("floor"), quotient)
        minus = self.new(f"fneg {self.numbers} {whole}")
        rest = self.call(self.block.intrinsic("fma"), b, minus, a)
        # The quotient may have been rounded up to a whole number: then the remainder has the opposite sign.
        above = self.new(f"fadd {self.numbers} {rest}, {b}")
        opposite = self.compare("olt", self.new(f"fmul {self.numbers} {rest}, {b}"), self.block.zero)
        self.choice(opposite, above, rest, name=name)

    def take(self, start: int, length: int, place: str, name: str) -> None:
        """Append the lookup in the ``length`` constants from ``start`` on, at an index in each lane."""
        size, last = self.block.constant(f"{length}.0"), self.block.constant(f"{length - 1}.0")
        from_end = self.new(f"fadd {self.numbers} {place}, {size}")
        place = self.choice(self.compare("olt", place, self.block.zero), from_end, place)
        # An index outside the table, or NaN, is clipped to the table.
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
