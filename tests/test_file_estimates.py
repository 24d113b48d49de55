"""Estimates from files: what another program has made of the same measurements is judged as what runs here."""

import dataclasses

import numpy as np
import pandas
import pytest

from filtergym import evaluate, read_recording, record, tidy_records
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.competitors.file_estimates import FileEstimates
from filtergym.evaluation.storage.blind import write_blind
from filtergym.evaluation.storage.dataset import NO_ROW, notes_of
from filtergym.evaluation.storage.estimates import write_estimates

TARGET = "filtergym/ManeuveringTarget-v0"
SETTINGS = {"scenario": "irregular-scans", "episodes": 6, "horizon": 20, "detection_probability": (0.8, 0.8)}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Estimates of ``imm``, in every form that is written, and what they were written from."""
    folder = tmp_path_factory.mktemp("estimates")
    whole = evaluate(TARGET, "imm", **SETTINGS, tracks=True)
    for form in ("csv", "nc", "tum"):
        write_estimates(folder / f"imm.{form}", whole)
    return folder, whole


def judged(path, **settings):
    """Evaluation of a file, and its records of whole episodes by metric and component."""
    found = evaluate(TARGET, f"file:{path}", **{**SETTINGS, **settings})
    return found, {(r.metric, r.component): r.value for r in tidy_records(found) if r.window == "all"}


@pytest.mark.parametrize("form", ["csv", "nc", "tum"])
def test_what_is_written_costs_what_it_has_cost(files, form):
    folder, whole = files
    path = folder / f"imm.{form}"
    if form == "tum":
        kinds = ("imm", "truth.imm")
        assert {each.name for each in path.iterdir()} == {f"{k}.{i}.tum" for k in kinds for i in range(6)}
        rows = np.loadtxt(path / "truth.imm.1.tum")
        np.testing.assert_allclose(rows[:, 1:3], whole["truth"].values[0, 1, :, :2], atol=1e-9)
        np.testing.assert_array_equal(rows[:, 3:], np.tile([0.0, 0, 0, 0, 1], (len(rows), 1)))
    found, records = judged(path)
    # Trajectories have nine decimals.
    np.testing.assert_allclose(found["cost"], whole["cost"], rtol=0.0 if form != "tum" else 1e-9)
    assert records["missing", ""] == records["lost_episodes", ""] == 0.0
    if form == "tum":  # no velocity, and no errors are stated
        assert records["rmse", "velocity"] is None
        assert ("anees", "state") not in records
    else:
        assert records["rmse", "velocity"] > 0.0
        np.testing.assert_array_equal(found["nis"], whole["nis"])


def test_a_covariance_is_read_in_the_frame_it_is_stated_in(files):
    folder, whole = files
    table = pandas.read_csv(folder / "imm.csv").drop(columns=["policy", "nis", "nis_degrees"])
    names = whole["component"].values.tolist()
    for i, a in enumerate(names):
        for j, b in enumerate(names[: i + 1]):
            table[f"covariance_{a}_{b}"] = whole["covariance"].values[0, :, :, i, j].ravel()
    table.to_csv(folder / "whole.csv", index=False)
    some = ["recording", "seconds", "estimate_position_x", "estimate_position_y", "sigma_position_x"]
    table[some].to_csv(folder / "part.csv", index=False)
    names = ["imm", f"file:{folder / 'whole.csv'}", f"file:{folder / 'part.csv'}"]
    found = evaluate(TARGET, names, **SETTINGS)
    np.testing.assert_allclose(found["nees"][1], whole["nees"][0], rtol=1e-9)  # a root and a square
    records = {r.policy: r.value for r in tidy_records(found) if (r.metric, r.window) == ("anees", "all")}
    assert records["imm"] == pytest.approx(records[names[1]])
    # Of y there is a mean and no deviation.
    expected = whole["error"].values[0, ..., 0] ** 2 / whole["covariance"].values[0, ..., 0, 0]
    np.testing.assert_allclose(found["nees"][2], expected, rtol=1e-9)


def test_rows_that_are_missing_are_counted_and_tracks_that_end_are_lost(files):
    folder, whole = files
    table = pandas.read_csv(folder / "imm.csv")
    kept = (table["measurement"] != 3) & (table["recording"] != 2)
    kept &= (table["recording"] != 4) | (table["measurement"] <= 5)
    table[kept].to_csv(folder / "gaps.csv", index=False)
    found, records = judged(folder / "gaps.csv")
    run, E, K = found.isel(policy=0), SETTINGS["episodes"], SETTINGS["horizon"]
    missing = E + (K - 1) + (K - 5)
    assert records["missing", ""] == pytest.approx(missing / (E * K))
    np.testing.assert_array_equal(run["lost"].isel(time=-1), [0, 0, NO_ROW, 0, NO_ROW, 0])
    # What is missing is held: before any row the initial estimate. Sums and differences round.
    estimate = (run["error"] - whole["error"][0]).values + whole["estimate"][0].values
    np.testing.assert_allclose(estimate[0, 2], whole["estimate"].values[0, 0, 1], rtol=1e-12)
    np.testing.assert_allclose(estimate[2], np.tile(estimate[2, :1], (K, 1)), rtol=1e-12)
    (note,) = notes_of(found)
    assert "2 of 6 episodes lost: the file contains no more estimates of the track in episode 2" in note


def test_a_recording_is_matched_by_its_names_and_its_own_clock(files, tmp_path):
    recording = record(TARGET, "paper", 2, horizon=15)
    began = np.datetime64("2024-05-01T00:00:00", "ms")
    clock = (began + (1000.0 * recording.seconds).astype("timedelta64[ms]")).astype(str)
    recording = dataclasses.replace(recording, names=("east", "west"), log_time=clock)
    whole = evaluate(TARGET, "imm", recording, tracks=True)
    write_estimates(tmp_path / "whole.csv", whole)
    table = pandas.read_csv(tmp_path / "whole.csv", dtype={"log_time": str})
    table.drop(columns=["log_time"]).to_csv(tmp_path / "seconds.csv", index=False)
    table.drop(columns=["seconds"]).to_csv(tmp_path / "dates.csv", index=False)
    for name in ("seconds", "dates"):
        found = evaluate(TARGET, f"file:{tmp_path / name}.csv", recording, tracks=True)
        np.testing.assert_array_equal(found["cost"], whole["cost"])
        assert not found["missing"].any()
    # Nothing shows that moments of another clock are the same ones.
    times = table["log_time"].str.partition("T")[2]
    table.drop(columns=["seconds"]).assign(log_time=times).to_csv(tmp_path / "times.csv", index=False)
    with pytest.raises(ValueError, match="are times of day, and those of the log dates"):
        evaluate(TARGET, f"file:{tmp_path / 'times.csv'}", recording)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "contains no estimate of position_x"),
        ("track,seconds,position_x,position_y\nfoo,1,2,3\n", "tracks foo, and those of the evaluation are 0, 1"),
        ("seconds,position_x,position_y\n1,2,3\n", "names no tracks"),
        ("track,seconds,velocity_x\n0,1,2\n", "lacks position_x, position_y, velocity_y, which the cost of"),
        ("track,position_x,position_y\n0,2,3\n", "needs a column seconds"),
        ("track,seconds,position_x,position_y\n0,1,x,3\n", "position_x has 'x' in row 0"),
        ("track,time,position_x,position_y\n0,2024-05-01T00:00:00,1,3\n", "are dates, but those of a simulation"),
        ("policy,track,seconds,position_x\na,0,1,2\nb,0,2,2\n", "several competitors, a, b"),
        (None, "there is no such file"),
    ],
)  # fmt: skip
def test_what_belongs_to_no_track_is_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "mine.csv").write_text(text)
    task = problem_of(TARGET).experiment(None).make_task()
    with pytest.raises(ValueError, match=message):
        FileEstimates(tmp_path / "mine.csv").of_tracks(task, {11: "0", 12: "1"})


def test_what_cannot_be_written_or_judged_is_refused(files):
    with pytest.raises(ValueError, match=r"estimates are written as \.csv or \.nc"):
        write_estimates(files[0] / "imm.txt", files[1])
    with pytest.raises(ValueError, match="closed loop"):
        evaluate("filtergym/UavAutopilot-v0", f"file:{files[0] / 'imm.csv'}", episodes=2)


def test_a_blind_recording_holds_all_that_is_received_and_no_truth(files, tmp_path):
    folder, whole = files
    experiment = problem_of(TARGET).experiment(None)
    recording = record(TARGET, **SETTINGS)
    write_blind(tmp_path, recording, experiment.make_task())
    assert "seed" in recording.source
    assert b"seed" not in (tmp_path / "measurements.nc").read_bytes()
    table = pandas.read_csv(tmp_path / "measurements.csv").set_index(["track", "measurement"])
    written = pandas.read_csv(folder / "imm.csv").set_index(["recording", "measurement"])
    np.testing.assert_allclose(table["seconds"], written["seconds"], rtol=1e-12)
    missed = table["available"] == 0.0
    assert missed.any()
    assert table.loc[missed, "position_1"].isna().all()
    shown = whole["measurement_position"].values[0, ..., 0].ravel()
    np.testing.assert_array_equal(table.loc[~missed, "position_1"], shown[~missed])
    start = pandas.read_csv(tmp_path / "start.csv")
    np.testing.assert_array_equal(start["mean_velocity_y"], recording.initial["mean"][:, 3])
    assert not [name for name in [*table, *start] if "truth" in name]
    assert b"truth" not in (tmp_path / "measurements.nc").read_bytes()


START = 1_403_715_273_262_142_976
"""ns since 1970, of a log at 20 Hz."""
STAMPS = START + 50_000_000 * np.arange(60)
CLOCKS = {
    "seconds": lambda stamp: f"{stamp // 10**9}.{stamp % 10**9:09d}",
    "ns": str,
    "us": lambda stamp: str(stamp // 1000),
    "ms": lambda stamp: str(stamp // 10**6),
    "ISO": lambda stamp: f"{np.datetime64(int(stamp), 'ns')}Z",
    "since the first": lambda stamp: f"{(stamp - START) / 1e9:.9f}",
}


def write_log(path, header, stamps, places, clock, separator=",", end=""):
    lines = [
        separator.join([CLOCKS[clock](int(stamp)), *(f"{value:.5f}" for value in place)]) + end
        for stamp, place in zip(stamps, places, strict=True)
    ]
    path.write_text("\n".join([*header, *lines]) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def timed(tmp_path_factory):
    """Measurements and truth of a log, and the RMSE of a program that repeats the measurements."""
    folder, time = tmp_path_factory.mktemp("times"), 0.05 * np.arange(60)
    truth = 30.0 + np.column_stack([2.0 * np.cos(0.3 * time), 2.0 * np.sin(0.4 * time)])
    seen = truth + np.random.default_rng(2).normal(0.0, 0.05, truth.shape)
    both = np.column_stack([seen, truth])
    columns = ["time,x,y,truth_position_x,truth_position_y"]
    for clock in CLOCKS:
        write_log(folder / f"{clock}.csv", columns, STAMPS, both, clock)
    return folder, seen.round(5), truth.round(5)


def error_of(folder, log, estimates):
    found = evaluate(TARGET, f"file:{estimates}", scenario=read_recording(folder / f"{log}.csv", TARGET))
    error = found["error"].values[0, 0, :, :2]
    return error[np.isfinite(error).all(axis=1)]


@pytest.mark.parametrize("log", ["seconds", "ns", "ISO"])
@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("form", ["time", "log_time", "tum"])
def test_times_of_another_program_are_found_by_the_time_of_the_log(timed, tmp_path, log, clock, form):
    folder, seen, truth = timed
    if form == "tum":
        if clock == "ISO":
            pytest.skip("a trajectory has numbers")
        path = write_log(tmp_path / "mine.tum", [], STAMPS, seen, clock, " ", " 0 0 0 0 1")
    else:
        if (form, clock) == ("log_time", "since the first"):
            pytest.skip("is no time of this log")
        path = write_log(tmp_path / "mine.csv", [f"{form},position_x,position_y"], STAMPS, seen, clock)
    # The track starts with the second row; five decimals of numbers near 30 m.
    np.testing.assert_allclose(error_of(folder, log, path), (seen - truth)[2:], atol=1e-12)


@pytest.mark.parametrize("log", ["seconds", "ns", "ISO", "since the first"])
def test_a_trajectory_has_the_time_of_the_log(timed, tmp_path, log):
    folder, _, _ = timed
    recording = read_recording(folder / f"{log}.csv", TARGET)
    whole = evaluate(TARGET, "kalman-imm-turn", scenario=recording, tracks=True)
    write_estimates(tmp_path / "e.tum", whole)
    (name,) = (each for each in (tmp_path / "e.tum").iterdir() if not each.name.startswith("truth"))
    rows = np.loadtxt(name)
    begin = 0.0 if log == "since the first" else START / 1e9
    # A double of seconds since 1970 is right to 0.24 us.
    np.testing.assert_allclose(rows[:, 0] - begin, 0.05 * np.arange(2, 2 + len(rows)), atol=5e-7)
    np.testing.assert_allclose(
        error_of(folder, log, name)[: len(rows)], whole["error"].values[0, 0, : len(rows), :2], atol=1e-8
    )


def test_estimates_of_another_clock_are_refused_with_both_spans(timed, tmp_path):
    folder, seen, _ = timed
    later = write_log(tmp_path / "later.csv", ["time,position_x,position_y"], STAMPS + 10**16, seen, "ns")
    with pytest.raises(ValueError, match=r"0 % of the measurements .* 2014-10-19T.* log from 2014-06-25T"):
        error_of(folder, "ns", later)
    few = write_log(tmp_path / "few.csv", ["time,position_x,position_y"], STAMPS[:20], seen[:20], "ns")
    with pytest.raises(ValueError, match=r"31 % of the measurements"):
        error_of(folder, "seconds", few)
