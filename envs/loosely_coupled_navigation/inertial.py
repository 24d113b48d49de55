"""Recordings of LooselyCoupledNavigation made from a log of a raw IMU and a log of position fixes.

The INS is aligned at a standstill and aided by the fixes. It then runs free in successive windows (see
``envs/logs/strapdown.py``), each from the velocity, attitude and biases of the aided INS. A window is an episode; its
measurements are positions of the INS, and the fixes with their reported deviations.

The environment takes the position at the start for the true one. So the INS begins at the true position if it is known,
and otherwise at that of the aided INS, whose error stays in the window.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy

from ...filters.geodesy import earth_fixed, east_north_up, geodetic
from ..data.recording import Recording
from ..logs.flight_tables import clock_seconds, numbers, read_table
from ..logs.strapdown import (
    GRAVITY,
    AidedInertial,
    InertialErrors,
    aid,
    align,
    check_motion,
    check_pyins,
    free_windows,
    tangent_plane,
)
from .task import TASK

if TYPE_CHECKING:
    import pandas

RATES, ACCELERATIONS = (tuple(f"{name}_{axis}" for axis in "xyz") for name in ("rate", "acceleration"))
RATE_UNITS = {"degrees/s": numpy.pi / 180.0, "rad/s": 1.0}
ACCELERATION_UNITS = {"m/s^2": 1.0, "g": GRAVITY}
GEODETIC, LOCAL = ("latitude", "longitude", "height"), ("x", "y", "z")
VELOCITIES = ("velocity_east", "velocity_north", "velocity_up")
LONGEST_IMU_GAP = 0.5
"""Longest gap between two measurements of the IMU, s; the motion in a longer one is unknown."""
LARGEST_IMU_INTERVAL = 0.1
"""Largest median interval of the IMU, s."""
UNEVEN = 0.1
"""Largest deviation of a fix from regular times, as a share of their interval: the filters count measurements."""
LONGEST_TRUTH_GAP = 1.5
"""Longest gap between two rows of the truth that is interpolated, s."""
DIFFERENCED_SIGMA = 0.3
"""Standard deviation of a velocity computed from positions, m/s; their distance in time is chosen for it."""
COMPARED = 2.0
"""Interval over which turns and changes of speed of fixes and IMU are compared, s."""
LARGEST_INNOVATION = 10.0
"""Largest root mean square of the aided INS's normalised innovations; about 1 where everything is right."""


