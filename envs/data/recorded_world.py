"""Worlds that replay a recording or take live measurements in place of a simulation; example measurements of a task."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy

from ...compiler.functions import map_arrays
from ...filters.geodesy import PlaneOrigin
from ..contract.draws import Draws
from ..contract.model import Model
from ..contract.observation import Array
from ..contract.task import Task, named_arrays
from ..contract.world import World


class Replayed(NamedTuple):
    """Position of an episode in a recording: the truth of a replayed world."""

    number: Array
    """Number of the recording, ``(N,)``, as a float, like all fields below."""
    count: Array
    """Number of measurements so far."""
    first: Array
    """Column of the first measurement."""
    last: Array
    """Column of the last one."""


class RecordedArrays(NamedTuple):
    """Arrays of a recording for replay, with all measurements, or all recordings, on the last axis."""

    measurements: Mapping[str, numpy.ndarray]
    initial: Mapping[str, numpy.ndarray]
    truth: numpy.ndarray | None
    seconds: numpy.ndarray
    first: numpy.ndarray
    """Columns of the first and of the last measurement of each recording, ``(E,)``."""
    last: numpy.ndarray


def measure_examples(task: Task, names: Iterable[str] = ()) -> tuple[Any, Any]:
    """Simulate an example of a task's initial estimate and measurement, arrays ``(..., 8)``.

    Args:
        task: on NumPy arrays.
        names: of the arrays of a recording; where one is a field that only recordings contain, the measurement has
            these fields too.
    """
    world = task.World(task)
    draws = Draws.counting(numpy.full((1, 8), 0.5), numpy)
    truth, initial = world.begin(draws, numpy.zeros((world.initial_normals, 8)))
    model = Model(task, task.controls[0])
    feedback = model.feedback(model.start_filter(initial), initial)
    row = numpy.zeros((world.normals + world.row_uniforms, 8))
    row[world.normals :] = 0.5
    measurement = world.advance(truth, row, feedback)[1]
    whole = world.add_recorded_fields(measurement)
    further = {name for name, _ in named_arrays(whole)} - {name for name, _ in named_arrays(measurement)}
    return initial, whole if further & {*names} else measurement


def measure_once(task: Task, names: Iterable[str] = ()) -> tuple[Any, Any]:
    """Simulate an example of a task's initial estimate and measurement; ValueError for a closed loop.

    Arguments as of :func:`measure_examples`.
    """
    if task.closes_loop:
        raise ValueError(
            f"{task.id} with these parameters is a closed loop, in which the estimate changes the next measurement: "
            "readings depend on the estimate in the loop, so that they can be neither "
            "recorded nor replayed"
        )
    return measure_examples(task, names)


def fill_arrays(like: Any, values: Callable[[str], Array], xp: Any) -> Any:
    """Return nested NamedTuples like ``like`` with other arrays, looked up by name and converted to its types.

    Args:
        like: a measurement, or an initial estimate.
        values: array of a name, as of :func:`~.task.named_arrays`.
        xp: array namespace.
    """
    names = iter([name for name, _ in named_arrays(like)])

    def fill(part: Any) -> Any:
        array = values(next(names))
        if part.dtype.kind == "b":
            return array > 0.5
        return xp.astype(array, xp.int64) if part.dtype.kind in "iu" else array

    return map_arrays(fill, like)


class _ForeignWorld(World[Task, Any, Any]):
    """World of readings of real sensors; the task's simulated world computes costs and missing values.

    Attributes:
        simulated: the task's own world, which computes the cost of an error.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.simulated: World[Any, Any, Any] = task.World(task)

    def mask_missing(self, measurement: Any) -> Any:
        return self.simulated.mask_missing(measurement)

    def component_readings(self, measurement: Any) -> Array | None:
        return self.simulated.component_readings(measurement)

    def component_deviations(self, measurement: Any) -> Array | None:
        return self.simulated.component_deviations(measurement)

    def error_cost(self, error: Array) -> Array:
        return self.simulated.error_cost(error)


