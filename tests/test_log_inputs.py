"""Logs as they come: truth of positions only, latitude and longitude, decimal commas, gaps, duplicates and clocks."""

import dataclasses

import gymnasium as gym
import numpy as np
import pandas
import pymap3d
import pytest

from filtergym import evaluate, read_recording, tidy_records
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.envs.logs.flight_tables import seconds
from filtergym.evaluation.storage.estimates import write_estimates

TARGET = "filtergym/ManeuveringTarget-v0"
COUNT = 60
TIME = 5.0 * np.arange(COUNT)
ORIGIN = (48.7, 2.4, 120.0)
"""Latitude, longitude and height."""


def aircraft(**changes):
    """Plots of a slow turn, with deviations and the truth; columns that are None are left out."""
    heading = 0.01 * np.maximum(TIME - 100.0, 0.0)
    velocity = 150.0 * np.stack([np.cos(heading), np.sin(heading)])
    truth = np.cumsum(5.0 * velocity, axis=1)
    plots = truth + np.random.default_rng(0).normal(0.0, 40.0, truth.shape)
    columns = {"time": TIME, "x": plots[0], "y": plots[1], "sigma_x": np.full(COUNT, 40.0)}
    columns |= {"sigma_y": np.full(COUNT, 40.0), "truth_position_x": truth[0], "truth_position_y": truth[1]}
    columns |= {"truth_velocity_x": velocity[0], "truth_velocity_y": velocity[1]}
    return pandas.DataFrame({name: v for name, v in {**columns, **changes}.items() if v is not None})


def untold(**changes):
    found = aircraft(**changes)
    return found[[name for name in found if not name.startswith("truth_")]]


def read(log, tmp_path, **options):
    log.to_csv(tmp_path / "log.csv", index=False, **options)
    return read_recording(tmp_path / "log.csv", TARGET)


def same_measurements(one, other):
    """Whether two recordings are bit for bit the same, but for what they are called."""
    np.testing.assert_array_equal(one.seconds, other.seconds)
    for name, values in one.measurements.items():
        np.testing.assert_array_equal(values, other.measurements[name])


# --- truth that is known in part


def marginal(error, covariance):
    """Oracle: squared Mahalanobis distance of the components that are known, and how many they are."""
    known = np.isfinite(error)
    if not known.any():
        return np.nan, 0
    inverse = np.linalg.inv(covariance[np.ix_(known, known)])
    return error[known] @ inverse @ error[known], known.sum()


def test_what_is_not_known_of_the_truth_is_left_out(tmp_path):
    log = aircraft()
    holes = log.copy()
    holes.loc[10:19, ["truth_velocity_x", "truth_velocity_y"]] = np.nan
    holes.loc[30:34, [name for name in holes if name.startswith("truth_")]] = np.nan
    whole = evaluate(TARGET, ["imm"], scenario=read(log, tmp_path), tracks=True).isel(policy=0, episode=0)
    dataset = evaluate(TARGET, ["imm"], scenario=read(holes, tmp_path), tracks=True)
    found = dataset.isel(policy=0, episode=0)
    np.testing.assert_array_equal(found["estimate"], whole["estimate"])
    # The first two rows make the start.
    unknown = np.isnan(holes.iloc[2:, 5:].to_numpy())
    error = np.where(unknown, np.nan, whole["error"].values)
    np.testing.assert_array_equal(found["error"].values, error)
    cost = np.where(unknown[:, 0], np.nan, whole["cost"].values)
    np.testing.assert_array_equal(found["cost"].values, cost)
    for i in range(COUNT - 2):
        expected, degrees = marginal(error[i], found["covariance"].values[i])
        # Two ways to invert covariances whose condition is below 1e4.
        np.testing.assert_allclose(found["nees"].values[i], expected, rtol=1e-10)
        assert found["nees_degrees"].values[i] == degrees
    records = {(r.metric, r.component): r.value for r in tidy_records(dataset) if r.window == "all"}
    position = np.sqrt(np.nanmean(error[:, 0] ** 2 + error[:, 1] ** 2))
    np.testing.assert_allclose(records["rmse", "position"], position, rtol=1e-12)
    np.testing.assert_allclose(records["cost", ""], np.nanmean(cost), rtol=1e-12)
    of_each = found["nees"].values / np.where(unknown[:, 0], np.nan, 4.0 - 2.0 * unknown[:, 2])
    np.testing.assert_allclose(records["anees", "state"], np.nanmean(of_each), rtol=1e-12)