def inertial_recording(
    imu: "Path | str | pandas.DataFrame",
    fixes: "Path | str | pandas.DataFrame",
    truth: "Path | str | pandas.DataFrame | None" = None,
    *,
    rate_unit: str = "degrees/s",
    acceleration_unit: str = "m/s^2",
    mounting: Sequence[float] = (0.0, 0.0, 0.0),
    lever: Sequence[float] = (0.0, 0.0, 0.0),
    delay: float = 0.0,
    site: Sequence[float] | None = None,
    sigma: float | None = None,
    velocity_sigma: float = 0.1,
    errors: InertialErrors | None = None,
    settling: float = 30.0,
    window: float = 20.0,
    name: str = "inertial",
    source: str = "",
    licence: str = "",
) -> Recording:
    """Make a recording of LooselyCoupledNavigation from a log of an IMU and a log of position fixes.

    Files are CSV, NetCDF, Parquet or JSON, tables those of pandas. Both have ``time``, seconds or dates of one clock.

    Args:
        imu: ``rate_x`` to ``rate_z`` and ``acceleration_x`` to ``acceleration_z``, gravity included: at rest 9.8 m/s^2
            upwards.
        fixes: ``latitude``, ``longitude`` (degrees) and ``height`` (m), or ``x``, ``y``, ``z`` (m east, north, up of
            ``site``); optional ``sigma`` (m, of each axis) and ``velocity_east``, ``velocity_north``, ``velocity_up``
            (m/s, all three). They come at one interval; rows may lack.
        truth: true positions in the same form; without a row within 1.5 s the truth is unknown.
        rate_unit: ``degrees/s`` or ``rad/s``.
        acceleration_unit: ``m/s^2`` or ``g``.
        mounting: roll, pitch and yaw of the IMU's axes to forward, right, down of the vehicle, degrees.
        lever: from the IMU to the antenna, forward, right, down, m.
        delay: by which times of the IMU are late, s.
        site: latitude, longitude (degrees) and height (m) of the origin of ``x``, ``y``, ``z``.
        sigma: deviation of the fixes, m, where they state none.
        velocity_sigma: deviation of their velocities, m/s.
        errors: of the IMU; default: those of a consumer IMU.
        settling: from the end of the standstill to the first window, s: some turns, after which the heading is known.
        window: in which the INS runs free, s.
        name: of the recording.
        source: where the data come from, in words.
        licence: of the data, in words.

    Raises:
        ValueError: without pyins; for columns that lack, units, axes and clocks that cannot be; without a standstill of
            5 s at the beginning; or if no window is left.
    """
    check_pyins()
    inertial, clock = read_inertial(imu, rate_unit, acceleration_unit, mounting, delay)
    positions, its_clock = read_positions(fixes, "fixes", site)
    check_clocks(inertial, clock, positions, its_clock, "fixes")
    deviations = fix_deviations(positions, sigma)
    navigation = aided_inertial(inertial, positions, deviations, velocity_sigma, lever, errors)
    times, rows = regular_times(positions.index.to_numpy(), navigation.trajectory.index[-1])
    origin = tuple(numpy.radians(positions.iloc[0][["lat", "lon"]].to_numpy(dtype=float)))
    reference = numpy.full((len(times), 2), numpy.nan)
    if truth is not None:
        true, its_clock = read_positions(truth, "truth", site)
        check_clocks(inertial, clock, true, its_clock, "truth")
        reference = interpolate(tangent_plane(true, origin).T, true.index.to_numpy(), times)
    T = float(numpy.median(numpy.diff(positions.index)))
    K = max(1, round(window / T))
    begin = int(numpy.searchsorted(times, navigation.trajectory.index[0] + settling))
    starts = numpy.arange(begin, len(times) - K - 1, K)
    if not len(starts):
        raise ValueError(
            f"after the standstill and {settling:g} s to settle there are not {K * T + T:g} s left, as a window needs"
        )
    # From the start of each window to the last observation.
    at = starts[:, None] + numpy.arange(K + 2)
    ins = free_windows(navigation, times[at], reference[starts], origin, lever)
    seconds = T * numpy.broadcast_to(numpy.arange(1.0, K + 2.0), (len(starts), K + 1))
    return Recording(
        environment=TASK.id,
        measurements=paired_measurements(
            ins, tangent_plane(positions, origin).T, deviations, rows[at[:, 1:]]
        ),
        initial={"mean": ins[:, 0], "covariance": numpy.zeros((len(starts), 2, 2))},
        seconds=seconds,
        lengths=numpy.full(len(starts), K),
        truth=None if truth is None else reference[at[:, 1:]],
        names=tuple(f"{times[start] - times[0]:.8g} s" for start in starts),
        parameters={"axes": 2, "sampling_interval": T},
        name=name,
        source=source,
        licence=licence,
        log_time=times[at[:, 1:]] if clock == "seconds" else None,
        typical={"receiver_intensity": float(numpy.median(deviations)) ** 2 * T},
    )


def paired_measurements(
    ins: numpy.ndarray, fixes: numpy.ndarray, deviations: numpy.ndarray, rows: numpy.ndarray
) -> dict[str, numpy.ndarray]:
    """Return the arrays of a ``Measurement`` by name, from INS positions and the fixes at the same times.

    Args:
        ins: positions of the INS from the start on, m, ``(E, 1 + K, 2)``.
        fixes: positions of all fixes, m, ``(n, 2)``.
        deviations: those of the fixes, m, ``(n,)``.
        rows: the fix at each measurement, ``(E, K)``; -1: none.
    """
    there = rows >= 0
    return {
        "number": numpy.broadcast_to(numpy.arange(1.0, rows.shape[1] + 1.0), rows.shape),
        "ins": ins[:, 1:],
        "increment": numpy.diff(ins, axis=1),
        "fix": numpy.where(there[..., None], fixes[rows], 0.0),
        "available": there.astype(float),
        "reported_deviation": numpy.where(there, deviations[rows], numpy.median(deviations)),
    }


