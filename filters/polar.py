"""Errors of a range-and-azimuth radar in Cartesian coordinates."""

from .array_namespace import Array, namespace

SMALLEST_RANGE = 1.0
"""Range below which variances are evaluated at this range, m, since the azimuth is undefined at zero."""


def cartesian_variances(position: Array, range_sigma: Array, bearing_sigma: Array) -> Array:
    """Return the variances along x and y of a polar measurement, ``(2, ...)``, m^2, (22) and (23) of the IMM
    paper.

    ``sigma_x^2 = cos^2(b) sigma_r^2 + r^2 sin^2(b) sigma_b^2`` and the same with sine and cosine exchanged
    for y, where ``cos(b) = x / r``. The covariance of x and y is not part of the paper's model.

    Args:
        position: x and y at which the variances are evaluated, ``(2, ...)``, m.
        range_sigma: standard deviation of the range, m; a number or ``(...)``.
        bearing_sigma: standard deviation of the azimuth, rad, same shape.
    """
    xp = namespace(position)
    squares = position * position
    squared_range = xp.clip(squares[0] + squares[1], SMALLEST_RANGE**2, None)
    along = squares * (range_sigma * range_sigma / squared_range)
    return along + (squared_range - squares) * (bearing_sigma * bearing_sigma)
