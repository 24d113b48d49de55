"""Reference estimator and bound of TightlyCoupledNavigation."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy

from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.tightly_coupled_navigation.parameters import LINE, SINGER
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ...envs.tightly_coupled_navigation.world import Measurement, Truth
from ...filters import extended_kalman, gnss_ins, range_errors
from ...filters.ordered_sums import ordered_sum
from ...filters.packed_covariance import diagonal, pack, unpack

KNOWN_ACCELERATION_SIGMA = 0.01
"""Standard deviation of a known acceleration in the reference, m/s^2, so that its covariance stays invertible."""
KNOWN_INCREMENT_SIGMA = 1e-3
"""Standard deviation of steady increments of the velocity on the fixed courses, m/s."""


class KnownModeState(NamedTuple):
    """State of reference and bound; n = 17 + S states (``filters/range_errors.py``)."""

    mean: Array
    """Mean of the state, ``(n, N)``."""
    covariance: Array
    """Covariance of the state, packed (:mod:`~filtergym.filters.packed_covariance`), ``(n (n + 1) / 2, N)``."""
    mode: Array
    """True hypothesis at the last measurement, ``(N,)``."""


class _KnownMode:
    """Base of reference and bound: the true hypothesis selects the models, and the state of the sensors is
    known.

    The acceleration with which a manoeuvre begins is known. A manoeuvre that follows another one, or a jump,
    takes its new acceleration at the end of a step; on the course "kinematic" the first one is there from the
    beginning of its step. Standard deviation and correlation time of coloured errors of the pseudoranges are
    known; the errors are states.
    """

    traceable = True
    disturbances = ("stuck", "noisy", "hidden", "no_rates", "coloured", "reflections", "ramp", "aperture")
    knows_acceleration: float = 0.0
    """Standard deviation of the known acceleration, m/s^2."""

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        self.task = task
        self.axis: Array = task.axis[..., 0]
        self.size: int = gnss_ins.SIZE + task.satellites

    def start(self, initial: Initial, truth: Truth) -> KnownModeState:
        mean, covariance = range_errors.start(
            initial.mean,
            initial.covariance,
            self.task.satellites,
            truth.disturbances["coloured"].deviation ** 2,
        )
        return KnownModeState(mean, pack(covariance), truth.mode)

    def reset_acceleration(self, track: KnownModeState, lanes: Array, acceleration: Array) -> KnownModeState:
        """Set the acceleration to a known one in the episodes of a mask ``lanes``; return the state."""
        xp, a = self.task.xp, gnss_ins.ACCELERATION
        new = numpy.zeros(self.size)
        new[a] = 1.0
        keep = self.task.constant(pack(numpy.outer(1.0 - new, 1.0 - new)))[:, None]
        known = self.task.constant(pack(self.knows_acceleration**2 * numpy.diag(new)))[:, None]
        return track._replace(
            mean=xp.concat(
                [
                    track.mean[: a.start],
                    xp.where(lanes, acceleration, track.mean[a]),
                    track.mean[a.stop :],
                ]
            ),
            covariance=xp.where(lanes, track.covariance * keep + known, track.covariance),
        )

    def predict_track(self, truth: Truth, track: KnownModeState, noises: Array) -> KnownModeState:
        """Predict the state to the present measurement under the true hypothesis."""
        xp, task, T = self.task.xp, self.task, self.task.common.T
        jumped = truth.jumped > 0.0
        at_once = (truth.mode == SINGER) & (track.mode != SINGER) & ~jumped
        # A jump at the end of this step begins the next leg.
        _, push = task.world.course.leg_at(truth.legs, truth.step + truth.jumped)
        track = self.reset_acceleration(track, at_once, push)
        # A jump ends a step that was moved by the hypothesis before it.
        moved_by = xp.where(jumped, track.mode, truth.mode)
        axis = xp.take(self.axis, moved_by, axis=-1)[:, :, None]
        noise = xp.take(noises, moved_by, axis=-1)[:, :, None]
        coloured = truth.disturbances["coloured"]
        kept = coloured.process.decay
        gained = coloured.deviation**2 * (1.0 - kept * kept)
        mean, covariance = range_errors.predict(
            track.mean[:, None],
            unpack(track.covariance, self.size)[:, :, None],
            axis,
            T,
            task.common.decay,
            noise,
            kept,
            gained,
        )
        mean = mean[:, 0]
        if task.parameters.course != "random":
            _, along = task.world.course.leg_at(truth.legs, truth.step)
            increment = xp.where(moved_by == LINE, T * along, 0.0)
            x, v = mean[gnss_ins.POSITION] + (0.5 * T) * increment, mean[gnss_ins.VELOCITY] + increment
            mean = xp.concat([x, mean[3:4], v, mean[7:]])
        track = KnownModeState(mean, pack(covariance[:, :, 0]), truth.mode)
        return self.reset_acceleration(track, jumped, push)

    def readings_and_jacobian(self, measurement: Measurement, state: Array) -> tuple[Array, Any]:
        return range_errors.observe(
            state,
            measurement.satellite_position,
            measurement.satellite_velocity,
            measurement.ins_angles,
            self.task.parameters.gravity,
        )

    def process_noises(self, models: Sequence[gnss_ins.AxisModel]) -> Array:
        """Return the covariances of the process noise of every hypothesis, ``(n, n, M)``."""
        noises, known = numpy.zeros((self.size, self.size, len(models))), gnss_ins.SIZE
        for i, model in enumerate(models):
            noises[:known, :known, i] = gnss_ins.process_noise(model, self.task.common)
        return self.task.constant(noises)

    def sensors(self, measurement: Measurement, truth: Truth) -> tuple[list[Array], list[Array]]:
        """Return the true variance of every reading, and its availability, which is zero for stuck
        accelerometers.
        """
        nominal, forces = self.task.sensor_variance, self.task.sensors[2].readings
        variance = [nominal[j] * truth.noise_factor[j] ** 2 for j in range(len(nominal))]
        available = [measurement.available[j] for j in range(len(nominal))]
        # The reading of a stuck sensor was used when it was new.
        for j in range(forces.start, forces.stop):
            available[j] = available[j] * (1.0 - truth.disturbances["stuck"].now)
        return variance, available


class KnownMode(_KnownMode):
    """One extended Kalman filter that knows the draw of the episode: manoeuvres, faults, and all noise
    levels.

    At rest, and in straight flight on the fixed courses, which has steady increments and no noise, the bank's small
    regularising noise remains, so that the reported covariance stays invertible.
    """

    kind = "reference"
    knows_acceleration = KNOWN_ACCELERATION_SIGMA
    knows = (
        "the true hypothesis at every step, when and with which acceleration a manoeuvre begins, the true noise of "
        "every sensor, when the accelerometers stick, by how much pseudoranges are off for reflections and drifts, and "
        "deviation and correlation time of their coloured errors"
    )

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        p = task.parameters
        increment = p.true_increment_sigma if p.course == "random" else KNOWN_INCREMENT_SIGMA
        rest, _, singer = task.models
        line = gnss_ins.constant_velocity_model(p.sampling_interval, increment, p.reset_acceleration_sigma)
        self.noises: Array = self.process_noises((rest, line, singer))

    def update(
        self, memory: KnownModeState, measurement: Measurement, truth: Truth
    ) -> tuple[Array, Array, KnownModeState, Likelihood]:
        """Predict under the true hypothesis, update with working sensors; return mean, covariance, memory,
        likelihood.
        """
        xp, task, known = self.task.xp, self.task, gnss_ins.SIZE
        track = self.predict_track(truth, memory, self.noises)
        expected, rows = self.readings_and_jacobian(measurement, track.mean)
        residual = measurement.readings - expected
        ranges = task.sensors[0].readings
        off = truth.range_error - truth.disturbances["coloured"].level
        residual = xp.concat([residual[ranges] - off, residual[ranges.stop :]])
        variance, available = self.sensors(measurement, truth)
        update = extended_kalman.update_one_by_one(
            track.mean, unpack(track.covariance, self.size), residual, rows, variance, available
        )
        likelihood = Likelihood(
            update.log_likelihood, ordered_sum(update.squared_residuals), ordered_sum(available)
        )
        after = KnownModeState(update.mean, pack(update.covariance), truth.mode)
        return update.mean[:known], update.covariance[:known, :known], after, likelihood


class KnownModeBound(_KnownMode):
    """Posterior Cramér-Rao bound of an estimator that knows the hypothesis and the beginnings of manoeuvres.

    The covariance recursion of the motion that generates the truth, along the true states: no motion noise
    at rest, that of the increments on random straight flight (none on the fixed courses, whose increments are
    known), Singer's in manoeuvres, and the acceleration with which each begins given.
    """

    kind = "bound"
    knows = (
        "the true hypothesis at every step, the acceleration with which a manoeuvre begins, the true noise of "
        "every sensor, when the accelerometers stick, by how much pseudoranges are off for reflections and drifts, "
        "and deviation and correlation time of their coloured errors"
    )

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        p = task.parameters
        increment = p.true_increment_sigma if p.course == "random" else 0.0
        rest = gnss_ins.rest_model(p.sampling_interval, 0.0, 0.0)
        line = gnss_ins.constant_velocity_model(p.sampling_interval, increment, 0.0)
        self.noises: Array = self.process_noises((rest, line, task.models[SINGER]))

    def update(
        self, memory: KnownModeState, measurement: Measurement, truth: Truth
    ) -> tuple[Array, KnownModeState]:
        """Return the bound on the variances after this measurement, and the memory."""
        xp = self.task.xp
        track = self.predict_track(truth, memory, self.noises)
        state = xp.concat([truth.state, truth.disturbances["coloured"].level])
        expected, rows = self.readings_and_jacobian(measurement, state)
        update = extended_kalman.update_one_by_one(
            track.mean,
            unpack(track.covariance, self.size),
            xp.zeros_like(expected),
            rows,
            *self.sensors(measurement, truth),
        )
        P = pack(update.covariance)
        return P[diagonal(self.size)[: gnss_ins.SIZE]], track._replace(covariance=P)