def test_positions_alone_judge_positions(tmp_path):
    recording = read(aircraft(truth_velocity_x=None, truth_velocity_y=None), tmp_path)
    assert recording.notes == (
        "no truth of velocity_x, velocity_y: errors and NEES are of the other components",
    )
    found = evaluate(TARGET, ["imm", "kalman-imm"], scenario=recording)
    records = tidy_records(found)
    assert {r.component for r in records if r.metric == "rmse"} == {"position_x", "position_y", "position"}
    whole = {
        (r.policy, r.metric, r.component): r.value
        for r in tidy_records(evaluate(TARGET, ["imm", "kalman-imm"], scenario=read(aircraft(), tmp_path)))
    }
    for r in records:
        if r.metric in ("rmse", "cost", "relative_cost_difference", "log_likelihood") and r.window == "all":
            assert r.value == whole[r.policy, r.metric, r.component]
    assert (found["nees_degrees"].values == 2.0).all()
    # A file of it gives the same.
    recording.write(tmp_path / "again.nc")
    again = evaluate(TARGET, ["imm"], scenario=read_recording(tmp_path / "again.nc"))
    np.testing.assert_array_equal(again["nees"].values[0], found["nees"].values[0])
    with pytest.raises(
        ValueError, match=r"lacks some of the truth, so the reward .* leave out reward='cost'"
    ):
        gym.make(TARGET, scenario=recording, reward="cost")


def test_scans_without_a_row_have_no_truth(tmp_path):
    log = aircraft()
    time = TIME + np.random.default_rng(1).uniform(-1.0, 1.0, COUNT)
    recording = read(log.assign(time=time).drop(index=range(20, 26)), tmp_path)
    assert recording.notes == ("6 missed measurements: these have no row",)
    truth = recording.truth[0]
    assert np.isnan(truth).all(axis=1).nonzero()[0].tolist() == [*range(18, 24)]
    np.testing.assert_array_equal(truth[24:], log.iloc[26:, 5:].to_numpy())
    with pytest.raises(ValueError, match="truth is infinite; write NaN for unknown values"):
        dataclasses.replace(recording, truth=np.where(recording.truth > 1e3, np.inf, recording.truth))


# --- latitude and longitude


def geodetic(x, y, up=30.0):
    """Latitude, longitude and height of metres east and north of the origin, by another library."""
    found = pymap3d.enu2geodetic(x, y, np.full(len(x), up), *ORIGIN)
    return dict(zip(("lat", "lon", "altitude"), found, strict=True))


def test_latitude_and_longitude_become_metres_around_the_first(tmp_path):
    log = aircraft(truth_velocity_x=None, truth_velocity_y=None)
    places = geodetic(log["x"], log["y"])
    true = geodetic(log["truth_position_x"], log["truth_position_y"])
    true = {f"truth_{name}": values for name, values in true.items()}
    log = log.drop(columns=["x", "y", "truth_position_x", "truth_position_y"]).assign(**places, **true)
    recording = read(log, tmp_path)
    first = (places["lat"][0], places["lon"][0])
    east, north, _ = pymap3d.geodetic2enu(places["lat"], places["lon"], places["altitude"], *first, 0.0)
    # Both round Earth-fixed coordinates of 6e6 m.
    position = recording.measurements["position"][0]
    np.testing.assert_allclose(position, np.stack([east, north], axis=1)[2:], atol=1e-8)
    east, north, _ = pymap3d.geodetic2enu(*true.values(), *first, 0.0)
    np.testing.assert_allclose(recording.truth[0, :, :2], np.stack([east, north], axis=1)[2:], atol=1e-8)
    assert recording.notes[1] == (
        f"x is east and y north of latitude {first[0]:.8f}, longitude {first[1]:.8f}, the first position"
    )


def test_heights_that_lack_are_those_of_the_others(tmp_path):
    """At 1.6 km a height of zero would move a target at 10 km by 2.5 m."""
    log = untold()
    log = log.drop(columns=["x", "y"]).assign(**geodetic(log["x"], log["y"], 1600.0))
    whole = read(log.assign(altitude=1720.0, truth_lat=log["lat"], truth_lon=log["lon"]), tmp_path)
    position = whole.measurements["position"]
    assert np.abs(position).max() > 10e3
    np.testing.assert_array_equal(whole.truth[..., :2], position)
    some = log["altitude"].where(np.arange(COUNT) % 3 == 0) * 0.0 + 1720.0
    np.testing.assert_array_equal(
        read(log.assign(altitude=some), tmp_path).measurements["position"], position
    )


