"""A battery's charge from its current, an input, and its voltage under load."""

import numpy as np

import filtergym
from filtergym import Input

Battery = filtergym.state_space(
    "mine/Battery-v0",
    # Charge of 2.5 Ah, and the voltage of one RC pair of 25 mOhm and 40 s; 20 mOhm in series.
    drift=lambda x, u: [-u[0] / (2.5 * 3600), (0.025 * u[0] - x[1]) / 40.0],
    diffusion=np.diag([1e-9, 1e-6]),
    inputs={"current": Input(mean=1.8, deviation=1.5, correlation_time=20.0, noise=0.05, unit="A")},
    h=lambda x, u: [3.3 + 0.9 * x[0] - 0.6 * x[0] ** 2 + 0.55 * x[0] ** 3 - x[1] - 0.02 * u[0]],
    R=[[0.01**2]],
    measured=["voltage"],
    mean=[0.8, 0],
    covariance=np.diag([0.01, 1e-4]),
    names=["charge", "relaxation"],
    units=["1", "V"],
    weights=[1, 0],
    sampling_interval=2.0,
    horizon=300,
)
