"""Blocks of lanes that one instruction computes, with their LLVM types and constants.

LLVM splits every operation on a block that is wider than a register of the processor. That doubles its time, but the
code of short programs is faster, because the two halves are independent.
"""

import functools

LANES = 8
"""Number of lanes of the widest block; the width of every array is a multiple of it."""


class LaneBlock:
    """Block of adjacent lanes that one instruction computes: LLVM types and constants of such a vector.

    Args:
        lanes: number of lanes, a divisor of ``LANES``.

    Attributes:
        numbers: LLVM type of a float64 in every lane.
        truths: LLVM type of a boolean in every lane.
        words: LLVM type of a 64-bit integer in every lane.
        addresses: LLVM type of an address in every lane.
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
        """Return the LLVM text of a constant with the same value in every lane."""
        return "<" + ", ".join([f"{kind} {value}"] * self.lanes) + ">"

    def repeat(self, one: str, kind: str) -> str:
        """Return the LLVM instruction that copies the value in the first lane to every lane."""
        return f"shufflevector {kind} {one}, {kind} poison, <{self.lanes} x i32> zeroinitializer"

    def intrinsic(self, name: str) -> str:
        """Return the name of an LLVM intrinsic function for this block."""
        return f"@llvm.{name}.v{self.lanes}f64"

    @property
    def gather(self) -> str:
        """Name of the LLVM intrinsic that loads a number from the address in each lane."""
        return f"@llvm.masked.gather.v{self.lanes}f64.v{self.lanes}p0"


@functools.cache
def block_for(features: str) -> LaneBlock:
    """Return the :class:`LaneBlock` for a processor with these LLVM features: 8 lanes with AVX-512, else 4."""
    return block_of(LANES if "+avx512f" in features.split(",") else LANES // 2)


@functools.cache
def block_of(lanes: int) -> LaneBlock:
    """Return the :class:`LaneBlock` of this number of lanes."""
    return LaneBlock(lanes)
