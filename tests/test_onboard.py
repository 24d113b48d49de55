"""The filter of a vehicle beside ours: logs of ArduPilot in their documented format, and a log of PX4 that flew."""

import gzip
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from filtergym import read_recording
from filtergym.baselines.advice import FittedLog
from filtergym.baselines.onboard import ONBOARD, _withhold, judge_onboard
from filtergym.baselines.problem import problem_of
from filtergym.envs.logs.onboard import ARDUPILOT_RADIUS, PX4_RADIUS, _px4_track, read_onboard
from filtergym.filters.geodesy import PlaneOrigin
from filtergym.names import find_competitors

TARGET = "filtergym/ManeuveringTarget-v0"
SPEEDS = (0.001, 1000.0)
FORMATS = {  # number of the message, its types in the format and in struct, and its columns
    "GPS": (1, "QBBLLf", "<QBBiif", "TimeUS,I,Status,Lat,Lng,Alt"),
    "GPA": (2, "QBC", "<QBH", "TimeUS,I,HAcc"),
    "ORGN": (3, "QBLLe", "<QBiii", "TimeUS,Type,Lat,Lng,Alt"),
    "XKF1": (4, "QBff", "<QBff", "TimeUS,C,PN,PE"),
}
LATITUDE, LONGITUDE, DELAY = 48.0, 11.0, 0.2


def dataflash(path, rows):
    """Write a log of ArduPilot: messages that describe those that follow, and these."""
    content = b""
    head = 128, "BBnNZ", "<BB4s16s64s", "Type,Length,Name,Format,Columns"
    for name, (number, types, layout, columns) in {"FMT": head, **FORMATS}.items():
        words = name.encode(), types.encode(), columns.encode()
        content += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, 3 + struct.calcsize(layout), *words)
    for name, *values in rows:
        number, _, layout, _ = FORMATS[name]
        content += b"\xa3\x95" + bytes([number]) + struct.pack(layout, *values)
    path.write_bytes(content)
    return path


def degrees(north, east):
    """The inverse of ArduPilot's metres, in units of 1e-7 degrees."""
    latitude = LATITUDE + np.degrees(north / ARDUPILOT_RADIUS)
    across = np.cos(np.radians(0.5 * (latitude + LATITUDE)))
    return round(1e7 * latitude), round(1e7 * (LONGITUDE + np.degrees(east / ARDUPILOT_RADIUS / across)))


def flown(time):
    """Metres north and east at a time: a circle."""
    return 40.0 * np.sin(0.2 * time), 40.0 * np.cos(0.2 * time)


def flight(path, seconds=120.0, estimates=True):
    """Write a flight: fixes five times a second, of what was ``DELAY`` before; another receiver and another core."""
    noise = np.random.default_rng(0)
    rows = [("ORGN", 0, 0, *degrees(0.0, 0.0), 0), ("ORGN", 0, 1, 0, 0, 0)]
    for i, time in enumerate(np.arange(10.0, 10.0 + seconds, 0.1)):
        stamp = round(1e6 * time)
        if estimates:
            rows += [("XKF1", stamp, 0, *flown(time)), ("XKF1", stamp, 1, 900.0, 900.0)]
        if i % 2 == 0:
            fix = np.array(flown(time - DELAY)) + noise.normal(0.0, 0.5, 2)
            rows += [("GPS", stamp, 0, 3, *degrees(*fix), 500.0), ("GPS", stamp, 1, 3, 0, 0, 0.0)]
            rows += [("GPA", stamp, 0, 70)]
    return dataflash(path, rows)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    pytest.importorskip("pymavlink", reason="not installed: pip install 'filtergym[logs]'")
    return flight(tmp_path_factory.mktemp("flight") / "00000001.BIN")


def test_fixes_of_ardupilot_are_read(log):
    recording = read_recording(log, TARGET)
    assert recording.rows[0] == 598
    assert np.ptp(recording.measurements["position"][0], axis=0) == pytest.approx(80.0, abs=3.0)
    sigma = pytest.approx(0.7 / np.sqrt(2.0), abs=1e-3)  # the distance is 0.7 m
    assert recording.deviations == {"sigma_x": sigma, "sigma_y": sigma}
    assert "positions are of GPS, times seconds since the start of the autopilot" in recording.notes


def test_estimates_of_ardupilot_are_where_they_were(log):
    track = read_onboard(log)
    assert track.source == "EKF3 of ArduPilot, XKF1"
    at = track.at(np.array([20.0, 20.05, 9.0, 1e3]), PlaneOrigin(LATITUDE, LONGITUDE))
    # The sphere is larger than the ellipsoid is curved there: 0.2 % of 40 m.
    assert at[:2] == pytest.approx(np.array([flown(t)[::-1] for t in (20.0, 20.05)]), abs=0.25)
    assert np.isnan(at[2:]).all()


