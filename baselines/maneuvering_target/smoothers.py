"""Smoothers of ManeuveringTarget: its Kalman filters with later scans.

Their forward passes are those estimators; with lag zero they return the same estimates.
"""

from collections.abc import Sequence
from typing import Any

from ...envs.contract.filter import EstimateState
from ...envs.contract.observation import Array
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.world import Measurement
from ...filters import coordinated_turn, imm, scans, smoothing
from ...filters.small_matrices import apply
from ..table import Variant
from .estimators import (
    ConstantVelocity,
    KalmanInteractingMultipleModel,
    KalmanMixture,
    KalmanTurnInteractingMultipleModel,
)


class ConstantVelocitySmoother(ConstantVelocity):
    """One Kalman filter of constant velocity with white acceleration, smoothed (Rauch, Tung and Striebel 1965).

    Args:
        acceleration: standard deviation of the acceleration, m/s^2.
        lag: number of later scans that each estimate uses; default: all of them.
    """

    kind = "smoother"

    def __init__(self, task: ManeuveringTarget, acceleration: float = 1.0, lag: int | None = None) -> None:
        super().__init__(task, acceleration)
        self.lag = lag

    def _motion(self, mean: Array, measurement: Measurement) -> smoothing.Motion:
        F, unit = self.motion(measurement.interval)
        return smoothing.Motion(F, self.variance * unit, apply(F, mean))

    def smooth(
        self, measurements: Sequence[Measurement], states: Sequence[EstimateState]
    ) -> tuple[Array, Array]:
        """Return means ``(4, K, N)`` and covariances of a track, smoothed with all later scans or those within
        the lag.
        """
        filtered = smoothing.Gaussian(*scans.stack_scans(states)[:2])
        motion = scans.by_stretches(self._motion, filtered.mean, scans.stack_scans(measurements))
        smoothed = smoothing.smooth(filtered, motion, self.lag)
        return smoothed.mean[:, 1:], smoothed.covariance[:, :, 1:]


class KalmanIMMSmoother(KalmanInteractingMultipleModel):
    """The usual IMM over two Kalman filters of constant velocity, smoothed by a second filter backward in time.

    Args:
        lag: number of later scans that each estimate uses; default: all of them.
        **arguments: arguments of :class:`.KalmanInteractingMultipleModel`.
    """

    kind = "smoother"

    def __init__(self, task: ManeuveringTarget, lag: int | None = None, **arguments: Any) -> None:
        super().__init__(task, **arguments)
        self.lag = lag

    def motions(self, mixed: Array, T: Array) -> smoothing.Motion:
        """Return transition and process noise of every filter over intervals, and the predicted means."""
        F, unit = self.motion(T)
        Q = self.xp.stack([variance * unit for variance in self.variances], axis=2)
        F = F[:, :, None]
        return smoothing.Motion(F, Q, apply(F, mixed))

    def _arrival(self, bank: smoothing.GaussianMixture, measurement: Measurement) -> smoothing.Arrival:
        xp = self.xp
        prediction = imm.predict_mode_probabilities(self.transition, bank.probabilities)
        mixed, _ = imm.mix(bank.mean, bank.covariance, prediction.mixing)
        there = measurement.available > 0.0
        H = self.xp.zeros((2, bank.mean.shape[0], 1), dtype=bank.mean.dtype, device=self.task.device)
        H = H + xp.eye(2, bank.mean.shape[0], dtype=bank.mean.dtype, device=self.task.device)[:, :, None]
        return smoothing.Arrival(
            self.motions(mixed, measurement.interval),
            H + 0.0 * measurement.interval,
            self.identity * xp.where(there, 1.0 / measurement.variance, 0.0),
            xp.where(there, measurement.position, 0.0),
        )

    def smooth(
        self, measurements: Sequence[Measurement], states: Sequence[KalmanMixture]
    ) -> tuple[Array, Array]:
        """Return means ``(4, K, N)`` and covariances of a track, smoothed with all later scans or those within
        the lag.
        """
        filtered = smoothing.GaussianMixture(*scans.stack_scans(states)[3:])
        arrival = scans.by_stretches(self._arrival, filtered, scans.stack_scans(measurements))

        def estimate(bank: smoothing.GaussianMixture) -> tuple[Array, Array]:
            mean, covariance = imm.combine(*bank)
            return mean[:4], covariance[:4, :4]

        mean, covariance = smoothing.smooth_imm(filtered, arrival, self.transition, self.lag, estimate)
        return mean[:, 1:], covariance[:, :, 1:]


class KalmanTurnIMMSmoother(KalmanIMMSmoother, KalmanTurnInteractingMultipleModel):
    """IMM over quiet and noisy constant velocity and the coordinated turn, smoothed by a second filter backward.

    The turn is linearised where the filter has linearised it. A filter of constant velocity discards the turn rate: its
    transition is zero there, and its noise is the variance of a turn that begins.

    Args:
        lag: number of later scans that each estimate uses; default: all of them.
        **arguments: arguments of :class:`.KalmanTurnInteractingMultipleModel`.
    """

    def motions(self, mixed: Array, T: Array) -> smoothing.Motion:
        """Return transition, process noise and predicted mean of every filter; see
        :meth:`KalmanIMMSmoother.motions`.
        """
        xp = self.xp
        F, unit = self.motion(T)
        nothing = 0.0 * unit[0]
        straight = coordinated_turn.augment_turn_rate(nothing, F, 0.0)[1]
        noises = [
            coordinated_turn.augment_turn_rate(nothing, variance * unit, self.turn_variance)[1]
            for variance in self.variances
        ]
        turning = coordinated_turn.jacobian(mixed[:, 2], T)
        predicted = [apply(straight, mixed[:, j]) for j in range(2)]
        return smoothing.Motion(
            xp.stack([straight, straight, turning], axis=2),
            xp.stack([*noises, self.turn.noise(T)], axis=2),
            xp.stack([*predicted, coordinated_turn.propagate(mixed[:, 2], T)], axis=1),
        )


SMOOTHERS: dict[str, Any] = {
    "kalman-smoother": ConstantVelocitySmoother,
    "imm-smoother": KalmanIMMSmoother,
    "imm-turn-smoother": KalmanTurnIMMSmoother,
    "imm-lag-1": Variant(KalmanIMMSmoother, "``imm-smoother`` that waits for one later scan only.", lag=1),
    "imm-lag-2": Variant(KalmanIMMSmoother, "``imm-smoother`` that waits for two later scans only.", lag=2),
    "imm-lag-5": Variant(KalmanIMMSmoother, "``imm-smoother`` that waits for five later scans only.", lag=5),
}
