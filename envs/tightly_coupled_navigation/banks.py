"""Banks of TightlyCoupledNavigation: extended Kalman filters for hypotheses on the motion, which an action steers.

The filters, one for each hypothesis, are mixed with their weights before every measurement and combined after it. The
steps are numbered as in the paper (see :mod:`.task`). Of steps 1 to 4, the prediction, the combined mean is computed
twice: after :meth:`act`, because it steers the tracking loops of the next measurement, and with the rest of the
prediction in :meth:`predict`.

Reading: step 3 of the scan lacks a hat and carries the index k|k-1; the spread is taken about the posterior
estimates, otherwise the matrix is not symmetric.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import extended_kalman, gnss_ins, imm
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ...filters.packed_covariance import pack, unpack
from ..contract.controls import bank_action_space, bank_probabilities
from ..contract.filter import Bank, Initial
from ..contract.observation import (
    BOUNDED_LOG,
    SHARE,
    SIGNED_LOG,
    Array,
    Block,
    Quantity,
    clock_block,
    last_action_block,
    log_predicted_block,
    relative_likelihood_block,
)
from ..contract.task import Task
from .parameters import HYPOTHESES, SensorGroup, TightlyCoupledNavigationParameters
from .problem import NavigationProblem
from .world import Measurement

EFFICIENT = 1.345
"""Huber threshold with an efficiency of 95 % for Gaussian noise (Huber, Robust Statistics, 1981)."""
LEAST_STRENGTH = 1e-9
"""Smallest strength of the robust update: with a threshold of 1e9 deviations it is the plain one."""


class Prediction(NamedTuple):
    """Prediction of the bank for a measurement, steps 1 to 4, under M = 3 hypotheses."""

    mean: Array
    """Predicted means, ``(17, M, N)``."""
    covariance: Array
    """Predicted covariances, packed, ``(153, M, N)``."""
    probabilities: Array
    """Predicted probabilities, ``(M, N)``."""


class Filters(NamedTuple):
    """State of the bank of extended Kalman filters.

    Covariances are packed (:mod:`~filtergym.filters.packed_covariance`); that of the combination (step 8) is computed
    on demand.
    """

    means: Array
    """Means after the update, ``(17, M, N)``; where the action sets the noise, the predicted ones before
    :meth:`act`."""
    covariances: Array
    """Predicted covariances, packed, ``(153, M, N)``."""
    log_predicted: Array
    """Logarithm of the predicted probabilities, ``(M, N)``."""
    log_likelihood: Array
    """Log-likelihood of the readings in each filter, ``(M, N)``."""
    nis: Array
    """Normalised innovation squared by group of sensors, each conditional on the previous groups, ``(4, M, N)``."""
    log_density: Array
    """Log-density of the measurement under the prediction with the nominal noise, ``(N,)``."""
    average_nis: Array
    """Short average of the NIS per reading, ``(4, M, N)``."""
    accelerometers: Array
    """Last readings of the accelerometers, ``(3, N)``, m/s^2; infinite before the first."""
    repeated: Array
    """1 where the accelerometers repeat their previous readings exactly, ``(N,)``."""
    range_innovation: Array
    """Innovations at the combined prediction: S pseudoranges, m, S rates, m/s; ``(2 S, N)``."""
    probabilities: Array
    """Weights of the hypotheses, ``(M, N)``."""
    mean: Array
    """Combined mean, ``(17, N)``."""
    action: Array
    """Last action, ``(A, N)``."""


class SatelliteBank(Bank[Task, Measurement, Any]):
    """Base class of the banks on satellite readings: statistics by group of sensors, and their observation blocks."""

    task: NavigationProblem
    parameters: TightlyCoupledNavigationParameters
    hypotheses: Sequence[str] = HYPOTHESES

    @property
    def actions(self) -> Sequence[str]:
        """Names of the components of the action."""
        return self.hypotheses

    # --- the agent's observation

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks, such as the NIS of each filter by group of sensors, innovations, availability, time."""
        xp, p, task = self.xp, self.parameters, self.task
        slots = [str(slot) for slot in p.satellites]
        each = [f"{sensor.name}_{hypothesis}" for sensor in task.sensors for hypothesis in self.hypotheses]
        ranges, rates, forces, _ = task.sensors

        def innovation(name: str, sensor: SensorGroup) -> Block:
            part, sigma = sensor.readings, sensor.sigma
            return Block(
                f"{name}_innovation", lambda f, y: y.available[part] * f.range_innovation[part] / sigma,
                f"the {name}'s innovation at the combined prediction over sigma; 0 where it is missing",
                slots, BOUNDED_LOG,
            )  # fmt: skip

        def available(name: str, sensor: SensorGroup) -> Block:
            return Block(
                f"{name}_available", lambda f, y: y.available[sensor.readings],
                f"1 where the {name} reached the filter", slots, SHARE, over_interval="mean",
            )  # fmt: skip

        return (
            Block(
                "nis", lambda f, y: f.nis / self._present(y),
                "the normalised innovation squared per reading, of a group of sensors given those before it",
                each, BOUNDED_LOG, over_interval="mean",
            ),
            Block(
                "average_nis", lambda f, y: f.average_nis,
                f"the short average of the same, over {p.averaging_measurements:g} measurements", each,
                BOUNDED_LOG,
            ),
            relative_likelihood_block(xp, self.hypotheses, compression=BOUNDED_LOG),
            log_predicted_block(self.hypotheses),
            Block(
                "accelerometer", lambda f, y: y.readings[forces.readings] / p.gravity, "specific force",
                ("forward", "right", "down"), SIGNED_LOG, unit=f"{p.gravity:g} m/s^2",
            ),
            Block(
                "accelerometers_repeat", lambda f, y: f.repeated,
                "1 where the accelerometers repeat their last readings exactly, as noise never does", compression=SHARE,
                over_interval="mean",
            ),
            innovation("pseudorange", ranges),
            innovation("rate", rates),
            available("pseudorange", ranges),
            available("rate", rates),
            clock_block(xp, p.horizon, unit="horizon"),
            last_action_block(self.actions, name="last"),
        )  # fmt: skip

    @property
    def quantities(self) -> Sequence[Quantity]:
        """Innovations in m and m/s, computed from the observation."""
        ranges, rates, *_ = self.task.sensors
        return (
            Quantity(
                "pseudorange_innovation_in_metres", "m", "measured minus predicted pseudorange",
                lambda read: ranges.sigma * read("pseudorange_innovation"),
            ),
            Quantity(
                "rate_innovation_in_metres_per_second", "m/s", "measured minus predicted pseudorange rate",
                lambda read: rates.sigma * read("rate_innovation"),
            ),
        )  # fmt: skip

    def _present(self, measurement: Measurement) -> Array:
        """Return the number of available readings of each group of sensors, at least one, ``(4, 1, N)``."""
        here = [ordered_sum(measurement.available[sensor.readings]) for sensor in self.task.sensors]
        return self.xp.stack([self.xp.clip(count, 1.0, None) for count in here])[:, None]


