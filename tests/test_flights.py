"""Sets of recorded flights: reading, cleaning, what is refused, episodes, and intervals over flights."""

import datetime
import gzip
import importlib
import importlib.util
import json
import runpy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pymap3d
import pytest
import xarray
from gymnasium.vector import AutoresetMode
from models import make_model

from filtergym import Flights, Trajectory, evaluate, tidy_records
from filtergym.envs.logs import flight_tables
from filtergym.envs.logs.flight_cleaning import fit_parabolas
from filtergym.envs.logs.flights import read_flights
from filtergym.evaluation.running.metrics import flight_records
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.filters.geodesy import east_north

ID = "filtergym/ManeuveringTarget-v0"
DOCS = Path(__file__).parent.parent / "docs"
FIVE = np.arange(0.0, 200.0, 5.0)
"""Times of a flight, s."""


def weave(time, start=(2e4, 1e4), speed=120.0):
    return np.stack([start[0] + speed * time, start[1] + 500.0 * np.sin(time / 40.0)], axis=1)


def table(file, **columns):
    rows = zip(*columns.values(), strict=True)
    file.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return file


def flight_file(file, time=FIVE, **of_weave):
    x, y = weave(time, **of_weave).T
    return table(file, time=time, x=x, y=y)


def as_json(file, **columns):
    values = [np.array(column).tolist() for column in columns.values()]
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]
    text = json.dumps(rows).encode()
    file.write_bytes(gzip.compress(text) if file.suffix == ".gz" else text)


def three():
    """Flights of 33, 16 and 24 scans of 6 s."""
    return [
        Trajectory(time, weave(time, (2e4, 1e4 * i)), name=f"flight {i}")
        for i, time in enumerate((FIVE, FIVE[:21], FIVE[:30]))
    ]


# --- around the site


def test_local_tangent_plane_is_that_of_a_geodesy_library():
    rng = np.random.default_rng(0)
    site = (48.72, 2.38)
    degrees = np.array(site)[:, None] + rng.uniform(-4.0, 4.0, (2, 50))
    altitude = rng.uniform(-100.0, 12e3, 50)
    east, north, _ = pymap3d.geodetic2enu(*degrees, altitude, *site, 0.0)
    found = east_north(*np.radians(degrees), altitude, tuple(np.radians(site)))
    # Ten nanometres: a few roundings of Earth-fixed coordinates of 6400 km.
    np.testing.assert_allclose(found, [east, north], rtol=0, atol=1e-8)


# --- reading


