r"""Kalman update with measurements of which an unknown few have far larger errors than stated (outliers).

The error is normal with variance R, or with probability g an outlier of variance k^2 R (the contaminated normal:
J. W. Tukey, A survey of sampling from contaminated distributions, 1960). Either hypothesis i has its innovation
covariance S_i = P_zz + R_i, and with the innovation nu and the posterior weights w_i the two updates together have the
moments (the Gaussian-sum update of H. W. Sorenson and D. L. Alspach, Automatica 7 (1971), 465-479, merged)

    x = x' + P_xz sum_i w_i S_i^-1 nu                                                                          (1)
    P = P' - P_xz (sum_i w_i S_i^-1 - w_0 w_1 d d^T) P_zx,  d = (S_0^-1 - S_1^-1) nu                           (2)

The spread of the means is in (2): a measurement that may be an outlier enlarges the covariance. For g = 0 both are
Kalman's.

(2) is the short form: its rounding is relative to P', not to P. P stays positive definite after jumps of 3000
standard deviations, not of 10 000.

Shapes: states ``(n, ...)``, batch last.
"""

import math

from . import imm
from .array_namespace import Array, namespace
from .kalman import Update
from .small_matrices import apply, mirror_lower, outer, product, transpose


def update_position(
    mean: Array, covariance: Array, z: Array, variance: Array, probability: float, factor: float
) -> Update:
    """Return the update with measurements of the first two state components, which may be outliers.

    Args:
        mean: predicted mean, ``(n, ...)``.
        covariance: predicted covariance, ``(n, n, ...)``.
        z: measurements, ``(2, ...)``.
        variance: R of measurements that are no outliers, ``(2, ...)``.
        probability: g, probability of an outlier; zero: none.
        factor: k, factor on its standard deviation.

    Returns:
        The update, with the log-density of the mixture; the squared distance is the weighted mean of both.
    """
    xp = namespace(mean)
    innovation = z - mean[:2]
    deviations = [(1.0, 1.0 - probability), *([(factor, probability)] if probability > 0.0 else [])]
    inverses, distances, weighted = [], [], []
    for deviation, prior in deviations:
        xx, yy = (covariance[i, i] + deviation**2 * variance[i] for i in range(2))
        xy = covariance[1, 0]
        determinant = xx * yy - xy * xy
        inverse = xp.stack([xp.stack([yy, -xy]), xp.stack([-xy, xx])]) / determinant
        scaled = apply(inverse, innovation)
        distance = innovation[0] * scaled[0] + innovation[1] * scaled[1]
        inverses.append((inverse, scaled))
        distances.append(distance)
        weighted.append(math.log(prior) - math.log(2.0 * math.pi) - 0.5 * (distance + xp.log(determinant)))
    (information, scaled), squared, log_likelihood = inverses[0], distances[0], weighted[0]
    if probability > 0.0:
        # From e^40 on the outlier is certain in double precision, and up to e^80 the odds are a number in single.
        odds = xp.exp(xp.clip(weighted[1] - weighted[0], -700.0, 80.0))
        outlier = odds / (1.0 + odds)
        log_likelihood = imm.log_sum(xp.stack(weighted))
        difference = scaled - inverses[1][1]
        information = (1.0 - outlier) * information + outlier * inverses[1][0]
        information = information - outlier * (1.0 - outlier) * outer(difference, difference)
        scaled = scaled - outlier * difference
        squared = squared + outlier * (distances[1] - squared)
    cross = covariance[:, :2]
    reduced = covariance - product(product(cross, information), transpose(cross))
    return Update(mean + apply(cross, scaled), mirror_lower(reduced), log_likelihood, squared)
