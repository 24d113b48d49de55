"""How likely recorded measurements are, as a function of an estimator's parameters.

A recording is cut into windows, which run side by side: a window begins some measurements before those that count, so
that the start of its track no longer matters. Lanes are windows times candidates: an estimator that takes its
parameters as arrays ``(N,)`` runs all candidates at once, compiled where it can be traced. So a gradient by finite
differences costs one run.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...compiler import namespace
from ...compiler.functions import CompiledFunction, empty_lanes, leaves, map_arrays, round_up_lanes
from ...compiler.namespace import NotTraceable
from ...compiler.program import Graph
from ...compiler.sequence import CallSequence, moving_array
from ...envs.contract.companions import find_companion
from ...envs.contract.filter import Filter, FilterInput
from ...envs.contract.log_format import LogFormat
from ...envs.contract.observation import Array
from ...envs.contract.task import Task
from ...envs.data.recorded_world import fill_arrays, measure_once
from ...envs.data.recording import Recording
from ...envs.engine.compiled import AVAILABLE, warn_of
from .filters import as_filter

Apply = Callable[[Mapping[str, Any]], tuple[dict[str, Any], Callable[[Task], Any]]]
"""From parameters to keywords of the task and what makes the estimator, see :class:`~..baselines.table.Tunable`."""


class Span(NamedTuple):
    """Measurements of a recording whose likelihood counts."""

    episode: int
    first: int
    """Number of the first one, from 0 on."""
    last: int
    """Number after the last one."""


class Windows(NamedTuple):
    """Pieces of a recording side by side, W of them, the longest of T measurements."""

    initial: Any
    """The initial estimate of each, the task's NamedTuple of arrays ``(..., W)``."""
    measurements: Sequence[Any]
    """T of the task's ``Measurement``, arrays ``(..., W)``."""
    counts: numpy.ndarray
    """Whether a measurement's likelihood counts, ``(T, W)``."""


def cut_windows(
    recording: Recording, task: Task, spans: Sequence[Span], warm_up: int, every: int = 1
) -> Windows:
    """Cut a recording into windows, each with an initial estimate from its own first measurements.

    Args:
        recording: of the task.
        task: on NumPy arrays, whose log format says how a track starts; where it has none, or a window begins with the
            recording, the recording's own initial estimate stands.
        spans: what counts.
        warm_up: measurements that a window begins earlier, where there are as many.
        every: of those with a field ``available`` one in so many is received, the others are missing.
    """
    template, like = measure_once(type(task)(task.parameters), recording.measurements)
    starts, pieces, counted = [], [], []
    for span in spans:
        initial, first = _start(recording, task, span, warm_up)
        last = min(span.last, int(recording.rows[span.episode]))
        starts.append(initial)
        pieces.append(
            {name: values[span.episode, first:last] for name, values in recording.measurements.items()}
        )
        counted.append(numpy.arange(first, last) >= span.first)
    longest = max(len(count) for count in counted)
    counts = numpy.zeros((longest, len(spans)), dtype=bool)
    for column, count in enumerate(counted):
        counts[: len(count), column] = count
    arrays = {
        name: numpy.stack([_extend(piece[name], longest) for piece in pieces], axis=-1)
        for name in recording.measurements
    }
    if every > 1:
        arrays["available"] = _thin(arrays["available"], every)
    initial_arrays = {
        name: numpy.stack([numpy.asarray(start[name]) for start in starts], axis=-1) for name in starts[0]
    }
    rows = [{name: values[k] for name, values in arrays.items()} for k in range(longest)]
    measurements = [fill_arrays(like, row.__getitem__, numpy) for row in rows]
    return Windows(fill_arrays(template, initial_arrays.__getitem__, numpy), measurements, counts)


def _thin(available: numpy.ndarray, every: int) -> numpy.ndarray:
    """Keep of what is available, ``(T, W)``, the first, and each so many measurements after the last kept."""
    kept = numpy.zeros_like(available)
    since = numpy.full(available.shape[1], every)
    for row, values in zip(kept, available, strict=True):
        now = (values > 0.0) & (since >= every)
        row[now], since[now] = values[now], 0
        since += 1
    return kept


