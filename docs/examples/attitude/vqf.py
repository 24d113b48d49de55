"""VQF: strapdown integration, smoothed specific force, a slow heading, bias of the gyroscope, disturbed fields.

Written from the paper [1], batch on the last axis; ``T`` is the sampling interval, ``q`` in products turns vectors.

1. *Gyroscope.* The rate alone turns the sensor against an almost inertial frame, ``p <- p exp(T (w - bias))``.
2. *Inclination.* The specific force ``f`` in that frame is smoothed by a second-order Butterworth filter of the time
   constant ``tau_acc``: accelerations cancel over time, gravity does not. With ``a = r lowpass(p f p*) r*`` over its
   length and ``c = sqrt((a_3 + 1) / 2)``,

       r <- (c, a_2 / (2 c), -a_1 / (2 c), 0) r

3. *Heading.* With ``g`` the heading of the field in the frame of ``r p``,

       d <- d + k wrap(g - d),   k = max(1 - exp(-T / tau_mag), 1 / n) at the n-th measurement while n T < tau_mag

   and the attitude is ``q = turn(-d) r p``.
4. *Bias.* A Kalman filter of the three biases, with a slow random walk. At rest, that is while gyroscope and
   accelerometer have stayed near their own smoothed values for some time, the smoothed rate is a measurement of the
   bias. In motion, an inclination that has to be corrected all the time shows the bias: with ``R`` the rotation matrix
   of ``r p`` and ``R'`` the same smoothed like the force, the measurement of ``R' bias`` is

       (lowpass(R bias)_1 - a_2 / T, lowpass(R bias)_2 + a_1 / T, 0)

   where the third, about the vertical, hardly counts.
5. *Disturbed fields.* Norm and dip of the field are compared with those of a reference. While they differ ``k`` is
   zero, after a minute of that it is halved; a field that stays the same for a while of motion is the new reference.

The low-pass filters are the bilinear transform of the Butterworth filter with the cut-off ``sqrt(2) / (2 pi tau)``, as
state-variable filters with trapezoidal integrators [2]: in the steady state their memory is the value itself, so that
time constants may change while they run. In its first ``tau`` seconds a filter gives the mean of all so far, and then
goes on from there.

Reading: the paper's frame is east, north, up; here it is north, west, up.

[1] D. Laidig, T. Seel, VQF: highly accurate IMU orientation estimation with bias estimation and magnetic disturbance
    rejection, Information Fusion 91 (2023), 187-204, arXiv:2203.17024; constants are its defaults.
[2] V. Zavalishin, The art of VA filter design, Native Instruments, 2012, chapter 4.
"""

import math
from typing import Any, NamedTuple

from filtergym.filters.array_namespace import Array, namespace
from filtergym.filters.ordered_sums import ordered_sum

from .quaternions import (
    direction_cosines,
    exponential,
    length,
    multiply,
    normalise,
    square,
    to_world,
)

ACCELEROMETER_TIME = 3.0
"""tau_acc, s."""
MAGNETOMETER_TIME = 9.0
"""tau_mag, s."""
DEGREE = math.pi / 180.0
BIAS_SIGMA = 0.5 * DEGREE
"""Of the first estimate, rad/s."""
BIAS_FORGETTING_TIME = 100.0
"""s in which the standard deviation grows from 0 to 0.1 deg/s."""
BIAS_LIMIT = 2.0 * DEGREE
"""rad/s."""
BIAS_SIGMA_MOTION, BIAS_SIGMA_REST = 0.1 * DEGREE, 0.03 * DEGREE
"""Standard deviations to which the bias converges, rad/s."""
VERTICAL_FORGETTING = 0.0001
"""Weight of the assumption that the bias about the vertical is zero."""
REST_TIME, REST_FILTER_TIME = 1.5, 0.5
"""s."""
REST_RATE, REST_FORCE = 2.0 * DEGREE, 0.5
"""Deviations from the smoothed values that are still rest, rad/s and m/s^2."""
FIELD_FILTER_TIME, FIELD_REFERENCE_TIME = 0.05, 20.0
"""s."""
FIELD_NORM, FIELD_DIP = 0.1, 10.0 * DEGREE
"""Largest differences to the reference, relative and rad."""
NEW_FIELD_TIME, FIRST_FIELD_TIME, NEW_FIELD_RATE = 20.0, 5.0, 20.0 * DEGREE
"""How long a field must stay the same while the sensor turns at least so fast, s and rad/s."""
UNDISTURBED_TIME, REJECTION_TIME, REJECTION_FACTOR = 0.5, 60.0, 2.0
FOR_EVER = 1e12
"""Measurements after which nothing depends on their number."""


