"""Positions that a vehicle's own filter estimated in flight, from the log of an autopilot.

* PX4, ``.ulg``: metres north and east of a reference, of ``vehicle_local_position``, the estimate that flew, or of the
  first ``estimator_local_position``.
* ArduPilot, ``.bin``: metres north and east of ``ORGN``, of ``XKF1`` (EKF3) or ``NKF1`` (EKF2), the first core.

Both autopilots project latitude and longitude to metres on a sphere. This module inverts the projection, so that fixes
and estimates can be put into one plane on the ellipsoid.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy

from ...filters.geodesy import PlaneOrigin
from ..data.foreign_files import parse_apart
from .flight_tables import MOST_ROWS
from .receiver_logs import DATAFLASH_SUFFIXES, EXTRA

PX4_RADIUS = 6371000.0
"""Radius of PX4's sphere, m: ``CONSTANTS_RADIUS_OF_EARTH``."""
ARDUPILOT_RADIUS = 6378100.0
"""Radius of ArduPilot's sphere, m: ``LATLON_TO_M`` is 0.011131884502145 m for 1e-7 degrees."""
LONGEST_GAP = 1.0
"""Longest time between two estimates for interpolation, s."""


class OnboardTrack(NamedTuple):
    """Positions by time that a vehicle's own filter estimated, and their source."""

    source: str
    """Filter, autopilot and topic, as text."""
    time: numpy.ndarray
    """Times by the clock of the log, s, increasing, ``(n,)``."""
    latitude: numpy.ndarray
    """Latitude, degrees, ``(n,)``."""
    longitude: numpy.ndarray
    """Longitude, degrees, ``(n,)``."""

    def at(self, time: numpy.ndarray, origin: PlaneOrigin) -> numpy.ndarray:
        """Return positions east and north of an origin at times, m, ``(..., 2)``; NaN in gaps over ``LONGEST_GAP``."""
        place = origin.east_north(self.latitude, self.longitude, numpy.full(len(self.time), numpy.nan))
        after = numpy.clip(numpy.searchsorted(self.time, time), 1, len(self.time) - 1)
        near = self.time[after] - self.time[after - 1] <= LONGEST_GAP
        axes = [numpy.interp(time, self.time, axis, left=numpy.nan, right=numpy.nan) for axis in place]
        return numpy.where(near[..., None], numpy.stack(axes, axis=-1), numpy.nan)


def read_onboard(path: Any) -> OnboardTrack | None:
    """Return the track that the vehicle's own filter estimated, from an autopilot's log; None if there is none.

    Raises:
        ValueError: if the log of an autopilot cannot be read.
    """
    file = Path(path) if isinstance(path, str | Path) else Path()
    if not file.is_file() or file.suffix not in (".ulg", *DATAFLASH_SUFFIXES):
        return None
    parser = "ulog" if file.suffix == ".ulg" else "dataflash"
    found = parse_apart(parser, file, EXTRA, rows_limit=MOST_ROWS, onboard=True)
    if not found:
        return None
    track = _px4_track(**found) if parser == "ulog" else _ardupilot_track(**found)
    return track if track is not None and len(track.time) > 1 else None


def _px4_track(topic: str, fields: dict[str, numpy.ndarray]) -> OnboardTrack:
    """Return the track of a PX4 log: the inverse of its azimuthal equidistant ``map_projection``."""
    valid = fields.get("xy_valid", numpy.ones(len(fields["timestamp"]))) > 0
    # Time of the sample of the estimate; its publication is some ms later.
    time, x, y, latitude, longitude = (
        fields[name][valid].astype(float)
        for name in (
            "timestamp_sample" if "timestamp_sample" in fields else "timestamp",
            "x",
            "y",
            "ref_lat",
            "ref_lon",
        )
    )
    phi, angle = numpy.radians(latitude), numpy.hypot(x, y) / PX4_RADIUS
    part = numpy.sinc(angle / numpy.pi) / PX4_RADIUS  # sine over angle, and its limit
    north = numpy.arcsin(numpy.cos(angle) * numpy.sin(phi) + x * part * numpy.cos(phi))
    east = numpy.arctan2(y * part, numpy.cos(phi) * numpy.cos(angle) - numpy.sin(phi) * x * part)
    source = f"EKF2 of PX4, {topic}"
    return _in_order(source, 1e-6 * time, numpy.degrees(north), longitude + numpy.degrees(east))


def _ardupilot_track(topic: str, estimates: numpy.ndarray, origins: numpy.ndarray) -> OnboardTrack | None:
    """Return the track of an ArduPilot log: metres north and east added to the last origin.

    Estimates ``(3, n)`` and origins ``(4, m)`` have times in us; origins of type 0 are those of the filter.
    """
    origins = origins[:, origins[1] == 0.0]
    if not origins.size:
        return None
    time, north, east = estimates
    at = numpy.maximum(numpy.searchsorted(origins[0], time, side="right") - 1, 0)
    metres = numpy.radians(ARDUPILOT_RADIUS)
    latitude = origins[2][at] + north / metres
    across = metres * numpy.cos(numpy.radians(0.5 * (latitude + origins[2][at])))
    source = f"{'EKF3' if topic == 'XKF1' else 'EKF2'} of ArduPilot, {topic}"
    return _in_order(source, 1e-6 * time, latitude, origins[3][at] + east / across)


def _in_order(
    source: str, time: numpy.ndarray, latitude: numpy.ndarray, longitude: numpy.ndarray
) -> OnboardTrack:
    whole = numpy.isfinite([time, latitude, longitude]).all(axis=0)
    latest = numpy.maximum.accumulate(numpy.append(-numpy.inf, numpy.where(whole, time, -numpy.inf)))[:-1]
    whole &= time > latest
    return OnboardTrack(source, time[whole], latitude[whole], longitude[whole])
