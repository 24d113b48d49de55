"""A carriage on a rail: an accelerometer each 10 ms as input, and a camera whose fixes come 150 ms late."""

import numpy as np

import filtergym
from filtergym import Input, Sensor

Rail = filtergym.state_space(
    "mine/LateVision-v0",
    # Position, velocity, and the bias of the accelerometer.
    drift=lambda x, u: [x[1], u[0] - x[2], 0.0 * u[0]],
    diffusion=np.diag([0, 0.01, 1e-3]),
    inputs={"acceleration": Input(deviation=1.5, correlation_time=0.7, noise=0.1, unit="m/s^2")},
    sensors={"camera": Sensor([[1, 0, 0]], 0.02**2, interval=0.2)},
    mean=[0, 0, 0],
    covariance=np.diag([0.01, 0.1, 0.04]),
    names=["position", "velocity", "bias"],
    units=["m", "m/s", "m/s^2"],
    weights=[1, 0, 0],
    sampling_interval=0.01,
    horizon=300,
)


def follow(policy, imu, fixes):
    """Return the estimates after each sample of the IMU; fixes are `(time, arrival, position)`, in order of arrival."""
    filter, waiting, estimates = filtergym.online("mine/LateVision-v0", policy, lag=40), list(fixes), []
    filter.start(mean=[0, 0, 0], covariance=Rail.definition.covariance)
    for time, acceleration in imu:
        found = filter.update(time, acceleration=acceleration)
        while waiting and waiting[0][1] <= time:
            seen, _, position = waiting.pop(0)
            found = filter.update(seen, camera=position)
        estimates.append(found.mean)
    return np.array(estimates)
