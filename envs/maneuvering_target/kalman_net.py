r"""The filter of ManeuveringTarget inside the learned estimator ``kalman-net``, which a recurrent network steers.

An extended Kalman filter of position and velocity. At every scan the network outputs nine numbers a in [-1, 1], in
the frame of the predicted velocity (along it, and across it to the left, a rotation U):

    motion   over the next interval T a turn at the rate a_across / v, and speed times 1 + a_along T / v,
             a = largest_acceleration (a8, a9);  F is the Jacobian of the turn
    noise    sigma = nominal_acceleration noise_range^(a1, a2),  R = noise_range^a3 diag(variance)
             Q(sigma) = G U diag(sigma^2) U^T G^T,  G = [T^2 / 2 I, T I],  P' = F P F^T + Q(sigma)
    gain     K = M H^T (H M H^T + W R W^T)^-1,  W = U diag(caution^(a4, a5)) U^T,
             M = F P F^T + Q(agility^(a6, a7) sigma)
    update   x = x' + K nu,  P = (I - K H) P' (I - K H)^T + K R K^T                                 (Joseph form)

All zero is the Kalman filter of constant velocity under white acceleration. Without a measurement K is zero.

The gain of a network on innovations is that of Revach and others, "KalmanNet: Neural Network Aided Kalman Filtering
for Partially Known Dynamics", IEEE Trans. Signal Processing 70 (2022) 1532-1547; the covariance by Joseph's form with
that gain and learned noises is that of Mortada and others, "Recursive KalmanNet: Deep Learning-Augmented Kalman
Filtering for State Estimation with Consistent Uncertainty Quantification" (2025). Reading: their networks output the
gain itself, here the network outputs the noises of a Kalman gain, so that an untrained network is a working filter.
These differ from the noises of the covariance: the best values for one need not be the best for the other. Their
dynamics are given; here the network also outputs the acceleration.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import coordinated_turn
from ...filters.array_namespace import namespace
from ...filters.small_matrices import apply, outer, product, transpose
from ..contract.filter import Bank, Initial
from ..contract.observation import SIGNED_LOG, STORED_AS_LOG, Array, Block, innovation_block, prior_block
from .banks import SCANS_SHOWN
from .parameters import ManeuveringTargetParameters
from .problem import TargetProblem
from .world import Measurement

NOMINAL_ACCELERATION = 1.0
"""Standard deviation of the acceleration at action zero, m/s^2, about that of all flights of ``random``."""
NOISE_RANGE = 20.0
"""Largest factor and divisor of the standard deviation of the acceleration, and of the variance of a measurement."""
CAUTION = 5.0
"""Largest factor and divisor of the measurement's sigma in the gain alone."""
AGILITY = 5.0
"""Largest factor and divisor of the deviation of the acceleration."""
LARGEST_ACCELERATION = 8.0
"""Largest acceleration that the network predicts along and across, m/s^2: a third above any flight of ``random``."""
LEAST_SPEED = 20.0
"""Smallest speed by which a turn is divided, m/s: a target at rest has no direction."""
ANSWERS = 9
FRAME = ("along", "across")


class KalmanNetState(NamedTuple):
    """State of the extended Kalman filter, with the values that the network observes."""

    mean: Array
    """Estimate of x, y (m), vx, vy (m/s), ``(4, N)``; predicted between :meth:`KalmanNetBank.predict` and the
    action."""
    covariance: Array
    """Covariance, ``(4, 4, N)``; between ``predict`` and the action without process noise."""
    acceleration: Array
    """Predicted acceleration until the next scan, along and across, m/s^2, ``(2, N)``."""
    deviation: Array
    """Standard deviation of the acceleration in the last scan, ``(N,)``."""
    correction: Array
    """Correction of the velocity in the last scan, m/s."""
    innovation: Array
    """Innovation, m, along and across the predicted velocity, ``(2, N)``."""
    prior: Array
    """Variance of the predicted position with the noise of the last scan, m^2."""
    sensor: Array
    """Variance of the measurement, m^2."""
    coupling: Array
    """Correlation of the measurement errors along and across, ``(N,)``."""


STANDING = 1e-3
"""Speed below which a target has no direction, m/s."""


def speed_of(velocity: Array, least: float = STANDING) -> Array:
    """Return the speed, ``(N,)``, m/s, of a velocity, smoothly limited from below by ``least``."""
    return (velocity[0] * velocity[0] + velocity[1] * velocity[1] + least**2) ** 0.5


