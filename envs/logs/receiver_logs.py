"""Readers of receiver logs, which return columns with the names of tables.

* RTKLIB's ``.pos``: geodetic or Earth-fixed positions or baselines in metres, with standard deviations.
* NMEA 0183, ``.nmea``: positions of GGA and RMC, standard deviations of GST.
* ULog of PX4, ``.ulg``: positions of the topic ``vehicle_gps_position``, or ``sensor_gps``.
* Logs of ArduPilot, ``.bin``: positions of ``GPS``, of the first receiver.
* Bags of ROS 1, ``.bag``, and of ROS 2, ``.db3`` or ``.mcap``: ``NavSatFix``, with ``Odometry`` for a second sensor, or
  positions of ``Odometry`` or of poses.

Each becomes a table with those of ``time``, ``latitude``, ``longitude``, ``altitude``, ``sigma_x`` and ``sigma_y``
that the log contains, or with ``x`` and ``y`` of a baseline. The readers use files as data only, never code, types or
paths in them, and reject a file that is too large before it fills the memory.
"""

import datetime
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ...filters.geodesy import east_north_up, geodetic
from ..data.foreign_files import open_foreign, parse_apart
from ..data.foreign_parsers import NAVSAT, check_rows

if TYPE_CHECKING:
    import pandas

LONGEST_LINE = 4096
"""Longest line, bytes; the rest counts as another line."""
MOST_BROKEN = 0.5
"""Largest share of broken lines: a file with more is of another kind."""
EXTRA = "pip install 'filtergym[logs]'"
DAY = 86400.0
WEEK = 7 * DAY


class ReceiverLog(NamedTuple):
    """Columns read from a receiver's log, and notes."""

    columns: Mapping[str, Any]
    """Columns by name, all of the same length."""
    notes: tuple[str, ...] = ()
    """Notes on the reading, one line each."""


def count_of(count: int, what: str, plural: str = "") -> str:
    """Return a count with its noun, whose plural has an s unless given."""
    return f"{count:,} {what if count == 1 else plural or what + 's'}"


def _note_broken(count: int, good: int, what: str) -> tuple[str, ...]:
    if count > MOST_BROKEN * (count + good):
        raise ValueError(f"{count_of(count, 'line')} of {count + good:,} {what}: is it whole?")
    return (f"{count_of(count, 'line')} {what}: left out",) if count else ()


def _read_lines(file: Path) -> Iterator[bytes]:
    with open_foreign(file) as content:
        while line := content.readline(LONGEST_LINE):
            yield line


# --- RTKLIB

QUALITY = ("none", "fixed", "float", "SBAS", "DGPS", "single", "PPP")
"""Quality of a solution, by its number."""


def read_rtklib(file: Path, most_rows: int) -> ReceiverLog:
    """Return positions and standard deviations from an RTKLIB solution file (manual 2.4.2, B.1), as columns.

    Args:
        file: its path.
        most_rows: largest number of rows.

    Raises:
        ValueError: if the file is no solution, or has more rows.
    """
    names: list[str] = []
    system, rows, broken = "", [], 0
    for line in _read_lines(file):
        text = line.decode("utf-8", "replace").strip().lstrip("\ufeff")
        if text.startswith("%"):
            words = text.lstrip("% ").replace(",", " ").split()
            if words and words[0] in ("GPST", "UTC", "JST"):
                system, names = words[0], [re.sub(r"\(.*", "", word) for word in words[1:]]
                if any("'" in word for word in words):
                    raise ValueError(
                        "latitude and longitude are degrees, minutes and seconds: write them as ddd.ddddddd"
                    )
            continue
        cells = re.split(r"[,;\s]+", text)
        if not text:
            continue
        if not names:
            raise ValueError(
                "it lacks RTKLIB's line with the names of its columns, such as % GPST latitude(deg) longitude(deg)"
            )
        try:
            # Newer versions append further named columns, such as velocities.
            rows.append((*_rtklib_time(cells), *map(float, cells[2 : 2 + len(names)])))
            if len(rows[-1]) != 2 + len(names):
                rows.pop()
                raise ValueError
        except ValueError:
            broken += 1
        check_rows(len(rows), most_rows)
    notes = _note_broken(broken, len(rows), "are no solutions")
    if not rows:
        raise ValueError("it holds no solution of RTKLIB")
    written, seconds, *values = zip(*rows, strict=True)
    found = dict(zip(names, map(numpy.array, values), strict=True))
    columns, position_notes = _rtklib_positions(found)
    notes += position_notes
    if "Q" in found:
        counted = Counter(QUALITY[int(q)] if 0 <= q < len(QUALITY) else f"{q:g}" for q in found["Q"].tolist())
        notes += (f"quality: {', '.join(f'{count:,} {name}' for name, count in counted.most_common())}",)
    dates = all(written)
    notes += (f"times are {system}" if dates else f"times are seconds of {system} since 1980",)
    return ReceiverLog({"time": list(written) if dates else numpy.array(seconds), **columns}, notes)


