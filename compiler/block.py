"""Blocks of lanes that one instruction computes, and how LLVM writes their values.

Of a block that is wider than a register of the processor LLVM splits every operation: that takes it twice as long, and
the code of short programs is faster, because two halves do not wait for each other.
"""

import functools

LANES = 8
"""Lanes that the width of every array is a multiple of: those of the widest block."""


class LaneBlock:
    """So many lanes side by side.

    Args:
        lanes: how many; a divisor of ``LANES``.

    Attributes:
        numbers: LLVM's type of a float64 in every lane.
        truths: of a truth value in every lane.
        words: of a whole number of 64 bits in every lane.
        addresses: of an address in every lane.
        alignment: bytes of a value.
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
        """Return a constant that is the same in every lane."""
        return "<" + ", ".join([f"{kind} {value}"] * self.lanes) + ">"

    def repeat(self, one: str, kind: str) -> str:
        """Return what repeats the first lane of a value of some type in every lane."""
        return f"shufflevector {kind} {one}, {kind} poison, <{self.lanes} x i32> zeroinitializer"

    def intrinsic(self, name: str) -> str:
        """Return the name of LLVM's own function of numbers."""
        return f"@llvm.{name}.v{self.lanes}f64"

    @property
    def gather(self) -> str:
        """Name of LLVM's function that reads an address in every lane."""
        return f"@llvm.masked.gather.v{self.lanes}f64.v{self.lanes}p0"


@functools.cache
def block_for(features: str) -> LaneBlock:
    """Return the block of one register: eight lanes with AVX-512, four on any other processor.

    Args:
        features: as LLVM lists them, ``+avx2,-avx512f,...``.
    """
    return block_of(LANES if "+avx512f" in features.split(",") else LANES // 2)


@functools.cache
def block_of(lanes: int) -> LaneBlock:
    """Return the block of so many lanes."""
    return LaneBlock(lanes)
