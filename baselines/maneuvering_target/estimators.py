"""Estimators of ManeuveringTarget: what the measurements allow beyond the filters that an action steers."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.world import Measurement
from ...envs.observation import Array
from ...envs.task import Initial
from ...filters import coordinated_turn, imm, kalman, unscented


class KalmanModel:
    """Matrices of the constant-velocity model in x and y."""

    def __init__(self, task: ManeuveringTarget) -> None:
        self.task, self.xp = task, task.xp
        F, Q = kalman.white_acceleration(task.parameters.sampling_interval, 1.0, axes=2)
        self.F, self.unit_Q = task.constant(F), task.constant(Q)
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        self.identity = task.constant([[1.0, 0.0], [0.0, 1.0]])[:, :, None]

    def updated(self, predicted: tuple[Array, Array], measurement: Measurement) -> kalman.Update:
        """Kalman's update of a predicted mean and covariance with the measured position."""
        return kalman.update(*predicted, measurement.position, self.H, self.identity * measurement.variance)


class KalmanBank(NamedTuple):
    """Memory of the IMM over Kalman filters."""

    mean: Array
    covariance: Array
    probabilities: Array


class KalmanInteractingMultipleModel(KalmanModel):
    """The usual IMM over two Kalman filters of constant velocity, without and with white acceleration.

    Args:
        task: the problem.
        accelerations: standard deviation of the acceleration of each filter, m/s^2.
        stay: probability of each mode to last another scan; it is left for any other alike.
    """

    kind = "estimator"

    def __init__(
        self,
        task: ManeuveringTarget,
        accelerations: Sequence[float] = (0.0, 2.775),
        stay: Sequence[float] = (0.9, 0.9),
    ) -> None:
        super().__init__(task)
        modes = range(len(stay))
        self.Q = [sigma**2 * self.unit_Q for sigma in accelerations]
        self.transition = task.constant(
            [[stay[i] if i == j else (1.0 - stay[i]) / (len(stay) - 1) for j in modes] for i in modes]
        )
        # All modes are left equally often in the long run, so they are met in proportion to how long they last.
        lasting = [1.0 / (1.0 - probability) for probability in stay]
        self.probabilities = task.constant([scans / sum(lasting) for scans in lasting])

    def augmented(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Give an estimate of position and velocity the state in which the filters are mixed."""
        return mean, covariance

    def filtered(self, mean: Array, covariance: Array, measurement: Measurement) -> list[kalman.Update]:
        """Predict and update every filter from its mixed state ``(n, M, N)``."""
        return [
            self.updated(kalman.predict(mean[:, j], covariance[:, :, j], self.F, Q), measurement)
            for j, Q in enumerate(self.Q)
        ]

    def start(self, initial: Initial, N: int) -> KalmanBank:
        """Start all filters where everyone starts."""
        xp, M = self.xp, self.probabilities.shape[0]
        mean, covariance = self.augmented(initial.mean, initial.covariance)
        return KalmanBank(
            xp.stack([mean] * M, axis=1),
            xp.stack([covariance] * M, axis=2),
            self.probabilities[:, None] + 0.0 * mean[:1],
        )

    def update(self, measurement: Measurement, memory: KalmanBank) -> tuple[Array, Array, KalmanBank]:
        """One IMM cycle."""
        xp = self.xp
        prediction = imm.predict_mode_probabilities(self.transition, memory.probabilities)
        mixed = imm.mix(memory.mean, memory.covariance, prediction.mixing)
        results = self.filtered(*mixed, measurement)
        log_likelihood = xp.stack([r.log_likelihood for r in results])
        probabilities = imm.mode_posterior(imm.log_probabilities(prediction.probabilities), log_likelihood)
        bank = KalmanBank(
            xp.stack([r.mean for r in results], axis=1),
            xp.stack([r.covariance for r in results], axis=2),
            probabilities,
        )
        mean, covariance = imm.combine(*bank)
        return mean[:4], covariance[:4, :4], bank


class TurnModel(KalmanModel):
    """The nearly coordinated turn, with the turn rate as fifth state.

    Args:
        task: the problem.
        acceleration: standard deviation of the acceleration along x and y, m/s^2.
        turn_rate_change: of the change of the turn rate from scan to scan, degrees/s.
    """

    def __init__(self, task: ManeuveringTarget, acceleration: float, turn_rate_change: float) -> None:
        super().__init__(task)
        self.T = task.parameters.sampling_interval
        change = math.radians(turn_rate_change) / self.T
        self.Q = task.constant(coordinated_turn.process_noise(self.T, acceleration, change))[:, :, None]
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]])

    def predicted(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Time update by the extended Kalman filter."""
        return coordinated_turn.predict(mean, covariance, self.T, self.Q)


class KalmanTurnInteractingMultipleModel(KalmanInteractingMultipleModel):
    """IMM over quiet and noisy constant velocity and an extended Kalman filter of the coordinated turn.

    The filters differ in dimension. Reading: one of constant velocity counts as one of five states whose turn rate
    has mean zero and the variance of a turn that begins, independent of the rest, and forgets what is mixed into it
    (unbiased mixing: Yuan, Bar-Shalom, Willett and others, IEEE Trans. AES 48, 2012, 3250-3267; Granström, Willett and
    Bar-Shalom, IEEE Trans. AES 51, 2015, 2975-2986), not as one that is certain not to turn.

    Args:
        task: the problem.
        accelerations: standard deviation of the acceleration of each filter, the turn's last, m/s^2.
        turn_rate_start: standard deviation of the turn rate of a turn that begins, degrees/s.
        turn_rate_change: of its change from scan to scan, degrees/s.
        stay: probability of each mode to last another scan; it is left for any other alike.
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
        self.turn = TurnModel(task, accelerations[2], turn_rate_change)
        self.turn_variance = math.radians(turn_rate_start) ** 2

    def augmented(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Add the turn rate of straight flight."""
        return coordinated_turn.augmented(mean, covariance, self.turn_variance)

    def filtered(self, mean: Array, covariance: Array, measurement: Measurement) -> list[kalman.Update]:
        """Predict and update every filter from its mixed state ``(5, 3, N)``."""
        results = []
        for straight in super().filtered(mean[:4], covariance[:4, :4], measurement):
            mean5, covariance5 = self.augmented(straight.mean, straight.covariance)
            results.append(straight._replace(mean=mean5, covariance=covariance5))
        predicted = self.turn.predicted(mean[:, 2], covariance[:, :, 2])
        return [*results, self.turn.updated(predicted, measurement)]


class UnscentedTurn(TurnModel):
    """Unscented Kalman filter of position, velocity and turn rate, always in a nearly coordinated turn.

    The measurement is linear, so only the prediction takes the unscented transform; the update is Kalman's.

    Args:
        task: the problem.
        acceleration: standard deviation of the acceleration along x and y, m/s^2.
        turn_rate_change: of the change of the turn rate from scan to scan, degrees/s.
        turn_rate_start: of the turn rate at the start of the track, degrees/s.
    """

    kind = "estimator"

    def __init__(
        self,
        task: ManeuveringTarget,
        acceleration: float = 0.3,
        turn_rate_change: float = 0.3,
        turn_rate_start: float = 2.0,
    ) -> None:
        super().__init__(task, acceleration, turn_rate_change)
        self.turn_variance = math.radians(turn_rate_start) ** 2

    def start(self, initial: Initial, N: int) -> Initial:
        """Start where everyone starts, with a turn rate about zero."""
        return Initial(*coordinated_turn.augmented(initial.mean, initial.covariance, self.turn_variance))

    def update(self, measurement: Measurement, memory: Initial) -> tuple[Array, Array, Initial]:
        """Carry the sigma points through the turn and update with the measured position."""
        mean, covariance = unscented.transform(
            memory.mean, memory.covariance, lambda points: coordinated_turn.turned(points, self.T)
        )
        result = self.updated((mean, covariance + self.Q), measurement)
        return result.mean[:4], result.covariance[:4, :4], Initial(result.mean, result.covariance)
