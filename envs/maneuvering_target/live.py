"""Radar plots as they come, as measurements of ManeuveringTarget; columns as of :mod:`.logs`."""

from collections.abc import Mapping
from typing import Any

import numpy

from ...filters import polar
from ..live_input import LiveInput, Memory
from .logs import COLUMNS
from .world import Measurement

VALUES = ("x", "y", "range", "azimuth", "sigma_x", "sigma_y", "range_sigma", "azimuth_sigma")


class PlotInput(LiveInput):
    """A plot, ``x`` and ``y`` or ``range`` and ``azimuth``, or none where the scan missed the target."""

    counter = "scan"

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return columns of a log, and nothing beside mean and covariance."""
        return {name: COLUMNS[name] for name in VALUES}, {}

    def start(self, time: numpy.ndarray, given: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Start as if a scan had just seen the target."""
        initial, memory = super().start(time, given)
        return initial, {**memory, "last_plot": time}

    def measure(self, memory: Memory, time: numpy.ndarray, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Take a plot for what it is, and its variances at the measured position."""
        self.check_names(values, self.values)
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
        return measurement, {"time": time, "count": scan, "last_plot": last_plot}

    def _position(self, values: Mapping[str, Any]) -> numpy.ndarray:
        if "range" not in values:
            return numpy.stack([self.read(values, "x"), self.read(values, "y")])
        distance, azimuth = self.read(values, "range"), numpy.radians(self.read(values, "azimuth"))
        return numpy.stack([distance * numpy.sin(azimuth), distance * numpy.cos(azimuth)])

    def _variance(self, position: numpy.ndarray, values: Mapping[str, Any]) -> numpy.ndarray:
        p = self.parameters
        stated = numpy.stack([self.read(values, "sigma_x"), self.read(values, "sigma_y")])
        distance, bearing = self.read(values, "range_sigma"), self.read(values, "azimuth_sigma")
        distance = numpy.where(numpy.isfinite(distance), distance, p.range_sigma)
        bearing = numpy.where(numpy.isfinite(bearing), bearing, p.bearing_sigma)
        with numpy.errstate(invalid="ignore"):
            polar_variance = polar.cartesian_variances(position, distance, numpy.radians(bearing))
        return numpy.where(numpy.isfinite(stated), stated**2, polar_variance)
