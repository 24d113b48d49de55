"""Checks of task parameters: each raises ``ValueError`` with the name, the value and what was expected."""

import math
from collections.abc import Sequence
from typing import Any


def frozen(value: Any) -> Any:
    """Turn lists into tuples, all the way down, so that parameters from JSON equal those from Python."""
    return tuple(frozen(item) for item in value) if isinstance(value, list | tuple) else value


def number(
    name: str,
    value: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
) -> None:
    """Check a finite number against its limits."""
    limits = [
        (f"above {above}", above is None or (isinstance(value, int | float) and value > above)),
        (f"at least {at_least}", at_least is None or (isinstance(value, int | float) and value >= at_least)),
        (f"below {below}", below is None or (isinstance(value, int | float) and value < below)),
        (f"at most {at_most}", at_most is None or (isinstance(value, int | float) and value <= at_most)),
    ]
    stated = [
        text
        for (text, _), limit in zip(limits, (above, at_least, below, at_most), strict=True)
        if limit is not None
    ]
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not is_number or not all(holds for _, holds in limits):
        expected = " ".join(["a finite number", " and ".join(stated)]).strip()
        raise ValueError(f"{name} must be {expected}, got {value!r}")


def integer(name: str, value: Any, *, at_least: int) -> None:
    """Check an integer against its lower limit."""
    if not isinstance(value, int) or isinstance(value, bool) or value < at_least:
        raise ValueError(f"{name} must be an integer of at least {at_least}, got {value!r}")


def numbers(name: str, values: Any, count: int | None = None, **limits: Any) -> None:
    """Check a sequence of numbers, its length, and each of them against the limits of :func:`number`."""
    if not isinstance(values, Sequence) or isinstance(values, str) or (count and len(values) != count):
        expected = f"{count} numbers" if count else "a sequence of numbers"
        raise ValueError(f"{name} must be {expected}, got {values!r}")
    for i, value in enumerate(values):
        number(f"{name}[{i}]", value, **limits)


def interval(name: str, values: Any, **limits: Any) -> None:
    """Check a pair of numbers in ascending order."""
    numbers(name, values, 2, **limits)
    if values[0] > values[1]:
        raise ValueError(f"{name} must be in ascending order, got {values!r}")


def choice(name: str, value: Any, allowed: Sequence[str]) -> None:
    """Check that a word is one of those allowed."""
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")


def stochastic_matrix(name: str, rows: Any, size: int, columns: int | None = None) -> None:
    """Check a matrix of probabilities whose rows sum to one (row = from, column = to)."""
    columns = columns or size
    if not isinstance(rows, Sequence) or len(rows) != size:
        raise ValueError(f"{name} must have {size} rows (row = from, column = to), got {rows!r}")
    for i, row in enumerate(rows):
        numbers(f"{name}[{i}]", row, columns, at_least=0.0, at_most=1.0)
        if abs(sum(row) - 1.0) > 1e-9:
            raise ValueError(f"{name}[{i}] must sum to 1, got {row!r} with sum {sum(row):.12g}")