def frame_of(velocity: Array) -> Array:
    """Return the rotation U^T, ``(2, 2, N)``, whose rows are the direction of a velocity and that to its left.

    For a velocity of zero the rows are the axes.
    """
    xp = namespace(velocity)
    moves = velocity[0] * velocity[0] + velocity[1] * velocity[1] > STANDING**2
    direction = velocity / speed_of(velocity)
    direction = xp.stack([xp.where(moves, direction[0], 1.0), xp.where(moves, direction[1], 0.0)])
    return xp.stack([direction, xp.stack([-direction[1], direction[0]])])


def sensor_blocks(
    bank: Any, variances: Callable[..., Array], coupling: Callable[..., Array]
) -> Sequence[Block]:
    """Return the observation blocks of a measurement's covariance along and across the velocity.

    ``variances`` along and across, ``(2, N)``, m^2, and ``coupling``, the correlation, are functions of state and
    measurement.
    """
    xp, p = bank.xp, bank.parameters
    return (
        Block(
            "measurement_sigma",
            lambda f, z: 0.5 * xp.log(variances(f, z) * (1.0 / p.range_sigma**2)),
            "the measurement's sigma over range_sigma",
            FRAME,
            STORED_AS_LOG,
        ),
        Block("measurement_correlation", coupling, "correlation of the measurement's errors"),
    )


def clock_blocks(bank: Any) -> Sequence[Block]:
    """Return the observation blocks of predicted speed, scan number, detection and interval of a bank."""
    xp, p = bank.xp, bank.parameters
    return (
        Block(
            "speed",
            lambda f, _: xp.log(speed_of(f.mean[2:], LEAST_SPEED) * 0.01),
            "the predicted speed over 100 m/s",
            compression=STORED_AS_LOG,
        ),
        Block(
            "scan",
            lambda _, measurement: xp.clip(measurement.scan * (1.0 / SCANS_SHOWN), None, 1.0),
            f"scans since the start over {SCANS_SHOWN}, saturating at 1",
        ),
        Block("available", lambda _, measurement: measurement.available, "1 if the scan saw the target"),
        Block(
            "interval",
            lambda _, measurement: xp.log(measurement.interval * (1.0 / p.sampling_interval)),
            "the time since the scan before over sampling_interval",
            compression=STORED_AS_LOG,
        ),
    )


def sensor_covariance(measurement: Measurement, xp: Any) -> Array:
    """Return the covariance of a measured position, m^2, ``(2, 2, N)``."""
    none = 0.0 * measurement.variance[0]
    return xp.stack([xp.stack([measurement.variance[0], none]), xp.stack([none, measurement.variance[1]])])


def advance(mean: Array, acceleration: Array, T: Array) -> tuple[Array, Array]:
    """Return the mean after a turn and change of speed by an acceleration, and the given mean with turn rate.

    Args:
        mean: x, y (m), vx, vy (m/s), ``(4, N)``.
        acceleration: along and across, m/s^2, ``(2, N)``.
        T: interval, s, ``(N,)``.

    Returns:
        The predicted mean, and the given mean with the turn rate as fifth state, ``(5, N)``.
    """
    xp = namespace(mean)
    rate = 1.0 / speed_of(mean[2:], LEAST_SPEED)
    turning = xp.concat([mean, (acceleration[1] * rate)[None]])
    turned = coordinated_turn.propagate(turning, T)
    faster = T * acceleration[0] * rate
    position = mean[:2] + (1.0 + 0.5 * faster) * (turned[:2] - mean[:2])
    return xp.concat([position, (1.0 + faster) * turned[2:4]]), turning


