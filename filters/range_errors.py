r"""Slowly varying errors of pseudoranges as additional states of :mod:`.gnss_ins`.

A pseudorange is off by e_j beside its white noise, one such error for each of S satellites. The state is
``[lambda (17), e_1 ... e_S]``. An error is a first-order Gauss-Markov process (multipath, atmosphere, ephemerides),

    e_k = psi e_{k-1} + w,        rho_j = |s_j - X| + D' + e_j + white noise,                                  (1)

and it may be drawn anew before any measurement, as where another reflection replaces the last one: with probability p
it is N(m, v), whatever it was. Of the two predictions "held" (0) and "renewed" (1), the innovation nu_i of the
pseudorange has the variance S_i, and the posterior probability of the second one is

    pi = p N(nu_1; 0, S_1) / [(1 - p) N(nu_0; 0, S_0) + p N(nu_1; 0, S_1)].                                    (2)

Both predictions differ in e_j alone. They are merged with these weights before the update: the mean of e_j is
``(1 - pi) e_j + pi m``, its covariances with other states are multiplied by ``1 - pi``, and its variance is

    (1 - pi) P_jj + pi v + pi (1 - pi) (e_j - m)^2.                                                            (3)

Reading: merging after both *updates* would take two updates of the whole covariance; for pi of zero or one
the result is the same.

:func:`take_reading` is the update by one scalar observation whose noise is a Gaussian sum over L variances, with the
score and its derivative of :func:`.receiver_faults.weigh_levels` (Masreliez 1975): ``x += P h^T g nu``,
``P -= (g - c nu^2) P h^T h P``. With one variance it is Kalman's.

Sources: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with applications to tracking and navigation, Wiley 2001,
sections 8.2 (coloured measurement noise) and 11.6 (merging); P. D. Groves, Principles of GNSS, inertial, and
multisensor integrated navigation systems, 2013, section 14.2.

Shapes: states ``(17 + S, ...)``, covariances ``(17 + S, 17 + S, ...)``, batch last.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from . import gnss_ins
from .array_namespace import Array, namespace
from .extended_kalman import JacobianRow
from .receiver_faults import weigh_levels

LARGEST_PROBABILITY = 1.0 - 1e-12
"""Largest probability of a renewal, so that its odds are finite."""


def start(mean: Array, covariance: Array, satellites: int, variance: Array) -> tuple[Array, Array]:
    """Append range errors of mean zero to the mean and covariance of the first 17 states.

    Args:
        mean: mean of the first 17 states, ``(17, N)``.
        covariance: their covariance, ``(17, 17, N)``.
        satellites: number S of satellites.
        variance: variance of each range error, m^2, ``(N,)``.
    """
    xp, none = namespace(mean), 0.0 * mean[0]
    size = gnss_ins.SIZE + satellites
    empty = xp.stack([none] * size)
    rows = [xp.concat([covariance[i], empty[:satellites]]) for i in range(gnss_ins.SIZE)]
    for j in range(gnss_ins.SIZE, size):
        rows.append(xp.concat([empty[:j], (none + variance)[None], empty[j + 1 :]]))
    return xp.concat([mean, empty[:satellites]]), xp.stack(rows)


def advance(state: Array, axis: Array, T: float, decay: float, persistence: Array | list[Array]) -> Array:
    """Multiply a vector or matrix of states with range errors by the transition matrix, ``F x`` or ``F P``.

    Args:
        state: x or P, ``(17 + S, ...)``.
        axis: transition matrix of (x, v, a), ``(3, 3, ...)``, see :func:`.gnss_ins.advance`.
        T: step, s.
        decay: factor of the attitude rates.
        persistence: psi, factor on a range error in a step, broadcast against ``(...)``; or a list of one for each.
    """
    known = gnss_ins.SIZE
    if isinstance(persistence, list):
        errors = namespace(state).stack([psi * state[known + j] for j, psi in enumerate(persistence)])
    else:
        errors = persistence * state[known:]
    return namespace(state).concat([gnss_ins.advance(state, axis, T, decay), errors], axis=0)


def predict(
    mean: Array,
    covariance: Array,
    axis: Array,
    T: float,
    decay: float,
    Q: Array,
    persistence: Array | list[Array],
    noise_variance: Array | list[Array],
) -> tuple[Array, Array]:
    """Return the predicted means ``F x`` and covariances ``F P F^T + Q`` of M hypotheses.

    Args:
        mean: means, ``(17 + S, M, N)``.
        covariance: covariances, ``(17 + S, 17 + S, M, N)``.
        axis: transition matrices of (x, v, a), ``(3, 3, M, 1)``.
        T: step, s.
        decay: factor of the attitude rates.
        Q: covariance of the process noise of the first 17 states, with zeros beyond, ``(17 + S, 17 + S, M, 1)``.
        persistence: psi, factor on a range error, ``(N,)`` or a number; or a list of one for each error.
        noise_variance: variance of w, m^2, same shape.
    """
    xp = namespace(mean)
    moved = advance(covariance, axis, T, decay, persistence)
    both = advance(xp.moveaxis(moved, 0, 1), axis, T, decay, persistence) + Q
    for j in range(gnss_ins.SIZE, mean.shape[0]):
        own = noise_variance[j - gnss_ins.SIZE] if isinstance(noise_variance, list) else noise_variance
        both = _replace(both, j, both[j], both[j, j] + own)
    return advance(mean, axis, T, decay, persistence), both


def observe(
    state: Array, satellite_position: Array, satellite_velocity: Array, ins_angles: Array, gravity: float
) -> tuple[Array, list[JacobianRow]]:
    """Return the predicted observations of a state with range errors, and their Jacobian rows.

    Arguments as of :func:`.gnss_ins.observe`.
    """
    expected, rows = gnss_ins.observe(state, satellite_position, satellite_velocity, ins_angles, gravity)
    errors = state[gnss_ins.SIZE :]
    S = errors.shape[0]
    ranges = [
        JacobianRow((*row.columns, gnss_ins.SIZE + j), (*row.values, 1.0)) for j, row in enumerate(rows[:S])
    ]
    return namespace(state).concat([expected[:S] + errors, expected[S:]]), [*ranges, *rows[S:]]


class SequentialUpdate(NamedTuple):
    """Intermediate state of an update by one scalar observation after the other."""

    shift: Array
    """Mean minus predicted mean, ``(n, ...)``."""
    covariance: Array
    """Covariance after the observations so far, ``(n, n, ...)``."""
    log_likelihood: Array
    """Log-density of the observations so far, given the prediction, ``(...)``."""
    squared_distance: Array
    """Normalised innovation squared of the observations so far, ``(...)``."""


def begin(mean: Array, covariance: Array) -> SequentialUpdate:
    """Return the state of a sequential update before its first observation: no shift, zero log-likelihood."""
    none = 0.0 * mean[0]
    return SequentialUpdate(0.0 * mean, covariance, none, none)


def innovation_of(state: SequentialUpdate, residual: Array, row: JacobianRow) -> tuple[Array, Array, Array]:
    """Return the innovation of an observation given those before, ``P h^T`` of shape ``(n, ...)``, and
    ``h P h^T``.

    Args:
        state: state before the observation.
        residual: residual at the predicted mean, ``(...)``.
        row: row of the Jacobian at the predicted mean.
    """
    cross: Array = 0.0
    for column, value in zip(*row, strict=True):
        cross = cross + state.covariance[column] * value
    variance: Array = 0.0
    for column, value in zip(*row, strict=True):
        variance = variance + cross[column] * value
        residual = residual - state.shift[column] * value
    return residual, cross, variance


def take_reading(
    state: SequentialUpdate,
    residual: Array,
    row: JacobianRow,
    levels: Array,
    probabilities: Array,
    available: Array,
) -> tuple[SequentialUpdate, Array]:
    """Update with a scalar observation whose noise is a Gaussian sum; return also the noise levels' weights.

    Args:
        state: state before the observation.
        residual: residual at the predicted mean, ``(...)``; any finite number where it is not available.
        row: row of the Jacobian at the predicted mean.
        levels: variances in ascending order, ``(L, ...)`` that broadcast.
        probabilities: probabilities of the levels, same shape; that of the highest one above zero.
        available: one with an observation, zero without.

    Returns:
        The state after it, and the responsibilities of the levels, ``(L, ...)``, which are meaningless without an
        observation.
    """
    error, cross, variance = innovation_of(state, residual, row)
    square = error * error
    noise = weigh_levels(square, 1, variance, levels, probabilities)
    weight = available * (noise.score - noise.spread * square)
    after = SequentialUpdate(
        state.shift + cross * (available * noise.score * error),
        state.covariance - weight * (cross[:, None] * cross[None]),
        state.log_likelihood + available * noise.log_density,
        state.squared_distance + available * noise.score * square,
    )
    return after, noise.responsibilities


class Renewal(NamedTuple):
    """Distribution of a range error that may have been drawn anew; arrays that broadcast against ``(...)``."""

    probability: Array
    """Probability p of a renewal."""
    mean: Array
    """Mean m of a new error, m."""
    variance: Array
    """Variance v of a new error, m^2."""


def take_pseudorange(
    state: SequentialUpdate,
    predicted: Array,
    place: int,
    residual: Array,
    row: JacobianRow,
    variance: float,
    renewal: Renewal,
    available: Array,
) -> SequentialUpdate:
    """Update with a pseudorange whose slowly varying error may have been drawn anew, (2) and (3).

    Args:
        state: state before the observation.
        predicted: predicted mean of the range error, ``(...)``.
        place: index of the range error among the states.
        residual: residual at the predicted mean, ``(...)``.
        row: row of the Jacobian at the predicted mean; the derivative by the range error is one.
        variance: variance of the white noise, m^2.
        renewal: distribution of a new error.
        available: one with a pseudorange, zero without.
    """
    xp = namespace(predicted)
    error, cross, known = innovation_of(state, residual, row)
    own, P = predicted + state.shift[place], state.covariance[place, place]
    p = xp.clip(renewal.probability, None, LARGEST_PROBABILITY)
    held = known + variance
    renewed = held - 2.0 * cross[place] + P + renewal.variance
    other = error + own - renewal.mean
    difference = 0.5 * (error * error / held - other * other / renewed + xp.log(held / renewed))
    odds = p / (1.0 - p) * xp.exp(available * xp.clip(difference, -600.0, 600.0))
    pi = odds / (1.0 + odds)
    stay, apart = 1.0 - pi, own - renewal.mean
    merged = _replace(
        state.covariance,
        place,
        stay * state.covariance[place],
        stay * P + pi * renewal.variance + pi * stay * apart * apart,
    )
    shift = xp.concat(
        [state.shift[:place], (state.shift[place] - pi * apart)[None], state.shift[place + 1 :]]
    )
    log_density = xp.log((1.0 - p) * (1.0 + odds)) - 0.5 * (
        error * error / held + xp.log(2.0 * math.pi * held)
    )
    error, cross, known = innovation_of(state._replace(shift=shift, covariance=merged), residual, row)
    total = available / (known + variance)
    return SequentialUpdate(
        shift + cross * (total * error),
        merged - total * (cross[:, None] * cross[None]),
        state.log_likelihood + available * log_density,
        state.squared_distance + total * error * error,
    )


def _replace(covariance: Array, place: int, values: Sequence[Array], own: Array) -> Array:
    """Replace the row, column and variance of one state in a covariance."""
    xp = namespace(covariance)
    row = xp.concat([values[:place], own[None], values[place + 1 :]])
    covariance = xp.concat([covariance[:place], row[None], covariance[place + 1 :]])
    return xp.concat([covariance[:, :place], row[:, None], covariance[:, place + 1 :]], axis=1)
