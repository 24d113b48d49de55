"""Readings of sensors on the state of an environment, for many lanes.

A reading is ``z(t) = h(x(t - delay)) + bias + v``, ``v ~ N(0, R)``, rounded to whole quanta and, of an angle, wrapped.
Noise is a function of the seed, the number of the episode since that seed, the step and the sensor
(:mod:`~filtergym.compiler.counter_numbers`): two agents in episodes of one seed meet the same noise, whatever they do,
and a lane of a vector environment meets that of a single one.
"""

import dataclasses
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..compiler.counter_numbers import numbers
from ..compiler.vector_functions import VectorFunction
from ..envs.linear.sensors import EARLY, Channel, Sensor
from ..filters.angles import PERIODS
from ..own_equations import trace_measurement
from ..own_sensors import find_channels
from .models import EnvironmentModel

STREAM = zlib.crc32(b"filtergym.wrappers.NoisyObservation")
"""Key of the noise, so that it is independent of that of the environment of the same seed."""
BLOCK = 64
"""Steps whose noise is made at once."""
Array = numpy.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class EnvironmentSensor(Sensor):
    """A sensor of a state-space model with the faults that readings of an environment may have.

    ``h`` may also be the name of a component, or names or numbers of several.
    """

    bias: float = 0.0
    """Standard deviation of an error that is constant in an episode."""
    delay: int = 0
    """Steps until a reading is received."""
    quantum: float = 0.0
    """Step between two values that it can report; zero: it reports any."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bias", "quantum"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not 0.0 <= value < numpy.inf:
                raise ValueError(f"{name} of a sensor must be a finite number of at least 0, got {value!r}")
        if isinstance(self.delay, bool) or not isinstance(self.delay, int) or not 0 <= self.delay <= 100:
            raise ValueError(f"delay of a sensor must be a number of steps from 0 to 100, got {self.delay!r}")


def read_sensors(given: Any, names: Sequence[str], angles: Mapping[str, str]) -> dict[str, EnvironmentSensor]:
    """Return sensors with their h as a matrix or a function of the state.

    Args:
        given: sensors by their names: objects, or mappings of their fields.
        names: of the components of the state, ``(n,)``.
        angles: units of those that are angles, by their names.

    Raises:
        ValueError: for a sensor that is none, or of a component that does not exist.
    """
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"sensors must be a mapping from names to sensors, at least one, got {given!r}")
    fields = [one.name for one in dataclasses.fields(EnvironmentSensor)]
    found = {}
    for name, one in given.items():
        values = {f: getattr(one, f) for f in fields if hasattr(one, f)} if isinstance(one, Sensor) else one
        if not isinstance(values, Mapping) or not {*values} <= {*fields} or not {"h", "R"} <= {*values}:
            raise ValueError(
                f"the sensor {name!r} must be a Sensor, or a mapping with h, R and any of "
                f"{', '.join(fields[2:])}, got {one!r}"
            )
        places = _component_places(name, values["h"], names)
        if places is not None:
            turning = {angles.get(names[place]) for place in places}
            if len(turning) > 1 and values.get("wraps") is None:
                raise ValueError(
                    f"the sensor {name!r} measures {', '.join(names[place] for place in places)}, of which angles wrap "
                    "and others do not: give one sensor to each kind"
                )
            wraps = values.get("wraps") or turning.pop()
            R = values["R"] if callable(values["R"]) else _noise_matrix(values["R"], len(places))
            values = {**values, "wraps": wraps, "h": numpy.eye(len(names))[places], "R": R}
        found[str(name)] = EnvironmentSensor(**values)
    return found


def _component_places(sensor: str, h: Any, names: Sequence[str]) -> list[int] | None:
    """Return the places of components that are named, numbered or chosen by a matrix; None for any other h."""
    if not callable(h) and numpy.shape(h)[1:] == (len(names),):
        chosen = _chosen_columns(numpy.asarray(h, dtype=float))
        return chosen.tolist() if chosen is not None and len(chosen) else None
    kinds = (str, int, numpy.integer)
    listed: Any = [h] if isinstance(h, kinds) else h
    if not isinstance(listed, Sequence) or not all(isinstance(one, kinds) for one in listed):
        return None
    places = []
    for one in listed:
        known = one in names if isinstance(one, str) else not isinstance(one, bool) and 0 <= one < len(names)
        if not known:
            raise ValueError(
                f"the sensor {sensor!r} measures component {one!r}, and the state has {len(names)}: {', '.join(names)}"
            )
        places.append(names.index(one) if isinstance(one, str) else int(one))
    return places


def _chosen_columns(rows: Array) -> Array | None:
    """Return the column that each row of a matrix chooses; None where a row is not one 1 among zeros."""
    is_choice = ((rows == 0.0) | (rows == 1.0)).all() and (rows.sum(axis=1) == 1.0).all()
    return rows.argmax(axis=1) if is_choice else None


def _noise_matrix(R: Any, count: int) -> Array:
    """Return R as an array; a single number is the variance of each of the numbers that a sensor measures."""
    given = numpy.asarray(R, dtype=float)
    return numpy.diag(numpy.broadcast_to(given, count)) if given.ndim == 0 else given


class Reading(NamedTuple):
    """Readings of all sensors at one step, one after the other: m numbers."""

    values: Array
    """``(N, m)``; where nothing is received the last reading."""
    available: Array
    """Whether a reading is received, ``(N, m)`` of booleans."""


class Readings:
    """Sensors of N lanes.

    Args:
        sensors: of :func:`read_sensors`.
        size: n, components of the state.
        interval: between two steps, s.
        lanes: N.

    Attributes:
        channels: places of the sensors among the m numbers.
        limit: of each number, half a turn of an angle but for rounding, else infinity, ``(m,)``.
    """

    def __init__(
        self, sensors: Mapping[str, EnvironmentSensor], size: int, interval: float, lanes: int
    ) -> None:
        self.sensors: Mapping[str, EnvironmentSensor] = sensors
        self.interval: float = interval
        self._lanes = lanes
        self._functions = [
            trace_measurement(f"h of the sensor {name!r}", one.h, size, 0) for name, one in sensors.items()
        ]
        counts = [function.size for function in self._functions]
        self.channels: tuple[Channel, ...] = find_channels(sensors, counts, interval)
        self._noises = [self._noise(*each, size) for each in zip(sensors.items(), counts, strict=True)]
        m = sum(counts)
        of_each = [one for one, count in zip(sensors.values(), counts, strict=True) for _ in range(count)]
        self.bias: Array
        self.quantum: Array
        self.delays: Array
        self.bias, self.quantum, self.delays = (
            numpy.array([getattr(one, name) for one in of_each]) for name in ("bias", "quantum", "delay")
        )
        self.periods: Array = numpy.array([PERIODS[one.wraps] if one.wraps else numpy.inf for one in of_each])
        self.limit: Array = numpy.nextafter(0.5 * self.periods, numpy.inf)
        self._turning, self._rounded = numpy.isfinite(self.periods), self.quantum > 0.0
        self._size = m
        self._is_linear = all(one.matrix is not None and not numpy.any(one.offset) for one in self._functions)
        self._is_linear &= not any(isinstance(root, VectorFunction) for root in self._noises)
        if self._is_linear:
            rows = numpy.concatenate([numpy.asarray(one.matrix) for one in self._functions])
            root = numpy.zeros((m, m))
            for channel, own in zip(self.channels, self._noises, strict=True):
                root[channel.places, channel.places] = own
            self._chosen = _chosen_columns(rows)
            self._diagonal = numpy.diag(root) if not numpy.tril(root, -1).any() else None
            self._rows, self._root = rows, root
        self._is_steady = all(one.interval is None and one.availability == 1.0 for one in self.channels)
        self._turn = numpy.where(self._turning, self.periods, 1.0)
        self._is_exact = not (self._turning.any() or self._rounded.any())
        self._each, self._all_made = numpy.arange(lanes), numpy.ones((lanes, m), dtype=bool)
        self._identities = numpy.zeros((2, lanes), dtype=numpy.uint64)
        self._is_seeded = numpy.zeros(lanes, dtype=bool)
        self.steps: Array = numpy.zeros(lanes, dtype=numpy.int64)
        """Since the start of each lane's episode."""
        self._block = numpy.zeros((BLOCK, 2 * m + len(sensors), lanes))
        self._filled = numpy.zeros(lanes, dtype=numpy.int64)
        """First step of each lane's block."""
        self._offset = numpy.zeros((lanes, m))
        self._last = numpy.zeros((lanes, m))
        self._waiting = numpy.zeros((int(self.delays.max()) + 1, 2, lanes, m))
        """Readings that are under way and whether they were made, by the step modulo the longest delay plus one."""

    @staticmethod
    def _noise(item: tuple[str, EnvironmentSensor], count: int, size: int) -> Any:
        """Return the root of a sensor's R, or its function of the state.

        Raises:
            ValueError: where R is no covariance.
        """
        name, one = item
        if callable(one.R):
            return VectorFunction(
                lambda x: [number for row in numpy.reshape(one.R(x), (count, count)) for number in row], size
            )
        R = _noise_matrix(one.R, count)
        try:
            if R.shape != (count, count) or not numpy.isfinite(R).all():
                raise numpy.linalg.LinAlgError
            return numpy.linalg.cholesky(R)
        except numpy.linalg.LinAlgError:
            raise ValueError(
                f"R of the sensor {name!r} must be a positive definite covariance of its {count} numbers, got "
                f"{numpy.asarray(one.R).tolist()}"
            ) from None

    def begin(self, lanes: Array, state: Array, seeds: Sequence[int | None] | None) -> Reading:
        """Begin episodes of some lanes, and return the first readings; they are received at once, but for the delay.

        Args:
            lanes: which begin, booleans ``(N,)``.
            state: of all lanes, ``(N, n)``.
            seeds: of all lanes; None, of all or of one: it goes on with its next episode, at first of a random seed.
        """
        given: Sequence[int | None] = [None] * self._lanes if seeds is None else seeds
        goes_on = lanes & self._is_seeded & (seeds is None)
        self._identities[1, goes_on] += numpy.uint64(1)
        for lane in numpy.flatnonzero(lanes & ~goes_on).tolist():
            seed = given[lane]
            if seed is None and not self._is_seeded[lane]:
                seed = int(numpy.random.SeedSequence().generate_state(1)[0])
            if seed is None:
                self._identities[1, lane] += numpy.uint64(1)
            else:
                self._identities[:, lane] = int(seed) ^ STREAM << 32, 0
                self._is_seeded[lane] = True
        self.steps[lanes] = 0
        self._fill(lanes)
        row = self._row()
        self._offset[lanes] = (self.bias * row[self._size : 2 * self._size].T)[lanes]
        values = self._measure(state, row)
        self._waiting[:, 0, lanes], self._waiting[:, 1, lanes] = values[lanes], 0.0
        self._waiting[0, 1, lanes] = 1.0
        self._last = numpy.where(lanes[:, None], values, self._last)
        available = numpy.zeros((self._lanes, self._size), dtype=bool)
        available[lanes] = self.delays == 0
        return Reading(self._last, available)

    def advance(self, lanes: Array | None, state: Array) -> Reading:
        """Return the readings one step later of some lanes; others keep their last ones.

        Args:
            lanes: which step, booleans ``(N,)``; None: all.
            state: of all lanes, ``(N, n)``.
        """
        self.steps += 1 if lanes is None else lanes
        late = self.steps - self._filled >= BLOCK
        if late[0] if self._lanes == 1 else late.any():
            self._fill(late)
        row = self._row()
        made = self._all_made if self._is_steady else self._made(row[2 * self._size :])
        values = self._measure(state, row)
        if len(self._waiting) > 1:
            number, depth, each = self.steps, len(self._waiting), self._each
            self._waiting[number % depth, 0, each], self._waiting[number % depth, 1, each] = values, made
            sent = (number[:, None] - self.delays) % depth
            values, made = (
                self._waiting[sent, part, each[:, None], numpy.arange(self._size)] for part in (0, 1)
            )
            made = (made > 0.0) & (number[:, None] >= self.delays)
        if lanes is not None:
            made = made & lanes[:, None]
        if made is not self._all_made:
            values = numpy.where(made, values, self._last)
        self._last = values
        return Reading(values, made)

    def _made(self, uniforms: Array) -> Array:
        """Return whether each number is measured at this step, ``(N, m)``; uniforms ``(sensors, N)``."""
        made = numpy.empty((self._lanes, self._size), dtype=bool)
        for channel, uniform in zip(self.channels, uniforms, strict=True):
            due = uniform < channel.availability
            if channel.interval is not None:
                share = self.interval / channel.interval
                count = numpy.floor(self.steps * share + EARLY)
                due &= count > numpy.floor((self.steps - 1) * share + EARLY)
            made[:, channel.places] = due[:, None]
        return made

    def _fill(self, lanes: Array) -> None:
        """Make the noise of the coming steps of some lanes."""
        t = self.steps[lanes] + numpy.arange(BLOCK)[:, None]
        self._filled[lanes] = self.steps[lanes]
        self._block[:, :, lanes] = numbers(self._identities[:, lanes], t, 2 * self._size, len(self.channels))

    def _row(self) -> Array:
        """Return the noise of this step of every lane, ``(2 m + sensors, N)``."""
        if self._lanes == 1:
            return self._block[self.steps[0] - self._filled[0]]
        return self._block[self.steps - self._filled, :, self._each].T

    def _measure(self, state: Array, row: Array) -> Array:
        """Return what all sensors measure now, ``(N, m)``."""
        if self._is_linear:
            normals = row[: self._size].T
            measured = _product(state, self._rows) if self._chosen is None else state[:, self._chosen]
            noise = _product(normals, self._root) if self._diagonal is None else normals * self._diagonal
            return self.finish(measured + noise + self._offset)
        x = state.T
        values = numpy.empty((self._lanes, self._size))
        for channel, h, root in zip(self.channels, self._functions, self._noises, strict=True):
            normals = row[channel.places]
            if isinstance(root, VectorFunction):
                count = channel.size
                root = numpy.linalg.cholesky(root.value(x, numpy).T.reshape(-1, count, count))
                noise = sum((root[:, :, k] * normals[k][:, None] for k in range(count)), numpy.zeros(()))
            else:
                noise = _product(normals.T, root)
            values[:, channel.places] = h.value(x, numpy).T + noise
        return self.finish(values + self._offset)

    def finish(self, values: Array) -> Array:
        """Round readings to whole quanta, and wrap angles."""
        if self._is_exact:
            return values
        if self._rounded.any():
            quantum = numpy.where(self._rounded, self.quantum, 1.0)
            values = numpy.where(self._rounded, numpy.round(values / quantum) * quantum, values)
        if self._turning.any():
            turned = values - numpy.rint(values / self._turn) * self._turn
            values = turned if self._turning.all() else numpy.where(self._turning, turned, values)
        return values


def _product(vectors: Array, matrix: Array) -> Array:
    """Return ``vectors @ matrix.T``, summed in one order for any number of lanes, as BLAS does not."""
    return sum((vectors[:, k, None] * column for k, column in enumerate(matrix.T)), numpy.zeros(()))


def sensors_of(
    model: EnvironmentModel | None, given: Any, size: int
) -> tuple[dict[str, EnvironmentSensor], float]:
    """Return the sensors on the state of a model, or on the observation itself, and the interval between steps, s."""
    if model is None:
        return read_sensors(given, [str(place) for place in range(size)], {}), 1.0
    return read_sensors(given, tuple(model.names), model.angles), model.interval
