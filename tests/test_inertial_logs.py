"""Recordings from a raw IMU and fixes: a drive whose IMU and positions are known, and logs that cannot be."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from circular_drive import HEIGHT, LATITUDE, LONGITUDE, RATE, CircularDrive

from filtergym import evaluate, read_recording
from filtergym.envs.data.recording import Recording
from filtergym.envs.logs import strapdown
from filtergym.envs.loosely_coupled_navigation.inertial import (
    ACCELERATIONS,
    RATES,
    geodetic_of_local,
    inertial_recording,
    interpolate,
    paired_measurements,
    regular_times,
)
from filtergym.filters import geodesy

RATE_BIAS, FORCE_BIAS = (0.004, -0.003, 0.002), (0.05, -0.03, 0.04)
"""Of the simulated IMU, rad/s and m/s^2: left alone they make 50 m of 20 s."""
SIGMA, SECONDS = 1.0, 37.0
WINDOWS = {"settling": 15.0, "window": 10.0}
SITE = (np.degrees(LATITUDE), np.degrees(LONGITUDE), HEIGHT)


class Drive(CircularDrive):
    """Of which a whole circle takes 21 s."""

    turn = 0.3


def log_tables(seconds=SECONDS):
    """Tables of the IMU, degrees/s and m/s^2, of the fixes every 0.5 s, and of the truth."""
    drive = Drive(seconds)
    rates, forces = drive.inertial()
    imu = pd.DataFrame(np.degrees(rates + RATE_BIAS), columns=RATES)
    imu[[*ACCELERATIONS]] = forces + FORCE_BIAS
    imu.insert(0, "time", drive.time)
    some = slice(None, None, round(0.5 * RATE))
    positions = np.array(drive.position())[:, some]
    generator = np.random.default_rng(0)
    noise = SIGMA * generator.standard_normal(positions.shape)
    truth = pd.DataFrame(positions.T, columns=["latitude", "longitude", "height"])
    truth.insert(0, "time", drive.time[some])
    degree = np.radians(1.0) * geodesy.SEMI_MAJOR_AXIS
    fixes = truth.assign(
        latitude=truth["latitude"] + noise[0] / degree,
        longitude=truth["longitude"] + noise[1] / degree / np.cos(LATITUDE),
        height=truth["height"] + noise[2],
        sigma=SIGMA,
    )
    velocity = drive.velocity[some] + 0.05 * generator.standard_normal((len(fixes), 3))
    fixes["velocity_north"], fixes["velocity_east"], fixes["velocity_up"] = velocity.T
    return imu, fixes, truth


def write_log(folder=Path()):
    """Write the tables as files; what tests/check_extras.py runs."""
    for name, table in zip(("imu", "fixes", "truth"), log_tables(), strict=True):
        table.to_csv(folder / f"{name}.csv", index=False)


@pytest.fixture
def pyins():
    return pytest.importorskip("pyins", reason="not installed: pip install 'filtergym[ins]'")


@pytest.fixture
def log():
    return log_tables()


def test_free_ins_stays_near_the_truth(pyins, tmp_path):
    """Files give windows in which the INS begins at the truth and is off by less than its biases alone would make."""
    write_log(tmp_path)
    imu, fixes, truth = (tmp_path / f"{name}.csv" for name in ("imu", "fixes", "truth"))
    recorded = inertial_recording(imu, fixes, truth, **WINDOWS)
    assert recorded.names == ("24.5 s",)
    assert recorded.parameters == {"axes": 2, "sampling_interval": 0.5}
    assert recorded.typical == {"receiver_intensity": 0.5}
    # 50 m of 20 s are 12 m of 10 s.
    assert abs(recorded.measurements["ins"] - recorded.truth).max() < 4.0
    assert abs(recorded.measurements["ins"] - recorded.truth)[:, 0].max() < 0.1
    stated = recorded.measurements["reported_deviation"][..., None]
    noise = (recorded.measurements["fix"] - recorded.truth) / stated
    assert noise.std() == pytest.approx(1.0, abs=0.3)  # three deviations of 42 numbers
    path = Drive(SECONDS)
    known = np.stack([path.east, path.north], axis=1)[:: round(0.5 * RATE)][49:71]
    moved = recorded.truth[0] - recorded.initial["mean"][0]
    np.testing.assert_allclose(moved, known[1:] - known[0], atol=0.02)
    recorded.write(tmp_path / "drive.nc")
    read = read_recording(tmp_path / "drive.nc")
    found = evaluate(read.environment, ["augmented", "gnss-only"], scenario=read)
    assert np.isfinite(found["error"].values).all()


def test_alignment_finds_attitude_and_bias(pyins):
    """A vehicle that heads north on a slope of nose up 2 and right side down 1 degree, with biased gyroscopes."""
    from scipy.spatial.transform import Rotation

    drive = CircularDrive(20.0)
    rates, forces = drive.inertial()
    tilt = Rotation.from_euler("xyz", [1.0, 2.0, 0.0], degrees=True).inv()
    inertial = pd.DataFrame(
        np.hstack([tilt.apply(rates) + RATE_BIAS, tilt.apply(forces)]),
        drive.time,
        [*(f"gyro_{axis}" for axis in "xyz"), *(f"accel_{axis}" for axis in "xyz")],
    )
    north, east, down = drive.velocity.T
    fixes = pd.DataFrame(np.array([*drive.position(), north, east, down]).T, drive.time)
    fixes.columns = ["lat", "lon", "alt", "VN", "VE", "VD"]
    found = strapdown.align(inertial, fixes.iloc[::10])
    assert found.start["roll"] == pytest.approx(1.0, abs=0.01)
    assert found.start["pitch"] == pytest.approx(2.0, abs=0.01)
    assert found.start["heading"] == pytest.approx(0.0, abs=0.1)
    # The same where the first course is 34 degrees, 3 s into the circle; a sample of the rates is 0.3 degrees.
    late = strapdown.align(inertial, fixes[(fixes.index < 10.5) | (fixes.index > 18.0)])
    assert late.start["heading"] == pytest.approx(0.0, abs=0.6)
    # What is left of the rates before the motion is the rotation of the Earth, 15 degrees an hour.
    still = found.increments[found.increments.index < drive.standstill]
    left = (still[["theta_x", "theta_y", "theta_z"]].sum() / still["dt"].sum()).to_numpy()
    assert np.linalg.norm(left) == pytest.approx(geodesy.EARTH_RATE, rel=0.01)


BACKWARD = "rate_x", "rate_y", "acceleration_x", "acceleration_y"


def changed(table, columns, change):
    columns = [*columns]
    return table.assign(**{name: change(table[name]) for name in columns})


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda t: changed(t, ACCELERATIONS, lambda a: a / 9.80665), "at rest is 0.995 m/s.2 .* units of g"),
        (lambda t: changed(t, ["acceleration_z"], lambda a: a + 9.8), "gravity was taken out"),
        (lambda t: changed(t, RATES, lambda a: 180.0 / np.pi * a), "mean rate at rest is 13.* check the unit"),
        (lambda t: changed(t, RATES, np.radians), "a turn of 1 the fixes have one of .*: check the unit of the rates"),
        (lambda t: changed(t, ["acceleration_y", "acceleration_z"], lambda a: -a), r"mounting, \(180, 0, 0\)"),
        (lambda t: changed(t, ["rate_z"], lambda a: -a), "a turn of 1 the fixes have one of -1"),
        (lambda t: changed(t, BACKWARD, lambda a: -a), "a change of speed of 1 the fixes have one of -0.99"),
        (lambda t: changed(t, ["time"], lambda a: a + 1e5), "they need one clock"),
        (lambda t: changed(t, ["time"], lambda a: 1e3 * a), "25 s apart .* milliseconds"),
        (lambda t: changed(t, ["time"], lambda a: a[::-1].to_numpy()), "times of the .* IMU must increase"),
        (lambda t: t[(t["time"] < 20.0) | (t["time"] > 21.0)], "gap of 1.05 s after row 799"),
        (lambda t: t[t["time"] > 7.0], "standstill of 5 s at the beginning"),
        (lambda t: t[t["time"] < 8.0], "no samples between the standstill and the last fix"),
        (lambda t: t.drop(columns="rate_x"), "lack the column rate_x"),
        (lambda t: changed(t, ["rate_x"], lambda a: a.where(a.index != 7)), "row 7 of the IMU has a cell without"),
    ],
)  # fmt: skip
def test_impossible_imu_values_are_refused(pyins, log, change, sentence):
    imu, fixes, _ = log
    with pytest.raises(ValueError, match=sentence):
        inertial_recording(change(imu), fixes, **WINDOWS)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda t: t[t["time"] < 9.0], "no speed is above 2 m/s"),
        (lambda t: t.drop(columns="sigma"), "every fix needs a standard deviation"),
        (lambda t: t.drop(columns="height"), "lack the column height"),
        (lambda t: t.rename(columns={"latitude": "y", "longitude": "x", "height": "z"}), "give the site"),
        (lambda t: changed(t, ["latitude"], lambda a: 1e7 * a), "must be degrees"),
        (
            lambda t: t.assign(time=pd.date_range("2026-05-01", periods=len(t), freq="500ms")),
            "use the same form in both",
        ),
    ],
)
def test_impossible_receiver_values_are_refused(pyins, log, change, sentence):
    imu, fixes, _ = log
    with pytest.raises(ValueError, match=sentence):
        inertial_recording(imu, change(fixes), **WINDOWS)


def test_units_and_mounting_are_converted(pyins, log, monkeypatch):
    """The same log in rad/s and g of an IMU with x forward, y left, z up aligns as in degrees/s and m/s^2."""
    imu, fixes, _ = log
    starts = []

    def stop(alignment, *_):
        starts.append(alignment.start)
        raise ValueError("stop")

    monkeypatch.setattr("filtergym.envs.loosely_coupled_navigation.inertial.aid", stop)
    other = changed(changed(imu, RATES, np.radians), ACCELERATIONS, lambda a: a / 9.80665)
    other = changed(other, ["rate_y", "rate_z", "acceleration_y", "acceleration_z"], lambda a: -a)
    turned = {"rate_unit": "rad/s", "acceleration_unit": "g", "mounting": (180.0, 0.0, 0.0)}
    for table, keywords in ((imu, {}), (other, turned)):
        with pytest.raises(ValueError, match="stop"):
            inertial_recording(table, fixes, **keywords, **WINDOWS)
    np.testing.assert_allclose(starts[1], starts[0], atol=1e-9)
    with pytest.raises(ValueError, match="the unit must be degrees/s or rad/s, got 'rpm'"):
        inertial_recording(imu, fixes, rate_unit="rpm")


def test_missing_fixes_leave_gaps():
    times, rows = regular_times(np.array([0.0, 0.5, 1.01, 2.5, 3.0, 3.5]), 3.2)
    assert rows.tolist() == [0, 1, 2, -1, -1, 3, 4]
    np.testing.assert_allclose(times, [0.0, 0.5, 1.01, 1.5067, 2.0033, 2.5, 3.0], atol=1e-4)
    with pytest.raises(ValueError, match=r"fixes come every 0.5 s, but two are 0.7 s apart after row 1"):
        regular_times(np.array([0.0, 0.5, 1.2, 1.7, 2.2]), 9.0)


def test_a_measurement_without_a_fix_is_not_available():
    ins, fixes = np.arange(8.0).reshape(1, 4, 2) ** 2, np.array([[1.0, 2.0], [3.0, 4.0]])
    found = paired_measurements(ins, fixes, np.array([0.5, 1.5]), np.array([[1, -1, 0]]))
    assert found["available"].tolist() == [[1.0, 0.0, 1.0]]
    assert found["fix"].tolist() == [[[3.0, 4.0], [0.0, 0.0], [1.0, 2.0]]]
    assert found["reported_deviation"].tolist() == [[1.5, 1.0, 0.5]]
    assert found["increment"].tolist() == [[[4.0, 8.0], [12.0, 16.0], [20.0, 24.0]]]


def test_truth_is_unknown_in_gaps():
    values = np.array([[0.0], [1.0], [5.0]])
    found = interpolate(values, np.array([0.0, 1.0, 5.0]), np.array([-1.0, 0.25, 1.0, 3.0, 5.0, 6.0]))
    np.testing.assert_array_equal(found[:, 0], [np.nan, 0.25, 1.0, np.nan, 5.0, np.nan])


def test_metres_of_a_site_are_placed_on_the_ellipsoid():
    east, north = np.array([0.0, 300.0, -40.0]), np.array([0.0, -200.0, 10.0])
    found = geodetic_of_local(np.stack([east, north, 0.0 * east]), SITE)
    np.testing.assert_allclose(found[:, 0], SITE, rtol=1e-12)
    table = pd.DataFrame(found.T, columns=["lat", "lon", "alt"])
    # Two planes, one 1600 m above the other.
    np.testing.assert_allclose(
        strapdown.tangent_plane(table, (LATITUDE, LONGITUDE)), [east, north], atol=1e-5
    )


@pytest.mark.slow
def test_position_only_fixes_aid_the_ins(pyins, log):
    imu, fixes, _ = log
    recorded = inertial_recording(imu, fixes[["time", "latitude", "longitude", "height", "sigma"]], **WINDOWS)
    assert isinstance(recorded, Recording)
    assert recorded.truth is None
    path = Drive(SECONDS)
    known = np.stack([path.east, path.north], axis=1)[:: round(0.5 * RATE)]
    ins = np.concatenate([recorded.initial["mean"][:, None], recorded.measurements["ins"]], axis=1)
    # The origin is the first fix, which has an error of its own.
    assert abs(ins[0] - known[49:71]).max() < 15.0
