"""Positions with slow errors, anchored by a second sensor: filter, columns, fit, choice, and the sentences about it."""

import dataclasses
import itertools
import math
import runpy
from pathlib import Path

import numpy as np
import pandas
import pytest

from filtergym import evaluate, online, read_recording
from filtergym.baselines.advice import FittedLog, advise
from filtergym.baselines.fitted_filters import families_of, read_artefact, write_advised
from filtergym.baselines.maneuvering_target.anchored import regress_odometry
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.baselines.problem import problem_of
from filtergym.envs.data.recording import Recording, join_recordings
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.evaluation.competitors.likelihood import Span, cut_windows
from filtergym.filters import dead_reckoning
from filtergym.reports.tables.advice import advice_lines

ID = "filtergym/ManeuveringTarget-v0"
PROBLEM = problem_of(ID)
ERROR, TAU, DRIFT, SCALE, HEADING, WHITE = 10.0, 40.0, 0.4, 0.9, 6.0, 1.0
"""Of the simulated log: m, s, m/m^0.5, 1, degrees clockwise, m."""


def drive(count=1200, T=1.0, seed=0, deviation=ERROR):
    """A slow vehicle with a receiver whose errors last, and wheels; a table."""
    rng = np.random.default_rng(seed)
    course = np.cumsum(0.05 * rng.standard_normal(count))
    d = 2.0 * T * np.stack([np.sin(course), np.cos(course)], axis=1)
    h = math.radians(HEADING)
    true = SCALE * d @ np.array([[math.cos(h), -math.sin(h)], [math.sin(h), math.cos(h)]])
    way = np.hypot(*true.T)[:, None]
    position = np.cumsum(true + DRIFT * np.sqrt(way) * rng.standard_normal((count, 2)), axis=0)
    fading, error = math.exp(-T / TAU), np.zeros((count, 2))
    error[0] = deviation * rng.standard_normal(2)
    for k in range(1, count):
        error[k] = fading * error[k - 1] + deviation * math.sqrt(1 - fading**2) * rng.standard_normal(2)
    fixes = position + error + WHITE * rng.standard_normal((count, 2))
    columns = {"time": T * np.arange(count), "x": fixes[:, 0], "y": fixes[:, 1], "sigma_x": WHITE}
    columns |= {"sigma_y": WHITE, "odometry_x": d[:, 0], "odometry_y": d[:, 1]}
    columns |= {"truth_position_x": position[:, 0], "truth_position_y": position[:, 1]}
    return pandas.DataFrame(columns)


def read(table, folder, name="drive.csv", **keywords):
    table.to_csv(folder / name, index=False)
    return read_recording(folder / name, ID, speeds=(0.01, 1000.0), **keywords)


# --- the filter


def test_filter_is_least_squares_over_the_whole_log():
    """Position of the last fix from the joint density of all fixes, with the error's covariance in closed form and
    nothing recursive; the first fix is all that is known of the start. Rounding of 40 updates."""
    rng = np.random.default_rng(1)
    K, s, tau, q, r = 40, 5.0, 20.0, 0.4, 1.5
    T = rng.uniform(0.5, 3.0, K)
    d = rng.normal(0.0, 3.0, (K, 2))
    z = np.cumsum(d, axis=0) + rng.normal(0.0, 6.0, (K, 2))
    mean, covariance = dead_reckoning.start(
        np.array([3.0, -2.0, 0.5, 0.0])[:, None], np.diag([r**2, r**2, 4.0, 4.0])[:, :, None], s
    )
    H = np.hstack([np.eye(2), np.zeros((2, 2)), np.eye(2)])
    likelihood = 0.0
    for k in range(K):
        mean, covariance = dead_reckoning.predict_position(
            mean,
            covariance,
            d[k][:, None],
            np.ones(1),
            T[[k]],
            dead_reckoning.Noise(q, 1.0, tau, s),
        )
        S = H @ covariance[:, :, 0] @ H.T + r**2 * np.eye(2)
        gain, nu = covariance[:, :, 0] @ H.T @ np.linalg.inv(S), z[k] - H @ mean[:, 0]
        likelihood -= 0.5 * (nu @ np.linalg.solve(S, nu) + math.log(np.linalg.det(2.0 * math.pi * S)))
        mean = mean + (gain @ nu)[:, None]
        covariance = covariance - (gain @ H @ covariance[:, :, 0])[:, :, None]
    time = np.append(0.0, np.cumsum(T))
    walk = np.append(0.0, np.cumsum(q**2 * (np.hypot(*d.T) + dead_reckoning.CREEP * T)))
    slow = s**2 * np.exp(-np.abs(time[:, None] - time) / tau) + r**2 * np.eye(K + 1)
    moved = np.minimum(walk[:, None], walk)
    # Fixes less the first one and less the displacements; what is sought is the position less both.
    C = np.hstack([-np.ones((K, 1)), np.eye(K)])
    seen = C @ slow @ C.T + moved[1:, 1:]
    both = moved[-1, 1:] - C @ slow[:, 0]
    y = z - np.array([3.0, -2.0]) - np.cumsum(d, axis=0)
    weights = np.linalg.solve(seen, both)
    np.testing.assert_allclose(mean[:2, 0], [3.0, -2.0] + d.sum(axis=0) + weights @ y, rtol=1e-9)
    variance = moved[-1, -1] + slow[0, 0] - weights @ both
    np.testing.assert_allclose(covariance[:2, :2, 0], variance * np.eye(2), rtol=1e-9, atol=1e-9)
    expected = sum(
        -0.5 * (y[:, i] @ np.linalg.solve(seen, y[:, i]) + np.linalg.slogdet(2.0 * np.pi * seen)[1])
        for i in range(2)
    )
    assert likelihood == pytest.approx(expected, rel=1e-10)


