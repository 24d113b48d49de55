"""Reference estimator and bound of TightlyCoupledNavigation."""

from typing import Any, NamedTuple

import numpy

from ...envs.filter import Initial
from ...envs.observation import Array
from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES, LINE, REST, SINGER
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ...envs.tightly_coupled_navigation.world import Measurement, Truth
from ...evaluation.competitors import Likelihood
from ...filters import extended_kalman, gnss_ins
from ...filters.ordered_sums import ordered_sum
from ...filters.packed_covariance import diagonal, pack, unpack


class Track(NamedTuple):
    """Memory of both."""

    mean: Array
    """``(17, N)``."""
    covariance: Array
    """Packed (:mod:`~filtergym.filters.packed_covariance`), ``(153, N)``."""
    mode: Array
    """True hypothesis at the last measurement, ``(N,)``."""


def _replace_acceleration(
    matrix: Array, variance: float, task: TightlyCoupledNavigation, lanes: Array
) -> Array:
    """Packed covariance with an acceleration that has nothing to do with the past in some lanes."""
    new = numpy.zeros(gnss_ins.SIZE)
    new[gnss_ins.ACCELERATION] = 1.0
    keep = task.constant(pack(numpy.outer(1.0 - new, 1.0 - new)))
    fresh = matrix * keep[:, None] + task.constant(pack(variance * numpy.diag(new)))[:, None]
    return task.xp.where(lanes, fresh, matrix)


class _KnownMode:
    """Models that the true hypothesis chooses step by step, and sensors whose state is known.

    From the step on which a manoeuvre begins, the acceleration has nothing to do with the past. A manoeuvre
    that follows another one, or that the task announces by a jump, takes its new acceleration at the end of a
    step; on the course "kinematic" the first one is there from the beginning of its step.
    """

    traceable = True

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        self.task = task
        self.axis = task.axis[..., 0]

    def start(self, initial: Initial, truth: Truth) -> Track:
        """Start where everyone starts."""
        return Track(initial.mean, pack(initial.covariance), truth.mode)

    def reset_acceleration(self, track: Track, lanes: Array, variance: float) -> Track:
        """Track with an unknown acceleration of some variance in some lanes."""
        xp = self.task.xp
        moved = xp.concat(
            [track.mean[:8], xp.where(lanes, 0.0 * track.mean[8:11], track.mean[8:11]), track.mean[11:]]
        )
        return track._replace(
            mean=moved, covariance=_replace_acceleration(track.covariance, variance, self.task, lanes)
        )

    def predict_track(self, truth: Truth, track: Track, noises: Array, variance: float) -> Track:
        """Prediction to the present measurement.

        Args:
            truth: at that measurement.
            track: after the one before.
            noises: covariance of the process noise of every hypothesis, ``(17, 17, M)``.
            variance: of the acceleration with which a manoeuvre begins, (m/s^2)^2 per axis.
        """
        xp, task = self.task.xp, self.task
        jumped = truth.jumped > 0.0
        at_once = (truth.mode == SINGER) & (track.mode != SINGER) & ~jumped
        track = self.reset_acceleration(track, at_once, variance)
        # A jump ends a step that was moved by the hypothesis before it.
        moved_by = xp.where(jumped, track.mode, truth.mode)
        axis = xp.take(self.axis, moved_by, axis=-1)[:, :, None]
        noise = xp.take(noises, moved_by, axis=-1)[:, :, None]
        mean, covariance = gnss_ins.predict(
            track.mean[:, None],
            unpack(track.covariance, gnss_ins.SIZE)[:, :, None],
            axis,
            task.common.T,
            task.common.decay,
            noise,
        )
        track = Track(mean[:, 0], pack(covariance[:, :, 0]), truth.mode)
        return self.reset_acceleration(track, jumped, variance)

    def readings_and_jacobian(self, measurement: Measurement, state: Array) -> tuple[Array, Any]:
        """Readings of a state and the rows of their Jacobian there."""
        return gnss_ins.observe(
            state,
            measurement.satellite_position,
            measurement.satellite_velocity,
            measurement.ins_angles,
            self.task.parameters.gravity,
        )

    def sensors(self, measurement: Measurement, truth: Truth) -> tuple[list[Array], list[Array]]:
        """True variance of every reading, and one where it says something."""
        nominal, forces = self.task.sensor_variance, self.task.sensors[2].readings
        variance = [nominal[j] * truth.noise_factor[j] ** 2 for j in range(len(nominal))]
        available = [measurement.available[j] for j in range(len(nominal))]
        # A reading that is held was already used when it was new.
        for j in range(forces.start, forces.stop):
            available[j] = available[j] * (1.0 - truth.stuck)
        return variance, available


