"""FilterPy's calls, and filtergym's beside them: both run, and agree."""

import filterpy.common
import filterpy.kalman
import numpy as np
import pandas as pd

import filtergym

T = 1.0  # s between measurements
F, H, R = np.array([[1, T], [0, 1]]), np.array([[1.0, 0.0]]), np.array([[25.0]])
Q = filterpy.common.Q_discrete_white_noise(2, dt=T, var=0.1)
mean, covariance = np.array([0.0, 10.0]), np.diag([100.0, 25.0])
readings = 10.0 * T * np.arange(1, 21) + np.random.default_rng(0).normal(0.0, 5.0, 20)


def compare(name, theirs, ours):
    difference = np.max(np.abs(np.asarray(theirs, float).ravel() - np.asarray(ours, float).ravel()))
    print(f"{name:24} differ by {difference:.0e}")
    return difference


# --- FilterPy: a Kalman filter
kalman = filterpy.kalman.KalmanFilter(dim_x=2, dim_z=1)
kalman.x, kalman.P, kalman.F, kalman.H, kalman.Q, kalman.R = mean, covariance, F, H, Q, R
for z in readings:
    kalman.predict()
    kalman.update(z)

# --- filtergym
filtergym.state_space("mine/Tracker-v0", f=F, h=H, Q=Q, R=R, mean=mean, covariance=covariance)
filter = filtergym.online("mine/Tracker-v0", "kalman")
filter.start(mean=mean, covariance=covariance)
for z in readings:
    now = filter.update(values=[z])

compare("kf.x", kalman.x, now.mean)
compare("kf.P", kalman.P, now.covariance)
compare("kf.y.T @ kf.SI @ kf.y", kalman.y.T @ kalman.SI @ kalman.y, now.nis)
compare("kf.log_likelihood", kalman.log_likelihood, now.log_likelihood)

# --- FilterPy: a measurement is missing
kalman.predict()
kalman.update(None)

# --- filtergym
now = filter.update()
compare("kf.update(None)", kalman.x, now.mean)


# --- FilterPy: extended and unscented, for a range to a beacon 20 m aside
def distance(x):
    return np.hypot(x[0], 20.0)


extended = filterpy.kalman.ExtendedKalmanFilter(dim_x=2, dim_z=1)
extended.x, extended.P, extended.F, extended.Q, extended.R = mean.copy(), covariance, F, Q, R
points = filterpy.kalman.MerweScaledSigmaPoints(2, alpha=1.0, beta=0.0, kappa=1.0)
unscented = filterpy.kalman.UnscentedKalmanFilter(
    2, 1, T, lambda x: np.array([distance(x)]), lambda x, dt: F @ x, points
)
unscented.x, unscented.P, unscented.Q, unscented.R = mean.copy(), covariance, Q, R
for z in readings:
    extended.predict()
    extended.update(z, lambda x: np.array([[x[0] / distance(x), 0.0]]), distance)
    unscented.predict()
    unscented.update(np.array([z]))

# --- filtergym: no Jacobian, no sigma points
filtergym.state_space(
    "mine/Beacon-v0",
    f=F,
    h=lambda x: [np.hypot(x[0], 20.0)],
    Q=Q,
    R=R,
    mean=mean,
    covariance=covariance,
)
for name, theirs in (("extended", extended), ("unscented", unscented)):
    filter = filtergym.online("mine/Beacon-v0", name)
    filter.start(mean=mean, covariance=covariance)
    for z in readings:
        now = filter.update(values=[z])
    compare(name, theirs.x, now.mean)

# --- FilterPy: an interacting multiple model
filters = []
for scale in (1.0, 100.0):
    one = filterpy.kalman.KalmanFilter(dim_x=2, dim_z=1)
    one.x, one.P, one.F, one.H, one.Q, one.R = mean, covariance, F, H, scale * Q, R
    filters.append(one)
stay = np.array([[0.95, 0.05], [0.05, 0.95]])
imm = filterpy.kalman.IMMEstimator(filters, np.array([0.5, 0.5]), stay)
for z in readings:
    imm.predict()
    imm.update(z)

# --- filtergym
filtergym.state_space(
    "mine/Switching-v0",
    f=F,
    h=H,
    Q=Q,
    R=R,
    mean=mean,
    covariance=covariance,
    hypotheses=[{"Q": 100.0 * Q}],
    transition=stay,
)
filter = filtergym.online("mine/Switching-v0", "imm")
filter.start(mean=mean, covariance=covariance)
for z in readings:
    now = filter.update(values=[z])
compare("imm.x", imm.x, now.mean)
compare("imm.mu", imm.mu, now.mode_probability)

# --- FilterPy: a log, filtered and smoothed
kalman.x, kalman.P = mean, covariance
means, covariances, _, _ = kalman.batch_filter(readings)
smoothed, _, _, _ = kalman.rts_smoother(means, covariances)

# --- filtergym: the log as a file; any competitor's name
pd.DataFrame({"time": T * np.arange(20), "z1": readings}).to_csv("readings.csv", index=False)
log = filtergym.read_recording("readings.csv", "mine/Tracker-v0")
run = filtergym.evaluate("mine/Tracker-v0", ["kalman", "kalman-smoother"], log, episodes=1, tracks=True)
compare("kf.batch_filter", means, run["estimate"].sel(policy="kalman"))
compare("kf.rts_smoother", smoothed, run["estimate"].sel(policy="kalman-smoother"))
