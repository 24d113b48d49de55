"""Libraries of elementary functions such as exp and sin, for one or several lanes per call.

On Linux glibc has vector functions, with errors up to four units in the last place. Where they are missing, the scalar
functions of the C library replace them, which every platform has.
"""

import ctypes
import functools
import platform
import sys
from typing import NamedTuple

from .program import FUNCTIONS

BINARY = frozenset(("atan2", "pow", "hypot"))
VARIANTS = {"avx512f": ("e", 8), "avx2": ("d", 4), "sse4.1": ("b", 2), "neon": ("n", 2)}
"""Letter in glibc's symbols for the vectors of an instruction set, and their number of float64."""
ROUNDING = ("floor", "ceil", "trunc", "rint", "fma")
"""Functions that LLVM calls from the C library if the processor has no instruction for them."""


class LibraryFunction(NamedTuple):
    """Symbol, address and number of lanes of a function such as exp."""

    symbol: str
    lanes: int
    """Number of float64 per call."""
    address: int


class Library(NamedTuple):
    """Name and functions of a library of elementary functions."""

    name: str
    functions: dict[str, LibraryFunction]
    """Functions by their names in :data:`~.program.FUNCTIONS` and ``ROUNDING``."""


def _address(library: ctypes.CDLL, symbol: str) -> int | None:
    if not hasattr(library, symbol):
        return None
    return ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value


def _open(*names: str | None) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except (OSError, TypeError):
            continue
    return None


@functools.cache
def portable_library() -> Library:
    """Return the scalar elementary functions of the C library, one lane per call."""
    library = _open("ucrtbase") if sys.platform == "win32" else _open("libm.so.6", None)
    functions = {}
    for name in (*FUNCTIONS, *ROUNDING):
        address = library and _address(library, name)
        if address:
            functions[name] = LibraryFunction(name, 1, address)
    return Library("C library", functions)


@functools.cache
def fastest_library(features: str) -> Library:
    """Return the elementary functions for a processor's LLVM features: glibc's vector ones if it has them."""
    there = features.split(",")
    vectors = _open("libmvec.so.1")
    if platform.machine() == "aarch64":
        there.append("+neon")
    variant = next((VARIANTS[name] for name in VARIANTS if f"+{name}" in there), None)
    if vectors is None or variant is None:
        return portable_library()
    letter, lanes = variant
    functions = dict(portable_library().functions)
    for name in FUNCTIONS:
        symbol = f"_ZGV{letter}N{lanes}{'vv' if name in BINARY else 'v'}_{name}"
        address = _address(vectors, symbol)
        if address:
            functions[name] = LibraryFunction(symbol, lanes, address)
    return Library(f"libmvec, {lanes} numbers a call", functions)