def _rtklib_time(cells: Sequence[str]) -> tuple[str, float]:
    """Return date and time as written, and 0; of a GPS week and seconds no date, and the seconds since 1980."""
    if "/" in cells[0]:
        return f"{cells[0]} {cells[1]}", 0.0
    return "", WEEK * int(cells[0]) + float(cells[1])


def _rtklib_positions(found: Mapping[str, numpy.ndarray]) -> tuple[dict[str, Any], tuple[str, ...]]:
    if {"latitude", "longitude"} <= {*found}:
        columns = {"latitude": found["latitude"], "longitude": found["longitude"]}
        if "height" in found:
            columns["altitude"] = found["height"]
        if {"sde", "sdn"} <= {*found}:
            columns |= {"sigma_x": found["sde"], "sigma_y": found["sdn"]}
        return columns, ()
    if {"e-baseline", "n-baseline"} <= {*found}:
        columns = {"x": found["e-baseline"], "y": found["n-baseline"]}
        if {"sde", "sdn"} <= {*found}:
            columns |= {"sigma_x": found["sde"], "sigma_y": found["sdn"]}
        return columns, ("x is east and y north of RTKLIB's base station",)
    axes = ["x-ecef", "y-ecef", "z-ecef"]
    if {*axes} <= {*found}:
        latitude, longitude, height = geodetic(numpy.stack([found[axis] for axis in axes]))
        columns = {
            "latitude": numpy.degrees(latitude),
            "longitude": numpy.degrees(longitude),
            "altitude": height,
        }
        deviations = ["sdx", "sdy", "sdz", "sdxy", "sdyz", "sdzx"]
        if {*deviations} <= {*found}:
            sigmas = numpy.stack([found[name] for name in deviations])
            columns |= _rotate_sigmas(sigmas, float(latitude[0]), float(longitude[0]))
        return columns, ()
    raise ValueError(
        f"RTKLIB wrote {', '.join(found)}; needed are latitude and longitude, x-ecef and so on, or e-baseline "
        "and so on"
    )


def _rotate_sigmas(sigmas: numpy.ndarray, latitude: float, longitude: float) -> dict[str, numpy.ndarray]:
    """Return standard deviations east and north, m, by name, from Earth-fixed ones at an origin (rad).

    ``sigmas``, ``(6, n)``, are of x, y, z, and signed roots of the covariances xy, yz, zx.
    """
    xx, yy, zz, xy, yz, zx = numpy.sign(sigmas) * sigmas**2
    covariance = numpy.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
    rotation = east_north_up(latitude, longitude)
    variance = numpy.einsum("ij,jkn,ik->in", rotation, covariance, rotation)
    # Covariances of small deviations may not be positive, because the file rounds them.
    east, north, _ = numpy.sqrt(numpy.maximum(variance, 1e-8))
    return {"sigma_x": east, "sigma_y": north}


# --- NMEA

SENTENCE = re.compile(rb"\$[A-Z]{2}(?:GGA|RMC|GST),[^\r\n$]*")


class _Epoch:
    def __init__(self, time: float) -> None:
        self.time = time
        self.date: datetime.date | None = None
        self.place: tuple[float, float] | None = None
        self.altitude = math.nan
        self.sigmas: tuple[float, float] | None = None
        self.positioned = False
        """Whether a sentence with a position has been read."""


