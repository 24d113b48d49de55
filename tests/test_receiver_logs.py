"""Logs of receivers: RTKLIB, NMEA, ULog and bags of ROS 1, from small files of the same form."""

import re
import struct

import numpy as np
import pandas
import pymap3d
import pytest
from test_onboard import flight

from filtergym import read_recording
from filtergym.filters import geodesy

TARGET = "filtergym/ManeuveringTarget-v0"
COUNT = 40
TIME = 0.25 * np.arange(COUNT)
ORIGIN = (40.0966916, -105.1471665, 1601.4)


def track():
    """East, north and up of a car that turns, m, ``(3, COUNT)``."""
    heading = 0.2 * TIME
    return np.stack([50.0 * np.sin(heading), 50.0 * (1.0 - np.cos(heading)), 0.3 * TIME])


def places():
    """Latitude, longitude and height of it, by another library, ``(3, COUNT)``."""
    return np.stack(pymap3d.enu2geodetic(*track(), *ORIGIN))


def clock(times, start="2025-08-28T23:59:55.000", form="%Y/%m/%d %H:%M:%S.%f"):
    """Dates of times, s; by default they pass midnight."""
    return [(pandas.Timestamp(start) + pandas.Timedelta(seconds=t)).strftime(form)[:23] for t in times]


def around_the_first():
    """East and north of the first place, m, ``(COUNT, 2)``."""
    return np.stack(pymap3d.geodetic2enu(*places(), *places()[:2, 0], 0.0)[:2], axis=1)


def check_positions(recording, tolerance):
    """Compare with the track, of which the first two positions make the start."""
    found = recording.measurements["position"][0]
    np.testing.assert_allclose(found, around_the_first()[2:], atol=tolerance)
    np.testing.assert_allclose(recording.seconds[0], TIME[2:] - TIME[1], atol=1e-9)


def test_earth_fixed_coordinates_and_back():
    """Against another library; both round coordinates of 6e6 m."""
    rng = np.random.default_rng(0)
    latitude, longitude = rng.uniform(-1.57, 1.57, 1000), rng.uniform(-np.pi, np.pi, 1000)
    height = rng.uniform(-500.0, 20e3, 1000)
    found = geodesy.geodetic(geodesy.earth_fixed(latitude, longitude, height))
    radius = geodesy.SEMI_MAJOR_AXIS
    # Bowring's formula is approximate by up to 2e-6 m at these heights.
    np.testing.assert_allclose(found[0] * radius, latitude * radius, atol=5e-6)
    np.testing.assert_allclose(found[1], longitude, atol=1e-15)
    np.testing.assert_allclose(found[2], height, atol=1e-8)
    other = pymap3d.ecef2geodetic(*geodesy.earth_fixed(latitude, longitude, height), deg=False)
    np.testing.assert_allclose(found[2], other[2], atol=1e-8)


# --- RTKLIB

GEODETIC = "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)"
EARTH_FIXED = (
    "%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio"
)
BASELINE = (
    "%  UTC  e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde(m) sdn(m) sdu(m) sden(m) sdnu(m) sdue(m)"
)


def rtklib(path, header, positions, sigmas=(0.02, 0.03, 0.05, 0.0, 0.0, 0.0), times=None, separator="   "):
    """Write a solution; positions are ``(3, COUNT)``."""
    lines = ["% program   : RTKLIB ver.2.4.2", "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)", header]
    for i, time in enumerate(times or clock(TIME)):
        values = [*(f"{v:.9f}" for v in positions[:, i]), 1 + (i > 30), 20, *sigmas, 0.0, 1.0]
        lines.append(separator.join([*time.split(), *map(str, values)]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("separator", ["   ", ",", "\t"])
def test_geodetic_solutions(separator, tmp_path):
    path = rtklib(tmp_path / "drive.pos", GEODETIC, places(), separator=separator)
    recording = read_recording(path, TARGET)
    check_positions(recording, 2e-4)  # 1e-9 degrees are 1e-4 m
    assert recording.measurements["variance"][0, 0] == pytest.approx([0.03**2, 0.02**2], rel=1e-12)
    assert recording.parameters == {"sampling_interval": 0.25}
    assert recording.notes[:2] == ("quality: 31 fixed, 9 float", "times are GPST")
    assert recording.log_time[0, :2].tolist() == ["2025/08/28 23:59:55.500", "2025/08/28 23:59:55.750"]


def test_earth_fixed_solutions(tmp_path):
    fixed = np.stack(pymap3d.geodetic2ecef(*places()))
    # Deviations 3 cm east, 2 cm north, 5 cm up, and east and north correlated by a half, turned by another library.
    local = np.array([[9.0, 3.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 25.0]]) * 1e-4
    axes = np.stack([pymap3d.enu2ecefv(*axis, *ORIGIN[:2]) for axis in np.eye(3)], axis=1)
    covariance = axes @ local @ axes.T
    written = [covariance[pair] for pair in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))]
    sigmas = np.sign(written) * np.sqrt(np.abs(written))
    recording = read_recording(rtklib(tmp_path / "drive.pos", EARTH_FIXED, fixed, sigmas), TARGET)
    check_positions(recording, 1e-6)
    np.testing.assert_allclose(np.sqrt(recording.measurements["variance"][0, 0]), [0.03, 0.02], rtol=1e-6)


