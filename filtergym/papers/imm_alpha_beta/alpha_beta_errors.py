"""Exact errors of an alpha-beta filter: steady-state variances, and moments propagated scan by scan."""

from typing import NamedTuple

from ...filters.alpha_beta import Covariance, predict_covariance, update_covariance
from ...filters.array_namespace import Array


class VarianceReduction(NamedTuple):
    """Steady-state error variances of an alpha-beta filter per unit variance of white measurement noise."""

    position: Array
    velocity: Array
    """Velocity variance, in units of 1 / T^2."""
    prediction: Array


def variance_reduction(alpha: Array, beta: Array) -> VarianceReduction:
    """Return the steady-state variance-reduction ratios of an alpha-beta filter with gains alpha and beta.

    Textbook results (Blackman and Popoli, Design and Analysis of Modern Tracking Systems, 1999), with
    ``d = alpha (4 - 2 alpha - beta)``: position ``(2 alpha^2 + 2 beta - 3 alpha beta) / d``, velocity
    ``2 beta^2 / d / T^2``, prediction ``(2 alpha^2 + alpha beta + 2 beta) / d``.
    """
    d = alpha * (4.0 - 2.0 * alpha - beta)
    return VarianceReduction(
        (2.0 * alpha**2 + 2.0 * beta - 3.0 * alpha * beta) / d,
        2.0 * beta**2 / d,
        (2.0 * alpha**2 + alpha * beta + 2.0 * beta) / d,
    )


class ErrorMoments(NamedTuple):
    """Mean and covariance of the error "truth minus estimate" of one coordinate: position and velocity."""

    position: Array
    velocity: Array
    covariance: Covariance


def propagate_error(
    moments: ErrorMoments,
    push: tuple[Array, Array],
    R: Array,
    alpha: Array,
    beta: Array,
    T: float,
) -> ErrorMoments:
    """Return the exact mean and covariance of an alpha-beta filter's error after one scan with known gains.

    The error of the filter is linear in its initial error, the measurement noise and the manoeuvre, so its mean and
    covariance follow without Monte Carlo: ``e(k|k) = (I - K H) (F e + push) - K v``.

    Args:
        moments: moments of the error after the previous update.
        push: displacement by the manoeuvre in this scan, m (``a T^2 / 2``), and change of velocity, m/s (``a T``).
        R: variance of the measurement noise, m^2.
        alpha: position gain of this scan.
        beta: velocity gain of this scan.
        T: sampling interval, s.
    """
    position = moments.position + T * moments.velocity + push[0]
    velocity = moments.velocity + push[1]
    covariance = update_covariance(predict_covariance(moments.covariance, T), R, alpha, beta, T)
    return ErrorMoments((1.0 - alpha) * position, velocity - (beta / T) * position, covariance)
