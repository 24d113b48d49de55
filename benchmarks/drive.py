"""A real drive as recordings of LooselyCoupledNavigation: free-running INS in windows, with RTK as truth.

    git clone https://github.com/rtklibexplorer/GNSS_IMU
    pip install 'filtergym[ins]'
    python benchmarks/drive.py GNSS_IMU --out docs/data/drive.nc --figure docs/images/drive.png

The log (BSD-3-Clause, see ``docs/data/drive_licence.txt``): a car with a consumer IMU at 100 Hz and an RTK receiver at
4 Hz, 549 s. Processing, with the strapdown algorithm and the Kalman filter of pyins (``python-ins``):

1. **Alignment** and aiding by the positions and velocities of RTK, as in ``envs/logs/strapdown.py``.
2. **Windows.** At the start of each the INS is set to velocity, attitude and biases of that filter, which has used no
   later data, and to the position of RTK; then it runs free. Windows do not overlap.
3. **Truth** is the RTK position of the antenna, 1 to 2.5 cm by its own report, unchanged.
4. **Fixes** are simulated: truth plus white noise. The solution in the log is RTK only; a receiver's own position would
   have to be computed from its raw observations.

Readings, of ``src/drive_config.py`` and ``src/convert_imu_file.py`` in the repository unless noted otherwise:

* The IMU's milliseconds are stretched to the logger's time tags, and these are 0.125 s late. With 0.16 to 0.2 s the
  innovations here would be least, and the error of the INS after 20 s 15 m in place of 16 m.
* The IMU is mounted at (180, -6.79, 185.35) degrees roll, pitch, yaw to the vehicle, the antenna 5 cm left of it.
* Accelerations are in units of 9.80665 m/s^2, rates in degrees/s. No low-pass filter is used: the integration acts as
  one.
* Heights are above sea level and used as ellipsoidal ones: 16 m change the scale by 3e-6.
* Densities of white noise are measured here, over 1 s at the standstill with the engine running; around roll
  and pitch that is ten times the value that the repository takes from the data sheet.
"""

import argparse
import json
import struct
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy
import xarray

from filtergym.envs.logs.strapdown import GRAVITY, AidedInertial, aid, align, free_windows, tangent_plane
from filtergym.envs.loosely_coupled_navigation.task import TASK

SOURCE = "https://github.com/rtklibexplorer/GNSS_IMU, commit 8235ee6c5f349db529bf43ad556a3769b346b5a1, data/drive_0708"
LICENCE = "BSD-3-Clause, Copyright (c) 2025, rtklibexplorer"
INERTIAL, FIXES = "data/drive_0708/imu_1934.csv", "data/drive_0708/gnss_1934_sf.pos"

MOUNTING = (180.0, -6.79, 185.35)
"""Roll, pitch and yaw of the IMU's axes to forward, right, down of the vehicle, degrees."""
LEVER = (0.0, -0.05, 0.0)
"""Lever arm from the IMU to the antenna, forward, right, down, m."""
DELAY = 0.125
"""Delay of the logger's time tags of the IMU, s; the repository's."""
RTK_POSITION, RTK_VELOCITY = 0.02, 0.06
"""Standard deviations of RTK's positions, m, and velocities, m/s, of each axis; close to the reported ones."""
ALIGNMENT = 30.0
"""Time from the end of the standstill to the first window, s: some turns, after which the heading is known."""
MEASUREMENTS = 80
"""Measurements in a window, 20 s; one more is recorded, for the last observation."""
PARAMETERS = {
    "axes": 2,
    "sampling_interval": 0.25,
    "receiver_intensity": 0.5,
    "drift": 0.0,
    "coloured": 1.0,
    "correlation_time": 30.0,
    "white_intensity": 0.0,
}
"""Parameters of the environment. Fixes come as often as RTK, with the environment's default deviation, 1.41 m. The
levels of the INS errors are the rounded result of :func:`fit_levels`: no constant and no white part is detectable, and
of the coloured one ``coloured^2 / correlation_time`` is better determined than each.
"""