def _start(recording: Recording, task: Task, span: Span, warm_up: int) -> tuple[Mapping[str, Any], int]:
    """Initial estimate of a window, and the number of its first measurement."""
    own = {name: values[span.episode] for name, values in recording.initial.items()}
    log_format = find_companion(task, LogFormat)
    if log_format is None or span.first <= warm_up:
        return own, 0
    first = span.first - warm_up
    available = recording.measurements.get("available")
    # A track starts from what was measured: the window begins earlier where its first measurements are missing.
    while (
        available is not None and first > 0 and not (available[span.episode, first : first + 2] > 0.0).all()
    ):
        first -= 1
    if first == 0:
        return own, 0
    rows = slice(first, first + 3)
    try:
        begun = log_format.start(
            {
                name: values[span.episode : span.episode + 1, rows]
                for name, values in recording.measurements.items()
            },
            recording.seconds[span.episode : span.episode + 1, rows],
            task.parameters,
        )
    except ValueError:
        return own, 0
    return {name: values[0] for name, values in begun.initial.items()}, first + begun.used


def _extend(values: numpy.ndarray, length: int) -> numpy.ndarray:
    """Repeat the last measurement up to a length; what is repeated never counts."""
    missing = length - len(values)
    return values if missing == 0 else numpy.concatenate([values, numpy.repeat(values[-1:], missing, axis=0)])


def _update(
    task: Task, names: tuple[str, ...], apply: Apply, values: Array, measurement: Any, memory: Any
) -> tuple[Any, Array]:
    """Memory after a measurement, and its log-likelihood; parameters ``(P, N)``."""
    own = apply({name: values[i] for i, name in enumerate(names)})[1](task)
    return _step(as_filter(task, own), measurement, memory)


def _step(filter: Filter[Any, Any, Any], measurement: Any, state: Any) -> tuple[Any, Array]:
    received = filter.task.world.mask_missing(measurement)
    after = filter.step(state, FilterInput(received))
    return after, filter.records(after, received).get("log_likelihood")