def test_baselines(tmp_path):
    recording = read_recording(rtklib(tmp_path / "drive.pos", BASELINE, track()), TARGET)
    np.testing.assert_allclose(recording.measurements["position"][0], track()[:2, 2:].T, atol=1e-9)
    assert recording.measurements["variance"][0, 0] == pytest.approx([0.02**2, 0.03**2], rel=1e-12)
    assert recording.notes == (
        "x is east and y north of RTKLIB's base station",
        "quality: 31 fixed, 9 float",
        "times are UTC",
    )


def test_weeks_and_their_seconds(tmp_path):
    times = [f"2381 {604795.0 + t:.3f}" if t < 5.0 else f"2382 {t - 5.0:.3f}" for t in TIME]
    recording = read_recording(rtklib(tmp_path / "drive.pos", GEODETIC, places(), times=times), TARGET)
    check_positions(recording, 2e-4)
    assert recording.notes[1] == "times are seconds of GPST since 1980"
    assert recording.log_time[0, -1] == 2382 * 604800.0 + TIME[-1] - 5.0


def test_broken_lines_of_a_solution_are_counted(tmp_path):
    path = rtklib(tmp_path / "drive.pos", GEODETIC, places())
    whole = path.read_text()
    path.write_text(whole.replace(" 40.0966916", " 4o.0966916", 1) + "2025/08/29 00:00:05.000 40.09")
    recording = read_recording(path, TARGET)
    assert recording.notes[0] == "2 lines are no solutions: left out"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: text.replace(GEODETIC, "%"), "lacks RTKLIB's line with the names of its columns"),
        (lambda text: text.replace("(deg)", "(d'\")"), "are degrees, minutes and seconds"),
        (lambda text: text.replace("latitude", "x").replace("longitude", "y"), "needed are latitude"),
        (lambda text: text.replace("/08/", "-08-"), "40 lines of 40 are no solutions: is it whole"),
        (lambda text: "", "holds no solution of RTKLIB"),
    ],
)
def test_what_is_no_solution_is_refused(change, sentence, tmp_path):
    path = rtklib(tmp_path / "drive.pos", GEODETIC, places())
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=r"recording .*drive\.pos: ") as refusal:
        read_recording(path, TARGET)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


# --- NMEA


def sentence(words):
    total = 0
    for byte in words.encode():
        total ^= byte
    return f"${words}*{total:02X}"


def degrees(value, digits, letters):
    """Degrees and minutes, and the letter of the hemisphere."""
    whole, minutes = divmod(abs(value) * 60.0, 60.0)
    return f"{int(whole):0{digits}d}{minutes:010.7f},{letters[int(value < 0.0)]}"


