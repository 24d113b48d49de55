"""A flight given as positions in time: a user's own, or one composed of straight legs and exact turns."""

import dataclasses
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy

MOST_SAMPLES = 20_000
"""Of a flight, 33 h of scans 6 s apart; more are taken for a mistake of units or an outlier among the times."""


@dataclass(frozen=True)
class Trajectory:
    """Positions and velocities of a flight at given times.

    Args:
        time: seconds, strictly increasing, ``(n,)`` with n >= 2.
        position: x and y in metres, ``(n, 2)``.
        velocity: m/s, ``(n, 2)``; by default the slope of a cubic spline through the positions.
        name: what reports call it.

    Raises:
        ValueError: if the times do not increase, a value is not finite, or shapes do not match.
    """

    time: numpy.ndarray
    position: numpy.ndarray
    velocity: numpy.ndarray | None = None
    name: str = "trajectory"

    def __post_init__(self) -> None:
        time = numpy.asarray(self.time, dtype=float)
        if time.ndim != 1 or len(time) < 2:
            raise ValueError(f"a trajectory needs at least two times in one row, got shape {time.shape}")
        arrays = {"position": self.position}
        if self.velocity is not None:
            arrays["velocity"] = self.velocity
        checked = {"time": time}
        for name, values in arrays.items():
            checked[name] = numpy.asarray(values, dtype=float)
            if checked[name].shape != (len(time), 2):
                raise ValueError(f"{name} must have shape ({len(time)}, 2), got {checked[name].shape}")
        for name, values in checked.items():
            bad = numpy.argwhere(~numpy.isfinite(values))
            if len(bad):
                raise ValueError(f"{name} has a value that is not finite in row {bad[0][0]}")
            object.__setattr__(self, name, values)
        steps = numpy.diff(time)
        if (steps <= 0).any():
            row = int(numpy.argmax(steps <= 0)) + 1
            raise ValueError(
                f"times must increase, but row {row} has {time[row]:g} s after {time[row - 1]:g} s"
            )

    @property
    def duration(self) -> float:
        """Seconds from the first to the last time."""
        return float(self.time[-1] - self.time[0])

    def intervals(self, interval: float) -> int:
        """Number of whole sampling intervals (s) that the flight lasts.

        Raises:
            ValueError: if they are too many for an episode.
        """
        count = self.duration / interval + 1e-9
        if count > MOST_SAMPLES:
            raise ValueError(
                f"trajectory {self.name!r} lasts {self.duration:g} s, which is {count:.4g} sampling intervals "
                f"of {interval:g} s, more than {MOST_SAMPLES:,}: check that its times are seconds, "
                "or give a larger sampling_interval"
            )
        return int(count)

    def resampled(self, interval: float, count: int) -> numpy.ndarray:
        """State at ``count`` times from the start, ``interval`` apart, straight on beyond the end.

        Between the given times a cubic runs through positions and velocities (Hermite), or, without
        velocities, a cubic spline through the positions.

        Returns:
            x, y (m) and their rates (m/s), ``(4, count)``.

        Raises:
            ValueError: if that are too many samples.
        """
        if count > MOST_SAMPLES:
            raise ValueError(
                f"trajectory {self.name!r} cannot be sampled {count:,} times, more than {MOST_SAMPLES:,}: "
                "give a smaller horizon"
            )
        from scipy.interpolate import CubicHermiteSpline, CubicSpline, make_interp_spline

        if self.velocity is not None:
            curve = CubicHermiteSpline(self.time, self.position, self.velocity)
        elif len(self.time) < 4:
            curve = make_interp_spline(self.time, self.position, k=len(self.time) - 1)
        else:
            curve = CubicSpline(self.time, self.position)
        wanted = self.time[0] + interval * numpy.arange(count)
        inside = numpy.minimum(wanted, self.time[-1])
        rate = curve(inside, 1)
        position = curve(inside) + rate * (wanted - inside)[:, None]
        return numpy.concatenate([position, rate], axis=1).T


def trajectory_of(fields: Mapping[str, Any]) -> Trajectory:
    """Return the trajectory whose fields a dictionary holds.

    Raises:
        ValueError: if a field is missing or there is another, or their values are no trajectory.
    """
    known = [field.name for field in dataclasses.fields(Trajectory)]
    if not {"time", "position"} <= set(fields) <= set(known):
        raise ValueError(
            f"a trajectory as a dictionary has time, position and optionally velocity and name, got "
            f"{', '.join(map(repr, fields)) or 'nothing'}"
        )
    try:
        return Trajectory(**fields)
    except (ValueError, TypeError) as error:  # rows of different lengths, words
        raise ValueError(f"scenario as a dictionary: {error}") from error


TRAJECTORY_SUFFIXES = (".csv", ".nc")


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory from a file.

    Args:
        path: CSV with a header line, or NetCDF with variables along one dimension: ``time`` (s), ``x``, ``y``
            (m) and optionally ``vx``, ``vy`` (m/s).

    Raises:
        ValueError: if the file cannot be read, a column is missing, or a value is not a number.
    """
    columns: dict[str, numpy.ndarray]
    try:
        if path.suffix == ".nc":
            import xarray

            # From memory: a mapped file stays open where its reading fails.
            content = io.BytesIO(path.read_bytes())
            with xarray.open_dataset(content, engine="scipy", decode_times=False) as data:
                columns = {str(name): data[name].values for name in data.variables}
        else:
            with path.open(encoding="utf-8-sig") as file:
                names = [name.strip() for name in file.readline().split(",")]
                values = numpy.loadtxt(file, delimiter=",", ndmin=2)
            twice = {name for name in names if names.count(name) > 1}
            if twice:
                raise ValueError(f"it has the column {', '.join(sorted(twice))} more than once")
            if values.shape[1] != len(names):
                raise ValueError(f"{len(names)} column names but {values.shape[1]} columns")
            columns = dict(zip(names, values.T, strict=True))
    except Exception as error:  # the reader of NetCDF raises whatever a broken file makes it stumble over
        raise ValueError(f"cannot read trajectory {path}: {str(error) or type(error).__name__}") from error
    missing = [name for name in ("time", "x", "y") if name not in columns]
    if missing:
        raise ValueError(
            f"trajectory {path} lacks the column {', '.join(missing)}; it has {', '.join(columns)} and needs "
            "time, x, y and optionally vx, vy"
        )
    try:
        position = numpy.column_stack([columns["x"], columns["y"]])
        velocity = (
            numpy.column_stack([columns["vx"], columns["vy"]]) if {"vx", "vy"} <= set(columns) else None
        )
        return Trajectory(columns["time"], position, velocity, name=path.stem)
    except (ValueError, TypeError) as error:  # columns of words, of other lengths, of more dimensions
        raise ValueError(f"trajectory {path}: {error}") from error
