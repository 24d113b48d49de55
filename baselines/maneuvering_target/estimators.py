"""Estimators of ManeuveringTarget: what the measurements allow beyond the filters that an action steers."""

from typing import ClassVar, NamedTuple

from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.world import Measurement
from ...envs.observation import Array
from ...envs.task import Initial
from ...filters import imm, kalman


class KalmanModel:
    """Matrices of the constant-velocity model in x and y."""

    def __init__(self, task: ManeuveringTarget) -> None:
        self.task, self.xp = task, task.xp
        F, Q = kalman.white_acceleration(task.parameters.sampling_interval, 1.0, axes=2)
        self.F, self.unit_Q = task.constant(F), task.constant(Q)
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        self.identity = task.constant([[1.0, 0.0], [0.0, 1.0]])[:, :, None]


class KalmanBank(NamedTuple):
    """Memory of the IMM over Kalman filters."""

    mean: Array
    covariance: Array
    probabilities: Array


class KalmanInteractingMultipleModel(KalmanModel):
    """The usual IMM over two Kalman filters: no manoeuvre, and white acceleration of 2.775 m/s^2."""

    kind = "estimator"
    sigmas: ClassVar[tuple[float, float]] = (0.0, 2.775)

    def start(self, initial: Initial, N: int) -> KalmanBank:
        """Start both filters where everyone starts."""
        xp = self.xp
        half = 0.5 + 0.0 * initial.mean[:2]
        return KalmanBank(
            xp.stack([initial.mean] * 2, axis=1), xp.stack([initial.covariance] * 2, axis=2), half
        )

    def update(self, measurement: Measurement, memory: KalmanBank) -> tuple[Array, Array, KalmanBank]:
        """One IMM cycle."""
        xp = self.xp
        transition = self.task.constant([[0.9, 0.1], [0.1, 0.9]])
        prediction = imm.predict_mode_probabilities(transition, memory.probabilities)
        mean, covariance = imm.mix(memory.mean, memory.covariance, prediction.mixing)
        R = self.identity * measurement.variance
        results = []
        for j, sigma in enumerate(self.sigmas):
            predicted = kalman.predict(mean[:, j], covariance[:, :, j], self.F, sigma**2 * self.unit_Q)
            results.append(kalman.update(*predicted, measurement.position, self.H, R))
        log_likelihood = xp.stack([r.log_likelihood for r in results])
        probabilities = imm.mode_posterior(imm.log_probabilities(prediction.probabilities), log_likelihood)
        bank = KalmanBank(
            xp.stack([r.mean for r in results], axis=1),
            xp.stack([r.covariance for r in results], axis=2),
            probabilities,
        )
        return *imm.combine(*bank), bank
