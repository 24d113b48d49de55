"""A track as arrays of all its scans, and recursions over it, some scans after the others.

A long recursion on NumPy's arrays is compiled: one native call takes many scans, without going back to Python between
them. What lies in memory beside the given track and the answer does not grow with the track.

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
"""Function of the input of a scan and of the value carried from the next one, without a time axis."""
LEAST = 64
"""Scans from which on a recursion is compiled; a shorter one ends before its step is traced."""
TOGETHER = 8192
"""Lanes times scans of a stretch: enough that a stretch costs little beside its numbers."""


class Scans(Sequence[Any]):
    """Scans of a track, each computed on first use.

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
    """Put a time axis into nested tuples of arrays ``(..., N)``, one for each scan: ``(..., K, N)``."""
    if isinstance(scans, Scans):
        return map_nested(lambda values: numpy.moveaxis(values, 0, -2), scans.arrays)
    return map_nested(lambda *arrays: namespace(arrays[0]).stack(arrays, axis=-2), *scans)


def join(stretches: Sequence[Any]) -> Any:
    """Put nested tuples of arrays ``(..., scans, N)`` one after the other."""
    return map_nested(lambda *arrays: namespace(arrays[0]).concat(arrays, axis=-2), *stretches)


def take_scans(part: Any, scans: slice) -> Any:
    """Return some scans of nested tuples of arrays ``(..., K, N)``."""
    return map_nested(lambda values: values[..., scans, :], part)


def over_time(function: Step, *parts: Any) -> Any:
    """Call a function without a time axis once for all scans.

    Args:
        function: of nested tuples of arrays ``(..., N)``, each episode for itself.
        *parts: the same with a time axis, ``(..., K, N)``.

    Returns:
        Its result, with a time axis.
    """
    last = leaves(parts)[0].shape[-2:]
    found = function(*map_nested(_flatten_time, parts))
    return map_nested(lambda values: namespace(values).reshape(values, (*values.shape[:-1], *last)), found)


def by_stretches(function: Step, *parts: Any) -> Callable[[slice], Any]:
    """Return what calls :func:`over_time` for some scans of ``parts`` alone."""
    return lambda stretch: over_time(function, *(take_scans(part, stretch) for part in parts))


def _flatten_time(values: Array) -> Array:
    """Return the scans side by side in the batch."""
    return namespace(values).reshape(values, (*values.shape[:-2], values.shape[-2] * values.shape[-1]))


def repeat(part: Any, last: tuple[int, int]) -> Any:
    """Give nested tuples of arrays the last two axes, where they have axes of one."""
    return map_nested(
        lambda values: namespace(values).broadcast_to(values, (*values.shape[:-2], *last)), part
    )


# --- recursions


class Track(NamedTuple):
    """Input of a recursion, a stretch of scans after the other."""

    scans: int
    """K."""
    episodes: int
    """N."""
    given: Callable[[slice], Sequence[Any]]
    """Nested tuples of arrays ``(..., scans, N)`` of some scans, of which the step is given one by one."""


def backward(
    step: Step,
    track: Track,
    nothing_later: Callable[[slice], Carried],
    lag: int | None = None,
    keep: Callable[[Carried], Any] = lambda carried: carried,
) -> Any:
    """Run a recursion from the end of a track.

    Args:
        step: the same object in every call, since its compiled form is stored by it.
        track: input of the first K - 1 scans.
        nothing_later: value carried from some of K scans if no later measurement is used.
        lag: how many later scans are used; default: all.
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
    compiled = _compiled(step, end) if last >= LEAST else None
    carried, found = _scan(end, 0), [keep(end)]
    whole = lag is None or lag >= last
    length = max(1, TOGETHER // round_up_lanes(N)) if whole else max(lag or 1, TOGETHER // N)
    for first in reversed(range(0, last, length)):
        beyond = min(first + length, last)
        if whole:
            given = track.given(slice(first, beyond))
            some = _run(step, given, carried) if compiled is None else _run_compiled(compiled, given, carried)
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
    """Return the carried values of some scans with a lag: all take one step together, ``lag`` times over."""
    last = min(scans.stop - 1 + lag, track.scans)  # of the scans that these depend on
    given, carried = track.given(slice(scans.start, last)), nothing_later(slice(scans.start, last + 1))
    end = take_scans(carried, slice(-1, None))
    for _ in range(lag):
        carried = join([over_time(step, *given, take_scans(carried, slice(1, None))), end])
    return take_scans(carried, slice(0, scans.stop - scans.start))


def _run(step: Step, given: Sequence[Any], carried: Carried) -> Carried:
    """Carry from scan to scan in Python."""
    found = []
    for k in reversed(range(leaves(tuple(given))[0].shape[-2])):
        carried = step(*(_scan(part, k) for part in given), carried)
        found.append(carried)
    stacked: Carried = stack_scans(found[::-1])
    return stacked


_traced = functools.lru_cache(16)(lambda step: CompiledFunction(step, Graph(), unchanged=0))


def _compiled(step: Step, carried: Any) -> CompiledFunction | None:
    """Return the step on NumPy arrays, to be compiled; None for other arrays."""
    if not AVAILABLE or any(type(values) is not numpy.ndarray for values in leaves(carried)):
        return None
    compiled: CompiledFunction = _traced(step)
    return compiled


def _run_compiled(compiled: CompiledFunction, given: Sequence[Any], start: Carried) -> Carried:
    """Carry from scan to scan in native code."""
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
    """Return the arrays ``(..., K, N)`` as ``(K, ..., width)``, the last episode again in the lanes beyond."""
    rows = numpy.moveaxis(values, -2, 0)
    found = numpy.empty((*rows.shape[:-1], width))
    found[..., : rows.shape[-1]], found[..., rows.shape[-1] :] = rows, rows[..., -1:]
    return found
