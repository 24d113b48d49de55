"""Backward recursions over the scans of a track, compiled for NumPy arrays.

A long recursion on NumPy arrays is compiled: one native call processes many scans.

Shapes: a time axis of K scans stands before the batch, ``(..., K, N)``.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar, overload

import numpy

from ..compiler.functions import CompiledFunction, leaves, round_up_lanes
from ..compiler.native import AVAILABLE
from ..compiler.program import Graph
from ..compiler.sequence import CallSequence, moving_array
from .array_namespace import Array, map_nested, namespace

Carried = TypeVar("Carried", bound=tuple[Any, ...])
Step = Callable[..., Any]
"""Function from the input of a scan and the value carried from the next scan to the value of this scan, without a time
axis.
"""
LEAST = 64
"""Least number of scans for which a recursion is compiled; a shorter one takes less time than tracing."""
TOGETHER = 8192
"""Number of lanes times scans in one stretch, large enough that the overhead of a stretch is small."""


class Scans(Sequence[Any]):
    """Sequence of the scans of a track, each a view of nested arrays made on first use, ``(..., N)``.

    Args:
        arrays: nested tuples of arrays ``(K, ..., N)``.
    """

    def __init__(self, arrays: Any) -> None:
        self.arrays = arrays

    def __len__(self) -> int:
        return len(leaves(self.arrays)[0])

    @overload
    def __getitem__(self, place: int) -> Any: ...
    @overload
    def __getitem__(self, place: slice) -> "Scans": ...
    def __getitem__(self, place: int | slice) -> Any:
        if isinstance(place, slice):
            return Scans(map_nested(lambda values: values[place], self.arrays))
        if not -len(self) <= place < len(self):
            raise IndexError(f"scan {place} of {len(self)}")
        # Rows one after the other: by these matrix products round.
        return map_nested(lambda values: numpy.ascontiguousarray(values[place]), self.arrays)


def stack_scans(scans: Sequence[Any]) -> Any:
    """Stack the nested arrays ``(..., N)`` of each scan along a time axis, ``(..., K, N)``."""
    if isinstance(scans, Scans):
        return map_nested(lambda values: numpy.moveaxis(values, 0, -2), scans.arrays)
    return map_nested(lambda *arrays: namespace(arrays[0]).stack(arrays, axis=-2), *scans)


def join(stretches: Sequence[Any]) -> Any:
    """Concatenate nested arrays ``(..., scans, N)`` along the time axis."""
    return map_nested(lambda *arrays: namespace(arrays[0]).concat(arrays, axis=-2), *stretches)


def take_scans(part: Any, scans: slice) -> Any:
    """Return a slice of the scans of nested arrays ``(..., K, N)``."""
    return map_nested(lambda values: values[..., scans, :], part)


def over_time(function: Step, *parts: Any) -> Any:
    """Apply a function to all scans of a track in one call, with the scans in the batch axis.

    Args:
        function: function of nested arrays ``(..., N)`` that treats each episode separately.
        *parts: its arguments at K scans, ``(..., K, N)``.

    Returns:
        Its results, with a time axis.
    """
    last = leaves(parts)[0].shape[-2:]
    found = function(*map_nested(_flatten_time, parts))
    return map_nested(lambda values: namespace(values).reshape(values, (*values.shape[:-1], *last)), found)


def by_stretches(function: Step, *parts: Any) -> Callable[[slice], Any]:
    """Return a function of a slice of scans, which applies ``function`` to those scans of ``parts`` in one
    call.
    """
    return lambda stretch: over_time(function, *(take_scans(part, stretch) for part in parts))


def _flatten_time(values: Array) -> Array:
    """Return arrays ``(..., K, N)`` as ``(..., K N)``."""
    return namespace(values).reshape(values, (*values.shape[:-2], values.shape[-2] * values.shape[-1]))


def repeat(part: Any, last: tuple[int, int]) -> Any:
    """Broadcast the last two axes of nested arrays to the sizes ``last``."""
    return map_nested(
        lambda values: namespace(values).broadcast_to(values, (*values.shape[:-2], *last)), part
    )


# --- recursions


class Track(NamedTuple):
    """Input of a backward recursion over the scans of a track, given by a function of slices of the scans."""

    scans: int
    """Number of scans K."""
    episodes: int
    """Number of episodes N."""
    given: Callable[[slice], Sequence[Any]]
    """Function from a slice of the scans to their inputs, nested arrays ``(..., scans, N)``, the arguments of the
    step.
    """


def backward(
    step: Step,
    track: Track,
    nothing_later: Callable[[slice], Carried],
    lag: int | None = None,
    keep: Callable[[Carried], Any] = lambda carried: carried,
) -> Any:
    """Run a recursion from the last scan of a track to the first; return its values at all K scans.

    Args:
        step: step of the recursion; the same object in every call, since its compiled form is cached.
        track: input of the first K - 1 scans.
        nothing_later: function from a slice of the K scans to the carried value without later measurements.
        lag: number of later scans that each scan uses; default: all.
        keep: function that selects the stored part of the carried values, scan by scan.

    Returns:
        The stored part of the values carried from each of K scans.

    Raises:
        ValueError: for a negative lag.
    """
    if lag is not None and lag < 0:
        raise ValueError(f"a lag is a number of later scans, at least 0, got {lag}")
    last, N, _ = track
    end = nothing_later(slice(last, last + 1))
    compiled = _compile_step(step, end) if last >= LEAST else None
    carried, found = _scan(end, 0), [keep(end)]
    whole = lag is None or lag >= last
    length = max(1, TOGETHER // round_up_lanes(N)) if whole else max(lag or 1, TOGETHER // N)
    for first in reversed(range(0, last, length)):
        beyond = min(first + length, last)
        if whole:
            given = track.given(slice(first, beyond))
            some = (
                _run_in_python(step, given, carried)
                if compiled is None
                else _run_compiled(compiled, given, carried)
            )
            carried = _scan(some, 0)
        else:
            some = _run_lagged(compiled or step, track, nothing_later, lag or 0, slice(first, beyond))
        found.append(keep(some))
    return join(found[::-1])


def _scan(part: Any, place: int) -> Any:
    return map_nested(lambda values: values[..., place, :], part)


def _run_lagged(
    step: Step, track: Track, nothing_later: Callable[[slice], Carried], lag: int, scans: slice
) -> Carried:
    """Return carried values with a fixed lag, by ``lag`` steps in each of which all ``scans`` advance
    together.
    """
    last = min(scans.stop - 1 + lag, track.scans)  # of the scans that these depend on
    given, carried = track.given(slice(scans.start, last)), nothing_later(slice(scans.start, last + 1))
    end = take_scans(carried, slice(-1, None))
    for _ in range(lag):
        carried = join([over_time(step, *given, take_scans(carried, slice(1, None))), end])
    return take_scans(carried, slice(0, scans.stop - scans.start))


def _run_in_python(step: Step, given: Sequence[Any], carried: Carried) -> Carried:
    found = []
    for k in reversed(range(leaves(tuple(given))[0].shape[-2])):
        carried = step(*(_scan(part, k) for part in given), carried)
        found.append(carried)
    stacked: Carried = stack_scans(found[::-1])
    return stacked


_traced = functools.lru_cache(16)(lambda step: CompiledFunction(step, Graph(), unchanged=0))


def _compile_step(step: Step, carried: Any) -> CompiledFunction | None:
    """Return the compiled form of a step on NumPy arrays; None for other arrays."""
    if not AVAILABLE or any(type(values) is not numpy.ndarray for values in leaves(carried)):
        return None
    compiled: CompiledFunction = _traced(step)
    return compiled


def _run_compiled(compiled: CompiledFunction, given: Sequence[Any], start: Carried) -> Carried:
    """Return the carried values of some scans, from a loop in native code."""
    N = leaves(start)[0].shape[-1]
    width = round_up_lanes(N)
    special = compiled.specialise(*(_scan(part, 0) for part in given), start)
    rows = [_rows_of_scans(values, width) for values in leaves(tuple(given))]
    found = [numpy.empty((len(rows[0]) + 1, *values.shape[:-1], width)) for values in leaves(start)]
    for memory, values in zip(found, leaves(start), strict=True):
        memory[-1] = _rows_of_scans(values[..., None, :], width)[0]
    inputs = [values[::-1] for values in rows] + [memory[:0:-1] for memory in found]
    outputs = [memory[-2::-1] for memory in found]
    # Even and odd steps are the same one; each has a table, whose entries move with every step.
    calls = [special.bound([array[0] for array in inputs], [array[0] for array in outputs]) for _ in range(2)]
    arrays = enumerate(inputs + outputs)
    moving = [moving_array(call, place, array) for place, array in arrays for call in calls]
    CallSequence(calls[:1], calls[1:], moving, len(rows[0])).run_once(width)
    kept = iter(memory[:-1, ..., :N].copy() for memory in found)  # without the lanes beyond
    carried: Carried = map_nested(lambda _: numpy.moveaxis(next(kept), 0, -2), start)
    return carried


def _rows_of_scans(values: Array, width: int) -> numpy.ndarray:
    """Return arrays ``(..., K, N)`` as ``(K, ..., width)``, with the last episode repeated in further lanes."""
    rows = numpy.moveaxis(values, -2, 0)
    found = numpy.empty((*rows.shape[:-1], width))
    found[..., : rows.shape[-1]], found[..., rows.shape[-1] :] = rows, rows[..., -1:]
    return found