class KnownMode(_KnownMode):
    """One extended Kalman filter whose model follows the true hypothesis and whose noise is the true one.

    Rest keeps the bank's small regularising noise, so that the reported covariance stays invertible. On the
    fixed courses, where straight flight has steady increments and no noise, the increment's size is taken as
    its standard deviation.
    """

    kind = "reference"
    knows = (
        "the true hypothesis at every step, when a manoeuvre begins, the true noise of every sensor, when the "
        "accelerometers stick, and what pseudoranges are off by"
    )

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        p = task.parameters
        T = p.sampling_interval
        increment = p.true_increment_sigma if p.course == "random" else p.leg_acceleration * T
        line = gnss_ins.constant_velocity_model(T, increment, p.reset_acceleration_sigma)
        true_line = task.constant(gnss_ins.process_noise(line, task.common))
        noises = [task.process_noise[:, :, i, 0] for i in range(len(HYPOTHESES))]
        noises[LINE] = true_line
        self.noises = task.xp.stack(noises, axis=-1)

    def update(
        self, measurement: Measurement, truth: Truth, memory: Track
    ) -> tuple[Array, Array, Track, Likelihood]:
        """Predict under the true hypothesis and update with the sensors that work."""
        xp, task = self.task.xp, self.task
        track = self.predict_track(truth, memory, self.noises, task.parameters.singer_sigma**2)
        expected, rows = self.readings_and_jacobian(measurement, track.mean)
        residual = measurement.readings - expected
        ranges = task.sensors[0].readings
        residual = xp.concat([residual[ranges] - truth.range_error, residual[ranges.stop :]])
        variance, available = self.sensors(measurement, truth)
        update = extended_kalman.update_one_by_one(
            track.mean, unpack(track.covariance, gnss_ins.SIZE), residual, rows, variance, available
        )
        likelihood = Likelihood(
            update.log_likelihood, ordered_sum(update.squared_residuals), ordered_sum(available)
        )
        after = Track(update.mean, pack(update.covariance), truth.mode)
        return update.mean, update.covariance, after, likelihood


class KnownModeBound(_KnownMode):
    """Posterior Cramér-Rao bound of an estimator that is told the hypothesis and how manoeuvres begin.

    The covariance recursion of the motion that generates the truth, along the true states: no motion noise
    at rest, that of the increments on random straight flight (none on the fixed courses, whose increments are
    known), Singer's in manoeuvres, and the acceleration with which each begins given.
    """

    kind = "bound"
    knows = (
        "the true hypothesis at every step, the acceleration with which a manoeuvre begins, the true noise of "
        "every sensor, when the accelerometers stick, and what pseudoranges are off by"
    )

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        p = task.parameters
        increment = p.true_increment_sigma if p.course == "random" else 0.0
        axes = {
            REST: gnss_ins.rest_model(p.sampling_interval, 0.0, 0.0),
            LINE: gnss_ins.constant_velocity_model(p.sampling_interval, increment, 0.0),
            SINGER: task.models[SINGER],
        }
        noises = [gnss_ins.process_noise(axes[i], task.common) for i in range(len(HYPOTHESES))]
        self.noises = task.constant(numpy.stack(noises, axis=-1))

    def update(self, measurement: Measurement, truth: Truth, memory: Track) -> tuple[Array, Track]:
        """Bound after this measurement: the diagonal of the covariance."""
        xp = self.task.xp
        track = self.predict_track(truth, memory, self.noises, 0.0)
        expected, rows = self.readings_and_jacobian(measurement, truth.state)
        update = extended_kalman.update_one_by_one(
            track.mean,
            unpack(track.covariance, gnss_ins.SIZE),
            xp.zeros_like(expected),
            rows,
            *self.sensors(measurement, truth),
        )
        P = pack(update.covariance)
        return P[diagonal(gnss_ins.SIZE)], track._replace(covariance=P)
