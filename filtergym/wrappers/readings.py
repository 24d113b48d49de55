"""Readings of sensors on the state of an environment, for many lanes.

A reading is ``z(t) = h(x(t - delay)) + bias + v``, ``v ~ N(0, R)``, rounded to whole quanta and, of an angle, wrapped.
Noise is a function of the seed, the number of the episode since that seed, the step and the sensor
(:mod:`~filtergym.compiler.counter_numbers`): two agents in episodes of one seed meet the same noise, whatever they do,
and a lane of a vector environment meets that of a single one.
"""

import contextlib
import dataclasses
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..compiler.counter_code import bind_numbers
from ..compiler.counter_numbers import numbers
from ..compiler.native import AVAILABLE
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

    All lanes step together, and a row of a block holds the noise of each one's own step.

    Args:
        sensors: of :func:`read_sensors`.
        size: n, components of the state.
        interval: between two steps, s.
        lanes: N.

    Attributes:
        limit: of each number, half a turn of an angle but for rounding, else infinity, ``(m,)``.
        complete: readings of the last time of which those of all sensors, the slowest too, have been received.
    """

    def __init__(
        self, sensors: Mapping[str, EnvironmentSensor], size: int, interval: float, lanes: int
    ) -> None:
        self._interval, self._lanes = interval, lanes
        self._functions = [
            trace_measurement(f"h of the sensor {key!r}", sensors[key].h, size, 0) for key in sensors
        ]
        counts = [function.size for function in self._functions]
        self._channels: tuple[Channel, ...] = find_channels(sensors, counts, interval)
        m = self._size = sum(counts)
        self._root, self._varying = numpy.eye(m), {}
        for channel, (name, one) in zip(self._channels, sensors.items(), strict=True):
            if callable(one.R):
                self._varying[channel] = _noise_function(one.R, channel.size, size)
            else:
                self._root[channel.places, channel.places] = _noise_root(name, one.R, channel.size)
        matrices = [
            one.matrix for one in self._functions if one.matrix is not None and not numpy.any(one.offset)
        ]
        is_linear = len(matrices) == len(counts) and not self._varying
        self._rows: Any = numpy.concatenate(matrices) if is_linear else None
        self._chosen = _chosen_columns(numpy.concatenate(matrices)) if is_linear else None
        each = [one for one, count in zip(sensors.values(), counts, strict=True) for _ in range(count)]
        self._bias, self._quantum, self._delays = (
            numpy.array([getattr(one, name) for one in each]) for name in ("bias", "quantum", "delay")
        )
        periods = numpy.array([PERIODS[one.wraps] if one.wraps else numpy.inf for one in each])
        self.limit: Array = numpy.nextafter(0.5 * periods, numpy.inf)
        turning, self._quanta = numpy.isfinite(periods), numpy.where(self._quantum > 0.0, self._quantum, 1.0)
        self._divisors, self._periods = numpy.where(turning, periods, 1.0), numpy.where(turning, periods, 0.0)
        self._turns, self._rounds = bool(turning.any()), bool(self._quantum.any())
        self._is_biased, self._is_late = bool(self._bias.any()), bool(self._delays.any())
        self._is_steady = all(one.interval is None and one.availability == 1.0 for one in self._channels)
        self._all_made, self._each = numpy.ones((lanes, m), dtype=bool), numpy.arange(m)
        self._is_seeded = numpy.zeros(lanes, dtype=bool)
        self._clock, self._starts = 0, numpy.zeros(lanes, dtype=numpy.int64)
        """Steps of all lanes, and those at the start of each one's episode."""
        self._identities = numpy.zeros((2, lanes, BLOCK), dtype=numpy.uint64)
        self._times = numpy.zeros((lanes, BLOCK), dtype=numpy.int64)
        """Identities of the episodes and measurements of a block of steps, see :mod:`.counter_numbers`."""
        self._normals = m * (1 + self._is_biased)
        self._numbers = numpy.zeros((self._normals + len(sensors) * (not self._is_steady), lanes, BLOCK))
        """Normal and uniform numbers of these."""
        self._draw: Any = None
        """The native call that makes them."""
        self._noise, self._made = numpy.zeros((BLOCK, lanes, m)), numpy.zeros((BLOCK, lanes, m), dtype=bool)
        self._offset, self._last = numpy.zeros((lanes, m)), numpy.zeros((lanes, m))
        self._waiting = numpy.zeros((int(self._delays.max()) + 1, 2, lanes, m))
        """Readings that are under way and whether they were made, by the clock modulo the longest delay plus one."""
        self.complete: Reading = Reading(self._last, self._all_made)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without native code."""
        return {**vars(self), "_draw": None}

    def begin(
        self, lanes: Array, state: Array, seeds: Sequence[int | None] | None, received: Any = False
    ) -> Reading:
        """Begin episodes of some lanes, and return the first readings; they are received at once, but for the delay.

        Args:
            lanes: which begin, booleans ``(N,)``.
            state: of all lanes, ``(N, n)``.
            seeds: of all lanes; None, of all or of one: it goes on with its next episode, at first of a random seed.
            received: whether the others have received theirs.
        """
        given: Sequence[int | None] = [None] * self._lanes if seeds is None else seeds
        for lane in numpy.flatnonzero(lanes).tolist():
            seed = given[lane]
            if seed is None and self._is_seeded[lane]:
                self._identities[1, lane] += numpy.uint64(1)
            else:
                drawn = int(numpy.random.SeedSequence().generate_state(1)[0]) if seed is None else int(seed)
                self._identities[:, lane], self._is_seeded[lane] = [[drawn ^ STREAM << 32], [0]], True
        self._starts[lanes] = self._clock
        self._fill(lanes)
        if self._is_biased:
            own = self._bias * self._numbers[self._size : self._normals, :, self._clock % BLOCK].T
            self._offset[lanes] = own[lanes]
        values = self._measure(state)
        self._waiting[:, :, lanes] = 0.0
        self._waiting[self._clock % len(self._waiting)][:, lanes] = values[lanes], self._all_made[lanes]
        values = self._last = numpy.where(lanes[:, None], values, self._last)
        found = Reading(values, numpy.where(lanes[:, None], self._delays == 0, received))
        self.complete = self._complete(found, lanes)
        return found

    def advance(self, lanes: Array | None, state: Array) -> Reading:
        """Return the readings one step later of some lanes; others keep their last ones, and wait for their beginning.

        Args:
            lanes: which step, booleans ``(N,)``; None: all.
            state: of all lanes, ``(N, n)``.
        """
        self._clock += 1
        if self._clock % BLOCK == 0:
            self._fill(numpy.ones(self._lanes, dtype=bool))
        made = self._all_made if self._is_steady else self._made[self._clock % BLOCK].copy()
        values = self._measure(state)
        if self._is_late:
            depth, each = len(self._waiting), self._each
            self._waiting[self._clock % depth] = values, made
            sent = (self._clock - self._delays) % depth
            values, made = self._waiting[sent, 0, :, each].T, self._waiting[sent, 1, :, each].T > 0.0
        if lanes is not None:
            made = made & lanes[:, None]
        if made is not self._all_made:
            values = numpy.where(made, values, self._last)
        self._last = values
        found = Reading(values, made)
        self.complete = self._complete(found, lanes)
        return found

    def _complete(self, found: Reading, lanes: Array | None) -> Reading:
        if self._is_late:
            values, made = self._waiting[(self._clock + 1) % len(self._waiting)]
            found = Reading(values.copy(), made > 0.0)
        return found if lanes is None else Reading(found.values, found.available & lanes[:, None])

    def _fill(self, lanes: Array) -> None:
        """Make the numbers of a block of steps of some lanes."""
        t = (self._clock - self._starts[lanes])[:, None] + numpy.arange(BLOCK) - self._clock % BLOCK
        if AVAILABLE and self._draw is None:
            named, flat = self._identities.reshape(2, -1), self._numbers.reshape(len(self._numbers), -1)
            self._draw = bind_numbers(named, self._times.reshape(-1), flat, self._normals)
        self._times[lanes] = t - 1  # the call adds one
        for lane in numpy.flatnonzero(lanes).tolist() if AVAILABLE else ():
            self._draw(lane * BLOCK, lane * BLOCK + BLOCK)
        if not AVAILABLE:
            counts = self._normals, len(self._numbers) - self._normals
            self._numbers[:, lanes] = numbers(self._identities[:, lanes, 0], t.T, *counts).transpose(1, 2, 0)
        self._noise[:, lanes] = _product(self._numbers[: self._size, lanes].T, self._root)
        for channel, uniform in zip(self._channels, self._numbers[self._normals :, lanes], strict=False):
            due = uniform < channel.availability
            if channel.interval is not None:
                share = self._interval / channel.interval
                due &= numpy.floor(t * share + EARLY) > numpy.floor((t - 1) * share + EARLY)
            self._made[:, lanes, channel.places] = due.T[:, :, None]

    def _measure(self, state: Array) -> Array:
        """Return what all sensors measure now, ``(N, m)``."""
        noise = self._noise[self._clock % BLOCK]
        if self._chosen is not None:
            values = state.take(self._chosen, axis=1)
        elif self._rows is not None:
            values = _product(state, self._rows)
        else:
            values = numpy.concatenate([h.value(state.T, numpy) for h in self._functions]).T
        for channel, R in self._varying.items():
            root = numpy.linalg.cholesky(R.value(state.T, numpy).T.reshape(-1, channel.size, channel.size))
            own = noise[:, channel.places]
            noise = noise.copy()
            noise[:, channel.places] = sum(root[:, :, k] * own[:, k, None] for k in range(channel.size))
        values = values + noise
        if self._is_biased:
            values += self._offset
        if self._rounds:
            quantum = self._quantum
            values = numpy.where(quantum > 0.0, numpy.rint(values / self._quanta) * quantum, values)
        if self._turns:
            turns = values / self._divisors
            numpy.rint(turns, turns)
            turns *= self._periods
            values -= turns
        return values


def _noise_function(R: Any, count: int, size: int) -> VectorFunction:
    """Return the numbers of R, row by row, as a function of the state."""
    return VectorFunction(lambda x: [one for row in numpy.reshape(R(x), (count, count)) for one in row], size)


def _noise_root(sensor: str, given: Any, count: int) -> Array:
    """Return the root of a sensor's R, or raise ValueError where it is no covariance."""
    R = _noise_matrix(given, count)
    if R.shape == (count, count) and numpy.isfinite(R).all():
        with contextlib.suppress(numpy.linalg.LinAlgError):
            return numpy.linalg.cholesky(R)
    raise ValueError(
        f"R of the sensor {sensor!r} must be a positive definite covariance of its {count} numbers, got "
        f"{numpy.asarray(given).tolist()}"
    )


def _product(vectors: Array, matrix: Array) -> Array:
    """Return ``vectors @ matrix.T``, summed in one order for any number of lanes, as BLAS does not."""
    return sum((vectors[..., k, None] * column for k, column in enumerate(matrix.T)), numpy.zeros(()))


def sensors_of(
    model: EnvironmentModel | None, given: Any, size: int
) -> tuple[dict[str, EnvironmentSensor], float]:
    """Return the sensors on the state of a model, or on the observation itself, and the interval between steps, s."""
    if model is None:
        return read_sensors(given, [str(place) for place in range(size)], {}), 1.0
    return read_sensors(given, tuple(model.names), model.angles), model.interval
