"""The truth of a log in a file of its own: what is matched, interpolated, noted and refused."""

import numpy as np
import pandas
import pytest

from filtergym import read_recording
from filtergym.envs.logs.truth_files import LONGEST_GAP, offset_note

ID = "filtergym/ManeuveringTarget-v0"
COUNT = 80
TIME = np.arange(COUNT) * 1.0


def path_of(time):
    """A car at 15 m/s that turns, m, ``(n, 2)``."""
    return np.stack([200.0 * np.sin(0.075 * time), 200.0 * np.cos(0.075 * time)], axis=1)


def log(**changes):
    rng = np.random.default_rng(0)
    fixes = path_of(TIME) + rng.normal(0.0, 2.0, (COUNT, 2))
    columns = {"time": TIME, "x": fixes[:, 0], "y": fixes[:, 1], "sigma_x": 2.0, "sigma_y": 2.0}
    return pandas.DataFrame({**columns, **changes})


def truth(time, **changes):
    x, y = path_of(np.asarray(time)).T
    return pandas.DataFrame({"time": time, "x": x, "y": y, **changes})


def read(tmp_path, table, true, name="truth.csv", **keywords):
    table.to_csv(tmp_path / "log.csv", index=False)
    if isinstance(true, str):
        (tmp_path / name).write_text(true)
    else:
        true.to_csv(tmp_path / name, index=False)
    return read_recording(tmp_path / "log.csv", ID, truth=tmp_path / name, **keywords)


def test_equal_times_are_as_in_one_file(tmp_path):
    """Bit for bit, whatever the order of other columns."""
    apart = read(tmp_path, log(), truth(TIME))
    x, y = path_of(TIME).T
    log(truth_position_x=x, truth_position_y=y).to_csv(tmp_path / "both.csv", index=False)
    together = read_recording(tmp_path / "both.csv", ID)
    np.testing.assert_array_equal(apart.truth, together.truth)
    expected = "80 of 80 rows have a truth: 80 at the same time, 0 between two that are at most 1.5 s apart"
    assert expected in apart.notes


def test_it_is_interpolated_in_short_gaps_alone(tmp_path):
    """Of a truth every 0.4 s with a hole, and only there nothing is known; linear, so exact for a linear path."""
    time = np.arange(-0.2, 90.0, 0.4)
    time = time[(time < 20.1) | (time > 30.1)]
    true = truth(time, x=3.0 * time, y=-time)
    recording = read(tmp_path, log(), true)
    # The first two rows make the start.
    now = TIME[2:]
    inside = (now > time[time < 20.1][-1]) & (now < time[time > 30.1][0])
    np.testing.assert_array_equal(np.isnan(recording.truth[0, :, 0]), inside)
    np.testing.assert_allclose(recording.truth[0, ~inside, 0], 3.0 * now[~inside], atol=1e-9)
    np.testing.assert_allclose(recording.truth[0, ~inside, 1], -now[~inside], atol=1e-9)
    assert inside.sum() == 11
    assert "69 of 80 rows have a truth" in recording.notes[0]


def test_a_gap_longer_than_the_limit_is_one(tmp_path):
    step = LONGEST_GAP + 0.1
    recording = read(tmp_path, log(), truth(np.arange(0.0, 80.0, step)))
    known = np.isfinite(recording.truth[0, :, 0])
    on_it = np.abs(TIME[2:] / step - np.round(TIME[2:] / step)) < 1e-6
    np.testing.assert_array_equal(known, on_it)


