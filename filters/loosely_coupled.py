r"""Loosely coupled INS and GNSS on one axis: INS error model, plain scheme, augmented error state.

    INS      dX/dt  = dXr/dt + beta + eta + xi,     beta constant,  d eta/dt = -eta / tau + w
    GNSS     Z      = Xr + zeta
    plain    dXh/dt = dX/dt + K (Z - Xh),           K = sqrt(Ge / N) when settled
    error    d delta/dt = beta + eta + xi,          delta = X - Xr,  X - Z = delta - zeta

``xi`` has the intensity G, ``zeta`` N, ``eta`` the stationary variance ``sigma^2``, ``beta`` the variance
``sigma_b^2``. This is Fig. 3 of the paper by Benkafo and Lobaty; its (4) and (5) with A = 0 and the
equivalent white intensity Ge give the plain scheme.

Reading: the paper does not say how the INS enters (3). Its increment replaces ``A Xh + U``, which is the same
as filtering ``X - Z`` with an error that walks at random.
Reading: "the systematic errors are compensated" holds for the plain scheme as an attenuation, of a constant
rate error to ``beta / K``; only the augmented scheme, which estimates (delta, beta, eta), removes it.

The filters compute ``Xh = X - delta_h`` of the position itself, with the innovation ``nu = Z - Xh``.
Everything is elementwise in the batch; one covariance serves all axes of space.
"""

import math
from typing import NamedTuple

import numpy

from .array_namespace import Array
from .linear_systems import Matrix, van_loan


def error_model(
    drift: float, coloured: float, correlation_time: float, white_intensity: float
) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, noise intensity and initial covariance of the continuous INS error model (delta, beta, eta).

    Args:
        drift: standard deviation of the constant rate error, m/s.
        coloured: stationary standard deviation of the coloured rate error, m/s.
        correlation_time: correlation time of the coloured rate error, s.
        white_intensity: G, intensity of the white rate error, m^2/s.

    Returns:
        ``A``, ``B G B^T`` and the covariance at the start, where INS and reference agree, each ``(3, 3)``.
    """
    A = numpy.array([[0.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0 / correlation_time]])
    BGBt = numpy.diag([white_intensity, 0.0, 2.0 * coloured**2 / correlation_time])
    return A, BGBt, numpy.diag([0.0, drift**2, coloured**2])


class Sampling(NamedTuple):
    """Coefficients of the sampled INS error, ``delta += step beta + drive eta + dd``, ``eta = decay eta + de``."""

    step: float
    """Sampling interval, s."""
    drive: float
    """Displacement per unit of the coloured rate error at the start of the step, s."""
    decay: float
    """Factor on the coloured rate error in a step."""
    coloured: float
    """Standard deviation of ``de`` per unit of the stationary one."""
    coupling: float
    """Regression of ``dd`` on ``de``, s."""
    residual: float
    """Variance of ``dd`` that ``de`` does not explain, per unit of the stationary variance, s^2."""


def sampling(correlation_time: float, step: float) -> Sampling:
    """Return the exact discrete coefficients of the INS error, for a coloured rate error of unit variance."""
    A, BGBt, _ = error_model(0.0, 1.0, correlation_time, 0.0)
    Phi, Qd = van_loan(A, BGBt, step)
    coupling = Qd[0, 2] / Qd[2, 2]
    return Sampling(
        step,
        float(Phi[0, 2]),
        float(Phi[2, 2]),
        math.sqrt(Qd[2, 2]),
        float(coupling),
        max(float(Qd[0, 0] - coupling * Qd[0, 2]), 0.0),
    )


def steady_state_gain(growth: Array, R: Array) -> Array:
    """Return the steady-state gain of the sampled plain scheme, ``P / (P + R)`` with the steady prediction P.

    ``P = q / 2 + sqrt(q^2 / 4 + q R)``; the gain is ``sqrt(Ge / N) step`` at first order in the step.

    Args:
        growth: q, increase of the error's variance in a step, ``Ge step``, m^2.
        R: variance of a measurement, ``N / step``, m^2.
    """
    P = growth / 2 + (growth * growth / 4 + growth * R) ** 0.5
    return P / (P + R)


def update_variance(P: Array, R: Array, gain: Array) -> Array:
    """Return the variance after an update with any gain, ``(1 - gain)^2 P + gain^2 R`` (Joseph form), m^2."""
    rest = 1.0 - gain
    return rest * rest * P + gain * gain * R


class PlainVariance(NamedTuple):
    """Variances of the plain scheme's error under any gain, by two error models; arrays of one shape, m^2."""

    assumed: Array
    """Variance by the scheme's own model: only white noise of an equivalent intensity."""
    modelled: Array
    """Variance with every rate error of :func:`error_model`."""
    with_drift: Array
    """Covariance of the error with the displacement ``step beta``."""
    with_coloured: Array
    """Covariance of the error with the displacement ``drive eta``."""


