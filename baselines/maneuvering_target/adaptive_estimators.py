"""Single Kalman filters of constant velocity that estimate their noise from the innovations.

A scan that missed the target contains no information on noise: the estimate stays.
"""

from typing import NamedTuple

from ...envs.contract.filter import FilterInput, Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.maneuvering_target.banks import SHORTEST
from ...envs.maneuvering_target.constant_velocity import KalmanModel
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...filters import kalman, noise_adaptation


class ProcessNoiseTrack(NamedTuple):
    """State of a filter that estimates its process noise."""

    mean: Array
    covariance: Array
    likelihood: Likelihood
    level: noise_adaptation.Level


class SageHusaProcessNoise(KalmanModel):
    """A Kalman filter that estimates its acceleration noise from its own corrections (Sage and Husa 1969).

    Args:
        acceleration: standard deviation of the acceleration at the start, m/s^2.
        forgetting: factor on the weight of the past at each scan.
        least: smallest standard deviation of the acceleration, m/s^2.
    """

    def __init__(
        self, task: ManeuveringTarget, acceleration: float = 1.0, forgetting: float = 0.9, least: float = 0.1
    ) -> None:
        super().__init__(task)
        self.variance: float = acceleration**2
        self.forgetting = forgetting
        self.least: float = least**2

    def start(self, initial: Initial) -> ProcessNoiseTrack:
        """Return the state at the initial estimate, with the process noise given as argument."""
        nothing = 0.0 * initial.mean[0]
        level = noise_adaptation.Level(self.variance + nothing, 1.0 + nothing)
        return ProcessNoiseTrack(*self.first_track(initial), level)

    def update(self, state: ProcessNoiseTrack, inputs: FilterInput) -> ProcessNoiseTrack:
        """Predict with the estimated process noise, update, estimate the noise again; return the state."""
        measurement = inputs.measurement
        F, unit = self.motion(measurement.interval)
        mean, carried = kalman.predict(state.mean, state.covariance, F, 0.0 * unit)
        predicted = carried + unit * state.level.value
        result = self.update_estimate((mean, predicted), measurement)
        # An interval of zero has no process noise, and its correction no information on it.
        passed = measurement.interval >= SHORTEST * self.task.parameters.sampling_interval
        sample = noise_adaptation.process_noise_factor(
            result.mean - mean,
            *(self.diagonal(P) for P in (result.covariance, carried, self.xp.where(passed, unit, 1.0))),
        )
        available = self.xp.where(passed, measurement.available, 0.0)
        level = noise_adaptation.fading_mean(state.level, sample, self.forgetting, available)
        level = level._replace(value=self.xp.clip(level.value, self.least, None))
        return ProcessNoiseTrack(*self.track(measurement, result), level)

    def diagonal(self, covariance: Array) -> Array:
        """Return the diagonal ``(4, N)`` of covariances ``(4, 4, N)``."""
        return self.xp.stack([covariance[i, i] for i in range(4)])


class MeasurementNoiseTrack(NamedTuple):
    """State of a filter that estimates its measurement noise."""

    mean: Array
    covariance: Array
    likelihood: Likelihood
    noise: noise_adaptation.InverseGamma


class VariationalBayes(KalmanModel):
    """A Kalman filter that estimates its measurement noise by variational Bayes (Särkkä and Nummenmaa 2009).

    Along x and y it estimates the ratio of the true variance to that of the radar.

    Args:
        acceleration: standard deviation of the acceleration, m/s^2.
        forgetting: rho, factor on the information about the noise at each scan.
        shape: half the number of measurements to which the radar's own variance is equivalent at the start.
    """

    iterations = 3

    def __init__(
        self,
        task: ManeuveringTarget,
        acceleration: float = 2.775,
        forgetting: float = 0.95,
        shape: float = 5.0,
    ) -> None:
        super().__init__(task)
        self.variance: float = acceleration**2
        self.forgetting = forgetting
        self.shape = shape

    def start(self, initial: Initial) -> MeasurementNoiseTrack:
        """Return the state at the initial estimate, with the radar's variances as noise."""
        shape = self.shape + 0.0 * initial.mean[:2]
        return MeasurementNoiseTrack(*self.first_track(initial), noise_adaptation.InverseGamma(shape, shape))

    def update(self, state: MeasurementNoiseTrack, inputs: FilterInput) -> MeasurementNoiseTrack:
        """Predict, update mean and measurement noise together; return the state."""
        measurement = inputs.measurement
        xp, variance, available = self.xp, measurement.variance, measurement.available
        F, unit = self.motion(measurement.interval)
        predicted = kalman.predict(state.mean, state.covariance, F, self.variance * unit)

        def update(factor: Array) -> tuple[Array, Array, kalman.Update]:
            result = self.update_estimate(predicted, measurement._replace(variance=factor * variance))
            updated = xp.stack([result.covariance[0, 0], result.covariance[1, 1]])
            residual = xp.where(available > 0.0, measurement.position - result.mean[:2], 0.0)
            return residual / xp.sqrt(variance), updated / variance, result

        before = noise_adaptation.forget(state.noise, self.forgetting, available)
        noise, result = noise_adaptation.variational_bayes(before, update, self.iterations, available)
        # With the noise estimated before this scan: with the noise of its own update it would not be a prediction.
        nominal = self.update_estimate(predicted, measurement._replace(variance=before.variance * variance))
        likelihood = self.likelihood(measurement, *nominal[2:])
        return MeasurementNoiseTrack(result.mean, result.covariance, likelihood, noise)