class LowPass(NamedTuple):
    """Memory of second-order low-pass filters, ``(signals, N)`` each."""

    band: Array
    """Integrator that is zero in the steady state."""
    low: Array
    """Integrator that is the value then."""
    mean: Array
    """Of all values so far."""
    number: Array
    """Values so far, ``(N,)``."""


def start_low_pass(signals: Array) -> LowPass:
    """Memory before the first value.

    Args:
        signals: array of the shape of a value.
    """
    zero = 0.0 * signals
    return LowPass(zero, zero, zero, zero[0])


def settled_low_pass(value: Array) -> LowPass:
    """Memory of a filter that has been given one value for ever."""
    return LowPass(0.0 * value, value, value, FOR_EVER + 0.0 * value[0])


def low_pass(state: LowPass, value: Array, time_constant: Any, interval: float) -> tuple[Array, LowPass]:
    """Smoothed value, and the memory after it.

    Args:
        state: before.
        value: ``(signals, N)``.
        time_constant: tau, s, a number or ``(N,)``.
        interval: T, s.
    """
    xp, number = namespace(value), state.number + 1.0
    mean = state.mean + (value - state.mean) / number
    half = interval / (math.sqrt(2.0) * time_constant)
    g = xp.tan(half) if hasattr(half, "shape") else math.tan(half)
    a1 = 1.0 / (1.0 + g * (g + math.sqrt(2.0)))
    step = value - state.low
    band = a1 * (state.band + g * step)
    low = state.low + g * band
    # The mean is smoothed further on from the steady state that it would be.
    early = (number - 1.0) * interval < time_constant
    smoothed = xp.where(early, mean, low)
    return smoothed, LowPass(
        xp.where(early, 0.0, 2.0 * band - state.band),
        xp.where(early, mean, 2.0 * low - state.low),
        mean,
        number,
    )


def wrap(angle: Array) -> Array:
    """Angle between -pi and pi, rad."""
    xp = namespace(angle)
    return angle - 2.0 * math.pi * xp.floor((angle + math.pi) / (2.0 * math.pi))


class BiasEstimate(NamedTuple):
    """Kalman filter of the gyroscope's bias, and what tells rest from motion."""

    bias: Array
    """rad/s, ``(3, N)``."""
    covariance: Array
    """``(3, 3, N)``."""
    rotation: LowPass
    """Rotation matrix to the frame in which up is up, ``(9, N)``."""
    turned: LowPass
    """Bias about the two horizontal axes of that frame, ``(2, N)``."""
    rate: LowPass
    """``(3, N)``."""
    force: LowPass
    """``(3, N)``."""
    smoothed_rate: Array
    """rad/s, ``(3, N)``."""
    rest: Array
    """How long the sensor has been at rest, s, ``(N,)``."""


class FieldWatch(NamedTuple):
    """What tells a disturbed field; times in s, all ``(N,)`` but the first."""

    smoothed: LowPass
    """Norm and dip, ``(2, N)``."""
    norm: Array
    """Of the reference; zero where there is none."""
    dip: Array
    """rad."""
    undisturbed: Array
    """How long the field has been like the reference."""
    rejected: Array
    """How long the magnetometer has been left out."""
    candidate_norm: Array
    candidate_dip: Array
    candidate: Array
    """How long the field has been like the candidate while the sensor turned."""
    disturbed: Array
    """Booleans."""