def read_inertial(file: Path) -> Any:
    """Return rates, rad/s, and specific forces, m/s^2, forward, right and down by time, s since 1970 of GPS time.

    ``file`` has seven columns, three accelerations, three rates and milliseconds; ``FILE.tag`` has the time
    tags.

    Raises:
        ValueError: if either file has another format.
    """
    import pandas
    from pyins import transform, util

    tags = file.with_name(f"{file.name}.tag").read_bytes()
    # A header of 60 bytes, the tick at the start (not needed), its time in whole seconds and the rest of it; then pairs
    # of milliseconds since then and bytes of the file.
    if not tags.startswith(b"TIMETAG RTKLIB") or len(tags) < 84 or (len(tags) - 76) % 8:
        raise ValueError(f"{file.name}.tag contains no time tags of RTKLIB")
    _, whole, rest = struct.unpack("<IId", tags[60:76])
    last = numpy.frombuffer(tags[76:], "<u4")[-2]
    try:
        # First and last line may be cut.
        lines = file.read_text(encoding="utf-8").splitlines()[1:-1]
        table = numpy.array([line.split(",") for line in lines], dtype=float).reshape(len(lines), 7)
        understood = len(table) > 1 and numpy.isfinite(table).all()
    except ValueError:
        understood = False
    if not understood:
        raise ValueError(f"{file.name} is no table of three accelerations, three rates and milliseconds")
    since = table[:, 6] - table[0, 6]
    if (numpy.diff(since) <= 0.0).any():
        raise ValueError(f"{file.name}: milliseconds in the last column do not increase")
    time = whole + rest - DELAY + since * (1e-3 * last / since[-1])
    to_vehicle = transform.mat_from_rph(MOUNTING).T
    rates = numpy.radians(table[:, 3:6]) @ to_vehicle.T
    forces = GRAVITY * table[:, :3] @ to_vehicle.T
    return pandas.DataFrame(numpy.hstack([rates, forces]), time, [*util.GYRO_COLS, *util.ACCEL_COLS])


def read_fixes(file: Path) -> Any:
    """Return an RTKLIB solution's positions (degrees, m), velocities (m/s) and quality by time, s since 1970.

    Velocities are north, east, down, time is GPS time; quality 1 is fixed, 2 float. An empty file raises ValueError.
    """
    import pandas

    rows = [line.split() for line in file.read_text(encoding="utf-8").splitlines() if line and line[0] != "%"]
    try:
        when = [datetime.strptime(" ".join(row[:2]), "%Y/%m/%d %H:%M:%S.%f") for row in rows]
        time = [at.replace(tzinfo=UTC).timestamp() for at in when]
        values = numpy.array([row[2:18] for row in rows], dtype=float).reshape(len(rows), 16)
    except (ValueError, IndexError):
        raise ValueError(f"{file.name} is no solution of RTKLIB with velocities") from None
    if len(rows) < 2 or (numpy.diff(time) <= 0.0).any():
        raise ValueError(f"{file.name} needs at least two positions, with times that increase")
    columns = {"lat": 0, "lon": 1, "alt": 2, "VN": 13, "VE": 14, "VD": 15, "quality": 3}
    table = pandas.DataFrame({name: values[:, i] for name, i in columns.items()}, time)
    table["VD"] *= -1.0  # RTKLIB's is up
    return table


def align_ins(inertial: Any, fixes: Any) -> AidedInertial:
    """Return the INS aligned at the standstill and aided by RTK from there.

    Raises:
        ValueError: if the recording does not begin with a standstill of 5 s, or the vehicle does not move after it.
    """
    sigma = numpy.full(len(fixes), RTK_POSITION)
    return aid(align(inertial, fixes), fixes, sigma, RTK_VELOCITY, LEVER)


def recordings(inertial: Any, fixes: Any, seed: int = 0) -> xarray.Dataset:
    """Return a drive cut into recordings of LooselyCoupledNavigation.

    Raises:
        ValueError: if positions are missing, or none is left after the alignment.
    """
    T, K = PARAMETERS["sampling_interval"], MEASUREMENTS
    steps = numpy.diff(fixes.index)
    if abs(steps - T).max() > 0.01:
        raise ValueError(f"positions come every {T} s, but two are {abs(steps).max():.2f} s apart")
    navigation = align_ins(inertial, fixes)
    clock = fixes.index.to_numpy() - fixes.index[0]
    first = int(numpy.searchsorted(fixes.index, navigation.trajectory.index[0] + ALIGNMENT))
    last = int(numpy.searchsorted(fixes.index, navigation.trajectory.index[-1], side="right"))
    starts = range(first, last - K - 1, K)
    if not starts:
        raise ValueError(f"after the alignment there are not {K * T:g} s left for a recording")
    site = tuple(numpy.radians(fixes.iloc[0][["lat", "lon"]].to_numpy(dtype=float)))
    reference = tangent_plane(fixes, site).T
    truth = numpy.array([reference[start : start + K + 2] for start in starts])
    windows = [fixes.index.to_numpy()[start : start + K + 2] for start in starts]
    ins = free_windows(navigation, windows, truth[:, 0], site, LEVER)
    deviation = (PARAMETERS["receiver_intensity"] / T) ** 0.5
    noise = numpy.random.default_rng(seed).standard_normal(truth[:, 1:].shape)
    return dataset(truth, ins, truth[:, 1:] + deviation * noise, deviation, clock[list(starts)])


