"""Reference estimators and the bound of ManeuveringTarget."""

from typing import ClassVar, NamedTuple

from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.world import Measurement, RadarWorld, Truth
from ...envs.observation import Array
from ...envs.task import Initial
from ...filters import bounds, imm, kalman, polar


class _KalmanReference:
    """Matrices of the constant-velocity model in x and y."""

    def __init__(self, task: ManeuveringTarget) -> None:
        self.task, self.xp = task, task.xp
        F, Q = kalman.white_acceleration(task.parameters.sampling_interval, 1.0, axes=2)
        self.F, self.unit_Q = task.constant(F), task.constant(Q)
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        self.identity = task.constant([[1.0, 0.0], [0.0, 1.0]])[:, :, None]


class KnownTurn(_KalmanReference):
    """A Kalman filter that is told in which scans the target manoeuvres, not how.

    Inside a manoeuvre its acceleration noise is as large as the manoeuvre's acceleration, elsewhere zero.
    """

    kind = "reference"
    knows = "the scans of every manoeuvre and the size of its acceleration"

    def start(self, initial: Initial, truth: Truth) -> Initial:
        """Start where everyone starts."""
        return initial

    def acceleration_sigma(self, truth: Truth) -> Array:
        """Size per axis of the acceleration in this scan, zero on straight flight, ``(N,)``."""
        xp, world, T = self.xp, self.task.world, self.task.parameters.sampling_interval
        assert isinstance(world, RadarWorld)
        if truth.maneuvers is None:
            rate = world.table[2:, 1:] - world.table[2:, :-1]
            row = xp.clip(xp.astype(truth.scan, xp.int64) - 1, None, rate.shape[1] - 1)
            change = rate[:, row] / T
            return xp.sqrt(0.5 * (change[0] ** 2 + change[1] ** 2))
        m = truth.maneuvers
        total = 0.0 * truth.scan
        for slot in range(world.slots):
            active = xp.astype((truth.scan >= m.first[slot]) & (truth.scan <= m.last[slot]), total.dtype)
            speed2 = truth.velocity[0] ** 2 + truth.velocity[1] ** 2
            turn2 = (m.velocity_along[slot] ** 2 + m.velocity_across[slot] ** 2) * speed2 / T**2
            thrust2 = m.acceleration[0, slot] ** 2 + m.acceleration[1, slot] ** 2
            total = total + active * 0.5 * (thrust2 + turn2)
        return xp.sqrt(total)

    def update(self, measurement: Measurement, truth: Truth, memory: Initial) -> tuple[Array, Array, Initial]:
        """Predict with the noise of this scan and update with its measurement."""
        Q = self.unit_Q[:, :, None] * self.acceleration_sigma(truth) ** 2
        mean, covariance = kalman.predict(memory.mean, memory.covariance, self.F, Q)
        result = kalman.update(
            mean, covariance, measurement.position, self.H, self.identity * measurement.variance
        )
        return result.mean, result.covariance, Initial(result.mean, result.covariance)


class KalmanBank(NamedTuple):
    """Memory of the IMM over Kalman filters."""

    mean: Array
    covariance: Array
    probabilities: Array


class KalmanInteractingMultipleModel(_KalmanReference):
    """The usual IMM over two Kalman filters: no manoeuvre, and white acceleration of 2.775 m/s^2."""

    kind = "reference"
    knows = "nothing hidden, but its filters are outside what the action can steer"
    sigmas: ClassVar[tuple[float, float]] = (0.0, 2.775)

    def start(self, initial: Initial, truth: Truth) -> KalmanBank:
        """Start both filters where everyone starts."""
        xp = self.xp
        half = 0.5 + 0.0 * initial.mean[:2]
        return KalmanBank(
            xp.stack([initial.mean] * 2, axis=1), xp.stack([initial.covariance] * 2, axis=2), half
        )

    def update(
        self, measurement: Measurement, truth: Truth, memory: KalmanBank
    ) -> tuple[Array, Array, KalmanBank]:
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


class KnownInputBound(_KalmanReference):
    """Posterior Cramér-Rao bound of an estimator that is told the whole acceleration: no process noise."""

    kind = "bound"
    knows = "the acceleration in every scan"

    def start(self, initial: Initial, truth: Truth) -> Array:
        """Covariance of the start."""
        return initial.covariance

    def update(self, measurement: Measurement, truth: Truth, memory: Array) -> tuple[Array, Array]:
        """Bound after this scan: the diagonal of the covariance recursion at the true position."""
        world, p = self.task.world, self.task.parameters
        assert isinstance(world, RadarWorld)
        P = bounds.predicted_bound(memory, self.F[:, :, None])
        variance = polar.cartesian_variances(truth.position, p.range_sigma, world.bearing_sigma)
        P = bounds.posterior_cramer_rao_bound(P, self.H, self.identity * variance)
        return self.xp.stack([P[i, i] for i in range(4)]), P
