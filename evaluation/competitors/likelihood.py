"""Log-likelihood of recorded measurements as a function of an estimator's parameters, for fitting them.

A recording is cut into windows, which run in parallel and begin some measurements before those that count.
Lanes are windows times candidates: an estimator whose parameters may be arrays ``(N,)`` runs all candidates
at once, so that a gradient by finite differences costs one run. Long runs are processed in stretches, for
constant memory.
"""

import copy
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from ...envs.engine.compiled import AVAILABLE, warn_not_compiled
from .filters import as_filter

Apply = Callable[[Mapping[str, Any]], tuple[dict[str, Any], Callable[[Task], Any]]]
"""Function from parameters to task keywords and the estimator's maker, see :class:`~..baselines.table.Tunable`."""


STRETCH_NUMBERS = 1 << 19
"""Number of lanes times measurements in one stretch: 4 MB for each number of a measurement."""


class Span(NamedTuple):
    """Measurements of a recording that count in the likelihood: episode, first and last measurement."""

    episode: int
    first: int
    """Number of the first measurement, from 0 on."""
    last: int
    """Number after the last measurement."""


class Windows(NamedTuple):
    """W windows of a recording as arrays, the longest of T measurements."""

    initial: Any
    """Initial estimate of each window, the task's NamedTuple of arrays ``(..., W)``."""
    measurements: Any
    """The task's ``Measurement`` of arrays ``(T, ..., W)``."""
    counts: numpy.ndarray
    """Mask of the measurements that count in the likelihood, ``(T, W)``."""
    tiles: dict[int, tuple[Any, Any]]
    """Cache of the initial estimates and measurements repeated for several candidates, by their number."""

    def measurement(self, k: int) -> Any:
        """Return measurement k of every window, the task's ``Measurement`` of arrays ``(..., W)``."""
        return map_arrays(lambda array: array[k], self.measurements)