class RecordedWorld(_ForeignWorld):
    """World that replays the readings of a recording.

    Args:
        name: name of the recording, for errors.
    """

    initial_normals = 1
    normals = 1

    def __init__(self, task: Task, tables: RecordedArrays, name: str) -> None:
        super().__init__(task)
        self._name = name
        plain = type(task)(task.parameters)
        self._initial, self._measurement = measure_once(plain, tables.measurements)
        # RecordedArrays of NumPy are read by compiled code as they are.
        convert = task.constant if "torch" in task.xp.__name__ else numpy.asarray
        self.tables: RecordedArrays = RecordedArrays(
            {name: convert(values) for name, values in tables.measurements.items()},
            {name: convert(values) for name, values in tables.initial.items()},
            None if tables.truth is None else convert(tables.truth),
            convert(tables.seconds),
            convert(tables.first),
            convert(tables.last),
        )

    def begin(self, draws: Draws, normals: Array) -> tuple[Replayed, Any]:
        """Draw a recording for each episode; return its position at the start and its initial estimate."""
        number = draws.integer("recording", (0, len(self.tables.first) - 1))
        first, last = self._at(self.tables.first, number), self._at(self.tables.last, number)
        initial = self._fill(self._initial, self.tables.initial, number)
        return Replayed(number, 0.0 * number, first, last), initial

    def advance(self, truth: Replayed, noise: Array, feedback: None) -> tuple[Replayed, Any]:
        """Return the position at the next measurement, and that measurement; at the end the last one again."""
        truth = truth._replace(count=truth.count + 1.0)
        return truth, self._fill(self._measurement, self.tables.measurements, self._column(truth))

    def all_observations(self) -> tuple[Array | None, Array | None]:
        """Return the readings of the components in all measurements, and their deviations, ``(C, measurements)``.

        Both are None where the measured quantity is no component.
        """
        columns = self.xp.arange(self.tables.seconds.shape[-1])
        measurement = self._fill(self._measurement, self.tables.measurements, columns)
        return self.simulated.component_readings(measurement), self.simulated.component_deviations(
            measurement
        )

    def _column(self, truth: Replayed) -> Array:
        xp = self.xp
        return xp.minimum(truth.first + xp.clip(truth.count - 1.0, 0.0, None), truth.last)

    def _at(self, table: Array, column: Array) -> Array:
        return self.xp.take(table, self.xp.astype(column, self.xp.int64), axis=-1)

    def _fill(self, like: Any, tables: Mapping[str, Array], column: Array) -> Any:
        return fill_arrays(like, lambda name: self._at(tables[name], column), self.xp)

    def state(self, truth: Replayed) -> Array:
        """Return the true values of the task's components, ``(C, N)``.

        Raises:
            ValueError: if the recording has none.
        """
        if self.tables.truth is None:
            raise ValueError(f"recording {self._name!r} has no truth, so there is no error and no cost")
        return self._at(self.tables.truth, self._column(truth))

    def records(self, truth: Replayed) -> dict[str, Array]:
        """Return the value to record at a measurement by name: the time since the track's start, s."""
        return {"seconds": self._at(self.tables.seconds, self._column(truth))}

    def context(self, truth: Replayed) -> dict[str, Array]:
        """Return the context by name: the index of the recording that each episode replays."""
        return {"recording": truth.number}


@dataclass(frozen=True)
class Feed:
    """Scenario data of live measurements in place of a recording; their truth is unknown.

    Args:
        regular: whether every measurement comes, one sampling interval after the previous one.
        second_sensor: whether a measurement has the fields that only recordings contain.
        deviations: of measurements that state none, named and in units as in a log.
        scan_interval: time between scans, s; a longer time between two measurements contains missed scans. None: the
            time between is one step.
        origin: origin of the conversion of latitude and longitude into metres; None: they are not accepted.
    """

    regular: bool = False
    second_sensor: bool = False
    deviations: tuple[tuple[str, float], ...] = ()
    scan_interval: float | None = None
    origin: PlaneOrigin | None = None
    truth: ClassVar[None] = None
    has_whole_truth: ClassVar[bool] = False

    def has_interval(self, seconds: float) -> bool:
        """Return True: live measurements are taken to come at a task's constant interval."""
        return True

    def lengths_within(self, horizon: int, decision_interval: int) -> tuple[int, ...]:
        """Return the episodes' lengths: an empty tuple, as live measurements have no end."""
        return ()

    def world(self, task: Task) -> "LiveWorld":
        """Return the world of live measurements that replaces a task's simulated world."""
        return LiveWorld(task, self.second_sensor)


class Unknown(NamedTuple):
    """The unknown truth of live measurements: an empty state."""


class LiveWorld(_ForeignWorld):
    """World of live measurements, whose numbers are passed in as its noise.

    Args:
        second_sensor: whether a measurement has the fields that only recordings contain.

    Attributes:
        initial: an initial estimate, for its names, shapes and types.
        measurement: a measurement, for its shapes and types.
    """

    def __init__(self, task: Task, second_sensor: bool) -> None:
        super().__init__(task)
        self.initial, measurement = measure_examples(type(task)(task.parameters))
        self.measurement = self.simulated.add_recorded_fields(measurement) if second_sensor else measurement
        self.initial_normals: int = _count_numbers(self.initial)
        self.normals: int = _count_numbers(self.measurement)

    def begin(self, draws: Draws, normals: Array) -> tuple[Unknown, Any]:
        """Return the unknown truth, and the initial estimate made of the numbers in ``normals``."""
        return Unknown(), self._fill(self.initial, normals)

    def advance(self, truth: Unknown, noise: Array, feedback: None) -> tuple[Unknown, Any]:
        """Return the unknown truth, and the measurement made of the numbers in ``noise``."""
        return truth, self._fill(self.measurement, noise)

    def _fill(self, like: Any, numbers: Array) -> Any:
        parts, first = {}, 0
        for name, array in named_arrays(like):
            last = first + math.prod(array.shape[:-1])
            parts[name] = self.xp.reshape(numbers[first:last], (*array.shape[:-1], numbers.shape[-1]))
            first = last
        return fill_arrays(like, parts.__getitem__, self.xp)

    def state(self, truth: Unknown) -> Array:
        """Raise ValueError, since the truth of live measurements is unknown."""
        raise ValueError("the truth of live measurements is unknown, so there is no error and no cost")


def _count_numbers(like: Any) -> int:
    return sum(math.prod(array.shape[:-1]) for _, array in named_arrays(like))
