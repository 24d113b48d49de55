"""The sensors of a user's state-space model, checked and stacked."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy

from .envs.contract.log_format import RECORDING, TIME, TRUTH
from .envs.contract.parameters import quote_shortened
from .envs.linear.sensors import Channel, Sensor
from .filters.angles import PERIODS
from .own_equations import Function, NoiseBlock, check_array, further_arguments, trace_measurement

RESERVED = (RECORDING, "values", "available")
"""Names that have another meaning in a table or a measurement."""
NOISES = ("process", "measurement")
"""Names of the other noises, which no sensor can have."""


def replace_sensors(sensors: Mapping[str, Sensor] | None, replacements: Any) -> dict[str, Sensor]:
    """Return sensors by name with some replaced; None in place of ``sensors`` allows any name.

    Raises:
        ValueError: for an object that is no sensor, or an unknown name.
    """
    if not isinstance(replacements, Mapping) or not all(
        isinstance(one, Sensor) for one in replacements.values()
    ):
        raise ValueError(
            f"sensors must be a mapping from names to Sensor, got {quote_shortened(replacements)}"
        )
    if {*replacements} & {*NOISES}:
        raise ValueError(
            f"sensors cannot be called {' or '.join(NOISES)}, which are the names of other noises"
        )
    if sensors is not None and not {*replacements} <= {*sensors}:
        unknown = next(name for name in replacements if name not in sensors)
        raise ValueError(f"sensors are {', '.join(sensors) or 'not named'}, got {unknown!r}")
    return {**(sensors or {}), **replacements}


def stack_sensors(sensors: Mapping[str, Sensor], size: int, inputs: int) -> tuple[Function, list[NoiseBlock]]:
    """Return the stacked measurement function h of all sensors, and the noise block of each.

    Raises:
        ValueError: for sensors that do not fit a state of ``size`` numbers and ``inputs`` inputs.
    """
    R, traced = [], []
    for name, one in sensors.items():
        traced.append(trace_measurement(f"h of the sensor {name!r}", one.h, size, inputs))
        R.append(NoiseBlock(f"R of the sensor {name!r}", one.R, traced[-1].size))
    matrices = [one.matrix for one in traced if one.matrix is not None and not numpy.any(one.offset)]
    if len(matrices) == len(traced):
        return numpy.concatenate(matrices), R
    if any(one.given for one in traced):
        return lambda x, u: [number for one in sensors.values() for number in _numbers(one.h, x, u)], R
    return lambda x: [number for one in sensors.values() for number in _numbers(one.h, x, None)], R


def _numbers(h: Function, x: Any, u: Any) -> Any:
    if not callable(h):
        return check_array("h", h, (None, len(x))) @ x
    return h(x, u) if further_arguments(h) else h(x)


def find_channels(
    sensors: Mapping[str, Sensor], counts: Sequence[int], interval: float
) -> tuple[Channel, ...]:
    """Return a :class:`Channel` for each sensor: its places in the measurement, period, availability and gate.

    Raises:
        ValueError: for a sensor whose interval is shorter than ``interval``.
    """
    if not sensors:
        return (Channel("values", 0, counts[0]),)
    channels, first = [], 0
    for (name, one), count in zip(sensors.items(), counts, strict=True):
        if one.interval is not None and one.interval < interval * (1.0 - 1e-9):
            raise ValueError(
                f"the sensor {name!r} is due every {one.interval:g} s, and measurements are {interval:g} s apart: set "
                "sampling_interval to the shortest of all"
            )
        period = None if one.wraps is None else PERIODS[one.wraps]
        channels.append(Channel(name, first, count, one.interval, one.availability, one.gate, period))
        first += count
    return tuple(channels)


def sensor_columns(sensors: Mapping[str, Sensor], channels: Sequence[Channel]) -> dict[str, str]:
    """Return the unit of each measured number by its column's name; "" where the sensor states none.

    Raises:
        ValueError: for names or units that do not fit.
    """
    columns: dict[str, str] = {}
    for channel in channels:
        one, count = sensors[channel.name], channel.size
        parts = tuple(one.names) or tuple(str(j + 1) for j in range(count))
        units = tuple(one.units) or (one.wraps or "",) * count
        if len(parts) != count or len(units) != count:
            raise ValueError(
                f"names and units of the sensor {channel.name!r} must be {count} each, got {parts!r} and {units!r}"
            )
        named = (channel.name,) if count == 1 else tuple(f"{channel.name}_{part}" for part in parts)
        columns.update(zip(named, units, strict=True))
    return columns


def check_columns(names: Sequence[str], count: int, inputs: Iterable[str]) -> None:
    """Raise ValueError unless ``names`` are ``count`` distinct columns that no input, time or truth has."""
    lower = [str(name).lower() for name in (*names, *inputs)]
    if len(names) != count or len({*lower}) != len(lower) or {*lower} & {*TIME, *RESERVED, ""}:
        raise ValueError(
            f"measured must be {count} different names, none of them a time or an input, got {names!r}; names may not "
            f"be {', '.join(RESERVED)} either"
        )
    if any(name.startswith(TRUTH) for name in lower):
        raise ValueError(f"names of measured numbers must not begin with {TRUTH}, got {names!r}")
