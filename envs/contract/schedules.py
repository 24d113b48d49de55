"""When something holds: windows of time, and values that step."""

from types import ModuleType
from typing import NamedTuple

from .observation import Array


class Steps(NamedTuple):
    """A signal that is constant between its steps."""

    values: Array
    """At the start and from each step on, ``(J + 1, ..., N)``."""
    times: Array
    """Of the steps, ascending, ``(J, N)``: numbers of measurements, or s."""

    def at(self, time: Array, xp: ModuleType) -> Array:
        """Value at a time, ``(..., N)``."""
        value = self.values[0]
        for i in range(self.times.shape[0]):
            value = xp.where(time >= self.times[i], self.values[i + 1], value)
        return value


def within(time: Array, window: Array) -> Array:
    """Whether a time lies in a window: not before its first row, but before its second one, ``(N,)``."""
    return (time >= window[0]) & (time < window[1])
