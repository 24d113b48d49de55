"""World of RadarEsmTracking: target, radar and ESM station."""

import math
from typing import Any, NamedTuple

import numpy

from ...filters import class_fusion
from ...filters.ordered_sums import ordered_sum
from ..contract.draws import Draws, category, draw_between
from ..contract.faults import Disturbance, Disturbances, GaussMarkov, Glint, draw_undisturbed
from ..contract.observation import Array
from ..contract.world import World
from .parameters import RadarEsmTrackingParameters
from .problem import RadarEsmProblem

DISTURBANCES: tuple[type[Disturbance], ...] = (Glint,)
"""Disturbances of the radar other than correlated and coloured errors; add new ones last to keep episodes equal."""


class Truth(NamedTuple):
    """True state of the target, of its emitters and of the radar errors."""

    scan: Array
    """Number of the current scan, integer, ``(N,)``; 0 starts the track."""
    motion: Array
    """Range (m), range rate (m/s), range acceleration (m/s^2), ``(3, N)``."""
    target_class: Array
    """Index of the class now, ``(N,)``."""
    emitter_type: Array
    """Index of the type now, ``(N,)``; of no effect where types are redrawn."""
    change_scan: Array
    """Scan from which the next class governs, ``(N,)``."""
    next_class: Array
    """Index of the class after the change, ``(N,)``."""
    next_type: Array
    """Index of the type after the change, ``(N,)``."""
    radiating: Array
    """Whether the target radiates, booleans ``(N,)``."""
    other_class: Array
    """Class of the second emitter, ``(N,)``."""
    other_type: Array
    """Emitter type of the second emitter, ``(N,)``."""
    separation: Array
    """Bearing of the second emitter minus the target's, degrees, ``(N,)``."""
    silence_start: Array
    """Probability at each look that the target falls silent, ``(N,)``."""
    silence_end: Array
    """Probability at each look that a silent target radiates again, ``(N,)``."""
    second_emitter: Array
    """Probability that the ESM receives the second emitter instead of the target, ``(N,)``."""
    radar_coloured: Array
    """Stationary standard deviation of the radar's coloured errors over that of the white ones, ``(N,)``."""
    radar_decay: Array
    """Factor of the coloured errors from one scan to the next, ``(N,)``."""
    radar_kick: Array
    """Standard deviation of the innovations of the coloured errors, in the same units, ``(N,)``."""
    radar_correlation: Array
    """Correlation of the white errors of range and range rate, ``(N,)``."""
    radar_error: Array
    """Coloured errors of range and range rate now, in the same units, ``(2, N)``."""
    disturbances: dict[str, Any]
    """States of the disturbances of the world, by their names."""


class Measurement(NamedTuple):
    """Measurement of radar and ESM at one scan; the radar measures at every scan."""

    scan: Array
    """Scans since the start of the track, integer, ``(N,)``; one scan is ``sampling_interval`` seconds."""
    radar: Array
    """Range (m) and range rate (m/s), ``(2, N)``; errors of ``range_sigma`` and ``range_rate_sigma``."""
    looked: Array
    """Whether the ESM looked at this scan, booleans ``(N,)``; it may have received nothing."""
    decision: Array
    """Index of the emitter type that the ESM decides for, or the number of types without a decision, ``(N,)``."""
    bearing_difference: Array
    """Radar bearing minus ESM bearing, degrees, wrapped to [-180, 180), ``(N,)``; 0 without a decision, where
    an estimator gets NaN. Reading: the difference and not the two bearings, because each is measured from the true
    bearing here."""


class Start(NamedTuple):
    """Initial estimate given to every filter, with the first measurement."""

    mean: Array
    """First measured range (m) and range rate (m/s), acceleration 0, ``(3, N)``."""
    covariance: Array
    """Covariance of the radar, and of the acceleration of a target of unknown class, ``(3, 3, N)``."""
    first: Measurement
    """Measurement of scan 0; the estimate does not include its ESM decision."""


