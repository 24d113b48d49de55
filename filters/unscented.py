r"""Scaled unscented transform: mean and covariance of a function of a Gaussian variable.

2n + 1 sigma points carry mean and covariance through the function, which is never differentiated:

    lambda = alpha^2 (n + kappa) - n,  L L^T = (n + lambda) P
    X_0 = x,  X_i = x + L_i,  X_{n+i} = x - L_i       (L_i: column i of L)
    W_0 = lambda / (n + lambda),  W_i = 1 / (2 (n + lambda)),  W_0^c = W_0 + 1 - alpha^2 + beta
    y = sum W_i f(X_i),  P_y = sum W_i^c (f(X_i) - y)(f(X_i) - y)^T

S. J. Julier, The scaled unscented transformation, Proc. American Control Conference (2002), 4555-4559; E. A. Wan and
R. van der Merwe, The unscented Kalman filter, chapter 7 of S. Haykin, Kalman Filtering and Neural Networks (2001).
With alpha = 1 and kappa = 0 no weight is negative. With differences d_i = f(X_i) - f(X_0) and their weighted mean s,

    P_y = sum W_i d_i d_i^T + (beta - alpha^2) s s^T          (i > 0, kappa = 0)

so P_y stays positive semidefinite for every alpha up to sqrt(beta).

Shapes: means ``(n, ...)``, covariances ``(n, n, ...)``, batch last.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum
from .small_matrices import apply, cholesky, outer


class Spread(NamedTuple):
    """Parameters of the unscented transform."""

    alpha: float | Array = 1.0
    """Scale of the distance of the points from the mean; a number, or ``(...)``."""
    beta: float = 2.0
    """Parameter of the fourth moments; 2 is best for a Gaussian variable."""
    kappa: float = 0.0
    """Second scaling; 3 - n is Julier's first choice."""


GAUSSIAN = Spread()


def sigma_points(mean: Array, covariance: Array, spread: Spread = GAUSSIAN) -> Array:
    """Return the sigma points, ``(n, 2n + 1, ...)``: mean, mean plus and mean minus the columns of the root.

    Args:
        mean: mean, ``(n, ...)``.
        covariance: covariance, ``(n, n, ...)``, positive definite.
        spread: parameters of the transform.
    """
    xp = namespace(mean)
    n = mean.shape[0]
    scale = spread.alpha * (n + spread.kappa) ** 0.5
    L, zero = cholesky(covariance), 0.0 * mean[0]
    columns = [xp.stack([scale * L[i][j] if j <= i else zero for i in range(n)]) for j in range(n)]
    return xp.stack(
        [mean, *(mean + column for column in columns), *(mean - column for column in columns)], axis=1
    )


def weights(n: int, spread: Spread = GAUSSIAN) -> tuple[list[Any], list[Any]]:
    """Return two lists of the weights of the 2n + 1 sigma points: for the mean and for the covariance.

    Args:
        n: dimension of the variable.
        spread: parameters of the transform.
    """
    total = spread.alpha**2 * (n + spread.kappa)
    others = [0.5 / total] * (2 * n)
    first = (total - n) / total
    return [first, *others], [first + 1.0 - spread.alpha**2 + spread.beta, *others]


def limit_spread(jacobian: Array, covariance: Array, limit: float) -> Spread:
    """Return parameters whose sigma points move a function by no more than a limit, to first order.

    The columns of the scaled root of P move a row H of the function by at most alpha sqrt(n H P H^T). Angles are
    measured up to whole turns, so points that move one by half a turn or more have no difference of known sign.

    Args:
        jacobian: rows H of the function at the mean, ``(m, n, ...)``.
        covariance: covariance, ``(n, n, ...)``.
        limit: largest change of each row of the function.
    """
    n, xp = covariance.shape[0], namespace(covariance)
    variances = [
        ordered_sum(row * apply(covariance, row)) for row in (jacobian[i] for i in range(jacobian.shape[0]))
    ]
    alpha = 1.0
    for variance in variances:
        alpha = xp.minimum(alpha, limit / xp.sqrt(xp.maximum(n * variance, limit**2)))
    return Spread(alpha)


def transform(
    mean: Array, covariance: Array, function: Callable[[Array], Array], spread: Spread = GAUSSIAN
) -> tuple[Array, Array]:
    """Return mean ``(m, ...)`` and covariance ``(m, m, ...)`` of a function of a Gaussian variable, by sigma
    points.

    Args:
        mean: mean, ``(n, ...)``.
        covariance: covariance, ``(n, n, ...)``, positive definite.
        function: function from points ``(n, 2n + 1, ...)`` to ``(m, 2n + 1, ...)``.
        spread: parameters of the transform.
    """
    return combine(function(sigma_points(mean, covariance, spread)), *weights(mean.shape[0], spread))


def combine(points: Array, for_mean: Sequence[Any], for_covariance: Sequence[Any]) -> tuple[Array, Array]:
    """Return the weighted mean ``(m, ...)`` and covariance ``(m, m, ...)`` of points.

    Args:
        points: ``(m, p, ...)``, that of the mean first.
        for_mean: weights of the points for the mean, which sum to one, p numbers or arrays ``(...)``.
        for_covariance: those for the covariance.
    """
    first = points[:, 0]
    # The weights sum to one, and with a small alpha they are large: differences lose fewer digits than points.
    shift = ordered_sum(w * (points[:, i] - first) for i, w in enumerate(for_mean) if i)
    differences = (points[:, i] - first - shift for i in range(len(for_mean)))
    spread_out = ordered_sum(
        w * outer(difference, difference) for w, difference in zip(for_covariance, differences, strict=True)
    )
    return first + shift, spread_out
