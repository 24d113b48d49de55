"""Inertial navigation from rates and accelerations: alignment, aiding by fixes, and free running.

Strapdown algorithm and error-state Kalman filter are those of pyins (``filtergym[ins]``). Tables are of pandas, by
time in s: inertial measurements with the columns ``gyro_x`` to ``gyro_z`` (rad/s) and ``accel_x`` to ``accel_z``
(specific force, m/s^2) forward, right and down in the vehicle; fixes with ``lat``, ``lon`` (degrees), ``alt`` (m) and
``VN``, ``VE``, ``VD`` (m/s north, east, down).

1. **Alignment.** While the vehicle stands, the mean specific force gives roll and pitch, and the mean rates less the
   rotation of the Earth are the bias of the gyroscopes. The heading is the course of the first motion less the angle
   turned until then.
2. **Aiding.** From there fixes correct position, velocity, attitude and the biases of gyroscopes and accelerometers.
3. **Free running.** From a state of that filter, which has used no later data, the INS runs without fixes.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy

from ...filters.geodesy import east_north

LEAST_STANDSTILL = 5.0
"""Shortest standstill for the alignment, s: the bias of the gyroscopes is the mean over it."""
BEFORE_MOTION = 1.0
"""The standstill ends this long before the first speed above the limit, s."""
GRAVITY = 9.80665
"""Standard gravity, m/s^2."""
GRAVITY_TOLERANCE = 0.05
"""Relative tolerance of gravity, which varies by 0.6 % over the Earth; cheap accelerometers err by 0.2 m/s^2."""
LARGEST_TILT = 45.0
"""Largest tilt of the vehicle at rest, degrees: beyond it the axes are not forward, right and down."""
LARGEST_RATE = 0.1
"""Largest mean rate at rest, rad/s; cheap gyroscopes have a bias of 0.02 rad/s."""
SLOPES = (0.3, 3.0)
"""Limits of the slope of turns and speed changes by the fixes against those by the IMU; hills and a tilted IMU reduce
it from 1 to 0.6."""
LEVEL_SIGMA, HEADING_SIGMA = 2.0, 10.0
"""Standard deviations of the attitude after the alignment, degrees."""
STANDING_SIGMA = 0.05
"""Standard deviation of velocity, m/s, and smallest of position, m, at the standstill."""
AIDING_STEP = 0.25
"""Longest step of the prediction of the covariance, s."""
DEVIATION_STEP = 0.1
"""Relative difference below which standard deviations of fixes count as equal."""


@dataclass(frozen=True)
class InertialErrors:
    """Assumed errors of an IMU; the defaults are those of a consumer IMU in a car with a running engine."""

    gyroscope_noise: float = 0.05
    """Root density of white noise, degrees/s^0.5."""
    accelerometer_noise: float = 0.015
    """Root density of white noise, m/s^1.5."""
    gyroscope_bias: float = 0.1
    """Standard deviation of the bias left after the standstill, degrees/s."""
    accelerometer_bias: float = 0.2
    """Standard deviation of the bias, m/s^2."""
    gyroscope_walk: float = 0.0001
    """Root density of the random walk of the bias, degrees/s^1.5."""
    accelerometer_walk: float = 0.001
    """Root density of the random walk of the bias, m/s^2.5."""


@dataclass(frozen=True)
class Alignment:
    """Result of the alignment: state of the INS at the end of the standstill."""

    start: Any
    """Position, velocity and attitude, a series of pyins named by its time."""
    increments: Any
    """Later rotation vectors (rad) and velocity increments (m/s), without the gyroscopes' bias of the standstill."""


@dataclass(frozen=True)
class AidedInertial:
    """Estimates of an INS aided by fixes, at every sample of the IMU."""

    trajectory: Any
    """Latitude, longitude (degrees), altitude, velocity and attitude; a table of pyins by time."""
    biases: Any
    """Biases of gyroscopes (rad/s) and accelerometers (m/s^2), with the columns of the increments; a table by time."""
    increments: Any
    """Rotation vectors (rad) and velocity increments (m/s), without the gyroscopes' bias of the standstill."""
    innovations: Any
    """Tables of innovations over their standard deviations, by kind of measurement."""


