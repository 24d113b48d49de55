"""Random motion that is smooth: damped oscillators driven by white noise.

In units of its standard deviations an oscillator of the frequency ``w0`` (rad/s) and the damping ``z`` has position and
velocity ``y`` with

    dy/dt = [[0, w0], [-w0, -2 z w0]] y + (0, sqrt(4 z w0)) n                                   (1)

and the identity as stationary covariance (Lyapunov's equation). Over an interval T with ``s = z w0`` and
``w = w0 sqrt(1 - z^2)``

    y <- F y + L n,   F = exp(-s T) [[cos wT + s/w sin wT, w0/w sin wT], [-w0/w sin wT, cos wT - s/w sin wT]]   (2)
    L L^T = I - F F^T                                                                           (3)

exactly. The position is smooth, and serves as angular rate; the velocity has no power at frequency zero, as the
acceleration of something that comes back, and serves as acceleration.
"""

import math
from typing import NamedTuple

from filtergym.filters.array_namespace import Array, namespace

DAMPING = 0.5


class Oscillator(NamedTuple):
    """One interval of an oscillator, entries ``(N,)``."""

    F: tuple[Array, Array, Array, Array]
    """Row by row."""
    L: tuple[Array, Array, Array]
    """Lower triangle, row by row."""


def oscillator(frequency: Array, interval: float) -> Oscillator:
    """Discrete oscillator; equations (2), (3).

    Args:
        frequency: Hz, ``(N,)``.
        interval: T, s.
    """
    xp, w0 = namespace(frequency), 2.0 * math.pi * frequency
    ratio = math.sqrt(1.0 - DAMPING**2)
    decay, phase = xp.exp(-DAMPING * interval * w0), ratio * interval * w0
    c, s = decay * xp.cos(phase), decay * xp.sin(phase) / ratio
    F = (c + DAMPING * s, s, -s, c - DAMPING * s)
    one = xp.sqrt(xp.clip(1.0 - F[0] * F[0] - F[1] * F[1], 1e-14, None))
    mixed = -(F[0] * F[2] + F[1] * F[3]) / one
    rest = xp.sqrt(xp.clip(1.0 - F[2] * F[2] - F[3] * F[3] - mixed * mixed, 0.0, None))
    return Oscillator(F, (one, mixed, rest))


def move(step: Oscillator, y: Array, noise: Array) -> Array:
    """Positions and velocities after an interval, ``(2, axes, N)``.

    Args:
        step: of :func:`oscillator`.
        y: before.
        noise: standard normal numbers, ``(2, axes, N)``.
    """
    (a, b, c, d), (one, mixed, rest) = step
    return namespace(y).stack(
        [
            a * y[0] + b * y[1] + one * noise[0],
            c * y[0] + d * y[1] + mixed * noise[0] + rest * noise[1],
        ]
    )
