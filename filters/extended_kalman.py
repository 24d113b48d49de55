r"""Three forms of the measurement update of an extended Kalman filter, equal to rounding.

With the prediction x', P', the residual nu = y - S(x'), the Jacobian H = dS/dx at x' and noise covariance R:

    gain form         K = P' H^T (H P' H^T + R)^-1
                      x = x' + K nu,   P = (I - K H) P' (I - K H)^T + K R K^T            (Joseph)
    information form  P = (P'^-1 + H^T R^-1 H)^-1,   x = x' + P H^T R^-1 nu              (step 6)
    one by one        for every scalar observation j with variance r_j:
                      s = h P h^T + r_j,  g = P h^T / sqrt(s),  nu' = nu_j - h (x - x')
                      x += g nu' / sqrt(s),  P -= g g^T

The step numbers are those of Moroz's paper on an adaptive multi-hypothesis measurer. The third form needs R
diagonal; it inverts nothing, keeps P exactly symmetric, uses the zeros of h, leaves out what is not
available, and its terms nu'^2 / s are independent contributions to the normalised innovation squared, in the
order in which the observations are taken. For 17 states and 14 observations it takes as long as one
stacked product of 31 x 31 matrices.

Reading: steps 5 and 6 of the paper write the Jacobian once through the picked parameters v = c x and once
directly; one Jacobian with respect to the state is used.

Shapes: mean ``(n, ...)``, covariance ``(n, n, ...)``, residual ``(m, ...)``, batch last.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from .array_namespace import Array, namespace


class JacobianRow(NamedTuple):
    """Non-zero part of one row of a Jacobian."""

    columns: tuple[int, ...]
    """Which states enter."""
    values: tuple[Array | float, ...]
    """Derivative with respect to each of them, ``(...)`` or a number."""


class Correction(NamedTuple):
    """Result of an update by scalar observations."""

    mean: Array
    """``(n, ...)``."""
    covariance: Array
    """``(n, n, ...)``."""
    log_likelihood: Array
    """Log-density of the available observations given the prediction, ``(...)``."""
    squared_residuals: tuple[Array, ...]
    """Of every observation, its normalised residual squared given those before it, zero where it is not
    available; m arrays ``(...)``. Their sum is the normalised innovation squared."""


def _leading(stack: Array) -> Array:
    """Move the two last axes of a stack of matrices to the front."""
    return namespace(stack).moveaxis(stack, (-2, -1), (0, 1))


def _trailing(matrix: Array) -> Array:
    """Move the two leading axes to the end, where stacked products take them."""
    return namespace(matrix).moveaxis(matrix, (0, 1), (-2, -1))


def _column(vector: Array) -> Array:
    return namespace(vector).moveaxis(vector, 0, -1)[..., None]


def dense(rows: Sequence[JacobianRow], like: Array) -> Array:
    """Full matrix ``(m, n, ...)`` of a Jacobian given by its non-zero parts.

    Args:
        rows: m rows.
        like: a state ``(n, ...)``, for size and kind.
    """
    xp = namespace(like)
    zero = xp.zeros_like(like[0])
    matrix = []
    for columns, values in rows:
        row = [zero] * like.shape[0]
        for column, value in zip(columns, values, strict=True):
            row[column] = zero + value
        matrix.append(xp.stack(row))
    return xp.stack(matrix)


def update_gain_form(
    mean: Array, covariance: Array, residual: Array, H: Array, R: Array
) -> tuple[Array, Array]:
    """Mean and covariance after a measurement, by the Kalman gain and Joseph's form.

    Args:
        mean: predicted, ``(n, ...)``.
        covariance: predicted, ``(n, n, ...)``.
        residual: ``(m, ...)``.
        H: Jacobian, ``(m, n, ...)``.
        R: covariance of the noise, ``(m, m, ...)``.
    """
    xp = namespace(mean)
    P, H, R, nu = _trailing(covariance), _trailing(H), _trailing(R), _column(residual)
    HP = H @ P
    K = xp.linalg.solve(HP @ H.mT + R, HP).mT
    rest = xp.eye(mean.shape[0], dtype=mean.dtype, device=mean.device) - K @ H
    joseph = rest @ P @ rest.mT + K @ R @ K.mT
    return mean + xp.moveaxis((K @ nu)[..., 0], -1, 0), _leading(joseph)


def update_information_form(
    mean: Array, covariance: Array, residual: Array, H: Array, R: Array
) -> tuple[Array, Array]:
    """Mean and covariance after a measurement, step 6 of the paper; arguments of :func:`update_gain_form`.

    The predicted covariance must be invertible.
    """
    xp = namespace(mean)
    P, H, R, nu = _trailing(covariance), _trailing(H), _trailing(R), _column(residual)
    weighted = xp.linalg.solve(R, H).mT
    posterior = xp.linalg.inv(xp.linalg.inv(P) + weighted @ H)
    return mean + xp.moveaxis((posterior @ (weighted @ nu))[..., 0], -1, 0), _leading(posterior)


def update_one_by_one(
    mean: Array,
    covariance: Array,
    residual: Array,
    rows: Sequence[JacobianRow],
    variance: Array,
    available: Array,
) -> Correction:
    """Mean, covariance and likelihood after m independent scalar observations.

    Args:
        mean: predicted, ``(n, ...)``.
        covariance: predicted, ``(n, n, ...)``.
        residual: ``(m, ...)``, all of them at the predicted mean.
        rows: the Jacobian at the predicted mean.
        variance: of the noise, m values that broadcast against ``(...)``.
        available: one where an observation is there, zero where it is not; m values, likewise.

    Returns:
        The update; an observation that is not available changes nothing and has no likelihood.
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
        here = available[j]
        whitened = here * error / xp.sqrt(s)
        # The same factor on both sides keeps the covariance exactly symmetric.
        gain = cross * (here / xp.sqrt(s))
        shift = shift + gain * whitened
        covariance = covariance - gain[:, None] * gain[None]
        square = whitened * whitened
        cost = cost + square + here * xp.log(2.0 * math.pi * s)
        squares.append(square)
    return Correction(mean + shift, covariance, -0.5 * cost, tuple(squares))
