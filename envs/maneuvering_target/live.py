"""Live measurements of ManeuveringTarget: radar plots, one at a time; columns as of :mod:`.logs`."""

import math
from collections.abc import Mapping
from typing import Any

import numpy

from ...filters import polar
from ..contract.live_input import LiveInput, LiveReader, LiveValues, Memory
from ..logs.plausibility import check_degrees
from .logs import COLUMNS, FARTHEST_RANGE, east_north, two_plot_start
from .world import Measurement, Odometry

SECOND_SENSOR = ("odometry_x", "odometry_y", "odometry_speed", "odometry_heading")
PLACE = ("latitude", "longitude", "altitude")
VALUES = ("x", "y", "range", "azimuth", "sigma_x", "sigma_y", "range_sigma", "azimuth_sigma")


def choose(condition: Any, first: Any, second: Any) -> Any:
    """Return ``numpy.where(condition, first, second)``; for a bool one of two numbers."""
    if condition.__class__ is bool:
        return first if condition else second
    return numpy.where(condition, first, second)


def is_finite(number: Any) -> Any:
    """Return whether a float, or each number of an array, is finite."""
    return math.isfinite(number) if number.__class__ is float else numpy.isfinite(number)


class PlotInput(LiveInput):
    """Converter of live radar plots, ``x`` and ``y`` or ``range`` and ``azimuth``, into measurements.

    A filter that was advised for a log of ``latitude`` and ``longitude`` accepts these instead.
    """

    counter = "scan"
    fuses = True

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start."""
        names = VALUES if self.task.recording.origin is None else (*VALUES, *PLACE)
        if self.measurement.odometry is None:
            return {name: COLUMNS[name].live_text for name in names}, {}
        at_start = {name: COLUMNS[name].live_text for name in SECOND_SENSOR[2:]}
        return {name: COLUMNS[name].live_text for name in (*names, *SECOND_SENSOR)}, at_start

    def start(self, time: Any, initial_values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the initial estimate, and a memory as if a scan had just seen the target."""
        initial, memory = super().start(
            time, {name: initial_values[name] for name in ("mean", "covariance") if name in initial_values}
        )
        velocity = {} if self.measurement.odometry is None else {"velocity": self._velocity(initial_values)}
        return initial, {**memory, "last_plot": time, **velocity}

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the measurement of a plot, with its variances at the measured position, and the memory."""
        x, y = self._position(values)
        there, position, scan = is_finite(x) & is_finite(y), numpy.array((x, y)), memory["count"] + 1.0
        measurement = Measurement(
            scan,
            choose(there, position, 0.0),
            choose(there, self._variance(position, values), self.parameters.range_sigma**2),
            there * 1.0,
            time - memory["time"],
            time - memory["last_plot"],
        )
        after = {"time": time, "count": scan, "last_plot": choose(there, time, memory["last_plot"])}
        if self.measurement.odometry is None:
            return measurement, after
        velocity = self._velocity(values)
        moved = numpy.array([self.read(values, "odometry_x"), self.read(values, "odometry_y")])
        between = 0.5 * measurement.interval * (memory["velocity"] + velocity)
        moved = numpy.where(numpy.isfinite(moved), moved, between)
        is_known = numpy.isfinite(moved).all(axis=0)
        odometry = Odometry(numpy.where(is_known, moved, 0.0), is_known.astype(float))
        return measurement._replace(odometry=odometry), {**after, "velocity": velocity}

    def _velocity(self, values: Mapping[str, Any]) -> numpy.ndarray:
        heading = numpy.radians(self.read(values, "odometry_heading"))
        return east_north(self.read(values, "odometry_speed"), heading)

    def _position(self, values: Mapping[str, Any]) -> tuple[Any, Any]:
        if "latitude" in values or "longitude" in values:
            return self._project(values)
        if "range" not in values:
            return self.read(values, "x"), self.read(values, "y")
        distance, azimuth = self.read(values, "range"), numpy.radians(self.read(values, "azimuth"))
        x, y = east_north(distance, azimuth)
        return (x, y) if self.lanes else (float(x), float(y))

    def _project(self, values: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return x and y, m, of a latitude and longitude, around the origin of the log in the filter's setup."""
        twice = [name for name in VALUES[:4] if name in values]
        if twice:
            raise ValueError(f"a plot has {twice[0]} and latitude or longitude: leave one of them out")
        latitude, longitude, altitude = (numpy.atleast_1d(self.read(values, name)) for name in PLACE)
        check_degrees("latitude", latitude, 90.0)
        check_degrees("longitude", longitude, 360.0)
        origin: Any = self.task.recording.origin
        position = origin.east_north(latitude, longitude, altitude)
        farthest = float(numpy.nanmax(numpy.hypot(*position), initial=0.0))
        if farthest > FARTHEST_RANGE:
            raise ValueError(
                f"a plot lies {farthest / 1e3:,.0f} km from latitude {origin.latitude:g}, longitude "
                f"{origin.longitude:g}, around which the log was that the filter is advised for, and the plane there "
                f"ends at {FARTHEST_RANGE / 1e3:,.0f} km: write another origin into the file"
            )
        return tuple(position) if self.lanes else tuple(position[:, 0].tolist())

    def start_from(self, first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, numpy.ndarray]:
        """Return the initial mean and covariance by name: the second plot, and the velocity between the two."""
        plots = [{name: value for name, value in plot.items() if name != "time"} for plot in (first, second)]
        position = numpy.reshape([self._position(plot) for plot in plots], (2, 2, self.tracks))
        lasted = second["time"] - first["time"]
        if not numpy.isfinite(position).all() or not 0.0 < lasted < numpy.inf:
            raise ValueError(
                f"a track starts from two plots, the second later, got {first!r:.200} and {second!r:.200}"
            )
        variance = [
            numpy.reshape(self._variance(p.reshape(2, *self.lanes), plot), p.shape)
            for p, plot in zip(position, plots, strict=True)
        ]
        begun = two_plot_start(
            numpy.moveaxis(position, -1, 0),
            numpy.moveaxis(numpy.stack(variance), -1, 0),
            numpy.array([[lasted]]),
        )
        return {name: numpy.moveaxis(values, 0, -1) for name, values in begun.items()}

    def _variance(self, position: numpy.ndarray, values: Mapping[str, Any]) -> numpy.ndarray:
        """Return the variances of a plot, m^2: those stated with it, or of the filter's setup, or the radar's."""
        p, usual = self.parameters, dict(self.task.recording.deviations)
        readings = LiveValues(self, values)
        stated = [readings.deviations("sigma_x"), readings.deviations("sigma_y")]
        distance, bearing = readings.deviations("range_sigma"), readings.deviations("azimuth_sigma")
        if "sigma_x" in usual:  # unless the plot itself states those of a radar
            radar = is_finite(distance)
            stated = [
                choose(is_finite(one) | radar, one, usual[name])
                for one, name in zip(stated, ("sigma_x", "sigma_y"), strict=True)
            ]
        distance = choose(is_finite(distance), distance, usual.get("range_sigma", p.range_sigma))
        bearing = choose(is_finite(bearing), bearing, usual.get("azimuth_sigma", p.bearing_sigma))
        variance = polar.cartesian_variances(position, distance, numpy.radians(bearing))
        both = zip(stated, variance, strict=True)
        return numpy.array([choose(is_finite(one), one * one, other) for one, other in both])


LIVE_READER = LiveReader(PlotInput)