def test_of_several_altitudes_one_is_taken(tmp_path):
    log = untold()
    log = log.drop(columns=["x", "y"]).assign(**geodetic(log["x"], log["y"]))
    recording = read(log, tmp_path)
    several = log.rename(columns={"altitude": "geoaltitude"}).assign(
        baroaltitude=9e9, latitude=log["lat"], lat=0.0
    )
    again = read(several, tmp_path)
    same_measurements(again, recording)
    assert again.notes[0] == "not read: columns lat, baroaltitude"


def test_places_without_deviations_scatter_as_x_and_y_do(tmp_path):
    log = untold(sigma_x=None, sigma_y=None)
    plane = read(log, tmp_path)
    places = read(log[["time"]].assign(**geodetic(log["x"], log["y"])), tmp_path)
    sigma, expected = (read.deviations["sigma_x"] for read in (places, plane))
    assert 30.0 < expected < 50.0  # 40 m, by the scatter of some forty plots
    assert sigma == pytest.approx(expected, rel=0.02)  # a plane that touches elsewhere, and three digits
    assert places.deviations_from == plane.deviations_from
    assert (places.measurements["variance"] == sigma**2).all()
    note = f"assumed as positions scatter about their neighbours: sigma_x {expected:.3g} m"
    assert note in str(plane.notes)  # a user who evaluates filters on it reads the assumption
    assert (
        read_recording(tmp_path / "log.csv", TARGET, range_sigma=40.0).measurements["variance"] == 1600.0
    ).all()


def test_truth_that_one_file_lacks_judges_no_filter(tmp_path):
    aircraft().to_csv(tmp_path / "a.csv", index=False)
    aircraft(truth_velocity_x=None, truth_velocity_y=None).to_csv(tmp_path / "b.csv", index=False)
    recording = read_recording(tmp_path, TARGET)
    assert recording.truth_known.tolist() == [True, True, False, False]
    components = {
        r.component for r in tidy_records(evaluate(TARGET, ["imm"], recording)) if r.metric == "rmse"
    }
    assert components == {"position_x", "position_y", "position"}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"lon": None}, "lacks the column longitude: latitude and longitude are needed together"),
        ({"lat": np.full(COUNT, 4870.0)}, "latitude reaches 4870, and degrees from -90 to 90"),
        ({"lat": None, "lon": np.full(COUNT, np.nan), "latitude": np.full(COUNT, np.nan)}, "no row has latitude"),
        ({"truth_lat": np.full(COUNT, 48.0)}, "lacks the column truth_longitude"),
        ({"x": TIME, "y": TIME}, "it has x and latitude: leave one of them out"),
        (
            {"x": TIME, "y": TIME, "lat": None, "lon": None, "truth_lat": TIME / 100.0, "truth_lon": TIME / 100.0},
            "it has truth_latitude and no latitude, without which the origin of x and y is not known",
        ),
    ],
)  # fmt: skip
def test_wrong_places_are_one_sentence(changes, sentence, tmp_path):
    log = untold()
    columns = {**log.drop(columns=["x", "y"]), **geodetic(log["x"], log["y"]), **changes}
    with pytest.raises(ValueError, match=r"recording .*log\.csv: ") as refusal:
        read(pandas.DataFrame({n: v for n, v in columns.items() if v is not None}), tmp_path)
    assert sentence in str(refusal.value)


# --- decimal commas, duplicates, repeats


def test_decimal_commas(tmp_path):
    log = aircraft().round(3)
    other = read(log, tmp_path)
    same_measurements(read(log, tmp_path, sep=";", decimal=","), other)
    same_measurements(read(log, tmp_path, sep="\t", decimal=","), other)


def test_rows_that_come_twice_are_left_out(tmp_path):
    log = aircraft()
    recording = read(pandas.concat([log.iloc[:21], log.iloc[20:]]), tmp_path)
    same_measurements(recording, read(log, tmp_path))
    assert recording.notes == ("1 row has the time of the row before: left out, the first is row 21",)
    other = log.iloc[20:21].assign(x=0.0)
    recording = read(pandas.concat([log.iloc[:21], other, log.iloc[20:]]), tmp_path)
    same_measurements(recording, read(log, tmp_path))
    assert recording.notes == (
        "2 rows have the time of the row before, 1 of them with other values: left out, the first is row 21",
    )