class RadarEsmWorld(World[RadarEsmProblem, Truth, Measurement]):
    """World of a target of one class on one range channel, measured by a radar and an ESM station."""

    parameters: RadarEsmTrackingParameters
    reading_field = "radar"

    def __init__(self, task: RadarEsmProblem) -> None:
        super().__init__(task)
        p, constant = self.parameters, task.constant
        self.disturbances: Disturbances = Disturbances.of(task, DISTURBANCES)
        self.radar_is_coloured: bool = p.radar_coloured[1] > 0.0
        further = 2 if self.radar_is_coloured else 0
        self.own_initial_normals, self.own_normals = 5 + further, 7 + further
        """Numbers of normal variables before those of the disturbances."""
        self.initial_normals: int = self.own_initial_normals + self.disturbances.initial_normals
        self.normals: int = self.own_normals + self.disturbances.normals
        self.row_uniforms: int = 4 + self.disturbances.row_uniforms
        models, start = task.design_models(p)
        # Q = L L^T; diagonal where the noise is on the acceleration only, which Cholesky cannot factor.
        root = numpy.sqrt if p.process_noise == "acceleration" else numpy.linalg.cholesky
        roots = numpy.stack([root(Q) for Q in numpy.moveaxis(models.Q, -1, 0)], axis=-1)
        lower = [roots[i, j] for i in range(3) for j in range(i + 1)]
        self.motion_table: Array = constant(numpy.stack([*models.Phi[:, 2], *lower]))
        """Response to the acceleration and root of the noise, a column for each class."""
        self.acceleration_sigma: Array = constant(p.acceleration_sigma)
        self.start_covariance: Array = constant(start @ numpy.array(p.prior))[..., None]
        self.cost_factors: Array = constant(
            [[1.0 / scale] for scale in (p.range_scale, p.range_rate_scale, p.acceleration_scale)]
        )
        # Thresholds of categories, a column for each class or type, which lanes index.
        known = numpy.eye(task.classes)
        share = p.prior if p.true_class == "random" else known[p.class_names.index(p.true_class)]
        self.class_thresholds: Any = _thresholds([share])[:, 0].tolist()
        self.type_thresholds: Array = constant(_thresholds(p.composition))
        self.decision_thresholds: Array = constant(_thresholds(p.recognition))
        self.never: float = (p.horizon + 2) * p.sampling_interval
        """Time of a change that does not happen, s."""
        self.class_change: tuple[float, float] = p.class_change or (self.never, self.never)

    # --- the target and its emissions

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Start]:
        """Draw target, class and disturbances; return this truth, and the initial estimate from scan 0."""
        xp, p, own = self.xp, self.parameters, self.own_initial_normals
        distance = draws.uniform("initial_range", p.initial_range)
        closing_speed = draws.uniform("closing_speed", p.closing_speed)
        target_class = draws.category("target_class", self.class_thresholds)
        emitter_type = draws.category("emitter_type", self._types_of(target_class))
        next_class = self._another_class(draws, "next_class", target_class)
        next_type = draws.category("next_type", self._types_of(next_class))
        change = draws.uniform("class_change", self.class_change)
        other_class = self._another_class(draws, "other_class", target_class)
        other_type = draws.category("other_type", self._types_of(other_class))
        separation = draws.uniform("separation", p.second_emitter_separation)
        side = xp.where(draws.event("other_side", 0.5), -1.0, 1.0)
        radiating = draws.unit("radiating")
        zero = 0.0 * distance
        silence_start = zero + draw_between(draws.uniform, "silence_start", p.silence_start)
        silence_end = zero + draw_between(draws.uniform, "silence_end", p.silence_end)
        second_emitter = zero + draw_between(
            draws.uniform, "second_emitter_probability", p.second_emitter_probability
        )
        coloured = zero + draw_between(draws.uniform, "radar_coloured", p.radar_coloured)
        lasting = zero + draw_between(draws.log_uniform, "radar_correlation_time", p.radar_correlation_time)
        correlation = zero + draw_between(draws.uniform, "radar_correlation", p.radar_correlation)
        if p.class_change_probability < 1.0:
            changes = draws.event("class_changes", p.class_change_probability)
            change = xp.where(changes, change, self.never)
        calm = draw_undisturbed(draws, p)
        if calm is not None:
            change = xp.where(calm, self.never, change)
            second_emitter, coloured, correlation = (
                xp.where(calm, 0.0, x) for x in (second_emitter, coloured, correlation)
            )
        wandering = GaussMarkov.sampled(coloured, lasting, p.sampling_interval, xp)
        acceleration = xp.take(self.acceleration_sigma, target_class, axis=0) * normals[0]
        truth = Truth(
            scan=xp.zeros_like(target_class),
            motion=xp.stack([distance, -closing_speed, acceleration]),
            target_class=target_class,
            emitter_type=emitter_type,
            change_scan=xp.astype(xp.ceil(change / p.sampling_interval), xp.int64),
            next_class=next_class,
            next_type=next_type,
            radiating=radiating * (silence_start + silence_end) < silence_end,
            other_class=other_class,
            other_type=other_type,
            separation=side * separation,
            silence_start=silence_start,
            silence_end=silence_end,
            second_emitter=second_emitter,
            radar_coloured=coloured,
            radar_decay=wandering.decay,
            radar_kick=wandering.kick,
            radar_correlation=correlation,
            radar_error=(coloured if self.radar_is_coloured else 0.0) * normals[own - 2 : own],
            disturbances=self.disturbances.draw_further(
                self.disturbances.begin(draws, normals[own:], zero), draws
            ),
        )
        truth, first = self._measure(truth, normals[1:3], normals[3:5], draws.unit("first_intercept", 3))
        mean = xp.stack([first.radar[0], first.radar[1], zero])
        return truth, Start(mean, self.start_covariance + zero, first)

    def _types_of(self, target_class: Array) -> Array:
        return self.xp.take(self.type_thresholds, target_class, axis=1)

    def _another_class(self, draws: Draws, name: str, target_class: Array) -> Array:
        step = draws.integer(name, (1, self.task.classes - 1))
        return (target_class + self.xp.astype(step, self.xp.int64)) % self.task.classes

    def advance(self, truth: Truth, noise: Array, feedback: None) -> tuple[Truth, Measurement]:
        """Return the truth at the next scan, after a possible class change and silence, and the measurement.

        A row of noise: 3 normal numbers for the motion, 2 for the radar, 2 for the bearings, 2 for the radar's coloured
        errors if there are any; uniform ones for the type, the decision, the source and the silence. Those of the
        disturbances follow in both groups.
        """
        xp, p = self.xp, self.parameters
        scan, uniforms = truth.scan + 1, noise[self.normals :]
        f = xp.take(self.motion_table, truth.target_class, axis=1)
        x, w = truth.motion, noise
        motion = xp.stack(
            [
                x[0] + p.sampling_interval * x[1] + f[0] * x[2] + f[3] * w[0],
                x[1] + f[1] * x[2] + f[4] * w[0] + f[5] * w[1],
                f[2] * x[2] + f[6] * w[0] + f[7] * w[1] + f[8] * w[2],
            ]
        )
        truth = truth._replace(scan=scan, motion=motion)
        if p.class_change:
            changed = scan >= truth.change_scan
            truth = truth._replace(
                target_class=xp.where(changed, truth.next_class, truth.target_class),
                emitter_type=xp.where(changed, truth.next_type, truth.emitter_type),
            )
        if p.silence_start[1] > 0.0:
            on = xp.where(
                truth.radiating, uniforms[3] >= truth.silence_start, uniforms[3] < truth.silence_end
            )
            truth = truth._replace(radiating=xp.where(self._looks(scan), on, truth.radiating))
        if self.radar_is_coloured:
            wandering = GaussMarkov(truth.radar_decay, truth.radar_kick)
            truth = truth._replace(radar_error=wandering.advance(truth.radar_error, noise[7:9]))
        further = noise[self.own_normals : self.normals], uniforms[4:]
        steps = self.disturbances.split_noise(scan, p.sampling_interval, *further, feedback)
        states = self.disturbances.advance(truth.disturbances, steps)
        truth = truth._replace(disturbances=states)
        truth, measurement = self._measure(truth, noise[3:5], noise[5:7], uniforms[:3])
        states, measurement = self.disturbances.change_measurement(truth.disturbances, measurement, steps)
        return truth._replace(disturbances=states), measurement

    # --- the sensors

    def _looks(self, scan: Array) -> Array:
        return scan % self.parameters.esm_period == 0

    def _measure(
        self, truth: Truth, errors: Array, bearings: Array, uniforms: Array
    ) -> tuple[Truth, Measurement]:
        """Return the truth and the measurement of radar and ESM at this scan.

        ``errors`` and ``bearings`` are normal numbers for the radar's white errors and both bearings, ``(2, N)`` each;
        ``uniforms`` are for the type, the decision and the source, ``(3, N)``.
        """
        xp, p = self.xp, self.parameters
        if p.radar_correlation != (0.0, 0.0):
            along = truth.radar_correlation
            errors = xp.stack([errors[0], along * errors[0] + xp.sqrt(1.0 - along * along) * errors[1]])
        errors = self.disturbances.change_errors(truth.disturbances, errors)
        if self.radar_is_coloured:
            errors = errors + truth.radar_error
        radar = xp.stack(
            [truth.motion[0] + p.range_sigma * errors[0], truth.motion[1] + p.range_rate_sigma * errors[1]]
        )
        states, radar = self.disturbances.change_reading(truth.disturbances, radar)
        heard_class, heard_type, heard = truth.target_class, truth.emitter_type, truth.radiating
        esm_bearing = p.esm_bearing_sigma * bearings[1]
        if p.second_emitter_probability[1] > 0.0:
            other = uniforms[2] < truth.second_emitter
            heard_class = xp.where(other, truth.other_class, heard_class)
            heard_type = xp.where(other, truth.other_type, heard_type)
            heard = other | heard
            esm_bearing = esm_bearing + xp.where(other, truth.separation, 0.0)
        if p.emitter == "redrawn":
            heard_type = category(uniforms[0], self._types_of(heard_class), xp)
        looked = self._looks(truth.scan)
        heard = heard & looked
        decision = category(uniforms[1], xp.take(self.decision_thresholds, heard_type, axis=1), xp)
        difference = class_fusion.bearing_difference(p.radar_bearing_sigma * bearings[0], esm_bearing)
        measurement = Measurement(
            scan=truth.scan,
            radar=radar,
            looked=looked,
            decision=xp.where(heard, decision, self.task.types),
            bearing_difference=xp.where(heard, difference, 0.0),
        )
        return truth._replace(disturbances=states), measurement

    # --- costs and readings

    def error_factor(self, truth: Truth) -> Array:
        """Return the standard deviation of this scan's white radar errors over nominal, ``(N,)``; 1 without glint."""
        return truth.disturbances.get("glint", self.xp.ones_like(truth.separation))

    def state(self, truth: Truth) -> Array:
        """Return the true range, range rate and acceleration, ``(3, N)``."""
        return truth.motion

    def reading_deviations(self, measurement: Measurement) -> Array:
        """Return the standard deviations of range and range rate, ``(2, N)``."""
        p = self.parameters
        return self.task.constant([[p.range_sigma], [p.range_rate_sigma]]) + 0.0 * measurement.radar

    def mask_missing(self, measurement: Measurement) -> Measurement:
        """Return the measurement with NaN as the bearing difference where there is no ESM decision."""
        decided = measurement.decision < self.task.types
        difference = self.xp.where(decided, measurement.bearing_difference, math.nan)
        return measurement._replace(bearing_difference=difference)

    def component_readings(self, measurement: Measurement) -> Array:
        """Return the measured range and range rate, ``(3, N)`` with NaN for the acceleration."""
        return self.xp.concat([measurement.radar, measurement.radar[:1] * math.nan])

    def component_deviations(self, measurement: Measurement) -> Array:
        """Return the standard deviations of range and range rate, ``(3, N)`` with NaN for the acceleration."""
        p, once = self.parameters, self.xp.ones_like(measurement.radar[0])
        return self.xp.stack([p.range_sigma * once, p.range_rate_sigma * once, math.nan * once])

    def error_cost(self, error: Array) -> Array:
        """Return the mean of the three squared errors over their squared scales, ``(N,)``."""
        scaled = error * self.cost_factors
        return ordered_sum(scaled * scaled) * (1.0 / 3.0)

    def records(self, truth: Truth) -> dict[str, Array]:
        """Return true class, true type, time and values of disturbances to record at a scan, by name."""
        xp = self.xp
        return {
            **self.disturbances.records(truth.disturbances),
            "true_class": xp.astype(truth.target_class, xp.float64),
            "true_type": xp.astype(truth.emitter_type, xp.float64),
            "seconds": xp.astype(truth.scan, xp.float64) * self.parameters.sampling_interval,
        }

    def context(self, truth: Truth) -> dict[str, Array]:
        """Return the draws of classes, emitters, radar errors and silences, and their current values, by name."""
        p, xp = self.parameters, self.xp
        never = 0 * truth.change_scan - 1
        changes = (p.class_change is not None) & (truth.change_scan <= p.horizon + 1)
        return {
            "target_class": truth.target_class,
            "emitter_type": truth.emitter_type,
            "change_scan": xp.where(changes, truth.change_scan, never),
            "next_class": xp.where(changes, truth.next_class, never),
            "next_type": xp.where(changes, truth.next_type, never),
            "other_class": truth.other_class,
            "other_type": truth.other_type,
            "separation": truth.separation,
            "silence_start": truth.silence_start,
            "silence_end": truth.silence_end,
            "second_emitter": truth.second_emitter,
            "radar_coloured": truth.radar_coloured,
            "radar_decay": truth.radar_decay,
            "radar_correlation": truth.radar_correlation,
            "radar_error": truth.radar_error,
            "error_factor": self.error_factor(truth),
            "radiating": xp.astype(truth.radiating, xp.float64),
            **self.disturbances.context(truth.disturbances),
        }


def _thresholds(rows: object) -> numpy.ndarray:
    """Return cumulative probabilities of rows as thresholds for a uniform number, ``(columns - 1, rows)``."""
    return numpy.cumsum(numpy.array(rows), axis=1)[:, :-1].T
