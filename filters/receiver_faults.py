r"""Faults of a satellite receiver beside an INS: slowly varying errors of the receiver, and noise of unknown level.

The INS error (delta, beta, eta) of :mod:`.loosely_coupled` is followed by the receiver's own errors e,

    e_k = psi e_{k-1} + w,        Z = Xr + h e + zeta,        X - Z = delta - h e - zeta,

each of which is one of two things:

* a coloured error (first-order Gauss-Markov): ``psi = exp(-T / tau_e)``, ``h = 1``;
* the rate of a ramp by which spoofing pulls the fixes off: ``psi = 1``, ``w = 0``, h the time since it began.

The noise zeta has an unknown level: its density is a Gaussian sum over L variances, ``p(zeta) = sum_l q_l N(0, R_l)``.
A filter of one Gaussian then updates by the score of the density of its innovation (Masreliez 1975). With
``S_l = H P H^T + R_l``, the responsibilities ``w_l ~ q_l N(nu; 0, S_l)``, ``g = sum_l w_l / S_l`` and
``c = sum_l w_l / S_l^2 - g^2``,

    x = x + P H^T g nu,        P = P - P H^T (g - c nu^2) H P,

the exact mean and covariance of the mixture of L Kalman updates, whose gains all lie along ``P H^T``.

* Alspach, Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Trans. AC 17(4), 1972.
* Masreliez, "Approximate non-Gaussian filtering with linear state and observation relations", IEEE Trans. AC 20(1),
  1975.
* Gustafsson, "Adaptive filtering and change detection", Wiley 2000, chapter 10 (filter banks, pruning and merging).
"""

import math
from typing import NamedTuple

from .array_namespace import Array, namespace
from .loosely_coupled import AugmentedCovariance, Sampling, predict_augmented
from .ordered_sums import ordered_sum


class FaultCovariance(NamedTuple):
    """Covariance of the INS error (delta, beta, eta) and of E errors of the receiver."""

    ins: AugmentedCovariance
    """Covariance of the INS error, arrays ``(...)``."""
    cross: Array
    """Covariances of delta, beta and eta with each error of the receiver, ``(3, E, ...)``."""
    faults: Array
    """Covariance of the receiver's errors, ``(E, E, ...)``."""


def predict_fault(
    P: FaultCovariance, s: Sampling, coloured: Array, white: Array, decay: Array, noise_variance: Array
) -> FaultCovariance:
    """Predict the covariance of INS and receiver errors over one step, ``F P F^T + Qd``.

    Args:
        P: covariance after the previous measurement.
        s: sampling of the INS error.
        coloured: increase of the coloured rate error's variance in a step, m^2/s^2.
        white: variance of the displacement in a step that this increase does not explain, m^2.
        decay: psi, factor on each error of the receiver in a step, ``(E, ...)``.
        noise_variance: increase of the variance of each of them in a step, ``(E, ...)``.
    """
    xp = namespace(P.cross)
    position, drift, rate = P.cross
    along = position + s.step * drift + s.drive * rate
    E = P.faults.shape[0]
    faults = [[decay[i] * decay[k] * P.faults[i, k] for k in range(E)] for i in range(E)]
    for i in range(E):
        faults[i][i] = faults[i][i] + noise_variance[i]
    return FaultCovariance(
        predict_augmented(P.ins, s, coloured, white),
        xp.stack([decay * along, decay * drift, decay * s.decay * rate]),
        xp.stack([xp.stack(row) for row in faults]),
    )


def add_fault(P: FaultCovariance, variance: Array) -> FaultCovariance:
    """Append one more receiver error, independent of all others, to the covariance.

    Args:
        P: covariance without it.
        variance: variance of the added error, ``(...)``.
    """
    xp, none = namespace(variance), 0.0 * variance
    E = P.faults.shape[0]
    row = xp.stack([none] * E + [variance])[None]
    return FaultCovariance(
        P.ins,
        xp.concat([P.cross, xp.stack([none[None]] * 3)], axis=1),
        xp.concat([xp.concat([P.faults, xp.moveaxis(row[:, :-1], 0, 1)], axis=1), row]),
    )


def matrix(P: FaultCovariance) -> Array:
    """Return the covariance of INS and receiver errors (delta, beta, eta, e) as one array,
    ``(3 + E, 3 + E, ...)``.
    """
    xp, ins = namespace(P.faults), P.ins
    first = [
        [ins.position, ins.position_drift, ins.position_coloured],
        [ins.position_drift, ins.drift, ins.drift_coloured],
        [ins.position_coloured, ins.drift_coloured, ins.coloured],
    ]
    rows = [xp.concat([xp.stack(row), P.cross[i]]) for i, row in enumerate(first)]
    return xp.stack([*rows, *(xp.concat([P.cross[:, k], P.faults[k]]) for k in range(P.faults.shape[0]))])