class HypothesisBank(SatelliteBank):
    """Bank of ``evidence``, ``mode`` and ``weights``: the action weights the hypotheses on the motion."""

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium space of the selected hypothesis, or of a number for each."""
        return bank_action_space(self.control, len(self.hypotheses))

    def start(self, initial: Initial) -> Filters:
        """Return the filters' state at the start of the track, with the initial probabilities."""
        xp, M, task = self.xp, len(self.hypotheses), self.task
        zeros = 0.0 * initial.mean[0]
        means = xp.stack([initial.mean] * M, axis=1)
        covariances = xp.stack([pack(initial.covariance)] * M, axis=1)
        probabilities = task.constant(self.parameters.initial_probabilities)[:, None] + zeros
        nis = xp.stack([xp.stack([zeros] * M)] * len(task.sensors))
        return Filters(
            means=means,
            covariances=covariances,
            log_predicted=imm.log_probabilities(probabilities),
            log_likelihood=nis[0],
            nis=nis,
            log_density=zeros,
            average_nis=nis + 1.0,
            accelerometers=xp.stack([zeros + math.inf] * 3),
            repeated=zeros,
            range_innovation=xp.stack([zeros] * task.tracked.stop),
            probabilities=probabilities,
            mean=initial.mean,
            action=xp.stack([zeros] * len(self.actions)),
        )

    def _predict_hypotheses(self, state: Filters) -> Prediction:
        """Return the filters mixed with their weights and extrapolated under their hypotheses (steps 1 to 4)."""
        task, common = self.task, self.task.common
        chain = imm.predict_mode_probabilities(task.transition, state.probabilities)
        mixed = imm.mix(state.means, unpack(state.covariances, gnss_ins.SIZE), chain.mixing)
        mean, covariance = gnss_ins.predict(*mixed, task.axis, common.T, common.decay, task.process_noise)
        return Prediction(mean, pack(covariance), chain.probabilities)

    def feedback(self, state: Filters, measurement: Any) -> Array | None:
        """Return the state predicted for the next measurement, ``(17, N)``, which steers the tracking loops."""
        task, common = self.task, self.task.common
        chain = imm.predict_mode_probabilities(task.transition, state.probabilities)
        mixed = weighted_sum(chain.mixing, state.means[:, :, None])
        mean = gnss_ins.advance(mixed, task.axis, common.T, common.decay)
        return weighted_sum(chain.probabilities, mean)

    def predict(self, state: Filters, measurement: Measurement) -> Filters:
        """Return the filters predicted to a measurement and updated with nominal noise, with NIS and likelihood."""
        xp, task, predicted = self.xp, self.task, self._predict_hypotheses(state)
        combined = weighted_sum(predicted.probabilities, predicted.mean)
        seen = gnss_ins.geometry(combined, measurement.satellite_position, measurement.satellite_velocity)
        innovation = measurement.readings[task.tracked] - xp.concat(gnss_ins.ranges(combined, seen))
        update = self._update_hypotheses(
            predicted.mean,
            predicted.covariance,
            measurement,
            task.sensor_variance,
            self.thresholds(state, measurement),
        )
        nis = xp.stack([ordered_sum(update.squared_residuals[sensor.readings]) for sensor in task.sensors])
        change = nis / self._present(measurement) - state.average_nis
        accelerometers = measurement.readings[task.sensors[2].readings]
        repeated = xp.all(accelerometers == state.accelerometers, axis=0)
        log_predicted = imm.log_probabilities(predicted.probabilities)
        means, covariances = self._before_the_action(predicted, update)
        return state._replace(
            means=means,
            covariances=covariances,
            log_predicted=log_predicted,
            log_likelihood=update.log_likelihood,
            nis=nis,
            log_density=imm.log_mixture_density(log_predicted, update.log_likelihood),
            average_nis=state.average_nis + (1.0 / self.parameters.averaging_measurements) * change,
            accelerometers=accelerometers,
            repeated=xp.astype(repeated, combined.dtype),
            range_innovation=innovation,
        )

    def _before_the_action(
        self, predicted: Prediction, update: extended_kalman.Correction
    ) -> tuple[Array, Array]:
        """Return the means and packed covariances from which :meth:`act` continues: here the updated ones."""
        return update.mean, pack(update.covariance)

    def _update_hypotheses(
        self,
        means: Array,
        covariances: Array,
        measurement: Measurement,
        variance: Sequence[Any],
        thresholds: Sequence[Array] | None = None,
        cautions: Sequence[Array] | None = None,
    ) -> extended_kalman.Correction:
        expected, rows = gnss_ins.observe(
            means,
            measurement.satellite_position[:, :, None],
            measurement.satellite_velocity[:, :, None],
            measurement.ins_angles[:, None],
            self.parameters.gravity,
        )
        residual = measurement.readings[:, None] - expected
        return extended_kalman.update_one_by_one(
            means,
            unpack(covariances, gnss_ins.SIZE),
            residual,
            rows,
            variance,
            measurement.available,
            thresholds,
            cautions,
        )

    def thresholds(self, state: Filters, measurement: Measurement) -> Sequence[Array] | None:
        """Return each reading's threshold of the robust update; None, as here, for the paper's update."""
        return None

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Return the hypotheses weighted by the action (step 7) and combined (step 8)."""
        xp, control, dtype = self.xp, self.control, state.log_likelihood.dtype
        probabilities = bank_probabilities(
            control,
            action,
            state.log_predicted,
            state.log_likelihood,
            self.parameters.evidence_scale,
            xp,
        )
        probabilities = xp.astype(probabilities, dtype)
        if control == "mode":
            last = probabilities
        else:
            last = xp.astype(xp.clip(action, 0.0 if control == "weights" else -1.0, 1.0), dtype)
        return self._combine(state, probabilities, last)

    def weigh_by_bayes(self, state: Filters, last_action: Array) -> Filters:
        """Return the hypotheses weighted by Bayes' rule (step 7), as in the paper, and combined (step 8)."""
        probabilities = imm.mode_posterior(state.log_predicted, state.log_likelihood)
        return self._combine(state, probabilities, last_action)

    def _combine(self, state: Filters, probabilities: Array, last_action: Array) -> Filters:
        return state._replace(
            probabilities=probabilities,
            mean=weighted_sum(probabilities, state.means),
            action=last_action,
        )

    def covariance(self, state: Filters) -> Array:
        """Return the covariance of the combined mean (step 8), ``(17, 17, N)``."""
        covariances = unpack(state.covariances, gnss_ins.SIZE)
        return imm.combine(state.means, covariances, state.probabilities)[1]

    def records(self, state: Filters, measurement: Measurement) -> dict[str, Array]:
        """Return probabilities, NIS, log-likelihood, and whether a rate is outside its aperture, to record, by name.

        NIS and its degrees of freedom are those of the combination.
        """
        xp, rates = self.xp, self.task.sensors[1]
        beyond = xp.abs(state.range_innovation[rates.readings]) > self.parameters.rate_aperture
        return {
            "mode_probability": state.probabilities,
            "nis": weighted_sum(state.probabilities, ordered_sum(state.nis)),
            "nis_degrees": ordered_sum(measurement.available),
            "log_likelihood": state.log_density,
            "rate_outside_aperture": xp.astype(xp.any(beyond, axis=0), state.mean.dtype),
        }