def predict_plain(
    P: PlainVariance, s: Sampling, growth: float, drift: float, coloured: float, white_intensity: float
) -> PlainVariance:
    """Predict the variances of the plain scheme over one step.

    Args:
        P: variances after the previous measurement.
        s: sampling of the INS error.
        growth: increase of the error's variance in a step by the scheme's own model, ``Ge step``, m^2.
        drift: standard deviation of the constant rate error, m/s.
        coloured: stationary standard deviation of the coloured rate error, m/s.
        white_intensity: G, intensity of the white rate error, m^2/s.
    """
    by_drift, by_coloured = (s.step * drift) ** 2, (s.drive * coloured) ** 2
    coupled = s.coupling * (s.coloured * coloured) ** 2
    apart = white_intensity * s.step + s.residual * coloured**2 + s.coupling * coupled
    return PlainVariance(
        P.assumed + growth,
        P.modelled + 2.0 * (P.with_drift + P.with_coloured) + (by_drift + by_coloured + apart),
        P.with_drift + by_drift,
        s.decay * P.with_coloured + (s.decay * by_coloured + s.drive * coupled),
    )


def update_plain(P: PlainVariance, R: Array, gain: Array) -> PlainVariance:
    """Update the variances of the plain scheme with any gain that does not depend on innovations (Joseph
    form).

    Args:
        P: predicted variances.
        R: variance of the measurement, m^2.
        gain: gain; zero where there is no measurement.
    """
    rest = 1.0 - gain
    kept, noise = rest * rest, gain * gain * R
    return PlainVariance(
        kept * P.assumed + noise, kept * P.modelled + noise, rest * P.with_drift, rest * P.with_coloured
    )


def best_constant_gain(
    drift: float, coloured: float, correlation_time: float, white_intensity: float, receiver_intensity: float
) -> float:
    """Return the gain K, 1/s, with the least steady mean square error of the plain scheme.

    From (6) for ``d Delta/dt = -K Delta + beta + eta + xi - K zeta`` the settled mean square error is
    ``(sigma_b / K)^2 + sigma^2 / (K (K + 1/tau)) + (G + K^2 N) / (2 K)``, m^2, convex in K.

    Args:
        drift: standard deviation of the constant rate error, m/s.
        coloured: stationary standard deviation of the coloured rate error, m/s.
        correlation_time: of the coloured rate error, s.
        white_intensity: G, m^2/s.
        receiver_intensity: N, m^2 s.

    Raises:
        ValueError: the INS has no error, so that the best gain is zero.
    """
    if not max(drift, coloured, white_intensity) > 0:
        raise ValueError("the best gain of a perfect INS is zero; give it a rate error")
    from scipy.optimize import brentq

    rate = 1.0 / correlation_time

    def slope(K: float) -> float:
        return (
            -2.0 * drift**2 / K**3
            - coloured**2 * (2.0 * K + rate) / (K * (K + rate)) ** 2
            + (receiver_intensity - white_intensity / K**2) / 2.0
        )

    low, high = 1.0, 1.0
    while slope(low) > 0:
        low /= 2.0
    while slope(high) < 0:
        high *= 2.0
    return float(brentq(slope, low, high, xtol=1e-12, rtol=1e-12))


