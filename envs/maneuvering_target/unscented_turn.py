"""The nearly coordinated turn of ManeuveringTarget, and the estimator ``unscented-turn``, its unscented filter."""

import math

from ...filters import coordinated_turn, unscented
from ..contract.filter import EstimateState, FilterInput, Initial
from ..contract.observation import Array
from .constant_velocity import ConstantVelocityModel, KalmanModel
from .problem import TargetProblem

DEGREE = math.pi / 180.0


class TurnModel(ConstantVelocityModel):
    """Model of a nearly coordinated turn, with the turn rate as fifth state.

    Args:
        acceleration: standard deviation of the acceleration along x and y, m/s^2.
        turn_rate_change: standard deviation of the change of the turn rate from scan to scan, degrees/s.
    """

    def __init__(self, task: TargetProblem, acceleration: float, turn_rate_change: float) -> None:
        super().__init__(task)
        self.variance: float = acceleration**2
        self.change: float = DEGREE * turn_rate_change / task.parameters.sampling_interval
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]])

    def noise(self, T: Array, acceleration: float | Array = 1.0, turn_rate: float | Array = 1.0) -> Array:
        """Return the process noise covariance over intervals, s, ``(5, 5, N)``, with factors on its variances."""
        Q = (acceleration * self.variance) * self.motion(T)[1]
        change = turn_rate * (T * self.change) ** 2
        return coordinated_turn.augment_turn_rate(0.0 * Q[0], Q, change)[1]

    def predict_turn(self, mean: Array, covariance: Array, T: Array) -> tuple[Array, Array]:
        """Return the mean and covariance that an extended Kalman filter of the turn predicts over intervals, s."""
        return coordinated_turn.predict(mean, covariance, T, self.noise(T))


class UnscentedTurn(TurnModel, KalmanModel):
    """Unscented Kalman filter of position, velocity and turn rate in a nearly coordinated turn.

    The measurement is linear, so only the prediction takes the unscented transform; the update is Kalman's.

    Args:
        acceleration: standard deviation of the acceleration along x and y, m/s^2.
        turn_rate_change: standard deviation of the change of the turn rate from scan to scan, degrees/s.
        turn_rate_start: standard deviation of the turn rate at the start of the track, degrees/s.
    """

    def __init__(
        self,
        task: TargetProblem,
        acceleration: float = 0.3,
        turn_rate_change: float = 0.3,
        turn_rate_start: float = 2.0,
    ) -> None:
        super().__init__(task, acceleration, turn_rate_change)
        self.turn_variance: float = (DEGREE * turn_rate_start) ** 2

    def start(self, initial: Initial) -> EstimateState:
        """Return the filter's state at the initial estimate, with a turn rate of mean zero."""
        return super().start(Initial(*coordinated_turn.augment_turn_rate(*initial[:2], self.turn_variance)))

    def predict_turn(self, mean: Array, covariance: Array, T: Array) -> tuple[Array, Array]:
        """Return the mean and covariance of sigma points after a turn over intervals, s, with process noise."""
        mean, covariance = unscented.transform(
            mean, covariance, lambda points: coordinated_turn.propagate(points, T)
        )
        return mean, covariance + self.noise(T)

    def update(self, state: EstimateState, inputs: FilterInput) -> EstimateState:
        """Return the state predicted to a scan and updated with the measured position."""
        predicted = self.predict_turn(state.mean, state.covariance, inputs.measurement.interval)
        return self.track(inputs.measurement, self.update_estimate(predicted, inputs.measurement))
