"""Wrong units, clocks and columns in recordings: refused or noted; what is right passes without a word."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from test_recording import table

from filtergym import evaluate, read_recording, record
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.logs.plausibility import check_extents
from filtergym.evaluation.storage.dataset import notes_of
from filtergym.reports.tables.advice import reading_lines

TARGET, LOOSE, ESM = (
    f"filtergym/{name}-v0" for name in ("ManeuveringTarget", "LooselyCoupledNavigation", "RadarEsmTracking")
)
TIME = 5.0 * np.arange(60)
KNOT = 1.944


def plots(**changes):
    """Plots of an aircraft with its truth; changes are functions of a column."""
    noise = np.random.default_rng(0).normal(0.0, 100.0, (2, len(TIME)))
    truth = np.stack([-20e3 + 150.0 * TIME, 15e3 + 0.02 * TIME**2])
    columns = {"time": TIME, "x": truth[0] + noise[0], "y": truth[1] + noise[1]}
    columns |= {"truth_position_x": truth[0], "truth_position_y": truth[1]}
    columns |= {"truth_velocity_x": np.full(60, 150.0), "truth_velocity_y": 0.04 * TIME}
    return _changed(columns, changes)


def further_notes(recording):
    """Notes on a recording but for what was assumed because no column states deviations."""
    return [note for note in recording.notes if "no column states deviations" not in note]


def polar(**changes):
    """Ranges and azimuths of an aircraft that flies around the radar, and nothing true."""
    angle, noise = np.radians(40.0) + 0.005 * TIME, np.random.default_rng(1).normal(size=(2, len(TIME)))
    azimuth = np.degrees(angle) + 0.25 * noise[1]
    return _changed({"time": TIME, "range": 30e3 + 100.0 * noise[0], "azimuth": azimuth}, changes)


def drive(**changes):
    """INS and receiver of a car, ten times a second, along one axis."""
    time, noise = 0.1 * np.arange(200), np.random.default_rng(2).normal(0.0, 1.4, 200)
    position = 15.0 * time + 5.0 * np.sin(time)
    return _changed({"time": time, "ins": position + 0.01 * time, "fix": position + noise}, changes)


def echoes(**changes):
    """Ranges and range rates of an aircraft that comes nearer, with the true ones."""
    time, noise = 0.5 * np.arange(100), np.random.default_rng(3).normal(size=(2, 100))
    columns = {"time": time, "range": 60e3 - 200.0 * time + 3e3 * noise[0]}
    columns |= {"range_rate": -200.0 + 50.0 * noise[1], "truth_range": 60e3 - 200.0 * time}
    columns |= {"truth_range_rate": np.full(100, -200.0), "truth_acceleration": np.zeros(100)}
    return _changed(columns, changes)


def _changed(columns, changes):
    found = dict(columns)
    for name, change in changes.items():
        found[name] = change(columns[name]) if callable(change) else change
    return found


def untold(columns):
    return {name: values for name, values in columns.items() if not name.startswith("truth_")}


def test_extents_a_thousand_times_apart_are_refused():
    """In either order; half and twice as much are not a slip of units, nor is NaN an extent."""
    track = np.array([[0.0, np.nan], [3.0, 0.0], [np.nan, 4.0]])
    for factor, refused in ((1000.0, True), (600.0, True), (1900.0, True), (400.0, False), (2500.0, False)):
        for series in ((factor * track, track), (track, factor * track)):
            if not refused:
                check_extents(("ins", "fix"), *series)
                continue
            with pytest.raises(ValueError, match=r"extends over .* m: is \w+ kilometres"):
                check_extents(("ins", "fix"), *series)


def kilometres(values):
    return 1e-3 * values


def milliseconds(values):
    return 1e3 * values


def knots(values):
    return KNOT * values


def an_hour_later(values):
    """A clock that is put forward in the middle."""
    return values + 3600.0 * (values >= values[30])


def an_hour_earlier(values):
    return values - 3600.0 * (values >= values[30])


RANGES = "range", "truth_range", "truth_range_rate"
FAR = {"truth_position_x": kilometres, "truth_position_y": kilometres, "truth_velocity_x": kilometres}
WRONG = [
    (TARGET, plots(x=kilometres, y=kilometres), "are x, y kilometres"),
    (TARGET, polar(range=kilometres), "are x, y kilometres"),
    (TARGET, polar(azimuth=np.radians), "azimuth scatters by .* is it radians"),
    (TARGET, plots(time=milliseconds), "times are 5000 s apart, .* are they milliseconds"),
    (TARGET, plots(time=lambda t: t / 60.0), "are the times minutes"),
    (TARGET, plots(truth_velocity_x=knots, truth_velocity_y=knots), "1.94 times .* knots"),
    (TARGET, plots(**FAR, truth_velocity_y=kilometres), "truth lies .* is it kilometres"),
    (LOOSE, drive(ins=kilometres, fix=kilometres), "positions scatter by .* kilometres"),
    (LOOSE, drive(fix=kilometres), "ins extends over .* is fix kilometres"),
    (LOOSE, drive(time=milliseconds), "times are 100 s apart, .* are they milliseconds"),
    (ESM, echoes(**dict.fromkeys(RANGES, kilometres)), "positions scatter by .* kilometres"),
    (ESM, echoes(time=milliseconds), "times are 500 s apart, .* are they milliseconds"),
    (ESM, echoes(truth_range_rate=knots), "truth_range_rate are 1.94 times .* knots"),
    (TARGET, plots(sigma=np.ones(60)), "column sigma, .* did you mean .*sigma_x"),
    (TARGET, polar(range_std=np.ones(60)), "column range_std, .* did you mean .*range_sigma"),
    (TARGET, polar(azimuth_sigme=np.ones(60)), "azimuth_sigme, .* did you mean azimuth_sigma"),
    (TARGET, untold(plots(time=an_hour_later)), "3,605 s pass .* did the clock change"),
    (TARGET, plots(time=an_hour_earlier), "time decreases .* in UTC"),
]


@pytest.mark.parametrize(("env", "columns", "sentence"), WRONG, ids=[sentence for *_, sentence in WRONG])
def test_what_cannot_be_is_refused_in_a_sentence(env, columns, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence) as refusal:
        read_recording(table(tmp_path / "wrong.csv", **columns), env)
    assert "\n" not in str(refusal.value)


def outlier(values):
    return np.where(np.arange(len(values)) == 20, values + 50e3, values)


def late(values):
    """Times of a track that was lost for ten minutes."""
    return values + 600.0 * (values >= values[30])


STATED = {"sigma_x": np.full(60, 100.0), "sigma_y": np.full(60, 100.0)}
IN_RADIANS = {"azimuth": np.radians, "azimuth_sigma": np.full(60, np.radians(0.25))}
STANDING = untold(plots(x=lambda x: x - 150.0 * TIME, y=lambda y: y - 0.02 * TIME**2)) | STATED
TWICE = dict.fromkeys("xy", lambda v: np.where(np.arange(60) == 9, v[8], v))
LOST = untold(plots(time=late, x=lambda x: x + 150.0 * 600.0 * (np.arange(60) >= 30)))
NOTED = [
    (TARGET, plots(x=outlier), r"measurement 19 is off the track, by up to 4\d,\d+ m"),
    (LOOSE, drive(fix=outlier), "measurement 20 is off the track"),
    (ESM, echoes(range=lambda r: r + 4.0 * (outlier(r) - r)), "measurement 20 is off the track"),
    (TARGET, STANDING, r"all positions lie within \d\d\d m, where errors of 141 m are stated: the target stands"),
    (TARGET, polar(**IN_RADIANS, range_sigma=np.full(60, 100.0)), "stays within 2 pi and is taken for degrees"),
    (TARGET, plots(**TWICE), "measurement 8 is the same as before"),
    (TARGET, plots(mode_a=np.ones(60), velocity=np.ones(60)), "not read: columns mode_a, velocity"),
    (TARGET, LOST, "nothing was received for 605 s between measurements 28 and 149"),
]  # fmt: skip


@pytest.mark.parametrize(("env", "columns", "sentence"), NOTED, ids=[sentence for *_, sentence in NOTED])
def test_what_is_noteworthy_is_printed(env, columns, sentence, tmp_path):
    path = table(tmp_path / "log.csv", **columns)
    *others, note = further_notes(read_recording(path, env))
    assert others == (["120 missed measurements: these have no row"] if columns is LOST else [])
    assert re.search(sentence, note), note
    again = table(tmp_path / "again.csv", **columns)
    assert f"again: {note}" in read_recording([path, again], env).notes


def test_what_is_noteworthy_goes_with_an_evaluation(tmp_path):
    recording = read_recording(table(tmp_path / "log.csv", **plots(x=outlier)), TARGET)
    *notes, of_intervals = notes_of(evaluate(TARGET, ["random"], recording))
    assert notes == list(recording.notes)
    assert of_intervals.startswith("This one episode has no intervals: it contains ")


def test_a_log_of_ten_rows_is_called_a_guess(tmp_path):
    short = {name: values[:10] for name, values in plots().items()}
    lines = [*reading_lines(read_recording(table(tmp_path / "ten.csv", **short), TARGET))]
    assert any(line.startswith("Fewer than 30 measurements") for line in lines)
    # Kilometres whose deviations are kilometres, too, are a slow target: who knows it sees that.
    (extent,) = (line for line in lines if line.startswith("Positions span"))
    assert re.fullmatch(r"Positions span [45],\d{3} m by [1-4]\d\d m, at 1[2-8]\d m/s in the median.", extent)
    lines = [*reading_lines(read_recording(table(tmp_path / "sixty.csv", **plots()), TARGET))]
    assert not any("guess" in line for line in lines)


@pytest.mark.parametrize(
    ("variable", "factor", "sentence"),
    [
        ("position", 1e-3, "are x, y kilometres"),
        ("seconds", 1e3, "times are 6000 s apart, .* are they milliseconds"),
        ("truth", 1e-3, "truth lies .* is it kilometres"),
    ],
)
def test_files_are_checked_as_tables_are(variable, factor, sentence, tmp_path):
    data = record(TARGET, "paper", episodes=2).dataset
    data[variable] = factor * data[variable]
    data.to_netcdf(tmp_path / "wrong.nc", engine="scipy")
    with pytest.raises(ValueError, match=sentence):
        read_recording(tmp_path / "wrong.nc")


def test_a_right_table_passes_without_a_note(tmp_path):
    for env, columns in ((TARGET, plots()), (TARGET, polar()), (LOOSE, drive()), (ESM, echoes())):
        assert further_notes(read_recording(table(tmp_path / "log.csv", **columns), env)) == []


def test_slow_targets_are_accepted_on_request(tmp_path):
    path = table(tmp_path / "slow.csv", **untold(plots(time=lambda t: 300.0 * t)))
    with pytest.raises(ValueError, match="are the times milliseconds"):
        read_recording(path, TARGET, sampling_interval=1500.0)
    slow = read_recording(path, TARGET, speeds=(0.0, 1000.0), sampling_interval=1500.0)
    assert further_notes(slow) == []


@pytest.mark.parametrize("id", [id for id in catalogue() if "Uav" not in id])
def test_what_filtergym_writes_passes_without_a_note(id, tmp_path):
    """All scenarios but those that simulate what is noted, and closed loops."""
    for scenario in catalogue()[id].scenarios:
        if scenario in ("glint", "outliers", "clutter") or ("Tightly" in id and scenario != "urban"):
            continue
        record(id, scenario, episodes=5, horizon=60).write(tmp_path / "made.nc")
        assert read_recording(tmp_path / "made.nc").notes == (), scenario


def test_files_of_the_documentation_pass_without_a_note(tmp_path):
    docs = Path(__file__).parent.parent / "docs"
    assert read_recording(docs / "data" / "drive.nc").notes == ()
    runpy.run_path(str(docs / "examples" / "plots.py"))["write_plots"](tmp_path / "plots.csv")
    assert further_notes(read_recording(tmp_path / "plots.csv", TARGET)) == []