class VQF(NamedTuple):
    """State of the filter."""

    sensor: Array
    """``p``, from the sensor's frame to the almost inertial one, ``(4, N)``."""
    inclination: Array
    """``r``, from there to a frame in which up is up, ``(4, N)``."""
    heading: Array
    """``d``, of the north in that frame, rad, ``(N,)``."""
    force: LowPass
    """Specific force in the almost inertial frame, ``(3, N)``."""
    number: Array
    """Headings averaged so far, ``(N,)``."""
    bias: BiasEstimate | None
    """None where it is not estimated."""
    field: FieldWatch | None
    """None where fields are believed."""


def start_vqf(q: Array, bias: bool = True, rejection: bool = True, settled: bool = False) -> VQF:
    """State at the start.

    Args:
        q: an attitude, ``(4, N)``.
        bias: whether the bias of the gyroscope is estimated.
        rejection: whether disturbed fields are recognised.
        settled: whether that attitude is believed as if it were an average over the time constants; otherwise the first
            measurement says where up is and where north, as in [1].
    """
    xp = namespace(q)
    vector, zero = 0.0 * q[:3], 0.0 * q[0]
    nine = xp.concat([vector, vector, vector])
    estimate = BiasEstimate(
        vector,
        BIAS_SIGMA**2 * xp.reshape(xp.stack([zero + float(i % 4 == 0) for i in range(9)]), (3, 3, -1)),
        start_low_pass(nine),
        start_low_pass(vector[:2]),
        start_low_pass(vector),
        start_low_pass(vector),
        vector,
        zero,
    )
    # Without a reference nothing can be left out: the time for that is used up.
    watch = FieldWatch(
        start_low_pass(vector[:2]), zero, zero, zero, zero + REJECTION_TIME, zero, zero, zero, zero < 1.0
    )
    up = xp.stack([zero, zero, zero + 9.81])
    identity = xp.concat([1.0 + 0.0 * q[:1], vector])
    return VQF(
        q,
        identity,
        zero,
        settled_low_pass(up) if settled else start_low_pass(vector),
        FOR_EVER + zero if settled else zero,
        estimate if bias else None,
        watch if rejection else None,
    )


def vqf_step(
    state: VQF,
    rate: Array,
    accelerometer: Array,
    magnetometer: Array,
    interval: float,
    accelerometer_time: Any = ACCELEROMETER_TIME,
    magnetometer_time: Any = MAGNETOMETER_TIME,
) -> VQF:
    """State after a measurement.

    Args:
        state: before.
        rate: of the gyroscope, rad/s, ``(3, N)``.
        accelerometer: specific force, m/s^2, ``(3, N)``.
        magnetometer: field, ``(3, N)``, any unit.
        interval: T, s.
        accelerometer_time: tau_acc, s, a number or ``(N,)``.
        magnetometer_time: tau_mag, s, likewise.
    """
    xp, number = namespace(rate), state.number + 1.0
    bias = state.bias
    unbiased = rate if bias is None else rate - bias.bias
    p = normalise(multiply(state.sensor, exponential(interval * unbiased)))
    inertial = to_world(direction_cosines(p), accelerometer)
    smoothed, force = low_pass(state.force, inertial, accelerometer_time, interval)
    a = normalise(to_world(direction_cosines(state.inclination), smoothed))
    c = xp.sqrt(0.5 * xp.clip(a[2] + 1.0, 1e-12, None))
    tilt = xp.stack([c, 0.5 * a[1] / c, -0.5 * a[0] / c, 0.0 * c])
    r = normalise(multiply(tilt, state.inclination))
    rotation = direction_cosines(multiply(r, p))
    if bias is not None:
        bias = _bias_step(bias, rate, accelerometer, a, rotation, interval, accelerometer_time)
    field = to_world(rotation, magnetometer)
    difference = wrap(xp.atan2(field[1], field[0]) - state.heading)
    ratio = -interval / magnetometer_time
    gain = -xp.expm1(ratio) if hasattr(ratio, "shape") else -math.expm1(ratio)
    watch = state.field
    if watch is not None:
        turning = rate if bias is None else bias.smoothed_rate
        watch, factor = _watch_step(watch, field, length(turning), interval)
        gain = gain * factor
    # The mean of all so far, until that moves less than the filter.
    gain = xp.where(
        number * interval <= magnetometer_time, xp.maximum(1.0 / number, gain + 0.0 * number), gain
    )
    heading = wrap(state.heading + gain * difference)
    return VQF(p, r, heading, force, number, bias, watch)


