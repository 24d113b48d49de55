"""The IMM over alpha-beta filters without the environment, in several readings of the paper.

The paper leaves open which covariance stands in the likelihood (11) of filters with fixed gains, and whether one mode
variable serves both axes. The environment has the canonical reading only (the covariance of the gains used, mixed with
the spread of the means, one mode for both axes). The others run here, on the measurements of its episodes.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy

from ...filters import alpha_beta, imm, kalman
from ...filters.gaussian import log_density
from .alpha_beta_errors import variance_reduction


class Recording(NamedTuple):
    """Radar measurements and truth of N episodes of K scans."""

    start: numpy.ndarray
    """Estimate at scan 0: x, y (m), vx, vy (m/s), ``(4, N)``."""
    start_variance: numpy.ndarray
    """Variance of its position, m^2, ``(2, N)``; that of the velocity is 2 / T^2 times this."""
    measurement: numpy.ndarray
    """Measured position, m, ``(K, 2, N)``."""
    variance: numpy.ndarray
    """Variance evaluated at the measured position, m^2, ``(K, 2, N)``."""
    truth: numpy.ndarray
    """x, y, vx, vy, ``(K, 4, N)``."""
    interval: float
    """Sampling interval T, s."""


Likelihood = Literal["gains used", "no spread", "Kalman", "R/(1-alpha)", "steady"]


@dataclass(frozen=True)
class Reading:
    """One reading of the paper, where it leaves choices open; the default is the canonical one."""

    gains: tuple[float, ...] = (0.3, 0.7)
    stay: float = 0.9
    """Probability of staying in a mode; the rest is shared among the others."""
    likelihood: Likelihood = "gains used"
    """Innovation covariance S of (11). "gains used": covariance of the gains in force (Joseph form), mixed
    with the spread of the means. "no spread": mixed without it. "Kalman": the covariance follows the optimal
    gain with Q = 0. "R/(1-alpha)": what a steady Kalman filter of that gain would have. "steady": R times one
    plus the steady prediction variance of the gain for white noise."""
    per_axis: bool = False
    """One IMM, with its own mode probabilities, for each axis."""


def _diagonal(values: numpy.ndarray) -> numpy.ndarray:
    d = len(values)
    return numpy.eye(d).reshape(d, d, *[1] * (values.ndim - 1)) * values


def _kalman_covariance(P: numpy.ndarray, R: numpy.ndarray) -> numpy.ndarray:
    """Return the covariances ``(2 d, 2 d, M, N)`` after a Kalman update by positions of variances R ``(d, N)``."""
    n, modes, lanes = len(P), P.shape[2], P.shape[3]
    repeated = _diagonal(numpy.tile(R, (1, modes)))
    nothing = numpy.zeros((n, modes * lanes))
    H = numpy.eye(n)[: n // 2]
    flat = P.reshape(n, n, -1)
    return kalman.update(nothing, flat, nothing[: n // 2], H, repeated).covariance.reshape(P.shape)


def interacting_multiple_model(recording: Recording, reading: Reading) -> numpy.ndarray:
    """Run the IMM in one reading of the paper over recorded measurements, and return its errors.

    Returns:
        Estimate minus truth: x, y (m), vx, vy (m/s), ``(K, 4, N)``.
    """
    T, modes = recording.interval, len(reading.gains)
    # One IMM per axis is one IMM of a single coordinate on twice as many lanes: first all x, then all y.
    d = 1 if reading.per_axis else 2
    scans, lanes = len(recording.measurement), recording.start.shape[1]
    alpha = numpy.asarray(reading.gains)[:, None]
    beta = alpha_beta.benedict_bordner_beta(alpha)
    leave = (1.0 - reading.stay) / (modes - 1)
    transition = numpy.full((modes, modes), leave) + (reading.stay - leave) * numpy.eye(modes)
    start = recording.start.reshape(2 * d, -1)
    variance = recording.start_variance.reshape(d, -1)
    mean = numpy.stack([start] * modes, axis=1)
    P = numpy.stack([_diagonal(numpy.concatenate([variance, 2.0 / T**2 * variance]))] * modes, axis=2)
    probabilities = numpy.full((modes, start.shape[1]), 1.0 / modes)
    error = numpy.empty((scans, 4, lanes))
    for k in range(scans):
        z, R = recording.measurement[k].reshape(d, -1), recording.variance[k].reshape(d, -1)
        prediction = imm.predict_mode_probabilities(transition, probabilities)
        mixed, mixed_P = imm.mix(mean, P, prediction.mixing)
        if reading.likelihood == "no spread":
            mixed_P = numpy.einsum("abin,ijn->abjn", P, prediction.mixing)
        predicted = alpha_beta.predict(mixed[:d], mixed[d:], T)
        P = alpha_beta.predict_joint_covariance(mixed_P, T)
        innovation = z[:, None] - predicted
        noise = R[:, None] + 0.0 * alpha
        if reading.likelihood == "R/(1-alpha)":
            S = _diagonal(noise / (1.0 - alpha))
        elif reading.likelihood == "steady":
            S = _diagonal(noise * (1.0 + variance_reduction(alpha, beta).prediction))
        else:
            S = P[:d, :d] + _diagonal(noise)
        log_likelihood, _ = log_density(innovation, S)
        probabilities = imm.mode_posterior(imm.log_probabilities(prediction.probabilities), log_likelihood)
        mean = numpy.concatenate(alpha_beta.update(predicted, mixed[d:], innovation, alpha, beta, T))
        if reading.likelihood == "Kalman":
            P = _kalman_covariance(P, R)
        else:
            P = alpha_beta.update_joint_covariance(P, R[:, None], alpha, beta, T)
        estimate = (probabilities * mean).sum(axis=1)
        error[k] = estimate.reshape(4, lanes) - recording.truth[k]
    return error