def nmea(path, deviations=True, dates=True, quality=None):
    """Write GGA, RMC once a second, and GST, with other sentences between."""
    lines = []
    times = pandas.Timestamp("2026-05-01T23:59:55") + pandas.to_timedelta(TIME, unit="s")
    for i, (time, (latitude, longitude, height)) in enumerate(zip(times, places().T, strict=True)):
        now = time.strftime("%H%M%S.%f")[:9]
        where = f"{degrees(latitude, 2, 'NS')},{degrees(longitude, 3, 'EW')}"
        fix = 1 if quality is None else quality[i]
        where = where if fix else ",,,"
        lines.append(sentence(f"GPGGA,{now},{where},{fix},12,0.9,{height + 17.0:.4f},M,-17.0,M,,"))
        lines.append(sentence("GPGSV,1,1,01,02,45,120,40"))
        if dates and i % 4 == 2:
            lines.append(sentence(f"GNRMC,{now},{'A' if fix else 'V'},{where},5.0,90.0,{time:%d%m%y},,,A"))
        if deviations:
            lines.append(sentence(f"GPGST,{now},2.0,,,,1.5,{2.5 + 0.1 * (i == 5)},3.0"))
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


@pytest.fixture
def pynmea2():
    return pytest.importorskip("pynmea2", reason="not installed: pip install 'filtergym[logs]'")


def test_sentences(pynmea2, tmp_path):
    recording = read_recording(nmea(tmp_path / "walk.nmea"), TARGET)
    check_positions(recording, 2e-4)  # 1e-7 minutes are 2e-4 m
    sigma = np.sqrt(recording.measurements["variance"][0, 2:4])
    np.testing.assert_allclose(sigma, [[2.5, 1.5], [2.6, 1.5]], rtol=1e-12)
    assert len(recording.notes) == 1
    assert recording.log_time[0, [0, -1]].tolist() == [
        "2026-05-01T23:59:55.500000Z",
        "2026-05-02T00:00:04.750000Z",
    ]


def test_sentences_without_a_date(pynmea2, tmp_path):
    recording = read_recording(nmea(tmp_path / "walk.nmea", dates=False), TARGET)
    check_positions(recording, 2e-4)
    assert recording.log_time[0, [0, -1]].tolist() == ["23:59:55.500000", "00:00:04.750000"]


def test_no_deviation_is_made_of_hdop(pynmea2, tmp_path):
    path = nmea(tmp_path / "walk.nmea", deviations=False)
    deviation = read_recording(path, TARGET).deviations["sigma_x"]
    assert deviation < 0.1  # the sentences are written without noise: they scatter by their turn alone
    recording = read_recording(path, TARGET, range_sigma=2.5)
    assert (recording.measurements["variance"] == 6.25).all()
    assert recording.notes[0].startswith("no GST sentence gives the size of errors: HDOP describes")


def test_times_without_a_fix_are_missing_measurements(pynmea2, tmp_path):
    quality = np.where((np.arange(COUNT) > 9) & (np.arange(COUNT) < 20), 0, 4)
    recording = read_recording(nmea(tmp_path / "walk.nmea", quality=quality), TARGET)
    np.testing.assert_array_equal(recording.measurements["available"][0], (quality > 0)[2:])
    assert recording.notes[0] == "10 times without a position"


def test_broken_sentences_are_counted(pynmea2, tmp_path):
    path = nmea(tmp_path / "walk.nmea")
    lines = path.read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if "GGA,000000" in line)
    lines[number] = lines[number].replace("4005", "4006")
    text = "\n".join(f"12:00:00.123 COM3 > {line}" for line in lines)
    path.write_bytes(text.encode() + b"\n\xb5\x62\x01\x07\x00$GPGGA,12")
    recording = read_recording(path, TARGET)
    assert recording.notes[0] == "2 lines have a wrong checksum or are no sentence: left out"


def test_what_holds_no_sentence_is_refused(pynmea2, tmp_path):
    broken = "it holds no sentence GGA or RMC that is whole, and {} broken ones"
    for content, sentence in (
        (b"", broken.format(0)),
        (b"$GPGGA,,,,,,,,,*00\n" * 9, broken.format(9)),
        (b"\x00" * 50_000, "it holds no sentence"),
        (b"$GPGGA," * 50_000, "it holds no sentence"),
    ):
        (tmp_path / "walk.nmea").write_bytes(content)
        with pytest.raises(ValueError, match=rf"recording .*walk\.nmea: {sentence}"):
            read_recording(tmp_path / "walk.nmea", TARGET)


