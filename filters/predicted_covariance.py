r"""A Kalman update that estimates the covariance of its own prediction.

Where the process noise is wrong, so is the predicted covariance P'. It gets an inverse-Wishart distribution whose mean
is the nominal P'_0 and whose strength tau says for how many measurements that stands; the variational-Bayes update of
state and P' together is the fixed point of

    K, x, P = Kalman's update with P'
    A = P + (x - x')(x - x')^T,  P' = (tau P'_0 + A) / (tau + 1)

Y. Huang, Y. Zhang, Z. Wu, N. Li and J. Chambers, A novel adaptive Kalman filter with inaccurate process and
measurement noise covariance matrices, IEEE Transactions on Automatic Control 63 (2018) 594-601, after S. Särkkä and
A. Nummenmaa, who do the same for the measurement noise (2009).

Reading: the paper estimates R likewise; here R is known, and that half is left out. For tau to infinity this is
Kalman's filter.
"""

from . import kalman
from .array_namespace import Array
from .small_matrices import outer


def update(
    mean: Array, covariance: Array, z: Array, H: Array, R: Array, tau: float, iterations: int
) -> kalman.Update:
    """Measurement update with the predicted covariance estimated from the same measurement.

    Args:
        mean: predicted, ``(n, N)``.
        covariance: nominal one of the prediction, ``(n, n, N)``.
        z: measurement, ``(m, N)``.
        H: measurement matrix, ``(m, n)`` or ``(m, n, N)``.
        R: covariance of the measurement noise, ``(m, m)`` or ``(m, m, N)``.
        tau: strength of the nominal covariance, more than zero.
        iterations: of the fixed point, at least 1; the first is Kalman's update.

    Returns:
        The last update; its likelihood and squared distance are those under the estimated covariance.
    """
    result = kalman.update(mean, covariance, z, H, R)
    for _ in range(iterations - 1):
        correction = result.mean - mean
        estimated = (tau * covariance + result.covariance + outer(correction, correction)) / (tau + 1.0)
        result = kalman.update(mean, estimated, z, H, R)
    return result