def dataset(
    truth: numpy.ndarray, ins: numpy.ndarray, fix: numpy.ndarray, deviation: float, starts: numpy.ndarray
) -> xarray.Dataset:
    """Return a drive's windows as an xarray dataset, in the format of a file of recordings.

    Args:
        truth: true positions from the start of each window on, m, ``(episode, 1 + time, axis)``.
        ins: positions by the INS, same shape, m.
        fix: positions by the receiver from the first measurement on, m, ``(episode, time, axis)``.
        deviation: standard deviation of the fixes, m.
        starts: starts of the windows, s since the start of the drive.
    """
    episodes, measured, axes = fix.shape
    T = PARAMETERS["sampling_interval"]
    number = numpy.broadcast_to(numpy.arange(1.0, measured + 1.0), (episodes, measured))
    each = ("episode", "time", "axis")
    found = xarray.Dataset(
        {
            "number": (each[:2], number),
            "ins": (each, ins[:, 1:], {"units": "m"}),
            "increment": (each, numpy.diff(ins, axis=1), {"units": "m"}),
            "fix": (each, fix, {"units": "m"}),
            "available": (each[:2], numpy.ones((episodes, measured))),
            "reported_deviation": (each[:2], numpy.full((episodes, measured), deviation), {"units": "m"}),
            "seconds": (each[:2], T * number, {"units": "s"}),
            "length": ("episode", numpy.full(episodes, measured - 1, dtype="int32")),
            "truth": (("episode", "time", "component"), truth[:, 1:], {"units": "m"}),
            "initial_mean": (("episode", "component"), truth[:, 0], {"units": "m"}),
            "initial_covariance": (
                ("episode", "component", "other_component"),
                numpy.zeros((episodes, axes, axes)),
                {"units": "m^2"},
            ),
        },
        {
            "recording": ("episode", [f"{start:.0f} s" for start in starts]),
            "component": [f"position_{axis}" for axis in "xyz"[:axes]],
        },
    )
    found.attrs = {
        "environment": TASK.id,
        "parameters": json.dumps(PARAMETERS),
        "source": SOURCE,
        "licence": LICENCE,
    }
    return found


def errors(recorded: xarray.Dataset) -> numpy.ndarray:
    """Return the INS position less truth, m, a row for each recording and axis, ``(n, time)``."""
    difference = (recorded["ins"].to_numpy() - recorded["truth"].to_numpy()).transpose(0, 2, 1)
    return difference.reshape(-1, difference.shape[-1])


def ins_error_covariance(time: numpy.ndarray, levels: dict[str, float]) -> numpy.ndarray:
    """Return the covariance of the INS position error at times, s, ``(n, n)``, m^2.

    It is the integral of a constant, an exponentially correlated and a white rate error.
    """
    s, t, tau = time[:, None], time, levels["correlation_time"]
    coloured = 2.0 * tau * numpy.minimum(s, t) - tau**2 * (
        1.0 - numpy.exp(-s / tau) - numpy.exp(-t / tau) + numpy.exp(-abs(s - t) / tau)
    )
    return (
        levels["drift"] ** 2 * s * t
        + levels["coloured"] ** 2 * coloured
        + levels["white_intensity"] * numpy.minimum(s, t)
    )


