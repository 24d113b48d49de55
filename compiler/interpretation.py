"""NumPy interpreter of programs, in any precision: slow, and the reference for code in other languages."""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from .program import BAND, FUNCTIONS, OPERATIONS, StraightLineProgram, unband

_COMPUTE: dict[str, Callable[..., Any]] = {**OPERATIONS, **FUNCTIONS, "where": numpy.where}


def first_steps(program: StraightLineProgram, results: int) -> int:
    """Return the number of steps after which a program's first ``results`` results are computed."""
    return 1 + max((result.node for result in program.results[:results]), default=-1)


def interpret(
    program: StraightLineProgram,
    read: Callable[[int, int], Any],
    dtype: Any = numpy.float64,
    between: Callable[[Sequence[numpy.ndarray]], None] | None = None,
    results: int = 0,
) -> list[numpy.ndarray]:
    """Return the results of a program for N lanes, computed with NumPy in any precision.

    Args:
        program: the program.
        read: function from argument and row to an input, ``(N,)`` or a number; called at first use.
        dtype: type of all numbers; a constant beyond its range becomes the nearest normal number.
        between: called with the first results, before any other input is read.
        results: number of these results.
    """
    constants = in_range(program.constants, dtype)
    values: list[Any] = []
    pause = first_steps(program, results) if between is not None else -1
    with numpy.errstate(all="ignore"):
        for place, (operation, arguments, logical) in enumerate(program.steps):
            if place == pause and between is not None:
                between([values[result.node] for result in program.results[:results]])
            if operation == "input":
                value: Any = numpy.asarray(read(*arguments), dtype=dtype)
            elif operation == "constant":
                value = constants[arguments[0]]
                value = value != 0.0 if logical else value
            elif operation == "take":
                start, length, index = arguments
                value = constants[start : start + length][_places(values[index], length)]
            elif operation == "product":
                start, rows, *vector = arguments
                table = constants[start : start + -(-rows // BAND) * BAND * len(vector)]
                columns = zip(unband(table, rows, len(vector)).T[..., None], vector, strict=True)
                value = functools.reduce(operator.add, (column * values[i] for column, i in columns))
            elif operation == "entry":
                value = values[arguments[1]][arguments[0]]
            elif operation == "number":
                value = numpy.asarray(values[arguments[0]]).astype(dtype)
            else:
                value = _COMPUTE[operation](*(values[argument] for argument in arguments))
            values.append(value)
        if pause == len(program.steps) and between is not None:
            between([values[result.node] for result in program.results[:results]])
    return [numpy.asarray(values[result.node]) for result in program.results]


def in_range(constants: numpy.ndarray, dtype: Any) -> numpy.ndarray:
    """Return constants in a floating-point type; those beyond its range become its nearest normal numbers."""
    limits = numpy.finfo(dtype)
    size = numpy.clip(numpy.abs(constants), float(limits.tiny), float(limits.max))
    changed = numpy.isfinite(constants) & (constants != 0.0) & (limits.dtype != numpy.float64)
    with numpy.errstate(over="ignore"):
        found: numpy.ndarray = numpy.where(changed, numpy.copysign(size, constants), constants).astype(dtype)
    return found


def _places(index: Any, length: int) -> numpy.ndarray:
    """Return valid indices into a table: negative ones count from the end, others are clipped, NaN is zero."""
    index = numpy.asarray(index, dtype=float)
    index = numpy.where(index < 0.0, index + length, index)
    inside = numpy.where(index > 0.0, numpy.minimum(index, length - 1.0), 0.0)
    return inside.astype(numpy.int64)