def test_logs_of_too_many_rows_are_refused(pynmea2, tmp_path, monkeypatch):
    monkeypatch.setattr("filtergym.envs.logs.flight_tables.MOST_ROWS", COUNT - 1)
    rows = [(round(1e6 * time), *place, 2.0, 3) for time, place in zip(TIME, places().T, strict=True)]
    pytest.importorskip("pyulog", reason="not installed: pip install 'filtergym[logs]'")
    for path in (
        nmea(tmp_path / "walk.nmea"),
        rtklib(tmp_path / "drive.pos", GEODETIC, places()),
        ulog(tmp_path / "flight.ulg", NEW, rows),
        bag(tmp_path / "drive.bag"),
    ):
        with pytest.raises(ValueError, match="it has more than 39 rows: split it"):
            read_recording(path, TARGET)


# --- ULog


def ulog(path, fields, rows, name="vehicle_gps_position"):
    """Write a log of one topic: fields are names and their types in C and in struct."""
    content = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)

    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    declared = "".join(f"{c} {field};" for field, c, _ in fields)
    content += message("B", bytes(40)) + message("F", f"{name}:{declared}".encode())
    content += message("A", struct.pack("<BH", 0, 1) + name.encode())
    for row in rows:
        content += message("D", struct.pack("<H" + "".join(s for *_, s in fields), 1, *row))
    path.write_bytes(content)
    return path


OLD = [("timestamp", "uint64_t", "Q"), ("lat", "int32_t", "i"), ("lon", "int32_t", "i")]
OLD += [("alt_ellipsoid", "int32_t", "i"), ("eph", "float", "f"), ("fix_type", "uint8_t", "B")]
NEW = [("timestamp", "uint64_t", "Q"), ("latitude_deg", "double", "d"), ("longitude_deg", "double", "d")]
NEW += [("altitude_ellipsoid_m", "double", "d"), ("eph", "float", "f"), ("fix_type", "uint8_t", "B")]


@pytest.mark.parametrize(("fields", "units"), [(OLD, (1e7, 1e7, 1e3)), (NEW, (1.0, 1.0, 1.0))])
def test_positions_of_an_autopilot(fields, units, tmp_path):
    pytest.importorskip("pyulog", reason="not installed: pip install 'filtergym[logs]'")
    rows = []
    for i, place in enumerate(places().T):
        values = [value * unit for value, unit in zip(place, units, strict=True)]
        values = [round(v) for v in values] if fields is OLD else values
        rows.append((round(1e6 * (TIME[i] + 7.0)), *values, 2.0, 3 - 2 * (i == 9)))
    recording = read_recording(ulog(tmp_path / "flight.ulg", fields, rows), TARGET)
    assert recording.measurements["available"][0].tolist() == [float(i != 9) for i in range(2, COUNT)]
    there = recording.measurements["available"][0] > 0.0
    found = recording.measurements["position"][0][there]
    # 1e-7 degrees are a centimetre; of the first position, too.
    tolerance = 2e-2 if fields is OLD else 1e-7
    np.testing.assert_allclose(found, around_the_first()[2:][there], atol=tolerance)
    np.testing.assert_allclose(recording.measurements["variance"][0][there], 2.0, rtol=1e-12)
    assert recording.notes[:2] == (
        "positions are of vehicle_gps_position, times seconds since the start of the autopilot",
        "1 row without a fix",
    )


def test_a_log_without_positions_is_refused(tmp_path):
    pytest.importorskip("pyulog", reason="not installed: pip install 'filtergym[logs]'")
    path = ulog(tmp_path / "flight.ulg", NEW[:1], [(i,) for i in range(9)], "vehicle_air_data")
    with pytest.raises(ValueError, match="it holds neither vehicle_gps_position nor sensor_gps"):
        read_recording(path, TARGET)
    path.write_bytes(b"no log at all")
    with pytest.raises(ValueError, match=r"recording .*flight\.ulg: "):
        read_recording(path, TARGET)


# --- bags