def test_every_form_of_time_and_file_is_the_same_flight(tmp_path):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    start = datetime.datetime(2026, 5, 1, 12, tzinfo=datetime.UTC)
    dates = [start + datetime.timedelta(seconds=s) for s in FIVE]
    x, y = weave(FIVE).T
    nanoseconds = np.array([d.replace(tzinfo=None) for d in dates], dtype="datetime64[ns]")
    table(tmp_path / "iso.csv", time=[d.isoformat() for d in dates], x=x, y=y)
    table(tmp_path / "zulu.csv", Timestamp=[f"{d:%Y-%m-%dT%H:%M:%SZ}" for d in dates], X=x, Y=y)
    stamped = pyarrow.array(nanoseconds, pyarrow.timestamp("ns", tz="Europe/Paris"))
    for name, stamps in (("ns", nanoseconds), ("s", nanoseconds.astype("datetime64[s]")), ("zone", stamped)):
        parquet.write_table(pyarrow.table({"time": stamps, "x": x, "y": y}), tmp_path / f"{name}.parquet")
    data = {"x": ("time", x, {"units": "m"}), "y": ("time", y)}
    for name, stamps in (("dates", nanoseconds), ("seconds", FIVE)):
        xarray.Dataset(data, {"time": stamps}).to_netcdf(tmp_path / f"{name}.nc", engine="scipy")
    as_json(tmp_path / "rows.json", timestamp=(1000 * (1_700_000_000 + FIVE)).astype(int), x=x, y=y)
    by_columns = {"time": FIVE + 1.7e9, "x": x, "y": y}
    text = json.dumps({name: dict(enumerate(values.tolist())) for name, values in by_columns.items()})
    (tmp_path / "columns.json").write_text(text)
    found = read_flights(tmp_path)
    assert len(found.trajectories) == 9
    for trajectory in found.trajectories:
        np.testing.assert_allclose(trajectory.time - trajectory.time[0], FIVE, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(trajectory.position, weave(FIVE))


def geodetic(site=(48.0, 2.0)):
    """Latitude and longitude of a flight to the north, by the library; its position, m."""
    position = weave(FIVE)
    latitude, longitude, height = pymap3d.enu2geodetic(*position.T, np.full(len(FIVE), 3000.0), *site, 0.0)
    return position, latitude, longitude, height


def test_columns_of_opensky_and_traffic(tmp_path):
    position, latitude, longitude, height = geodetic()
    time = 1.7e9 + FIVE
    ones = np.ones(len(FIVE))
    table(
        tmp_path / "opensky.csv", time=time, icao24=["3c6444"] * len(FIVE), lat=latitude, lon=longitude,
        velocity=120.0 * ones, callsign=["DLH1  "] * len(FIVE), onground=["False"] * len(FIVE), baroaltitude=0.0 * ones,
        geoaltitude=height,
    )  # fmt: skip
    stamps = [f"{datetime.datetime.fromtimestamp(t, datetime.UTC)}" for t in time]
    table(
        tmp_path / "traffic.csv", timestamp=stamps, latitude=latitude, longitude=longitude, altitude=height / 0.3048,
        groundspeed=240.0 * ones,
    )  # fmt: skip
    for name in ("opensky", "traffic"):
        (found,) = read_flights(tmp_path / f"{name}.csv", site=(48.0, 2.0)).trajectories
        np.testing.assert_allclose(found.position, position, rtol=0, atol=1e-6)
        assert found.name == name


def test_flights_of_one_file_are_separated_and_stale_positions_go(tmp_path):
    _, latitude, longitude, _ = geodetic()
    latitude[7], longitude[7] = latitude[6], longitude[6]
    latitude[9] = np.nan
    height = 3000.0 + 10.0 * FIVE
    aircraft = ["a", "b"] * (len(FIVE) // 2)
    file = table(tmp_path / "two.csv", time=FIVE, latitude=latitude, longitude=longitude, icao24=aircraft)
    found = read_flights(file, site=(48.0, 2.0))
    assert [t.name for t in found.trajectories] == ["two:a", "two:b"]
    np.testing.assert_array_equal(found.trajectories[0].time, FIVE[::2])
    assert found.sources[0].notes == ("2 flights", "1 row without position")
    alone = table(tmp_path / "one.csv", time=FIVE, latitude=latitude, longitude=longitude, altitude=height)
    found = read_flights(alone, site=(48.0, 2.0))
    assert found.sources[0].notes == ("1 row without position", "1 repeated position")
    np.testing.assert_array_equal(found.trajectories[0].time, np.delete(FIVE, [7, 9]))


def test_rows_of_named_flights_need_no_order_and_those_on_the_ground_are_not_flown(tmp_path):
    _, latitude, longitude, _ = geodetic()
    mixed = np.random.default_rng(0).permutation(len(FIVE))
    columns = {"time": FIVE, "lat": latitude, "lon": longitude}
    columns |= {"icao24": np.repeat("a", len(FIVE)), "onground": np.where(FIVE < 20.0, "True", "False")}
    file = table(tmp_path / "one.csv", **{name: values[mixed] for name, values in columns.items()})
    found = read_flights(file, site=(48.0, 2.0))
    assert found.sources[0].notes == ("4 rows on the ground",)
    np.testing.assert_array_equal(found.trajectories[0].time, FIVE[4:])


def test_samples_of_a_package_that_is_not_imported(tmp_path, monkeypatch):
    with monkeypatch.context() as absent:
        absent.setattr(importlib.util, "find_spec", lambda name: None)  # whether or not it is installed here
        with pytest.raises(ValueError, match=r"is not installed; .* pip install --no-deps"):
            make_model(ID, scenario="traffic:quickstart")
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "traffic" / "data" / "samples" / "collections"
    folder.mkdir(parents=True)
    (tmp_path / "traffic" / "__init__.py").write_text("raise ImportError('of a long chain of libraries')")
    _, latitude, longitude, height = geodetic()
    columns = {"timestamp": (1000 * (1_700_000_000 + FIVE)).astype(int), "latitude": latitude}
    columns |= {"longitude": longitude, "altitude": height / 0.3048, "groundspeed": 240.0 + 0.0 * FIVE}
    as_json(folder / "quickstart.json.gz", **columns)
    importlib.invalidate_caches()
    found = read_flights("traffic:quickstart")
    site = (round(float(np.median(latitude)), 2), round(float(np.median(longitude)), 2))
    assert found.sources[0].notes == (f"radar at {site[0]:.2f}, {site[1]:.2f}",)
    expected = np.stack(pymap3d.geodetic2enu(latitude, longitude, height, *site, 0.0)[:2], axis=1)
    np.testing.assert_allclose(found.trajectories[0].position, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.diff(found.trajectories[0].time), 5.0, rtol=1e-9)
    with pytest.raises(ValueError, match="has no sample 'quikstart': did you mean quickstart"):
        read_flights("traffic:quikstart")


def test_rows_that_lack_a_velocity_are_taken_out(tmp_path):
    x, y = weave(FIVE).T
    vx, vy = np.gradient(weave(FIVE), FIVE, axis=0).T
    vx[3] = np.nan
    (found,) = read_flights(table(tmp_path / "v.csv", time=FIVE, x=x, y=y, vx=vx, vy=vy)).trajectories
    np.testing.assert_array_equal(found.velocity, np.delete(np.stack([vx, vy], axis=1), 3, axis=0))


def test_what_lies_beyond_the_reach_is_taken_out(tmp_path):
    _, latitude, longitude, _ = geodetic()
    latitude[30:] += 6.0  # degrees: 670 km
    file = table(tmp_path / "far.csv", time=FIVE, latitude=latitude, longitude=longitude)
    found = read_flights(file, site=(48.0, 2.0))
    assert found.sources[0].notes == ("10 rows beyond 500 km",)
    assert len(found.trajectories[0].time) == 30


# --- cutting


def test_gaps_jumps_and_outliers_by_hand(tmp_path):
    time = np.concatenate([np.arange(0.0, 100.0, 5.0), [300.0, 305.0, 400.0], np.arange(470.0, 570.0, 5.0)])
    position = weave(time)
    position[4] += 8e4  # there and back: one position
    position[30:] += 5e4  # there to stay: a jump
    file = table(tmp_path / "ory_07.csv", time=time, x=position[:, 0], y=position[:, 1])
    found = read_flights(file)
    assert found.sources[0].notes == ("1 outlier over 1000 m/s", "3 gaps over 60 s", "1 jump over 1000 m/s")
    times = [t.time for t in found.trajectories]
    # 400 s stands alone: no piece.
    kept = [np.delete(time[:20], 4), time[20:22], time[23:30], time[30:]]
    for own, expected in zip(times, kept, strict=True):
        np.testing.assert_array_equal(own, expected)
    assert [t.name for t in found.trajectories] == [f"ory_07 {i}/4" for i in (1, 2, 3, 4)]
    assert {t.flight for t in found.trajectories} == {"ory_07"}


def test_smoothing_is_a_parabola_around_each_position(tmp_path):
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.5, 2.0, 60))
    parabola = np.stack([1e4 + 90.0 * time + 0.8 * time**2, 2e4 - 70.0 * time], axis=1)
    noisy = parabola + rng.normal(0.0, 30.0, parabola.shape)
    position, velocity = fit_parabolas(time, noisy, 7.0)
    for i in (0, 1, 30, 59):
        near = np.abs(time - time[i]) <= 7.0
        naive = np.polynomial.polynomial.polyfit(time[near] - time[i], noisy[near], 2)
        np.testing.assert_allclose(position[i], naive[0], rtol=1e-9)
        np.testing.assert_allclose(velocity[i], naive[1], rtol=1e-6, atol=1e-6)
    few = fit_parabolas(time[::10], parabola[::10], 1.0)[0]  # of neighbours that are farther away
    np.testing.assert_allclose(few, parabola[::10], rtol=0, atol=1e-6)
    (found,) = read_flights(flight_file(tmp_path / "a.csv"), smoothing=20.0).trajectories
    np.testing.assert_array_equal(found.velocity, fit_parabolas(FIVE, weave(FIVE), 20.0)[1])