def test_metres_of_px4_become_degrees_and_metres_again():
    latitude, longitude, north, east = 47.4, 8.5, np.array([0.0, 1e3, -3e3]), np.array([0.0, 2e3, 4e3])
    count = len(north)
    fields = {"timestamp": np.arange(1, count + 1) * 1_000_000, "x": north, "y": east}
    fields |= {"ref_lat": np.full(count, latitude), "ref_lon": np.full(count, longitude)}
    track = _px4_track("vehicle_local_position", fields)
    # map_projection_project of PX4.
    phi, other, step = (
        np.radians(latitude),
        np.radians(track.latitude),
        np.radians(track.longitude - longitude),
    )
    angle = np.arccos(
        np.clip(np.sin(phi) * np.sin(other) + np.cos(phi) * np.cos(other) * np.cos(step), -1.0, 1.0)
    )
    scale = np.where(angle > 0.0, angle / np.where(angle > 0.0, np.sin(angle), 1.0), 1.0) * PX4_RADIUS
    assert scale * (
        np.cos(phi) * np.sin(other) - np.sin(phi) * np.cos(other) * np.cos(step)
    ) == pytest.approx(north, abs=1e-5)
    assert scale * np.cos(other) * np.sin(step) == pytest.approx(east, abs=1e-5)


def judgement(path, names=("kalman-imm", "imm")):
    recording = read_recording(path, TARGET, speeds=SPEEDS)
    problem = problem_of(TARGET)
    share = FittedLog(problem, recording).share
    makers = {one.name: one.maker for one in find_competitors(problem, names)}
    return recording, judge_onboard(problem, recording, {}, share, makers, read_onboard(path))


def test_withheld_fixes_judge_the_filter_of_the_vehicle(log):
    _, found = judgement(log)
    assert found.delay == pytest.approx(DELAY)
    assert 25 <= found.fixes <= 32  # a fifth of a quarter
    # It is the truth here: what is left is the noise of the fixes, 0.5 m on each axis.
    assert found.errors[ONBOARD] == pytest.approx(0.71, rel=0.25)
    assert found.errors["kalman-imm"] > found.errors[ONBOARD]
    assert found.relative.value == pytest.approx(found.errors["kalman-imm"] / found.errors[ONBOARD] - 1.0)


def test_a_withheld_fix_is_a_missed_measurement(log):
    recording = read_recording(log, TARGET)
    withheld = np.zeros(recording.seconds.shape, dtype=bool)
    withheld[0, 4] = True
    found = _withhold(recording, withheld).measurements
    assert (found["available"][0, 3:6] == [1.0, 0.0, 1.0]).all()
    assert (found["position"][0, 4] == 0.0).all()
    assert found["elapsed"][0, 5] == pytest.approx(recording.seconds[0, 5] - recording.seconds[0, 3])
    assert found["elapsed"][0, :5] == pytest.approx(recording.measurements["elapsed"][0, :5])


def test_a_log_without_estimates_has_no_such_row(log, tmp_path):
    pytest.importorskip("pyulog", reason="not installed: pip install 'filtergym[logs]'")
    assert read_onboard(flight(tmp_path / "a.bin", 2.0, estimates=False)) is None
    assert read_onboard("flights/*.ulg") is None
    (tmp_path / "log.csv").write_text("time,x,y\n")
    assert read_onboard(tmp_path / "log.csv") is None


def test_a_log_without_fixes_is_refused(tmp_path):
    pytest.importorskip("pymavlink", reason="not installed: pip install 'filtergym[logs]'")
    path = dataflash(tmp_path / "a.bin", [("XKF1", i, 0, 0.0, 0.0) for i in range(9)])
    with pytest.raises(ValueError, match=re.escape("it holds no GPS")):
        read_recording(path, TARGET)


def test_a_log_of_px4_that_flew_is_judged(tmp_path):
    """Two topics of a file of pyulog's own tests."""
    pytest.importorskip("pyulog", reason="not installed: pip install 'filtergym[logs]'")
    path = tmp_path / "flight.ulg"
    path.write_bytes(
        gzip.decompress((Path(__file__).parent / "golden" / "sample_px4_events.ulg.gz").read_bytes())
    )
    recording, found = judgement(path, ["imm"])
    assert found.source == "EKF2 of PX4, vehicle_local_position"
    distance = np.linalg.norm(found.positions - recording.measurements["position"], axis=-1)
    assert np.nanmax(distance[recording.measurements["available"] > 0.0]) < 0.1  # m: both are of one place
    assert found.errors[ONBOARD] == pytest.approx(0.0185, abs=1e-3)