def read_nmea(file: Path, most_rows: int) -> ReceiverLog:
    """Return positions and standard deviations from NMEA 0183 sentences GGA, RMC and GST, as columns.

    Args:
        file: its path; lines may begin with other text, such as a time of the logger.
        most_rows: largest number of rows.

    Raises:
        ValueError: if the file has none of these sentences, or more rows.
    """
    try:
        import pynmea2
    except ImportError as error:
        raise ValueError(f"NMEA needs one more package: {EXTRA}") from error
    epochs: list[_Epoch] = []
    good = broken = 0
    for line in _read_lines(file):
        for found in SENTENCE.findall(line):
            try:
                message = pynmea2.parse(found.decode("ascii").strip(), check=True)
                _add_sentence(message, epochs)
                good += 1
            except (ValueError, TypeError, AttributeError, pynmea2.ParseError):
                broken += 1
        check_rows(len(epochs), most_rows)
    epochs = [epoch for epoch in epochs if epoch.positioned]
    if not epochs:
        raise ValueError(f"it holds no sentence GGA or RMC that is whole, and {broken:,} broken ones")
    notes = _note_broken(broken, good, "have a wrong checksum or are no sentence")
    days = _find_dates(epochs)
    places = numpy.array([epoch.place or (math.nan, math.nan) for epoch in epochs])
    columns: dict[str, Any] = {"latitude": places[:, 0], "longitude": places[:, 1]}
    columns["time"] = [_format_time(epoch.time, day) for epoch, day in zip(epochs, days, strict=True)]
    columns["altitude"] = numpy.array([epoch.altitude for epoch in epochs])
    if any(epoch.sigmas for epoch in epochs):
        columns |= _fill_sigmas([epoch.sigmas for epoch in epochs])
    else:
        notes += (
            "no GST sentence gives the size of errors: HDOP describes the geometry of the satellites, not metres",
        )
    missing = int(numpy.isnan(places[:, 0]).sum())
    if missing:
        notes += (f"{count_of(missing, 'time')} without a position",)
    return ReceiverLog(columns, notes)


def _add_sentence(message: Any, epochs: list[_Epoch]) -> None:
    clock: datetime.time = message.timestamp
    time = 3600.0 * clock.hour + 60.0 * clock.minute + clock.second + 1e-6 * clock.microsecond
    kind = message.sentence_type
    place, altitude, sigmas = None, math.nan, None
    if kind == "GST":
        sigmas = float(message.std_dev_longitude), float(message.std_dev_latitude)
    elif message.gps_qual > 0 if kind == "GGA" else message.status == "A":
        if not message.lat or not message.lon:
            raise ValueError("the position is empty")
        place = float(message.latitude), float(message.longitude)
        if kind == "GGA" and message.altitude is not None:
            altitude = float(message.altitude) + float(message.geo_sep or 0.0)
    if not epochs or epochs[-1].time != time:
        epochs.append(_Epoch(time))
    epoch = epochs[-1]
    epoch.positioned |= kind != "GST"
    epoch.place, epoch.sigmas = epoch.place or place, epoch.sigmas or sigmas
    if not math.isnan(altitude):
        epoch.altitude = altitude
    if kind == "RMC" and isinstance(message.datestamp, datetime.date):
        epoch.date = message.datestamp


def _find_dates(epochs: Sequence[_Epoch]) -> list[datetime.date | None]:
    known = next((i for i, epoch in enumerate(epochs) if epoch.date), None)
    if known is None:
        return [None] * len(epochs)
    # At midnight the time of day decreases by more than half a day.
    steps = numpy.diff([epoch.time for epoch in epochs]) < -0.5 * DAY
    nights = numpy.append(0, numpy.cumsum(steps))
    first: Any = epochs[known].date
    found, shift = [], 0
    for epoch, night in zip(epochs, (nights - nights[known]).tolist(), strict=True):
        if epoch.date is not None:
            shift = (epoch.date - first).days - night
        found.append(first + datetime.timedelta(days=night + shift))
    return found


def _format_time(time: float, day: datetime.date | None) -> str:
    clock = (datetime.datetime.min + datetime.timedelta(seconds=time)).time().isoformat()
    return clock if day is None else f"{day.isoformat()}T{clock}Z"


