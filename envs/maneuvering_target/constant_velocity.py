"""The constant-velocity model of ManeuveringTarget, over the time between two scans, whatever it is."""

import math
from types import ModuleType
from typing import Any

from ...filters import kalman
from ...filters.small_matrices import outer
from ..contract.filter import EstimateState, Filter, Initial, Likelihood
from ..contract.observation import Array
from .parameters import ManeuveringTargetParameters
from .problem import TargetProblem
from .world import Measurement


class ConstantVelocityModel:
    """The constant-velocity model in x and y."""

    def __init__(self, task: TargetProblem) -> None:
        self.task = task
        self.parameters: ManeuveringTargetParameters = task.parameters
        self.xp: ModuleType = task.xp
        moved, noise = kalman.white_acceleration(1.0, 1.0, axes=2)
        self.unmoved: Array = task.constant(kalman.white_acceleration(0.0, 1.0, axes=2)[0])[:, :, None]
        self.moved: Array = task.constant(moved)[:, :, None] - self.unmoved
        self.correlated: Array = task.constant([[float(q > 0.0) for q in row] for row in noise])[:, :, None]
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        self.identity: Array = task.constant([[1.0, 0.0], [0.0, 1.0]])[:, :, None]

    def motion(self, T: Array) -> tuple[Array, Array]:
        """Return the transition matrix, and covariance of the process noise by an acceleration of 1 m/s^2, over
        intervals.

        Args:
            T: s, ``(N,)``.

        Returns:
            :func:`.kalman.white_acceleration` of each, ``(4, 4, N)``.
        """
        by_acceleration = self.xp.stack([0.5 * T**2, 0.5 * T**2, T, T])
        return self.unmoved + T * self.moved, self.correlated * outer(by_acceleration, by_acceleration)

    def where_detected(self, measurement: Measurement, then: Any, otherwise: Any) -> Any:
        """Return one of two tuples of arrays where the scan saw the target, the other where it missed it."""
        there = measurement.available > 0.0
        parts = zip(then, otherwise, strict=True)
        return type(then)(*(self.xp.where(there, seen, missed) for seen, missed in parts))

    def likelihood(self, measurement: Measurement, log_likelihood: Array, nis: Array) -> Likelihood:
        """Return the likelihood of a scan; NaN where it missed the target."""
        there = measurement.available > 0.0
        log_likelihood, nis = (self.xp.where(there, values, math.nan) for values in (log_likelihood, nis))
        return Likelihood(log_likelihood, nis, 2.0 * measurement.available)

    def update_estimate(
        self, predicted: tuple[Array, Array], measurement: Measurement, H: Array | None = None
    ) -> kalman.Update:
        """Return Kalman's update of a predicted mean and covariance with the measured position, or these
        themselves, which say nothing of how likely they are; H is that of the position unless another one is
        given.
        """
        H = self.H if H is None else H
        result = kalman.update(*predicted, measurement.position, H, self.identity * measurement.variance)
        return self.where_detected(measurement, result, kalman.Update(*predicted, 0.0, 0.0))


class KalmanModel(ConstantVelocityModel, Filter[Any, Any, Any]):
    """Base of the estimators with the constant-velocity model."""

    def start(self, initial: Initial) -> Any:
        """Start from the initial estimate."""
        return self.first_track(initial)

    def first_track(self, initial: Initial) -> EstimateState:
        """Return the estimate before the first scan."""
        return EstimateState(*initial[:2], Likelihood.unknown(initial.mean[0]))

    def mean(self, state: Any) -> Array:
        """Return the position and velocity, without further states."""
        return state.mean[:4]

    def covariance(self, state: Any) -> Array:
        """Return the covariance of position and velocity, without further states."""
        return state.covariance[:4, :4]

    def track(self, measurement: Measurement, result: kalman.Update) -> EstimateState:
        """Return the state after an update."""
        return EstimateState(result.mean, result.covariance, self.likelihood(measurement, *result[2:]))
