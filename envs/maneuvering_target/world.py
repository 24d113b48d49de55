"""The flight of ManeuveringTarget, and the radar that measures it; equations in ``filters/polar.py``."""

import math
from typing import Any, NamedTuple

from ...filters import polar
from ..contract.draws import Draws
from ..contract.faults import GaussMarkov, Outliers
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.task import Task
from ..contract.world import World
from .clutter import Clutter, ClutterState, Echo, Plots, Track
from .courses import course_of
from .parameters import ManeuveringTargetParameters
from .scans import RegularScans, Reliability, UnreliableScans


class ColouredErrors(NamedTuple):
    """Errors that last from scan to scan, along x and y, in units of the white ones' standard deviations."""

    deviation: Array
    """``(N,)``."""
    correlation_time: Array
    """s, ``(N,)``."""
    level: Array
    """In this scan, ``(2, N)``."""


class Truth(NamedTuple):
    """The aircraft."""

    scan: Array
    """Number of the current scan, ``(N,)``."""
    position: Array
    """At its time, m, ``(2, N)``."""
    velocity: Array
    """m/s, ``(2, N)``."""
    flight: Any
    """What the course has drawn; None where it draws nothing."""
    scans: Reliability | None
    """None where every scan comes on time and sees the target."""
    error_factor: Array | None = None
    """Standard deviation of this scan's errors over that of usual ones, ``(N,)``; None where there is no glint."""
    coloured: ColouredErrors | None = None
    """None where no errors are."""
    bias: Array | None = None
    """Constant errors in the same units, ``(2, N)``; None where there are none."""
    clutter: ClutterState | None = None
    """None where there are no false plots."""


class Odometry(NamedTuple):
    """What a second sensor says of the motion since the scan before: wheels and a compass, a camera, an INS."""

    displacement: Array
    """x and y, m, ``(2, N)``; zero where it says nothing."""
    available: Array
    """1 if it says something, 0 if not, ``(N,)``."""


class Measurement(NamedTuple):
    """What the radar says in a scan.

    Where there is clutter, what is said of one plot is of the nearest in the gate; a scan with none there missed the
    target.
    """

    scan: Array
    """Scans since the start of the track, ``(N,)``."""
    position: Array
    """x and y, m, ``(2, N)``; zero in a scan that missed the target, where an estimator gets NaN."""
    variance: Array
    """Variances of their errors, evaluated at the measured position, m^2, ``(2, N)``; ``range_sigma`` squared in a scan
    that missed the target. Reading: those at the true position would show it."""
    available: Array
    """1 if the scan saw the target, 0 if not, ``(N,)``."""
    interval: Array
    """s since the scan before, ``(N,)``."""
    elapsed: Array
    """s since the last scan that saw the target, or the start of the track, ``(N,)``: the interval, unless that before
    missed it."""
    odometry: Odometry | None = None
    """What a second sensor says of the motion; None except in recordings that have one. No bank reads it, and no agent
    is shown it."""
    plots: Plots | None = None
    """All plots about the track; None where there is no clutter. No bank reads them, and no agent is shown them."""


