"""Known inputs of a state-space model, against naive loops and known distributions."""

import shutil

import numpy as np
import pytest
import scipy
from naive import kalman_update
from own_models import compare_lanes, simulate

import filtergym
from filtergym import Input, read_recording
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.companions import find_companion
from filtergym.envs.contract.log_format import LogFormat
from filtergym.envs.linear.state_space import StateSpaceMeasurement
from filtergym.exports.c_source import export_c
from filtergym.exports.request import request_export

R = np.array([[0.01]])


def discharge(x, dt, u):
    """Charge, and a voltage that relaxes, under a current and a load that does not act linearly."""
    return [x[0] - 0.1 * dt * u[0], x[1] * np.exp(-dt) + 0.2 * dt * u[0] * x[0] + dt * u[1] ** 2]


def state_jacobian(x, dt, u):
    return np.array([[1.0, 0.0], [0.2 * dt * u[0], np.exp(-dt)]])


def input_jacobian(x, dt, u):
    return np.array([[-0.1 * dt, 0.0], [0.2 * dt * x[0], 2.0 * dt * u[1]]])


def noise_of(dt):
    return [[0.001 * dt, 0.0], [0.0, 0.002 * dt]]


NOISY = {"current": Input(1.0, 0.5, 3.0, noise=0.3), "load": Input(0.5, 0.2, 2.0)}
N = np.diag([0.3**2, 0.0])
COMMON = {
    "f": discharge,
    "Q": noise_of,
    "h": lambda x: [x[0] + 0.1 * x[0] ** 2 - x[1]],
    "R": R,
    "mean": [0.8, 0.0],
    "covariance": 0.01 * np.eye(2),
    "measured": ["voltage"],
    "inputs": NOISY,
    "sampling_interval": 0.5,
}
FIXED = {"f": lambda x, u: discharge(x, 0.5, u), "Q": noise_of(0.5)}


def naive(mean, P, rows, N=N):
    """Extended Kalman filter of rows ``(dt, u, z)`` with NumPy's inverse."""
    for dt, u, z in rows:
        F, G = state_jacobian(mean, dt, u), input_jacobian(mean, dt, u)
        P = F @ P @ F.T + G @ N @ G.T + np.array(noise_of(dt))
        mean = np.array(discharge(mean, dt, u))
        nu = np.array([z - (mean[0] + 0.1 * mean[0] ** 2 - mean[1])])
        mean, P = kalman_update(mean, P, nu, np.array([[1.0 + 0.2 * mean[0], -1.0]]), np.array(R))
    return mean, P


@pytest.mark.parametrize(
    "kind", [{}, FIXED, {"inputs": ["current", "load"]}], ids=["timed", "fixed", "exact"]
)
@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_the_filter_is_that_of_the_inputs(make, kind, backend):
    """Ten measurements: rounding grows with the numbers of operations, not with the model."""
    jitter = {} if kind is FIXED else {"jitter": 0.9}
    start, kept = simulate(make(**kind), 10, 8, backend=backend, **jitter)
    known = np.zeros((2, 2)) if "inputs" in kind else N

    def follow(mean, P, lane):
        rows = [
            (0.5 if m.interval is None else m.interval[lane], m.inputs[:, lane], m.values[0, lane])
            for _, m, *_ in kept
        ]
        return naive(mean, P, rows, known)

    compare_lanes(start, kept, follow)


def test_inputs_have_the_distribution_that_is_declared(make):
    """Of 4,000 episodes: the course is stationary, has its correlation time, and is given with its noise."""
    _, kept = simulate(make(), 8, 4000)
    first, last = kept[0], kept[-1]
    for j, one in enumerate(NOISY.values()):
        course = (last[0].inputs[j] - one.mean) / one.deviation
        assert abs(course.mean()) < 4.0 / np.sqrt(4000)
        low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 4000)
        assert low < (course**2).sum() < high
        before = (first[0].inputs[j] - one.mean) / one.deviation
        kept_share = np.exp(-7 * 0.5 / one.correlation_time)
        assert abs(np.mean(course * before) - kept_share) < 4.0 * np.sqrt(2.0 / 4000)
        measured = last[1].inputs[j] - last[0].inputs[j]
        np.testing.assert_allclose(measured.std(), one.noise, rtol=0.05, atol=1e-15)


