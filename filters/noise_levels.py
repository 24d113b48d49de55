r"""Bank of Kalman filters for switching levels of process noise, with sensors whose noise levels switch, too.

Hypothesis j assumes a level g_j of the process noise, ``Q_j = g_j^2 Q_s + Q_o``. Before each step the level of
hypothesis i changes with probability c_i, and the new one is j with probability pi_j, whatever it was. With p_i the
probabilities after the last measurement and v_i = c_i p_i, V = sum_i v_i,

    p'_j = (1 - c_j) p_j + pi_j V                                                                              (1)
    x_0 = sum_i v_i x_i / V,  P_0 = sum_i v_i (P_i + d_i d_i^T) / V,  d_i = x_i - x_0                          (2)
    x'_j = a_j x_j + (1 - a_j) x_0,  a_j = (1 - c_j) p_j / p'_j                                                (3)
    P'_j = a_j P_j + (1 - a_j) P_0 + a_j (1 - a_j) d_j d_j^T                                                   (4)

which is the mixing of the interacting multiple model (H. A. P. Blom and Y. Bar-Shalom, IEEE Trans. Automatic Control 33
(1988), 780-783) with the transition matrix ``(1 - c_i) delta_ij + c_i pi_j``, in H steps in place of H^2.

The standard deviation of a sensor's noise is one of L levels, a Markov chain of its own; within hypothesis j
the probabilities of the levels of sensor k are q_kl. A reading is then taken in with the Gaussian sum of L
variances, merged by its moments (:func:`.receiver_faults.weigh_levels`; D. L. Alspach and H. W. Sorenson,
IEEE Trans. Automatic Control 17 (1972), 439-448). Sensors with independent noise are processed one after the
other; their order has a small influence.

Shapes: means ``(n, H, N)``, packed covariances ``(n (n + 1) / 2, H, N)``, probabilities ``(H, N)``, those of the levels
of a sensor ``(L, H, N)``.
"""

from collections.abc import Sequence
from typing import NamedTuple

from . import receiver_faults
from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum
from .packed_covariance import column

LEAST_PROBABILITY = 1e-30
"""Least probability of a hypothesis before a step, so that it can return and no weight is zero by zero."""


class LevelHypotheses(NamedTuple):
    """Estimates of H hypotheses on the noise levels, and their probabilities."""

    mean: Array
    """Means, ``(n, H, N)``."""
    covariance: Array
    """Packed covariances, ``(n (n + 1) / 2, H, N)``."""
    probability: Array
    """Probabilities of the hypotheses, ``(H, N)``."""
    sensors: tuple[Array, ...]
    """Probabilities of the levels of each sensor, ``(L, H, N)``."""

    def take(self, part: slice) -> "LevelHypotheses":
        """Return the hypotheses of a slice."""
        return LevelHypotheses(
            self.mean[:, part],
            self.covariance[:, part],
            self.probability[part],
            tuple(q[:, part] for q in self.sensors),
        )


def outer_products(deviation: Array) -> Array:
    """Return the outer products ``d d^T`` of vectors ``(n, ...)`` as packed lower triangles."""
    xp = namespace(deviation)
    return xp.concat([deviation[j:] * deviation[j] for j in range(deviation.shape[0])], axis=0)


class Moments(NamedTuple):
    """Mean and packed covariance of a mixture of hypotheses."""

    mean: Array
    covariance: Array
    total: Array
    """Sum of the weights, ``(N,)``."""
    shares: Array
    """Weights over their sum, ``(H, N)``."""


def merge(mean: Array, covariance: Array, weights: Array) -> Moments:
    """Return mean and packed covariance of a mixture of H hypotheses, equation (2).

    Args:
        mean: means, ``(n, H, N)``.
        covariance: packed covariances, ``(n (n + 1) / 2, H, N)``.
        weights: weights, ``(H, N)``, with a sum above zero.
    """
    total = ordered_sum(weights)
    shares = weights / total
    many = range(weights.shape[0])
    centre = ordered_sum(shares[i] * mean[:, i] for i in many)
    spread = ordered_sum(shares[i] * (covariance[:, i] + outer_products(mean[:, i] - centre)) for i in many)
    return Moments(centre, spread, total, shares)


