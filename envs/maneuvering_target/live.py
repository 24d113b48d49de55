"""Radar plots as they come, as measurements of ManeuveringTarget; columns as of :mod:`.logs`."""

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


class PlotInput(LiveInput):
    """A plot, ``x`` and ``y`` or ``range`` and ``azimuth``, or none where the scan missed the target.

    A filter whose file was advised for a log of ``latitude`` and ``longitude`` takes these in their place.
    """

    counter = "scan"
    fuses = True

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return columns of a log; of a second sensor speed and heading at the start, too."""
        names = VALUES if self.task.recording.origin is None else (*VALUES, *PLACE)
        if self.measurement.odometry is None:
            return {name: COLUMNS[name].live_text for name in names}, {}
        at_start = {name: COLUMNS[name].live_text for name in SECOND_SENSOR[2:]}
        return {name: COLUMNS[name].live_text for name in (*names, *SECOND_SENSOR)}, at_start

    def start(self, time: numpy.ndarray, given: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Start as if a scan had just seen the target."""
        initial, memory = super().start(
            time, {name: given[name] for name in ("mean", "covariance") if name in given}
        )
        velocity = {} if self.measurement.odometry is None else {"velocity": self._velocity(given)}
        return initial, {**memory, "last_plot": time, **velocity}

    def measure(self, memory: Memory, time: numpy.ndarray, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Take a plot for what it is, and its variances at the measured position."""
        position = self._position(values)
        there = numpy.isfinite(position).all(axis=0)
        scan = memory["count"] + 1.0
        measurement = Measurement(
            scan,
            numpy.where(there, position, 0.0),
            numpy.where(there, self._variance(position, values), self.parameters.range_sigma**2),
            there.astype(float),
            time - memory["time"],
            time - memory["last_plot"],
        )
        last_plot = numpy.where(there, time, memory["last_plot"])
        after = {"time": time, "count": scan, "last_plot": last_plot}
        if self.measurement.odometry is None:
            return measurement, after
        velocity = self._velocity(values)
        moved = numpy.stack([self.read(values, "odometry_x"), self.read(values, "odometry_y")])
        between = 0.5 * measurement.interval * (memory["velocity"] + velocity)
        moved = numpy.where(numpy.isfinite(moved), moved, between)
        says = numpy.isfinite(moved).all(axis=0)
        odometry = Odometry(numpy.where(says, moved, 0.0), says.astype(float))
        return measurement._replace(odometry=odometry), {**after, "velocity": velocity}

    def _velocity(self, values: Mapping[str, Any]) -> numpy.ndarray:
        """Velocity by the second sensor, ``(2, N)``, m/s; NaN where it says none."""
        heading = numpy.radians(self.read(values, "odometry_heading"))
        return east_north(self.read(values, "odometry_speed"), heading)

    def _position(self, values: Mapping[str, Any]) -> numpy.ndarray:
        if any(name in values for name in PLACE[:2]):
            return self._project(values)
        if "range" not in values:
            return numpy.stack([self.read(values, "x"), self.read(values, "y")])
        distance, azimuth = self.read(values, "range"), numpy.radians(self.read(values, "azimuth"))
        return east_north(distance, azimuth)

    def _project(self, values: Mapping[str, Any]) -> numpy.ndarray:
        """Position of latitude and longitude, around the origin of the log that the filter was advised for."""
        twice = [name for name in VALUES[:4] if name in values]
        if twice:
            raise ValueError(f"a plot has {twice[0]} and latitude or longitude: leave one of them out")
        latitude, longitude, altitude = (self.read(values, name) for name in PLACE)
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
        return position

    def start_from(self, first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, numpy.ndarray]:
        """Start a track as a log's starts: the second plot, and the difference of both over the time between them."""
        plots = [{name: value for name, value in plot.items() if name != "time"} for plot in (first, second)]
        position = numpy.stack([self._position(plot) for plot in plots])
        lasted = second["time"] - first["time"]
        if not numpy.isfinite(position).all() or not 0.0 < lasted < numpy.inf:
            raise ValueError(
                f"a track starts from two plots, the second later, got {first!r:.200} and {second!r:.200}"
            )
        variance = numpy.stack([self._variance(p, plot) for p, plot in zip(position, plots, strict=True)])
        begun = two_plot_start(
            numpy.moveaxis(position, -1, 0), numpy.moveaxis(variance, -1, 0), numpy.array([[lasted]])
        )
        return {name: numpy.moveaxis(values, 0, -1) for name, values in begun.items()}

    def _variance(self, position: numpy.ndarray, values: Mapping[str, Any]) -> numpy.ndarray:
        """Variances of a plot: as stated with it, else as the file of the filter says, else the radar's."""
        p, usual = self.parameters, dict(self.task.recording.deviations)
        readings = LiveValues(self, values)
        stated = numpy.stack([readings.deviations("sigma_x"), readings.deviations("sigma_y")])
        distance, bearing = readings.deviations("range_sigma"), readings.deviations("azimuth_sigma")
        if "sigma_x" in usual:  # unless the plot itself states those of a radar
            default = numpy.array([[usual["sigma_x"]], [usual["sigma_y"]]])
            stated = numpy.where(numpy.isfinite(stated) | numpy.isfinite(distance), stated, default)
        distance = numpy.where(numpy.isfinite(distance), distance, usual.get("range_sigma", p.range_sigma))
        bearing = numpy.where(numpy.isfinite(bearing), bearing, usual.get("azimuth_sigma", p.bearing_sigma))
        with numpy.errstate(invalid="ignore"):
            polar_variance = polar.cartesian_variances(position, distance, numpy.radians(bearing))
        return numpy.where(numpy.isfinite(stated), stated**2, polar_variance)


LIVE_READER = LiveReader(PlotInput)