class NoiseBank(HypothesisBank):
    """Bank of ``gain``: the action scales the sensors' noise; Bayes' rule weights the hypotheses."""

    adapts_covariance = True

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box with one number for each group of sensors, which scales its noise."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.actions),), numpy.float32)

    @property
    def actions(self) -> Sequence[str]:
        """Names of the groups of sensors, one for each component of the action."""
        return [sensor.name for sensor in self.task.sensors]

    def _before_the_action(
        self, predicted: Prediction, update: extended_kalman.Correction
    ) -> tuple[Array, Array]:
        """Return the predicted means and covariances, since the update waits for the action's noise."""
        return predicted.mean, predicted.covariance

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Return the filters updated with the noise that the action sets, weighted by Bayes' rule."""
        xp = self.xp
        exponent = xp.astype(xp.clip(action, -1.0, 1.0), state.mean.dtype)
        variance, thresholds = self._variance(exponent, state), self._thresholds(exponent)
        update = self._update_hypotheses(state.means, state.covariances, measurement, variance, thresholds)
        state = state._replace(
            means=update.mean, covariances=pack(update.covariance), log_likelihood=update.log_likelihood
        )
        return self.weigh_by_bayes(state, exponent)

    def _variance(self, exponent: Array, state: Filters) -> list[Array]:
        xp, p, task = self.xp, self.parameters, self.task
        up, down = 2.0 * math.log(p.noise_scale), 2.0 * math.log(p.noise_reduction)
        factor = xp.exp(xp.where(exponent > 0.0, up * exponent, down * exponent))
        return [
            nominal * factor[i]
            for i, sensor in enumerate(task.sensors)
            for nominal in task.sensor_variance[sensor.readings]
        ]

    def _thresholds(self, exponent: Array) -> Sequence[Array] | None:
        return None

    def covariance(self, state: Filters) -> Array:
        """Return the covariance of the combined mean, ``(17, 17, N)``, under an action inflated by the average NIS.

        The factor is the short average of the NIS per reading, if above one; with action zero it is one.
        """
        groups = int(state.average_nis.shape[0])
        average = weighted_sum(state.probabilities, ordered_sum(state.average_nis)) / groups
        steered = self.xp.any(state.action != 0.0, axis=0)
        return super().covariance(state) * self.xp.where(steered, self.xp.clip(average, 1.0, None), 1.0)


