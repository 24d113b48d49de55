"""Filters of filterpy for ManeuveringTarget: one object an episode.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy filterpy_filters:Imm --policy filterpy_filters:Unscented
"""

import numpy
from filtergym.adapters import FilterpyEstimator
from filterpy.kalman import (
    ExtendedKalmanFilter,
    IMMEstimator,
    KalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)
from scipy.linalg import block_diag


def constant_velocity(filter, T, sigma):
    """White acceleration of ``sigma`` m/s^2; the position is measured. The state is x, y, vx, vy."""
    identity = numpy.eye(2)
    G = numpy.vstack([T**2 / 2 * identity, T * identity])
    filter.F = numpy.block([[identity, T * identity], [0.0 * identity, identity]])
    filter.Q, filter.H = sigma**2 * G @ G.T, numpy.eye(2, 4)
    return filter


class Kalman(FilterpyEstimator):
    """A Kalman filter."""

    def begin(self, initial):
        kalman = constant_velocity(KalmanFilter(4, 2), self.task.parameters.sampling_interval, 2.0)
        kalman.x, kalman.P = initial.mean, initial.covariance
        return kalman

    def predict(self, track, interval):
        constant_velocity(track, interval, 2.0).predict()


class Imm(FilterpyEstimator):
    """Two Kalman filters: no manoeuvre, and white acceleration of 2.775 m/s^2, as `kalman-imm` has them."""

    sigmas = (0.0, 2.775)

    def begin(self, initial):
        models = []
        for sigma in self.sigmas:
            model = constant_velocity(KalmanFilter(4, 2), self.task.parameters.sampling_interval, sigma)
            model.x, model.P = initial.mean, initial.covariance
            models.append(model)
        return IMMEstimator(models, (0.5, 0.5), numpy.array([[0.9, 0.1], [0.1, 0.9]]))

    def predict(self, track, interval):
        for model, sigma in zip(track.filters, self.sigmas):
            constant_velocity(model, interval, sigma)
        track.predict()


class Unscented(FilterpyEstimator):
    """An unscented filter of the coordinated turn; its turn rate, rad/s, is no component of the task."""

    state = ("position_x", "velocity_x", "position_y", "velocity_y", "turn_rate")

    def begin(self, initial):
        T = self.task.parameters.sampling_interval
        points = MerweScaledSigmaPoints(5, alpha=0.1, beta=2.0, kappa=-2.0)
        ukf = UnscentedKalmanFilter(5, 2, T, lambda x: x[[0, 2]], coordinated_turn, points)
        ukf.x, ukf.P = initial.mean, initial.covariance
        ukf.P[4, 4] = 0.01**2
        return ukf

    def predict(self, track, interval):
        axis = 1.0**2 * numpy.outer([interval**2 / 2, interval], [interval**2 / 2, interval])
        track.Q = block_diag(axis, axis, (0.0005 * interval) ** 2)
        track.predict(dt=interval)


def coordinated_turn(x, T):
    """The state after T seconds of a turn at constant rate; (sin wT)/w and (1 - cos wT)/w without dividing by zero."""
    _, vx, _, vy, w = x
    along, across = T * numpy.sinc(w * T / numpy.pi), T * numpy.sin(w * T / 2) * numpy.sinc(w * T / (2 * numpy.pi))
    c, s = numpy.cos(w * T), numpy.sin(w * T)
    return numpy.array(
        [x[0] + along * vx - across * vy, c * vx - s * vy, x[2] + across * vx + along * vy, s * vx + c * vy, w]
    )


class Extended(FilterpyEstimator):
    """An extended Kalman filter of range and azimuth, for `--set polar_measurements=True`."""

    def begin(self, initial):
        ekf = constant_velocity(ExtendedKalmanFilter(4, 2), self.task.parameters.sampling_interval, 2.0)
        ekf.x, ekf.P = initial.mean, initial.covariance
        p = self.task.parameters
        ekf.R = numpy.diag([p.range_sigma, numpy.radians(p.bearing_sigma)]) ** 2
        return ekf

    def step(self, track, measurement):
        constant_velocity(track, measurement.interval, 2.0).predict()
        if measurement.available:
            track.update(polar(measurement.position), jacobian, polar, residual=wrapped)


def polar(x):
    """Range and azimuth."""
    return numpy.array([numpy.hypot(x[0], x[1]), numpy.arctan2(x[1], x[0])])


def jacobian(x):
    """Derivative of range and azimuth."""
    r = numpy.hypot(x[0], x[1])
    return numpy.array([[x[0] / r, x[1] / r, 0.0, 0.0], [-x[1] / r**2, x[0] / r**2, 0.0, 0.0]])


def wrapped(z, expected):
    """Difference of ranges and azimuths, an innovation of 358 degrees being one of -2."""
    y = z - expected
    y[1] = numpy.angle(numpy.exp(1j * y[1]))
    return y