def vqf_attitude(state: VQF) -> Array:
    """Attitude, ``(4, N)``."""
    xp, half = namespace(state.heading), -0.5 * state.heading
    turn = xp.stack([xp.cos(half), 0.0 * half, 0.0 * half, xp.sin(half)])
    return multiply(turn, multiply(state.inclination, state.sensor))


def _bias_step(
    estimate: BiasEstimate,
    rate: Array,
    accelerometer: Array,
    a: Array,
    rotation: Array,
    interval: float,
    accelerometer_time: Any,
) -> BiasEstimate:
    """Step 4 of the module: at rest or in motion, three scalar updates, one for each axis.

    Args:
        estimate: before.
        rate: of the gyroscope, rad/s, ``(3, N)``.
        accelerometer: specific force, m/s^2, ``(3, N)``.
        a: direction of the smoothed specific force before its correction, ``(3, N)``.
        rotation: direction cosines of ``r p``, ``(9, N)``.
        interval: T, s.
        accelerometer_time: tau_acc, s.
    """
    xp = namespace(rate)
    smoothed_rate, rate_filter = low_pass(estimate.rate, rate, REST_FILTER_TIME, interval)
    smoothed_force, force_filter = low_pass(estimate.force, accelerometer, REST_FILTER_TIME, interval)
    still = (square(rate - smoothed_rate) < REST_RATE**2) & (
        square(accelerometer - smoothed_force) < REST_FORCE**2
    )
    for i in range(3):
        still = still & (xp.abs(smoothed_rate[i]) <= BIAS_LIMIT)
    rest = xp.where(still, estimate.rest + interval, 0.0)
    at_rest = rest >= REST_TIME
    R, rotation_filter = low_pass(estimate.rotation, rotation, accelerometer_time, interval)
    bias = estimate.bias
    horizontal = xp.stack([ordered_sum(rotation[0:3] * bias), ordered_sum(rotation[3:6] * bias)])
    turned, turned_filter = low_pass(estimate.turned, horizontal, accelerometer_time, interval)
    innovation = xp.stack(
        [
            -a[1] / interval + turned[0] - ordered_sum(R[0:3] * bias),
            a[0] / interval + turned[1] - ordered_sum(R[3:6] * bias),
            -ordered_sum(R[6:9] * bias),
        ]
    )
    innovation = xp.where(at_rest, smoothed_rate - bias, innovation)
    H = [[xp.where(at_rest, float(i == j), R[3 * i + j]) for j in range(3)] for i in range(3)]
    growth = (0.1 * DEGREE) ** 2 * interval / BIAS_FORGETTING_TIME
    weights = [_noise_for(sigma, growth) for sigma in (BIAS_SIGMA_MOTION, BIAS_SIGMA_REST)]
    variances = [
        xp.where(at_rest, weights[1], weight + 0.0 * rest)
        for weight in (weights[0], weights[0], weights[0] / VERTICAL_FORGETTING)
    ]
    P = [
        [
            estimate.covariance[i, j]
            + (xp.where(estimate.covariance[i, j] < BIAS_SIGMA**2, growth, 0.0) if i == j else 0.0)
            for j in range(3)
        ]
        for i in range(3)
    ]
    left = xp.clip(innovation, -BIAS_LIMIT, BIAS_LIMIT)
    correction = [0.0 * rest] * 3
    # Independent measurements one after the other are the same as all at once.
    for row, variance, value in zip(H, variances, left, strict=True):
        PH = [ordered_sum(P[i][j] * row[j] for j in range(3)) for i in range(3)]
        S = ordered_sum(row[i] * PH[i] for i in range(3)) + variance
        remaining = value - ordered_sum(row[i] * correction[i] for i in range(3))
        correction = [correction[i] + PH[i] / S * remaining for i in range(3)]
        P = [[P[i][j] - PH[i] * PH[j] / S for j in range(3)] for i in range(3)]
    return BiasEstimate(
        xp.clip(bias + xp.stack(correction), -BIAS_LIMIT, BIAS_LIMIT),
        xp.stack([xp.stack(row) for row in P]),
        rotation_filter,
        turned_filter,
        rate_filter,
        force_filter,
        smoothed_rate,
        rest,
    )


