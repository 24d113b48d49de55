"""Parameters of tasks: limits beside the fields, and one function that checks them.

    @dataclass(frozen=True)
    class ParametersOfMine(TaskParameters):
        range_sigma: float = parameter(100.0, above=0.0)
        \"\"\"Standard deviation of the range, m (paper).\"\"\"

The type of a field determines the values that it takes (number, whole number, boolean, word, tuples of them, None);
:func:`parameter` declares further limits. Errors state name, value and expected values.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy


@dataclasses.dataclass(frozen=True)
class ParameterLimits:
    """Limits of a parameter's value beside its type; in a sequence they hold for each number."""

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None
    choices: tuple[str, ...] = ()
    ascending: bool = False
    """Whether the first number of a pair must not be larger than the second."""
    stochastic: bool = False
    """Whether a row of numbers must be probabilities that sum to one."""


def parameter(default: Any, **limits: Any) -> Any:
    """Declare a task's parameter: return a dataclass field with a default and :class:`ParameterLimits`."""
    return dataclasses.field(default=default, metadata={"limits": ParameterLimits(**limits)})


@dataclasses.dataclass(frozen=True)
class TaskParameters:
    """Base class of every task's parameters, which are checked on construction."""

    horizon: int = parameter(100, at_least=1)
    """Measurements acted on in one episode."""
    decision_interval: int = parameter(1, at_least=1)
    """Measurements for which one action holds."""

    def __post_init__(self) -> None:
        """Check every field against its type and limits, and convert lists to tuples."""
        cls: Any = type(self)
        for name, (hint, limits) in field_limits(cls).items():
            value = freeze(getattr(self, name))
            object.__setattr__(self, name, value)
            check(name, value, hint, limits)
        if self.horizon % self.decision_interval:
            raise ValueError(
                f"horizon must be a multiple of decision_interval, got {self.horizon} and "
                f"{self.decision_interval}"
            )
        self.check()

    def check(self) -> None:
        """Raise ValueError for fields that contradict each other; by default none do."""


@cache
def field_limits(cls: type) -> dict[str, tuple[Any, ParameterLimits]]:
    """Return the type and :class:`ParameterLimits` of every field of a parameters' dataclass, by name."""
    hints = typing.get_type_hints(cls)
    return {
        f.name: (hints[f.name], f.metadata.get("limits", ParameterLimits())) for f in dataclasses.fields(cls)
    }


def freeze(value: Any) -> Any:
    """Return a value with nested lists and arrays converted to tuples, so that parameters from JSON compare equal."""
    if isinstance(value, numpy.ndarray | numpy.generic):
        value = value.tolist()
    return tuple(freeze(item) for item in value) if isinstance(value, list | tuple) else value