class AugmentedCovariance(NamedTuple):
    """Covariance of (delta, beta, eta): six arrays of one shape."""

    position: Array
    """Variance of delta, m^2."""
    position_drift: Array
    """Covariance of delta and beta, m^2/s."""
    position_coloured: Array
    """Covariance of delta and eta, m^2/s."""
    drift: Array
    """Variance of beta, m^2/s^2."""
    drift_coloured: Array
    """Covariance of beta and eta, m^2/s^2."""
    coloured: Array
    """Variance of eta, m^2/s^2."""


def predict_augmented(
    P: AugmentedCovariance, s: Sampling, coloured: Array, white: Array
) -> AugmentedCovariance:
    """Predict the covariance of (delta, beta, eta) over one step, ``F P F^T + Qd``.

    Args:
        P: covariance after the previous measurement.
        s: sampling of the INS error.
        coloured: increase of the coloured rate error's variance in a step, m^2/s^2.
        white: variance of the displacement in a step that this increase does not explain, m^2.
    """
    position = P.position + s.step * P.position_drift + s.drive * P.position_coloured
    drift = P.position_drift + s.step * P.drift + s.drive * P.drift_coloured
    cross = P.position_coloured + s.step * P.drift_coloured + s.drive * P.coloured
    coupled = s.coupling * coloured
    return AugmentedCovariance(
        position + s.step * drift + s.drive * cross + (s.coupling * coupled + white),
        drift,
        s.decay * cross + coupled,
        P.drift,
        s.decay * P.drift_coloured,
        s.decay**2 * P.coloured + coloured,
    )


class AugmentedFilterGain(NamedTuple):
    """Gains of delta, beta and eta."""

    position: Array
    drift: Array
    """Gain of beta, 1/s."""
    coloured: Array
    """Gain of eta, 1/s."""


def update_augmented(
    P: AugmentedCovariance, R: Array, available: Array
) -> tuple[AugmentedFilterGain, AugmentedCovariance]:
    """Return the Kalman gains and the updated covariance of (delta, beta, eta) for a measurement of delta.

    ``K = P H^T / S``, ``P - K S K^T``; the position variance ``P R / S`` is positive whatever the rounding.

    Args:
        P: predicted covariance.
        R: variance of the measurement, m^2.
        available: one where there is a measurement, zero where there is none.
    """
    weight = available / (P.position + R)
    gain = AugmentedFilterGain(weight * P.position, weight * P.position_drift, weight * P.position_coloured)
    return gain, AugmentedCovariance(
        P.position - gain.position * P.position,
        P.position_drift - gain.position * P.position_drift,
        P.position_coloured - gain.position * P.position_coloured,
        P.drift - gain.drift * P.position_drift,
        P.drift_coloured - gain.drift * P.position_coloured,
        P.coloured - gain.coloured * P.position_coloured,
    )


def update_augmented_by(P: AugmentedCovariance, R: Array, gain: AugmentedFilterGain) -> AugmentedCovariance:
    """Return the covariance of (delta, beta, eta) after an update with any gain (Joseph form).

    ``(I - K H) P (I - K H)^T + K R K^T`` for a measurement of delta.

    Args:
        P: predicted covariance.
        R: variance of the measurement, m^2.
        gain: K; zero where there is no measurement.
    """
    rest = 1.0 - gain.position
    drift = P.position_drift - gain.drift * P.position
    coloured = P.position_coloured - gain.coloured * P.position
    noise = gain.position * R
    return AugmentedCovariance(
        rest * rest * P.position + noise * gain.position,
        rest * drift + noise * gain.drift,
        rest * coloured + noise * gain.coloured,
        P.drift - gain.drift * (P.position_drift + drift) + gain.drift * gain.drift * R,
        P.drift_coloured
        - gain.coloured * P.position_drift
        - gain.drift * coloured
        + gain.drift * gain.coloured * R,
        P.coloured - gain.coloured * (P.position_coloured + coloured) + gain.coloured * gain.coloured * R,
    )