def fit_levels(
    recorded: xarray.Dataset, correlation_time: float | None = None
) -> tuple[dict[str, float], float]:
    """Return the maximum-likelihood levels of the INS errors by name, and the log-likelihood of each difference.

    The differences are fixes less INS positions. The receiver's noise is included: relevant are the errors that a
    filter can detect through it.

    ``correlation_time`` is in s; None searches the likeliest.
    """
    from scipy.optimize import minimize

    names = ("drift", "coloured", "correlation_time", "white_intensity")
    time = recorded["seconds"].to_numpy()[0]
    deviation = recorded["reported_deviation"].to_numpy()[0]
    seen = (recorded["fix"] - recorded["ins"]).to_numpy().transpose(0, 2, 1).reshape(-1, len(time))

    def unlikely(logarithms: numpy.ndarray) -> float:
        covariance = ins_error_covariance(time, dict(zip(names, numpy.exp(logarithms), strict=True)))
        factor = numpy.linalg.cholesky(covariance + numpy.diag(deviation**2))
        white = numpy.linalg.solve(factor, seen.T)
        density = numpy.log(numpy.diag(factor)).sum() + 0.5 * len(time) * numpy.log(2.0 * numpy.pi)
        return float((density + 0.5 * (white**2).sum() / len(seen)) / len(time))

    tries = []
    for tau in (1.0, 10.0) if correlation_time is None else (correlation_time,):
        taus = (0.1, 1e3) if correlation_time is None else (tau, tau)
        bounds = numpy.log([(1e-3, 10.0), (1e-2, 10.0), taus, (1e-4, 10.0)])
        begin = numpy.log([0.3, 0.5, tau, 0.05])
        tries.append(minimize(unlikely, begin, bounds=bounds, method="Nelder-Mead"))
    best = min(tries, key=lambda found: found.fun)
    return dict(zip(names, numpy.exp(best.x), strict=True)), -float(best.fun)


def report(recorded: xarray.Dataset) -> None:
    found = abs(errors(recorded))
    time = recorded["seconds"].to_numpy()[0]
    covariance = ins_error_covariance(time, PARAMETERS)
    print("| after, s | median, m | root mean square, m | largest, m | by the model, m |")
    print("|---:|---:|---:|---:|---:|")
    for after in (1.0, 2.0, 5.0, 10.0, 15.0, 20.0):
        at = round(after / PARAMETERS["sampling_interval"]) - 1
        if at < len(time):
            rms = numpy.sqrt((found[:, at] ** 2).mean())
            print(
                f"| {after:g} | {numpy.median(found[:, at]):.2g} | {rms:.2g} | {found[:, at].max():.2g} "
                f"| {covariance[at, at] ** 0.5:.2g} |"
            )
    for correlation_time in (None, 1.0):
        levels, likelihood = fit_levels(recorded, correlation_time)
        fitted = ", ".join(f"{name} {value:.3g}" for name, value in levels.items())
        print(f"likeliest levels: {fitted}; log-likelihood {likelihood:.3f} for each fix")


def figure(recorded: xarray.Dataset, fixes: Any, file: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    site = tuple(numpy.radians(fixes.iloc[0][["lat", "lon"]].to_numpy(dtype=float)))
    drive = tangent_plane(fixes, site)
    time = recorded["seconds"].to_numpy()[0]
    found = errors(recorded)
    picture, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    left.plot(*drive, color="black", linewidth=1, label="RTK")
    for number, track in enumerate(recorded["ins"].to_numpy()):
        track = numpy.vstack([recorded["initial_mean"].to_numpy()[number], track])
        left.plot(
            *track.T, color="tab:red", linewidth=1, label="INS alone, 20 s each" if number == 0 else None
        )
    left.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    left.legend(frameon=False)
    right.plot(time, found.T, color="tab:grey", linewidth=0.6, alpha=0.6)
    rms = numpy.sqrt((found**2).mean(axis=0))
    right.plot(time, rms, color="tab:red", label="root mean square")
    model = numpy.sqrt(numpy.diag(ins_error_covariance(time, PARAMETERS)))
    right.plot(time, model, color="tab:blue", linestyle="--", label="the model's standard deviation")
    right.set(xlabel="since the start of the window, s", ylabel="INS error of an axis, m", ylim=(-65, 65))
    right.legend(frameon=False, loc="upper left")
    picture.savefig(file, dpi=110)
    pyplot.close(picture)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkout", type=Path, help="folder of the repository GNSS_IMU")
    parser.add_argument("--out", type=Path, help="file for the recordings, NetCDF")
    parser.add_argument("--figure", type=Path, help="file for the picture, PNG")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated fixes")
    given = parser.parse_args()
    fixes = read_fixes(given.checkout / FIXES)
    recorded = recordings(read_inertial(given.checkout / INERTIAL), fixes, given.seed)
    report(recorded)
    if given.out:
        recorded.to_netcdf(given.out, engine="scipy")
    if given.figure:
        figure(recorded, fixes, given.figure)


if __name__ == "__main__":
    main()