def test_times_in_whole_seconds_that_were_faster_are_refused(tmp_path):
    log = untold(time=np.floor(0.25 * np.arange(COUNT)))
    with pytest.raises(
        ValueError, match=r"rows 0 and 1: 45 of 60 rows have the time .* fractions of a second"
    ):
        read(log, tmp_path)


def test_positions_that_repeat_are_no_measurements(tmp_path):
    log = untold()
    log.loc[20:23, ["x", "y"]] = log.loc[19, ["x", "y"]].to_numpy()
    recording = read(log, tmp_path)
    assert (recording.measurements["available"][0] == 0.0).nonzero()[0].tolist() == [18, 19, 20, 21]
    assert recording.notes == (
        "4 rows repeat the position of the row before: left out as measurements, the first is row 20",
    )
    log.loc[20:23, ["x", "y"]] = np.nan
    same_measurements(recording, read(log, tmp_path))


def test_a_receiver_that_stands_still_may_repeat_itself(tmp_path):
    """In numbers as coarse as the noise a position comes again by chance."""
    rng = np.random.default_rng(4)
    steps = np.where(np.arange(COUNT) < 15, 0.0, 5.0)
    east = np.round(np.cumsum(steps) + rng.normal(0.0, 0.003, COUNT), 2)
    north = np.round(rng.normal(0.0, 0.003, COUNT), 2)
    assert ((np.diff(east) == 0.0) & (np.diff(north) == 0.0)).any()
    sigma = np.full(COUNT, 0.01)
    recording = read(untold(time=np.arange(COUNT), x=east, y=north, sigma_x=sigma, sigma_y=sigma), tmp_path)
    assert (recording.measurements["available"] == 1.0).all()


# --- clocks


PARIS = pandas.Timestamp("2026-10-25T00:57:00Z") + pandas.to_timedelta(TIME, unit="s")
"""Three minutes before clocks in Paris go back."""


def test_clocks_of_every_kind(tmp_path):
    expected = read(aircraft(), tmp_path)
    for written in (
        [t.isoformat() for t in PARIS],
        [t.isoformat() for t in PARIS.tz_convert("Europe/Paris")],
        [t.strftime("%Y/%m/%d %H:%M:%S.%f") for t in PARIS],
        [t.strftime("%d.%m.%Y %H:%M:%S,000") for t in PARIS],
        [(t + pandas.Timedelta(hours=23)).strftime("%H:%M:%S") for t in PARIS],
    ):
        recording = read(aircraft(time=written), tmp_path)
        same_measurements(recording, expected)
        assert recording.log_time[0].tolist() == written[2:]


@pytest.mark.parametrize(
    ("zone", "start", "sentence"),
    [
        ("Europe/Paris", "2026-10-25T00:57:00Z", "time decreases from .* in row 35 .* in UTC if the clock"),
        ("Europe/Paris", "2026-03-29T00:57:00Z", "3,605 s pass .* did the clock change, as in daylight saving"),
    ],
)  # fmt: skip
def test_a_local_clock_that_jumps_is_refused(zone, start, sentence, tmp_path):
    local = (pandas.Timestamp(start) + pandas.to_timedelta(TIME, unit="s")).tz_convert(zone).tz_localize(None)
    with pytest.raises(ValueError, match=sentence):
        read(untold(time=[t.isoformat() for t in local]), tmp_path)


@pytest.mark.parametrize(
    ("times", "sentence"),
    [
        (["2026-05-01T12:00:00Z", "2026-05-01T12:00:05"], "row 1, without the offset from UTC that other rows"),
        (["2026-05-01T12:00:00", "2026-05-01T12:00:05+02:00"], "row 0, without the offset from UTC"),
        (["12:00:00", "noon"], "'noon' in row 1, which is no time of day"),
        (["05/01/2026 12:00:00", "05/01/2026 12:00:05"], "row 0, which is neither seconds nor a date"),
        (["31.04.2026 12:00:00", "31.04.2026 12:00:05"], "row 0, which is neither seconds nor a date"),
    ],
)  # fmt: skip
def test_wrong_clocks_are_one_sentence(times, sentence):
    with pytest.raises(ValueError, match=sentence):
        seconds(pandas.Series(times))


def test_midnight_passes():
    times = ["23:59:58.5", "23:59:59.5", "0:00:00.5", "12:00:00", "23:00:00", "1:00:00"]
    found = seconds(pandas.Series(times))
    assert (found - found[0]).tolist() == [0.0, 1.0, 2.0, 43201.5, 82801.5, 90001.5]


# --- estimates