def from_matrix(P: Array) -> FaultCovariance:
    """Split a covariance ``(3 + E, 3 + E, ...)`` into the parts of a :class:`FaultCovariance`."""
    ins = (P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
    return FaultCovariance(AugmentedCovariance(*ins), P[:3, 3:], P[3:, 3:])


class Direction(NamedTuple):
    """Covariance ``P H^T`` of the state with a measurement ``delta - h e``, and its predicted variance ``H P H^T``."""

    position: Array
    drift: Array
    coloured: Array
    faults: Array
    """Covariances of the receiver's errors with the measurement, ``(E, ...)``."""
    variance: Array
    """``H P H^T``, m^2."""


def measured_direction(P: FaultCovariance, h: Array) -> Direction:
    """Return ``P H^T`` and ``H P H^T`` of a measurement ``delta - h e``.

    Args:
        P: predicted covariance.
        h: factor of each error of the receiver in the measurement, ``(E, ...)``.
    """
    ins, E = P.ins, range(P.faults.shape[0])

    def less(value: Array, row: Array) -> Array:
        return value - ordered_sum(h[k] * row[k] for k in E)

    position = less(ins.position, P.cross[0])
    faults = [less(P.cross[0, i], P.faults[i]) for i in E]
    return Direction(
        position,
        less(ins.position_drift, P.cross[1]),
        less(ins.position_coloured, P.cross[2]),
        namespace(position).stack(faults),
        less(position, faults),
    )


def update_fault(P: FaultCovariance, along: Direction, weight: Array) -> FaultCovariance:
    """Update the covariance of INS and receiver errors, ``P - P H^T weight H P``.

    Args:
        P: predicted covariance.
        along: ``P H^T``, from :func:`measured_direction`.
        weight: ``1 / S`` of a Kalman filter, ``g - c nu^2`` of a Gaussian sum, zero without a measurement, 1/m^2.
    """
    xp = namespace(weight)
    ins = along[:3]
    position, drift, coloured = (weight * part for part in ins)
    return FaultCovariance(
        AugmentedCovariance(
            P.ins.position - position * along.position,
            P.ins.position_drift - position * along.drift,
            P.ins.position_coloured - position * along.coloured,
            P.ins.drift - drift * along.drift,
            P.ins.drift_coloured - drift * along.coloured,
            P.ins.coloured - coloured * along.coloured,
        ),
        P.cross - xp.stack([(weight * part) * along.faults for part in ins]),
        P.faults - weight * (along.faults[:, None] * along.faults[None]),
    )


class NoiseMixture(NamedTuple):
    """Log-density, weights of the noise levels, and score of an innovation whose noise is a Gaussian sum."""

    log_density: Array
    """Log-density of the innovation on all axes, ``(...)``."""
    responsibilities: Array
    """``w_l`` of the L levels, which sum to one, ``(L, ...)``."""
    score: Array
    """Score g, 1/m^2."""
    spread: Array
    """Derivative c of the score, 1/m^4."""


def weigh_levels(
    squares: Array, axes: int, variance: Array, levels: Array, probabilities: Array
) -> NoiseMixture:
    """Return the posterior weights of noise levels, the log-density and the score of an innovation.

    The terms are scaled by the exponential of the highest level, so that no innovation makes all of them
    vanish.

    Args:
        squares: squared innovation, summed over the axes, m^2, ``(...)``.
        axes: number of axes, all with the same variances.
        variance: ``H P H^T``, m^2, ``(...)``.
        levels: variances ``R_l`` in ascending order, m^2, ``(L, ...)`` that broadcast.
        probabilities: ``q_l``, same shape; that of the highest level above zero.
    """
    xp = namespace(squares)
    precision = 1.0 / (variance + levels)
    half = -0.5 * squares
    height = precision if axes == 2 else xp.sqrt(precision)
    height = height * precision if axes == 3 else height
    terms = probabilities * height * xp.exp(half * (precision - precision[-1]))
    total = ordered_sum(terms)
    log_density = half * precision[-1] + xp.log(total) - 0.5 * axes * math.log(2.0 * math.pi)
    weights = terms / total
    weighted = weights * precision
    score = ordered_sum(weighted)
    spread = ordered_sum(weighted * precision) - score * score
    return NoiseMixture(log_density, weights, score, spread)
