r"""Kalman filter on covariances stored as lower triangles (packed), with sensors of single coordinates.

A symmetric ``(n, n, N)`` is stored as ``(n (n + 1) / 2, N)``: the columns of its lower triangle one after the
other, ``P00, P10, P20, ..., P11, P21, ...``. It takes almost half the arithmetic, and its prediction is one
matrix product over the whole batch: ``F P F^T`` is linear in P.

Measurements of single coordinates with independent noise are taken in one after the other,

    S = P_ii + R,   K = P_:i / S,   x = x + K (z - x_i),   P = P - K P_i:

which needs no inverse and is the joint update (12) of the paper by Gridnev, Rusetski and Rak exactly. K is
the Kalman gain of the P in use, so the short form is the Joseph form here.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy

from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum


def position(n: int, i: int, j: int) -> int:
    """Return the row of element (i, j) in the packed triangle of an ``n`` by ``n`` matrix."""
    i, j = max(i, j), min(i, j)
    return j * n - j * (j - 1) // 2 + i - j


def column(n: int, j: int) -> list[int]:
    """Return a list of the rows of the packed triangle that contain column j of the matrix."""
    return [position(n, i, j) for i in range(n)]


def diagonal(n: int) -> list[int]:
    """Return a list of the rows of the packed triangle that contain the diagonal."""
    return [position(n, i, i) for i in range(n)]


def pack(P: Array) -> Array:
    """Return the lower triangle of symmetric matrices ``(n, n, ...)``, packed as ``(n (n + 1) / 2, ...)``."""
    return namespace(P).concat([P[j:, j] for j in range(P.shape[0])], axis=0)


def unpack(packed: Array, n: int) -> Array:
    """Return the symmetric matrices ``(n, n, ...)`` of packed lower triangles ``(n (n + 1) / 2, ...)``."""
    return packed[_matrix(n)]


@functools.cache
def _matrix(n: int) -> numpy.ndarray:
    """Return the row of the packed triangle that contains each element of the matrix, ``(n, n)``."""
    return numpy.array([column(n, j) for j in range(n)])


def propagator(F: numpy.ndarray) -> numpy.ndarray:
    """Return the matrix M with ``pack(F P F^T) = M pack(P)``, square of n (n + 1) / 2 rows."""
    n = len(F)
    M = numpy.zeros((n * (n + 1) // 2,) * 2)
    for j in range(n):
        for i in range(j, n):
            for a in range(n):
                for b in range(n):
                    M[position(n, i, j), position(n, a, b)] += F[i, a] * F[j, b]
    return M


class PackedUpdate(NamedTuple):
    """Updated mean and packed covariance, log-likelihood and NIS of measurements of coordinates."""

    mean: Array
    """Updated mean, ``(n, N)``."""
    covariance: Array
    """Updated covariance, packed, ``(n (n + 1) / 2, N)``."""
    log_likelihood: Array
    """Log-density of the available measurements given the prediction, ``(N,)``."""
    squared_distance: Array
    """Normalised innovation squared, chi-square with as many degrees of freedom as measurements, ``(N,)``."""


def update_coordinates(
    mean: Array,
    covariance: Array,
    z: Array,
    coordinates: Sequence[int | tuple[int, ...]],
    R: Array,
    available: Array,
) -> PackedUpdate:
    """Update mean and packed covariance with independent measurements of coordinates, or of sums of
    coordinates.

    Args:
        mean: predicted mean, ``(n, N)``.
        covariance: predicted covariance, packed, ``(n (n + 1) / 2, N)``.
        z: readings, ``(m, N)``; where not available any finite number.
        coordinates: index of the coordinate that each sensor measures, or indices of those whose sum it measures.
        R: variances of the readings, ``(m,)`` or ``(m, N)``.
        available: 1 where there is a reading and 0 where there is none, ``(m, N)``.
    """
    xp = namespace(mean)
    n = mean.shape[0]
    squared_distance = determinant = None
    for k, read in enumerate(coordinates):
        rows = (read,) if isinstance(read, int) else read
        p = ordered_sum(covariance[column(n, i)] for i in rows)
        S = ordered_sum(p[i] for i in rows) + R[k]
        innovation = z[k] - ordered_sum(mean[i] for i in rows)
        weight = available[k] / S
        scaled = weight * innovation
        mean = mean + p * scaled
        gain = p * weight
        covariance = covariance - xp.concat([gain[j:] * p[j] for j in range(n)], axis=0)
        distance = scaled * innovation
        volume = xp.where(available[k] > 0.0, 2.0 * math.pi * S, 1.0)
        squared_distance = distance if squared_distance is None else squared_distance + distance
        determinant = volume if determinant is None else determinant * volume
    return PackedUpdate(mean, covariance, -0.5 * (squared_distance + xp.log(determinant)), squared_distance)


class GainModel(NamedTuple):
    """Covariance and variances from which a Kalman gain is computed, where they differ from those of the filter."""

    covariance: Array
    """Predicted covariance, packed, ``(n (n + 1) / 2, N)``."""
    R: Array
    """Variances of the readings, ``(m, N)``."""


class UpdateWithGain(NamedTuple):
    """Result of an update of single coordinates with the gain of another covariance, which is updated, too."""

    mean: Array
    """Updated mean, ``(n, N)``."""
    covariance: Array
    """Updated covariance, packed, ``(n (n + 1) / 2, N)``."""
    gain_covariance: Array
    """Covariance from which the gain is computed, updated with it, packed."""


def update_coordinates_with_gain(
    mean: Array,
    covariance: Array,
    z: Array,
    coordinates: Sequence[int],
    R: Array,
    available: Array,
    gain_model: GainModel,
) -> UpdateWithGain:
    """Update mean and packed covariance with single coordinates, by the Kalman gain of another covariance M.

    One coordinate i after the other, with the columns m of M and p of P::

        k = m / (m_i + R'),  x = x + k (z - x_i),  P = P - k u^T - u k^T,  u = p - k (p_i + R) / 2,  M = M - k m^T

    which is ``x + K nu`` and ``(I - K H) P (I - K H)^T + K R K^T`` with the joint gain of M and R'.

    Args:
        mean: predicted mean, ``(n, N)``.
        covariance: predicted covariance, packed, ``(n (n + 1) / 2, N)``.
        z: readings, ``(m, N)``; where not available any finite number.
        coordinates: index of the coordinate that each sensor measures.
        R: variances of the readings, ``(m, N)``.
        available: 1 where there is a reading and 0 where there is none, ``(m, N)``.
        gain_model: M and R'.
    """
    xp = namespace(mean)
    n, M = mean.shape[0], gain_model.covariance
    for k, i in enumerate(coordinates):
        p, q = covariance[column(n, i)], M[column(n, i)]
        gain = q * (available[k] / (q[i] + gain_model.R[k]))
        mean = mean + gain * (z[k] - mean[i])
        u = p - gain * (0.5 * (p[i] + R[k]))
        covariance = covariance - xp.concat([gain[j:] * u[j] + u[j:] * gain[j] for j in range(n)], axis=0)
        M = M - xp.concat([gain[j:] * q[j] for j in range(n)], axis=0)
    return UpdateWithGain(mean, covariance, M)