LOADED = {
    "f": lambda x, dt, u: [x[0] - 0.1 * dt * u[0], x[1] * np.exp(-dt)],
    "h": lambda x, u: [x[0] + 0.1 * x[0] ** 2 - x[1] - 0.3 * u[0] * (1.0 + x[1]) + u[1]],
}
"""What is measured is under load."""
SENSORS = {"voltage": filtergym.Sensor(LOADED["h"], R), "gauge": filtergym.Sensor([[1.0, 0.0]], R)}


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
@pytest.mark.parametrize("kind", [{}, {"inputs": ["current", "load"]}], ids=["noisy", "exact"])
def test_sensors_may_measure_the_inputs(make, kind, backend):
    """Against a naive extended Kalman filter of the same equations, rounding alone between them."""
    cls = make(**LOADED, **kind)
    start, kept = simulate(cls, 10, 4, backend=backend, jitter=0.9)
    known = np.zeros((2, 2)) if kind else N

    def follow(mean, P, lane):
        for _, m, *_ in kept:
            dt, u = m.interval[lane], m.inputs[:, lane]
            F, G = np.diag([1.0, np.exp(-dt)]), np.array([[-0.1 * dt, 0.0], [0.0, 0.0]])
            mean = F @ mean + G @ u
            P = F @ P @ F.T + G @ known @ G.T + np.array(noise_of(dt))
            H = np.array([[1.0 + 0.2 * mean[0], -1.0 - 0.3 * u[0]]])
            D = np.array([[-0.3 * (1.0 + mean[1]), 1.0]])
            nu = np.array([m.values[0, lane] - LOADED["h"](mean, u)[0]])
            mean, P = kalman_update(mean, P, nu, H, D @ known @ D.T + R)
        return mean, P

    compare_lanes(start, kept, follow)


def test_the_world_measures_what_truly_acts(make):
    """Without noise of the sensor, and with the exact input given, nothing is left of the difference."""
    cls = make(**LOADED, inputs=["current", "load"], R=[[1e-20]])
    _, kept = simulate(cls, 5, 8)
    for truth, measurement, *_ in kept:
        measured = LOADED["h"](truth.state, truth.inputs)[0]
        np.testing.assert_allclose(measurement.values[0], measured, atol=1e-8)


def test_filters_agree(make):
    cls = make(f=LOADED["f"], sensors=SENSORS, h=None, R=None, measured=(), hypotheses=[{"Q": noise_of}])
    names = ["kalman", "extended", "imm", "kalman-imm", "known-model"]
    dataset = filtergym.evaluate(cls.id, names, scenario="jitter", episodes=8, horizon=20)
    first, *others = dataset.error.values
    for other in others:
        np.testing.assert_allclose(other, first, rtol=1e-9, atol=1e-9)
    linear = make(f=LOADED["f"], h=lambda x, u: [x[0] - x[1] - 0.3 * u[0]])
    dataset = filtergym.evaluate(linear.id, ["extended", "unscented"], episodes=8, horizon=20)
    np.testing.assert_allclose(*dataset.error.values, rtol=1e-6, atol=1e-6)


def test_a_table_is_predicted_with_the_inputs_that_are_measured(make):
    cls = make(**LOADED)
    mean, dt, u = np.array([[0.7], [0.1]]), np.array([0.4]), np.array([[1.1], [0.2]])
    given = StateSpaceMeasurement(np.array([[0.3]]), np.ones((1, 1)), dt, u)
    predicted, _ = find_companion(cls, LogFormat).predict(mean, given, None)
    moved = LOADED["f"](mean[:, 0], 0.4, u[:, 0])
    np.testing.assert_allclose(predicted[:, 0], LOADED["h"](moved, u[:, 0]), rtol=1e-14)