# --- the files


def read_columns(
    data: Any, what: str, needed: Sequence[str], optional: Sequence[str] = ()
) -> tuple["pandas.DataFrame", str]:
    """Return columns in a file or table as numbers, indexed by time, s, and the kind of clock of its times.

    Args:
        data: a file or a table.
        what: its name in messages.
        needed: columns beside ``time``.
        optional: further ones.

    Raises:
        ValueError: if one lacks, or times do not increase.
    """
    import pandas

    known = ("time", *needed, *optional)
    if isinstance(data, pandas.DataFrame):
        table = data.rename(columns=lambda column: str(column).lower())
    else:
        try:
            table = read_table(Path(data), known).columns
        except ValueError as error:
            raise ValueError(f"{data}: {error}") from error
    lacking = [column for column in ("time", *needed) if column not in table]
    if lacking:
        raise ValueError(f"the {what} lack the column {', '.join(lacking)}; they need {', '.join(known)}")
    if len(table) < 2:
        raise ValueError(f"the {what} need at least two rows, got {len(table)}")
    table = table.reset_index(drop=True)
    clock, time = clock_seconds(table["time"])
    late = numpy.diff(time) <= 0.0
    if late.any():
        row = int(late.argmax())
        raise ValueError(
            f"times of the {what} must increase, but row {row + 1} has not a later one than row {row}"
        )
    found = {column: numbers(column, table[column]).to_numpy() for column in known[1:] if column in table}
    return pandas.DataFrame(found, time), clock


def read_inertial(
    data: Any, rate_unit: str, acceleration_unit: str, mounting: Sequence[float], delay: float
) -> tuple["pandas.DataFrame", str]:
    """Return an IMU's rates and specific forces forward, right and down as a table, and the clock of its times.

    Raises:
        ValueError: for unknown units, empty cells, or measurements too far apart.
    """
    import pandas
    from pyins import transform, util

    for unit, units in ((rate_unit, RATE_UNITS), (acceleration_unit, ACCELERATION_UNITS)):
        if unit not in units:
            raise ValueError(f"the unit must be {' or '.join(units)}, got {unit!r}")
    table, clock = read_columns(data, "measurements of the IMU", (*RATES, *ACCELERATIONS))
    empty = ~numpy.isfinite(table.to_numpy()).all(axis=1)
    if empty.any():
        raise ValueError(
            f"row {int(empty.argmax())} of the IMU has a cell without a number: leave the row out"
        )
    steps = numpy.diff(table.index)
    if numpy.median(steps) > LARGEST_IMU_INTERVAL:
        raise ValueError(
            f"measurements of the IMU are {numpy.median(steps):g} s apart and may be {LARGEST_IMU_INTERVAL:g} s: is "
            "their time in milliseconds?"
        )
    if steps.max() > LONGEST_IMU_GAP:
        raise ValueError(
            f"the IMU has a gap of {steps.max():.2f} s after row {int(steps.argmax())}: cut the logs there"
        )
    to_vehicle = transform.mat_from_rph(mounting).T
    rates = RATE_UNITS[rate_unit] * table[[*RATES]].to_numpy() @ to_vehicle.T
    forces = ACCELERATION_UNITS[acceleration_unit] * table[[*ACCELERATIONS]].to_numpy() @ to_vehicle.T
    columns = [*util.GYRO_COLS, *util.ACCEL_COLS]
    return pandas.DataFrame(numpy.hstack([rates, forces]), table.index - delay, columns), clock


