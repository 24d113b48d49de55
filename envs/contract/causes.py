"""Causes of an estimate's cost: circumstances of a measurement that an author declares, such as a turn.

Several causes may be true at a measurement. Each is computed from a :class:`Moment`, and traced with the steps of the
task. A cause that cannot be computed, such as of a context that a recording does not contain, is false everywhere; an
evaluation omits it.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, NamedTuple

from .companions import find_companion
from .observation import Array

LARGE_ERROR = 4.0
"""Number of stated standard deviations beyond which the error of a reading is an outlier: one of 16,000 white
normal errors with the stated deviation."""


MOST_CAUSES = 50
"""Largest number of causes of a task; the true ones are encoded in one number."""
RESERVED = ("all", "start", "other")
"""Names that an evaluation gives to causes of its own."""


class Moment(NamedTuple):
    """State of N episodes at one measurement, from which causes are computed."""

    xp: ModuleType
    """Array namespace."""
    context: Mapping[str, Array]
    """Context that the world reports of the episode, see :meth:`.World.context`; none of a recording."""
    state: Array
    """True values of the task's components, ``(C, N)``; NaN where a recording does not contain them."""
    measurement: Any
    """The world's NamedTuple."""
    readings: Array | None
    """Readings of the components, ``(C, N)``, NaN where there is none; None where a measurement is of no component."""
    deviations: Array | None
    """Standard deviations that are stated for their errors, ``(C, N)``."""

    def has_context(self, *names: str) -> bool:
        """Return whether the context has a non-empty array under each of these names."""
        return all(name in self.context and 0 not in self.context[name].shape for name in names)


class Cause(NamedTuple):
    """A circumstance of a measurement, such as a turn, by which an evaluation splits the costs of estimates."""

    name: str
    """One word or a few, of the rows of a table: ``turn``."""
    phrase: str
    """Completion of the phrase "most of its cost falls", with its preposition: ``in turns``."""
    holds: Callable[[Moment], Array | None]
    """Function from a moment to booleans, ``(N,)``; None where the cause cannot be computed."""


def bins(
    name: str, unit: str, phrase: str, edges: tuple[float, ...], value: Callable[[Moment], Array | None]
) -> tuple[Cause, ...]:
    """Return one :class:`Cause` for each interval of a quantity: below the first edge, between edges, above the last.

    Args:
        name: of the quantity, such as ``range``.
        unit: of the edges.
        phrase: before the interval in words, such as ``at ranges``.
        edges: ascending.
        value: of the quantity in that unit, ``(N,)``; None where it is not known.
    """
    words = [f"below {edges[0]:g} {unit}"]
    words += [f"of {low:g} to {high:g} {unit}" for low, high in itertools.pairwise(edges)]
    words += [f"from {edges[-1]:g} {unit} on"]
    ends = itertools.pairwise([-math.inf, *edges, math.inf])
    return tuple(
        Cause(f"{name} {interval}", f"{phrase} {interval}", _is_between(low, high, value))
        for interval, (low, high) in zip(words, ends, strict=True)
    )


def _is_between(
    low: float, high: float, value: Callable[[Moment], Array | None]
) -> Callable[[Moment], Array | None]:
    def holds(moment: Moment) -> Array | None:
        found = value(moment)
        return None if found is None else (found >= low) & (found < high)

    return holds


def context_flag(name: str) -> Callable[[Moment], Array | None]:
    """Return a function from a :class:`Moment` to booleans ``(N,)``: whether this number of the context is positive."""

    def holds(moment: Moment) -> Array | None:
        return moment.context[name] > 0.0 if moment.has_context(name) else None

    return holds


def _is_missed(moment: Moment) -> Array | None:
    """Return booleans ``(N,)``: whether any part of the measurement is missing; None if parts cannot be missing."""
    available = getattr(moment.measurement, "available", None)
    if available is None:
        return None
    missing = available < 0.5
    axes = tuple(range(len(missing.shape) - 1))
    found: Array = moment.xp.any(missing, axis=axes) if axes else missing
    return found


def _is_outlier(moment: Moment) -> Array | None:
    """Return booleans ``(N,)``: whether a reading's error exceeds ``LARGE_ERROR`` stated standard deviations."""
    if moment.readings is None or moment.deviations is None:
        return None
    error = moment.xp.abs(moment.readings - moment.state)
    found: Array = moment.xp.any(error > LARGE_ERROR * moment.deviations, axis=0)
    return found


MISSED = Cause("missed", "where a measurement is missed", _is_missed)
OUTLIER = Cause("outlier", f"on outliers beyond {LARGE_ERROR:g} stated sigma", _is_outlier)


class Causes(NamedTuple):
    """Companion of a problem: the causes by which an evaluation splits the costs of estimates."""

    causes: tuple[Cause, ...] = (MISSED,)
    start: int = 10
    """Number of measurements that form the start of a track, which is a further cause."""

    @classmethod
    def of(cls, task: Any) -> "Causes":
        """Return the :class:`Causes` that a task declares; by default missed measurements alone."""
        return find_companion(task, cls) or cls()


def cause_number(causes: tuple[Cause, ...], moment: Moment) -> Array:
    """Encode the causes that are true at a moment as one number ``(N,)``: the sum of ``2 ** index`` over them."""
    xp, total = moment.xp, 0.0 * moment.state[0]
    total = xp.where(total == total, total, 0.0)  # the truth of a recording may be NaN
    for place, cause in enumerate(causes):
        is_true = cause.holds(moment)
        if is_true is not None:
            total = total + xp.where(is_true, 2.0**place, 0.0)
    return total
