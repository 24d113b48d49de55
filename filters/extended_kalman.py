r"""Measurement update of an extended Kalman filter, by one scalar observation after the other.

With the prediction x', P', the residual nu = y - S(x') and the rows h of the Jacobian dS/dx at x', for every
observation j with variance r_j:

    s = h P h^T + r_j,  g = P h^T / sqrt(s),  nu' = nu_j - h (x - x')
    x += g nu' / sqrt(s),  P -= g g^T

This is step 6 of Moroz's paper on an adaptive multi-hypothesis measurer, ``P = (P'^-1 + H^T R^-1 H)^-1``,
``x = x' + P H^T R^-1 nu``, for a diagonal R. It keeps P exactly symmetric, and its terms nu'^2 / s are
independent contributions to the normalised innovation squared.

Reading: steps 5 and 6 of the paper write the Jacobian once through the picked parameters v = c x and once
directly; one Jacobian with respect to the state is used.

Robust update. Where the noise is Gaussian but for outliers, Huber's M-estimate minimises, for each
observation in its turn, ``(x - x')^T P^-1 (x - x') / 2 + rho(u)`` with the residual after the update
``u = (nu' - h (x - x')) / sqrt(r)``, ``rho(u) = u^2 / 2`` up to a threshold k and ``k |u| - k^2 / 2`` beyond
it. Reweighting, ``r' = r |u| / k`` beyond the threshold, is the usual way to it. For one scalar observation
its fixed point is

    s' = h P h^T + r' = max(s, sqrt(r) |nu'| / k),

and s' takes the place of s. Sources: P. J. Huber, Robust estimation of a location parameter, Annals of
Mathematical Statistics 35, 1964; in the update of a Kalman filter, by reweighting: Z. M. Durovic and B. D.
Kovacevic, Robust estimation with unknown noise statistics, IEEE Transactions on Automatic Control 44, 1999.

Gain of another variance. With a caution c the gain is ``k = P h^T / (h P h^T + c r)``, of the noise c r in place of r;
the covariance that it leaves is that of Joseph's form, ``P -= k u^T + u k^T`` with ``u = P h^T - s k / 2``.

Shapes: mean ``(n, ...)``, covariance ``(n, n, ...)``, residual ``(m, ...)``, batch last.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from .array_namespace import Array, namespace


class JacobianRow(NamedTuple):
    """Non-zero entries of one row of a Jacobian."""

    columns: tuple[int, ...]
    """Indices of the states with non-zero derivatives."""
    values: tuple[Array | float, ...]
    """Derivatives with respect to these states, ``(...)`` or numbers."""


class Correction(NamedTuple):
    """Updated mean and covariance, log-likelihood and squared residuals of scalar observations."""

    mean: Array
    """Updated mean, ``(n, ...)``."""
    covariance: Array
    """Updated covariance, ``(n, n, ...)``."""
    log_likelihood: Array
    """Log-density of the available observations given the prediction, ``(...)``."""
    squared_residuals: tuple[Array, ...]
    """Normalised squared residual of every observation given those before it, zero where it is not available; m arrays
    ``(...)``. Their sum is the normalised innovation squared.
    """


def update_one_by_one(
    mean: Array,
    covariance: Array,
    residual: Array,
    rows: Sequence[JacobianRow],
    variance: Array,
    available: Array,
    thresholds: Sequence[Array | float] | None = None,
    cautions: Sequence[Array | float] | None = None,
) -> Correction:
    """Update an extended Kalman filter with m independent scalar observations, one after the other.

    Args:
        mean: predicted mean, ``(n, ...)``.
        covariance: predicted covariance, ``(n, n, ...)``.
        residual: observations minus their predictions at the predicted mean, ``(m, ...)``.
        rows: rows of the Jacobian at the predicted mean.
        variance: variances of the noise, m values that broadcast against ``(...)``.
        available: one for an available observation; zero for others, which change nothing and have no
            likelihood; m values.
        thresholds: k of each observation in the robust update, m values; infinity for none. None: the plain
            update.
        cautions: factor on the variance of each observation in its gain alone, m values. None: the Kalman
            gain.
    """
    xp = namespace(mean)
    shift: Array | float = 0.0
    cost: Array | float = 0.0
    squares = []
    for j, (columns, values) in enumerate(rows):
        cross = covariance[columns[0]] * values[0]
        for column, value in zip(columns[1:], values[1:], strict=True):
            cross = cross + covariance[column] * value
        s = variance[j]
        error = residual[j]
        for column, value in zip(columns, values, strict=True):
            s = s + cross[column] * value
            if j:
                error = error - shift[column] * value  # type: ignore[index]
        if thresholds is not None:
            s = xp.maximum(s, xp.abs(error) * (variance[j] ** 0.5 / thresholds[j]))
        here = available[j]
        whitened = here * error / xp.sqrt(s)
        if cautions is None:
            # The same factor on both sides keeps the covariance exactly symmetric.
            gain = cross * (here / xp.sqrt(s))
            shift = shift + gain * whitened
            covariance = covariance - gain[:, None] * gain[None]
        else:
            explained: Array | float = 0.0
            for column, value in zip(columns, values, strict=True):
                explained = explained + cross[column] * value
            gain = cross * (here / (explained + cautions[j] * (s - explained)))
            shift = shift + gain * error
            other = cross - (0.5 * s) * gain
            covariance = covariance - (gain[:, None] * other[None] + other[:, None] * gain[None])
        square = whitened * whitened
        cost = cost + square + here * xp.log(2.0 * math.pi * s)
        squares.append(square)
    return Correction(mean + shift, covariance, -0.5 * cost, tuple(squares))
