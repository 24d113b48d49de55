r"""Positions with slowly varying errors, filtered with dead reckoning from a second sensor.

A receiver's errors last for minutes and look like motion. A second sensor, such as wheels and a compass, a
camera or an INS, separates both: its errors grow with the distance travelled. With its displacement d over an
interval T, scaled by k and turned clockwise by h,

    p' = p + k A(h) d + w                  position,                       w ~ N(0, q^2 l I)
    v' = (k A(h) d + w) / T                velocity, the mean of T
    e' = exp(-T / tau) e + u               error of the positions,         u ~ N(0, s^2 (1 - exp(-2 T / tau)) I)
    z  = p + e + n                         what was measured,              n ~ N(0, R)

The error e is a Gauss-Markov process of deviation s and correlation time tau (Brown and Hwang, Introduction
to Random Signals and Applied Kalman Filtering, 1997, section 5.5); it is estimated with the position (section
8.7). The error of dead reckoning is a random walk of intensity q over the way l, the length of the
displacement, and a little more: a still vehicle creeps no faster than ``CREEP``. Without a reading of the
second sensor the velocity goes on with a white acceleration a, constant in the interval:

    p' = p + T v + T^2 / 2 a,              v' = v + T a

The states are position x, y, velocity x, y, error x, y; k, h, s, tau and q are constants of the filter. A
constant error is not observable.

Shapes: batch last.
"""

from typing import NamedTuple

from .array_namespace import Array, namespace
from .kalman import predict

CREEP = 0.01
"""Speed by which the distance grows at a standstill, for the error of dead reckoning, m/s; ours."""


class Noise(NamedTuple):
    """Noise parameters of the filter with dead reckoning."""

    drift: float | Array
    """q, error of dead reckoning, m over the root of the distance in m."""
    acceleration: float | Array
    """Standard deviation of the acceleration a without dead reckoning, m/s^2."""
    correlation_time: float | Array
    """tau, correlation time of the receiver's error, s."""
    deviation: float | Array
    """s, standard deviation of the receiver's error, m."""


def _both_axes(block: list[list[Array]]) -> Array:
    """Return a matrix ``(3, 3)`` of one axis, entries ``(N,)``, as the block matrix of both axes, ``(6, 6, N)``."""
    xp, zero = namespace(block[0][0]), 0.0 * block[0][0]
    return xp.stack(
        [xp.stack([block[i // 2][j // 2] if i % 2 == j % 2 else zero for j in range(6)]) for i in range(6)]
    )


def start(mean: Array, covariance: Array, deviation: float | Array) -> tuple[Array, Array]:
    """Return mean ``(6, N)`` and covariance of the state at a first measured position, where
    ``p = z - e - n``.

    Args:
        mean: position and velocity, the position as it was measured, ``(4, N)``, m and m/s.
        covariance: covariance of their white errors, ``(4, 4, N)``.
        deviation: s, standard deviation of the receiver's error, m.
    """
    xp = namespace(mean)
    zero = 0.0 * mean[0]
    s2 = deviation**2 + zero
    white = xp.concat(
        [
            xp.concat([covariance, xp.stack([xp.stack([zero] * 2)] * 4)], axis=1),
            xp.stack([xp.stack([zero] * 6)] * 2),
        ],
        axis=0,
    )
    slow = _both_axes([[s2, zero, -s2], [zero, zero, zero], [-s2, zero, s2]])
    return xp.concat([mean, xp.stack([zero, zero])], axis=0), white + slow


def calibrate(displacement: Array, scale: float | Array, heading_offset: float | Array) -> Array:
    """Return displacements ``(2, N)`` multiplied by a scale factor and turned clockwise by an angle, rad."""
    xp = namespace(displacement)
    angle = heading_offset + 0.0 * displacement[0]
    cosine, sine = scale * xp.cos(angle), scale * xp.sin(angle)
    x, y = displacement[0], displacement[1]
    return xp.stack([cosine * x + sine * y, cosine * y - sine * x])


def predict_position(
    mean: Array,
    covariance: Array,
    displacement: Array,
    available: Array,
    T: Array,
    noise: Noise,
) -> tuple[Array, Array]:
    """Return mean and covariance predicted with the displacement of dead reckoning, or without one.

    Args:
        mean: mean of the state, ``(6, N)``.
        covariance: its covariance, ``(6, 6, N)``.
        displacement: calibrated displacement, m, ``(2, N)``.
        available: above zero where there is a displacement, ``(N,)``.
        T: interval, s, ``(N,)``.
        noise: noise parameters of the filter.
    """
    xp = namespace(mean)
    known = available > 0.0
    zero, one = 0.0 * T, 1.0 + 0.0 * T
    way = xp.sqrt(displacement[0] ** 2 + displacement[1] ** 2) + CREEP * T
    # In either case one number a both axes alike drives position and velocity.
    driving = xp.where(known, noise.drift**2 * way, noise.acceleration**2 + zero)
    by_noise = xp.where(known, one, 0.5 * T**2), xp.where(known, 1.0 / T, T)
    fading = xp.exp(-T / noise.correlation_time)
    coasting = xp.where(known, zero, T), xp.where(known, zero, one)
    F = _both_axes([[one, coasting[0], zero], [zero, coasting[1], zero], [zero, zero, fading]])
    pp, pv, vv = (driving * by_noise[i] * by_noise[j] for i, j in ((0, 0), (0, 1), (1, 1)))
    ee = noise.deviation**2 * (1.0 - fading**2)
    Q = _both_axes([[pp, pv, zero], [pv, vv, zero], [zero, zero, ee]])
    moved = xp.where(known, displacement, 0.0)
    return predict(mean, covariance, F, Q, xp.concat([moved, moved / T, xp.stack([zero, zero])], axis=0))