class RadarWorld(World[Task, Truth, Measurement]):
    """An aircraft on its course and a surveillance radar at the origin.

    Attributes:
        course: what the aircraft flies.
        scans: when scans come, and which of them see it.
        glint: which of them have larger errors.
        clutter: false plots beside that of the target.
    """

    own_parameters = ("flight", "track", "track_scans")
    parameters: ManeuveringTargetParameters
    received_field = "position"
    initial_normals = 4
    normals = 2

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        p = self.parameters
        self.bearing_sigma = math.radians(p.bearing_sigma)
        self.course = course_of(task)
        self.scans = (RegularScans if p.regular else UnreliableScans)(task, self.course)
        self.glint = Outliers(p.glint_probability, p.glint_factor)
        self.clutter = Clutter(task)
        if p.coloured:
            self.initial_normals, self.normals = 6, 4
        self.row_uniforms = self.scans.row_uniforms + self.glint.row_uniforms + self.clutter.row_uniforms

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw the flight; the track starts with errors of the measurement's size, equation (24)."""
        xp, p = self.xp, self.parameters
        ones = xp.ones_like(normals[0])
        flight, (position, velocity) = self.course.begin(draws, ones)
        sigma = xp.sqrt(self._variances(position))
        start = position + sigma * normals[:2]
        start_velocity = velocity + (math.sqrt(2.0) / p.sampling_interval) * sigma * normals[2:4]
        # The start is a measurement too: its variance is evaluated where it puts the target.
        variance = self._variances(start)
        diagonal = xp.concat([variance, (2.0 / p.sampling_interval**2) * variance])
        identity = xp.eye(4, dtype=diagonal.dtype, device=diagonal.device)[:, :, None]
        scans = self.scans.begin(draws, (position, velocity))
        factor = ones if p.glint_probability else None
        coloured = self._begin_coloured(draws, normals[4:]) if p.coloured else None
        bias = draws.uniform("bias", (-p.bias, p.bias), 2) if p.bias else None
        clutter = self.clutter.begin(draws, position)
        truth = Truth(0.0 * ones, position, velocity, flight, scans, factor, coloured, bias, clutter)
        return truth, Initial(xp.concat([start, start_velocity]), identity * diagonal)

    def _begin_coloured(self, draws: Draws, normals: Array) -> ColouredErrors:
        """Draw how large coloured errors are and how long they last; they are stationary from the start."""
        p = self.parameters
        deviation = draws.uniform("coloured_sigma", p.coloured_sigma)
        if p.undisturbed:
            drawn = draws.drawn.get("undisturbed")
            calm = draws.event("undisturbed", p.undisturbed) if drawn is None else drawn
            deviation = self.xp.where(calm, 0.0, deviation)
        return ColouredErrors(deviation, draws.uniform("coloured_time", p.coloured_time), deviation * normals)

    def advance(self, truth: Truth, noise: Array, feedback: Track | None) -> tuple[Truth, Measurement]:
        """Fly one scan and measure; in clutter, about the track of the filter."""
        p, number, flight = self.parameters, truth.scan + 1.0, truth.flight
        errors, uniforms = noise[:2], noise[self.normals :]
        before, glint = (truth.position, truth.velocity), uniforms[self.scans.row_uniforms :]
        scans, scan = self.scans.advance(truth.scans, flight, number, before, uniforms)
        (position, velocity), available = scan.motion, scan.available
        factor = None
        if p.glint_probability:
            factor = self.glint.amplify(self.xp.ones_like(number), glint, self.xp)
            errors = factor * errors
        coloured = truth.coloured
        if coloured is not None:
            process = GaussMarkov.sampled(
                coloured.deviation, coloured.correlation_time, scan.interval, self.xp
            )
            coloured = coloured._replace(level=process.advance(coloured.level, noise[2 : self.normals]))
            errors = errors + coloured.level
        if truth.bias is not None:
            errors = errors + truth.bias
        measured = self._measure(position, errors)
        variance = self._variances(measured)
        if not p.regular:
            seen = available > 0.0
            measured = self.xp.where(seen, measured, 0.0)
            variance = self.xp.where(seen, variance, p.range_sigma**2)
        clutter, plots, elapsed = truth.clutter, None, scan.elapsed
        if clutter is not None:
            assert feedback is not None
            clutter, plots, (measured, variance, available, elapsed) = self.clutter.advance(
                clutter,
                feedback,
                Echo(measured, available),
                scan.interval,
                uniforms[uniforms.shape[0] - self.clutter.row_uniforms :],
            )
        return (
            Truth(number, position, velocity, flight, scans, factor, coloured, truth.bias, clutter),
            Measurement(number, measured, variance, available, scan.interval, elapsed, plots=plots),
        )

    def _variances(self, position: Array) -> Array:
        """Of a measurement of a position, m^2, ``(2, N)``."""
        return polar.cartesian_variances(position, self.parameters.range_sigma, self.bearing_sigma)

    def _measure(self, position: Array, errors: Array) -> Array:
        """Measured position, m, ``(2, N)``, from errors in units of their standard deviations."""
        xp, p = self.xp, self.parameters
        if not p.polar_measurements:
            return position + xp.sqrt(self._variances(position)) * errors
        radius = xp.sqrt(position[0] ** 2 + position[1] ** 2) + p.range_sigma * errors[0]
        azimuth = xp.atan2(position[1], position[0]) + self.bearing_sigma * errors[1]
        return radius * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])

    def state(self, truth: Truth) -> Array:
        """Position and velocity, ``(4, N)``."""
        return self.xp.concat([truth.position, truth.velocity])

    def mask_missing(self, measurement: Measurement) -> Measurement:
        """Replace what was not received, of all plots too."""
        masked = super().mask_missing(measurement)
        if masked.plots is None:
            return masked
        plots = masked.plots
        position = self.xp.where(plots.available > 0.0, plots.position, math.nan)
        return masked._replace(plots=plots._replace(position=position))

    def add_recorded_fields(self, measurement: Measurement) -> Measurement:
        """Add the odometry, which is not simulated."""
        nothing = 0.0 * measurement.position
        return measurement._replace(odometry=Odometry(nothing, nothing[0]))

    def component_readings(self, measurement: Measurement) -> Array:
        """The measured position; nothing of the velocity."""
        position = self.mask_missing(measurement).position
        return self.xp.concat([position, position * math.nan])

    def component_deviations(self, measurement: Measurement) -> Array:
        """Root of the position's variance."""
        sigma = self.xp.sqrt(measurement.variance)
        return self.xp.concat([sigma, sigma * math.nan])

    def error_cost(self, error: Array) -> Array:
        """Squared position error over the squared range sigma."""
        scaled = error[:2] * (1.0 / self.parameters.range_sigma)
        return scaled[0] * scaled[0] + scaled[1] * scaled[1]

    def records(self, truth: Truth) -> dict[str, Array]:
        """In clutter, whether the plot that the filter was given is false."""
        return {} if truth.clutter is None else {"false_association": truth.clutter.false_association}

    def context(self, truth: Truth) -> dict[str, Array]:
        """What course and scans tell of themselves."""
        time = self.scans.time(truth.scans, truth.scan)
        return {
            **self.course.context(truth.flight, truth.scan, time),
            **self.scans.context(truth.scans),
            **({} if truth.coloured is None else {"coloured_sigma": truth.coloured.deviation}),
            **({} if truth.bias is None else {"bias": truth.bias}),
            **self.clutter.context(truth.clutter),
        }
