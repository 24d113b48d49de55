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
from ..compiler.library import portable_library
from ..compiler.native import AVAILABLE
from ..compiler.program import Graph
from ..compiler.vector_functions import VectorFunction
from ..envs.contract.parameters import ParameterLimits, check
from ..envs.linear.sensors import EARLY, Channel, Sensor
from ..filters.angles import PERIODS, shorten
from ..filters.array_namespace import namespace, select_nested
from ..filters.small_matrices import cholesky
from ..own_equations import trace_measurement
from ..own_sensors import find_channels
from .recursions import Array, Recursion

STREAM = zlib.crc32(b"filtergym.wrappers.NoisyObservation")
"""Key of the noise, so that it is independent of that of the environment of the same seed."""
BLOCK = 64
"""Steps whose noise is made at once without a compiler."""


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
        for name, hint, most in (("bias", float, None), ("delay", int, 100), ("quantum", float, None)):
            check(f"{name} of a sensor", getattr(self, name), hint, ParameterLimits(at_least=0, at_most=most))


def read_sensors(given: Any, names: Sequence[str], angles: Mapping[str, str]) -> dict[str, EnvironmentSensor]:
    """Return sensors with h as a matrix or a function of the state, or raise ValueError for one that cannot be."""
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
    """Return the indices of the components that h names, numbers or, as a matrix, selects; None for any other h."""
    if not callable(h) and numpy.shape(h)[1:] == (len(names),):
        rows = numpy.asarray(h, dtype=float)
        is_choice = ((rows == 0.0) | (rows == 1.0)).all() and (rows.sum(axis=1) == 1.0).all()
        return rows.argmax(axis=1).tolist() if is_choice and len(rows) else None
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


def _noise_matrix(R: Any, count: int) -> Array:
    """Return R as an array; a single number is the variance of each of the numbers that a sensor measures."""
    return numpy.diag(numpy.full(count, float(R))) if numpy.ndim(R) == 0 else numpy.asarray(R, dtype=float)


class Reading(NamedTuple):
    """Readings of all sensors at one step, one after the other: m numbers."""

    values: Array
    """``(N, m)``; where nothing is received the last reading."""
    available: Array
    """Whether a reading is received, ``(N, m)`` of booleans."""


