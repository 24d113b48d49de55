r"""Association of plots (detections) with a track: nearest neighbour in a gate, or probabilistic (PDA).

A scan gives K plots z_i with error variances R_i, of which one at most is the target's; the others are false, uniform
with density lambda (a Poisson number in a region), and the target is seen with probability P_D. With the innovations
nu_i = z_i - H x' and S_i = H P' H^T + R_i,

    d_i^2 = nu_i^T S_i^-1 nu_i                                                                                 (1)

**Nearest neighbour**: the plot of least d_i^2 is the target's if that is below the gate, else the scan missed it.

**Probabilistic data association**: with beta_i the probability that plot i is the target's, beta_0 that none is,

    beta_0 : beta_i = 1 - P_D : (P_D / lambda) N(nu_i; 0, S_i)                                                 (2)
    x = x' + P_xz d,  d = sum_i beta_i S_i^-1 nu_i                                                             (3)
    P = P' - P_xz (sum_i beta_i S_i^-1 - sum_i beta_i S_i^-1 nu_i nu_i^T S_i^-1 + d d^T) P_zx                  (4)

(3) and (4) are the moments of the mixture of all associations: the spread of the means is in (4). The
logarithm of the sum of the right sides of (2) is the likelihood ratio of the plots to false ones alone, by
which hypotheses about the motion are weighed.

Y. Bar-Shalom and E. Tse, Tracking in a cluttered environment with probabilistic data association, Automatica 11 (1975),
451-460; Y. Bar-Shalom and T. E. Fortmann, Tracking and Data Association (1988), sections 6.3 and 6.4, also for lambda
from the number of plots.

Shapes: states ``(n, ...)``, plots ``(2, K, ...)`` with trailing axes that broadcast against those of the states.
"""

import math
from typing import NamedTuple

from . import imm
from .array_namespace import Array, namespace
from .kalman import Update
from .ordered_sums import ordered_sum
from .small_matrices import apply, mirror_lower, outer, product, transpose


class Plots(NamedTuple):
    """All plots of a scan in the window of a track, in random order."""

    position: Array
    """Positions x and y, m, ``(2, K, N)``; zero without a plot, NaN where an estimator receives them."""
    variance: Array
    """Variances of their errors, evaluated at the plots, m^2, ``(2, K, N)``."""
    available: Array
    """1 where there is a plot, 0 where not, ``(K, N)``."""


def _invert(xx: Array, xy: Array, yy: Array) -> tuple[Array, Array]:
    """Return the inverse ``(2, 2, ...)`` and the determinant of a symmetric two-by-two matrix."""
    xp, determinant = namespace(xx), xx * yy - xy * xy
    return xp.stack([xp.stack([yy, -xy]), xp.stack([-xy, xx])]) / determinant, determinant


def squared_distances(position: Array, covariance: Array, plots: Array, variances: Array) -> Array:
    """Return the squared Mahalanobis distances (1) of K plots from a predicted position, ``(K, ...)``.

    Args:
        position: predicted position, ``(2, ...)``.
        covariance: its covariance, ``(2, 2, ...)``.
        plots: positions of the plots, ``(2, K, ...)``.
        variances: variances R of their errors, ``(2, K, ...)``.
    """
    nu = plots - position[:, None]
    P = covariance[:, :, None]
    xx, yy = P[0, 0] + variances[0], P[1, 1] + variances[1]
    inverse, _ = _invert(xx, P[1, 0] + 0.0 * xx, yy)
    scaled = apply(inverse, nu)
    return nu[0] * scaled[0] + nu[1] * scaled[1]


def nearest_neighbour(distances: Array, available: Array, gate: float) -> tuple[Array, Array]:
    """Return a mask of the plot nearest to the prediction, all zero where none is in the gate, and whether
    one is.

    Args:
        distances: squared distances, ``(K, N)``.
        available: above zero where there is a plot, ``(K, N)``.
        gate: largest squared distance.

    Returns:
        One for the nearest plot and zero for the others, ``(K, N)``, and whether one is in the gate,
        ``(N,)``. Of plots equally near it is the first.
    """
    xp = namespace(distances)
    least, chosen = gate + 0.0 * distances[0], -1.0 + 0.0 * distances[0]
    for i in range(distances.shape[0]):
        nearer = (available[i] > 0.0) & (distances[i] < least)
        least, chosen = xp.where(nearer, distances[i], least), xp.where(nearer, float(i), chosen)
    picked = [xp.where(chosen == float(i), 1.0, 0.0 * least) for i in range(distances.shape[0])]
    return xp.stack(picked), chosen >= 0.0


def update_position(
    mean: Array, covariance: Array, plots: Plots, detection_probability: float, density: Array
) -> Update:
    """Return the PDA update of a track with all plots of a scan, which measure the first two state
    components.

    Args:
        mean: predicted mean, ``(n, ...)``.
        covariance: predicted covariance, ``(n, n, ...)``.
        plots: plots of the scan.
        detection_probability: P_D, probability of detection.
        density: lambda, number of false plots per unit of area, ``(...)``.

    Returns:
        The update; ``log_likelihood`` is the log of the likelihood ratio to false plots alone, and the squared distance
        the mean over the plots weighted by beta.
    """
    xp = namespace(mean)
    none = math.log(1.0 - detection_probability) + 0.0 * covariance[0, 0]
    # Density is of plots, of their ratio to it the unit is none.
    ratio = math.log(detection_probability / (2.0 * math.pi)) - xp.log(density)
    logarithms, inverses, scaled, distances = [none], [], [], []
    count = plots.available.shape[0]
    for i in range(count):
        there = plots.available[i] > 0.0
        nu = xp.where(there, plots.position[:, i] - mean[:2], 0.0)
        xx, yy = (covariance[j, j] + plots.variance[j, i] for j in range(2))
        inverse, determinant = _invert(xx, covariance[1, 0], yy)
        applied = apply(inverse, nu)
        distance = nu[0] * applied[0] + nu[1] * applied[1]
        weight = ratio - 0.5 * (distance + xp.log(determinant))
        logarithms.append(xp.where(there, weight, -math.inf))
        inverses.append(inverse)
        scaled.append(applied)
        distances.append(distance)
    stacked = xp.stack(logarithms)
    beta = imm.softmax(stacked)
    weights = [beta[i + 1] for i in range(count)]
    d = ordered_sum(b * applied for b, applied in zip(weights, scaled, strict=True))
    information = outer(d, d) + ordered_sum(
        b * (inverse - outer(applied, applied))
        for b, inverse, applied in zip(weights, inverses, scaled, strict=True)
    )
    cross = covariance[:, :2]
    reduced = covariance - product(product(cross, information), transpose(cross))
    squared = ordered_sum(b * distance for b, distance in zip(weights, distances, strict=True))
    return Update(mean + apply(cross, d), mirror_lower(reduced), imm.log_sum(stacked), squared)
