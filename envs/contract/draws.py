"""The random quantities of an episode: named draws from uniform random numbers.

A world draws its quantities in a fixed order. A first pass without random numbers counts how many numbers that takes
(:meth:`Draws.counting`). Each draw is stored by name, for the context of the episode. It may apply within a window of
time, or change in steps: :func:`is_within`, :class:`StepSignal`.
"""

import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import NamedTuple

from .observation import Array


class Draws:
    """Random quantities of episodes, drawn by name one after another from uniform numbers on [0, 1).

    Every method takes the name of the quantity and, with ``count``, draws ``(count, N)`` of it in place of
    ``(N,)``.

    Args:
        uniforms: ``(rows, N)``.
        xp: array namespace.

    Attributes:
        drawn: the draws, by name.
    """

    def __init__(self, uniforms: Array, xp: ModuleType) -> None:
        self.xp = xp
        self.used: int = 0
        self.drawn: dict[str, Array] = {}
        self._uniforms = uniforms
        self._average: Array = None

    @classmethod
    def counting(cls, average: Array, xp: ModuleType) -> "Draws":
        """Return draws that only count the random numbers used, in ``used``; every number is one half."""
        draws = cls(average, xp)
        draws._average = average
        return draws

    def _rows(self, count: int | None) -> Array:
        first = self.used
        self.used += 1 if count is None else count
        if self._average is not None:
            return (
                self._average[0] if count is None else self.xp.concat([self._average] * max(count, 1))[:count]
            )
        return self._uniforms[first] if count is None else self._uniforms[first : self.used]

    def _keep(self, name: str, values: Array) -> Array:
        if name in self.drawn:
            raise ValueError(f"{name!r} is drawn twice")
        self.drawn[name] = values
        return values

    def unit(self, name: str, count: int | None = None) -> Array:
        """Draw a quantity that is uniformly distributed on [0, 1), ``(N,)`` or ``(count, N)``."""
        return self._keep(name, self._rows(count))

    def uniform(self, name: str, limits: Sequence[float], count: int | None = None) -> Array:
        """Draw a quantity that is uniformly distributed between two limits, ``(N,)`` or ``(count, N)``."""
        low, high = limits
        return self._keep(name, low + (high - low) * self._rows(count))

    def log_uniform(self, name: str, limits: Sequence[float], count: int | None = None) -> Array:
        """Draw a quantity with uniformly distributed logarithm between two limits, ``(N,)`` or ``(count, N)``."""
        low, high = limits
        return self._keep(name, low * self.xp.exp(math.log(high / low) * self._rows(count)))

    def integer(self, name: str, limits: Sequence[int], count: int | None = None) -> Array:
        """Draw equally probable integers from the first to the last limit, floats ``(N,)`` or ``(count, N)``."""
        first, last = limits
        return self._keep(name, first + self.xp.floor((last - first + 1) * self._rows(count)))

    def event(self, name: str, probability: float, count: int | None = None) -> Array:
        """Draw booleans that are true with a probability, ``(N,)`` or ``(count, N)``."""
        return self._keep(name, self._rows(count) < probability)

    def category(self, name: str, thresholds: Sequence[Array]) -> Array:
        """Draw an integer index ``(N,)`` with the given cumulative probabilities.

        ``thresholds`` are the cumulative probabilities but the last, numbers or ``(N,)`` each.
        """
        return self._keep(name, category(self._rows(None), thresholds, self.xp))


def draw_between(draw: Callable[..., Array], name: str, limits: tuple[float, float]) -> Array:
    """Draw a quantity between two limits; equal limits are returned without using a random number."""
    return limits[0] if limits[0] == limits[1] else draw(name, limits)


def category(uniform: Array, thresholds: Sequence[Array], xp: ModuleType) -> Array:
    """Return the integer index ``(N,)`` of the interval between thresholds that contains a uniform number."""
    index = xp.zeros_like(uniform, dtype=xp.int64)
    for threshold in thresholds:
        index = index + xp.astype(uniform >= threshold, xp.int64)
    return index


class StepSignal(NamedTuple):
    """A piecewise constant signal."""

    values: Array
    """Values at the start and from each step on, ``(J + 1, ..., N)``."""
    times: Array
    """Times of the steps, ascending, ``(J, N)``: numbers of measurements, or s."""

    def at(self, time: Array, xp: ModuleType) -> Array:
        """Return the value of the signal at a time, ``(..., N)``."""
        value = self.values[0]
        for i in range(self.times.shape[0]):
            value = xp.where(time >= self.times[i], self.values[i + 1], value)
        return value


def is_within(time: Array, window: Array) -> Array:
    """Return booleans ``(N,)``: whether a time lies in a window ``[start, end)``, the rows of ``window``."""
    return (time >= window[0]) & (time < window[1])
