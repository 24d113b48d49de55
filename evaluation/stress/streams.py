"""Simulated measurements of episodes as arrays over time, which can be altered before a filter receives them.

The paper's algorithm closes the loop, and all filters receive the same measurements.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy

from ...compiler.functions import map_arrays
from ...envs.contract.live_input import LiveReader
from ...envs.contract.model import Episode, Model
from ...envs.contract.task import Task
from ..running.rollout import start_lanes


@dataclass(frozen=True)
class Stream:
    """Measurements and truth of N episodes of K measurements each."""

    task: Task
    """Task on NumPy arrays; its world declares the meaning of the fields."""
    initial: Any
    """Initial estimate given to every filter, arrays ``(..., N)``."""
    measurements: Any
    """The task's ``Measurement``, arrays ``(K, ..., N)``."""
    truth: numpy.ndarray
    """True values of the components at the measurements, ``(K, C, N)``."""
    source: numpy.ndarray
    """Index of each measurement in the recorded stream without alterations, ``(K,)``."""
    begin: int = 0
    """Index of the first altered measurement."""
    end: int | None = None
    """Index of the first measurement after the alteration; None where the alteration lasts."""

    def __len__(self) -> int:
        return len(self.source)

    @property
    def episodes(self) -> int:
        """Number of episodes N."""
        return int(self.truth.shape[-1])

    @property
    def reading_field(self) -> str:
        """Name of the measurement's field that contains the sensors' readings."""
        world = type(self.task.world)
        return world.reading_field or world.received_field

    @property
    def readings(self) -> numpy.ndarray:
        """Readings of the sensors, ``(K, m, N)``."""
        values: numpy.ndarray = getattr(self.measurements, self.reading_field)
        return values

    @property
    def deviations(self) -> numpy.ndarray:
        """Standard deviations of the readings' errors, as the measurements or the model state them, ``(K, m, N)``."""
        world = self.task.world
        return numpy.stack([world.reading_deviations(self.at(k)) for k in range(len(self))])

    @property
    def is_timed(self) -> bool:
        """Whether measurements contain the time since the previous one."""
        return getattr(self.measurements, "interval", None) is not None

    @property
    def seconds(self) -> numpy.ndarray:
        """Times of the measurements of a timed stream, s, ``(K, N)``."""
        return numpy.cumsum(self.measurements.interval, axis=0)

    def at(self, number: int) -> Any:
        """Return the measurement with this index, arrays ``(..., N)``."""
        return map_arrays(lambda values: values[number], self.measurements)

    def select(self, numbers: Sequence[int] | numpy.ndarray) -> "Stream":
        """Return a stream of the measurements with these numbers, in this order; intervals do not change."""
        index = numpy.asarray(numbers)
        return replace(
            self,
            measurements=map_arrays(lambda values: values[index], self.measurements),
            truth=self.truth[index],
            source=self.source[index],
        )

    def with_fields(self, **fields: Any) -> "Stream":
        """Return a stream with some fields of its measurements replaced."""
        return replace(self, measurements=self.measurements._replace(**fields))

    def with_readings(self, readings: numpy.ndarray) -> "Stream":
        """Return a stream with other readings where readings were received."""
        return self.with_fields(**{self.reading_field: numpy.where(self.received, readings, self.readings)})

    @property
    def received(self) -> numpy.ndarray:
        """Mask of the readings that were received, ``(K, m, N)``."""
        available = getattr(self.measurements, "available", None)
        if available is None:
            return numpy.ones(self.readings.shape, dtype=bool)
        if available.ndim < self.readings.ndim:
            available = available[:, None]
        return numpy.broadcast_to(available > 0.0, self.readings.shape)

    def with_times(self, seconds: numpy.ndarray) -> "Stream":
        """Return a timed stream with other times of its measurements, s, ``(K, N)``."""
        interval = numpy.diff(seconds, axis=0, prepend=0.0 * seconds[:1])
        fields = {"interval": interval}
        elapsed = type(self.task.world).elapsed_field
        if elapsed:
            fields[elapsed] = _since_received(seconds, numpy.asarray(self.received.any(axis=1)))
        return self.with_fields(**fields)

    def mark_missing(self) -> "Stream":
        """Return a stream with readings of NaN marked as not received, as the input of an online filter does."""
        field, missing = type(self.task.world).received_field, numpy.isnan(self.readings)
        if not field or not missing.any():
            return self
        available = self.measurements.available.copy()
        available[missing if available.ndim == missing.ndim else missing.any(axis=1)] = 0
        return self.with_fields(**{field: numpy.where(missing, 0.0, self.readings), "available": available})

    def renumber(self) -> "Stream":
        """Return a stream with scan numbers from 1 on, if measurements have such numbers."""
        counter = LiveReader.of(self.task).input.counter
        values = getattr(self.measurements, counter, None)
        if values is None:
            return self
        numbers = numpy.arange(1, len(self) + 1)[:, None] + 0 * values
        return self.with_fields(**{counter: numbers.astype(values.dtype)})


def _since_received(seconds: numpy.ndarray, received: numpy.ndarray) -> numpy.ndarray:
    """Return the time since the previous received measurement, or the start, s, ``(K, N)``."""
    last, found = 0.0 * seconds[0], []
    for now, there in zip(seconds, received, strict=True):
        found.append(now - last)
        last = numpy.where(there, now, last)
    return numpy.stack(found)


def record_streams(model: Model, seeds: Sequence[int], length: int, chunk: int) -> Iterator[Stream]:
    """Simulate episodes with the paper's algorithm in the loop; yield streams that continue each other."""
    task, count = model.on_numpy().task, len(seeds)
    began: list[Episode] = []
    lanes = start_lanes(model, seeds, began.append)
    action = numpy.asarray(task.paper_policy.action)
    if isinstance(model.action_space, gymnasium.spaces.Discrete):
        actions = numpy.full(count, int(action.ravel()[0]))
    else:
        actions = numpy.tile(numpy.reshape(action, model.action_space.shape or ()), (count, 1))
    initial = map_arrays(lambda values: values[..., :count].copy(), began[0].measurement)
    measurements: list[Any] = []
    truth: list[numpy.ndarray] = []
    for first in range(0, length, chunk):
        size = min(chunk, length - first)
        while len(truth) < size:
            for episode, _ in lanes.decide(actions):
                cut = map_arrays(lambda values: values[..., :count].copy(), episode.measurement)
                measurements.append(cut)
                truth.append(task.world.state(episode.truth)[..., :count].copy())
        numbers = numpy.arange(first, first + size)
        yield Stream(task, initial, _stack(measurements[:size]), numpy.stack(truth[:size]), numbers)
        del measurements[:size], truth[:size]


def _stack(parts: Sequence[Any]) -> Any:
    first = parts[0]
    if isinstance(first, tuple):
        columns = (_stack([part[i] for part in parts]) for i in range(len(first)))
        return type(first)(*columns) if hasattr(first, "_fields") else tuple(columns)
    return None if first is None else numpy.stack(parts)