def read_positions(data: Any, what: str, site: Sequence[float] | None) -> tuple["pandas.DataFrame", str]:
    """Return latitude, longitude (degrees), altitude (m) and further columns as a table, and its clock.

    Raises:
        ValueError: if positions are not whole, of neither kind, or metres without a site.
    """
    import pandas

    optional = ("sigma", *VELOCITIES)
    table, clock = read_columns(data, what, (), (*GEODETIC, *LOCAL, *optional))
    names = GEODETIC if "latitude" in table else LOCAL
    lacking = [column for column in names if column not in table]
    if lacking:
        raise ValueError(
            f"the {what} lack the column {', '.join(lacking)}; they need {', '.join(GEODETIC)} or {', '.join(LOCAL)}"
        )
    table = table[numpy.isfinite(table[[*names]].to_numpy()).all(axis=1)]
    if len(table) < 2:
        raise ValueError(f"the {what} need at least two whole positions, got {len(table)}")
    coordinates = table[[*names]].to_numpy().T
    if names is LOCAL:
        if site is None:
            raise ValueError(
                f"the {what} are in metres: give the site, latitude, longitude and height of their origin"
            )
        coordinates = geodetic_of_local(coordinates, site)
    elif abs(coordinates[0]).max() > 90.0 or abs(coordinates[1]).max() > 360.0:
        raise ValueError(
            f"latitude and longitude of the {what} must be degrees, got {coordinates[:2].max():g}"
        )
    found = pandas.DataFrame(dict(zip(("lat", "lon", "alt"), coordinates, strict=True)), table.index)
    if all(column in table for column in VELOCITIES):
        east, north, up = table[[*VELOCITIES]].to_numpy().T
        found["VN"], found["VE"], found["VD"] = north, east, -up
    if "sigma" in table:
        found["sigma"] = table["sigma"]
    return found, clock


def geodetic_of_local(coordinates: numpy.ndarray, site: Sequence[float]) -> numpy.ndarray:
    """Return latitude, longitude (degrees) and height (m), ``(3, n)``, of points east, north and up of a site.

    ``site`` is its latitude and longitude, degrees, and height, m.
    """
    latitude, longitude, height = numpy.radians(site[0]), numpy.radians(site[1]), site[2]
    away = east_north_up(latitude, longitude).T @ coordinates
    found = geodetic(earth_fixed(latitude, longitude, height)[:, None] + away)
    return numpy.concatenate([numpy.degrees(found[:2]), found[2:]])


def check_clocks(inertial: Any, clock: str, other: Any, its_clock: str, what: str) -> None:
    """Raise ValueError if the IMU and another log have different clocks or do not overlap in time."""
    if clock != its_clock:
        raise ValueError(
            f"times of the IMU are {clock} and those of the {what} {its_clock}: use the same form in both"
        )
    if other.index[0] > inertial.index[-1] or other.index[-1] < inertial.index[0]:
        raise ValueError(
            f"the IMU is of {inertial.index[0]:.1f} to {inertial.index[-1]:.1f} s and the {what} of "
            f"{other.index[0]:.1f} to {other.index[-1]:.1f} s: they need one clock"
        )


# --- alignment of times


def fix_deviations(fixes: Any, sigma: float | None) -> numpy.ndarray:
    """Return the standard deviations of fixes, m, ``(n,)``, from their column, else ``sigma``."""
    stated = fixes["sigma"].to_numpy() if "sigma" in fixes else numpy.full(len(fixes), numpy.nan)
    deviations = numpy.where(numpy.isfinite(stated), stated, numpy.nan if sigma is None else sigma)
    if not (deviations > 0.0).all():
        raise ValueError(
            "every fix needs a standard deviation above zero: a column sigma (m), or sigma=3.0 for those without"
        )
    return deviations


