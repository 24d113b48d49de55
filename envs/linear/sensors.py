"""Named sensors of a state-space model: their measurements, rates and faults.

A measurement contains the numbers of all sensors, one after the other, and which of them were received. Filters update
with simultaneous sensors jointly: their noises are independent, so the order would matter only to linearisation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy

from ...filters.angles import PERIODS
from ..contract.causes import Cause, Moment
from ..contract.draws import Draws
from ..contract.observation import Array
from ..contract.parameters import ParameterLimits, check, freeze
from .parameters import StateSpaceParameters

LIMITS: dict[str, tuple[Any, ParameterLimits]] = {
    "interval": (float | None, ParameterLimits(above=0.0)),
    "availability": (float, ParameterLimits(above=0.0, at_most=1.0)),
    "gate": (float | None, ParameterLimits(above=0.0)),
    "wraps": (str | None, ParameterLimits(choices=tuple(PERIODS))),
}
"""Types and limits of the fields of a sensor."""
EARLY = 1e-6
"""Share of a sensor's interval by which it may be due early: sums of intervals are rounded."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """Sensor of a state-space model: its equation, noise, rate, availability and gate.

    Raises:
        ValueError: if a field is outside its limits.
    """

    h: Any
    """Measurement function: from the state ``(n,)`` to a list of m numbers, or a matrix ``(m, n)``."""
    R: Any
    """Covariance of the noise, ``(m, m)``, or the variance of a sensor with one number; or a function that returns
    either, with any of the arguments state, ``dt`` and ``u``: ``R(x)``, ``R(u)``, ``R(x, dt, u)``."""
    interval: float | None = None
    """Time between its measurements in a simulation, s: the sensor measures at the first measurement at which it is
    due. None: at every measurement."""
    availability: float = 1.0
    """Probability that a measurement which is due is received."""
    gate: float | None = None
    """Mahalanobis distance of an innovation from zero beyond which no filter updates with the measurement; None: no
    gate. The likelihood includes the measurement in any case."""
    wraps: str | None = None
    """Unit of a sensor that measures angles, ``"rad"`` or ``"deg"``: innovations are between minus and plus half a
    turn."""
    names: Sequence[str] = ()
    """Names of its m numbers, columns of a table ``SENSOR_NAME``; default: 1, 2 and so on. A single number has the name
    of the sensor."""
    units: Sequence[str] = ()
    """Units of its numbers; default: that of the measured component, or of the angle."""

    def __post_init__(self) -> None:
        for name, (hint, limits) in LIMITS.items():
            check(f"{name} of a sensor", freeze(getattr(self, name)), hint, limits)


class Channel(NamedTuple):
    """Indices of a sensor's numbers in a measurement, with its rate, availability and gate."""

    name: str
    first: int
    size: int
    interval: float | None = None
    availability: float = 1.0
    gate: float | None = None
    period: float | None = None
    """Period of its numbers, where they are angles."""

    @property
    def places(self) -> slice:
        """Slice of the sensor's numbers in a measurement."""
        return slice(self.first, self.first + self.size)

    @property
    def numbers(self) -> range:
        """Indices of the sensor's numbers in a measurement."""
        return range(self.first, self.first + self.size)

    def is_received(self, available: Array) -> Array:
        """Return whether any number of the sensor was received, booleans ``(N,)``, from ``available``, ``(m, N)``."""
        found = available[self.first] > 0.0
        for place in self.numbers[1:]:
            found = found | (available[place] > 0.0)
        return found


def missing_value_causes(channels: Sequence[Channel]) -> tuple[Cause, ...]:
    """Return one cause of cost for each of several sensors: it gives no value at a measurement."""

    def cause(channel: Channel) -> Cause:
        def holds(moment: Moment) -> Array:
            return ~channel.is_received(moment.measurement.available)

        return Cause(f"no {channel.name}", f"where {channel.name} gives no value", holds)

    return tuple(map(cause, channels))


