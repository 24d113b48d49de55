"""Measurements that come one by one from outside: values by their names, made into the task's ``Measurement``."""

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy

from .companions import find_companion
from .log_format import check_deviations
from .parameters import quote_shortened, read_numbers

if TYPE_CHECKING:
    from .task import Task

LARGEST = 1e15
"""Of what a sensor says: nothing in SI units is larger here, and its square is still a number."""
Memory = dict[str, Any]
"""What an input remembers of the measurements before: arrays ``(..., N)`` by name."""


class LiveInput:
    """Makes measurements of values as they come.

    This one serves every task: the values are the arrays of its ``Measurement``, by their names. Where the sensors of a
    task say the same in plainer words, it has a subclass.

    Args:
        task: on NumPy arrays.
        initial: an initial estimate, for its names and shapes.
        measurement: a measurement, likewise.
        tracks: how many come side by side, N.

    Attributes:
        values: names of what it takes at a measurement, and what they are.
        start_values: likewise at the start, beside mean and covariance.
    """

    counter: ClassVar[str] = "number"
    """Array of the measurement that counts measurements."""
    fuses: bool = False
    """Whether measurements may come at the same time."""
    values: Mapping[str, str]
    start_values: Mapping[str, str]

    def __init__(self, task: "Task", initial: Any, measurement: Any, tracks: int) -> None:
        self.task, self.tracks = task, tracks
        self.parameters: Any = task.parameters
        self.initial, self.measurement = initial, measurement
        self.values, self.start_values = self.describe()

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return what :attr:`values` and :attr:`start_values` are."""

        def shapes(part: Any, left_out: Iterable[str]) -> dict[str, str]:
            return {
                name: f"shape {array.shape[:-1]}"
                for name, array in part._asdict().items()
                if name not in left_out and array is not None
            }

        return shapes(self.measurement, [self.counter]), shapes(self.initial, ["mean", "covariance"])

    def read(self, values: Mapping[str, Any], name: str, shape: tuple[int, ...] = ()) -> numpy.ndarray:
        """Return a value as an array ``(*shape, N)``; NaN where it did not come.

        Raises:
            ValueError: for what is no number, or another shape.
        """
        value: Any = values.get(name)
        array = read_numbers(name, numpy.nan if value is None else value)
        if (numpy.abs(array) > LARGEST).any():
            raise ValueError(
                f"{name} must be at most {LARGEST:g}, or NaN where it did not come, got {quote_shortened(value)}"
            )
        if value is None:
            array = numpy.full((*shape, 1), numpy.nan)
        elif array.shape == shape or (array.ndim == 0 and math.prod(shape) == 1):
            array = array.reshape(*shape, 1)
        elif array.shape not in ((*shape, 1), (*shape, self.tracks)):  # a number is no vector of equal ones
            tracks = f", or (..., {self.tracks}) for {self.tracks} tracks" if self.tracks > 1 else ""
            raise ValueError(f"{name} must have shape {shape}{tracks}, got {numpy.shape(value)}")
        return numpy.broadcast_to(array, (*shape, self.tracks))

    def read_all(self, values: Mapping[str, Any], names: Iterable[str], what: str) -> numpy.ndarray:
        """Return some numbers as ``(len(names), N)``.

        Raises:
            ValueError: if one is missing.
        """
        found = numpy.stack([self.read(values, name) for name in names])
        if not numpy.isfinite(found).all():
            raise ValueError(f"{self.task.id} needs {', '.join(names)} {what}, got {_listed(values)}")
        return found

    def check_names(self, values: Mapping[str, Any], known: Mapping[str, str]) -> None:
        """Raise ValueError for a value of another name."""
        if not isinstance(values, Mapping):
            raise ValueError(f"values are given by name, got {quote_shortened(values)}")
        unknown = [name for name in values if name not in known]
        if unknown:
            listed = ", ".join(f"{name} ({text})" for name, text in known.items())
            raise ValueError(
                f"unknown value {quote_shortened(unknown[0])}: {self.task.id} takes {listed or 'no more'}"
            )

    def start(self, time: numpy.ndarray, given: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Initial estimate of the task's NamedTuple, and memory.

        Args:
            time: of the start, s, ``(N,)``.
            given: ``mean``, ``covariance`` and other values by name; arrays of one track, or with N last.

        Raises:
            ValueError: for what is missing, unknown, or of another shape.
        """
        return self.fill(self.initial, given, "at the start"), {
            "time": time,
            "count": numpy.zeros(self.tracks),
        }

    def fill(self, like: Any, given: Mapping[str, Any], what: str) -> Any:
        """NamedTuple of arrays ``(..., N)``, in the types of another.

        Raises:
            ValueError: for what is missing or not finite.
        """
        found = {}
        for name, array in like._asdict().items():
            if array is None:
                continue
            values = self.read(given, name, array.shape[:-1])
            if not numpy.isfinite(values).all():
                raise ValueError(f"{self.task.id} needs {name} {what}, finite, got {_listed(given)}")
            found[name] = values > 0.5 if array.dtype.kind == "b" else values.astype(array.dtype)
        return type(like)(**found)

    def measure(self, memory: Memory, time: numpy.ndarray, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Make the measurement of the values that came at a time.

        Args:
            memory: of the measurements before.
            time: s, ``(N,)``.
            values: by name; what did not come is None, NaN or left out.

        Raises:
            ValueError: for what is missing, unknown, or of another shape.
        """
        given = {**values, self.counter: memory["count"] + 1.0}
        field = self.task.World.received_field
        if field:
            shape = getattr(self.measurement, field).shape[:-1]
            received = self.read(values, field, shape)
            there = numpy.isfinite(received)
            if self.measurement.available.ndim == 1:
                there = there.all(axis=tuple(range(len(shape))))
            if "available" in values:
                there = there & (self.read(values, "available", self.measurement.available.shape[:-1]) > 0.0)
            given |= {field: self.replace_missing(memory, received, numpy.asarray(there)), "available": there}
        return self.fill(self.measurement, given, "at every measurement"), {
            **memory,
            "time": time,
            "count": given[self.counter],
        }

    def start_from(self, first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, numpy.ndarray]:
        """Initial mean and covariance from the first two measurements, each with its ``time``.

        Raises:
            ValueError: if two measurements start no track here, or one lacks what it takes.
        """
        raise ValueError(f"a track of {self.task.id} does not start from two measurements: call start")

    def replace_missing(self, memory: Memory, received: numpy.ndarray, there: numpy.ndarray) -> numpy.ndarray:
        """Numbers that stand for what was not received; zeros."""
        return numpy.where(there & numpy.isfinite(received), received, 0.0)


class LiveValues:
    """Values that came live, as :class:`~.log_format.Readings` of several tracks.

    Args:
        input: that reads them.
        values: by name; what did not come is None, NaN or left out.
    """

    def __init__(self, input: LiveInput, values: Mapping[str, Any]) -> None:
        self.input, self.values = input, values

    def has(self, *names: str) -> bool:
        """Whether all of these are given."""
        return all(self.values.get(name) is not None for name in names)

    def __getitem__(self, name: str) -> numpy.ndarray:
        """Value of each track, ``(N,)``; NaN where none came."""
        return self.input.read(self.values, name)

    def place(self, number: int) -> str:
        """Track of a value."""
        return f"track {number}"

    def deviations(self, name: str) -> numpy.ndarray:
        """Standard deviations, ``(N,)``; NaN where none is stated.

        Raises:
            ValueError: if one is not above zero.
        """
        found = self[name]
        check_deviations(self, name, found)
        return found


class LiveReader(NamedTuple):
    """How values that come one by one become measurements of a problem."""

    input: type[LiveInput] = LiveInput

    @classmethod
    def of(cls, task: Any) -> "LiveReader":
        """Reader of a task, or of a class of tasks; by default that of the arrays by their names."""
        return find_companion(task, cls) or cls()


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={quote_shortened(value)}" for name, value in values.items()) or "nothing"