def check(name: str, value: Any, hint: Any, limits: ParameterLimits) -> None:
    """Raise ValueError if a parameter's value violates its declared type or limits."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        if value is None:
            return
        (hint,) = (other for other in typing.get_args(hint) if other is not types.NoneType)
    if typing.get_origin(hint) is tuple:
        _sequence(name, value, typing.get_args(hint), limits)
    elif hint is bool:
        if not isinstance(value, bool):
            raise ValueError(f"{name} must be True or False, got {quote_shortened(value)}")
    elif hint is int:
        _integer(name, value, limits)
    elif hint is float:
        _number(name, value, limits)
    elif hint is str:
        _word(name, value, limits)
    else:
        raise TypeError(f"{name} is declared as {hint}, which has no check")


def _limits_in_words(limits: ParameterLimits) -> str:
    words = {"above": "above", "at_least": "at least", "below": "below", "at_most": "at most"}
    parts = [f"{words[f]} {getattr(limits, f)}" for f in words if getattr(limits, f) is not None]
    return " and ".join(parts)


def _within(value: float, limits: ParameterLimits) -> bool:
    return (
        (limits.above is None or value > limits.above)
        and (limits.at_least is None or value >= limits.at_least)
        and (limits.below is None or value < limits.below)
        and (limits.at_most is None or value <= limits.at_most)
    )


LARGEST = 1e60
"""Largest parameter: its fifth power is still finite."""


def quote_shortened(value: Any, most: int = 80) -> str:
    """Return the ``repr`` of a value on one line, shortened to at most ``most`` characters."""
    if isinstance(value, int) and abs(value) >= 10**most:
        return f"a whole number of {value.bit_length() * math.log10(2.0):,.0f} digits"
    if isinstance(value, str | bytes | list | tuple):
        value = value[: most + 1]
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # a whole number of too many digits, inside of something
        text = f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[:most]}..."


def read_numbers(name: str, value: Any) -> numpy.ndarray:
    """Return a user's number or nested list of numbers as an array of floats.

    Raises:
        ValueError: for a value that is no number, or rows of several lengths.
    """
    try:
        found = numpy.asarray(value)
        if found.dtype.kind in "iufb" or (found.dtype.kind == "O" and found.size):
            return found.astype(float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name} must be numbers, got {quote_shortened(value)}")


def _number(name: str, value: Any, limits: ParameterLimits) -> None:
    # Compared, not converted: a whole number can be too large for a float.
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST
    if not is_number or not _within(value, limits):
        stated = f"a finite number {_limits_in_words(limits)}".strip()
        is_too_large = isinstance(value, int | float) and abs(value) > LARGEST and _within(value, limits)
        size = f" and {LARGEST:g} in size at most" if is_too_large else ""
        raise ValueError(f"{name} must be {stated}{size}, got {quote_shortened(value)}")


def _integer(name: str, value: Any, limits: ParameterLimits) -> None:
    is_whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST
    if not is_whole or not _within(value, limits):
        stated = f" of {_limits_in_words(limits)}" if _limits_in_words(limits) else ""
        raise ValueError(f"{name} must be an integer{stated}, got {quote_shortened(value)}")


def check_integer(name: str, value: Any, at_least: int) -> int:
    """Return a user's argument as an int; raise ValueError unless it is a whole number and large enough."""
    value = freeze(value)
    _integer(name, value, ParameterLimits(at_least=at_least))
    return int(value)


def _word(name: str, value: Any, limits: ParameterLimits) -> None:
    if limits.choices and value not in limits.choices:
        raise ValueError(
            f"{name} must be one of {', '.join(map(repr, limits.choices))}, got {quote_shortened(value)}"
        )
    if not isinstance(value, str):
        raise ValueError(f"{name} must be a word, got {quote_shortened(value)}")


_KINDS = {float: "numbers", int: "integers", str: "words"}


def _sequence(name: str, value: Any, of: tuple[Any, ...], limits: ParameterLimits) -> None:
    count = None if of[-1] is Ellipsis else len(of)
    if not isinstance(value, Sequence) or isinstance(value, str) or (count and len(value) != count):
        kind = _KINDS.get(of[0], "rows")
        raise ValueError(
            f"{name} must be {f'{count} {kind}' if count else f'a sequence of {kind}'}, got {quote_shortened(value)}"
        )
    for i, item in enumerate(value):
        check(f"{name}[{i}]", item, of[0] if count is None else of[i], limits)
    if limits.ascending and of[0] in (int, float) and value[0] > value[1]:
        raise ValueError(f"{name} must be in ascending order, got {quote_shortened(value)}")
    if limits.stochastic and of[0] is float and abs(sum(value) - 1.0) > 1e-9:
        raise ValueError(f"{name} must sum to 1, got {quote_shortened(value)} with sum {sum(value):.12g}")


def check_length(name: str, value: Sequence[Any], count: int, what: str = "numbers") -> None:
    """Raise ValueError unless a sequence parameter has ``count`` elements, as another parameter requires."""
    if len(value) != count:
        raise ValueError(f"{name} must be {count} {what}, got {quote_shortened(value)}")


def square_matrix(name: str, rows: Sequence[Sequence[float]], size: int) -> None:
    """Raise ValueError if a transition matrix is not ``(size, size)``, as another parameter requires."""
    if len(rows) != size:
        raise ValueError(
            f"{name} must have {size} rows (row = from, column = to), got {quote_shortened(rows)}"
        )
    for i, row in enumerate(rows):
        check_length(f"{name}[{i}]", row, size)
