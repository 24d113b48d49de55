"""What comes late in a world of a state-space model, against naive filters that begin anew at every measurement."""

import numpy as np
import pytest
import scipy
from naive import kalman_update
from own_models import simulate

import filtergym
from filtergym import Sensor
from filtergym.baselines.state_space import Extended, InteractingKalman, Unscented
from filtergym.envs.contract.filter import FilterInput
from filtergym.envs.engine.backend import make_model

Q = np.diag([0.1, 0.2])
R = {"gps": 4.0, "odometry": 0.25}
COMMON = {
    "f": lambda x, dt: [x[0] + dt * x[1], 0.9 * x[1]],
    "Q": lambda dt: dt * Q,
    "sensors": {"gps": Sensor([[1, 0]], R["gps"], interval=1.0), "odometry": Sensor([[0, 1]], R["odometry"])},
    "mean": [1.0, 2.0],
    "covariance": np.diag([2.0, 1.0]),
    "sampling_interval": 0.5,
}
LATE = {"late": 0.4, "lateness": 3}


def naive(x, P, rows):
    """Kalman filter of rows ``(dt, z)`` with NumPy's inverse; NaN where nothing is known."""
    for dt, z in rows:
        F = np.array([[1.0, dt], [0.0, 0.9]])
        x, P = F @ x, F @ P @ F.T + dt * Q
        x, P = kalman_update(x, P, z - x, np.eye(2), np.diag([*R.values()]))
    return x, P


def received(values, available, lane):
    return np.where(available[:, lane] > 0.0, values[:, lane], np.nan)


@pytest.mark.parametrize("kind", [Extended, Unscented, InteractingKalman])
def test_what_comes_late_is_taken_in_as_if_all_had_begun_anew(make, kind):
    """At each of 15 measurements the filter is that of all that has come until then, in order."""
    cls = make(hypotheses=[{}])
    start, kept = simulate(cls, 15, 4, jitter=0.5, **LATE)
    estimator = kind(make_model(cls, backend="numpy", jitter=0.5, **LATE).task)
    state, came = estimator.start(start.measurement), 0
    rows = [[] for _ in range(4)]
    for k, (_, m, *_) in enumerate(kept):
        state = estimator.update(state, FilterInput(m))
        for lane in range(4):
            rows[lane].append((m.interval[lane], received(m.values, m.available, lane)))
            late = received(m.late, m.late_available, lane)
            if np.isfinite(late).any():
                dt, z = rows[lane][k - 3]
                assert np.isnan(z[np.isfinite(late)]).all()
                rows[lane][k - 3], came = (dt, np.where(np.isfinite(late), late, z)), came + 1
            x, P = naive(
                start.measurement.mean[:, lane], start.measurement.covariance[:, :, lane], rows[lane]
            )
            # Sigma points start with 1e-9 of Q more.
            tolerance = 1e-7 if kind is Unscented else 1e-12
            np.testing.assert_allclose(estimator.mean(state)[:, lane], x, tolerance, tolerance)
            np.testing.assert_allclose(estimator.covariance(state)[:, :, lane], P, tolerance, tolerance)
    assert came > 10


def test_the_world_hands_over_what_it_has_held_back(make):
    """Of 2,000 episodes: as many come late as declared, and each is of the state three measurements before."""
    _, kept = simulate(make(), 8, 2000, **LATE)
    due = [kept[k][1].late_available.sum(axis=1) + 0.0 for k in (3, 4, 5, 6, 7)]
    in_time = [kept[k][1].available.sum(axis=1) for k in (0, 1, 2, 3, 4)]
    for late, early in zip(due, in_time, strict=True):
        total = late + early
        assert (np.abs(late - 0.4 * total) <= 4.0 * np.sqrt(0.24 * total)).all()
    assert not any(kept[k][1].late_available.any() for k in range(3))
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], due[0][1])
    there = kept[3][1].late_available[1] > 0.0
    error = (kept[3][1].late[1] - kept[0][0].state[1])[there]
    assert low < (error**2).sum() / R["odometry"] < high


def test_every_backend_and_the_reference_take_in_what_comes_late(make):
    cls = make(hypotheses=[{}])
    names = ["extended", "kalman-imm", "known-model", "kalman"]
    runs = [
        filtergym.evaluate(cls.id, names, scenario="late", episodes=8, horizon=20, backend=backend)
        for backend in ("numpy", "compiled")
    ]
    np.testing.assert_array_equal(*(run.error.values for run in runs))
    extended, imm, known, dropped = runs[0].error.values
    np.testing.assert_allclose(imm, extended, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(known, extended, rtol=1e-9, atol=1e-9)
    assert np.abs(dropped - extended).max() > 0.1
