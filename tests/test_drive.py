"""The drive of benchmarks/drive.py: strapdown and levels against known answers; the shipped file."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import xarray
from circular_drive import HEIGHT, LATITUDE, LONGITUDE, RATE, CircularDrive

from filtergym import evaluate, read_recording
from filtergym.envs.logs import strapdown

ROOT = Path(__file__).parent.parent
spec = importlib.util.spec_from_file_location("drive", ROOT / "benchmarks" / "drive.py")
drive = importlib.util.module_from_spec(spec)
spec.loader.exec_module(drive)


@pytest.fixture
def pyins():
    return pytest.importorskip("pyins", reason="python-ins is in filtergym[dev]")


def test_free_ins_of_a_constant_acceleration_error(pyins):
    """East and north follow the circle; along the vehicle's down axis the height goes off by b t^2 / 2."""
    import pandas
    from pyins import strapdown as pyins_strapdown
    from pyins import util

    path, error = CircularDrive(27.0), 0.2
    rates, forces = path.inertial()
    inertial = pandas.DataFrame(np.hstack([rates, forces]), path.time, [*util.GYRO_COLS, *util.ACCEL_COLS])
    begin = round(15.5 * RATE)  # in the circle
    position = np.stack(path.position(), axis=1)
    attitude = np.stack([0.0 * path.yaw, 0.0 * path.yaw, np.degrees(path.yaw)], axis=1)
    columns = np.hstack([position, path.velocity, attitude])
    increments = pyins_strapdown.compute_increments_from_imu(inertial, "rate")
    # What the filter takes for a bias is subtracted.
    biases = pandas.DataFrame(np.zeros((1, 6)), [0.0], [*util.THETA_COLS, *util.DV_COLS])
    biases["dv_z"] = -error
    known = strapdown.AidedInertial(
        pandas.DataFrame(columns, path.time, util.TRAJECTORY_COLS), biases, increments, innovations={}
    )
    times = path.time[begin : begin + 401 : 10]
    found = strapdown.free_inertial(known, times)
    east, north = strapdown.tangent_plane(found, (LATITUDE, LONGITUDE))
    expected = strapdown.tangent_plane(
        pandas.DataFrame(position[begin : begin + 401 : 10], times, util.LLA_COLS), (LATITUDE, LONGITUDE)
    )
    np.testing.assert_allclose([east, north], expected, atol=0.1)
    down = 0.5 * error * (times - times[0]) ** 2
    np.testing.assert_allclose(found["alt"], HEIGHT - down, atol=0.1)


@pytest.fixture(scope="module")
def shipped():
    return xarray.load_dataset(ROOT / "docs" / "data" / "drive.nc", engine="scipy")


def test_shipped_file_is_a_drive(shipped):
    """Arrays agree with each other, fixes have the noise they report, and the car keeps to the speeds of a town."""
    start = shipped["initial_mean"].values[:, None]
    ins = np.concatenate([start, shipped["ins"].values], axis=1)
    np.testing.assert_array_equal(np.diff(ins, axis=1), shipped["increment"])
    stated = shipped["reported_deviation"].values[..., None]
    noise = (shipped["fix"].values - shipped["truth"].values) / stated
    assert noise.std() == pytest.approx(1.0, abs=0.04)  # four deviations of 3888 numbers
    assert abs(noise.mean()) < 0.07
    truth = np.concatenate([start, shipped["truth"].values], axis=1)
    speed = np.hypot(*np.moveaxis(np.diff(truth, axis=1), 2, 0)) / 0.25
    assert 12.0 < speed.max() < 17.0
    assert shipped["seconds"].values[0, [0, -1]].tolist() == [0.25, 20.25]
    rms = np.sqrt((drive.errors(shipped) ** 2).mean(axis=0))
    assert rms[3] < 0.1  # 1 s
    assert 2.0 < rms[39] < 5.0
    assert 10.0 < rms[79] < 20.0


def test_shipped_file_is_replayed_to_every_kind_of_filter():
    read = read_recording(ROOT / "docs" / "data" / "drive.nc")
    licence = (ROOT / "docs" / "data" / "drive_licence.txt").read_text(encoding="utf-8")
    assert "BSD 3-Clause License" in licence
    assert read.source.split("commit ")[1].split(",")[0] in licence
    assert read.parameters == drive.PARAMETERS
    found = evaluate(read.environment, ["plain-reduced", "augmented", "gnss-only"], scenario=read)
    assert found.sizes["episode"] == 24
    assert np.isfinite(found["error"].values).all()
    error = found["error"] ** 2
    root = np.sqrt(error.sum("component").mean(["episode", "time"]))
    # Two axes of white noise of 1.41 m, and the statement of the page on the filter that estimates the rate errors.
    assert float(root.sel(policy="gnss-only")) == pytest.approx(2.0, abs=0.1)
    assert float(root.sel(policy="augmented")) == pytest.approx(0.859, abs=1e-3)
