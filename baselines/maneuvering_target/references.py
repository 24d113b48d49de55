"""Reference estimators and the bound of ManeuveringTarget."""

from ...envs.maneuvering_target.world import Legs, Measurement, RadarWorld, Tracks, Truth
from ...envs.observation import Array
from ...envs.task import Initial
from ...filters import bounds, kalman, polar
from .estimators import KalmanModel


class KnownTurn(KalmanModel):
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
        if isinstance(truth.maneuvers, Tracks):
            tracks = truth.maneuvers
            before = xp.astype(xp.minimum(tracks.first + truth.scan, tracks.last) - 1.0, xp.int64)
            change = (truth.velocity - world.table[2:, before]) / T
            return xp.sqrt(0.5 * (change[0] ** 2 + change[1] ** 2))
        if isinstance(truth.maneuvers, Legs):
            change = (truth.velocity - world.on_legs(truth.maneuvers, truth.scan - 1.0)[1]) / T
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


class KnownInputBound(KalmanModel):
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