def check_pyins() -> None:
    """Raise ValueError if pyins is not installed."""
    try:
        import pyins  # noqa: F401
    except ImportError as error:
        raise ValueError("inertial navigation needs pyins: pip install 'filtergym[ins]'") from error


def align(inertial: Any, fixes: Any, standing: float = 0.2, moving: float = 2.0) -> Alignment:
    """Return the state of an INS at the end of the standstill at the beginning of a log (:class:`Alignment`).

    Args:
        inertial: measurements of the IMU.
        fixes: positions and velocities.
        standing: speed up to which the vehicle stands, m/s.
        moving: speed from which the course is the heading, m/s.

    Raises:
        ValueError: if the log does not begin with a standstill, nothing moves after it, or the specific force at rest
            is not that of gravity on forward, right and down.
    """
    import pandas
    from pyins import earth, strapdown, transform, util

    speed = numpy.hypot(fixes.VN, fixes.VE).to_numpy()
    if not (speed > moving).any():
        raise ValueError(
            f"the heading is the course of the first motion, but no speed is above {moving:.3g} m/s"
        )
    begin = fixes.index[int(numpy.argmax(speed > standing))] - BEFORE_MOTION
    rest = inertial[inertial.index < begin]
    if not len(rest) or rest.index[-1] - rest.index[0] < LEAST_STANDSTILL:
        raise ValueError(
            f"the alignment needs a standstill of {LEAST_STANDSTILL:g} s at the beginning, but the first speed above "
            f"{standing:.3g} m/s comes {begin + BEFORE_MOTION - inertial.index[0]:.1f} s after the IMU's first "
            "measurement"
        )
    bias = rest[util.GYRO_COLS].mean()
    forward, right, down = rest[util.ACCEL_COLS].mean()
    check_rest(bias.to_numpy(), numpy.array([forward, right, down]))
    inertial = inertial[(inertial.index >= begin) & (inertial.index <= fixes.index[-1])].copy()

    if not len(inertial):
        raise ValueError("the IMU has no samples between the standstill and the last fix")
    first = fixes.iloc[int(numpy.argmax(speed > moving))]
    before = inertial.index < first.name
    turned = numpy.trapezoid(inertial.gyro_z[before] - bias.gyro_z, inertial.index[before])
    position = [numpy.interp(inertial.index[0], fixes.index, fixes[name]) for name in util.LLA_COLS]
    attitude = numpy.degrees(
        [
            numpy.arctan2(-right, -down),
            numpy.arctan2(forward, numpy.hypot(right, down)),
            numpy.arctan2(first.VE, first.VN) - turned,
        ]
    )
    start = pandas.Series([*position, 0.0, 0.0, 0.0, *attitude], util.TRAJECTORY_COLS, name=inertial.index[0])
    # At rest a gyroscope measures its bias and the rotation of the Earth.
    bias -= transform.mat_from_rph(attitude).T @ earth.rate_n(position[0])
    inertial[util.GYRO_COLS] -= bias
    return Alignment(start, strapdown.compute_increments_from_imu(inertial, "rate"))


def check_rest(rates: numpy.ndarray, force: numpy.ndarray) -> None:
    """Raise ValueError unless mean rates and forces at rest fit axes forward, right and down.

    ``rates`` are in rad/s, ``force`` in m/s^2, ``(3,)`` each.
    """
    size = float(numpy.linalg.norm(force))
    if abs(size - GRAVITY) > GRAVITY_TOLERANCE * GRAVITY:
        likely = "it looks like units of g: " if abs(size - 1.0) < 2.0 * GRAVITY_TOLERANCE else ""
        likely = likely or ("gravity was taken out of it: " if size < 1.0 else "")
        raise ValueError(
            f"the acceleration at rest is {size:.3g} m/s^2 and must be near {GRAVITY:.3g}, the reaction to gravity: "
            f"{likely}check the unit"
        )
    tilt = float(numpy.degrees(numpy.arccos(-force[2] / size)))
    if tilt > LARGEST_TILT:
        raise ValueError(
            f"the acceleration at rest is {force[0]:.1f}, {force[1]:.1f}, {force[2]:.1f} m/s^2 forward, right, down, "
            f"where a level vehicle has 0, 0, -9.8: give the mounting, (180, 0, 0) for an IMU with x forward, y left, "
            "z up"
        )
    largest = float(abs(rates).max())
    if largest > LARGEST_RATE:
        raise ValueError(
            f"a mean rate at rest is {numpy.degrees(largest):.3g} degrees/s, more than any bias of a gyroscope: check "
            "the unit, and that the vehicle stands"
        )


