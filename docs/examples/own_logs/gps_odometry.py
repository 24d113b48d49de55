"""A drone at constant velocity: GPS each second, visual odometry ten times as often."""

import numpy as np

import filtergym
from filtergym import Sensor

Drone = filtergym.state_space(
    "mine/GpsOdometry-v0",
    # Position and velocity, disturbed by white acceleration of 1 m/s^2 in a second.
    drift=[[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]],
    diffusion=np.diag([0, 0, 1.0, 1.0]),
    sensors={
        "gps": Sensor([[1, 0, 0, 0], [0, 1, 0, 0]], np.diag([25.0, 25.0]), interval=1.0, names=("x", "y")),
        "odometry": Sensor([[0, 0, 1, 0], [0, 0, 0, 1]], np.diag([0.25, 0.25]), interval=0.1, names=("x", "y")),
    },
    mean=[0, 0, 0, 0],
    covariance=np.diag([100.0, 100.0, 25.0, 25.0]),
    names=["x", "y", "vx", "vy"],
    units=["m", "m", "m/s", "m/s"],
    weights=[0.5, 0.5, 0, 0],
    horizon=300,
)