class Readings(Recursion):
    """Sensors of N lanes (parallel episodes) on the state of a model, or on the observation of fields where it is None.

    Attributes:
        limit: of each number, half a turn of an angle but for rounding, else infinity, ``(m,)``.
        values: of the last step, ``(m,)`` of one lane, ``(N, m)`` of several.
        available: 1 where they were received, else 0.
        place: where observations are written before a step, ``(fields,)`` or ``(N, fields)``.
        complete: readings of the last time of which those of all sensors, the slowest too, have been received, and
            behind them 1 where they were made, ``(2 m, W)``.
    """

    def __init__(self, sensors: Mapping[str, EnvironmentSensor], model: Any, fields: int, lanes: int) -> None:
        super().__init__((sensors, model, fields, lanes), lanes)
        self.sensors, self._model, width = sensors, model, self._width
        self._interval: float = 1.0 if model is None else model.interval
        size = fields if model is None else len(model.names)
        what = "h of the sensor {!r}".format
        self._functions = [trace_measurement(what(name), one.h, size, 0) for name, one in sensors.items()]
        counts = [function.size for function in self._functions]
        self._channels: tuple[Channel, ...] = find_channels(sensors, counts, self._interval)
        self._roots = [_noise_root(one.name, sensors[one.name].R, one.size, size) for one in self._channels]
        each = [sensors[one.name] for one in self._channels for _ in one.numbers]
        faults = numpy.array([[one.bias, one.quantum] for one in each], dtype=float)
        self._bias, self._quantum = faults.T[..., None]
        self._delays = [one.delay for one in each]
        self._periods = {i: PERIODS[one.wraps] for i, one in enumerate(each) if one.wraps}
        m, is_biased, late = len(each), bool(self._bias.any()), max(self._delays)
        halves = numpy.array([0.5 * self._periods.get(i, numpy.inf) for i in range(m)])
        self.limit: Array = numpy.nextafter(halves, numpy.inf)
        is_steady = all(one.interval is None and one.availability == 1.0 for one in self._channels)
        self._counts = m * (1 + is_biased), len(sensors) * (not is_steady)
        """Of normal and of uniform numbers of a step."""
        self._numbers, observation = numpy.zeros((sum(self._counts), width)), numpy.zeros((width, fields))
        self._ahead: list[Array] = []
        """Numbers of coming steps, the last ones first."""
        seeds = numpy.random.SeedSequence().generate_state(width, numpy.uint64)
        self._identities, self._times = numpy.stack([seeds, 0 * seeds]), numpy.full(width, -1)
        """Identities of the episodes and steps of their numbers, see :mod:`.counter_numbers`."""
        self._before = [self._draw]
        if AVAILABLE:
            self.library = portable_library()  # rounds as NumPy
            self._before = [bind_numbers(self._identities, self._times, self._numbers, self._counts[0])]
        zeros = numpy.zeros((m, 1))
        state = zeros[0], zeros, zeros if is_biased else None, numpy.zeros((late, 2, m, 1)) if late else None
        self.bind(self._step_of, (self._step_of, Graph()), state, observation, self._numbers)
        self.complete, available, values = self.outputs
        self.place, self.values = observation[self.own], values[self.own]
        self.available: Array = available.T[self.own]

    def begin(self, begins: Array, steps: Array, seeds: Any = None) -> None:
        """Set the seeds of episodes, and begin them, see :meth:`.Recursion.begin`.

        Without a seed, one of all or of one, a lane goes on with its next episode, at first of a random seed.
        """
        for lane in numpy.flatnonzero(begins).tolist():
            if seeds is None or seeds[lane] is None:
                self._identities[1, lane] += numpy.uint64(1)
            else:
                self._identities[:, lane] = int(seeds[lane]) ^ STREAM << 32, 0
        own, self._ahead = self._times[: len(begins)], []
        own[:] = numpy.where(begins, -1, own - ~(begins | steps))  # the call adds one
        super().begin(begins, steps)

    def _draw(self, first: int, last: int) -> None:
        """Draw the random numbers of a step with NumPy; the arguments are those of the native call."""
        if not self._ahead:
            t = self._times + 1 + numpy.arange(BLOCK)[:, None]
            self._ahead = [*numbers(self._identities, t, *self._counts)[::-1]]
        self._times += 1
        self._numbers[...] = self._ahead.pop()

    def _arrays(self) -> list[Array]:
        return [*super()._arrays(), self._identities, self._times]

    def _step_of(self, given: Any, state: Any) -> tuple[Any, tuple[Array, ...]]:
        """Return the next state, and complete, available and last readings.

        The state is the step of the episode, last readings, constant errors and those under way ``(delay, 2, m, W)``,
        the newest first, with 1 where they were made.
        """
        (x, phases, normals), (step, last, bias, waiting), m = given, state, len(self._delays)
        xp, begins, is_active, rows = namespace(x), phases > 0.0, phases >= 0.0, []
        if self._model is not None:
            x = xp.asarray(self._model.state(x.T)).T
        for channel, root in zip(self._channels, self._roots, strict=True):
            L, own = root if isinstance(root, list) else root(x, xp), normals[channel.places]
            rows += [sum(L[i][k] * own[k] for k in range(i + 1)) for i in range(channel.size)]
        values = xp.concat([h.value(x, xp) for h in self._functions]) + xp.stack(rows)
        if bias is not None:
            bias = xp.where(begins, self._bias * normals[m : 2 * m], bias)
            values = values + bias
        quanta = numpy.where(self._quantum > 0.0, self._quantum, 1.0)
        values = xp.where(self._quantum > 0.0, xp.round(values / quanta) * quanta, values)
        values = shorten(values, self._periods)
        values = xp.where(is_finite := xp.isfinite(values), values, 0.0)
        step, rows = xp.where(begins, 0.0, step + 1.0), []
        for place, channel in enumerate(self._channels):
            due = begins | is_active
            if self._counts[1]:
                due = normals[self._counts[0] + place] < channel.availability
            if channel.interval is not None:
                share = self._interval / channel.interval
                due = due & (xp.floor(step * share + EARLY) > xp.floor((step - 1.0) * share + EARLY))
            rows += [xp.where(begins | due, 1.0, 0.0)] * channel.size
        now = xp.stack([values, xp.where(is_finite, xp.stack(rows), 0.0)])[None]  # else not received
        if waiting is not None:
            now = xp.concat([now, xp.where(begins, 0.0, waiting)])
            waiting = now[:-1]
        sent, received = (xp.stack([now[d, i, j] for j, d in enumerate(self._delays)]) for i in range(2))
        last = xp.where(begins, values, xp.where(received > 0.0, sent, last))
        after = select_nested(is_active, (step, last, bias, waiting), state)
        made, received = (xp.where(is_active, one, 0.0) for one in (now[-1, 1], received))
        return after, (xp.concat([now[-1, 0], made]), received, after[1])


def _noise_root(sensor: str, given: Any, count: int, size: int) -> Any:
    """Return the Cholesky factor of R, or a function of states and namespace that does, or raise ValueError."""
    if callable(given):
        rows: Any = given
        entries = lambda x: [one for row in numpy.reshape(rows(x), (count, count)) for one in row]  # noqa: E731
        function = VectorFunction(entries, size)
        return lambda x, xp: cholesky(xp.reshape(function.value(x, xp), (count, count, -1)))
    R = _noise_matrix(given, count)
    if R.shape == (count, count) and numpy.isfinite(R).all():
        with contextlib.suppress(numpy.linalg.LinAlgError):
            return numpy.linalg.cholesky(R).tolist()
    raise ValueError(
        f"R of the sensor {sensor!r} must be a positive definite covariance of its {count} numbers, got "
        f"{numpy.asarray(given).tolist()}"
    )
