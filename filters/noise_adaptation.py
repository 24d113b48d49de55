r"""Adaptive estimation of noise variances from a filter's own innovations and residuals.

Sage and Husa, "Adaptive filtering with unknown prior statistics", Joint Automatic Control Conference (1969):

    R_k = (1 - d_k) R_k-1 + d_k (nu^2 - H P' H^T)               unbiased, but it can become negative       (1)
    R_k = (1 - d_k) R_k-1 + d_k (epsilon^2 + H P H^T)           positive whatever the data                 (2)
    Q_k = (1 - d_k) Q_k-1 + d_k (K nu nu^T K^T + P - F P_k-1 F^T)                                          (3)
    d_k = (1 - b) / (1 - b^(k+1))                                                                          (4)

with the innovation ``nu = z - H x'``, the residual ``epsilon = z - H x``, P' and P the covariances before and
after the update, b the forgetting factor. (2) is the paper's estimate with the filtered state in place of the
smoothed one; unlike (1) it is biased unless the filter's R is right, and it is not used here.

Mehra, "Approaches to adaptive filtering", IEEE Transactions on Automatic Control 17(5), 1972, covariance
matching over the last W measurements (after "On the identification of variances and adaptive Kalman filtering",
15(2), 1970):

    R_k = 1/W sum of (nu^2 - H P' H^T)                                                                     (5)

Särkkä and Nummenmaa, "Recursive noise adaptive Kalman filtering by variational Bayesian approximations", IEEE
Transactions on Automatic Control 54(3), 2009: every variance has an inverse-gamma distribution with shape alpha and
scale beta,

    alpha' = rho alpha,  beta' = rho beta                                                                  (6)
    alpha = alpha' + 1/2,  beta = beta' + epsilon^2 / 2 + H P H^T / 2,  R = beta / alpha                     (7)

where epsilon and P come from the Kalman update with that R, so (7) is iterated from ``beta = beta'`` on.

Measurements are independent of each other: R is diagonal and everything is elementwise, ``(m, N)`` or ``(N,)``.
``available`` is 1 where there is a measurement and 0 where there is none; there nothing is learned or forgotten,
and all other arguments may be any finite number. In units of the reading of a sensor (innovations over the
reported deviation) the same functions estimate the factor by which the report is wrong.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum

State = TypeVar("State")


class Level(NamedTuple):
    """An estimated variance or factor on a covariance, and the number of samples that it averages."""

    value: Array
    """Variance or factor, in the unit of the samples squared."""
    weight: Array
    """Effective number of samples, more than zero; one at the start gives equation (4)."""


def fading_mean(level: Level, sample: Array, forgetting: float, available: Array | float = 1.0) -> Level:
    """Return the exponentially fading mean with one more sample, equation (4): weights ``forgetting^k``.

    Args:
        level: mean before.
        sample: sample of the same unit and shape.
        forgetting: b, above 0 and at most 1.
        available: 1 with a sample, 0 without.
    """
    weight = level.weight + available * (1.0 - (1.0 - forgetting) * level.weight)
    return Level(level.value + (available / weight) * (sample - level.value), weight)


def sage_husa(
    level: Level,
    innovation: Array,
    predicted: Array,
    forgetting: float,
    least: Array | float,
    available: Array | float = 1.0,
) -> Level:
    """Return Sage and Husa's estimate (1) of a measurement's noise variance, limited from below.

    Args:
        level: variance before.
        innovation: innovation nu.
        predicted: variance of the predicted measurement, ``H P' H^T``.
        forgetting: b, above 0 and at most 1.
        least: lower limit of the variance.
        available: 1 with a measurement, 0 without.
    """
    after = fading_mean(level, innovation**2 - predicted, forgetting, available)
    return after._replace(value=namespace(after.value).clip(after.value, least, None))


def process_noise_factor(correction: Array, updated: Array, carried: Array, unit: Array) -> Array:
    """Return a sample of the factor on the process noise, ``(N,)``, from the diagonal of (3), averaged over
    coordinates.

    Its mean is the true factor if the filter uses the right one. Without a measurement it is the factor that the filter
    uses. Single samples are often negative: average them with :func:`fading_mean` and limit the average from below.

    Args:
        correction: ``K nu`` of the c coordinates to use, ``(c, N)``.
        updated: their variances after the update, ``(c, N)``.
        carried: their variances predicted without process noise, the diagonal of ``F P F^T``, ``(c, N)``.
        unit: their variances by the process noise of factor one, ``(c,)`` lists or ``(c, N)``, above zero.
    """
    c = len(unit)
    return ordered_sum((correction[i] ** 2 + updated[i] - carried[i]) / unit[i] for i in range(c)) / c


def start_window(variance: Array, size: int) -> Array:
    """Return the window of equation (5) filled with an initial variance, ``(size, ...)``."""
    return namespace(variance).stack([variance] * size, axis=0)


def mehra(
    window: Array,
    innovation: Array,
    predicted: Array,
    least: Array | float,
    available: Array | float = 1.0,
) -> tuple[Array, Array]:
    """Return Mehra's estimate (5) of a measurement's noise variance, limited from below, and the updated
    window.

    Args:
        window: the last samples, the oldest first, ``(W, ...)``.
        innovation: innovation nu.
        predicted: variance of the predicted measurement, ``H P' H^T``.
        least: lower limit of the variance.
        available: 1 with a measurement, 0 without.
    """
    xp = namespace(window)
    sample = innovation**2 - predicted
    there = available + 0.0 * sample > 0.0
    window = xp.where(there, xp.concat([window[1:], sample[None]], axis=0), window)
    return xp.clip(ordered_sum(window) / window.shape[0], least, None), window


class InverseGamma(NamedTuple):
    """Inverse-gamma distribution of a noise variance."""

    shape: Array
    """Shape alpha: half the effective number of measurements."""
    scale: Array
    """Scale beta, in the unit of the variance."""

    @property
    def variance(self) -> Array:
        """Variance R of equation (7): the inverse of the mean of 1 / R."""
        return self.scale / self.shape


def forget(noise: InverseGamma, forgetting: float, available: Array | float = 1.0) -> InverseGamma:
    """Return the noise distribution with the same variance and less weight, before a measurement, equation
    (6).

    Args:
        noise: distribution after the previous measurement.
        forgetting: rho, above 0 and at most 1.
        available: 1 with a measurement now, 0 without; the paper forgets by the clock, so that after a gap a single
            measurement would decide.
    """
    kept = 1.0 - (1.0 - forgetting) * available
    return InverseGamma(kept * noise.shape, kept * noise.scale)


def variational_bayes(
    noise: InverseGamma,
    update: Callable[[Array], tuple[Array, Array, State]],
    iterations: int,
    available: Array | float = 1.0,
) -> tuple[InverseGamma, State]:
    """Return the noise distribution and the state after a measurement, by the fixed point of equation (7).

    Args:
        noise: distribution from :func:`forget`.
        update: function from the variances R to the residual epsilon after the Kalman update, the variance ``H P H^T``
            of the measured quantity after it, each like R, and the state.
        iterations: number of updates, at least 1; the paper finds two enough.
        available: 1 with a measurement, 0 without.

    Returns:
        The distribution, and the state of the last update.
    """
    shape = noise.shape + 0.5 * available
    residual, updated, state = update(noise.scale / shape)
    for _ in range(iterations - 1):
        scale = noise.scale + 0.5 * available * (residual**2 + updated)
        residual, updated, state = update(scale / shape)
    return InverseGamma(shape, noise.scale + 0.5 * available * (residual**2 + updated)), state