class SensorStates(NamedTuple):
    """State of the simulated sensors: time since the last value, gaps, offset."""

    waited: Array | None = None
    """Time since each sensor with an interval was due, s, ``(sensors, N)``."""
    silent: Array | None = None
    """1 in a gap of a sensor, else 0, ``(sensors, N)``."""
    bias: Array | None = None
    """Constant error, ``(m, N)``."""


class Receptions:
    """Simulation of which sensor values arrive (rates, gaps, losses), and of one sensor's offset.

    Args:
        deviations: standard deviations of the noise of the m numbers, ``(m,)``.

    Attributes:
        row_uniforms: number of uniform numbers at each measurement.
    """

    def __init__(
        self,
        parameters: StateSpaceParameters,
        xp: ModuleType,
        channels: Sequence[Channel],
        deviations: numpy.ndarray,
    ) -> None:
        self.parameters = parameters
        self.xp = xp
        self.channels = channels
        self.deviations = deviations
        self.due: list[Channel] = [channel for channel in self.channels if channel.interval is not None]
        self.lossy: list[Channel] = [channel for channel in self.channels if channel.availability < 1.0]
        self.has_gaps: bool = self.parameters.gaps > 0.0
        self.row_uniforms: int = len(self.lossy) + len(self.channels) * self.has_gaps

    def begin(self, draws: Draws, zero: Array) -> SensorStates | None:
        """Draw a sensor's offset; return the sensors' state at the start, None where sensors have no state."""
        states = SensorStates(
            self.xp.stack([zero] * len(self.due)) if self.due else None,
            self.xp.stack([zero] * len(self.channels)) if self.has_gaps else None,
            self._bias(draws, zero) if self.parameters.bias > 0.0 else None,
        )
        return None if all(part is None for part in states) else states

    def _bias(self, draws: Draws, zero: Array) -> Array:
        """Draw an offset of one sensor, up or down; return the constant errors of all numbers, ``(m, N)``."""
        biased = draws.integer("biased_sensor", (0, len(self.channels) - 1))
        sign = 2.0 * draws.integer("sign", (0, 1)) - 1.0
        size, rows = (self.parameters.bias * self.deviations).tolist(), []
        for number, channel in enumerate(self.channels):
            one = self.xp.where(biased == float(number), sign, zero)
            rows += [size[place] * one for place in channel.numbers]
        return self.xp.stack(rows)

    def advance(
        self, states: SensorStates | None, interval: Array, uniforms: Array
    ) -> tuple[SensorStates | None, Array | None]:
        """Return the sensors' state at a measurement, and 1 for each number received, else 0, ``(m, N)``; None: all."""
        xp, here = self.xp, {channel.name: 1.0 + 0.0 * interval for channel in self.channels}
        if not (self.due or self.lossy or self.has_gaps):
            return states, None
        states = states or SensorStates()
        waited = []
        for place, channel in enumerate(self.due):
            assert states.waited is not None
            assert channel.interval is not None
            total = states.waited[place] + interval
            times = xp.floor(total / channel.interval + EARLY)
            here[channel.name] = xp.where(times > 0.0, here[channel.name], 0.0)
            waited.append(total - channel.interval * times)
        for place, channel in enumerate(self.lossy):
            here[channel.name] = xp.where(uniforms[place] < channel.availability, here[channel.name], 0.0)
        silent = []
        for place, channel in enumerate(self.channels if self.has_gaps else ()):
            assert states.silent is not None
            uniform = uniforms[len(self.lossy) + place]
            begins = xp.where(uniform < self.parameters.gaps, 1.0, 0.0)
            goes_on = xp.where(uniform * self.parameters.gap_length >= 1.0, 1.0, 0.0)
            silent.append(xp.where(states.silent[place] > 0.0, goes_on, begins))
            here[channel.name] = here[channel.name] * (1.0 - silent[-1])
        states = states._replace(
            waited=xp.stack(waited) if waited else None, silent=xp.stack(silent) if silent else None
        )
        rows = [here[channel.name] for channel in self.channels for _ in range(channel.size)]
        return (None if all(part is None for part in states) else states), xp.stack(rows)
