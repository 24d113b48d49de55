"""Blocks of lanes that one instruction computes, and their types and constants in LLVM.

LLVM splits every operation on a block that is wider than a register of the processor. That doubles its time, but the
code of short programs is faster, because the two halves are independent.
"""

import functools

LANES = 8
"""Lanes of the widest block; the width of every array is a multiple of it."""


class LaneBlock:
    """A block of adjacent lanes.

    Args:
        lanes: number of lanes, a divisor of ``LANES``.

    Attributes:
        numbers: LLVM's type of a float64 in every lane.
        truths: LLVM's type of a truth value in every lane.
        words: LLVM's type of an integer of 64 bits in every lane.
        addresses: LLVM's type of an address in every lane.
        alignment: alignment of a value in bytes.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self.numbers: str = f"<{lanes} x double>"
        self.truths: str = f"<{lanes} x i1>"
        self.words: str = f"<{lanes} x i64>"
        self.addresses: str = f"<{lanes} x ptr>"
        self.alignment: int = 8 * lanes
        self.zero, self.one, self.minus_one = (self.constant(value) for value in ("0.0", "1.0", "-1.0"))
        self.true: str = self.constant("true", "i1")

    def constant(self, value: str, kind: str = "double") -> str:
        """Return a constant with the same value in every lane."""
        return "<" + ", ".join([f"{kind} {value}"] * self.lanes) + ">"

    def repeat(self, one: str, kind: str) -> str:
        """Return the instruction that repeats the first lane of a value in every lane."""
        return f"shufflevector {kind} {one}, {kind} poison, <{self.lanes} x i32> zeroinitializer"

    def intrinsic(self, name: str) -> str:
        """Return the name of LLVM's intrinsic function of numbers."""
        return f"@llvm.{name}.v{self.lanes}f64"

    @property
    def gather(self) -> str:
        """Name of LLVM's intrinsic function that reads an address in every lane."""
        return f"@llvm.masked.gather.v{self.lanes}f64.v{self.lanes}p0"


@functools.cache
def block_for(features: str) -> LaneBlock:
    """Return the block of one register: eight lanes with AVX-512, four on any other processor.

    Args:
        features: features in LLVM's form, ``+avx2,-avx512f,...``.
    """
    return block_of(LANES if "+avx512f" in features.split(",") else LANES // 2)


@functools.cache
def block_of(lanes: int) -> LaneBlock:
    """Return the block with a number of lanes."""
    return LaneBlock(lanes)