INPUTS, VOLTAGES = [[1.0, 0.5], [1.0, 0.5], [1.5, 0.5], [1.5, 0.25]], [0.9, 0.8, np.nan, 0.7]
ROWS = list(zip([0.5, 0.75, 0.25, 1.0], map(np.array, INPUTS), VOLTAGES, strict=True))


def test_a_loop_of_ones_own_gives_inputs_by_name_and_the_last_holds_on(make):
    filter, late = (filtergym.online(make().id, "extended", lag=lag) for lag in (0, 3))
    for each in (filter, late):
        each.start(mean=[0.8, 0.0], covariance=0.01 * np.eye(2))
    with pytest.raises(ValueError, match="needs load at the first measurement"):
        filter.update(0.5, voltage=0.9, current=1.0)
    readings = [
        (0.5, {"current": 1.0, "load": 0.5, "voltage": 0.9}),
        (1.25, {"voltage": 0.8}),
        (1.5, {"current": 1.5}),
        (2.5, {"load": 0.25, "values": [0.7]}),
    ]
    for time, values in readings:
        found = filter.update(time, **values)
    for k in (0, 2, 1, 3):
        again = late.update(readings[k][0], **readings[k][1])
    mean, P = naive(np.array([0.8, 0.0]), 0.01 * np.eye(2), ROWS)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-12)
    np.testing.assert_array_equal(again.mean, found.mean)
    with pytest.raises(ValueError, match="values contains voltage already"):
        filter.update(3.0, voltage=1.0, values=[1.0])


def test_a_table_has_a_column_for_each_input(make, tmp_path):
    id, file = make().id, tmp_path / "log.csv"
    file.write_text("time,current,load,voltage\n1,1,0.5,0.9\n1.75,,,0.8\n2,1.5,,\n3,,0.25,0.7\n")
    recording = read_recording(file, id, sampling_interval=0.5)
    np.testing.assert_array_equal(recording.measurements["inputs"][0], INPUTS)
    run = filtergym.evaluate(id, ["extended"], scenario=recording, tracks=True)
    mean, _ = naive(np.array([0.8, 0.0]), 0.01 * np.eye(2), ROWS)
    np.testing.assert_allclose(run["estimate"].values[0, 0, -1], mean, rtol=1e-12)
    # What is known of an input only later holds from the beginning.
    file.write_text("time,current,load,voltage\n1,,0.5,0.9\n1.75,1.25,,0.8\n")
    first, _ = read_recording(file, id).measurements["inputs"][0]
    assert first.tolist() == [1.25, 0.5]
    file.write_text("time,current,voltage\n1,1,0.9\n2,1,0.9\n")
    with pytest.raises(ValueError, match="lacks the column load"):
        read_recording(file, id)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no compiler")
def test_a_filter_with_inputs_is_exported(make, tmp_path):
    figures = export_c(request_export(problem_of(make().id), "extended"), tmp_path)
    assert figures.difference < 1e-9
    assert figures.test
    header = " ".join((tmp_path / "extended.h").read_text().split()).replace(" * ", " ")
    assert "inputs[2]" in header
    assert "values and available are of voltage, in this order; inputs" in header


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"inputs": ()}, "f takes u, and there are no inputs"),
        ({"f": lambda x, dt: [x[0], x[1]]}, "neither f, h nor R takes u: write"),
        ({"inputs": ["current", "voltage"]}, "none of them a time or an input"),
        ({"inputs": ["current", "values"]}, "names may not be recording, values, available"),
        ({"inputs": "current"}, "inputs must be names, or a mapping"),
        ({"inputs": {"current": 1.0}}, "the input 'current' must be an Input"),
    ],
)  # fmt: skip
def test_what_are_no_inputs_is_refused(make, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        make(**wrong)


def test_what_is_no_input_is_refused():
    with pytest.raises(ValueError, match="correlation_time of an input must be finite, above 0"):
        Input(correlation_time=0.0)
    with pytest.raises(ValueError, match="noise of an input must be finite, at least 0"):
        Input(noise=-1.0)