def test_the_line_about_a_file(tmp_path):
    time = np.concatenate(
        [np.arange(0.0, 100.0, 5.0), np.arange(200.0, 230.0, 5.0), np.arange(400.0, 500.0, 5.0)]
    )
    flight_file(tmp_path / "ory_07.csv", time)
    flight_file(tmp_path / "plain.csv")
    used, lines = read_flights(tmp_path).flyable(6.0, 5e5)
    assert lines == ["ory_07.csv: 2 gaps over 60 s, 3 pieces, 1 dropped (shorter than 10 scans of 6 s)"]
    assert [t.name for t in used] == ["ory_07 1/3", "ory_07 3/3", "plain"]
    assert read_flights(tmp_path, longest_gap=180.0).flyable(6.0, 5e5)[1] == []


# --- twenty wrong files, one sentence each

ONE = {"time": FIVE, "x": weave(FIVE)[:, 0], "y": weave(FIVE)[:, 1]}
DEGREES = {"time": FIVE, "latitude": 48.0 + FIVE * 1e-3, "longitude": 2.0 + 0.0 * FIVE}
V = np.gradient(weave(FIVE), FIVE, axis=0).T
STANDING = {"x": np.full(len(FIVE), 9e3), "y": np.full(len(FIVE), 9e3)}
SWAPPED = {"time": FIVE, "x": DEGREES["longitude"], "y": DEGREES["latitude"]}
LOST = [*ONE["y"][:3], "lost", *ONE["y"][4:]]
WRONG = [
    (ONE | {"x": ONE["x"] / 1e3, "y": ONE["y"] / 1e3}, "median speed 0.12 m/s: are x, y kilometres"),
    (SWAPPED, "are x, y degrees. then call them longitude and latitude"),
    (ONE | {"time": 1e3 * FIVE}, "are the times milliseconds"),
    (ONE | {"time": FIVE / 60.0}, "median speed 7218 m/s: are the times minutes"),
    (ONE | {"time": FIVE / 3600.0}, "are the times hours"),
    (ONE | {"vx": 1.944 * V[0], "vy": 1.944 * V[1]}, "vx, vy are 1.94 times .* are they knots"),
    (ONE | {"vx": 3.6 * V[0], "vy": 3.6 * V[1]}, "are they km/h"),
    (ONE | STANDING, "median speed 0 m/s: does it move at all"),
    (ONE | {"time": FIVE[::-1]}, "times must increase, but row 1 has 190 s after 195 s"),
    (ONE | {"time": np.repeat(FIVE[::2], 2)}, "times must increase, but row 1 has 0 s after 0 s"),
    (ONE | {"x": [""] * len(FIVE)}, "at least two positions, got 0"),
    (ONE | {"x": [*ONE["x"][:-1], "inf"]}, "x has a value that is not finite in row 39"),
    (ONE | {"time": ["", *FIVE[1:]]}, "time has a value that is not finite in row 0"),
    (ONE | {"y": LOST}, "y has 'lost' in row 3, which is no number"),
    (ONE | {"time": ["1 May", *FIVE[1:]]}, "time has '1 May' in row 0, .* neither seconds nor a date"),
    ({n: v[:1] for n, v in ONE.items()}, "at least two positions, got 1"),
    ({"time": FIVE, "speed": FIVE}, "lacks the column x, y; it has time, speed and needs time, x, y"),
    ({"time": FIVE, "lat": FIVE}, "lacks the column longitude"),
    (DEGREES, "give the radar's, --site LATITUDE,LONGITUDE"),
    (DEGREES | {"latitude": 1e3 * FIVE}, "latitude reaches 195000, and degrees .*: is it metres"),
    (ONE | {"time": 20.0 * FIVE}, "positions are 100 s apart, longer than the longest gap of 60 s"),
    (ONE | {"x": 1e9 * FIVE}, "median speed 1e.09 m/s: .* allow higher speeds"),
    ({n: v[:10] for n, v in ONE.items()}, "1 piece, 1 dropped .shorter than 10 scans of 6 s."),
    (ONE | {"x": ONE["x"] + 9e5}, "goes 943 km from the radar, whose range ends at 500 km"),
]


