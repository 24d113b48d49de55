"""Posterior Cramér-Rao bounds of linear-Gaussian tracking.

For ``x(k) = F x(k-1) + w``, ``z = H x + v`` the information recursion of Tichavsky, Muravchik and Nehorai
(1998) is the covariance recursion of the Kalman filter along the true states:
``P' = F P F^T + Q``, ``P = (P'^-1 + H^T R^-1 H)^-1``. Written with covariances it needs no inverse of Q,
which is singular wherever noise enters fewer directions than there are states (a pseudo-inverse would be
wrong).
"""

from .array_namespace import Array
from .kalman import Update, update
from .small_matrices import product, transpose


def predict_bound(P: Array, F: Array, Q: Array | float = 0.0) -> Array:
    """Return the posterior Cramér-Rao bound before the next measurement, ``F P F^T + Q``.

    Args:
        P: bound after the previous measurement, ``(n, n, N)``.
        F: transition matrix, ``(n, n, 1)`` or ``(n, n, N)``.
        Q: covariance of the process noise, same shape; zero where the input is known.
    """
    return product(product(F, P), transpose(F)) + Q


def posterior_cramer_rao_bound(P: Array, H: Array, R: Array) -> Array:
    """Return the posterior Cramér-Rao bound after a measurement, ``(n, n, N)``.

    Args:
        P: bound before it, ``(n, n, N)``.
        H: measurement matrix, ``(m, n)`` or ``(m, n, N)``.
        R: covariance of the measurement noise at the true state, ``(m, m)`` or ``(m, m, N)``.
    """
    nothing = 0.0 * P[:, 0]
    result: Update = update(nothing, P, nothing[: H.shape[0]], H, R)
    return result.covariance
