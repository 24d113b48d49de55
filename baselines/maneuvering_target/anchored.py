"""A Kalman filter of positions with slow errors that uses odometry, and the initial values of its fit."""

import math
from typing import Any

import numpy

from ...envs.contract.filter import EstimateState, FilterInput, Initial
from ...envs.data.recording import Recording
from ...envs.maneuvering_target.constant_velocity import KalmanModel
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.unscented_turn import DEGREE
from ...filters import dead_reckoning

STEP = 10.0
"""Time over which displacements by both sensors are compared, s: over shorter times noise dominates."""
FIXED_POINTS = 30
"""Iterations of the regression, far more than convergence takes."""


class DeadReckoning(KalmanModel):
    """Kalman filter of position, velocity and a Gauss-Markov error of the measured positions, moved by odometry.

    Equations: ``filters/dead_reckoning.py``. It runs on recordings with a second sensor alone.

    Args:
        error_deviation: standard deviation of the slow error of the measured positions, m.
        correlation_time: correlation time of that error, s.
        drift: drift of dead reckoning, m over the root of a metre of travelled distance.
        scale: factor on its displacements.
        heading_offset: clockwise rotation of its displacements, degrees.
    """

    acceleration: float = 1.0
    """Acceleration where there is no odometry, m/s^2; ours, for machines with wheels or legs."""

    def __init__(
        self,
        task: ManeuveringTarget,
        error_deviation: float = 5.0,
        correlation_time: float = 60.0,
        drift: float = 0.3,
        scale: float = 1.0,
        heading_offset: float = 0.0,
    ) -> None:
        super().__init__(task)
        self.deviation = error_deviation
        self.correlation_time = correlation_time
        self.drift = drift
        self.scale = scale
        self.heading_offset: float = DEGREE * heading_offset
        self.H = task.constant([[float(j in (i, i + 4)) for j in range(6)] for i in range(2)])

    def start(self, initial: Initial) -> EstimateState:
        """Return the state at the initial estimate, with the prior of the positions' slow error."""
        return super().start(Initial(*dead_reckoning.start(*initial[:2], self.deviation)))

    def update(self, state: EstimateState, inputs: FilterInput) -> EstimateState:
        """Predict by the odometry, update with the measured position; return the state."""
        measurement = inputs.measurement
        odometry = measurement.odometry
        if odometry is None:
            raise ValueError(
                "dead reckoning needs a second sensor: a recording with the columns odometry_x and odometry_y, or "
                "odometry_speed and odometry_heading"
            )
        predicted = dead_reckoning.predict_position(
            state.mean,
            state.covariance,
            dead_reckoning.calibrate(odometry.displacement, self.scale, self.heading_offset),
            odometry.available,
            measurement.interval,
            dead_reckoning.Noise(self.drift, self.acceleration, self.correlation_time, self.deviation),
        )
        return self.track(measurement, self.update_estimate(predicted, measurement))


def regress_odometry(recording: Recording) -> tuple[float, float]:
    """Return scale and heading offset (degrees) of a recording's odometry, by robust regression on positions.

    Iteratively reweighted least squares: a displacement off by e counts as ``|e|^-1.5``. Where the target
    does not move, 1 and 0.
    """
    measured, found, moved = recording.measurements, [], []
    for episode, rows in enumerate(recording.rows.tolist()):
        time, seen = recording.seconds[episode, :rows], measured["available"][episode, :rows] > 0.0
        position = measured["position"][episode, :rows] @ numpy.array([1.0, 1.0j])
        reckoned = numpy.cumsum(measured["odometry_displacement"][episode, :rows] @ numpy.array([1.0, 1.0j]))
        ends = numpy.searchsorted(time, time + STEP)
        both = numpy.flatnonzero(ends < rows)
        both = both[seen[both] & seen[ends[both]]]
        found.append(position[ends[both]] - position[both])
        moved.append(reckoned[ends[both]] - reckoned[both])
    fixes, ways = numpy.concatenate(found), numpy.concatenate(moved)
    there = numpy.abs(ways) > 0.1 * numpy.abs(ways).max(initial=0.0)
    fixes, ways = fixes[there], ways[there]
    if not len(ways):
        return 1.0, 0.0
    ratio: Any = 1.0
    floor = 1e-3 * float(numpy.median(numpy.abs(ways)))
    for _ in range(FIXED_POINTS):
        weight = numpy.maximum(numpy.abs(fixes - ratio * ways), floor) ** -1.5
        ratio = (weight * numpy.conj(ways) * fixes).sum() / (weight * numpy.abs(ways) ** 2).sum()
    return float(abs(ratio)), -math.degrees(float(numpy.angle(ratio)))