def check_motion(alignment: Alignment, fixes: Any, moving: float, interval: float) -> None:
    """Raise ValueError unless turns and speed changes by the IMU agree with those by the fixes.

    Turns of the course and changes of speed from fix to fix are regressed on the integrals of the down rate and of the
    forward acceleration; both slopes should be one.

    Args:
        alignment: result of :func:`align`.
        fixes: fixes with velocities.
        moving: speed from which the course is the heading, m/s.
        interval: time between the compared fixes, s.
    """
    increments = alignment.increments
    fixes = fixes[fixes.VN.notna() & fixes.VE.notna() & (fixes.index >= increments.index[0])]
    step = max(1, round(interval / float(numpy.median(numpy.diff(fixes.index)))))
    fixes = fixes.iloc[::step]
    speed = numpy.hypot(fixes.VN, fixes.VE).to_numpy()
    course = numpy.unwrap(numpy.arctan2(fixes.VE, fixes.VN))
    integrals = {
        name: numpy.diff(numpy.interp(fixes.index, increments.index, increments[name].cumsum()))
        for name in ("theta_z", "dv_x")
    }
    both = (speed[1:] > moving) & (speed[:-1] > moving)
    compared = (
        (integrals["theta_z"][both], numpy.diff(course)[both], "turn", "the unit of the rates"),
        (integrals["dv_x"], numpy.diff(speed), "change of speed", "the unit of the accelerations"),
    )
    for integral, change, what, unit in compared:
        slope, sigma = slope_of(integral, change)
        if slope + 3.0 * sigma < SLOPES[0] or slope - 3.0 * sigma > SLOPES[1]:
            raise ValueError(
                f"where the IMU measures a {what} of 1 the fixes have one of {slope:.2g}: check {unit}, the mounting "
                "(axes forward, right, down) and that both have one clock"
            )


def slope_of(x: numpy.ndarray, y: numpy.ndarray) -> tuple[float, float]:
    """Return the slope of the least-squares line through points ``(n,)``, and its standard deviation.

    The standard deviation is infinite if the slope is not determined.
    """
    if len(x) < 3 or numpy.ptp(x) == 0.0:
        return 1.0, numpy.inf
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y / (x @ x))
    return slope, float(numpy.sqrt(((y - slope * x) ** 2).sum() / (len(x) - 2) / (x @ x)))