def bag(path, covariance_type=2, compression=None, kind="sensor_msgs/msg/NavSatFix"):
    """Write a bag with positions, and something else."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="not installed: pip install 'filtergym[logs]'")
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connection = writer.add_connection("/gps/fix", kind, typestore=types)
        other = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=types)
        for i, place in enumerate(places().T):
            time = 1756402239 * 10**9 + round(1e9 * TIME[i])
            stamp = types.types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
            header = types.types["std_msgs/msg/Header"](i, stamp, "gps")
            status = types.types["sensor_msgs/msg/NavSatStatus"](-1 if i == 9 else 0, 1)
            fields = (header, status, *place, np.diag([4.0, 9.0, 16.0]).ravel(), covariance_type)
            if kind.endswith("NavSatFix"):
                writer.write(connection, i, types.serialize_ros1(types.types[kind](*fields), kind))
            text = types.types["std_msgs/msg/String"]("hello")
            writer.write(other, i, types.serialize_ros1(text, "std_msgs/msg/String"))
    return path


def bag2(folder, storage="SQLITE3", compression=False, kinds=("sensor_msgs/msg/NavSatFix",)):
    """Write a bag of ROS 2 and return its storage file; poses go 3 m east and 1 m south of the places."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="not installed: pip install 'filtergym[logs]'")
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)

    def make(kind, *fields):
        return types.types[kind](*fields)

    writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[storage])
    if compression:
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topics = {
            kind: writer.add_connection("/" + kind.split("/")[-1], kind, typestore=types) for kind in kinds
        }
        for i, (place, plane) in enumerate(zip(places().T, around_the_first(), strict=True)):
            time = 1756402239 * 10**9 + round(1e9 * TIME[i])
            stamp = make("builtin_interfaces/msg/Time", time // 10**9, time % 10**9)
            header = make("std_msgs/msg/Header", stamp, "gps")
            status = make("sensor_msgs/msg/NavSatStatus", -1 if i == 9 else 0, 1)
            point = make("geometry_msgs/msg/Point", plane[0] + 3.0, plane[1] - 1.0, 0.0)
            pose = make(
                "geometry_msgs/msg/Pose", point, make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
            )
            vector = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
            twist = make("geometry_msgs/msg/Twist", vector, vector)
            C = np.diag([4.0, 9.0, 1.0, 1.0, 1.0, 1.0]).ravel()
            stated = make("geometry_msgs/msg/PoseWithCovariance", pose, C)
            moving = make("geometry_msgs/msg/TwistWithCovariance", twist, C)
            messages = {
                "sensor_msgs/msg/NavSatFix": (header, status, *place, np.diag([4.0, 9.0, 16.0]).ravel(), 2),
                "nav_msgs/msg/Odometry": (header, "base", stated, moving),
                "geometry_msgs/msg/PoseStamped": (header, pose),
                "std_msgs/msg/String": ("hello",),
            }
            for kind in kinds:
                writer.write(topics[kind], time, types.serialize_cdr(make(kind, *messages[kind]), kind))
    return next(file for file in folder.iterdir() if file.suffix in (".db3", ".mcap"))


def check_fixes(recording, topic):
    """Compare with the places of the bags, whose tenth has no fix."""
    there = recording.measurements["available"][0] > 0.0
    assert there.tolist() == [i != 9 for i in range(2, COUNT)]
    found = recording.measurements["position"][0][there]
    np.testing.assert_allclose(found, around_the_first()[2:][there], atol=1e-7)
    assert (recording.measurements["variance"][0][there] == [4.0, 9.0]).all()
    assert recording.notes[:2] == (f"positions are of the topic {topic}", "1 message without a fix")


@pytest.mark.parametrize(("storage", "compression"), [("SQLITE3", False), ("MCAP", True)])
def test_messages_of_a_bag_of_ros_2(storage, compression, tmp_path):
    """By its file and by its folder, whose metadata are not needed."""
    path = bag2(tmp_path / "drive", storage, compression)
    metadata = "rosbag2_bagfile_information: {relative_file_paths: [/etc/passwd]}"
    (tmp_path / "drive" / "metadata.yaml").write_text(metadata)
    recording = read_recording(path, TARGET)
    check_fixes(recording, "/NavSatFix")
    folder = read_recording(tmp_path / "drive", TARGET)
    np.testing.assert_array_equal(folder.measurements["position"], recording.measurements["position"])


def test_odometry_of_a_bag_is_the_second_sensor(tmp_path):
    """Displacements of poses between the times of fixes, in the frame of the odometry."""
    kinds = ("sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry")
    recording = read_recording(bag2(tmp_path / "drive", kinds=kinds), TARGET)
    moved = np.diff(around_the_first(), axis=0)[1:]
    np.testing.assert_allclose(recording.measurements["odometry_displacement"][0], moved, atol=1e-8)
    assert (recording.measurements["odometry_available"] == 1.0).all()
    assert any("the second sensor is the topic /Odometry" in note for note in recording.notes)


def test_poses_of_a_bag_are_positions(tmp_path):
    expected = around_the_first()[2:] + np.array([3.0, -1.0])
    recording = read_recording(bag2(tmp_path / "odometry", kinds=("nav_msgs/msg/Odometry",)), TARGET)
    np.testing.assert_allclose(recording.measurements["position"][0], expected, atol=1e-9)
    assert (recording.measurements["variance"][0] == [4.0, 9.0]).all()
    path = bag2(tmp_path / "poses", "MCAP", kinds=("geometry_msgs/msg/PoseStamped",))
    recording = read_recording(path, TARGET, range_sigma=2.0)
    np.testing.assert_allclose(recording.measurements["position"][0], expected, atol=1e-9)
    assert "messages do not contain the size of errors" in recording.notes
    talk = bag2(tmp_path / "talk", kinds=("std_msgs/msg/String",))
    with pytest.raises(ValueError, match=r"no .*NavSatFix and no positions; it holds std_msgs/msg/String"):
        read_recording(talk, TARGET)


@pytest.mark.parametrize("compression", [None, "BZ2"])
def test_messages_of_a_bag(compression, tmp_path):
    check_fixes(read_recording(bag(tmp_path / "drive.bag", compression=compression), TARGET), "/gps/fix")


def test_a_bag_without_deviations_or_positions(tmp_path):
    unknown = read_recording(bag(tmp_path / "drive.bag", covariance_type=0), TARGET)
    assert "scatter" in unknown.deviations_from
    imu = bag(tmp_path / "imu.bag", kind="sensor_msgs/msg/Imu")
    with pytest.raises(ValueError, match=r"no .*NavSatFix and no positions; it holds .*std_msgs/msg/String"):
        read_recording(imu, TARGET)


def test_a_bag_with_a_definition_of_its_own_is_refused(tmp_path):
    path = bag(tmp_path / "drive.bag")
    content = path.read_bytes()
    digest = re.search(rb"md5sum=([0-9a-f]{32})", content[content.index(b"NavSatFix") - 200 :])[1]
    path.write_bytes(content.replace(digest, b"0" * 32))
    with pytest.raises(ValueError, match=r"its sensor_msgs/msg/NavSatFix is another than that of ROS 1"):
        read_recording(path, TARGET)


@pytest.mark.parametrize("suffix", [".pos", ".nmea", ".ulg", ".bin", ".bag", ".db3", ".mcap"])
def test_whatever_is_broken_is_one_sentence(suffix, tmp_path):
    """Bytes that changed and files that end early are read or refused, and nothing else happens."""
    library = {".ulg": "pyulog", ".nmea": "pynmea2", ".bin": "pymavlink"}.get(suffix, "numpy")
    pytest.importorskip(library, reason="not installed: pip install 'filtergym[logs]'")
    rows = [(round(1e6 * time), *place, 2.0, 3) for time, place in zip(TIME, places().T, strict=True)]
    make = {
        ".pos": lambda path: rtklib(path, GEODETIC, places()),
        ".nmea": nmea,
        ".ulg": lambda path: ulog(path, NEW, rows),
        ".bin": lambda path: flight(path, 10.0),
        ".bag": bag,
        ".db3": lambda path: bag2(path),
        ".mcap": lambda path: bag2(path, "MCAP", compression=True),
    }[suffix]
    whole = make(tmp_path / f"whole{suffix}").read_bytes()
    path, rng, sentences = tmp_path / f"log{suffix}", np.random.default_rng(0), []
    # Text is read at once; what takes a library takes longer, and `make fuzz` goes on for hours.
    for _ in range(30 if suffix in (".pos", ".nmea") else 4):
        content = bytearray(whole)
        for place in rng.integers(0, len(whole), int(rng.choice([1, 5, 50]))):
            content[place] = int(rng.choice([0, 255, rng.integers(0, 256)]))
        path.write_bytes(content[: int(rng.integers(1, 2 * len(whole)))])
        try:
            read_recording(path, TARGET)
        except ValueError as error:
            sentences.append(str(error))
    assert sentences
    assert all(text.startswith(f"recording {path}: ") and "\n" not in text for text in sentences)