def test_estimates_can_be_joined_with_the_log(tmp_path):
    start = 1756402239.749
    log = aircraft(time=start + TIME)
    recording = read(log.drop(index=range(20, 26)), tmp_path)
    recording.write(tmp_path / "again.nc")
    for again in (recording, read_recording(tmp_path / "again.nc")):
        found = evaluate(TARGET, ["imm", "bptt"], scenario=again, tracks=True)
        write_estimates(tmp_path / "estimates.csv", found)
        estimates = pandas.read_csv(tmp_path / "estimates.csv")
        # Times near 1.8e9 s are rounded to 2.4e-7 s.
        np.testing.assert_allclose(estimates["seconds"], np.tile(TIME[2:], 2), atol=1e-6)
        joined = estimates.merge(log, left_on="log_time", right_on="time")
        assert len(joined) == 2 * (COUNT - 2 - 6)
        np.testing.assert_array_equal(joined["truth_position_x_x"], joined["truth_position_x_y"])


# --- agents are shown deviations over the log's own


def scaled(tmp_path, factor, sigma=40.0):
    """The aircraft's log with all lengths so many times as large."""
    log = aircraft(sigma_x=np.full(COUNT, sigma), sigma_y=np.full(COUNT, sigma))
    return log * {name: 1.0 if name == "time" else factor for name in log}


def test_the_unit_of_length_of_a_log_is_nothing_to_an_agent_of_alpha_beta_filters(tmp_path):
    """To rounding of decimals and sixty updates. What knows accelerations in m/s^2, as kalman-net, is another."""
    errors = []
    for factor in (1.0, 1.0 / 32.0):
        recording = read(scaled(tmp_path, factor), tmp_path)
        assert recording.typical == {"range_sigma": 40.0 * factor}
        errors.append(evaluate(TARGET, ["bptt"], recording)["error"].values / factor)
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-6, atol=1e-6)


def test_a_deviation_that_is_named_wins_and_several_logs_take_their_median(tmp_path):
    for name, sigma in (("a", 40.0), ("b", 60.0)):
        scaled(tmp_path, 1.0, sigma).to_csv(tmp_path / f"{name}.csv", index=False)
    both = read_recording(tmp_path, TARGET)
    assert len(both.names) == 2
    assert both.typical == {"range_sigma": 50.0}
    task = task_class(TARGET)
    assert make_task(task, both).parameters.range_sigma == 50.0
    assert make_task(task, both, range_sigma=7.0).parameters.range_sigma == 7.0
    assert read_recording(tmp_path, TARGET, range_sigma=7.0).typical == {}
    both.write(tmp_path / "both.nc")
    assert read_recording(tmp_path / "both.nc").parameters["range_sigma"] == 50.0
    # Where no deviation is given, positions scatter: the log's noise is of 40 m.
    assert read(untold(sigma_x=None, sigma_y=None), tmp_path).typical == {
        "range_sigma": pytest.approx(40.0, rel=0.1)
    }


def test_positions_of_a_receiver_without_a_fix_are_no_measurements(tmp_path):
    """At latitude 0 and longitude 0, where they would lie 5,000 km off; the first row of them is named."""
    time = np.arange(40.0)
    table = {"time": time, "latitude": 51.5 + 1e-4 * time, "longitude": -0.1 + 1e-4 * time}
    pandas.DataFrame(table).to_csv(tmp_path / "all.csv", index=False)
    for name in ("latitude", "longitude"):
        table[name][[10, 30]] = 0.0
    pandas.DataFrame(table).to_csv(tmp_path / "zero.csv", index=False)
    whole, found = (read_recording(tmp_path / name, TARGET) for name in ("all.csv", "zero.csv"))
    assert any("2 positions at latitude 0, longitude 0, the first in row 10" in note for note in found.notes)
    available = found.measurements["available"][0]
    np.testing.assert_array_equal(np.flatnonzero(available == 0.0), [8, 28])  # the track starts with row 1
    there = available > 0.0
    np.testing.assert_array_equal(
        found.measurements["position"][0, there], whole.measurements["position"][0, there]
    )


def test_a_column_that_is_not_understood_can_be_ignored(tmp_path):
    table = {"time": np.arange(9.0), "x": np.arange(9.0), "y": np.zeros(9)}
    pandas.DataFrame({**table, "accuracy": 3.0}).to_csv(tmp_path / "log.csv", index=False)
    pandas.DataFrame(table).to_csv(tmp_path / "plain.csv", index=False)
    with pytest.raises(
        ValueError, match=r"the column accuracy, which is not read: .* by --rename 'accuracy=-'"
    ):
        read_recording(tmp_path / "log.csv", TARGET, speeds=(0.01, 1000.0))
    found = read_recording(tmp_path / "log.csv", TARGET, speeds=(0.01, 1000.0), rename={"Accuracy": "-"})
    plain = read_recording(tmp_path / "plain.csv", TARGET, speeds=(0.01, 1000.0))
    np.testing.assert_array_equal(found.measurements["position"], plain.measurements["position"])