def _fill_sigmas(sigmas: Sequence[tuple[float, float] | None]) -> dict[str, numpy.ndarray]:
    import pandas

    stated = pandas.DataFrame(
        [pair or (math.nan, math.nan) for pair in sigmas], columns=["sigma_x", "sigma_y"]
    )
    return {str(name): values.to_numpy() for name, values in stated.ffill().bfill().items()}


# --- ULog


def read_ulog(file: Path, most_rows: int) -> ReceiverLog:
    """Return the receiver's positions from a log of PX4 (ULog), as columns.

    Reading: ``eph`` is the standard deviation of the distance in the plane, so that of each axis is ``eph / sqrt(2)``.

    Args:
        file: its path.
        most_rows: largest number of rows.

    Raises:
        ValueError: if the log has no positions, or more rows.
    """
    log = parse_apart("ulog", file, EXTRA, rows_limit=most_rows)
    data = log["fields"]

    def column(*names: tuple[str, float]) -> Any:
        return next((data[name] * unit for name, unit in names if name in data), None)

    places = {
        "latitude": column(("latitude_deg", 1.0), ("lat", 1e-7)),
        "longitude": column(("longitude_deg", 1.0), ("lon", 1e-7)),
        "altitude": column(("altitude_ellipsoid_m", 1.0), ("alt_ellipsoid", 1e-3)),
    }
    if places["latitude"] is None or places["longitude"] is None:
        raise ValueError(
            f"its {log['topic']} has no latitude and longitude; it has {', '.join(log['names'][:20])}"
        )
    # A fix of type 2 and above has a position in the plane.
    fixed = data["fix_type"] >= 2 if "fix_type" in data else numpy.ones(len(data["timestamp"]), dtype=bool)
    columns = {"time": 1e-6 * data["timestamp"]}
    columns |= {name: numpy.where(fixed, v, math.nan) for name, v in places.items() if v is not None}
    if "eph" in data:
        sigma = data["eph"].astype(float) / math.sqrt(2.0)
        columns |= {"sigma_x": sigma, "sigma_y": sigma}
    return ReceiverLog(columns, _autopilot_notes(log["topic"], fixed))


def _autopilot_notes(topic: str, fixed: numpy.ndarray) -> tuple[str, ...]:
    source = f"positions are of {topic}, times seconds since the start of the autopilot"
    return (source, *_missing_fixes(fixed, "row"))


def _missing_fixes(fixed: numpy.ndarray, noun: str) -> tuple[str, ...]:
    return () if fixed.all() else (f"{count_of(int((~fixed).sum()), noun)} without a fix",)


# --- ArduPilot

DATAFLASH_SUFFIXES = (".bin", ".BIN")


def read_dataflash(file: Path, most_rows: int) -> ReceiverLog:
    """Return the first receiver's positions from a log of ArduPilot, as columns.

    Reading: ``HAcc`` of ``GPA`` is the standard deviation of the distance in the plane. Altitudes are above the sea:
    some tens of metres move a position in the plane by 1e-5 of its distance.

    Args:
        file: its path.
        most_rows: largest number of rows.

    Raises:
        ValueError: if the log has no positions, or more rows.
    """
    found = parse_apart("dataflash", file, EXTRA, rows_limit=most_rows)
    time, latitude, longitude, altitude, status = found["GPS"]
    fixed = status >= 2.0  # such a fix has a position in the plane
    columns = {"time": 1e-6 * time, "altitude": altitude}
    columns |= {"latitude": numpy.where(fixed, latitude, math.nan)}
    columns |= {"longitude": numpy.where(fixed, longitude, math.nan)}
    stated, accuracy = found["GPA"]
    if len(stated):
        at = numpy.maximum(numpy.searchsorted(stated, time, side="right") - 1, 0)
        columns |= dict.fromkeys(("sigma_x", "sigma_y"), accuracy[at] / math.sqrt(2.0))
    return ReceiverLog(columns, _autopilot_notes("GPS", fixed))


# --- ROS

UNKNOWN_COVARIANCE, NO_FIX = 0, -1


