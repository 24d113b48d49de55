r"""The reference estimator of RadarEsmTracking, and its bound.

Where the radar's errors are coloured the state has two more components, the coloured errors of range and range rate in
m and m/s, with ``e(k) = psi e(k-1) + w``: the augmented filter of a first-order Gauss-Markov error (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.2).
"""

from types import ModuleType
from typing import NamedTuple

from ...envs.contract.filter import Likelihood
from ...envs.contract.observation import Array
from ...envs.radar_esm_tracking.task import RadarEsmTracking
from ...envs.radar_esm_tracking.world import Measurement, Start, Truth
from ...filters import bounds, kalman
from ...filters.small_matrices import mirror_lower

NOTHING = 1e-12
"""Variance of an absent coloured error, in units of the white one: the covariance stays positive definite."""


class KnownClassState(NamedTuple):
    """Estimate, and the class that governs the next motion."""

    mean: Array
    """Mean of the state, ``(n, N)``; n = 3, or 5 with the radar's coloured errors."""
    covariance: Array
    """Covariance of the state, ``(n, n, N)``."""
    target_class: Array
    """Index of the class that governs the next motion, ``(N,)``."""


class _KnownDraw:
    """Base of reference and bound: the episode's true class selects the model at every scan."""

    knows = (
        "the true class at every scan, in which scans there is glint, how strong and how lasting the radar's coloured "
        "errors are, and how its white ones are correlated"
    )
    disturbances: tuple[str, ...] = ("glint",)
    traceable = True

    def __init__(self, task: RadarEsmTracking) -> None:
        p = task.parameters
        self.task = task
        self.xp: ModuleType = task.xp
        self.start_covariance: Array = task.constant(task.design_models(p)[1])
        self.coloured: bool = p.radar_coloured[1] > 0.0
        self.deviations: tuple[float, float] = p.range_sigma, p.range_rate_sigma
        # Range and range rate are measured, with their coloured errors.
        self.H = task.constant(
            [[float(j in (i, i + 3)) for j in range(5 if self.coloured else 3)] for i in range(2)]
        )

    def start(self, initial: Start, truth: Truth) -> KnownClassState:
        """Return the state at the initial estimate, with the true class's covariance and the true correlation of
        errors.
        """
        mean, P = initial.mean, self.of(self.start_covariance, truth.target_class)
        white, zero = self.white(truth), 0.0 * truth.radar_correlation
        start = [[P[i, j] if i == j else zero for j in range(3)] for i in range(3)]
        for i in range(2):
            for j in range(2):
                start[i][j] = white[i, j]
        if self.coloured:
            mean = self.xp.concat([mean, 0.0 * mean[:2]])
            share = truth.radar_coloured**2 + NOTHING
            for row in start:
                row += [zero, zero]
            start += [[zero] * 5, [zero] * 5]
            for i, sigma in enumerate(self.deviations):
                variance = share * sigma**2
                start[i][i] = start[i][i] + variance
                start[i + 3][i + 3] = variance
                start[i][i + 3] = start[i + 3][i] = -variance
        return KnownClassState(mean, self.matrix(start), truth.target_class)

    def matrix(self, rows: list[list[Array]]) -> Array:
        """Return a matrix ``(n, m, N)`` from rows of entries ``(N,)``."""
        return self.xp.stack([self.xp.stack(row) for row in rows])

    def of(self, matrices: Array, target_class: Array) -> Array:
        """Select the matrix of each episode's class, ``(3, 3, N)``, from those of all classes ``(3, 3, M)``."""
        return self.xp.take(matrices, target_class, axis=-1)

    def white(self, truth: Truth) -> Array:
        """Return the covariance of this scan's white errors, ``(2, 2, N)``."""
        (a, b), factor = self.deviations, self.task.world.error_factor(truth) ** 2
        cross = a * b * factor * truth.radar_correlation
        return self.matrix([[a * a * factor, cross], [cross, b * b * factor]])

    def motion(self, truth: Truth, governed: Array) -> tuple[Array, Array]:
        """Return transition and process noise ``(n, n, N)`` from the last scan to this one, of the class
        ``governed``.
        """
        models = self.task.models
        F, Q = self.of(models.Phi, governed), self.of(models.Q, governed)
        if not self.coloured:
            return F, Q
        zero, size = 0.0 * truth.radar_decay, range(5)
        gained = truth.radar_kick**2 + NOTHING

        def augment(matrix: Array, own: list[Array]) -> Array:
            return self.matrix(
                [
                    [matrix[i, j] if max(i, j) < 3 else own[i - 3] if i == j else zero for j in size]
                    for i in size
                ]
            )

        return (
            augment(F, [truth.radar_decay] * 2),
            augment(Q, [gained * sigma**2 for sigma in self.deviations]),
        )


class Ideal(_KnownDraw):
    """The Kalman filter that knows the draw of the episode: the optimal one, given it."""

    kind = "reference"

    def update(
        self, memory: KnownClassState, measurement: Measurement, truth: Truth
    ) -> tuple[Array, Array, KnownClassState, Likelihood]:
        """Predict under the true class and update; return mean, covariance, memory and likelihood."""
        F, Q = self.motion(truth, memory.target_class)
        mean, covariance = kalman.predict(memory.mean, memory.covariance, F, Q)
        result = kalman.update(mean, covariance, measurement.radar, self.H, self.white(truth))
        covariance = mirror_lower(result.covariance)
        track = KnownClassState(result.mean, covariance, truth.target_class)
        degrees = 2.0 + 0.0 * result.log_likelihood
        return result.mean[:3], covariance[:3, :3], track, Likelihood(*result[2:], degrees)


class KnownDrawBound(_KnownDraw):
    """Exact mean square error of the ideal filter, by its covariance recursion: no estimator does better."""

    kind = "bound"

    def update(
        self, memory: KnownClassState, measurement: Measurement, truth: Truth
    ) -> tuple[Array, KnownClassState]:
        """Return the bound on the variances after this scan, ``(3, N)``, and the memory."""
        F, Q = self.motion(truth, memory.target_class)
        P = bounds.predict_bound(memory.covariance, F, Q)
        P = bounds.posterior_cramer_rao_bound(P, self.H, self.white(truth))
        return self.xp.stack([P[i, i] for i in range(3)]), KnownClassState(memory.mean, P, truth.target_class)