def aid(
    alignment: Alignment,
    fixes: Any,
    position_sigma: numpy.ndarray,
    velocity_sigma: float | None,
    lever: Sequence[float] = (0.0, 0.0, 0.0),
    errors: InertialErrors | None = None,
) -> AidedInertial:
    """Aid an INS by position and velocity fixes from the end of the standstill on; return its estimates.

    Args:
        alignment: result of :func:`align`.
        fixes: positions, and velocities.
        position_sigma: standard deviation of each fix, of every axis, m, ``(n,)``.
        velocity_sigma: standard deviation of velocities, m/s; None: velocities are not used.
        lever: lever arm from the IMU to the antenna, forward, right, down, m.
        errors: errors of the IMU; default: those of a consumer IMU.
    """
    import pandas
    from pyins import filters, inertial_sensor, measurements, util

    errors = errors or InertialErrors()
    later = fixes.index > alignment.increments.index[0]
    aiding, sigma = fixes[later], position_sigma[later]
    aids = []
    classes = numpy.round(numpy.log(sigma) / DEVIATION_STEP)
    for number in numpy.unique(classes):
        alike = classes == number
        aids.append(measurements.Position(aiding[alike], numpy.median(sigma[alike]), numpy.array(lever)))
    if velocity_sigma is not None:
        moving = aiding[aiding[util.VEL_COLS].notna().all(axis=1)]
        aids.append(measurements.NedVelocity(moving, velocity_sigma, numpy.array(lever)))
    rates = numpy.radians([errors.gyroscope_bias, errors.gyroscope_noise, errors.gyroscope_walk])
    forces = errors.accelerometer_bias, errors.accelerometer_noise, errors.accelerometer_walk
    with _no_deprecations():
        found = filters.run_feedback_filter(
            alignment.start,
            position_sd=max(STANDING_SIGMA, float(position_sigma[0])),
            velocity_sd=STANDING_SIGMA,
            level_sd=LEVEL_SIGMA,
            azimuth_sd=HEADING_SIGMA,
            increments=alignment.increments,
            gyro_model=inertial_sensor.EstimationModel(*rates),
            accel_model=inertial_sensor.EstimationModel(*forces),
            measurements=aids,
            time_step=AIDING_STEP,
        )
    biases = pandas.DataFrame(
        numpy.hstack([found.gyro, found.accel]), found.gyro.index, [*util.THETA_COLS, *util.DV_COLS]
    )
    return AidedInertial(found.trajectory, biases, alignment.increments, found.innovations)


@contextmanager
def _no_deprecations() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The copy keyword is deprecated")
        yield


def free_inertial(
    navigation: AidedInertial, times: numpy.ndarray, lever: Sequence[float] = (0.0, 0.0, 0.0)
) -> Any:
    """Run the INS without fixes from the first of some times, s, on; return the antenna's positions as a table.

    Its columns are latitude, longitude (degrees) and altitude (m).
    """
    import pandas
    from pyins import strapdown, transform, util

    # From the last sample before the start, with the biases after the fix at the start.
    number = int(numpy.searchsorted(navigation.trajectory.index, times[0], side="right")) - 1
    start = navigation.trajectory.iloc[number]
    bias = navigation.biases[navigation.biases.index <= start.name].iloc[-1]
    increments = navigation.increments
    increments = increments[(increments.index > start.name) & (increments.index < times[-1] + 0.1)].copy()
    increments[bias.index] -= numpy.outer(increments.dt, bias)
    with _no_deprecations():
        track = strapdown.Integrator(start).integrate(increments)
    antenna = transform.translate_trajectory(track, lever)[util.LLA_COLS]
    columns = {name: numpy.interp(times, track.index, antenna[name]) for name in util.LLA_COLS}
    return pandas.DataFrame(columns, times)


def free_windows(
    navigation: AidedInertial,
    windows: Sequence[numpy.ndarray] | numpy.ndarray,
    beginnings: numpy.ndarray,
    site: tuple[float, float],
    lever: Sequence[float] = (0.0, 0.0, 0.0),
) -> numpy.ndarray:
    """Run the INS without fixes in windows of K times; return positions ``(E, K, 2)``, m east and north of a site.

    Args:
        navigation: the aided INS.
        windows: E times ``(K,)``, s.
        beginnings: initial position of each window, m, ``(E, 2)``; NaN: that of the aided INS.
        site: latitude and longitude, rad.
        lever: lever arm from the IMU to the antenna, forward, right, down, m.
    """
    tracks = []
    for times, beginning in zip(windows, beginnings, strict=True):
        track = tangent_plane(free_inertial(navigation, times, lever), site).T
        known = numpy.isfinite(beginning).all()
        tracks.append(track + (beginning - track[0]) if known else track)
    return numpy.array(tracks)


def tangent_plane(positions: Any, site: tuple[float, float]) -> numpy.ndarray:
    """Return a table's geodetic positions as coordinates ``(2, n)``, m east and north of a site (rad)."""
    latitude, longitude = numpy.radians(positions[["lat", "lon"]].to_numpy().T)
    return east_north(latitude, longitude, positions["alt"].to_numpy(), site)
