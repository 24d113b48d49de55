"""The peer of ManeuveringTarget's bank: filterpy's IMMEstimator over two 4-state Kalman filters, in a loop.

The nearest equivalent in Python: one estimator object for each target, stepped one after the other. It does less
than an environment step (no truth, no sensor, no observation, no reward, no autoreset).
"""

import time

import numpy

PEER_OF = "filtergym/ManeuveringTarget-v0"


def imm_steps_per_second(steps: int) -> float:
    """Return how many steps (``predict`` and ``update``) one filterpy IMM does in a second of processor time."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    T = 6.0
    F = numpy.eye(4) + T * numpy.eye(4, k=2)
    G = numpy.vstack([T**2 / 2 * numpy.eye(2), T * numpy.eye(2)])
    filters = []
    for acceleration in (0.0, 2.775):
        one = KalmanFilter(dim_x=4, dim_z=2)
        one.x = numpy.array([-10000.0, 5000.0, 100.0, 0.0])
        one.F, one.H = F, numpy.eye(2, 4)
        one.P, one.R = numpy.diag([1e4, 1e4, 600.0, 600.0]), 1e4 * numpy.eye(2)
        one.Q = acceleration**2 * G @ G.T
        filters.append(one)
    estimator = IMMEstimator(filters, numpy.array([0.5, 0.5]), numpy.array([[0.9, 0.1], [0.1, 0.9]]))
    # The measurements follow the straight leg, so that no likelihood underflows.
    time_axis = T * numpy.arange(1, steps + 1)[:, None]
    track = numpy.array([-10000.0, 5000.0]) + time_axis * numpy.array([100.0, 0.0])
    measurements = track + 100.0 * numpy.random.default_rng(0).standard_normal((steps, 2))
    begin = time.process_time()
    for measurement in measurements:
        estimator.predict()
        estimator.update(measurement)
    return steps / (time.process_time() - begin)
