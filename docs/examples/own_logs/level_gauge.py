"""A reservoir: a gauge that drifts and reports irregularly, and a dip stick twice a day."""

import numpy as np

import filtergym
from filtergym import Sensor

HOUR = 3600.0
Level = filtergym.state_space(
    "mine/LevelGauge-v0",
    # Level, m; its rate, m/h, which forgets within 5 h; the gauge's offset, m, which wanders.
    drift=[[0, 1 / HOUR, 0], [0, -1 / (5 * HOUR), 0], [0, 0, 0]],
    diffusion={
        "inflow": np.diag([0, 0.02**2 / HOUR, 0]),
        "offset": np.diag([0, 0, 0.05**2 / (24 * HOUR)]),
    },
    sensors={
        "gauge": Sensor([[1, 0, 1]], 0.01**2, interval=600.0),
        "stick": Sensor([[1, 0, 0]], 0.02**2, interval=12 * HOUR),
    },
    mean=[10, 0, 0],
    covariance=np.diag([0.01, 0.0025, 0.0025]),
    names=["level", "rate", "offset"],
    units=["m", "m/h", "m"],
    weights=[1, 0, 0],
    horizon=300,
)
