"""Tables of one's own as measurements of a state-space model, against its simulation and naive loops."""

import shutil
from types import SimpleNamespace

import numpy as np
import pandas
import pytest
from naive import kalman_update
from own_models import forget

import filtergym
from filtergym import read_recording, record
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.companions import find_companion
from filtergym.envs.contract.log_format import LogFormat
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.evaluation.statistics.innovations import with_innovations
from filtergym.exports.c_source import export_c
from filtergym.exports.request import request_export

TIMED = {
    "f": lambda x, dt: [x[0] + dt * x[1], x[1]],
    "Q": lambda dt: [[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]],
}
FIXED = {"f": [[1.0, 0.5], [0.0, 1.0]], "Q": [[0.1, 0.2], [0.2, 0.5]], "sampling_interval": 0.5}
BOTH = {
    "h": [[1, 0], [0, 1]],
    "R": [[25.0, 0.0], [0.0, 0.25]],
    "mean": [0, 10],
    "covariance": [[100, 0], [0, 25]],
    "names": ["Position", "velocity"],
    "units": ["m", "m/s"],
    "measured": ["gps", "Odometry"],
}
TEXT = "time,gps,odometry\n10,3.0,10.0\n10.4,,9.8\n11.3,14.0,\n12,20.5,10.1\n"
ID = "mine/Table-v0"


@pytest.fixture
def make():
    yield lambda **keywords: filtergym.state_space(ID, **{**TIMED, **BOTH, **keywords})
    forget(ID)


def written(path, text):
    path.write_text(text)
    return path


def naive(rows, R):
    """Kalman filter of the timed model, of rows ``(dt, gps, odometry)``, with NumPy's inverse."""
    x, P = np.array([0.0, 10.0]), np.diag([100.0, 25.0])
    for dt, *z in rows:
        F = np.array([[1.0, dt], [0.0, 1.0]])
        x, P = F @ x, F @ P @ F.T + np.array(TIMED["Q"](dt))
        x, P = kalman_update(x, P, np.array(z) - x, np.eye(2), R)
    return x, P


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_of_any_times_is_what_a_naive_filter_makes_of_it(make, tmp_path, suffix):
    make()
    path = written(tmp_path / "log.csv", TEXT)
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
        pandas.read_csv(path).to_parquet(tmp_path / "log.parquet")
    recording = read_recording(tmp_path / f"log.{suffix}", ID)
    usual = float(np.median(np.diff([10.0, 10.4, 11.3, 12.0])))
    rows = [(usual, 3.0, 10.0), (0.4, np.nan, 9.8), (0.9, 14.0, np.nan), (0.7, 20.5, 10.1)]
    np.testing.assert_allclose(recording.measurements["interval"][0], [row[0] for row in rows], rtol=1e-12)
    np.testing.assert_array_equal(recording.measurements["available"][0], [[1, 1], [0, 1], [1, 0], [1, 1]])
    assert recording.truth is None
    run = filtergym.evaluate(ID, ["kalman", "extended"], scenario=recording, tracks=True)
    mean, P = naive(rows, np.diag([25.0, 0.25]))
    for name in ("kalman", "extended"):
        own = run.sel(policy=name).isel(episode=0, time=-1)
        np.testing.assert_allclose(own["estimate"].values.ravel(), mean, rtol=1e-12)
        np.testing.assert_allclose(own["covariance"].values.reshape(2, 2), P, rtol=1e-12, atol=1e-12)
    # What is predicted of every sensor, and NaN where none was received.
    second = {name: values[0, 1][..., None] for name, values in recording.measurements.items()}
    predicted, received = find_companion(task_class(ID), LogFormat).predict(
        np.array([[0.0], [10.0]]), SimpleNamespace(**second), None
    )
    np.testing.assert_allclose(predicted, [[4.0], [10.0]], rtol=1e-9)
    np.testing.assert_array_equal(received, [[np.nan], [9.8]])