class RobustBank(NoiseBank):
    """Bank of ``robust``: the action scales the sensors' noise, and sets the treatment of repeats and outliers.

    The action sets the treatment in advance, since repeats and outliers are known only with the measurement.
    """

    @property
    def reach(self) -> float:
        """Share of the range of the noise factors, in logarithms, that actions within [-1, 1] use."""
        return self.parameters.noise_reach

    @property
    def actions(self) -> Sequence[str]:
        """Names of the action's components: sensor groups, repeated accelerometers, outliers of ranges and of rates."""
        ranges, rates = (sensor.name for sensor in self.task.sensors[:2])
        return [*super().actions, "accelerometers_repeated", f"{ranges}_outliers", f"{rates}_outliers"]

    def _variance(self, exponent: Array, state: Filters) -> list[Array]:
        """Return the noise variances of the readings; repeated accelerometer readings have a further factor."""
        xp, forces = self.xp, self.task.sensors[2].readings
        groups = len(self.task.sensors)
        variance = super()._variance(self.reach * exponent[:groups], state)
        own = 2.0 * math.log(self.parameters.noise_scale) * xp.clip(exponent[groups], 0.0, None)
        factor = xp.exp(own * state.repeated)
        return [*variance[: forces.start], *(v * factor for v in variance[forces]), *variance[forces.stop :]]

    def _thresholds(self, exponent: Array) -> Sequence[Array]:
        """Return the Huber threshold of each reading: finite for an action above 0, else infinite."""
        sensors = self.task.sensors
        strength = self.xp.clip(exponent[len(sensors) + 1 :], LEAST_STRENGTH, None)
        none = math.inf + 0.0 * exponent[0]
        each = [EFFICIENT / strength[0], EFFICIENT / strength[1], *[none] * (len(sensors) - 2)]
        return [
            threshold
            for sensor, threshold in zip(sensors, each, strict=True)
            for _ in range(sensor.readings.start, sensor.readings.stop)
        ]
