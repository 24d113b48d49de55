"""What sensors report, declared once for the rows of a table and for values that come live."""

from typing import Any, NamedTuple, Protocol

import numpy


class Column(NamedTuple):
    """A number that a sensor reports: a column of a table, and a value that comes live."""

    text: str
    """Its unit, and what it is."""
    live: str = ""
    """The same of a value that comes live; empty where ``text`` serves."""

    @property
    def live_text(self) -> str:
        """What it is where it comes live."""
        return self.live or self.text


class Readings(Protocol):
    """Numbers by the names of their columns: n rows of a table, or what came for n tracks."""

    def has(self, *names: str) -> bool:
        """Whether all of these are given."""
        ...

    def __getitem__(self, name: str) -> numpy.ndarray:
        """Numbers of a column, ``(n,)``; NaN where one did not come."""
        ...

    def place(self, number: int) -> str:
        """Where a number stands, such as "row 12"."""
        ...


def optional(readings: Readings, name: str, count: int) -> numpy.ndarray:
    """Numbers of a column that may lack, ``(n,)``; then NaN.

    Args:
        readings: given.
        name: of the column.
        count: n.
    """
    return readings[name] if readings.has(name) else numpy.full(count, numpy.nan)


def check_deviations(readings: Readings, name: str, values: Any) -> None:
    """Raise ValueError if a standard deviation is not above zero.

    Args:
        readings: that they are of.
        name: of the column.
        values: ``(n,)``; NaN where none is stated.
    """
    wrong = numpy.asarray(values <= 0.0)
    if wrong.any():
        place = int(wrong.argmax())
        raise ValueError(
            f"{name} is a standard deviation, above zero, and {readings.place(place)} has {float(values[place]):g}"
        )
