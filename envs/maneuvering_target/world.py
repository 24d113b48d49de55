"""World of ManeuveringTarget: the flight and the radar that measures it; equations in ``filters/polar.py``."""

import math
from typing import Any, ClassVar, NamedTuple

from ...filters import polar
from ...filters.data_association import Plots
from ..contract.draws import Draws
from ..contract.faults import Disturbances
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.task import Task
from ..contract.world import World
from .clutter import ReportedTrack
from .courses import Course, course_of
from .disturbances import DISTURBANCES
from .parameters import ManeuveringTargetParameters
from .scans import RegularScans, Reliability, UnreliableScans


class Truth(NamedTuple):
    """The true state of the aircraft, and of scans and disturbances."""

    scan: Array
    """Number of the current scan, ``(N,)``."""
    position: Array
    """Position at the time of the scan, m, ``(2, N)``."""
    velocity: Array
    """Velocity at the time of the scan, m/s, ``(2, N)``."""
    flight: Any
    """Constants of the flight that the course has drawn; None where it draws nothing."""
    scans: Reliability | None
    """State of the scans; None where every scan comes on time and sees the target."""
    disturbances: dict[str, Any]
    """State of each disturbance by its name, see :mod:`.disturbances`."""


class Odometry(NamedTuple):
    """Motion since the previous scan by a second sensor, such as wheels and a compass, a camera or an INS."""

    displacement: Array
    """Displacement along x and y, m, ``(2, N)``; zero without a reading."""
    available: Array
    """1 with a reading, 0 without, ``(N,)``."""


class Measurement(NamedTuple):
    """Report of the radar on a scan.

    In clutter the fields of one plot are those of the nearest in the gate; a scan without one there missed the target.
    """

    scan: Array
    """Scans since the start of the track, ``(N,)``."""
    position: Array
    """Measured x and y, m, ``(2, N)``; in a scan that missed the target zero, and NaN for an estimator."""
    variance: Array
    """Variances of their errors, evaluated at the measured position, m^2, ``(2, N)``; ``range_sigma`` squared in a scan
    that missed the target. Reading: those at the true position would reveal it."""
    available: Array
    """1 if the scan saw the target, 0 if not, ``(N,)``."""
    interval: Array
    """Time since the previous scan, s, ``(N,)``."""
    elapsed: Array
    """Time since the last scan that saw the target, or the start of the track, s, ``(N,)``: the interval, unless the
    previous scan missed it."""
    odometry: Odometry | None = None
    """Motion by a second sensor; None except in recordings that have one. No bank reads it, and no agent observes
    it."""
    plots: Plots | None = None
    """All plots around the track; None where there is no clutter. No bank reads them, and no agent observes them."""


