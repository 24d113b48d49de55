"""The reference estimator of RadarEsmTracking, and its bound."""

from typing import NamedTuple

from ...envs.observation import Array
from ...envs.radar_esm_tracking.task import RadarEsmTracking
from ...envs.radar_esm_tracking.world import Measurement, Start, Truth
from ...evaluation.competitors import Likelihood
from ...filters import bounds, kalman


class Track(NamedTuple):
    """Estimate, and the class that governs the coming motion."""

    mean: Array
    """``(3, N)``."""
    covariance: Array
    """``(3, 3, N)``."""
    target_class: Array
    """``(N,)``."""


class _KnownClass:
    """Models that the true class chooses scan by scan."""

    knows = "the true class at every scan"
    traceable = True

    def __init__(self, task: RadarEsmTracking) -> None:
        self.task = task
        self.start_covariance = task.constant(task.design_models(task.parameters)[1])

    def start(self, initial: Start, truth: Truth) -> Track:
        """Start where the filter of the true class starts."""
        return Track(initial.mean, self.of(self.start_covariance, truth.target_class), truth.target_class)

    def of(self, matrices: Array, target_class: Array) -> Array:
        """Matrix of each lane's class, ``(3, 3, N)``."""
        return self.task.xp.take(matrices, target_class, axis=-1)


class Ideal(_KnownClass):
    """The Kalman filter of the true class; where the class changes it switches its model at that scan."""

    kind = "reference"

    def update(
        self, measurement: Measurement, truth: Truth, memory: Track
    ) -> tuple[Array, Array, Track, Likelihood]:
        """Predict under the class that governed the motion, and update."""
        models, governed = self.task.models, memory.target_class
        mean, covariance = kalman.predict(
            memory.mean, memory.covariance, self.of(models.Phi, governed), self.of(models.Q, governed)
        )
        result = kalman.update(mean, covariance, measurement.radar, models.H, models.R)
        track = Track(result.mean, result.covariance, truth.target_class)
        degrees = float(models.H.shape[0]) + 0.0 * result.log_likelihood
        return result.mean, result.covariance, track, Likelihood(*result[2:], degrees)


class KnownClassBound(_KnownClass):
    """Exact mean square error of the ideal filter, by its covariance recursion: no estimator does better."""

    kind = "bound"

    def update(self, measurement: Measurement, truth: Truth, memory: Track) -> tuple[Array, Track]:
        """Bound after this scan: the diagonal of the covariance."""
        models, governed = self.task.models, memory.target_class
        P = bounds.predict_bound(
            memory.covariance, self.of(models.Phi, governed), self.of(models.Q, governed)
        )
        P = bounds.posterior_cramer_rao_bound(P, models.H, models.R)
        mean_square = self.task.xp.stack([P[i, i] for i in range(3)])
        return mean_square, Track(memory.mean, P, truth.target_class)
