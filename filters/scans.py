"""A track as arrays of all its scans, and recursions over it, some scans after the others.

A long recursion on NumPy's arrays is compiled: one native call takes many scans, without going back to Python between
them. What lies in memory beside the given track and the answer does not grow with the track.

Shapes: a time axis of K scans stands before the batch, ``(..., K, N)``.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar, overload

import numpy

from ..compiler.functions import CompiledFunction, leaves, round_up_lanes
from ..compiler.namespace import NotTraceable
from ..compiler.native import AVAILABLE
from ..compiler.program import Graph
from ..compiler.sequence import CallSequence, moving_array
from .array_namespace import Array, namespace

Carried = TypeVar("Carried", bound=tuple[Any, ...])
Step = Callable[..., Any]
"""Of what is given of a scan and what is carried from the one before, in the order of the recursion; it knows no time
axis."""
LEAST = 64
"""Scans from which on a recursion is compiled; a shorter one ends before its step is traced."""
TOGETHER = 8192
"""Lanes times scans of a stretch: enough that a stretch costs little beside its numbers."""


class Scans(Sequence[Any]):
    """The scans of a track, each made when it is asked for.

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
    """Call a function that knows no time axis once for all scans.

    Args:
        function: of nested tuples of arrays ``(..., N)``, each episode for itself.
        *parts: the same with a time axis, ``(..., K, N)``.

    Returns:
        What it returns, with a time axis.
    """
    last = leaves(parts)[0].shape[-2:]
    found = function(*map_nested(_flatten_time, parts))
    return map_nested(lambda values: namespace(values).reshape(values, (*values.shape[:-1], *last)), found)


def by_stretches(function: Step, *parts: Any) -> Callable[[slice], Any]:
    """Return what calls :func:`over_time` for some scans of ``parts`` alone."""
    return lambda stretch: over_time(function, *(take_scans(part, stretch) for part in parts))


def map_nested(function: Callable[..., Array], *parts: Any) -> Any:
    """Apply a function to the arrays of nested tuples and dictionaries; None holds none."""
    first = parts[0]
    if first is None:
        return None
    if isinstance(first, dict):
        return {name: map_nested(function, *(part[name] for part in parts)) for name in first}
    if isinstance(first, tuple):
        answers = [map_nested(function, *each) for each in zip(*parts, strict=True)]
        return type(first)(*answers) if hasattr(first, "_fields") else tuple(answers)
    return function(*parts)


def _flatten_time(values: Array) -> Array:
    """Scans side by side in the batch."""
    return namespace(values).reshape(values, (*values.shape[:-2], values.shape[-2] * values.shape[-1]))


class Track(NamedTuple):
    """What a recursion is given, by stretches of scans."""

    scans: int
    """Of the recursion, K."""
    episodes: int
    """N."""
    given: Callable[[slice], Sequence[Any]]
    """Nested tuples of arrays ``(..., scans, N)``, whose scans ``step`` is given one by one."""