def cut_windows(
    recording: Recording, task: Task, spans: Sequence[Span], warm_up: int, every: int = 1
) -> Windows:
    """Cut a recording into windows, each with an initial estimate from its own first measurements.

    Args:
        recording: recording of the task.
        task: task on NumPy arrays; its log format starts a track inside the recording.
        spans: measurements that count in the likelihood.
        warm_up: number of measurements to process before those that count.
        every: of measurements with a field ``available``, one in ``every`` is received, the others are
            missing.
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
    measurements = fill_arrays(like, arrays.__getitem__, numpy)
    return Windows(fill_arrays(template, initial_arrays.__getitem__, numpy), measurements, counts, {})


def _thin(available: numpy.ndarray, every: int) -> numpy.ndarray:
    """Thin a mask of available measurements ``(T, W)`` to one in ``every``, beginning with the first."""
    kept = numpy.zeros_like(available)
    since = numpy.full(available.shape[1], every)
    for row, values in zip(kept, available, strict=True):
        now = (values > 0.0) & (since >= every)
        row[now], since[now] = values[now], 0
        since += 1
    return kept


def _start(recording: Recording, task: Task, span: Span, warm_up: int) -> tuple[Mapping[str, Any], int]:
    """Return the initial estimate of a window by name, and the number of its first measurement."""
    own = {name: values[span.episode] for name, values in recording.initial.items()}
    log_format = find_companion(task, LogFormat)
    if log_format is None or span.first <= warm_up:
        return own, 0
    first = span.first - warm_up
    available = recording.measurements.get("available")
    # A track starts from measurements: the window begins earlier where its first measurements are missing.
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
    """Pad values to a length by repeating the last measurement."""
    missing = length - len(values)
    return values if missing == 0 else numpy.concatenate([values, numpy.repeat(values[-1:], missing, axis=0)])


def _update(
    task: Task, names: tuple[str, ...], apply: Apply, values: Array, measurement: Any, memory: Any
) -> tuple[Any, Array]:
    """Return an estimator's memory after a measurement, and its log-likelihood ``(N,)``, for parameters
    ``(P, N)``.
    """
    own = apply({name: values[i] for i, name in enumerate(names)})[1](task)
    return _step(as_filter(task, own), measurement, memory)


def _step(filter: Filter[Any, Any, Any], measurement: Any, state: Any) -> tuple[Any, Array]:
    received = filter.task.world.mask_missing(measurement)
    after = filter.step(state, FilterInput(received))
    return after, filter.records(after, received).get("log_likelihood")


class WindowLikelihood:
    """Function from an estimator's parameters to the log-likelihood of a recording, for many candidates at once.

    Args:
        task: task on NumPy arrays, without a recording.
        windows: windows of a recording.
        start: values of the parameters with a finite likelihood, by name.
        apply: function from parameters to the task's keywords and the estimator's maker.
        in_lanes: whether every parameter can be an array ``(N,)``; otherwise candidates run one after another.

    Raises:
        ValueError: if the estimator returns no log-likelihood of measurements, or none counts.
    """

    def __init__(
        self, task: Task, windows: Windows, start: Mapping[str, float], apply: Apply, in_lanes: bool = True
    ) -> None:
        self.task = task
        self.apply = apply
        self.in_lanes = in_lanes
        self.names: tuple[str, ...] = tuple(start)
        self._start = numpy.array([[value] for value in start.values()], dtype=float)
        self._compiled: CompiledFunction | None = None
        if in_lanes and AVAILABLE:
            graph = Graph()
            with namespace.tracing(graph):
                traced = type(task)(task.parameters, namespace)
            update = functools.partial(_update, traced, self.names, apply)
            self._compiled = CompiledFunction(update, graph, unchanged=0)
        self._take(windows)

    def _take(self, windows: Windows) -> None:
        self._counts = windows.counts
        self.windows = windows
        known = numpy.concatenate([~numpy.isnan(found[:, :, 0]) for found in self._stretches(self._start)])
        if not known.any():
            raise ValueError(
                "the estimator returns no log-likelihood of the measurements: return it from update"
            )
        self._counts = windows.counts & known
        self.count: int = int(self._counts.sum())
        if not self.count:
            raise ValueError("the recording has no measurement that counts")

    def on(self, windows: Windows) -> "WindowLikelihood":
        """Return the same likelihood function of other windows, without compiling it again."""
        other = copy.copy(self)
        other._take(windows)
        return other

    def __call__(self, values: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood of all measurements that count for parameters ``(P, C)``, nats, ``(C,)``;
        -inf if not finite.
        """
        if not self.in_lanes and values.shape[1] > 1:
            return numpy.concatenate([self(values[:, [i]]) for i in range(values.shape[1])])
        total, first = numpy.zeros(values.shape[1]), 0
        for found in self._stretches(values):
            counts = self._counts[first : first + len(found), :, None]
            total = total + numpy.where(counts, found, 0.0).sum(axis=(0, 1))
            first += len(found)
        return numpy.where(numpy.isfinite(total), total, -numpy.inf)

    def gradient(
        self, values: numpy.ndarray, step: float = 1e-4, of: Sequence[int] | numpy.ndarray | None = None
    ) -> tuple[float, numpy.ndarray]:
        """Return the log-likelihood of a candidate, and its gradient by central differences, from one run.

        Args:
            values: parameters, ``(P,)``.
            step: step of every parameter; the rounding error is 1e-12 of the log-likelihood over the step.
            of: indices of the parameters in the gradient; default: all.
        """
        moves = step * numpy.eye(len(values))[:, slice(None) if of is None else of]
        found = self(
            numpy.concatenate([values[:, None], values[:, None] + moves, values[:, None] - moves], axis=1)
        )
        count = moves.shape[1]
        return float(found[0]), (found[1 : 1 + count] - found[1 + count :]) / (2.0 * step)

    def _stretches(self, values: numpy.ndarray) -> Iterator[numpy.ndarray]:
        """Yield log-likelihoods of successive stretches of measurements, ``(rows, W, C)``."""
        count, W = values.shape[1], self._counts.shape[1]
        width = round_up_lanes(count * W)
        given = numpy.ascontiguousarray(values[:, numpy.minimum(numpy.arange(width) // W, count - 1)])
        rows = max(STRETCH_NUMBERS // width, 1)
        memory: Any = None
        for first in range(0, len(self._counts), rows):
            initial, measurements = self._tile_windows(count, first, rows)
            with numpy.errstate(all="ignore"):
                found, memory = self._run(given, initial, measurements, memory)
            yield numpy.moveaxis(found[:, : count * W].reshape(len(found), count, W), 1, 2)

    def _run(
        self, values: numpy.ndarray, initial: Any, measurements: Any, memory: Any
    ) -> tuple[numpy.ndarray, Any]:
        """Run all lanes through some measurements; return log-likelihoods ``(rows, lanes)`` and memory (None:
        from ``initial``).
        """
        found = numpy.empty((len(leaves(measurements)[0]), initial.mean.shape[-1]))
        given = values if self.in_lanes else values[:, 0]
        own = as_filter(
            self.task, self.apply({name: given[i] for i, name in enumerate(self.names)})[1](self.task)
        )
        memory = own.start(initial) if memory is None else memory
        if self._compiled is not None:
            try:
                return found, self._run_compiled(self._compiled, values, measurements, memory, found)
            except NotTraceable as error:
                warn_not_compiled(type(own).__name__, error)
                self._compiled = None
        for k in range(len(found)):
            memory, log_likelihood = _step(own, map_arrays(lambda array: array[k], measurements), memory)  # noqa: B023
            found[k] = numpy.nan if log_likelihood is None else log_likelihood
        return found, memory

    def _run_compiled(
        self,
        function: CompiledFunction,
        values: numpy.ndarray,
        measurements: Any,
        memory: Any,
        found: numpy.ndarray,
    ) -> Any:
        """Run all lanes in compiled code; write log-likelihoods to ``found`` and return the memory."""
        program = function.specialise(values, map_arrays(lambda array: array[0], measurements), memory)
        lanes, inner = found.shape[1], len(program.outputs) - 1
        memories = [[empty_lanes(leaf.shape, lanes) for leaf in program.outputs[:inner]] for _ in range(2)]
        for place, array in zip(memories[0], leaves(memory), strict=True):
            place[...] = array
        arrays = leaves(measurements)
        first = [array[0] for array in arrays]
        calls = [
            program.bound([values, *first, *before], [*after, found[0]])
            for before, after in (memories, memories[::-1])
        ]
        last = len(calls[0].arrays) - 1
        moving = [
            moving_array(call, place, series)
            for call in calls
            for place, series in (*enumerate(arrays, 1), (last, found))
        ]
        CallSequence(calls[:1], calls[1:], moving, len(found)).run_once(lanes)
        after = iter(memories[len(found) % 2])
        return map_arrays(lambda array: next(after).astype(array.dtype), memory)

    def _tile_windows(self, count: int, first: int, rows: int) -> tuple[Any, Any]:
        """Repeat initial estimates and a stretch of measurements for each candidate, ``(..., lanes)``."""
        tiles = self.windows.tiles
        if count in tiles:
            return tiles[count]
        windows = numpy.arange(round_up_lanes(count * self._counts.shape[1])) % self._counts.shape[1]

        def tile(array: numpy.ndarray) -> numpy.ndarray:
            return numpy.ascontiguousarray(array[..., windows])

        part = map_arrays(lambda array: tile(array[first : first + rows]), self.windows.measurements)
        tiled = map_arrays(tile, self.windows.initial), part
        if rows >= len(self._counts):  # all of them: stored for the next call
            tiles.clear()
            tiles[count] = tiled
        return tiled