def differenced_velocities(fixes: Any, deviations: numpy.ndarray) -> Any:
    """Return the fixes with velocities computed from position differences.

    The positions are so far apart in time that the velocities have the deviation ``DIFFERENCED_SIGMA``.
    """
    time = fixes.index.to_numpy()
    half = difference_half(deviations)
    after = numpy.clip(time + half, time[0], time[-1])
    before = numpy.clip(time - half, time[0], time[-1])
    site = tuple(numpy.radians(fixes.iloc[0][["lat", "lon"]].to_numpy(dtype=float)))
    east, north = (
        (numpy.interp(after, time, values) - numpy.interp(before, time, values)) / (after - before)
        for values in tangent_plane(fixes, site)
    )
    return fixes.assign(VN=north, VE=east, VD=0.0)


def difference_half(deviations: numpy.ndarray) -> float:
    """Return half of the time, s, between two fixes whose difference gives a velocity of ``DIFFERENCED_SIGMA``."""
    return float(numpy.median(deviations)) / DIFFERENCED_SIGMA / 2.0**0.5


def aided_inertial(
    inertial: Any,
    fixes: Any,
    deviations: numpy.ndarray,
    velocity_sigma: float,
    lever: Sequence[float],
    errors: InertialErrors | None,
) -> AidedInertial:
    """Return the INS aligned at the standstill and aided by fixes, after a check against them.

    Raises:
        ValueError: if it cannot be aligned, or does not follow the fixes.
    """
    measured = "VN" in fixes and bool(fixes["VN"].notna().any())
    known = fixes if measured else differenced_velocities(fixes, deviations)
    noise = velocity_sigma if measured else DIFFERENCED_SIGMA
    # Of the noise alone the speed is above five of its deviations once in 270,000 fixes.
    moving = max(2.0, 10.0 * noise)
    start = align(inertial, known, max(0.2, 5.0 * noise), moving)
    check_motion(start, known, moving, COMPARED if measured else COMPARED + 2.0 * difference_half(deviations))
    navigation = aid(start, known, deviations, velocity_sigma if measured else None, lever, errors)
    innovation = numpy.sqrt((navigation.innovations["Position"].to_numpy() ** 2).mean())
    if not innovation < LARGEST_INNOVATION:
        raise ValueError(
            f"the INS does not follow the fixes: innovations are {innovation:.3g} of their deviations in the root mean "
            "square; check sigma, and the delay between the clocks"
        )
    return navigation


def regular_times(time: numpy.ndarray, end: float) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return the regular times of measurements, s, and the index of the fix at each, -1 where there is none.

    Args:
        time: of the fixes, s.
        end: of the INS, s.

    Raises:
        ValueError: if fixes do not come at one interval.
    """
    T = float(numpy.median(numpy.diff(time)))
    steps = numpy.diff(time) / T
    whole = numpy.maximum(numpy.round(steps), 1.0)
    off = abs(steps - whole) > UNEVEN * whole
    if off.any():
        row = int(off.argmax())
        raise ValueError(
            f"fixes come every {T:.3g} s, but two are {steps[row] * T:.3g} s apart after row {row}: the filters of "
            "this environment count measurements, so resample them"
        )
    place = numpy.concatenate([[0], numpy.cumsum(whole)]).astype(int)
    rows = numpy.full(place[-1] + 1, -1)
    rows[place] = numpy.arange(len(time))
    times = numpy.interp(numpy.arange(len(rows)), place, time)
    there = times <= end
    return times[there], rows[there]


def interpolate(values: numpy.ndarray, time: numpy.ndarray, times: numpy.ndarray) -> numpy.ndarray:
    """Return values ``(n, A)`` interpolated at other times; NaN in long gaps and beyond the ends."""
    found = numpy.stack(
        [numpy.interp(times, time, column, numpy.nan, numpy.nan) for column in values.T], axis=1
    )
    right = numpy.clip(numpy.searchsorted(time, times), 1, len(time) - 1)
    apart = (
        (time[right] - time[right - 1] > LONGEST_TRUTH_GAP)
        & (times != time[right])
        & (times != time[right - 1])
    )
    found[apart] = numpy.nan
    return found
