"""Estimators of ManeuveringTarget: Kalman filters and IMMs without actions.

They predict over the actual time between two scans, and do not update for a scan that missed the target.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ...envs.contract.filter import EstimateState, FilterInput, Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.maneuvering_target.constant_velocity import KalmanModel
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.unscented_turn import DEGREE, TurnModel
from ...envs.maneuvering_target.world import Measurement
from ...filters import coordinated_turn, imm, kalman
from ...filters.ordered_sums import weighted_sum


class ConstantVelocity(KalmanModel):
    """One Kalman filter of constant velocity.

    Args:
        acceleration: standard deviation of the acceleration, constant from scan to scan, m/s^2.
    """

    def __init__(self, task: ManeuveringTarget, acceleration: float = 1.0) -> None:
        super().__init__(task)
        self.variance: float = acceleration**2

    def update(self, state: EstimateState, inputs: FilterInput) -> EstimateState:
        """Predict to a scan and update with its measurement; return the state."""
        F, Q = self.motion(inputs.measurement.interval)
        predicted = kalman.predict(state.mean, state.covariance, F, self.variance * Q)
        return self.track(inputs.measurement, self.update_estimate(predicted, inputs.measurement))


class KalmanMixture(NamedTuple):
    """State of the IMM over Kalman filters: their estimates and mode probabilities."""

    mean: Array
    covariance: Array
    likelihood: Likelihood
    means: Array
    covariances: Array
    probabilities: Array


class KalmanInteractingMultipleModel(KalmanModel):
    """The usual IMM over two Kalman filters of constant velocity, without and with white acceleration.

    Args:
        accelerations: standard deviation of the acceleration of each filter, m/s^2.
        stay: probability of each mode to last another scan; all others are equally likely next.
    """

    def __init__(
        self,
        task: ManeuveringTarget,
        accelerations: Sequence[float] = (0.0, 2.775),
        stay: Sequence[float] = (0.9, 0.9),
    ) -> None:
        super().__init__(task)
        modes = range(len(stay))
        self.variances: list[float] = [sigma**2 for sigma in accelerations]
        self.transition: Array = task.constant(
            [[stay[i] if i == j else (1.0 - stay[i]) / (len(stay) - 1) for j in modes] for i in modes]
        )
        # All modes are left equally often in the long run, so their probabilities are in proportion to their durations.
        lasting = [1.0 / (1.0 - probability) for probability in stay]
        self.probabilities: Array = task.constant([scans / sum(lasting) for scans in lasting])

    def augment(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Extend an estimate of position and velocity to the common state of all filters; here it is the
        same.
        """
        return mean, covariance

    def predict_and_update(
        self, mean: Array, covariance: Array, measurement: Measurement
    ) -> list[kalman.Update]:
        """Predict every filter from its mixed state ``(n, M, N)`` and update it; return the M updates."""
        F, Q = self.motion(measurement.interval)
        return [
            self.update_estimate(
                kalman.predict(mean[:, j], covariance[:, :, j], F, variance * Q), measurement
            )
            for j, variance in enumerate(self.variances)
        ]

    def start(self, initial: Initial) -> KalmanMixture:
        """Return the state at the start: all filters at the initial estimate, with prior probabilities."""
        xp, M = self.xp, self.probabilities.shape[0]
        mean, covariance = self.augment(initial.mean, initial.covariance)
        return KalmanMixture(
            *self.first_track(initial),
            xp.stack([mean] * M, axis=1),
            xp.stack([covariance] * M, axis=2),
            (self.probabilities[:, None] if self.probabilities.ndim == 1 else self.probabilities)
            + 0.0 * mean[:1],
        )

    def update(self, state: KalmanMixture, inputs: FilterInput) -> KalmanMixture:
        """Run one IMM cycle with a scan (mix, predict, update, combine); return the state.

        NIS is the filters' mean by posterior weights.
        """
        xp, measurement = self.xp, inputs.measurement
        prediction = imm.predict_mode_probabilities(self.transition, state.probabilities)
        mixed = imm.mix(state.means, state.covariances, prediction.mixing)
        results = self.predict_and_update(*mixed, measurement)
        log_likelihood = xp.stack([r.log_likelihood for r in results])
        log_predicted = imm.log_probabilities(prediction.probabilities)
        probabilities = imm.mode_posterior(log_predicted, log_likelihood)
        means = xp.stack([r.mean for r in results], axis=1)
        covariances = xp.stack([r.covariance for r in results], axis=2)
        mean, covariance = imm.combine(means, covariances, probabilities)
        density = imm.log_mixture_density(log_predicted, log_likelihood)
        nis = weighted_sum(probabilities, xp.stack([r.squared_distance for r in results]))
        likelihood = self.likelihood(measurement, density, nis)
        return KalmanMixture(mean[:4], covariance[:4, :4], likelihood, means, covariances, probabilities)


class KalmanTurnInteractingMultipleModel(KalmanInteractingMultipleModel):
    """IMM over quiet and noisy constant velocity and an extended Kalman filter of the coordinated turn.

    Reading: a filter of constant velocity counts as one of five states whose turn rate has mean zero and the
    variance of a turn that begins, and discards the turn rate that is mixed into it (unbiased mixing: Yuan,
    Bar-Shalom, Willett and others, IEEE Trans. AES 48, 2012, 3250-3267; Granström, Willett and Bar-Shalom,
    IEEE Trans. AES 51, 2015, 2975-2986), not as one with a turn rate of zero and no variance.

    Args:
        accelerations: standard deviation of the acceleration of each filter, the turn's last, m/s^2.
        turn_rate_start: standard deviation of the turn rate of a turn that begins, degrees/s.
        turn_rate_change: standard deviation of its change from scan to scan, degrees/s.
        stay: probability of each mode to last another scan; all others are equally likely next.
    """

    def __init__(
        self,
        task: ManeuveringTarget,
        accelerations: Sequence[float] = (0.05, 3.0, 0.3),
        turn_rate_start: float = 2.0,
        turn_rate_change: float = 0.3,
        stay: Sequence[float] = (0.95, 0.8, 0.8),
    ) -> None:
        super().__init__(task, accelerations[:2], stay)
        self.turn: TurnModel = TurnModel(task, accelerations[2], turn_rate_change)
        self.turn_variance: float = (DEGREE * turn_rate_start) ** 2

    def augment(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Append an independent turn rate, of mean zero and the variance of a turn that begins, as fifth
        component.
        """
        return coordinated_turn.augment_turn_rate(mean, covariance, self.turn_variance)

    def predict_and_update(
        self, mean: Array, covariance: Array, measurement: Measurement
    ) -> list[kalman.Update]:
        """Predict every filter from its mixed state ``(5, 3, N)`` and update it; return the three updates."""
        results = []
        for straight in super().predict_and_update(mean[:4], covariance[:4, :4], measurement):
            mean5, covariance5 = self.augment(straight.mean, straight.covariance)
            results.append(straight._replace(mean=mean5, covariance=covariance5))
        predicted = self.turn.predict_turn(mean[:, 2], covariance[:, :, 2], measurement.interval)
        return [*results, self.turn.update_estimate(predicted, measurement)]
