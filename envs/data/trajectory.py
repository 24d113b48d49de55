"""A flight given as positions in time: a user's own, or one composed of straight legs and exact turns."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy

from .scenario_data import FlightData

MOST_SAMPLES = 20_000
"""Most samples of a flight, 33 h of scans 6 s apart; more indicate a wrong unit or an outlier among the times."""


@dataclass(frozen=True)
class Trajectory(FlightData):
    """Positions and velocities of one flight at given times.

    Args:
        time: seconds, strictly increasing, ``(n,)`` with n >= 2.
        position: x and y in metres, ``(n, 2)``.
        velocity: m/s, ``(n, 2)``; by default the slope of a cubic spline through the positions.
        name: name in reports.
        flight: name of the flight that it is a piece of; empty where it is a whole one.

    Raises:
        ValueError: if the times do not increase, a value is not finite, or shapes do not match.
    """

    time: numpy.ndarray
    position: numpy.ndarray
    velocity: numpy.ndarray | None = None
    name: str = "trajectory"
    flight: str = ""

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

    def fields(self) -> dict[str, Any]:
        """Return the arrays and other constructor arguments of the trajectory, by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def duration(self) -> float:
        """Time from the first to the last position of the flight, s."""
        return float(self.time[-1] - self.time[0])

    def intervals(self, interval: float) -> int:
        """Return the number of whole sampling intervals (s) in the flight; ValueError if too many for an episode."""
        count = self.duration / interval + 1e-9
        if count > MOST_SAMPLES:
            raise ValueError(
                f"trajectory {self.name!r} lasts {self.duration:g} s, which is {count:.4g} sampling intervals "
                f"of {interval:g} s, more than {MOST_SAMPLES:,}: check that its times are seconds, "
                "or give a larger sampling_interval"
            )
        return int(count)

    def resample(self, interval: float, count: int) -> numpy.ndarray:
        """Return x, y (m) and their rates, ``(4, count)``, at times ``interval`` (s) apart from the start on.

        The flight continues straight beyond its end.

        Between the given times a cubic runs through positions and velocities (Hermite), or, without
        velocities, a cubic spline through the positions.

        Raises:
            ValueError: for too many samples.
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
    """Return a :class:`Trajectory` from a dictionary of its fields.

    Raises:
        ValueError: if a field is missing or unknown, or the values are no trajectory.
    """
    known = [field.name for field in dataclasses.fields(Trajectory)]
    if not {"time", "position"} <= set(fields) <= set(known):
        raise ValueError(
            f"a trajectory as a dictionary has time, position and optionally velocity, name and flight, got "
            f"{', '.join(map(repr, fields)) or 'nothing'}"
        )
    try:
        return Trajectory(**fields)
    except (ValueError, TypeError) as error:  # rows of different lengths, words
        raise ValueError(f"scenario as a dictionary: {error}") from error