def test_what_the_odometry_does_not_say_is_coasting():
    """Constant velocity with an acceleration that is constant in the interval, by dense matrices."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    mean, covariance = rng.normal(size=6), root @ root.T
    T, a, s, tau = 2.0, 0.7, 3.0, 10.0
    found = dead_reckoning.predict_position(
        mean[:, None],
        covariance[:, :, None],
        np.full((2, 1), 99.0),
        np.zeros(1),
        np.array([T]),
        dead_reckoning.Noise(1.0, a, tau, s),
    )
    F = np.eye(6) + T * np.eye(6, k=2)
    F[2:4, 4:] = 0.0
    F[4:, 4:] = math.exp(-T / tau) * np.eye(2)
    G = np.vstack([0.5 * T**2 * np.eye(2), T * np.eye(2), np.zeros((2, 2))])
    Q = a**2 * G @ G.T
    Q[4:, 4:] = s**2 * (1.0 - math.exp(-2.0 * T / tau)) * np.eye(2)
    np.testing.assert_allclose(found[0][:, 0], F @ mean, rtol=1e-13)
    np.testing.assert_allclose(found[1][:, :, 0], F @ covariance @ F.T + Q, rtol=1e-12, atol=1e-12)


def test_turning_is_clockwise_from_north():
    """A quarter turn takes north to east."""
    found = dead_reckoning.calibrate(np.array([[0.0], [1.0]]), 2.0, math.pi / 2)
    np.testing.assert_allclose(found[:, 0], [2.0, 0.0], atol=1e-15)


# --- columns


def test_displacements_are_read_and_divided_over_scans_without_a_row(tmp_path):
    table = drive(count=60)
    holes = table.drop([20, 21]).reset_index(drop=True)
    holes.loc[30, ["odometry_x", "odometry_y"]] = np.nan
    holes.loc[[40, 41], ["x", "y"]] = np.nan
    found = read(holes, tmp_path).measurements
    moved, there = found["odometry_displacement"][0], found["odometry_available"][0]
    # The first two rows make the start; row 22 holds what was moved since row 19, as it is written.
    written = table[["odometry_x", "odometry_y"]].to_numpy()
    np.testing.assert_array_equal(moved[:18], written[2:20])
    np.testing.assert_allclose(moved[18:21], np.tile(written[22] / 3.0, (3, 1)))
    assert np.flatnonzero(there == 0.0).tolist() == [30]
    assert (moved[30] == 0.0).all()
    assert found["available"][0].sum() == len(there) - 4  # two rows and two fixes are missing


def test_speed_and_heading_are_displacements(tmp_path):
    """A circle at constant speed: the mean of the velocities at both ends of an interval over it."""
    table = drive(count=60).drop(columns=["odometry_x", "odometry_y"])
    heading = 10.0 * np.arange(60)
    found = read(table.assign(odometry_speed=3.0, odometry_heading=heading), tmp_path).measurements
    angle = np.radians(heading)
    velocity = 3.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    np.testing.assert_allclose(
        found["odometry_displacement"][0], 0.5 * (velocity[1:-1] + velocity[2:]), atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="odometry_y"), "lacks the column odometry_y"),
        (lambda t: t.assign(odometry_speed=1.0, odometry_heading=0.0), "odometry_x and odometry_speed: leave one"),
        (lambda t: t.assign(odometry_x=np.nan, odometry_y=np.nan), "columns of the odometry are empty"),
    ],
)  # fmt: skip
def test_odometry_that_cannot_be_is_refused(change, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(change(drive(count=40)), tmp_path)


def test_no_other_filter_receives_the_second_sensor(tmp_path):
    """Every number of banks, estimators and agents is the same with it and without."""
    table = drive(count=80)
    names = ["imm", "kalman-imm-turn", "bptt"]
    found = evaluate(ID, names, read(table, tmp_path), tracks=True)
    plain = evaluate(ID, names, read(table.drop(columns=["odometry_x", "odometry_y"]), tmp_path), tracks=True)
    np.testing.assert_array_equal(found["estimate"].values, plain["estimate"].values)
    np.testing.assert_array_equal(found["log_likelihood"].values, plain["log_likelihood"].values)


def test_it_is_kept_in_files_and_left_out_of_what_only_some_have(tmp_path):
    first = read(drive(count=40), tmp_path)
    first.write(tmp_path / "drive.nc")
    again = read_recording(tmp_path / "drive.nc", speeds=(0.01, 1000.0))
    for name, values in first.measurements.items():
        np.testing.assert_array_equal(values, again.measurements[name])
    other = read(drive(count=50, seed=1).drop(columns=["odometry_x", "odometry_y"]), tmp_path, "other.csv")
    both: Recording = join_recordings([first, other], "both")
    assert "odometry_displacement" not in both.measurements
    assert "other: has no odometry_displacement, which is left out of all" in both.notes


# --- the fit


def test_regression_finds_scale_and_heading(tmp_path):
    """Although a tenth of the fixes is off by 200 m; of 1,200 s within a hundredth and a degree."""
    table = drive(deviation=1.0)
    far = np.random.default_rng(3).random(len(table)) < 0.1
    far[:2] = False
    table.loc[far, "x"] += 200.0
    scale, heading = regress_odometry(read(table, tmp_path))
    assert scale == pytest.approx(SCALE, abs=0.01)
    assert heading == pytest.approx(HEADING, abs=1.0)


def test_windows_may_be_thinned(tmp_path):
    """One of four scans is received; the first that is available, and then each four after the last."""
    table = drive(count=100)
    table.loc[[22, 23], ["x", "y"]] = np.nan
    recording = read(table, tmp_path)
    task = make_task(PROBLEM.task, None, **recording.parameters)
    windows = cut_windows(recording, task, [Span(0, 0, 98)], 0, every=4)
    there = np.flatnonzero(windows.measurements.available[:, 0] > 0.0).tolist()
    # Rows 22 and 23 are measurements 20 and 21.
    assert there[:8] == [0, 4, 8, 12, 16, 22, 26, 30]
    assert all(b - a >= 4 for a, b in itertools.pairwise(there))


def advise_of_two(recording):
    """Fit constant velocity and dead reckoning alone: the others take longer."""
    names = ("constant-velocity", "dead-reckoning")

    def families(recording):
        return {name: family for name, family in log_families(recording).items() if name in names}

    problem = dataclasses.replace(
        PROBLEM, baselines=dataclasses.replace(PROBLEM.baselines, log_families=families)
    )
    return advise(FittedLog(problem, recording), {"kalman-imm": PROBLEM.competitor("kalman-imm")})


@pytest.fixture(scope="module")
def advice(tmp_path_factory):
    return advise_of_two(read(drive(count=900), tmp_path_factory.mktemp("drive")))


def test_the_anchored_filter_is_advised_and_nearer_to_the_truth(advice):
    """Although from one fix to the next others predict as well as it does."""
    assert advice.advised.name == "dead-reckoning"
    assert advice.anchor.gain > 0.2
    assert advice.advised.relative_error.high < -0.05
    assert math.isnan(advice.advised.prediction)
    values = advice.fits["dead-reckoning"].values
    assert values["scale"] == pytest.approx(SCALE, abs=0.02)
    assert values["heading_offset"] == pytest.approx(HEADING, abs=1.5)
    true = {"log10_error_deviation": ERROR, "log10_correlation_time": TAU, "log10_drift": DRIFT}
    for name, value in true.items():
        interval = advice.intervals[name]
        assert interval.low <= math.log10(value) <= interval.high  # of this seed; coverage is a command


def test_the_report_names_the_data_of_the_likelihood(advice):
    text = "\n".join(advice_lines(advice, []))
    assert text.startswith("Take dead-reckoning, with the parameters below: ")
    assert "heading offset " in text
    assert "measurements 10 s apart are likelier by" in text
    assert "likelihoods of both kinds do not compare" in text
    assert "times as large as stated" not in text


def test_a_second_sensor_that_does_not_help_is_reported(advice):
    """As where its displacements are of something else."""
    fitted = next(c for c in advice.competitors if c.name == "constant-velocity")
    anchor = advice.anchor._replace(gain=-0.5)
    worse = advice._replace(fitted=fitted, anchor=anchor, profiles={fitted.name: {}})
    text = "\n".join(advice_lines(worse, []))
    assert "The second sensor does not help here: by dead-reckoning measurements 10 s apart are less" in text
    assert "0.50 nats each than by constant-velocity" in text
    assert "times as large as stated, if they are white" in text


@pytest.mark.filterwarnings("ignore:.*is not compiled")  # the code that refuses is not
def test_its_file_runs_on_such_logs_alone(advice, tmp_path):
    path = tmp_path / "mine.filter.json"
    fitted = advice.fits["dead-reckoning"]
    write_advised(path, PROBLEM, "dead-reckoning", advice.recording, fitted, advice.intervals, "test")
    read_artefact(path, PROBLEM)
    recording, table = read(drive(count=200), tmp_path), pandas.read_csv(tmp_path / "drive.csv")
    found = evaluate(ID, [str(path)], recording, tracks=True)
    assert np.isfinite(found["log_likelihood"].values).all()
    live = online(ID, str(path), **recording.parameters)
    live.start(*(recording.initial[part][0] for part in ("mean", "covariance")), time=table["time"][1])
    for k, row in table[2:].reset_index(drop=True).iterrows():
        estimate = live.update(**{key: value for key, value in row.items() if not key.startswith("truth")})
        np.testing.assert_array_equal(estimate.mean, found["estimate"].values[0, 0, k])
    plain = read(drive(count=200).drop(columns=["odometry_x", "odometry_y"]), tmp_path)
    with pytest.raises(ValueError, match="dead reckoning needs a second sensor"):
        evaluate(ID, [str(path)], plain)


def test_a_log_too_short_for_errors_that_last_has_no_anchor(tmp_path):
    found = advise_of_two(read(drive(count=100), tmp_path))
    assert found.anchor is None
    assert "dead-reckoning" not in found.fits
    plain = read(drive(count=60).drop(columns=["odometry_x", "odometry_y"]), tmp_path)
    assert "dead-reckoning" not in families_of(PROBLEM, plain)


def test_drives_of_the_public_data_become_logs_with_odometry(tmp_path, torch):
    example = runpy.run_path(str(Path(__file__).parent.parent / "docs" / "examples" / "nclt_odometry.py"))
    table = drive(count=30)
    speed = np.hypot(table.odometry_x, table.odometry_y)
    heading = np.arctan2(table.odometry_y, table.odometry_x)
    parts = {
        "gps": table[["x", "y"]],
        "ground_truth": table[["truth_position_x", "truth_position_y"]],
        "wheel": np.stack([speed - 0.1, speed + 0.1, heading], axis=1),
    }
    one = {name: torch.tensor(np.asarray(values)) for name, values in parts.items()} | {"data_date": "day"}
    for part in ("test", "val"):
        torch.save([one], tmp_path / f"{part}.pt")
    example["write_drives"](tmp_path, tmp_path / "logs")
    recording = read_recording(tmp_path / "logs" / "day.csv", ID, speeds=(0.0, 100.0))
    moved = recording.measurements["odometry_displacement"][0]
    np.testing.assert_allclose(moved, table[["odometry_x", "odometry_y"]].values[2:], atol=1e-5)
