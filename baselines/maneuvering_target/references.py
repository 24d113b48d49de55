"""Reference estimators and the bound of ManeuveringTarget."""

from typing import NamedTuple

from ...envs.filter import Initial
from ...envs.maneuvering_target.world import Measurement, RadarWorld, Truth
from ...envs.observation import Array
from ...evaluation.competitors import Likelihood
from ...filters import bounds, kalman, polar
from .estimators import KalmanModel


class TurnMemory(NamedTuple):
    """Memory of :class:`KnownTurn`."""

    mean: Array
    covariance: Array
    velocity: Array
    """True one at the last scan, ``(2, N)``."""


class KnownTurn(KalmanModel):
    """A Kalman filter that is told in which scans the target manoeuvres, not how.

    Inside a manoeuvre its acceleration noise is as large as the manoeuvre's acceleration, elsewhere zero.
    """

    kind = "reference"
    knows = "the scans of every manoeuvre and the size of its acceleration"

    def start(self, initial: Initial, truth: Truth) -> TurnMemory:
        """Start where everyone starts."""
        return TurnMemory(*initial, truth.velocity)

    def update(
        self, measurement: Measurement, truth: Truth, memory: TurnMemory
    ) -> tuple[Array, Array, TurnMemory, Likelihood]:
        """Predict with the noise of this scan and update with its measurement.

        The acceleration is the change of the velocity since the scan before, as large along x as along y.
        """
        T = measurement.interval
        F, unit = self.motion(T)
        change = (truth.velocity - memory.velocity) / T
        variance = 0.5 * (change[0] ** 2 + change[1] ** 2)
        result = self.update_estimate(
            kalman.predict(memory.mean, memory.covariance, F, variance * unit), measurement
        )
        memory = TurnMemory(result.mean, result.covariance, truth.velocity)
        return result.mean, result.covariance, memory, self.likelihood(measurement, *result[2:])


class KnownInputBound(KalmanModel):
    """Posterior Cramér-Rao bound of an estimator that is told the whole acceleration: no process noise."""

    kind = "bound"
    knows = "the acceleration in every scan"

    def start(self, initial: Initial, truth: Truth) -> Array:
        """Covariance of the start."""
        return initial.covariance

    def update(self, measurement: Measurement, truth: Truth, memory: Array) -> tuple[Array, Array]:
        """Bound after this scan: the diagonal of the covariance recursion at the true position. A scan that missed the
        target adds no information.
        """
        world, p = self.task.world, self.task.parameters
        assert isinstance(world, RadarWorld)
        predicted = bounds.predict_bound(memory, self.motion(measurement.interval)[0])
        variance = polar.cartesian_variances(truth.position, p.range_sigma, world.bearing_sigma)
        P = bounds.posterior_cramer_rao_bound(predicted, self.H, self.identity * variance)
        P = self.xp.where(measurement.available > 0.0, P, predicted)
        return self.xp.stack([P[i, i] for i in range(4)]), P