def test_dates_are_matched_with_seconds_since_1970_and_with_rtklib(tmp_path):
    start = pandas.Timestamp("2026-05-01 12:00:00", tz="UTC")
    dates = [f"{start + pandas.Timedelta(seconds=t):%Y-%m-%dT%H:%M:%SZ}" for t in TIME]
    plain = read(tmp_path, log(), truth(TIME))
    mixed = read(tmp_path, log(time=dates), truth(TIME).assign(time=TIME + start.timestamp()))
    np.testing.assert_array_equal(mixed.truth, plain.truth)
    header = "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m)"
    degrees = path_of(TIME) / 111e3
    rows = [
        f"2026/05/01 {start + pandas.Timedelta(seconds=t):%H:%M:%S.000} {y + 48.0:.9f} {x + 2.0:.9f} 100 1 9 0.01 0.01"
        for t, (x, y) in zip(TIME, degrees, strict=True)
    ]
    table = log(time=dates).drop(columns=["x", "y"])
    noise = np.random.default_rng(1).normal(0.0, 2e-5, (COUNT, 2))
    table = table.assign(lat=degrees[:, 1] + 48.0 + noise[:, 1], lon=degrees[:, 0] + 2.0 + noise[:, 0])
    found = read(tmp_path, table, "\n".join([header, *rows]), "truth.pos")
    error = found.measurements["position"] - found.truth[..., :2]
    assert np.sqrt((error**2).mean()) == pytest.approx(2e-5 * 111e3 * 0.86, rel=0.15)  # east is 0.67 of north
    assert any(note.startswith("truth: times are GPST") for note in found.notes)


def test_an_offset_is_reported_and_not_applied(tmp_path):
    late = truth(TIME).assign(time=TIME + 18.0)
    found = read(tmp_path, log(), late)
    sentences = [note for note in found.notes if "were added to its times" in note]
    assert len(sentences) == 1
    assert "-18.0 s" in sentences[0]
    assert "Nothing was shifted" in sentences[0]
    shifted = read(tmp_path, log(), late, truth_offset=-18.0)
    np.testing.assert_allclose(shifted.truth, read(tmp_path, log(), truth(TIME)).truth, atol=1e-9)
    assert any("-18 s were added to its times" in note for note in shifted.notes)
    assert not any("Nothing was shifted" in note for note in shifted.notes)


def test_an_offset_that_changes_is_none():
    """The clocks drift apart by 20 s: no constant would do."""
    time = np.arange(400.0)
    wrong = path_of(time - np.linspace(-10.0, 10.0, 400))
    assert offset_note(time, wrong, path_of(time)) == ""
    assert "+5.0 s" in offset_note(time, path_of(time - 5.0), path_of(time))


@pytest.mark.parametrize(
    ("true", "message"),
    [
        (truth(TIME + 500.0), "no measurement has a truth: the log's times are from 0 s to 79 s, those of .* from 5"),
        (truth(TIME).assign(time="12:00:00"), "times of the log are seconds and those of the truth times of day"),
        (truth(TIME).drop(columns="y"), "column truth_position_y is missing|lacks the column"),
        (truth(TIME)[["time"]], "has the columns time, and needs time and x and y"),
        (truth(TIME[::-1]), "time decreases from .* in row 0 to .* in row 1: --sort "),
        (truth(TIME[:1]), "it has one row"),
    ],
)  # fmt: skip
def test_what_cannot_be_matched_is_refused(true, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, log(), true)


def test_one_truth_is_enough(tmp_path):
    table = log(truth_position_x=0.0, truth_position_y=0.0)
    with pytest.raises(ValueError, match="leave these columns or the file of the truth out"):
        read(tmp_path, table, truth(TIME))
    recording = read(tmp_path, log(), truth(TIME))
    recording.write(tmp_path / "log.nc")
    with pytest.raises(ValueError, match="holds its own truth"):
        read_recording(tmp_path / "log.nc", ID, truth=tmp_path / "truth.csv")
    with pytest.raises(ValueError, match="there is no such file"):
        read_recording(tmp_path / "log.csv", ID, truth=tmp_path / "nothing.csv")


def test_commands_take_it(tmp_path, refusal, success):
    read(tmp_path, log(), truth(TIME))
    given = ("--recording", tmp_path / "log.csv", "--truth", tmp_path / "truth.csv")
    out = success("evaluate", ID, *given, "--policy", "imm")
    assert "80 of 80 rows have a truth" in " ".join(out.split())
    assert "RMSE" in out
    assert "--truth is for a recording" in refusal(
        "evaluate", ID, "--scenario", "paper", "--truth", tmp_path / "truth.csv"
    )