def recur(step: Step, track: Track, start: Carried, back: bool = False) -> Iterator[tuple[slice, Carried]]:
    """Run a recursion over a track.

    Args:
        step: of the recursion.
        track: what it is given.
        start: carried into the first step, nested tuples of arrays ``(..., N)``.
        back: whether it begins with the last scan.

    Yields:
        Stretches of scans in the order of the recursion, and what is carried out of each of their steps, with a time
        axis.
    """
    K, N, given = track
    compiled, width = _compiled(step, K, start), round_up_lanes(N)
    length = max(1, TOGETHER // width)
    firsts = range(0, K, length)
    for first in reversed(firsts) if back else firsts:
        stretch = slice(first, min(first + length, K))
        parts = given(stretch)
        if compiled is None:
            found = _run(step, parts, start, back)
        else:
            found = _run_compiled(compiled, parts, start, back)
        yield stretch, found
        edge = 0 if back else -1
        start = map_nested(lambda values, edge=edge: values[..., edge, :], found)


def backward(
    step: Step,
    track: Track,
    nothing_later: Callable[[slice], Carried],
    lag: int | None = None,
    keep: Callable[[Carried], Any] = lambda carried: carried,
) -> Any:
    """Run a recursion from the end of a track.

    Args:
        step: of the recursion.
        track: what is given of the first K - 1 scans.
        nothing_later: what is carried from some of K scans if nothing later is used.
        lag: how many later scans are used; default: all.
        keep: what is kept of that which is carried from some scans; each episode and scan for itself.

    Returns:
        What is kept of that which is carried from each of K scans.

    Raises:
        ValueError: for a negative lag.
    """
    if lag is not None and lag < 0:
        raise ValueError(f"a lag is a number of later scans, at least 0, got {lag}")
    last = track.scans
    end = nothing_later(slice(last, last + 1))
    found = [keep(end)]
    if lag is None or lag >= last:
        start = map_nested(lambda values: values[..., 0, :], end)
        found += [keep(carried) for _, carried in recur(step, track, start, True)]
    else:
        compiled = _compiled(step, last, end)
        length = max(1, lag, TOGETHER // track.episodes)
        for first in reversed(range(0, last, length)):
            found.append(keep(_lagged(compiled or step, track, nothing_later, lag, first, first + length)))
    return join(found[::-1])


def _lagged(
    step: Step, track: Track, nothing_later: Callable[[slice], Carried], lag: int, first: int, beyond: int
) -> Carried:
    """What is carried from the scans between two with a lag: all take one step together, ``lag`` times over."""
    last = min(beyond + lag - 1, track.scans)  # of the scans that these depend on
    begun = nothing_later(slice(first, last + 1))
    given = track.given(slice(first, last))
    carried, end = begun, take_scans(begun, slice(-1, None)) if last > first else begun
    for _ in range(lag):
        stepped = over_time(step, *given, map_nested(lambda values: values[..., 1:, :], carried))
        carried = join([stepped, end])
    return take_scans(carried, slice(0, min(beyond, track.scans) - first))


def repeat(part: Any, last: tuple[int, int]) -> Any:
    """Return nested tuples of arrays whose axes of one are those of all scans, or of the whole batch."""
    return map_nested(
        lambda values: namespace(values).broadcast_to(values, (*values.shape[:-2], *last)), part
    )


def _run(step: Step, parts: Sequence[Any], carried: Carried, back: bool) -> Carried:
    """Carry from scan to scan in Python."""
    found, count = [], leaves(tuple(parts))[0].shape[-2]
    for k in reversed(range(count)) if back else range(count):
        carried = step(*(map_nested(lambda values, k=k: values[..., k, :], part) for part in parts), carried)
        found.append(carried)
    stacked: Carried = stack_scans(found[::-1] if back else found)
    return stacked


_traced = functools.lru_cache(16)(lambda step: CompiledFunction(step, Graph(), unchanged=0))


def _compiled(step: Step, scans: int, carried: Any) -> CompiledFunction | None:
    """The step of a long recursion on NumPy's arrays, to be compiled; None of any other."""
    of_numpy = all(type(values) is numpy.ndarray for values in leaves(carried))
    if not AVAILABLE or scans < LEAST or not of_numpy:
        return None
    compiled: CompiledFunction = _traced(step)
    return compiled


def _run_compiled(compiled: CompiledFunction, parts: Sequence[Any], start: Carried, back: bool) -> Carried:
    """Carry from scan to scan in native code; in Python what cannot be traced."""
    first = [map_nested(lambda values: values[..., 0, :], part) for part in parts]
    try:
        special = compiled.specialise(*first, start)
    except NotTraceable:
        return _run(compiled.function, parts, start, back)
    N = leaves(start)[0].shape[-1]
    given = [_rows_of_scans(values, round_up_lanes(N)) for values in leaves(tuple(parts))]
    count, direction = len(given[0]), -1 if back else 1
    found = [
        numpy.empty((count + 1, *values.shape[:-1], round_up_lanes(N))) for values in leaves(start)
    ]
    for memory, values in zip(found, leaves(start), strict=True):
        memory[-1 if back else 0] = _rows_of_scans(values[..., None, :], memory.shape[-1])[0]
    inputs = [values[::direction] for values in given] + [memory[::direction][:-1] for memory in found]
    outputs = [memory[::direction][1:] for memory in found]
    arrays = inputs + outputs
    calls = [special.bound([a[0] for a in inputs], [a[0] for a in outputs]) for _ in range(2)]
    moving = [moving_array(call, place, values) for call in calls for place, values in enumerate(arrays)]
    CallSequence(calls[:1], calls[1:], moving).run(count, round_up_lanes(N))
    # Copies, without the lanes beyond.
    kept = iter((memory[:-1] if back else memory[1:])[..., :N].copy() for memory in found)
    carried: Carried = map_nested(lambda _: numpy.moveaxis(next(kept), 0, -2), start)
    return carried


def _rows_of_scans(values: Array, width: int) -> numpy.ndarray:
    """Arrays ``(..., K, N)`` as ``(K, ..., width)``, the last episode again in the lanes beyond."""
    rows = numpy.moveaxis(values, -2, 0)
    found = numpy.empty((*rows.shape[:-1], width))
    found[..., : rows.shape[-1]], found[..., rows.shape[-1] :] = rows, rows[..., -1:]
    return found