class KalmanNetBank(Bank[TargetProblem, Measurement, KalmanNetState]):
    """Bank of the learned estimator ``kalman-net``: the action sets noises, gain and motion of a Kalman filter."""

    parameters: ManeuveringTargetParameters
    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(-1.0, 1.0, (ANSWERS,), numpy.float32)

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        # Columns of the identity.
        columns = numpy.eye(4)[:, :, None]
        self.positions: Array = task.constant(columns[:, :2])
        self.velocities: Array = task.constant(columns[:, 2:])

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks, such as innovation, last correction, predicted and measured deviations, and the time."""
        xp, p = self.xp, self.parameters
        return (
            innovation_block(FRAME, value=lambda f, _: f.innovation / xp.sqrt(f.prior + f.sensor)),
            Block(
                "correction",
                lambda f, _: f.correction * (1.0 / (NOMINAL_ACCELERATION * p.sampling_interval)),
                "the last correction of the velocity over what 1 m/s^2 makes of it in a scan period",
                FRAME,
                SIGNED_LOG,
            ),
            prior_block(FRAME, value=lambda f, _: 0.5 * xp.log(f.prior / f.sensor)),
            *sensor_blocks(self, lambda f, _: f.sensor, lambda f, _: f.coupling),
            Block(
                "acceleration",
                lambda f, _: f.acceleration * (1.0 / LARGEST_ACCELERATION),
                "acceleration predicted for this scan over the largest",
                FRAME,
            ),
            Block(
                "deviation",
                lambda f, _: xp.log(f.deviation * (1.0 / NOMINAL_ACCELERATION)),
                "the sigma of the acceleration in the last scan over the nominal one",
                FRAME,
                STORED_AS_LOG,
            ),
            *clock_blocks(self),
        )

    def start(self, initial: Initial) -> KalmanNetState:
        """Return the filter's state at the start of the track, from the initial estimate."""
        none = 0.0 * initial.mean[:2]
        sensor = self.xp.stack([initial.covariance[0, 0], initial.covariance[1, 1]])
        deviation = NOMINAL_ACCELERATION + none
        return KalmanNetState(
            initial.mean, initial.covariance, none, deviation, none, none, sensor, sensor, none[0]
        )

    def predict(self, state: KalmanNetState, measurement: Measurement) -> KalmanNetState:
        """Return the state predicted to the scan with the last action's acceleration, with innovation statistics."""
        xp, T = self.xp, measurement.interval
        mean, turning = advance(state.mean, state.acceleration, T)
        F = coordinated_turn.jacobian(turning, T)[:4, :4]
        carried = product(product(F, state.covariance), transpose(F))
        frame = frame_of(mean[2:])
        noise = self.noise(frame, state.deviation, T)
        R = sensor_covariance(measurement, xp)
        sensor = product(product(frame, R), transpose(frame))
        prior = product(product(frame, carried[:2, :2] + noise[:2, :2]), transpose(frame))
        innovation = measurement.available * (measurement.position - mean[:2])
        variances = xp.stack([sensor[0, 0], sensor[1, 1]])
        return state._replace(
            mean=mean,
            covariance=carried,
            innovation=apply(frame, innovation),
            prior=xp.stack([prior[0, 0], prior[1, 1]]),
            sensor=variances,
            coupling=sensor[0, 1] / xp.sqrt(variances[0] * variances[1]),
        )

    def noise(self, frame: Array, deviation: Array, T: Array) -> Array:
        """Return the process noise covariance of accelerations along and across, over intervals, ``(4, 4, N)``.

        ``frame`` has the rows along and across, ``(2, 2, N)``; ``deviation`` is of each, m/s^2, ``(2, N)``.
        """
        xp = self.xp
        variance = deviation * deviation
        E = outer(variance[0] * frame[0], frame[0]) + outer(variance[1] * frame[1], frame[1])
        square = T * T
        corner, middle, velocity = (0.25 * square * square) * E, (0.5 * square * T) * E, square * E
        return xp.concat([xp.concat([corner, middle], axis=1), xp.concat([middle, velocity], axis=1)])

    def act(self, state: KalmanNetState, measurement: Measurement, action: Array) -> KalmanNetState:
        """Return the state updated with noises and gain of the action, whose acceleration the next prediction uses."""
        xp, available = self.xp, measurement.available
        a = xp.clip(action, -1.0, 1.0)
        frame = frame_of(state.mean[2:])
        inverse = transpose(frame)
        deviation = NOMINAL_ACCELERATION * xp.exp(math.log(NOISE_RANGE) * a[:2])
        P = state.covariance + self.noise(frame, deviation, measurement.interval)
        agile = deviation * xp.exp(math.log(AGILITY) * a[5:7])
        M = state.covariance[:, :2] + self.noise(frame, agile, measurement.interval)[:, :2]
        R = sensor_covariance(measurement, xp) * xp.exp(math.log(NOISE_RANGE) * a[2])
        caution = product(inverse, xp.exp(math.log(CAUTION) * a[3:5])[:, None] * frame)
        S = M[:2] + product(product(caution, R), caution)
        share = available / (S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1])
        inverted = share * xp.stack([xp.stack([S[1, 1], -S[0, 1]]), xp.stack([-S[0, 1], S[0, 0]])])
        K = product(M, inverted)
        correction = apply(K, apply(inverse, state.innovation))
        rest = xp.concat([self.positions - K, self.velocities + 0.0 * K], axis=1)
        joseph = product(product(rest, P), transpose(rest)) + product(product(K, R), transpose(K))
        return state._replace(
            mean=state.mean + correction,
            covariance=0.5 * (joseph + transpose(joseph)),
            acceleration=LARGEST_ACCELERATION * a[7:9],
            deviation=deviation,
            correction=apply(frame, correction[2:]),
        )
