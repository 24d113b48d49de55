r"""Nearly coordinated turn: motion at constant speed with an estimated turn rate.

The state is (x, y, vx, vy, omega), omega anticlockwise positive, and over an interval T with theta = omega T

    x'  = x + T (s vx - c vy),            y'  = y + T (c vx + s vy)
    vx' = cos(theta) vx - sin(theta) vy,  vy' = sin(theta) vx + cos(theta) vy,  omega' = omega
    s = sin(theta) / theta,               c = (1 - cos(theta)) / theta

and noise: an acceleration along x and y and a change of the turn rate, each constant and independent in every
interval. Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section
11.7; the Jacobian is theirs, written with s, c and their derivatives

    ds/dtheta = (cos(theta) - s) / theta,  dc/dtheta = s - c / theta

Reading: the book divides by omega and needs a second formula where it is small. Here c = sin(theta / 2) s(theta / 2)
and c / theta = s(theta / 2)^2 / 2, which lose no digits there; only ds/dtheta takes a series.

Shapes: states ``(5, ...)``, batch last.
"""

from .array_namespace import Array, namespace
from .kalman import white_acceleration
from .small_matrices import product, transpose


def _sine_ratio(angle: Array) -> Array:
    """Return ``sin(x) / x``, one at zero."""
    xp = namespace(angle)
    nonzero = angle != 0.0
    divisor = xp.where(nonzero, angle, 1.0)
    return xp.where(nonzero, xp.sin(divisor) / divisor, 1.0)


def _sine_ratio_derivative(angle: Array, cosine: Array, ratio: Array) -> Array:
    """Return the derivative of ``sin(x) / x``, from a series where the closed form cancels."""
    xp = namespace(angle)
    small = xp.abs(angle) < 0.1
    square = angle * angle
    series = -angle * (1 / 3 - square * (1 / 30 - square * (1 / 840 - square * (1 / 45360))))
    return xp.where(small, series, (cosine - ratio) / xp.where(small, 1.0, angle))


def propagate(state: Array, T: float | Array) -> Array:
    """Return the state after an interval at a constant turn rate, ``(5, ...)``.

    Args:
        state: position (m), velocity (m/s) and turn rate (rad/s), ``(5, ...)``.
        T: interval, s, a number or ``(...)``.
    """
    xp = namespace(state)
    x, y, vx, vy, omega = (state[i] for i in range(5))
    angle = T * omega
    s, c = _sine_ratio(angle), xp.sin(0.5 * angle) * _sine_ratio(0.5 * angle)
    cosine, sine = xp.cos(angle), xp.sin(angle)
    return xp.stack(
        [
            x + T * (s * vx - c * vy),
            y + T * (c * vx + s * vy),
            cosine * vx - sine * vy,
            sine * vx + cosine * vy,
            omega,
        ]
    )


def jacobian(state: Array, T: float | Array) -> Array:
    """Return the Jacobian of :func:`propagate` with respect to the state, ``(5, 5, ...)``."""
    xp = namespace(state)
    vx, vy, omega = state[2], state[3], state[4]
    angle = T * omega
    s, half = _sine_ratio(angle), _sine_ratio(0.5 * angle)
    c = xp.sin(0.5 * angle) * half
    cosine, sine = xp.cos(angle), xp.sin(angle)
    ds, dc = _sine_ratio_derivative(angle, cosine, s), s - 0.5 * half * half
    zero, one = 0.0 * omega, 1.0 + 0.0 * omega
    rows = [
        [one, zero, T * s, -T * c, T**2 * (ds * vx - dc * vy)],
        [zero, one, T * c, T * s, T**2 * (dc * vx + ds * vy)],
        [zero, zero, cosine, -sine, -T * (sine * vx + cosine * vy)],
        [zero, zero, sine, cosine, T * (cosine * vx - sine * vy)],
        [zero, zero, zero, zero, one],
    ]
    return xp.stack([xp.stack(row) for row in rows])


def process_noise(T: float, acceleration_sigma: float, turn_acceleration_sigma: float) -> list[list[float]]:
    """Return the covariance of the process noise over an interval, ``(5, 5)``, as nested lists.

    Args:
        T: interval, s.
        acceleration_sigma: standard deviation of the acceleration along x and y, m/s^2.
        turn_acceleration_sigma: standard deviation of the rate of change of the turn rate, rad/s^2.
    """
    Q = white_acceleration(T, acceleration_sigma, axes=2)[1]
    return [*([*row, 0.0] for row in Q), [0.0, 0.0, 0.0, 0.0, (T * turn_acceleration_sigma) ** 2]]


def predict(mean: Array, covariance: Array, T: float | Array, Q: Array) -> tuple[Array, Array]:
    """Return mean and covariance predicted by the extended Kalman filter, ``F P F^T + Q`` with the Jacobian F.

    Args:
        mean: mean of the state, ``(5, N)``.
        covariance: its covariance, ``(5, 5, N)``.
        T: interval, s, a number or ``(N,)``.
        Q: covariance of the process noise, ``(5, 5, 1)`` or ``(5, 5, N)``.
    """
    F = jacobian(mean, T)
    return propagate(mean, T), product(product(F, covariance), transpose(F)) + Q


def augment_turn_rate(mean: Array, covariance: Array, variance: float) -> tuple[Array, Array]:
    """Append an independent turn rate of mean zero to mean and covariance of position and velocity.

    Args:
        mean: mean of position and velocity, ``(4, N)``.
        covariance: their covariance, ``(4, 4, N)``.
        variance: variance of the turn rate, (rad/s)^2.
    """
    xp = namespace(mean)
    zero = 0.0 * mean
    right = xp.concat([covariance, zero[:, None]], axis=1)
    below = xp.concat([zero, variance + zero[:1]])
    return xp.concat([mean, zero[:1]]), xp.concat([right, below[None]])
