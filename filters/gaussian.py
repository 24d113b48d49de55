"""Gaussian log-densities and squared Mahalanobis distances of innovations and errors."""

import math

from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum
from .small_matrices import cholesky, solve_lower


def log_density(residual: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the log-density of ``N(0, covariance)`` at a residual, and its squared Mahalanobis distance.

    ``log N = -1/2 (d^2 + log det(2 pi S))``, ``d^2 = nu^T S^-1 nu``, by Cholesky factor; equation (11) of the
    IMM paper in logarithms, so that an innovation of 500 sigma keeps its likelihood.

    Args:
        residual: innovation or error, ``(m, ...)``.
        covariance: its covariance, ``(m, m, ...)``, symmetric positive definite.

    Returns:
        Log-density ``(...)`` and squared distance ``(...)``; the latter is chi-square with m degrees of
        freedom when the residual has that covariance (NIS for innovations, NEES for estimation errors).
    """
    xp = namespace(residual)
    factor = cholesky(covariance)
    whitened = solve_lower(factor, residual)
    squared_distance = ordered_sum(component**2 for component in whitened)
    determinant_root = factor[0][0]
    for i in range(1, len(whitened)):
        determinant_root = determinant_root * factor[i][i]
    constant = len(whitened) * math.log(2 * math.pi)
    return -0.5 * (squared_distance + constant) - xp.log(determinant_root), squared_distance