def _noise_for(sigma: float, growth: float) -> float:
    """Variance of a measurement for which the scalar Kalman filter settles at a standard deviation.

    Args:
        sigma: standard deviation to which the estimate settles.
        growth: variance that is added before each measurement.
    """
    return sigma**4 / growth + sigma**2


def _watch_step(watch: FieldWatch, field: Array, turning: Array, interval: float) -> tuple[FieldWatch, Array]:
    """Step 5 of the module: watch after a measurement, and the factor on the gain of the heading, ``(N,)``.

    Args:
        watch: before.
        field: in a frame in which up is up, ``(3, N)``.
        turning: smoothed angular rate, rad/s, ``(N,)``.
        interval: T, s.
    """
    xp = namespace(field)
    size = length(field)
    now = xp.stack([size, -xp.asin(xp.clip(field[2] / size, -1.0, 1.0))])
    (norm, dip), smoothed = low_pass(watch.smoothed, now, FIELD_FILTER_TIME, interval)
    slow = -math.expm1(-interval / FIELD_REFERENCE_TIME)

    def alike(other_norm: Array, other_dip: Array) -> Array:
        return (xp.abs(norm - other_norm) < FIELD_NORM * other_norm) & (xp.abs(dip - other_dip) < FIELD_DIP)

    same = alike(watch.norm, watch.dip)
    undisturbed = xp.where(same, watch.undisturbed + interval, 0.0)
    settled = same & (undisturbed >= UNDISTURBED_TIME)
    disturbed = ~same | (watch.disturbed & ~settled)
    reference_norm = xp.where(settled, watch.norm + slow * (norm - watch.norm), watch.norm)
    reference_dip = xp.where(settled, watch.dip + slow * (dip - watch.dip), watch.dip)
    stays = alike(watch.candidate_norm, watch.candidate_dip)
    fast = turning >= NEW_FIELD_RATE
    time = xp.where(stays, watch.candidate + xp.where(fast, interval, 0.0), 0.0)
    follow = stays & fast
    candidate_norm = xp.where(
        stays, watch.candidate_norm + xp.where(follow, slow * (norm - watch.candidate_norm), 0.0), norm
    )
    candidate_dip = xp.where(
        stays, watch.candidate_dip + xp.where(follow, slow * (dip - watch.candidate_dip), 0.0), dip
    )
    needed = xp.where(watch.norm == 0.0, FIRST_FIELD_TIME, NEW_FIELD_TIME)
    accepted = disturbed & follow & (time >= needed)
    disturbed = disturbed & ~accepted
    rejecting = disturbed & (watch.rejected <= REJECTION_TIME)
    factor = xp.where(rejecting, 0.0, xp.where(disturbed, 1.0 / REJECTION_FACTOR, 1.0))
    rejected = xp.where(
        disturbed,
        xp.where(rejecting, watch.rejected + interval, watch.rejected),
        xp.clip(watch.rejected - REJECTION_FACTOR * interval, 0.0, None),
    )
    return (
        FieldWatch(
            smoothed,
            xp.where(accepted, candidate_norm, reference_norm),
            xp.where(accepted, candidate_dip, reference_dip),
            xp.where(accepted, UNDISTURBED_TIME, undisturbed),
            rejected,
            candidate_norm,
            candidate_dip,
            time,
            disturbed,
        ),
        factor,
    )