class WindowLikelihood:
    """Log-likelihood of the measurements of windows, for many candidates at once.

    Args:
        task: on NumPy arrays, without a recording.
        windows: of a recording.
        start: values of the parameters under which the likelihood is finite, by name.
        apply: from parameters to what makes the estimator.
        in_lanes: whether every parameter may be an array ``(N,)``; else candidates run one after another.

    Attributes:
        names: of the parameters.
        count: measurements that count.

    Raises:
        ValueError: if the estimator does not say how likely measurements were, or none counts.
    """

    def __init__(
        self, task: Task, windows: Windows, start: Mapping[str, float], apply: Apply, in_lanes: bool = True
    ) -> None:
        self.task, self.windows, self.apply, self.in_lanes = task, windows, apply, in_lanes
        self.names = tuple(start)
        self._compiled: CompiledFunction | None = None
        if in_lanes and AVAILABLE:
            graph = Graph()
            with namespace.tracing(graph):
                traced = type(task)(task.parameters, namespace)
            update = functools.partial(_update, traced, self.names, apply)
            self._compiled = CompiledFunction(update, graph, unchanged=0)
        self._counts = windows.counts
        self._tiles: dict[int, tuple[Any, list[numpy.ndarray]]] = {}
        first = self._by_measurement(numpy.array([[value] for value in start.values()], dtype=float))[:, :, 0]
        if numpy.isnan(first).all():
            raise ValueError("the estimator does not say how likely measurements were: return it from update")
        self._counts = windows.counts & ~numpy.isnan(first)
        self.count = int(self._counts.sum())
        if not self.count:
            raise ValueError("the recording has no measurement that counts")

    def __call__(self, values: numpy.ndarray) -> numpy.ndarray:
        """Log-likelihood of all measurements that count, nats, ``(C,)``; minus infinity where it is not finite.

        Args:
            values: of the parameters, candidates last, ``(P, C)``.
        """
        each = self._by_measurement(values)
        total = numpy.where(self._counts[:, :, None], each, 0.0).sum(axis=(0, 1))
        return numpy.where(numpy.isfinite(total), total, -numpy.inf)

    def gradient(self, values: numpy.ndarray, step: float = 1e-4) -> tuple[float, numpy.ndarray]:
        """Log-likelihood of a candidate, and its gradient by central differences, in one run.

        Args:
            values: ``(P,)``.
            step: of every parameter; its rounding error is 1e-12 of the log-likelihood over the step.
        """
        moves = step * numpy.eye(len(values))
        found = self(
            numpy.concatenate([values[:, None], values[:, None] + moves, values[:, None] - moves], axis=1)
        )
        count = len(values)
        return float(found[0]), (found[1 : 1 + count] - found[1 + count :]) / (2.0 * step)

    def _by_measurement(self, values: numpy.ndarray) -> numpy.ndarray:
        """Log-likelihood of every measurement, ``(T, W, C)``."""
        count = values.shape[1]
        if not self.in_lanes and count > 1:
            return numpy.concatenate([self._by_measurement(values[:, [i]]) for i in range(count)], axis=2)
        W = self._counts.shape[1]
        initial, measurements = self._tile_windows(count)
        lanes = numpy.minimum(numpy.arange(round_up_lanes(count * W)) // W, count - 1)
        with numpy.errstate(all="ignore"):
            found = self._run(numpy.ascontiguousarray(values[:, lanes]), initial, measurements)
        return numpy.moveaxis(found[:, : count * W].reshape(len(found), count, W), 1, 2)

    def _run(
        self, values: numpy.ndarray, initial: Any, measurements: Sequence[numpy.ndarray]
    ) -> numpy.ndarray:
        """Run all lanes, ``(T, lanes)``."""
        lanes, length = initial.mean.shape[-1], len(self._counts)
        found = numpy.empty((length, lanes))
        given = values if self.in_lanes else values[:, 0]
        own = as_filter(
            self.task, self.apply({name: given[i] for i, name in enumerate(self.names)})[1](self.task)
        )
        memory = own.start(initial)
        if self._compiled is not None:
            try:
                self._run_compiled(self._compiled, values, measurements, memory, found)
                return found
            except NotTraceable as error:
                warn_of(type(own).__name__, error)
                self._compiled, memory = None, own.start(initial)
        for k in range(length):
            memory, told = _step(own, self._measurement(measurements, k), memory)
            found[k] = numpy.nan if told is None else told
        return found

    def _run_compiled(
        self,
        function: CompiledFunction,
        values: numpy.ndarray,
        measurements: Sequence[numpy.ndarray],
        memory: Any,
        found: numpy.ndarray,
    ) -> None:
        """Run all lanes through code that is bound to two memories, to and fro, and write what was found."""
        program = function.specialise(values, self._measurement(measurements, 0), memory)
        lanes, inner = found.shape[1], len(program.outputs) - 1
        memories = [[empty_lanes(leaf.shape, lanes) for leaf in program.outputs[:inner]] for _ in range(2)]
        for place, array in zip(memories[0], leaves(memory), strict=True):
            place[...] = array
        first = [array[0] for array in measurements]
        calls = [
            program.bound([values, *first, *before], [*after, found[0]])
            for before, after in (memories, memories[::-1])
        ]
        last = len(calls[0].arrays) - 1
        moving = [
            moving_array(call, place, arrays)
            for call in calls
            for place, arrays in (*enumerate(measurements, 1), (last, found))
        ]
        CallSequence(calls[:1], calls[1:], moving).run(len(found), lanes)

    def _measurement(self, measurements: Sequence[numpy.ndarray], k: int) -> Any:
        """Measurement k, put together from the arrays of all of them."""
        arrays = iter(measurements)
        return map_arrays(lambda _: next(arrays)[k], self.windows.measurements[0])

    def _tile_windows(self, count: int) -> tuple[Any, list[numpy.ndarray]]:
        """Initial estimates of so many candidates, one after another, and of each array of a measurement those of all
        T measurements, ``(T, ..., lanes)``.
        """
        if count not in self._tiles:
            W = self._counts.shape[1]
            windows = numpy.arange(round_up_lanes(count * W)) % W

            def tile(array: numpy.ndarray) -> numpy.ndarray:
                return numpy.ascontiguousarray(array[..., windows])

            arrays = zip(*(leaves(measurement) for measurement in self.windows.measurements), strict=True)
            stacked = [tile(numpy.stack(each)) for each in arrays]
            self._tiles = {count: (map_arrays(tile, self.windows.initial), stacked)}
        return self._tiles[count]
