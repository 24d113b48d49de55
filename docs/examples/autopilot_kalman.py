"""filterpy's Kalman filter in the closed loop of UavAutopilot: its control is known, and sensors drop out at times.

filtergym evaluate filtergym/UavAutopilot-v0 --policy autopilot_kalman:Kalman --policy kalman --policy matched
"""

import numpy
from filtergym.adapters import FilterpyEstimator
from filterpy.kalman import KalmanFilter


class Kalman(FilterpyEstimator):
    """The paper's filter, of the model that the autopilot was designed for."""

    def begin(self, initial):
        model = self.task.design.model
        kalman = KalmanFilter(len(model.F), len(self.task.sensors), dim_u=1)
        kalman.x, kalman.P = initial.mean, initial.covariance
        kalman.F, kalman.B, kalman.Q = model.F, model.B, model.scaled_noise + model.other_noise
        kalman.H = numpy.eye(len(model.F))[list(self.task.measured)]
        return kalman

    def step(self, track, measurement):
        track.predict(u=[measurement.control])
        there = measurement.available > 0
        if there.any():
            R = numpy.diag(self.task.sensor_variances)[there][:, there]
            track.update(measurement.reading[there], R, track.H[there])
