"""LLVM code that computes the counter-based random numbers of :mod:`.counter_numbers`.

A :class:`Value` represents a number in the text. The functions of :mod:`.counter_numbers` run on such values as on
arrays, and write their text. :func:`bind_numbers` returns compiled code.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy

from .block import LaneBlock, block_for
from .counter_numbers import UNIFORM_PAIRS, normal_pair, pair_of_bits, uniform_pair
from .functions import Call, address_of
from .native import HOT, IN_LOOPS, Code, native_text, processor

_LLVM = {"*": "mul", "+": "add", "-": "sub", "&": "and", "|": "or", "^": "xor", "<<": "shl", ">>": "lshr"}


class Value:
    """A value in LLVM text, a 64-bit integer (``whole``) or a float64, whose operators write instructions.

    Args:
        whole: whether it is an integer.
    """

    def __init__(self, text: "_VectorText", name: str, whole: bool) -> None:
        self.text = text
        self.name = name
        self.whole = whole

    def _with(self, operator: str, other: "Value | int | float") -> "Value":
        name = other.name if isinstance(other, Value) else self.text.constant(other)
        return Value(self.text, self.text.operation(operator, self.name, name, self.whole), self.whole)

    def __add__(self, other: Any) -> "Value":
        return self._with("+", other)

    def __sub__(self, other: Any) -> "Value":
        return self._with("-", other)

    def __mul__(self, other: Any) -> "Value":
        return self._with("*", other)

    def __truediv__(self, other: Any) -> "Value":
        return self._with("/", other)

    def __and__(self, other: Any) -> "Value":
        return self._with("&", other)

    def __or__(self, other: Any) -> "Value":
        return self._with("|", other)

    def __xor__(self, other: Any) -> "Value":
        return self._with("^", other)

    def __lshift__(self, other: Any) -> "Value":
        return self._with("<<", other)

    def __rshift__(self, other: Any) -> "Value":
        return self._with(">>", other)


class _VectorText:
    """LLVM instructions for a block of lanes, with the operations of :class:`~.counter_numbers.Machine`."""

    def __init__(self, prefix: str, block: LaneBlock) -> None:
        self.lines: list[str] = []
        self._prefix, self._count = prefix, 0
        self.block = block

    def name(self) -> str:
        self._count += 1
        return f"{self._prefix}{self._count}"

    def word(self, name: str) -> Value:
        return Value(self, name, True)

    def new(self, expression: str) -> str:
        name = self.name()
        self.lines.append(f"{name} = {expression}")
        return name

    def constant(self, value: int | float) -> str:
        if isinstance(value, int):
            return self.block.constant(str(value), "i64")
        return self.block.constant(f"0x{numpy.float64(value).view('u8'):016X}")

    def operation(self, operator: str, one: str, other: str, whole: bool) -> str:
        if whole:
            return self.new(f"{_LLVM[operator]} {self.block.words} {one}, {other}")
        return self.new(f"f{_LLVM.get(operator, 'div')} {self.block.numbers} {one}, {other}")

    def bits(self, number: Value) -> Value:
        return Value(
            self, self.new(f"bitcast {self.block.numbers} {number.name} to {self.block.words}"), True
        )

    def number(self, bits: Value) -> Value:
        return Value(self, self.new(f"bitcast {self.block.words} {bits.name} to {self.block.numbers}"), False)

    def sqrt(self, number: Value) -> Value:
        return Value(
            self,
            self.new(
                f"call {self.block.numbers} {self.block.intrinsic('sqrt')}({self.block.numbers} {number.name})"
            ),
            False,
        )

    def choose(self, condition: Value, one: Value, other: Value) -> Value:
        true = self.new(f"icmp ne {self.block.words} {condition.name}, zeroinitializer")
        return Value(
            self,
            self.new(
                f"select {self.block.truths} {true}, {self.block.numbers} {one.name}, {self.block.numbers} {other.name}"
            ),
            False,
        )


Make = Callable[[Any, Any, Any], tuple[Any, Any]]


def _write_pair(text: _VectorText, make: Make, names: tuple[str, str, str, str]) -> tuple[str, str]:
    one, other = make(text, *pair_of_bits(*(text.word(name) for name in names)))
    return one.name, other.name


def _loop(
    block: LaneBlock, kind: str, make: Make, first_row: str, count: str, first_pair: int, before: str
) -> list[str]:
    text = _VectorText(f"%{kind}", block)
    one, other = _write_pair(text, make, ("%key", "%episode", "%t", f"%pair_{kind}"))
    return [
        f"%some_{kind} = icmp sgt i64 {count}, 0",
        f"br i1 %some_{kind}, label %pairs_{kind}, label %done_{kind}",
        f"pairs_{kind}:",
        f"%place_{kind} = phi i64 [0, %{before}], [%next_{kind}, %pairs_{kind}]",
        f"%half_{kind} = lshr i64 %place_{kind}, 1",
        f"%number_{kind} = add i64 %half_{kind}, {first_pair}",
        f"%one_{kind} = insertelement {block.words} poison, i64 %number_{kind}, i32 0",
        f"%pair_{kind} = {block.repeat(f'%one_{kind}', block.words)}",
        *text.lines,
        f"%row_{kind} = add i64 {first_row}, %place_{kind}",
        f"%start_{kind} = mul i64 %row_{kind}, %stride",
        f"%at_{kind} = add i64 %start_{kind}, %lane",
        f"%to_{kind} = getelementptr double, ptr %rows, i64 %at_{kind}",
        f"store {block.numbers} {one}, ptr %to_{kind}, align 8",
        # The second number of the last pair may be unused.
        f"%beyond_{kind} = getelementptr double, ptr %to_{kind}, i64 %stride",
        f"%second_{kind} = add i64 %place_{kind}, 1",
        f"%both_{kind} = icmp slt i64 %second_{kind}, {count}",
        f"%other_{kind} = select i1 %both_{kind}, ptr %beyond_{kind}, ptr %nowhere",
        f"store {block.numbers} {other}, ptr %other_{kind}, align 8",
        f"%next_{kind} = add i64 %place_{kind}, 2",
        f"%more_{kind} = icmp slt i64 %next_{kind}, {count}",
        f"br i1 %more_{kind}, label %pairs_{kind}, label %done_{kind}",
        f"done_{kind}:",
    ]


@functools.cache
def llvm_text(block: LaneBlock) -> str:
    """Return LLVM text of ``@program(table, first, last)``: the random numbers of the next measurement.

    The table contains an unused entry, then address and stride of identities, of measurements and of the rows, then the
    number of normal rows and that of uniform rows.
    """
    entries = (
        *(("identities", "ptr", 1), ("apart", "i64", 2), ("measurements", "ptr", 3)),
        *(("rows", "ptr", 5), ("stride", "i64", 6), ("normals", "i64", 7), ("uniforms", "i64", 8)),
    )
    lines = [
        f"declare {block.numbers} {block.intrinsic('sqrt')}({block.numbers})",
        "define void @program(ptr %table, i64 %first, i64 %last) {",
        "entry:",
        f"%nowhere = alloca {block.numbers}, align {block.alignment}",
    ]
    for name, kind, place in entries:
        lines += [
            f"%in_{name} = getelementptr i64, ptr %table, i64 {place}",
            f"%{name} = load {kind}, ptr %in_{name}",
        ]
    lines += [
        "br label %head",
        "head:",
        "%lane = phi i64 [%first, %entry], [%next, %done_uniform]",
        "%inside = icmp slt i64 %lane, %last",
        "br i1 %inside, label %body, label %exit",
        "body:",
        "%at_key = getelementptr i64, ptr %identities, i64 %lane",
        "%at_episode = getelementptr i64, ptr %at_key, i64 %apart",
        "%at_t = getelementptr i64, ptr %measurements, i64 %lane",
        f"%key = load {block.words}, ptr %at_key, align 8",
        f"%episode = load {block.words}, ptr %at_episode, align 8",
        f"%before = load {block.words}, ptr %at_t, align 8",
        f"%following = add {block.words} %before, {block.constant('1', 'i64')}",
        f"store {block.words} %following, ptr %at_t, align 8",
        # A word of 32 bits, so that LLVM may use the code for products of 32 bits.
        f"%t = and {block.words} %following, {block.constant(str(0xFFFFFFFF), 'i64')}",
        *_loop(block, "normal", normal_pair, "0", "%normals", 0, "body"),
        *_loop(block, "uniform", uniform_pair, "%normals", "%uniforms", UNIFORM_PAIRS, "done_normal"),
        f"%next = add i64 %lane, {block.lanes}",
        "br label %head",
        "exit:",
        "ret void",
        "}",
    ]
    return "\n".join(lines)


def bind_numbers(identities: numpy.ndarray, t: numpy.ndarray, rows: numpy.ndarray, normals: int) -> Call:
    """Return a compiled call that advances ``t`` by one and writes that measurement's random numbers.

    The numbers have the same bits as those of :func:`~.counter_numbers.numbers`. An episode begins with ``t =
    -1``: the first run makes the numbers of its start.

    Args:
        identities: identities of the episodes, ``(2, width)`` uint64.
        t: last measurement, ``(width,)`` int64.
        rows: output, ``(numbers, width)``; the caller may :meth:`~.functions.Call.replace` it as array 2.
        normals: number of first rows with normal numbers; the others are uniform.

    Raises:
        ImportError: without llvmlite.
    """
    arrays = [identities, t, rows]
    table = [0]
    for array in arrays:
        table += [address_of(array), array.strides[0] // array.itemsize]
    table += [normals, len(rows) - normals]
    text = llvm_text(block_for(processor()[1]))
    return Call(
        Code(
            functools.partial(native_text, text, level=0),
            functools.partial(native_text, text),
            HOT // IN_LOOPS,
        ),
        numpy.array(table, dtype=numpy.int64),
        arrays,
        numpy.empty(0),
    )
