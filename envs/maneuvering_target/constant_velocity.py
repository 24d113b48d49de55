"""The constant-velocity model of ManeuveringTarget over any time between two scans, and the base of its filters."""

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
    """Constant-velocity model in x and y over any interval, and its update with a measured position."""

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
        """Return F and the process noise of an acceleration of 1 m/s^2 over intervals ``T`` (s), ``(4, 4, N)``."""
        by_acceleration = self.xp.stack([0.5 * T**2, 0.5 * T**2, T, T])
        return self.unmoved + T * self.moved, self.correlated * outer(by_acceleration, by_acceleration)

    def where_detected(self, measurement: Measurement, then: Any, otherwise: Any) -> Any:
        """Return ``then`` where the scan saw the target, else ``otherwise``; both are tuples of arrays."""
        there = measurement.available > 0.0
        parts = zip(then, otherwise, strict=True)
        return type(then)(*(self.xp.where(there, seen, missed) for seen, missed in parts))

    def likelihood(self, measurement: Measurement, log_likelihood: Array, nis: Array) -> Likelihood:
        """Return the :class:`Likelihood` of a scan; NaN where it missed the target."""
        there = measurement.available > 0.0
        log_likelihood, nis = (self.xp.where(there, values, math.nan) for values in (log_likelihood, nis))
        return Likelihood(log_likelihood, nis, 2.0 * measurement.available)

    def update_estimate(
        self, predicted: tuple[Array, Array], measurement: Measurement, H: Array | None = None
    ) -> kalman.Update:
        """Return Kalman's update of a predicted mean and covariance with the measured position.

        Where the scan missed the target they are unchanged, with likelihood and NIS zero.

        Args:
            predicted: mean ``(n, N)`` and covariance ``(n, n, N)``.
            measurement: the scan.
            H: matrix ``(2, n)`` of the measured position; None: that of the model.
        """
        H = self.H if H is None else H
        result = kalman.update(*predicted, measurement.position, H, self.identity * measurement.variance)
        return self.where_detected(measurement, result, kalman.Update(*predicted, 0.0, 0.0))


class KalmanModel(ConstantVelocityModel, Filter[Any, Any, Any]):
    """Base class of the estimators with the constant-velocity model."""

    def start(self, initial: Initial) -> Any:
        """Return the filter's state at the start of a track, from the initial estimate."""
        return self.first_track(initial)

    def first_track(self, initial: Initial) -> EstimateState:
        """Return the initial estimate as the state of one Kalman filter, with unknown likelihood."""
        return EstimateState(*initial[:2], Likelihood.unknown(initial.mean[0]))

    def mean(self, state: Any) -> Array:
        """Return the mean of position and velocity, ``(4, N)``, without further components of the state."""
        return state.mean[:4]

    def covariance(self, state: Any) -> Array:
        """Return the covariance of position and velocity, ``(4, 4, N)``, without further components."""
        return state.covariance[:4, :4]

    def track(self, measurement: Measurement, result: kalman.Update) -> EstimateState:
        """Return the result of a Kalman update as a filter's state, with the measurement's likelihood."""
        return EstimateState(result.mean, result.covariance, self.likelihood(measurement, *result[2:]))
