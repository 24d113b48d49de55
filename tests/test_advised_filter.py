"""One file of an advised filter: evaluate, online and the exported program give the same numbers on a user's log."""

import csv
import json
import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from models import Asked

import filtergym
from filtergym.baselines.advice import FittedLog, find_outliers, fit_all
from filtergym.baselines.fitted_filters import read_artefact, write_advised
from filtergym.baselines.fitting import OUTLIER_SHARE, WIDE, Fit, RobustEstimator
from filtergym.baselines.maneuvering_target.estimators import ConstantVelocity
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.filter import Initial
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.envs.logs.reading import read_recording
from filtergym.envs.maneuvering_target.logs import scale_noise
from filtergym.envs.maneuvering_target.world import Measurement
from filtergym.exports.c_source import FLAGS, export_c
from filtergym.exports.request import request_export
from filtergym.names import find_competitor

ID = "filtergym/ManeuveringTarget-v0"
PROBLEM = problem_of(ID)
STRICT = ("-Wconversion", "-Wdouble-promotion", "-Wshadow")
POLAR = "range", "azimuth", "range_sigma", "azimuth_sigma"
PLANE = "x", "y", "sigma_x", "sigma_y"
PLACE = "lat", "lon", "altitude", "sigma_x", "sigma_y"


def write_log(path, names, missed=0.0, outliers=0.0, jitter=0.0, speed=200.0, sigma=60.0, T=4.0):
    """Write a log of a target on a slow turn, with gaps, outliers and uneven times."""
    g = np.random.default_rng(3)
    n = 70
    time = T * np.arange(n) + jitter * T * g.uniform(-1.0, 1.0, n)
    course = 0.4 + 0.01 * np.arange(n)
    step = speed * T * np.stack([np.sin(course), np.cos(course)], axis=1)
    truth = np.array([20e3, 10e3]) + np.cumsum(step, axis=0)
    plots = truth + sigma * g.standard_normal(truth.shape)
    wild = (g.random(n) < outliers) & (np.arange(n) > 3)
    plots[wild] += 30.0 * sigma
    values = {"x": plots[:, 0], "y": plots[:, 1], "sigma_x": np.full(n, sigma), "sigma_y": np.full(n, sigma)}
    values["range"], azimuth = np.hypot(*plots.T), np.degrees(np.arctan2(plots[:, 0], plots[:, 1]))
    values |= {"azimuth": azimuth, "range_sigma": np.full(n, sigma), "azimuth_sigma": np.full(n, 0.15)}
    if "lat" in names:  # across the date line, and the altitude has gaps
        values |= {"lat": 48.7 + plots[:, 1] / 111.2e3, "lon": (359.5 + plots[:, 0] / 73.6e3) % 360.0 - 180.0}
        values["altitude"] = np.where(g.random(n) < 0.2, np.nan, g.uniform(500.0, 3000.0, n))
    kept = (g.random(n) >= missed) | (np.arange(n) < 3)
    columns = {"time": time, **{name: values[name] for name in names}}
    if "lat" not in names:
        columns |= {"truth_position_x": truth[:, 0], "truth_position_y": truth[:, 1]}
    table = np.column_stack(list(columns.values()))[kept]
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="")
    return path


LOGS = {
    "radar": {"names": POLAR, "missed": 0.2, "outliers": 0.05},
    "no deviations": {"names": PLANE[:2], "sigma": 30.0, "jitter": 0.02},
    "latitude": {"names": PLACE, "missed": 0.2, "outliers": 0.05, "jitter": 0.2},
}


def mean_of_evaluation(path, log):
    """Estimates of position in the rows of the log after the start, ``(n, 2)``."""
    setup = find_competitor(PROBLEM, path).log
    recording = read_recording(log, ID, speeds=(0.001, 1000.0), **setup.assumed)
    dataset = filtergym.evaluate(ID, str(path), recording, tracks=True)
    seen = np.isfinite(recording.log_time[0])
    estimate = dataset["estimate"].isel(policy=0, episode=0).transpose("time", "component").values[:, :2]
    return estimate[seen[: len(estimate)]]


def mean_of_online(path, log):
    """The same, row by row."""
    named = {old: new for new, old in find_competitor(PROBLEM, path).log.columns.items()}
    table = csv.DictReader(log.open())
    rows = [{named[k]: float(v) for k, v in row.items() if "truth" not in k} for row in table]
    running = filtergym.online(ID, str(path))
    running.start_from(*rows[:2])
    return np.array([running.update(**row).mean[:2] for row in rows[2:]])


