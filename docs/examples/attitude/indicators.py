"""What tells a filter how far to trust which sensor: residuals of both vectors and their averages.

An average over the time constant tau is an exponential one, from the first measurement on the plain mean.
"""

import math
from typing import Any, NamedTuple

from filtergym.envs.contract.observation import LOG1P, SHARE, SIGNED_LOG, Array, Block
from filtergym.filters.array_namespace import namespace

from .quaternions import DEGREES, TINY, length, square, to_world
from .world import GRAVITY, Measurement

FAST, SLOW, REFERENCE = 0.3, 3.0, 20.0
"""Time constants, s: within a movement, over some movements, and of what an undisturbed field is compared with."""


class Indicators(NamedTuple):
    """Averages; ``(N,)`` where nothing else is said."""

    number: Array
    """Measurements so far."""
    tilt: Array
    """Fast average of the horizontal specific force over its length, ``(2, N)``."""
    slow_tilt: Array
    """Slow average of the same, ``(2, N)``."""
    tilt_square: Array
    """Fast average of the square."""
    excess_square: Array
    """Fast average of the square of the specific force less gravity, (m/s^2)^2."""
    heading: Array
    """Fast average of the heading that the field shows, rad."""
    slow_heading: Array
    """Slow average of the same."""
    heading_square: Array
    """Fast average of the square."""
    strength: Array
    """Reference of the field's strength."""
    dip: Array
    """Reference of its dip, rad."""
    field_square: Array
    """Fast average of the square of what field and reference differ by, relative and rad."""
    rate_square: Array
    """Fast average of the square of the angular rate, (rad/s)^2."""


def start_indicators(zero: Array) -> Indicators:
    """Averages of nothing.

    Args:
        zero: ``(N,)``.
    """
    pair = namespace(zero).stack([zero, zero])
    return Indicators(zero, pair, pair, *[zero] * 9)


def observe(state: Indicators, cosines: Array, measurement: Measurement, interval: float) -> Indicators:
    """Averages after a measurement.

    Args:
        state: before.
        cosines: direction cosines as predicted, ``(9, N)``.
        measurement: that has come.
        interval: T, s.
    """
    xp, number = namespace(cosines), state.number + 1.0
    fast, slow, reference = (
        xp.maximum(1.0 / number, interval / tau + 0.0 * number) for tau in (FAST, SLOW, REFERENCE)
    )
    size = length(measurement.force)
    tilt = to_world(cosines, measurement.force)[:2] / size
    field = to_world(cosines, measurement.field)
    north = length(field[:2])
    heading = xp.atan2(field[1], field[0] + TINY)
    strength, dip = length(field), xp.atan2(-field[2], north)
    kept_strength = state.strength + reference * (strength - state.strength)
    kept_dip = state.dip + reference * (dip - state.dip)
    deviation = (strength / kept_strength - 1.0) ** 2 + (dip - kept_dip) ** 2
    return Indicators(
        number,
        state.tilt + fast * (tilt - state.tilt),
        state.slow_tilt + slow * (tilt - state.slow_tilt),
        state.tilt_square + fast * (square(tilt) - state.tilt_square),
        state.excess_square + fast * ((size - GRAVITY) ** 2 - state.excess_square),
        state.heading + fast * (heading - state.heading),
        state.slow_heading + slow * (heading - state.slow_heading),
        state.heading_square + fast * (heading * heading - state.heading_square),
        kept_strength,
        kept_dip,
        state.field_square + fast * (deviation - state.field_square),
        state.rate_square + fast * (square(measurement.rate) - state.rate_square),
    )


def _root(value: Array) -> Array:
    return namespace(value).sqrt(value + 1e-12)


def indicator_blocks(interval: float) -> tuple[Block, ...]:
    """What an agent is shown of them.

    Args:
        interval: T, s.
    """

    def shown(name: str, value: Any, text: str, compression: Any = LOG1P) -> Block:
        return Block(name, lambda f, _: value(f.indicators), text, shown=compression)

    return (
        shown("tilt", lambda s: DEGREES * length(s.tilt), "angle of the mean force to the estimated vertical, deg"),
        shown("slow_tilt", lambda s: DEGREES * length(s.slow_tilt), "that of the slow mean, deg"),
        shown("tilt_rms", lambda s: DEGREES * _root(s.tilt_square), "root mean square of the angle, deg"),
        shown("excess_rms", lambda s: _root(s.excess_square), "root mean square of force less gravity, m/s^2"),
        shown("heading", lambda s: DEGREES * s.heading, "mean heading of the field, deg", SIGNED_LOG),
        shown("slow_heading", lambda s: DEGREES * s.slow_heading, "slow mean of it, deg", SIGNED_LOG),
        shown("heading_rms", lambda s: DEGREES * _root(s.heading_square), "root mean square of it, deg"),
        shown("field_rms", lambda s: 100.0 * _root(s.field_square), "root mean square change of the field, percent"),
        shown("rate_rms", lambda s: _root(s.rate_square), "root mean square of the angular rate, rad/s"),
        Block(
            "settling",
            lambda f, _: namespace(f.indicators.number).exp(-interval / 5.0 * f.indicators.number),
            "exp(-t / 5 s), t since the start",
            shown=SHARE,
        ),
    )  # fmt: skip


def log_ten(decades: float) -> float:
    """Natural logarithm of so many decades."""
    return decades * math.log(10.0)
