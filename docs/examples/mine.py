"""A Kalman filter for ManeuveringTarget, in plain NumPy.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy mine:Mine --policy imm --policy bptt --policy known-turn
"""

import numpy


class Mine:
    """Constant velocity, disturbed by white acceleration of 2 m/s^2."""

    def start(self, initial, N):
        # N vectors and matrices side by side, so that @ multiplies each of them.
        return initial.mean.T[:, :, None], numpy.moveaxis(initial.covariance, -1, 0)

    def update(self, memory, measurement):
        T, (x, P) = measurement.interval[:, None, None], memory
        F, G = numpy.eye(4) + T * numpy.eye(4, k=2), numpy.eye(4, 2) * T**2 / 2 + numpy.eye(4, 2, k=-2) * T
        x, P = F @ x, F @ P @ F.mT + 2.0**2 * G @ G.mT
        seen = measurement.available[:, None, None] > 0
        z, R = measurement.position.T[:, :, None], measurement.variance.T[:, :, None] * numpy.eye(2)
        H = numpy.eye(2, 4)
        # A scan that missed the target has NaN for its position: the filter then only predicts.
        K = seen * (P @ H.T @ numpy.linalg.inv(H @ P @ H.T + R))
        x, P = x + K @ numpy.where(seen, z - H @ x, 0.0), P - K @ H @ P
        return x[:, :, 0].T, numpy.moveaxis(P, 0, -1), (x, P)