def read_rosbag(file: Path, most_rows: int) -> ReceiverLog:
    """Return the positions of the largest topic in a bag of ROS 1 or a storage file of ROS 2, as columns.

    The positions are ``NavSatFix``, with displacements of ``Odometry`` for a second sensor; without them, positions of
    ``Odometry`` or of poses, metres in their own frame.

    Args:
        file: its path.
        most_rows: largest number of rows.

    Raises:
        ValueError: if the bag has no positions, or more rows.
    """
    bag = parse_apart("bag", file, EXTRA, rows_limit=most_rows)
    if bag["kind"] != NAVSAT:
        return _pose_columns(bag["values"], bag["topic"])
    found = _navsat_columns(bag["values"], bag["topic"])
    return _add_odometry(found, bag["odometry"], bag["source"]) if "source" in bag else found


def _navsat_columns(values: numpy.ndarray, topic: str) -> ReceiverLog:
    time, status, latitude, longitude, altitude, east, north, covariance_type = values
    fixed = status != NO_FIX
    columns = {"time": time, "altitude": altitude}
    columns["latitude"] = numpy.where(fixed, latitude, math.nan)
    columns["longitude"] = numpy.where(fixed, longitude, math.nan)
    notes = [f"positions are of the topic {topic}"]
    if (covariance_type == UNKNOWN_COVARIANCE).any():
        notes.append("messages do not contain the size of errors")
    else:
        columns["sigma_x"] = numpy.sqrt(numpy.maximum(east, 0.0))
        columns["sigma_y"] = numpy.sqrt(numpy.maximum(north, 0.0))
    return ReceiverLog(columns, (*notes, *_missing_fixes(fixed, "message")))


def _pose_columns(values: numpy.ndarray, topic: str) -> ReceiverLog:
    time, x, y, *variances = values
    columns = {"time": time, "x": x, "y": y}
    notes = (f"positions are of the topic {topic}, metres in its own frame",)
    if not (numpy.array(variances) > 0.0).all():
        return ReceiverLog(columns, (*notes, "messages do not contain the size of errors"))
    sigma_x, sigma_y = numpy.sqrt(variances)
    return ReceiverLog({**columns, "sigma_x": sigma_x, "sigma_y": sigma_y}, notes)


def _add_odometry(log: ReceiverLog, values: numpy.ndarray, topic: str) -> ReceiverLog:
    order = numpy.argsort(values[0], kind="stable")
    time, x, y, *_ = values[:, order]
    now = log.columns["time"]
    moved = {}
    for name, axis in (("odometry_x", x), ("odometry_y", y)):
        at = numpy.interp(now, time, axis, left=math.nan, right=math.nan)
        moved[name] = numpy.append(math.nan, numpy.diff(at))
    if not numpy.isfinite(moved["odometry_x"]).any():
        return log
    note = f"the second sensor is the topic {topic}: it must not be made of the positions themselves"
    return ReceiverLog({**log.columns, **moved}, (*log.notes, note))


RECEIVER_READERS: Mapping[str, Callable[[Path, int], ReceiverLog]] = {
    ".pos": read_rtklib,
    ".nmea": read_nmea,
    ".ulg": read_ulog,
    **dict.fromkeys(DATAFLASH_SUFFIXES, read_dataflash),
    ".bag": read_rosbag,
    ".db3": read_rosbag,
    ".mcap": read_rosbag,
}
"""Readers by the suffix of a file."""


def receiver_columns(file: Path, suffix: str, most_rows: int) -> tuple["pandas.DataFrame", tuple[str, ...]]:
    """Return the columns of a receiver's log of any format as a table, and notes on the reading.

    Args:
        file: its path.
        suffix: one of ``RECEIVER_READERS``.
        most_rows: largest number of rows.

    Raises:
        ValueError: if the log cannot be read.
    """
    import pandas

    try:
        found = RECEIVER_READERS[suffix](file, most_rows)
    except Exception as error:  # libraries raise any error for a broken file
        if isinstance(error, ValueError) and not isinstance(error, UnicodeError):
            raise
        raise ValueError(
            f"it cannot be read as a log {suffix}: {str(error) or type(error).__name__}"
        ) from error
    return pandas.DataFrame(dict(found.columns)), found.notes