class RadarWorld(World[Task, Truth, Measurement]):
    """World of an aircraft on its course and a surveillance radar at the origin.

    Attributes:
        course: flight path of the aircraft.
        scans: times of scans, and which of them see it.
        disturbances: further errors of the radar.
    """

    own_parameters: ClassVar[tuple[str, ...]] = ("flight", "track", "track_scans")
    parameters: ManeuveringTargetParameters
    received_field = "position"
    stated_field = "variance"
    elapsed_field = "elapsed"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        p = self.parameters
        self.bearing_sigma: float = math.radians(p.bearing_sigma)
        self.course: Course = course_of(task)
        self.scans: RegularScans = (RegularScans if p.regular else UnreliableScans)(task, self.course)
        self.disturbances: Disturbances = Disturbances.of(task, DISTURBANCES)
        self.initial_normals: int = 4 + self.disturbances.initial_normals
        self.normals: int = 2 + self.disturbances.normals
        self.row_uniforms: int = self.scans.row_uniforms + self.disturbances.row_uniforms

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw flight, scans and disturbances; return this truth, and the initial estimate (24)."""
        xp, p = self.xp, self.parameters
        ones = xp.ones_like(normals[0])
        flight, (position, velocity) = self.course.begin(draws, ones)
        sigma = xp.sqrt(self.variances(position))
        start = position + sigma * normals[:2]
        start_velocity = velocity + (math.sqrt(2.0) / p.sampling_interval) * sigma * normals[2:4]
        # The start is a measurement too: its variance is evaluated where it puts the target.
        variance = self.variances(start)
        diagonal = xp.concat([variance, (2.0 / p.sampling_interval**2) * variance])
        identity = xp.eye(4, dtype=diagonal.dtype, device=diagonal.device)[:, :, None]
        scans = self.scans.begin(draws, (position, velocity))
        states = self.disturbances.begin(draws, normals[4:], 0.0 * ones)
        states = self.disturbances.draw_further(states, draws)
        truth = Truth(0.0 * ones, position, velocity, flight, scans, states)
        return truth, Initial(xp.concat([start, start_velocity]), identity * diagonal)

    def advance(
        self, truth: Truth, noise: Array, feedback: ReportedTrack | None
    ) -> tuple[Truth, Measurement]:
        """Return the truth at the next scan and its measurement; in clutter with plots around the filter's track."""
        p, number, flight = self.parameters, truth.scan + 1.0, truth.flight
        uniforms, before = noise[self.normals :], (truth.position, truth.velocity)
        scans, scan = self.scans.advance(truth.scans, flight, number, before, uniforms)
        (position, velocity), available = scan.motion, scan.available
        further = noise[2 : self.normals], uniforms[self.scans.row_uniforms :]
        steps = self.disturbances.split_noise(number, scan.interval, *further, feedback)
        states = self.disturbances.advance(truth.disturbances, steps)
        errors = self.disturbances.change_errors(states, noise[:2])
        states, measured = self._measure(position, errors, states)
        variance = self.variances(measured)
        if not p.regular:
            seen = available > 0.0
            measured = self.xp.where(seen, measured, 0.0)
            variance = self.xp.where(seen, variance, p.range_sigma**2)
        measurement = Measurement(number, measured, variance, available, scan.interval, scan.elapsed)
        states, measurement = self.disturbances.change_measurement(states, measurement, steps)
        return Truth(number, position, velocity, flight, scans, states), measurement

    def variances(self, position: Array) -> Array:
        """Return the variances of a measurement at a position, m^2, ``(2, N)``."""
        return polar.cartesian_variances(position, self.parameters.range_sigma, self.bearing_sigma)

    def error_axes(self, position: Array) -> Array:
        """Return the displacements of the measured position by errors of one standard deviation, ``(2, 2, N)``.

        To first order; the columns are errors along x and y or, where measurements are polar, of range and azimuth.
        """
        xp, p = self.xp, self.parameters
        if not p.polar_measurements:
            x, y = xp.sqrt(self.variances(position))
            return xp.stack([xp.stack([x, 0.0 * x]), xp.stack([0.0 * y, y])])
        along = position / xp.sqrt(position[0] ** 2 + position[1] ** 2) * p.range_sigma
        across = xp.stack([-position[1], position[0]]) * self.bearing_sigma
        return xp.stack([along, across], axis=1)

    def _measure(
        self, position: Array, errors: Array, states: dict[str, Any]
    ) -> tuple[dict[str, Any], Array]:
        """Return the disturbances' states and the measured position, m, ``(2, N)``.

        ``errors`` are in standard deviations of range and azimuth, or of x and y.
        """
        xp, p = self.xp, self.parameters
        if not p.polar_measurements:
            reading = position + xp.sqrt(self.variances(position)) * errors
            return self.disturbances.change_reading(states, reading)
        radius = xp.sqrt(position[0] ** 2 + position[1] ** 2) + p.range_sigma * errors[0]
        azimuth = xp.atan2(position[1], position[0]) + self.bearing_sigma * errors[1]
        states, (radius, azimuth) = self.disturbances.change_reading(states, xp.stack([radius, azimuth]))
        return states, radius * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])

    def state(self, truth: Truth) -> Array:
        """Return the true position and velocity, ``(4, N)``."""
        return self.xp.concat([truth.position, truth.velocity])

    def mask_missing(self, measurement: Measurement) -> Measurement:
        """Return the measurement with NaN in place of every value that was not received, of all plots too."""
        masked = super().mask_missing(measurement)
        if masked.plots is None:
            return masked
        plots = masked.plots
        position = self.xp.where(plots.available > 0.0, plots.position, math.nan)
        return masked._replace(plots=plots._replace(position=position))

    def add_recorded_fields(self, measurement: Measurement) -> Measurement:
        """Return the measurement with zeros as odometry, which is not simulated."""
        nothing = 0.0 * measurement.position
        return measurement._replace(odometry=Odometry(nothing, nothing[0]))

    def component_readings(self, measurement: Measurement) -> Array:
        """Return the measured position, ``(4, N)`` with NaN for the velocity."""
        position = self.mask_missing(measurement).position
        return self.xp.concat([position, position * math.nan])

    def component_deviations(self, measurement: Measurement) -> Array:
        """Return the standard deviations of the measured position, ``(4, N)`` with NaN for the velocity."""
        sigma = self.xp.sqrt(measurement.variance)
        return self.xp.concat([sigma, sigma * math.nan])

    def error_cost(self, error: Array) -> Array:
        """Return the squared position error over ``range_sigma`` squared, ``(N,)``."""
        scaled = error[:2] * (1.0 / self.parameters.range_sigma)
        return scaled[0] * scaled[0] + scaled[1] * scaled[1]

    def records(self, truth: Truth) -> dict[str, Array]:
        """Return the values of the disturbances to record at a scan, by name."""
        return self.disturbances.records(truth.disturbances)

    def context(self, truth: Truth) -> dict[str, Array]:
        """Return the random draws of course, scans and disturbances, by name."""
        time = self.scans.time(truth.scans, truth.scan)
        return {
            **self.course.context(truth.flight, truth.scan, time),
            **self.scans.context(truth.scans),
            **self.disturbances.context(truth.disturbances),
        }
