"""Exact errors of an alpha-beta filter whose gains follow a fixed schedule.

With gains that do not depend on the data the error is linear in the noise, so its mean square follows from
:func:`.alpha_beta_errors.propagate_error`: for constant gains, for the ramp of the paper's adaptive filter when the
scan of the detection is given, and for the best schedule.
"""

import math
from typing import NamedTuple

import numpy

from ...envs.maneuvering_target.parameters import ManeuveringTargetParameters
from ...filters import alpha_beta, polar
from .alpha_beta_errors import ErrorMoments, propagate_error


class Flight(NamedTuple):
    """Manoeuvre of one flight along x, scan by scan, and the variances of its measurements."""

    displacement: numpy.ndarray
    """Displacement by the manoeuvre in each scan, m, ``(K,)``."""
    increment: numpy.ndarray
    """Change of velocity in each scan, m/s, ``(K,)``."""
    variance: numpy.ndarray
    """Variance of the measurement at the true position, from the start on, m^2, ``(K + 1,)``."""
    interval: float
    """Sampling interval T, s."""


def maneuver_flight(parameters: ManeuveringTargetParameters) -> Flight:
    """Return the paper's manoeuvre along x, as displacement and velocity change per scan, and sensor variances."""
    p, T = parameters, parameters.sampling_interval
    first, last = p.maneuver_steps
    scans = numpy.arange(1, p.horizon + 1)
    accelerating = (scans >= first) & (scans <= last)
    position = numpy.empty((2, p.horizon + 1))
    for axis in range(2):
        increments = p.acceleration[axis] * T * accelerating
        velocity = p.initial_velocity[axis] + numpy.concatenate([[0.0], numpy.cumsum(increments)])
        steps = T * velocity[:-1] + 0.5 * T * increments
        position[axis] = p.initial_position[axis] + numpy.concatenate([[0.0], numpy.cumsum(steps)])
    variance = polar.cartesian_variances(position, p.range_sigma, math.radians(p.bearing_sigma))[0]
    increment = p.acceleration[0] * T * accelerating
    return Flight(0.5 * T * increment, increment, variance, T)


class MeanSquares(NamedTuple):
    """Mean square of the error of position and of velocity in each scan."""

    position: numpy.ndarray
    """Mean square of the position error, m^2, ``(K, ...)``."""
    velocity: numpy.ndarray
    """Mean square of the velocity error, (m/s)^2, ``(K, ...)``."""


def mean_square_errors(flight: Flight, alpha: numpy.ndarray) -> MeanSquares:
    """Return the exact mean square error of an alpha-beta filter under a schedule of gains; beta by (21).

    Args:
        flight: flight to track; the track starts with the errors of (24).
        alpha: position gain of each scan, ``(K, ...)``; trailing axes are schedules side by side.
    """
    T, nothing = flight.interval, 0.0 * alpha[0]
    start = flight.variance[0]
    moments = ErrorMoments(
        nothing,
        nothing,
        alpha_beta.Covariance(start + nothing, nothing, 2.0 * start / T**2 + nothing),
    )
    beta = alpha_beta.benedict_bordner_beta(alpha)
    position, velocity = [], []
    for k in range(len(alpha)):
        moments = propagate_error(
            moments,
            (flight.displacement[k], flight.increment[k]),
            flight.variance[k + 1],
            alpha[k],
            beta[k],
            T,
        )
        position.append(moments.position**2 + moments.covariance.position)
        velocity.append(moments.velocity**2 + moments.covariance.velocity)
    return MeanSquares(numpy.stack(position), numpy.stack(velocity))


def ramp_schedule(
    low: float, high: float, horizon: int, detection: int | None = None, ramp_scans: int = 7
) -> numpy.ndarray:
    """Return the position gains ``(K,)`` of the paper's adaptive filter that detects a manoeuvre at ``detection``.

    The gain falls linearly from ``high`` at scan 1 to ``low`` at scan 1 + ``ramp_scans``; at the detection it
    jumps to ``high`` and falls again.
    """
    scan = numpy.arange(1, horizon + 1)
    step = scan - 1
    if detection is not None:
        step = numpy.where(scan >= detection, scan - detection, step)
    return high - (high - low) * numpy.minimum(step, ramp_scans) / ramp_scans


def best_schedule(flight: Flight) -> numpy.ndarray:
    """Return the position gains ``(K,)`` with the smallest sum of mean-square position errors over a flight.

    The optimisation uses the whole flight, which no causal policy knows; a policy that reacts to data may be better.
    """
    from scipy.optimize import minimize

    scans = len(flight.increment)
    nominal = float(flight.variance.mean()) * scans
    step = 1e-6
    shifts = step * numpy.eye(scans)

    def objective(alpha: numpy.ndarray) -> tuple[float, numpy.ndarray]:
        # All central differences side by side cost as much as a few schedules one by one.
        schedules = numpy.concatenate(
            [alpha[:, None], alpha[:, None] + shifts, alpha[:, None] - shifts], axis=1
        )
        total = mean_square_errors(flight, schedules).position.sum(axis=0) / nominal
        return float(total[0]), (total[1 : scans + 1] - total[scans + 1 :]) / (2.0 * step)

    result = minimize(
        objective,
        ramp_schedule(0.3, 0.7, scans, int(numpy.argmax(flight.increment != 0.0)) + 2),
        jac=True,
        method="L-BFGS-B",
        bounds=[(1e-3, 0.999)] * scans,
        options={"maxiter": 1000, "ftol": 1e-10},
    )
    return result.x