@pytest.mark.parametrize(
    ("times", "hint"),
    [
        (
            [0.0, 1.0, 3.0, 2.0, 4.0],
            "time decreases from 3 in row 2 to 2 in row 3: --sort ",
        ),
        (
            [f"2026-03-14T09:12:0{second}.250Z" for second in (1, 3, 2, 4, 5)],
            r"from 2026-03-14T09:12:03\.250Z in row 1 to 2026-03-14T09:12:02\.250Z in row 2: --sort",
        ),
        ([4294967293, 4294967295, 1, 3, 5], "starts again: add 4294967296 to the times from row 2 on"),
        ([4294967.1, 4294967.2, 0.004, 0.1, 0.2], "starts again: add 4294967.296 to the times from row 2 on"),
    ],
)
def test_times_that_decrease_get_what_to_do(tmp_path, times, hint):
    table = {"time": times, "x": np.arange(5.0), "y": np.arange(5.0)}
    pandas.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ValueError, match=hint):
        read_recording(tmp_path / "log.csv", TARGET)


def assert_same_recording(found, other):
    np.testing.assert_array_equal(found.measurements["position"], other.measurements["position"])
    np.testing.assert_array_equal(found.truth, other.truth)
    np.testing.assert_array_equal(found.seconds, other.seconds)
    np.testing.assert_array_equal(found.log_time, other.log_time)
    assert found.names == other.names


@pytest.mark.parametrize("form", ["%Y-%m-%dT%H:%M:%SZ", None])
def test_rows_are_sorted_by_time_where_that_is_asked_for(tmp_path, form, command):
    """Within each recording, as if the file had been in order; what stood after later rows is counted."""
    times = [*TIME] if form is None else list(pandas.to_datetime(TIME, unit="s").strftime(form))
    both = pandas.concat([aircraft(time=times).assign(recording=name) for name in ("b", "a")])
    order = np.arange(2 * COUNT)
    order[[0, 1]], order[[20, 24]] = (1, 0), (24, 20)
    both.to_csv(tmp_path / "sorted.csv", index=False)
    both.iloc[order].to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ValueError, match="--sort"):
        read_recording(tmp_path / "log.csv", TARGET)
    found = read_recording(tmp_path / "log.csv", TARGET, sort=True)
    assert_same_recording(found, read_recording(tmp_path / "sorted.csv", TARGET))
    # Of the rows that changed places, the first of the one pair and all that the second pair encloses.
    assert "sorted by time: 5 of 120 rows stood after later ones" in found.notes
    assert not [n for n in read_recording(tmp_path / "sorted.csv", TARGET, sort=True).notes if "sorted" in n]
    words = ("evaluate", TARGET, "--recording", tmp_path / "log.csv", "--policy", "imm")
    code, shown, _ = command(*words, "--sort")
    assert (code, "sorted by time: 5 of 120 rows" in shown) == (0, True)
    assert command(*words)[0] == 2
    assert "--sort is for a recording" in command("evaluate", TARGET, "--policy", "imm", "--sort")[2]


def test_a_truth_is_sorted_with_its_log_and_a_counter_is_not(tmp_path):
    plots, rows = untold(), aircraft()
    plots.to_csv(tmp_path / "log.csv", index=False)
    true = rows[["time", "truth_position_x", "truth_position_y"]]
    true.to_csv(tmp_path / "truth.csv", index=False)
    true[::-1].to_csv(tmp_path / "back.csv", index=False)
    found = read_recording(tmp_path / "log.csv", TARGET, truth=tmp_path / "back.csv", sort=True)
    assert_same_recording(found, read_recording(tmp_path / "log.csv", TARGET, truth=tmp_path / "truth.csv"))
    assert "truth: sorted by time: 59 of 60 rows stood after later ones" in found.notes
    plots.assign(time=(TIME + 2.0**32 - 99.0) % 2.0**32).to_csv(tmp_path / "counter.csv", index=False)
    with pytest.raises(ValueError, match="a counter that starts again"):
        read_recording(tmp_path / "counter.csv", TARGET, sort=True)
