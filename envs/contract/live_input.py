"""Measurements of a live sensor, one at a time: named values, converted into the task's ``Measurement``."""

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
"""Largest reading of a sensor: nothing in SI units is larger here, and its square is still a number."""
Memory = dict[str, Any]
"""Memory of an input from the previous measurements: values by name."""


class LiveInput:
    """Converter of live sensor values, given by name, into measurements of a task.

    Here the values are the arrays of the ``Measurement``, by their names. A task whose sensors have simpler values has
    a subclass.

    Values of N tracks are arrays ``(..., N)``. Those of one track lack this axis, and a single number is a float:
    arithmetic of floats takes a tenth of the time of that of small arrays.

    Args:
        task: on NumPy arrays.
        initial: an initial estimate, for its names and shapes.
        measurement: a measurement, for its shapes and types.
        tracks: number of tracks side by side, N.

    Attributes:
        values: names and descriptions of the values of a measurement.
        start_values: names and descriptions of the values at the start, beside mean and covariance.
        lanes: shape of the axis of tracks: ``(N,)``, or empty of one track.
    """

    counter: ClassVar[str] = "number"
    """Array of the measurement that counts measurements."""
    fuses: bool = False
    """Whether several measurements may have the same time stamp."""
    values: Mapping[str, str]
    start_values: Mapping[str, str]

    def __init__(self, task: "Task", initial: Any, measurement: Any, tracks: int) -> None:
        self.task = task
        self.tracks = tracks
        self.lanes: tuple[int, ...] = () if tracks == 1 else (tracks,)
        self.parameters: Any = task.parameters
        self.initial = initial
        self.measurement = measurement
        self._fields = {name: one for name, one in measurement._asdict().items() if hasattr(one, "dtype")}
        self.values, self.start_values = self.describe()

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start of a track."""

        def shapes(part: Any, left_out: Iterable[str]) -> dict[str, str]:
            return {
                name: f"shape {array.shape[:-1]}"
                for name, array in part._asdict().items()
                if name not in left_out and array is not None
            }

        return shapes(self.measurement, [self.counter]), shapes(self.initial, ["mean", "covariance"])

    def read(self, values: Mapping[str, Any], name: str, shape: tuple[int, ...] = ()) -> Any:
        """Return a value by its name as an array ``(*shape, N)``, for one track ``shape``; NaN if it is missing.

        Raises:
            ValueError: for a value that is no number, or has another shape.
        """
        value: Any = values.get(name)
        if not shape and not self.lanes:
            if value is None:
                return math.nan
            if isinstance(value, float | int) and not abs(value) > LARGEST:
                return float(value)
        array = read_numbers(name, numpy.nan if value is None else value)
        if numpy.count_nonzero(numpy.abs(array) > LARGEST):  # a tenth of the time of any()
            raise ValueError(
                f"{name} must be at most {LARGEST:g}, or NaN where it was not received, got {quote_shortened(value)}"
            )
        if value is None:
            array = numpy.full((*shape, 1), numpy.nan)
        elif array.shape == shape or (array.ndim == 0 and math.prod(shape) == 1):
            array = array.reshape(*shape, 1)
        elif array.shape not in ((*shape, 1), (*shape, self.tracks)):  # a number is no vector of equal ones
            tracks = f", or (..., {self.tracks}) for {self.tracks} tracks" if self.tracks > 1 else ""
            raise ValueError(f"{name} must have shape {shape}{tracks}, got {numpy.shape(value)}")
        if self.lanes:
            return numpy.broadcast_to(array, (*shape, self.tracks))
        return array.reshape(shape) if shape else array.item()

    def read_all(self, values: Mapping[str, Any], names: Iterable[str], what: str) -> numpy.ndarray:
        """Return several numbers by name, ``(len(names), N)``, for one track ``(len(names),)``; none may be missing."""
        found = numpy.array([self.read(values, name) for name in names])
        if not numpy.isfinite(found).all():
            raise ValueError(f"{self.task.id} needs {', '.join(names)} {what}, got {_listed(values)}")
        return found

    def check_names(self, values: Mapping[str, Any], known: Mapping[str, str]) -> None:
        """Raise ValueError if a value's name is unknown."""
        if values.__class__ is not dict and not isinstance(values, Mapping):
            raise ValueError(f"values are given by name, got {quote_shortened(values)}")
        if not values.keys() <= known.keys():
            unknown = [name for name in values if name not in known]
            listed = ", ".join(f"{name} ({text})" for name, text in known.items())
            raise ValueError(
                f"unknown value {quote_shortened(unknown[0])}: {self.task.id} takes {listed or 'no more'}"
            )

    def start(self, time: Any, initial_values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the initial estimate from values by name, and the memory for the first measurement.

        Args:
            time: of the start, s, ``(N,)``, of one track a float.
            initial_values: ``mean``, ``covariance`` and other values by name; arrays of one track, or with N last.

        Raises:
            ValueError: for a value that is missing, unknown, or of another shape.
        """
        found = {}
        for name, array in self.initial._asdict().items():
            if array is not None:
                values = self._read_finite(initial_values, name, array, "at the start")
                found[name] = numpy.reshape(values, (*array.shape[:-1], self.tracks)).astype(array.dtype)
        return type(self.initial)(**found), {"time": time, "count": self.broadcast(0.0)}

    def broadcast(self, number: float, shape: tuple[int, ...] = ()) -> Any:
        """Return an array ``(*shape, N)`` filled with a number; for one track ``shape``, or the number itself."""
        return numpy.full((*shape, *self.lanes), number) if shape or self.lanes else number

    def _read_finite(
        self, initial_values: Mapping[str, Any], name: str, like: numpy.ndarray, what: str
    ) -> Any:
        """Return a value by its name, truncated to integers or booleans where ``like`` is; it must be finite."""
        values, dtype = self.read(initial_values, name, like.shape[:-1]), like.dtype
        if numpy.count_nonzero(numpy.isfinite(values)) < numpy.size(values):
            raise ValueError(f"{self.task.id} needs {name} {what}, finite, got {_listed(initial_values)}")
        if dtype.kind == "f":
            return values
        return values > 0.5 if dtype.kind == "b" else numpy.trunc(values)

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the task's ``Measurement`` from the values at one time, and the memory for the next one.

        Args:
            memory: of the previous measurements.
            time: s, ``(N,)``, of one track a float.
            values: by name; a missing one is None, NaN or omitted.

        Raises:
            ValueError: for a value that is missing, unknown, or of another shape.
        """
        count = memory["count"] + 1.0
        made = {self.counter: count} if self.counter in self._fields else {}
        field = self.task.World.received_field
        if field:
            like, shape = self._fields["available"], self._fields[field].shape[:-1]
            received = self.read(values, field, shape)
            there = numpy.isfinite(received)
            if like.ndim == 1:
                there = there.all(axis=tuple(range(len(shape))))
            if "available" in values:
                there = there & (self.read(values, "available", like.shape[:-1]) > 0.0)
            whole = numpy.count_nonzero(there) == there.size
            made[field] = received if whole else self.replace_missing(memory, received, there)
            made["available"] = there
        for name, array in self._fields.items():
            if name not in made:
                made[name] = self._read_finite(values, name, array, "at every measurement")
        return type(self.measurement)(**made), {**memory, "time": time, "count": count}

    def start_from(self, first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, numpy.ndarray]:
        """Return the initial mean and covariance by name from two measurements with ``time``; here raise ValueError."""
        raise ValueError(f"a track of {self.task.id} does not start from two measurements: call start")

    def replace_missing(self, memory: Memory, received: Any, there: Any) -> Any:
        """Return the values with numbers in place of those not received; by default zeros."""
        return numpy.where(there & numpy.isfinite(received), received, 0.0)


class LiveValues:
    """Live values of several tracks at one time, in the form of :class:`~.log_format.Readings`."""

    def __init__(self, input: LiveInput, values: Mapping[str, Any]) -> None:
        self.input = input
        self.values = values

    def has(self, *names: str) -> bool:
        """Return whether there is a value under each of these names."""
        return all(self.values.get(name) is not None for name in names)

    def __getitem__(self, name: str) -> numpy.ndarray:
        return numpy.atleast_1d(self.input.read(self.values, name))

    def place(self, number: int) -> str:
        """Return the name of a track by its index, for an error message."""
        return f"track {number}"

    def deviations(self, name: str) -> Any:
        """Return the positive standard deviations stated under a name, ``(N,)``, for one track a float; NaN: none."""
        found = self.input.read(self.values, name)
        if found.__class__ is not float or found <= 0.0:
            check_deviations(self, name, numpy.atleast_1d(found))
        return found


class LiveReader(NamedTuple):
    """Companion of a problem: its class of converters of live values."""

    input: type[LiveInput] = LiveInput

    @classmethod
    def of(cls, task: Any) -> "LiveReader":
        """Return the :class:`LiveReader` of a task or class of tasks; by default that of :class:`LiveInput`."""
        return find_companion(task, cls) or cls()


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={quote_shortened(value)}" for name, value in values.items()) or "nothing"