def switch(
    before: LevelHypotheses, change: Array, prior: Array, sensor_change: Array, levels: Array
) -> LevelHypotheses:
    """Mix H hypotheses before a step, in which their levels may change, equations (1) to (4).

    Args:
        before: hypotheses after the last measurement.
        change: c, probability of a change, ``(H, 1)``; above zero for one at least.
        prior: pi, probability of the new hypothesis, ``(H, 1)``; zero: nothing changes to it.
        sensor_change: probability that a sensor's level changes, by hypothesis, ``(H, 1)``.
        levels: probabilities of the level that a sensor changes to, ``(L, 1, 1)``.
    """
    xp = namespace(before.mean)
    probability = xp.clip(before.probability, LEAST_PROBABILITY, None)
    pool = merge(before.mean, before.covariance, change * probability)
    stay = (1.0 - change) * probability
    after = stay + prior * pool.total
    own = stay / after
    other = 1.0 - own
    mean, covariance = before.mean, before.covariance
    deviation = mean - pool.mean[:, None]
    sensors = []
    for q in before.sensors:
        pooled = ordered_sum(pool.shares[i] * q[:, i] for i in range(q.shape[1]))
        mixed = own * q + other * pooled[:, None]
        sensors.append((1.0 - sensor_change) * mixed + sensor_change * levels)
    return LevelHypotheses(
        mean - other * deviation,
        own * covariance + other * pool.covariance[:, None] + (own * other) * outer_products(deviation),
        after,
        tuple(sensors),
    )


class SensorUpdate(NamedTuple):
    """Result of an update with the reading of one sensor under all hypotheses."""

    mean: Array
    covariance: Array
    levels: Array
    """Probabilities of the sensor's levels, ``(L, H, N)``."""
    log_density: Array
    """Log-density of the reading, ``(H, N)``; zero without one."""
    nis: Array
    """Squared innovation over its variance, averaged over the levels, ``(H, N)``; zero without a reading."""


class SensorNoise(NamedTuple):
    """Levels of a sensor's noise, their probabilities, and the share and variance of outliers."""

    variances: Array
    """Variances of the levels, ascending, ``(L, H, 1)``."""
    probabilities: Array
    """Probabilities of the levels, ``(L, H, N)``."""
    outlier: float = 0.0
    """Probability that a reading is an outlier, at any level."""
    outlier_variance: float = 0.0
    """Variance of outliers, above that of every level."""


def update_sensor(
    mean: Array, covariance: Array, z: Array, rows: Sequence[int], noise: SensorNoise, available: Array
) -> SensorUpdate:
    """Update all hypotheses with the reading of one sensor, whose noise has one of several levels.

    Args:
        mean: predicted means, ``(n, H, N)``.
        covariance: predicted covariances, packed.
        z: reading, ``(N,)``; where not available any finite number.
        rows: coordinates whose sum the sensor measures.
        noise: distribution of the sensor's noise level.
        available: 1 where there is a reading and 0 where there is none, ``(N,)``.
    """
    xp, n = namespace(mean), mean.shape[0]
    along = ordered_sum(covariance[column(n, i)] for i in rows)
    innovation = available * (z - ordered_sum(mean[i] for i in rows))
    squared = innovation * innovation
    variance = ordered_sum(along[i] for i in rows)
    variances, q = noise.variances, noise.probabilities
    if noise.outlier:
        variances = xp.concat([variances, 0.0 * variances[:1] + noise.outlier_variance])
        q = xp.concat([(1.0 - noise.outlier) * q, 0.0 * q[:1] + noise.outlier])
    mixture = receiver_faults.weigh_levels(squared, 1, variance, variances, q)
    levels = mixture.responsibilities
    if noise.outlier:  # an outlier does not inform about the level
        levels = levels[:-1] + levels[-1] * noise.probabilities
    weighted = (available * (mixture.score - mixture.spread * squared)) * along
    return SensorUpdate(
        mean + along * (mixture.score * innovation),
        covariance - xp.concat([weighted[j:] * along[j] for j in range(n)], axis=0),
        available * levels + (1.0 - available) * noise.probabilities,
        available * mixture.log_density,
        mixture.score * squared,
    )