def mean_of_program(path, log, folder):
    """The same, by the exported program, which reads the file itself."""
    request = request_export(PROBLEM, str(path))
    export_c(request, folder)
    stem = "mine"
    command = ["cc", *FLAGS, *STRICT, "log.c", f"{stem}.c", "-lm", "-o", "log"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run([folder / "log", log], capture_output=True, text=True, check=True)
    rows = list(csv.DictReader(done.stdout.splitlines()))
    assert {row["status"] for row in rows} == {"taken"}
    return np.array([[float(row[f"estimate_position_{axis}"]) for axis in "xy"] for row in rows])


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("case", LOGS)
def test_all_doors_give_the_same_numbers(case, tmp_path):
    log = write_log(tmp_path / "log.csv", **LOGS[case])
    recording = read_recording(log, ID, speeds=(0.001, 1000.0))
    family = log_families(recording)["constant-velocity"]
    values = {**family.start, "log10_outlier_share": -1.7, "log10_noise_scale": 0.1}
    path = tmp_path / "mine.filter.json"
    write_advised(path, PROBLEM, "constant-velocity", recording, Fit(values, 0.0, 1, 0.0, ()), {}, "test")
    expected = mean_of_evaluation(path, log)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(mean_of_online(path, log), expected, rtol=0.0, atol=1e-11 * scale)
    found = mean_of_program(path, log, tmp_path / "c")
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 * scale)


def test_a_shipped_filter_is_saved_by_its_name(tmp_path):
    recording = read_recording(write_log(tmp_path / "log.csv", PLANE), ID)
    path = tmp_path / "some.filter.json"
    write_advised(path, PROBLEM, "kalman-imm-turn", recording, None, {}, "test")
    own = filtergym.evaluate(ID, [str(path), "kalman-imm-turn"], recording)["error"].values
    np.testing.assert_array_equal(own[0], own[1])
    table = json.loads(path.read_text())
    for change in ({"filter": "no:Body"}, {"log": {**table["log"], "interval": -1.0}}, {"fitted": "yes"}):
        path.write_text(json.dumps(table | change))
        with pytest.raises(ValueError, match=r"some\.filter\.json"):
            find_competitor(PROBLEM, path)


def test_without_deviations_the_file_states_which(tmp_path):
    log = write_log(tmp_path / "log.csv", PLANE[:2], sigma=30.0)
    setup = find_competitor(PROBLEM, _saved(tmp_path, log)).log
    assert 20.0 < setup.deviations["sigma_x"] < 90.0
    assert setup.assumed == {"range_sigma": setup.deviations["sigma_x"]}
    running = filtergym.online(ID, str(tmp_path / "mine.filter.json"))
    first, second, third = ({"time": 4.0 * k, "x": 100.0 * k, "y": 0.0} for k in range(3))
    running.start_from(first, second)
    bare = running.update(**third).covariance
    running.start_from(first, second)
    stated = dict.fromkeys(("sigma_x", "sigma_y"), setup.deviations["sigma_x"])
    np.testing.assert_array_equal(running.update(**third, **stated).covariance, bare)
    for deviation in (0.0, -1.0):
        with pytest.raises(ValueError, match="is a standard deviation, above zero"):
            running.update(12.0, x=0.0, y=0.0, sigma_x=deviation, sigma_y=1.0)


def test_latitude_needs_an_origin_and_lies_near_it(tmp_path):
    path = _saved(tmp_path, write_log(tmp_path / "log.csv", PLACE))
    running = filtergym.online(ID, str(path))
    origin = find_competitor(PROBLEM, path).log.plane
    east, north = (math.degrees(10.0 / length) for length in (6.39e6 * math.cos(math.radians(48.8)), 6.37e6))
    rows = [
        {"time": 4.0 * k, "latitude": origin.latitude + k * north, "longitude": origin.longitude + k * east}
        for k in range(4)
    ]
    running.start_from(*rows[:2])
    # At the origin's own height, which a plot without one is given; 10 m within half a percent.
    np.testing.assert_allclose(running.update(**rows[2]).mean[:2], 20.0, rtol=5e-3)
    for wrong, sentence in (
        ({"latitude": 91.0}, "degrees from -90 to 90"),
        ({"latitude": origin.latitude + 5.0}, "km from latitude 48"),
        ({"x": 3.0}, "leave one of them out"),
    ):
        with pytest.raises(ValueError, match=sentence):
            running.update(**{**rows[3], **wrong})
    with pytest.raises(ValueError, match="unknown value 'latitude'"):
        filtergym.online(ID, "kalman-imm").start_from(*rows[:2])
    table = json.loads(path.read_text())
    for name, value in (("latitude", 91.0), ("longitude", math.nan), ("height", 0.0)):
        changed = {**table["log"], "origin": {**table["log"]["origin"], name: value}}
        path.write_text(json.dumps(table | {"log": changed}))
        with pytest.raises(ValueError, match="its entry on the log is invalid"):
            find_competitor(PROBLEM, path)


