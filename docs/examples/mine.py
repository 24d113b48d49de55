"""A Kalman filter of one's own for ManeuveringTarget, in plain NumPy.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy mine:Mine --policy imm --policy bptt --policy known-turn
"""

import numpy


class Mine:
    """Constant velocity, disturbed by white acceleration of 2 m/s^2."""

    def __init__(self, task):
        T, identity = task.parameters.sampling_interval, numpy.eye(2)
        self.F = numpy.block([[identity, T * identity], [0.0 * identity, identity]])
        G = numpy.vstack([T**2 / 2 * identity, T * identity])
        self.Q, self.H = 2.0**2 * G @ G.T, numpy.eye(2, 4)

    def start(self, initial, N):
        # N vectors and matrices side by side, so that @ multiplies each of them.
        return initial.mean.T[:, :, None], numpy.moveaxis(initial.covariance, -1, 0)

    def update(self, measurement, memory):
        x, P = self.F @ memory[0], self.F @ memory[1] @ self.F.T + self.Q
        z, R = measurement.position.T[:, :, None], measurement.variance.T[:, :, None] * numpy.eye(2)
        K = P @ self.H.T @ numpy.linalg.inv(self.H @ P @ self.H.T + R)
        x, P = x + K @ (z - self.H @ x), P - K @ self.H @ P
        return x[:, :, 0].T, numpy.moveaxis(P, 0, -1), (x, P)
