r"""Faults of a satellite receiver beside an INS: an error that the receiver adds, and noise whose level nobody knows.

The INS error (delta, beta, eta) of :mod:`.loosely_coupled` gets a fourth state, the receiver's own error e,

    e_k = psi e_{k-1} + w,        Z = Xr + h e + zeta,        X - Z = delta - h e - zeta,

which is one of two things:

* a coloured error (first-order Gauss-Markov): ``psi = exp(-T / tau_e)``, ``h = 1``;
* the rate of a ramp by which spoofing pulls the fixes off: ``psi = 1``, ``w = 0``, h the time since it began.

The noise zeta has an unknown level: its density is a Gaussian sum over L variances, ``p(zeta) = sum_l q_l N(0, R_l)``.
A filter of one Gaussian then updates by the score of the density of its innovation (Masreliez 1975). With
``S_l = H P H^T + R_l``, the responsibilities ``w_l ~ q_l N(nu; 0, S_l)``, ``g = sum_l w_l / S_l`` and
``c = sum_l w_l / S_l^2 - g^2``,

    x = x + P H^T g nu,        P = P - P H^T (g - c nu^2) H P,

the exact mean and covariance of the mixture of L Kalman updates, whose gains all lie along ``P H^T``.

Sources of these:

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
    """Covariance of (delta, beta, eta, e): that of the INS error, and four arrays of the same shape."""

    ins: AugmentedCovariance
    position_fault: Array
    """Of delta and e, m times the unit of e."""
    drift_fault: Array
    coloured_fault: Array
    fault: Array
    """Variance of e."""


def predict_fault(
    P: FaultCovariance, s: Sampling, coloured: Array, white: Array, decay: Array = 1.0, gained: Array = 0.0
) -> FaultCovariance:
    """Covariance after one step without a measurement, ``F P F^T + Qd``.

    Args:
        P: after the previous measurement.
        s: sampling of the INS error.
        coloured: variance that the coloured rate error gains in a step, m^2/s^2.
        white: variance of the displacement in a step that this gain does not explain, m^2.
        decay: psi, what is left of the receiver's error after a step.
        gained: variance that the receiver's error gains in a step.
    """
    along = P.position_fault + s.step * P.drift_fault + s.drive * P.coloured_fault
    return FaultCovariance(
        predict_augmented(P.ins, s, coloured, white),
        decay * along,
        decay * P.drift_fault,
        decay * s.decay * P.coloured_fault,
        decay * decay * P.fault + gained,
    )


class Direction(NamedTuple):
    """``P H^T`` of a measurement ``delta - h e``, and the variance ``H P H^T`` that is predicted for it."""

    position: Array
    drift: Array
    coloured: Array
    fault: Array
    variance: Array
    """m^2."""


def measured_direction(P: FaultCovariance, h: Array) -> Direction:
    """Direction along which a measurement changes the estimate.

    Args:
        P: of the prediction.
        h: share of the receiver's error in the measurement.
    """
    position = P.ins.position - h * P.position_fault
    fault = P.position_fault - h * P.fault
    return Direction(
        position,
        P.ins.position_drift - h * P.drift_fault,
        P.ins.position_coloured - h * P.coloured_fault,
        fault,
        position - h * fault,
    )


def update_fault(P: FaultCovariance, along: Direction, weight: Array) -> FaultCovariance:
    """Covariance after an update, ``P - P H^T weight H P``.

    Args:
        P: of the prediction.
        along: of :func:`measured_direction`.
        weight: ``1 / S`` of a Kalman filter, ``g - c nu^2`` of a Gaussian sum, zero without a measurement, 1/m^2.
    """
    position, drift, coloured, fault = (weight * part for part in along[:4])
    ins = AugmentedCovariance(
        P.ins.position - position * along.position,
        P.ins.position_drift - position * along.drift,
        P.ins.position_coloured - position * along.coloured,
        P.ins.drift - drift * along.drift,
        P.ins.drift_coloured - drift * along.coloured,
        P.ins.coloured - coloured * along.coloured,
    )
    return FaultCovariance(
        ins,
        P.position_fault - position * along.fault,
        P.drift_fault - drift * along.fault,
        P.coloured_fault - coloured * along.fault,
        P.fault - fault * along.fault,
    )


class NoiseMixture(NamedTuple):
    """What an innovation says under noise that is a Gaussian sum."""

    log_density: Array
    """Of the innovation on all axes, ``(...)``."""
    responsibilities: Array
    """``w_l`` of the L levels, which sum to one, ``(L, ...)``."""
    score: Array
    """g, 1/m^2."""
    spread: Array
    """c, 1/m^4."""


def weigh_levels(
    squares: Array, axes: int, variance: Array, levels: Array, probabilities: Array
) -> NoiseMixture:
    """Weigh the levels of a measurement's noise by its innovation.

    The terms are scaled by the exponential of the highest level, which is the largest of them, so that no innovation,
    however large, makes all of them vanish.

    Args:
        squares: squared innovation, summed over the axes, m^2, ``(...)``.
        axes: number of axes, all with the same variances.
        variance: ``H P H^T``, m^2, ``(...)``.
        levels: variances ``R_l`` in ascending order, m^2, ``(L, ...)`` that broadcast.
        probabilities: ``q_l``, likewise; that of the highest level above zero.
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
