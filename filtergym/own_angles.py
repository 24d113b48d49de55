"""Angles of a user's state-space model: declared ones, and undeclared ones that jump by whole turns."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy

from .compiler.vector_functions import VectorFunction
from .envs.contract.parameters import quote_shortened
from .envs.linear.equations import StateSpaceModel
from .envs.linear.sensors import Channel
from .filters.angles import PERIODS

STEPS = ((0.01, 1001), (1.0, 1001))
"""Steps, and their number, by which a component of the state is moved to find jumps: 10 rad and 1,000 degrees."""
EXACT = 1e-3
"""Share of a turn by which a jump may differ from one."""
HALVINGS = 30
"""Halvings of the distance over which a jump is confirmed."""


def find_periods(
    angles: Any, names: Sequence[str], places: Sequence[int | None], channels: Sequence[Channel]
) -> dict[int, float]:
    """Return the period of each state component that is an angle, declared or measured as one, by its index.

    ``places`` are the components that the numbers of a measurement measure, or None.

    Raises:
        ValueError: for an unknown component or unit.
    """
    if not isinstance(angles, Mapping):
        raise ValueError(
            f"angles must be units by names, such as {{'{names[0]}': 'rad'}}, got {quote_shortened(angles)}"
        )
    for name, unit in angles.items():
        if name not in names:
            raise ValueError(
                f"angles names {quote_shortened(name)}, and the components are {', '.join(names)}"
            )
        if unit not in PERIODS:
            raise ValueError(
                f"the unit of the angle {name!r} must be 'rad' or 'deg', got {quote_shortened(unit)}"
            )
    of_rows = {row: one.period for one in channels if one.period is not None for row in one.numbers}
    measured = {
        place: of_rows[row] for row, place in enumerate(places) if place is not None and row in of_rows
    }
    return {**measured, **{names.index(name): PERIODS[unit] for name, unit in angles.items()}}


def warn_of_turns(
    model: StateSpaceModel,
    typical: numpy.ndarray,
    components: Mapping[str, bool],
    channels: Sequence[Channel],
) -> None:
    """Warn of components and sensors whose function jumps by a whole turn and that are not declared angles.

    Args:
        model: traced equations.
        typical: a typical state, then the interval and the inputs that the functions take, ``(n + 1 + p,)``.
        components: whether each component is declared an angle, by its name.
        channels: the sensors.
    """
    n, inputs = len(components), typical[len(components) + 1 :]
    of_motion = typical if model.timed else numpy.concatenate([typical[:n], inputs])
    jumping = _jumping_rows(model.f, of_motion[: n + model.f.given], n)
    for row, (name, declared) in enumerate(components.items()):
        if row in jumping and not declared:
            unit = jumping[row]
            _warn(
                f"f takes whole turns off {name}, which is no declared angle: write angles={{{name!r}: {unit!r}}}"
            )
    jumping = _jumping_rows(model.h, numpy.concatenate([typical[:n], inputs])[: n + model.h.given], n)
    for channel in channels:
        found = next((jumping[row] for row in channel.numbers if row in jumping), None)
        if found is not None and channel.period is None:
            where = f"the sensor {channel.name!r}" if channel.name else "h"
            _warn(
                f"{where} measures an angle that jumps by a turn: declare it by Sensor(..., wraps={found!r})"
            )


def _warn(text: str) -> None:
    warnings.warn(text, UserWarning, stacklevel=4)


def _jumping_rows(function: VectorFunction, given: numpy.ndarray, n: int) -> dict[int, str]:
    """Return the unit, "rad" or "deg", of each row of a function that jumps by a whole turn."""
    found: dict[int, str] = {}
    for place in range(n):
        for step, count in STEPS:
            points = given[:, None] + numpy.zeros((1, count))
            points[place] += step * (numpy.arange(count) - count // 2)
            with numpy.errstate(all="ignore"):
                change = numpy.diff(function.value(points, numpy), axis=1)
                usual = 0.5 * (change[:, :-2] + change[:, 2:])
                jump = numpy.abs(change[:, 1:-1] - usual)
            for unit, period in PERIODS.items():
                near = numpy.abs(jump - period) < EXACT * period
                for row in numpy.flatnonzero(near.any(axis=1)).tolist():
                    at = int(numpy.argmax(near[row])) + 1
                    if _jumps_by(function, row, points[:, at], points[:, at + 1], period):
                        found[row] = unit
    return found


def _jumps_by(
    function: VectorFunction, row: int, low: numpy.ndarray, high: numpy.ndarray, period: float
) -> bool:
    """Return whether a row of a function jumps by ``period`` between two points ``(n,)``, found by bisection."""
    for _ in range(HALVINGS):
        points = numpy.stack([low, 0.5 * (low + high), high], axis=1)
        with numpy.errstate(all="ignore"):
            first, second = numpy.abs(numpy.diff(function.value(points, numpy)[row]))
        low, high = (points[:, 0], points[:, 1]) if first > second else (points[:, 1], points[:, 2])
    return bool(abs(max(first, second) - period) < EXACT * period)
