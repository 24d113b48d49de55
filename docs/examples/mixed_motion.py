"""Nonlinear, switching and mismatched: a turning target seen by range and bearing."""

import numpy as np

import filtergym

T = 1.0


def turn(x):
    """Coordinated turn: x, y (m), speed (m/s), heading (rad), turn rate (rad/s)."""
    heading = x[3] + 0.5 * T * x[4]
    return [x[0] + T * x[2] * np.cos(heading), x[1] + T * x[2] * np.sin(heading), x[2], x[3] + T * x[4], x[4]]


def straight(x):
    """The same without a turn rate."""
    return [x[0] + T * x[2] * np.cos(x[3]), x[1] + T * x[2] * np.sin(x[3]), x[2], x[3], 0.0 * x[4]]


def radar(x):
    """Range (m), and cosine and sine of the bearing: no angle that jumps."""
    r = np.hypot(x[0], x[1])
    return [r, x[0] / r, x[1] / r]


Target = filtergym.state_space(
    "mine/Target-v0",
    f=straight,
    h=radar,
    Q=np.diag([0.01, 0.01, 0.1, 1e-5, 1e-8]),
    R=np.diag([25.0, 1e-4, 1e-4]),
    mean=[2000, 1000, 30, 1, 0],
    covariance=np.diag([100, 100, 25, 0.04, 1e-6]),
    names=["x", "y", "speed", "heading", "rate"],
    units=["m", "m", "m/s", "rad", "rad/s"],
    weights=[1, 1, 0, 0, 0],  # the cost is the squared position error
    hypotheses=[
        {"f": turn, "Q": np.diag([0.01, 0.01, 0.1, 1e-5, 1e-3])}
    ],  # the world switches to it, and back
    transition=[[0.95, 0.05], [0.1, 0.9]],
    filter_model={"R": np.diag([100.0, 4e-4, 4e-4])},  # the filters overestimate the radar's noise
    process_noise=(0.3, 3.0),  # the true Q of an episode, as a factor
    availability=0.9,  # of ten measurements one is missed
)
