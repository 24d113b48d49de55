"""Pitch and roll: rates of a gyroscope as inputs, angles of an accelerometer that wrap."""

import numpy as np

import filtergym
from filtergym import Input, Sensor


def drift(x, u):
    """Euler angles, rad, and the biases of the gyroscope, rad/s; the body does not yaw."""
    p, q = u[0] - x[2], u[1] - x[3]
    return [p + q * np.sin(x[0]) * np.tan(x[1]), q * np.cos(x[0]), 0.0 * p, 0.0 * p]


Attitude = filtergym.state_space(
    "mine/PitchRoll-v0",
    drift=drift,
    diffusion={"angles": np.diag([1e-4, 1e-4, 0, 0]), "biases": np.diag([0, 0, 1e-5, 1e-5])},
    inputs={
        "gyro_p": Input(mean=1.0, deviation=0.8, correlation_time=1.0, noise=0.02, unit="rad/s"),
        "gyro_q": Input(deviation=0.2, correlation_time=0.2, noise=0.02, unit="rad/s"),
    },
    sensors={
        "roll_angle": Sensor([[1, 0, 0, 0]], 0.05**2, wraps="rad"),
        "pitch_angle": Sensor([[0, 1, 0, 0]], 0.05**2, wraps="rad"),
    },
    mean=[0, 0, 0, 0],
    covariance=np.diag([0.01, 0.01, 0.0025, 0.0025]),
    names=["roll", "pitch", "bias_p", "bias_q"],
    units=["rad", "rad", "rad/s", "rad/s"],
    weights=[0.5, 0.5, 0, 0],
    sampling_interval=0.02,
    horizon=300,
)