@pytest.mark.parametrize(("columns", "message"), WRONG, ids=[message for _, message in WRONG])
def test_a_wrong_file_is_refused_in_one_sentence(columns, message, tmp_path):
    file = table(tmp_path / "wrong.csv", **columns)
    with pytest.raises(ValueError, match=message) as caught:
        make_model(ID, scenario=file)
    assert "wrong.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("binary.csv", bytes(range(256)), "it is no text in UTF-8"),
        ("binary.nc", bytes(range(256)), "cannot read trajectory .*binary.nc"),
        ("empty.csv", b"", "lacks the column time, x, y"),
        ("twice.csv", b"time,x,x,y\n0,1,2,3\n6,2,3,4\n", "it has the column x more than once"),
        ("ragged.csv", b"time,x,y\n0,1,2\n6,2\n", "3 column names but 2 columns in row 1"),
        ("words.txt", b"time,x,y\n", "files of flights end in .csv, .nc, .parquet, .json, .json.gz"),
        ("number.json", b"3", "JSON of flights is a list of rows"),
        ("cut.json.gz", gzip.compress(b"[{}]", mtime=0)[:-9], "cannot read trajectory .*cut.json.gz"),
    ],
)
def test_what_is_no_table_is_refused(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_flights(tmp_path / name)


def test_a_unit_that_a_file_names_itself_is_believed(tmp_path):
    x, y = weave(FIVE).T
    data = xarray.Dataset({"x": ("time", x / 1e3, {"units": "km"}), "y": ("time", y)}, {"time": FIVE})
    data.to_netcdf(tmp_path / "km.nc", engine="scipy")
    with pytest.raises(ValueError, match="x is in 'km', and 'm' is expected"):
        read_flights(tmp_path / "km.nc")


def test_millions_of_rows_are_refused_before_they_are_read(tmp_path, monkeypatch):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(flight_tables, "MOST_ROWS", 30)
    flight_file(tmp_path / "a.csv")
    as_json(tmp_path / "a.json", **ONE)
    as_json(tmp_path / "a.json.gz", **ONE)
    parquet.write_table(pyarrow.table(ONE), tmp_path / "a.parquet")
    data = {name: ("time", values) for name, values in ONE.items()}
    xarray.Dataset(data).to_netcdf(tmp_path / "a.nc", engine="scipy")
    for suffix in (".csv", ".nc", ".parquet", ".json", ".json.gz"):
        with pytest.raises(ValueError, match="it has more than 30 rows"):
            read_flights(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"longest_gap": 0.0}, "longest_gap must be a finite number above 0"),
        ({"speeds": (5.0, 1.0)}, "speeds must be in ascending order"),
        ({"fewest_scans": 1}, "fewest_scans must be an integer of at least 2"),
        ({"site": (100.0, 0.0)}, "site is a latitude and a longitude in degrees"),
        ({"site": 48.0}, "site must be 2 numbers"),
    ],
)
def test_wrong_limits_are_refused(keywords, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_flights(flight_file(tmp_path / "a.csv"), **keywords)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nothing/*.csv", "no file matches 'nothing/"),
        (["random.csv", "paper"], "a mixture of scenarios is a dictionary of weights"),
        (["sheet"], "cannot read trajectory sheet: files of flights end in"),
        ([3], "a set of flights holds files and trajectories, got 3"),
        ([{"time": [0, 1]}], "a trajectory as a dictionary has time"),
        ({"trajectories": "mine"}, "are a list of dictionaries, got 'mine'"),
        ({"trajectories": [], "site": 1}, "optionally name and fewest_scans, got 'trajectories', 'site'"),
        ({"trajectories": []}, "at least one trajectory"),
    ],
)
def test_what_is_no_set_is_refused(source, message):
    with pytest.raises(ValueError, match=message):
        make_model(ID, scenario=source)


def test_environments_without_flights_say_so(tmp_path):
    flight_file(tmp_path / "a.csv")
    with pytest.raises(ValueError, match="RadarEsmTracking-v0 does not take flights as scenario"):
        make_model("RadarEsmTracking", scenario=tmp_path)


def test_broken_files_are_left_out_and_named_and_a_set_of_them_is_refused(tmp_path):
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    flight_file(tmp_path / "minutes.csv", FIVE / 60.0, speed=7200.0)
    with pytest.raises(ValueError, match=r"nothing of .* can be flown: binary.csv: it is no text.*; minutes"):
        read_flights(tmp_path)
    flight_file(tmp_path / "whole.csv")
    used, lines = read_flights(str(tmp_path / "*.csv")).flyable(6.0, 5e5)
    assert [t.name for t in used] == ["whole"]
    assert lines == [
        "binary.csv: left out: it is no text in UTF-8: save it as such (a spreadsheet: CSV UTF-8)",
        "minutes.csv: left out: median speed 7200 m/s: are the times minutes?",
    ]


# --- episodes


def test_the_table_of_flights_is_every_flight_on_its_own():
    model = make_model(ID, scenario=three())
    alone = [make_model(ID, scenario=flight) for flight in three()]
    assert model.task.flights == tuple(one.task.horizon for one in alone) == (32, 16, 24)
    assert model.task.horizon == 32
    drawn = np.array([[0.0, 0.34, 0.67, 0.999, 0.33, 0.66, 0.5, 0.1]])
    np.testing.assert_array_equal(model.task.lengths(drawn), [32, 16, 24, 24, 32, 16, 16, 32])
    nothing = np.zeros((4, 8))
    episode = model.begin(drawn, nothing)
    singles = [one.begin(np.empty((0, 8)), nothing) for one in alone]
    for _ in range(16):
        for lane, flight in enumerate(model.task.flight_of(drawn)):
            np.testing.assert_array_equal(
                model.task.world.state(episode.truth)[:, lane],
                model.task.world.state(singles[flight].truth)[:, 0],
            )
        noise = np.zeros((2, 8))
        episode = model.measure(episode, noise)
        singles = [one.measure(single, noise) for one, single in zip(alone, singles, strict=True)]
    np.testing.assert_array_equal(model.context(episode)["flight"], [0, 1, 2, 2, 0, 1, 1, 0])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_vector_and_single_environments_agree_and_end_with_their_flight(mode):
    keywords = {"scenario": three(), "control": "gain"}
    vector = gym.make_vec(ID, num_envs=4, autoreset_mode=mode, **keywords)
    singles = [gym.make(ID, **keywords) for _ in range(4)]
    shown = vector.reset(seed=5)[0]
    own = np.stack([env.reset(seed=5 + i)[0] for i, env in enumerate(singles)])
    np.testing.assert_array_equal(shown, own)
    waiting, taken, lengths = np.zeros(4, dtype=bool), np.zeros(4, dtype=int), set()
    rng = np.random.default_rng(0)
    for _ in range(80):
        action = rng.uniform(-1.0, 1.0, (4, 1))
        shown, _, _, truncated, _ = vector.step(action)
        for i, env in enumerate(singles):
            ended = False
            if waiting[i]:
                own[i], waiting[i], taken[i] = env.reset()[0], False, 0
            else:
                own[i], _, _, ended, _ = env.step(action[i])
                taken[i] += 1
            assert ended == truncated[i]
            if ended:
                lengths.add(int(taken[i]))
                waiting[i] = mode is AutoresetMode.NEXT_STEP
                if not waiting[i]:
                    own[i], taken[i] = env.reset()[0], 0
        np.testing.assert_array_equal(shown, own)
    assert lengths == {32, 16, 24}


def test_an_evaluation_flies_every_flight_as_often_to_its_end():
    dataset = evaluate(ID, ["imm", "known-turn", "known-input-bound"], three(), episodes=7)
    names, counts = np.unique(dataset["flight"].values, return_counts=True)
    assert names.tolist() == ["flight 0", "flight 1", "flight 2"]
    assert counts.tolist() == [3, 3, 3]
    lengths = dict(zip(names.tolist(), (32, 16, 24), strict=True))
    for i, flight in enumerate(dataset["flight"].values.tolist()):
        last = lengths[flight]
        assert dataset["length"].values[i] == last
        np.testing.assert_array_equal(np.isfinite(dataset["cost"].values[:2, i]), [np.arange(32) < last] * 2)


def test_records_by_hand():
    dataset = evaluate(ID, ["imm", "adaptive"], three(), episodes=6)
    per_episode = np.nanmean(dataset["cost"].values, axis=-1)
    found = {(r.policy, r.metric, r.component): r for r in tidy_records(dataset)}
    assert found["imm", "cost", ""].value == pytest.approx(per_episode[0].mean(), rel=1e-12)
    squares = np.nansum(dataset["error"].values[0, ..., :2] ** 2, axis=-1)
    there = ~np.isnan(dataset["error"].values[0, ..., 0])
    peak = np.sqrt((squares.sum(axis=0) / there.sum(axis=0)).max())
    assert found["imm", "peak_rmse", "position"].value == pytest.approx(peak, rel=1e-12)
    flown = {(r.scenario, r.policy, r.metric, r.component): r for r in flight_records(dataset)}
    for flight in ("flight 0", "flight 1", "flight 2"):
        record = flown[f"3 flights: {flight}", "imm", "cost", ""]
        assert record.episodes == 2
        mine = per_episode[0, dataset["flight"].values == flight]
        assert record.value == pytest.approx(mine.mean(), rel=1e-12)
    assert dataset.attrs["scenario"] == "3 flights"


def test_flights_of_the_same_name_are_not_pieces_of_one():
    one, two, three_ = (Trajectory(FIVE, weave(FIVE, (2e4, 5e3 * i))) for i in range(3))
    assert set(evaluate(ID, ["zero"], [one, two, three_], 3)["flight"].values) == {
        f"trajectory {i}" for i in (1, 2, 3)
    }


def test_a_horizon_ends_every_flight_and_decisions_that_hold_fit():
    assert make_model(ID, scenario=three(), horizon=20).task.flights == (20, 16, 20)
    assert make_model(ID, scenario=three(), horizon=50).task.flights == (32, 16, 24)
    assert make_model(ID, scenario=three(), decision_interval=5, horizon=30).task.flights == (30, 15, 20)
    assert make_model(ID, scenario=three(), sampling_interval=4.0).task.flights == (48, 25, 36)


def test_too_many_scans_are_refused(monkeypatch):
    monkeypatch.setattr("filtergym.envs.maneuvering_target.flights.MOST_SCANS", 71)
    with pytest.raises(ValueError, match="have 72 scans of 6 s together, more than 71: fly fewer"):
        make_model(ID, scenario=three())


def test_a_set_survives_json_and_a_reset_names_one(tmp_path):
    given = Flights(tuple(three()), "mine", 12)
    env = gym.make(ID, scenario=given)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert env.spec.max_episode_steps == again.spec.max_episode_steps == 32
    for seed in range(4):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], again.reset(seed=seed)[0])
    other = gym.make(ID)
    other.reset(seed=0)
    np.testing.assert_array_equal(other.reset(seed=3, options={"scenario": given})[0], env.reset(seed=3)[0])


# --- intervals


def test_whole_clusters_are_resampled():
    values = np.array([1.0, 4.0, -2.0, 7.0, 5.0])
    plain = Bootstrap(5).estimate(values)
    # Three episodes each that say the same are no more than one.
    thrice = Bootstrap(15, clusters=np.repeat(list("abcde"), 3)).estimate(np.repeat(values, 3))
    np.testing.assert_allclose(thrice, plain, rtol=1e-12)
    unequal = Bootstrap(3, clusters=["a", "a", "b"])
    # Both, a twice, or b twice: nothing else can be drawn.
    found = {tuple(np.round(row, 12)) for row in unequal.weights}
    assert found == {(round(1 / 3, 12),) * 3, (0.5, 0.5, 0.0), (0.0, 0.0, 1.0)}
    one = Bootstrap(5, clusters=["a"] * 5).estimate(values)
    assert one == plain


def test_means_are_of_what_is_there_where_flights_end():
    values = np.array([[1.0, 2.0], [3.0, np.nan]])
    means = Bootstrap(2, clusters=["a", "b"]).means(values)
    np.testing.assert_array_equal(means[0], [2.0, 2.0])
    only_b = np.flatnonzero(means[1:, 0] == 3.0) + 1
    assert np.isnan(means[only_b, 1]).all()
    assert only_b.size > 100
    # Elsewhere a value that is missing is an error that must be seen.
    assert np.isnan(Bootstrap(2).means(values)[0, 1])


# --- the command


def test_one_command_on_a_folder_with_two_broken_files(tmp_path, success):
    runpy.run_path(str(DOCS / "examples" / "flights.py"))["write_flights"](tmp_path)
    words = ["evaluate", ID, "--scenario", tmp_path / "*.csv", "--policy", "imm", "--policy", "adaptive"]
    out = success(*words, "--episodes", 19, "--json", tmp_path / "all.json")
    page = (DOCS / "own_data.md").read_text(encoding="utf-8")
    assert out[out.index("ory_07.csv:") :] in page
    left_out = (11, 15)
    assert "18 flights" in out
    assert all((f"ory_{i:02} " in out) is (i not in left_out) for i in range(20))
    scenarios = {record["scenario"] for record in json.loads((tmp_path / "all.json").read_text())}
    assert len(scenarios) == 19


def test_an_aircraft_that_has_landed_flies_another_flight(tmp_path):
    # Gaps of two minutes, and of an hour.
    time = np.concatenate([FIVE, 320.0 + FIVE, 4100.0 + FIVE])
    found = read_flights(flight_file(tmp_path / "day.csv", time)).trajectories
    assert [piece.name for piece in found] == ["day 1/3", "day 2/3", "day 3/3"]
    assert [piece.flight for piece in found] == ["day flight 1", "day flight 1", "day flight 2"]