@pytest.mark.parametrize("kind", [TIMED, FIXED])
def test_a_recording_that_is_written_as_a_table_is_read_as_it_was(make, tmp_path, kind):
    make(**kind)
    jitter = {"jitter": 0.9} if kind is TIMED else {}
    made = record(ID, episodes=1, horizon=30, availability=0.8, **jitter)
    there = made.measurements["available"][0] > 0.0
    columns = np.where(there, made.measurements["values"][0], np.nan)
    rows = np.column_stack([500.0 + made.seconds[0], columns, made.truth[0]])
    names = ["time", "gps", "odometry", "truth_position", "truth_velocity"]
    table = pandas.DataFrame(rows, columns=names)
    if kind is FIXED:
        # Where nothing was received a row may lack; the last is needed to know how long it went on.
        table = table[there.any(axis=1) | np.isin(np.arange(len(table)), [0, len(table) - 1])]
        assert len(table) < len(there)
    table.to_csv(tmp_path / "log.csv", index=False)
    first = float(made.seconds[0, 0]) if kind is TIMED else 0.5
    read = read_recording(tmp_path / "log.csv", ID, sampling_interval=first)
    for name, values in made.measurements.items():
        np.testing.assert_allclose(read.measurements[name], values, rtol=0.0, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(read.seconds, made.seconds, rtol=0.0, atol=1e-9)
    runs = [filtergym.evaluate(ID, ["kalman"], scenario=each, tracks=True) for each in (made, read)]
    np.testing.assert_allclose(*(run["estimate"].values[:, :, :30] for run in runs), rtol=0.0, atol=1e-7)
    first, second = (run["error"].values[:, :, :30] for run in runs)
    known = np.isfinite(second)
    assert known.sum() > 40
    np.testing.assert_allclose(first[known], second[known], rtol=0.0, atol=1e-7)


def test_the_innovation_of_a_table_is_the_measurement_less_its_prediction(make, tmp_path):
    cls = make()
    recording = read_recording(written(tmp_path / "log.csv", TEXT), ID)
    run = filtergym.evaluate(ID, ["kalman"], scenario=recording, tracks=True)
    found = with_innovations(run, make_task(cls, recording))["prediction_error"].values[0, 0]
    x = run["estimate"].transpose("policy", "episode", "time", "component").values[0, 0]
    np.testing.assert_allclose(found[1, 1], 9.8 - x[0, 1], rtol=1e-12)
    np.testing.assert_allclose(found[2, 0], 14.0 - (x[1, 0] + 0.9 * x[1, 1]), rtol=1e-10)
    assert np.isnan([*found[0], found[1, 0], found[2, 1]]).all()


@pytest.mark.parametrize(
    ("kind", "text", "sentence"),
    [
        (TIMED, "time,gps\n0,1\n1,2\n", r"lacks the column odometry; .* give --rename 'NAME=odometry'"),
        (TIMED, "t,pos,odom\n0,1,2\n1,2,3\n", "such as --rename 't=time,pos=gps,odom=odometry'"),
        (TIMED, "time,gps,odometry\n0,,\n1,,\n", "no row has a value of gps, odometry"),
        (TIMED, "time,gps,odometry\n0,1,2\n1,2,-1e308\n", r"odometry is -1e\+308 in row 1, and 1e\+15 at most"),
        (FIXED, "time,gps,odometry\n0,1,2\n0.7,2,3\n", r"moves by 0.5 s .* row 1 is 0.7 s after row 0: give --set"),
        (FIXED, "time,gps,odometry\n0,1,2\n0.001,2,3\n", "row 1 is 0.001 s after row 0"),

    ],
)  # fmt: skip
def test_a_table_that_does_not_fit_is_refused_with_what_to_type(make, tmp_path, kind, text, sentence):
    make(**kind)
    with pytest.raises(ValueError, match=sentence):
        read_recording(written(tmp_path / "log.csv", text), ID)


def test_columns_may_be_named_by_the_user(make, tmp_path):
    make()
    path = written(tmp_path / "log.csv", TEXT.replace("time,gps,odometry", "t,pos,odom"))
    found = read_recording(path, ID, rename={"T": "time", "pos": "gps", "odom": "Odometry"})
    plain = read_recording(written(tmp_path / "plain.csv", TEXT), ID)
    np.testing.assert_array_equal(found.measurements["values"], plain.measurements["values"])
    assert found.columns == {"time": "t", "gps": "pos", "odometry": "odom"}
    for rename, sentence in (
        ({"position": "gps"}, "it has no column position, which was to become gps; it has t, pos, odom"),
        ({"pos": "height"}, "pos was to become height, which is not read: choose from gps, odometry"),
        ({"pos": "gps", "odom": "gps"}, "two columns would become gps"),
    ):
        with pytest.raises(ValueError, match=sentence):
            read_recording(path, ID, rename={"t": "time", **rename})


def test_a_column_is_ignored(make, tmp_path):
    make()
    lines = TEXT.splitlines()
    more = "\n".join([f"{lines[0]},gpss", *(f"{line},1" for line in lines[1:])])
    path = written(tmp_path / "log.csv", f"{more}\n")
    assert "not read: column gpss" in read_recording(path, ID).notes
    found = read_recording(path, ID, rename={"gpss": "-"})
    plain = read_recording(written(tmp_path / "plain.csv", TEXT), ID)
    np.testing.assert_array_equal(found.measurements["values"], plain.measurements["values"])
    assert not any("gpss" in note for note in found.notes)
    with pytest.raises(ValueError, match="it has no column sped, which was to be left out; it has time, gps"):
        read_recording(path, ID, rename={"sped": "-"})
    with pytest.raises(ValueError, match=r"gpss was to become height, .* or gpss=- to ignore the column"):
        read_recording(path, ID, rename={"gpss": "height"})


def test_rows_of_one_time_from_several_sensors_are_one_measurement(make, tmp_path):
    make()
    text = "time,gps,odometry\n10,3.0,\n10,,10.0\n10.4,,9.8\n11.3,14.0,\n12,,10.1\n12,20.5,10.1\n"
    found = read_recording(written(tmp_path / "log.csv", text), ID)
    plain = read_recording(written(tmp_path / "plain.csv", TEXT), ID)
    for name, values in plain.measurements.items():
        np.testing.assert_array_equal(found.measurements[name], values, err_msg=name)
    np.testing.assert_array_equal(found.log_time, plain.log_time)
    assert any(note.startswith("2 rows joined with one of the same time") for note in found.notes)
    other = TEXT.replace("10.4,,9.8", "10.0,5.0,9.8")
    with pytest.raises(ValueError, match="time is the same in rows 0 and 1"):
        read_recording(written(tmp_path / "other.csv", other), ID)


def test_commands_take_a_table(make, tmp_path, monkeypatch, command, success):
    make()
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.3, 2.0, 60))
    speed = 10.0 + np.cumsum(rng.normal(0.0, 1.0, 60))
    rows = np.column_stack([time, 10.0 * time + rng.normal(0.0, 5.0, 60), speed])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,gps,odometry", comments="")
    monkeypatch.chdir(tmp_path)
    log = ("--recording", "log.csv", "--rename", "t=time")
    success("evaluate", ID, *log, "--policy", "kalman")
    shown = success("tune", ID, *log, "--policy", "extended", "--out", ".")
    assert "measurement noise" in shown
    assert f"filtergym evaluate {problem_of(ID).name} --policy" in shown.replace("\n", " ")
    code, _, errors = command("tune", ID, "--policy", "extended", "--truth", "log.csv")
    assert (code, "--truth is for a recording" in errors) == (2, True)
    for renamed in ("t", "t=time,", "t=time=x"):
        code, _, errors = command("evaluate", ID, "--recording", "log.csv", "--rename", renamed)
        assert (code, "--rename takes NAME=MEANING" in errors) == (2, True)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no compiler")
def test_a_filter_is_exported_and_tried_on_a_table(make, tmp_path):
    make()
    recording = read_recording(written(tmp_path / "log.csv", TEXT), ID)
    assert export_c(request_export(problem_of(ID), "extended", recording), tmp_path).difference < 1e-9


def test_names_of_measurements_are_distinct(make):
    for measured in (["one"], ["a", "A"], ["a", "time"], ["a", "truth_x"], ["a", ""]):
        with pytest.raises(ValueError, match=r"measured must|names of measured numbers must"):
            make(measured=measured)
