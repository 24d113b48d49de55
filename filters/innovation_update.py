r"""Kalman update with a given innovation and gain, for extended, unscented and learned filters.

    S = H P H^T + R,  K = P H^T S^-1,  x = x' + K nu,  P = (I - K H) P' (I - K H)^T + K R K^T       (Joseph form)

with the innovation ``nu = z - h(x')`` and the Jacobian H of h at x'; Bar-Shalom, Li and Kirubarajan,
Estimation with Applications to Tracking and Navigation (2001), sections 5.2 and 10.3. Entries that were not
received take no part: their rows of H and of the innovation are zero, their noise is independent and of
variance one.

Arrays have the batch last; a matrix shared by the whole batch is ``(n, n)``.
"""

import math
import operator
from collections.abc import Callable
from typing import NamedTuple

from .array_namespace import Array, namespace
from .gaussian import log_density
from .kalman import Update
from .ordered_sums import ordered_sum
from .small_matrices import apply, mirror_lower, product, solve_definite, transpose
from .unscented import GAUSSIAN, Spread, transform


class Received(NamedTuple):
    """Measurement model restricted to the received entries of a measurement."""

    innovation: Array
    """Innovation, ``(m, N)``; zero for entries not received."""
    H: Array
    """Measurement Jacobian, ``(m, n, N)``; zero rows for entries not received."""
    R: Array
    """Noise covariance, ``(m, m, N)``; identity for entries not received."""
    available: Array
    """1 for entries received, 0 for others, ``(m, N)``."""


def keep_received(innovation: Array, H: Array, R: Array, available: Array) -> Received:
    """Restrict a measurement model to the received entries: the others get zero innovation and H, and unit
    noise.

    Args:
        innovation: innovation, ``(m, N)``, finite.
        H: measurement Jacobian, ``(m, n)`` or ``(m, n, N)``.
        R: noise covariance, ``(m, m)`` or ``(m, m, N)``.
        available: 1 for entries received, 0 for others, ``(m, N)``.
    """
    H, R = (part[..., None] if part.ndim == 2 else part for part in (H, R))
    return Received(available * innovation, available[:, None] * H, _isolate_missing(R, available), available)


def _isolate_missing(S: Array, available: Array) -> Array:
    """Return a covariance ``(m, m, N)`` with rows and columns of the identity for entries not received."""
    xp = namespace(available)
    m = available.shape[0]
    identity = xp.eye(m, dtype=available.dtype, device=available.device)[..., None]
    return available[:, None] * available[None] * S + identity * (1.0 - available)


def kalman_gain(covariance: Array, received: Received) -> Array:
    """Return the Kalman gain ``(n, m, N)`` for a predicted covariance ``(n, n, N)``."""
    HP = product(received.H, covariance)
    return transpose(solve_definite(product(HP, transpose(received.H)) + received.R, HP))


def update_with_gain(mean: Array, covariance: Array, received: Received, K: Array) -> Update:
    """Return the measurement update with any gain (Joseph form), and the log-likelihood of the received
    entries.

    Args:
        mean: predicted mean, ``(n, N)``.
        covariance: predicted covariance, ``(n, n, N)``.
        received: innovation with its model.
        K: gain, ``(n, m, N)``.
    """
    xp = namespace(mean)
    nu, H, R, available = received
    identity = xp.eye(mean.shape[0], dtype=mean.dtype, device=mean.device)[..., None]
    rest = identity - product(K, H)
    joseph = product(product(rest, covariance), transpose(rest)) + product(product(K, R), transpose(K))
    joseph = 0.5 * (joseph + transpose(joseph))
    density, nis = log_density(nu, product(product(H, covariance), transpose(H)) + R)
    return Update(mean + apply(K, nu), joseph, density + _density_of_missing(available), nis)


def _density_of_missing(available: Array) -> Array:
    """Return the term ``m_missing log(2 pi) / 2`` by which a log-density exceeds that of m received entries,
    ``(N,)``.
    """
    return 0.5 * math.log(2.0 * math.pi) * ordered_sum(1.0 - available)


def unscented_update(
    mean: Array,
    covariance: Array,
    z: Array,
    h: Callable[[Array], Array],
    R: Array,
    available: Array,
    within_gates: Callable[[Array, Array], Array] | None = None,
    spread: Spread = GAUSSIAN,
    subtract: Callable[[Array, Array], Array] = operator.sub,
) -> Update:
    """Return the measurement update of an unscented Kalman filter, by sigma points.

    Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proceedings of the IEEE 92 (2004), 401-422.

    Args:
        mean: predicted mean, ``(n, N)``.
        covariance: predicted covariance, ``(n, n, N)``, positive definite.
        z: measurement, ``(m, N)``, finite also where it was not received.
        h: function from points ``(n, 2n + 1, N)`` to measurements ``(m, 2n + 1, N)``.
        R: noise covariance, ``(m, m)`` or ``(m, m, N)``.
        available: 1 for entries received, 0 for others, ``(m, N)``.
        within_gates: function from innovation ``(m, N)`` and its covariance to 1 for entries inside their gates, 0 for
            others, ``(m, N)``; the likelihood includes entries outside, too. None: there are no gates.
        spread: parameters of the transform.
        subtract: function from measurement and prediction ``(m, N)`` to the innovation; for angles the shortest
            difference, and then h returns angles that are continuous from point to point.
    """
    xp = namespace(mean)
    n = mean.shape[0]
    R = R[..., None] if R.ndim == 2 else R
    joint, spread_out = transform(mean, covariance, lambda x: xp.concat([x, h(x)]), spread)
    nu = available * subtract(z, joint[n:])
    S = _isolate_missing(spread_out[n:, n:] + R, available)
    cross = available[:, None] * spread_out[n:, :n]
    gated, taken = S, nu
    if within_gates is not None:
        kept = within_gates(nu, S)
        gated, taken, cross = _isolate_missing(S, kept), kept * nu, kept[:, None] * cross
    K = transpose(solve_definite(gated, cross))
    density, nis = log_density(nu, S)
    return Update(
        mean + apply(K, taken),
        mirror_lower(covariance - product(K, cross)),
        density + _density_of_missing(available),
        nis,
    )
