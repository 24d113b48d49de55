r"""Discrete Kalman filter on batches of small systems.

    prediction  x' = F x + b,  P' = F P F^T + Q
    update      nu = z - H x', S = H P' H^T + R, K = P' H^T S^-1,
                x = x' + K nu,  P = (I - K H) P' (I - K H)^T + K R K^T   (Joseph form)

Arrays have the batch last; a matrix shared by the whole batch is ``(n, n)``. Bar-Shalom, Li and Kirubarajan,
Estimation with Applications to Tracking and Navigation (2001), chapter 5.
"""

from typing import NamedTuple

from .array_namespace import Array, namespace
from .gaussian import log_density
from .small_matrices import apply, product, solve_definite, transpose


class Update(NamedTuple):
    """Result of a measurement update: mean, covariance, log-likelihood and NIS."""

    mean: Array
    """Updated mean, ``(n, N)``."""
    covariance: Array
    """Updated covariance, ``(n, n, N)``."""
    log_likelihood: Array
    """Log-density of the measurement given the prediction, ``(N,)``."""
    squared_distance: Array
    """Normalised innovation squared (NIS), ``(N,)``."""


def _with_batch_axis(matrix: Array) -> Array:
    return matrix[..., None] if matrix.ndim == 2 else matrix


def predict(
    mean: Array, covariance: Array, F: Array, Q: Array, offset: Array | None = None
) -> tuple[Array, Array]:
    """Return the predicted mean ``F x + b`` and covariance ``F P F^T + Q``.

    Args:
        mean: mean of the state, ``(n, N)``.
        covariance: its covariance, ``(n, n, N)``.
        F: transition matrix, ``(n, n)`` or ``(n, n, N)``.
        Q: covariance of the process noise, ``(n, n)`` or ``(n, n, N)``.
        offset: known input, ``(n, N)`` or None.
    """
    F, Q = _with_batch_axis(F), _with_batch_axis(Q)
    moved = apply(F, mean)
    if offset is not None:
        moved = moved + offset
    return moved, product(product(F, covariance), transpose(F)) + Q


def update(mean: Array, covariance: Array, z: Array, H: Array, R: Array) -> Update:
    """Return the measurement update in Joseph form, with the log-likelihood of the measurement.

    Args:
        mean: predicted mean, ``(n, N)``.
        covariance: predicted covariance, ``(n, n, N)``.
        z: measurement, ``(m, N)``.
        H: measurement matrix, ``(m, n)`` or ``(m, n, N)``.
        R: covariance of the measurement noise, ``(m, m)`` or ``(m, m, N)``.
    """
    xp = namespace(mean)
    H, R = _with_batch_axis(H), _with_batch_axis(R)
    innovation = z - apply(H, mean)
    HP = product(H, covariance)
    S = product(HP, transpose(H)) + R
    K = transpose(solve_definite(S, HP))
    n = mean.shape[0]
    identity = xp.eye(n, dtype=mean.dtype, device=mean.device)[..., None]
    rest = identity - product(K, H)
    joseph = product(product(rest, covariance), transpose(rest)) + product(product(K, R), transpose(K))
    # Rounding makes the product slightly asymmetric, and that grows over many updates.
    joseph = 0.5 * (joseph + transpose(joseph))
    log_likelihood, squared_distance = log_density(innovation, S)
    return Update(mean + apply(K, innovation), joseph, log_likelihood, squared_distance)


def white_acceleration(T: float, sigma: float, axes: int = 1) -> tuple[list[list[float]], list[list[float]]]:
    """Return F and Q, nested lists, of the constant-velocity model with a piecewise constant white acceleration.

    ``F = [[I, T I], [0, I]]``, ``Q = sigma^2 [[T^4/4 I, T^3/2 I], [T^3/2 I, T^2 I]]`` for the state
    (positions, velocities); ``B = [T^2/2, T]`` of the IMM paper with ``w ~ N(0, sigma^2)``.

    Args:
        T: sampling interval, s.
        sigma: standard deviation of the acceleration, m/s^2.
        axes: number of coordinates.
    """
    n = 2 * axes
    F = [[1.0 if i == j else T if j == i + axes else 0.0 for j in range(n)] for i in range(n)]
    g = [T**2 / 2, T]
    Q = [
        [sigma**2 * g[i // axes] * g[j // axes] if i % axes == j % axes else 0.0 for j in range(n)]
        for i in range(n)
    ]
    return F, Q


def constant_acceleration(T: Array, axes: int = 1) -> Array:
    """Return the transition matrices of the constant-acceleration model, ``(3 axes, 3 axes, N)``.

    The state is (positions, velocities, accelerations).

    ``F = [[I, T I, T^2/2 I], [0, I, T I], [0, 0, I]]``; Bar-Shalom, Li and Kirubarajan, section 6.2.3.

    Args:
        T: intervals, s, ``(N,)``.
        axes: number of coordinates.
    """
    xp, zero = namespace(T), 0.0 * T
    derivatives = [1.0 + zero, T, 0.5 * T**2]
    size = range(3 * axes)
    return xp.stack(
        [
            xp.stack([derivatives[(j - i) // axes] if j >= i and (j - i) % axes == 0 else zero for j in size])
            for i in size
        ]
    )