def test_measurements_of_one_time_are_fused(tmp_path):
    """Two fixes of equal deviations count as their mean with a variance half as large."""
    log = write_log(tmp_path / "log.csv", PLANE)
    path = _saved(tmp_path, log, outliers=False)
    starts = [{"time": 4.0 * k, "x": 100.0 * k, "y": 0.0} for k in range(2)]
    both, one = filtergym.online(ID, str(path)), filtergym.online(ID, str(path))
    both.start_from(*starts)
    one.start_from(*starts)
    both.update(8.0, x=190.0, y=5.0, sigma_x=60.0, sigma_y=60.0)
    found = both.update(8.0, x=230.0, y=-15.0, sigma_x=60.0, sigma_y=60.0)
    half = 60.0 / np.sqrt(2.0)
    expected = one.update(8.0, x=210.0, y=-5.0, sigma_x=half, sigma_y=half)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-10)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-9, atol=1e-9)


def test_a_share_of_outliers_is_the_likelier_of_two_kalman_filters():
    """By dense matrices, step by step: the mixture's likelihood, and the update that is kept; rounding of 60 steps."""
    task = make_task(PROBLEM.task, None)
    share, g = 0.05, np.random.default_rng(1)
    estimator = Asked(RobustEstimator(ConstantVelocity(task, acceleration=2.0), scale_noise, share))
    m, P, T = np.array([0.0, 0.0, 50.0, 10.0]), np.diag([1e4, 1e4, 400.0, 400.0]), 4.0
    memory = estimator.start(Initial(m[:, None], P[:, :, None]), 1)
    F, H = np.eye(4) + T * np.eye(4, k=2), np.eye(2, 4)
    G = np.concatenate([0.5 * T**2 * np.eye(2), T * np.eye(2)])
    kept = []
    for k in range(1, 61):
        z = np.array([200.0, 40.0]) * k + 50.0 * g.standard_normal(2) + 3000.0 * (k % 20 == 7)
        m, P = F @ m, F @ P @ F.T + 4.0 * G @ G.T
        both = []
        for weight, scale in ((1.0 - share, 1.0), (share, WIDE)):
            S = H @ P @ H.T + scale**2 * 2500.0 * np.eye(2)
            nu, K = z - H @ m, P @ H.T @ np.linalg.inv(S)
            density = -0.5 * (nu @ np.linalg.solve(S, nu) + math.log(np.linalg.det(2.0 * math.pi * S)))
            both.append((math.log(weight) + density, m + K @ nu, (np.eye(4) - K @ H) @ P))
        kept.append(int(both[1][0] > both[0][0]))
        _, m, P = both[kept[-1]]
        one = np.ones(1)
        plot = Measurement(k * one, z[:, None], np.full((2, 1), 2500.0), one, T * one, T * one)
        mean, covariance, memory, found = estimator.update(memory, plot)
        np.testing.assert_allclose(mean[:, 0], m, rtol=1e-9)
        np.testing.assert_allclose(covariance[:, :, 0], P, rtol=1e-8, atol=1e-8)
        assert found.log_likelihood[0] == pytest.approx(np.logaddexp(both[0][0], both[1][0]), rel=1e-9)
    assert [k for k, wide in enumerate(kept, 1) if wide] == [7, 27, 47]


@pytest.mark.slow
def test_outliers_are_found_where_there_are_some_and_only_there(tmp_path):
    for outliers in (0.0, 0.05):
        recording = read_recording(write_log(tmp_path / "log.csv", PLANE, outliers=outliers), ID)
        family = log_families(recording)["constant-velocity"]
        tunable, found, _ = fit_all(FittedLog(PROBLEM, recording), family)
        assert (OUTLIER_SHARE in found.values) == (outliers > 0.0)
        named = find_outliers(make_task(PROBLEM.task, None), recording, tunable, found)
        error = recording.measurements["position"][0] - recording.truth[0][:, :2]
        np.testing.assert_array_equal(named[0], np.hypot(*error.T) > 600.0)


def _saved(folder: Path, log: Path, outliers: bool = True) -> Path:
    recording = read_recording(log, ID)
    family = log_families(recording)["constant-velocity"]
    values = {**family.start, **({"log10_outlier_share": -1.7} if outliers else {}), "log10_noise_scale": 0.0}
    path = folder / "mine.filter.json"
    write_advised(path, PROBLEM, "constant-velocity", recording, Fit(values, 0.0, 1, 0.0, ()), {}, "test")
    assert read_artefact(path, PROBLEM).log is not None
    return path
