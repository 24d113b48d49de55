r"""Banks of a task of state-space models: one extended Kalman filter, or an interacting multiple model (IMM).

With a the action in [-1, 1], and the model's Q, R, its Jacobians F, H and the predicted mean x' = f(x):

    noise     P' = F P F^T + 10^(d a1) Q,  R' = 10^(d a2) R,  d = noise_decades
    gain      K = diag(c^a) P' H^T (H P' H^T + R)^-1,  c = gain_factor, in Joseph's form
    evidence  nats added to the log-posterior of each hypothesis of the IMM

Zero is the filter as written.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import imm
from ...filters.angles import unwrap
from ...filters.innovation_update import Received, update_with_gain
from ...filters.ordered_sums import ordered_sum
from ...filters.small_matrices import outer, product, transpose
from ..contract.controls import bank_action_space, bank_probabilities
from ..contract.filter import Bank, Initial
from ..contract.observation import (
    AVERAGE_OF_LOG1P,
    SHARE,
    SIGNED_LOG,
    STORED_AS_LOG,
    Array,
    Block,
    availability_block,
    innovation_block,
    last_action_block,
    nis_block,
    relative_likelihood_block,
)
from .equations import Equations, StateSpaceMeasurement, StateSpaceProblem
from .parameters import StateSpaceParameters

AVERAGE_WEIGHT = 0.1
"""Weight of the newest measurement in the observed averages."""
NOISE_RANGE = 20.0
"""Largest factor and divisor of each standard deviation of the process and measurement noise, in ``kalman-net``."""
AGILITY = 5.0
"""Largest factor and divisor of the standard deviations in the gain alone, in ``kalman-net``."""
OFFSET = 5.0
"""Largest offset of the predicted state, in standard deviations of the process noise, in ``kalman-net``."""


class ExtendedKalmanState(NamedTuple):
    """State of an extended Kalman filter: estimate, innovation statistics, last action and correction."""

    mean: Array
    """Mean, ``(n, N)``; predicted between ``predict`` and the action."""
    covariance: Array
    """Covariance, ``(n, n, N)``; between ``predict`` and the action predicted without process noise."""
    innovation: Array
    """Innovation over its predicted sigma, ``(m, N)``."""
    nis: Array
    """Normalised innovation squared of the received values, ``(N,)``."""
    log_likelihood: Array
    """Log-density of the last measurement under its prediction, ``(N,)``."""
    average: Array
    """Exponential average of log(1 + nis / degrees), ``(N,)``."""
    action: Array
    """Action of the last measurement, ``(A, N)``."""
    correction: Array | None = None
    """Correction of the state by the last update, in standard deviations of the process noise, ``(n, N)``; None where
    it is not observed."""


class StateSpaceBank(Bank[StateSpaceProblem, StateSpaceMeasurement, ExtendedKalmanState]):
    """Base class of the banks of one extended Kalman filter."""

    parameters: StateSpaceParameters

    def __init__(self, task: StateSpaceProblem, control: str) -> None:
        super().__init__(task, control)
        self.equations: Equations = task.filter_equations[0]
        own = self.equations.model
        self.states: int = own.f.size
        self.sensors: int = own.h.size

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box [-1, 1] with one number for each component of the action."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.action_names),), numpy.float32)

    @property
    def action_names(self) -> Sequence[str]:
        """Names of the components of the action, in order; subclasses define them."""
        raise NotImplementedError

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: innovation over sigma, NIS, its average, availability, the last action."""
        parts = tuple(map(str, range(1, self.sensors + 1))) if self.sensors > 1 else ()
        return (
            innovation_block(parts, text="innovations over their sigma"),
            nis_block(),
            Block(
                "average_nis",
                lambda f, _: f.average,
                "average of log(1 + nis) of a number of the measurement",
                compression=AVERAGE_OF_LOG1P,
            ),
            availability_block(parts=parts),
            last_action_block(self.action_names),
        )

    def start(self, initial: Initial) -> ExtendedKalmanState:
        """Return the filter's state at the start of the track, from the initial estimate."""
        zero = 0.0 * initial.mean[0]
        return ExtendedKalmanState(
            initial.mean,
            initial.covariance,
            self.xp.stack([zero] * self.sensors),
            zero,
            zero,
            zero + math.log(2.0),
            self.xp.stack([zero] * len(self.action_names)),
        )

    def process_noise(self, mean: Array, measurement: StateSpaceMeasurement, action: Array) -> Array:
        """Return the process noise Q at a predicted mean under an action, ``(n, n, N)`` or ``(n, n, 1)``."""
        return self.equations.process_noise(mean, measurement)

    def sensor_noise(self, mean: Array, measurement: StateSpaceMeasurement, action: Array) -> Array:
        """Return the measurement noise R at a predicted mean under an action, ``(m, m, N)`` or ``(m, m, 1)``."""
        return self.equations.sensor_noise(mean, measurement)

    def predict(self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement) -> ExtendedKalmanState:
        """Return the state predicted to a measurement, with innovation statistics under the last action."""
        mean, carried = self.equations.predict_moments(state.mean, state.covariance, measurement)
        return self.compare(state._replace(mean=mean, covariance=carried), measurement)

    def compare(self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement) -> ExtendedKalmanState:
        """Return the state with statistics of a measurement under its prediction, such as innovation and NIS."""
        xp = self.xp
        received = self.receive(state, measurement, state.action)
        P = state.covariance + self.process_noise(state.mean, measurement, state.action)
        S = product(product(received.H, P), transpose(received.H)) + received.R
        sigma = xp.sqrt(xp.stack([S[j, j] for j in range(self.sensors)]))
        result = update_with_gain(state.mean, P, received, 0.0 * transpose(received.H))
        degrees = ordered_sum(measurement.available)
        share = result.squared_distance / xp.maximum(degrees, 1.0 + 0.0 * degrees)
        weight = AVERAGE_WEIGHT * xp.minimum(degrees, 1.0 + 0.0 * degrees)
        return state._replace(
            innovation=received.innovation / sigma,
            nis=result.squared_distance,
            log_likelihood=result.log_likelihood,
            average=state.average + weight * (xp.log1p(share) - state.average),
        )

    def receive(
        self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement, action: Array
    ) -> Received:
        """Return innovation, H and R of the received numbers under an action."""
        R = self.sensor_noise(state.mean, measurement, action)
        return self.equations.receive(measurement, state.mean, R)

    def records(self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement) -> dict[str, Array]:
        """Return the log-likelihood, NIS and its degrees of freedom by name; NaN where nothing was received."""
        degrees = ordered_sum(measurement.available)
        there = degrees > 0.0
        return {
            "log_likelihood": self.xp.where(there, state.log_likelihood, math.nan),
            "nis": self.xp.where(there, state.nis, math.nan),
            "nis_degrees": degrees,
        }


class StateSpaceNoiseBank(StateSpaceBank):
    """Bank of the control ``noise``: the action scales Q and R of an extended Kalman filter."""

    action_names: Sequence[str] = ("process", "measurement")

    def _scale(self, action: Array, entry: int) -> Array:
        return self.xp.exp((self.parameters.noise_decades * math.log(10.0)) * action[entry])

    def process_noise(self, mean: Array, measurement: StateSpaceMeasurement, action: Array) -> Array:
        """Return the process noise Q scaled by the action, ``(n, n, N)``."""
        return self._scale(action, 0) * self.equations.process_noise(mean, measurement)

    def sensor_noise(self, mean: Array, measurement: StateSpaceMeasurement, action: Array) -> Array:
        """Return the measurement noise R scaled by the action, ``(m, m, N)``."""
        return self.equations.sensor_noise(mean, measurement, self._scale(action, 1))

    def act(
        self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement, action: Array
    ) -> ExtendedKalmanState:
        """Return the state updated with Q and R scaled by the action."""
        action = self.xp.clip(action, -1.0, 1.0)
        received = self.receive(state, measurement, action)
        P = state.covariance + self.process_noise(state.mean, measurement, action)
        result = update_with_gain(state.mean, P, received, self.equations.gain(P, received))
        return state._replace(mean=result.mean, covariance=result.covariance, action=action)


class StateSpaceGainBank(StateSpaceBank):
    """Bank of the control ``gain``: the action multiplies the Kalman gain of each state component."""

    @property
    def action_names(self) -> Sequence[str]:
        """Names of the state's components, one for each number of the action."""
        return tuple(component.name for component in self.task.components)

    def act(
        self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement, action: Array
    ) -> ExtendedKalmanState:
        """Return the state updated with the Kalman gain multiplied by the action's factors."""
        action = self.xp.clip(action, -1.0, 1.0)
        received = self.receive(state, measurement, action)
        P = state.covariance + self.process_noise(state.mean, measurement, action)
        factor = self.xp.exp(math.log(self.parameters.gain_factor) * action)
        result = update_with_gain(state.mean, P, received, factor[:, None] * self.equations.gain(P, received))
        return state._replace(mean=result.mean, covariance=result.covariance, action=action)


class StateSpaceKalmanNetBank(StateSpaceBank):
    r"""Bank of the learned estimator ``kalman-net``: a network sets noises, gain and motion of a filter.

    With D = diag(20^a) of n entries of the action, W = diag(20^a) of m, A = diag(5^a) of n, C = diag(5^a) of m, and
    b of n:

        x' = f(x) + 5 b sqrt(diag Q)                          b of the measurement before
        P' = F P F^T + D Q D,  R' = W R W
        K = M H^T (H M H^T + C R' C)^-1,  M = F P F^T + A D Q D A,  in Joseph's form with P' and R'

    The gain of a network on innovations is that of Revach and others, "KalmanNet: Neural Network Aided Kalman Filtering
    for Partially Known Dynamics", IEEE Trans. Signal Processing 70 (2022) 1532-1547. Reading: their network returns
    the gain itself; here it returns the noises of a Kalman gain, so that an untrained network (action zero) is the
    filter as written.
    """

    def __init__(self, task: StateSpaceProblem, control: str) -> None:
        super().__init__(task, control)
        usual = task.definition.nominal_process_noise(self.parameters.sampling_interval)
        sigma = numpy.sqrt(numpy.diag(usual))
        self.deviations: Array = task.constant(sigma)[:, None]
        self.scales: Array = task.constant(1.0 / numpy.where(sigma > 0.0, sigma, 1.0))[:, None]

    @property
    def action_names(self) -> Sequence[str]:
        """Names of the action's entries: noises, their factors in the gain alone, and offsets."""
        counts = {"process": self.states, "sensor": self.sensors, "agility": self.states}
        counts |= {"caution": self.sensors, "offset": self.states}
        return tuple(f"{name}_{i + 1}" for name, count in counts.items() for i in range(count))

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of one filter, and the state, the last correction and the log-deviations."""
        names = tuple(component.name for component in self.task.components)
        names = names if len(names) > 1 else ()
        xp = self.xp

        def spread(f: ExtendedKalmanState, _: StateSpaceMeasurement) -> Array:
            variances = xp.stack([f.covariance[i, i] for i in range(self.states)])
            return 0.5 * xp.log(1e-12 + variances * self.scales**2)

        return (
            *super().blocks,
            Block(
                "state",
                lambda f, _: f.mean * self.scales,
                "predicted state over the deviation of the process noise",
                names,
                SIGNED_LOG,
            ),
            Block(
                "correction",
                lambda f, _: f.correction,
                "last correction over the deviation of the process noise",
                names,
                SIGNED_LOG,
            ),
            Block(
                "spread",
                spread,
                "deviation of the state over that of the process noise",
                names,
                STORED_AS_LOG,
            ),
        )

    def start(self, initial: Initial) -> ExtendedKalmanState:
        """Return the filter's state at the start of the track, from the initial estimate."""
        return super().start(initial)._replace(correction=0.0 * initial.mean)

    def _part(self, action: Array, place: int) -> Array:
        """Return a part of the action by its number: 0 process, 1 sensor, 2 agility, 3 caution, 4 offset."""
        n, m = self.states, self.sensors
        ends = numpy.cumsum([0, n, m, n, m, n]).tolist()
        return action[ends[place] : ends[place + 1]]

    def process_noise(self, mean: Array, measurement: StateSpaceMeasurement, action: Array) -> Array:
        """Return the process noise ``D Q D`` that the action sets, ``(n, n, N)``."""
        Q = self.equations.process_noise(mean, measurement)
        return self._scaled(Q, NOISE_RANGE, self._part(action, 0))

    def sensor_noise(self, mean: Array, measurement: StateSpaceMeasurement, action: Array) -> Array:
        """Return the measurement noise ``W R W`` that the action sets, ``(m, m, N)``."""
        R = self.equations.sensor_noise(mean, measurement)
        return self._scaled(R, NOISE_RANGE, self._part(action, 1))

    def _scaled(self, matrix: Array, factor: float, exponents: Array) -> Array:
        scale = self.xp.exp(math.log(factor) * exponents)
        return outer(scale, scale) * matrix

    def predict(self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement) -> ExtendedKalmanState:
        """Return the state predicted with the last action's offset, with innovation statistics."""
        mean, carried = self.equations.predict_moments(state.mean, state.covariance, measurement)
        mean = mean + (OFFSET * self.deviations) * self._part(state.action, 4)
        return self.compare(state._replace(mean=mean, covariance=carried), measurement)

    def act(
        self, state: ExtendedKalmanState, measurement: StateSpaceMeasurement, action: Array
    ) -> ExtendedKalmanState:
        """Return the state updated with the noises, gain factors and offset that the network's action sets."""
        action = self.xp.clip(action, -1.0, 1.0)
        Q = self.process_noise(state.mean, measurement, action)
        received = self.receive(state, measurement, action)
        agile = state.covariance + self._scaled(Q, AGILITY, self._part(action, 2))
        cautious = self._scaled(received.R, AGILITY, self._part(action, 3))
        K = self.equations.gain(agile, received._replace(R=cautious))
        result = update_with_gain(state.mean, state.covariance + Q, received, K)
        return state._replace(
            mean=result.mean,
            covariance=result.covariance,
            action=action,
            correction=(result.mean - state.mean) * self.scales,
        )


class Mixture(NamedTuple):
    """State of an interacting multiple model (IMM): combined estimate, hypotheses, their probabilities."""

    mean: Array
    """Mean after an action, ``(n, N)``."""
    covariance: Array
    """Covariance after an action, ``(n, n, N)``."""
    means: Array
    """Means of the hypotheses, ``(n, M, N)``."""
    covariances: Array
    """Covariances of the hypotheses, ``(n, n, M, N)``."""
    log_predicted: Array
    """Logarithm of the predicted probabilities, ``(M, N)``."""
    probabilities: Array
    """Probabilities after the last action, ``(M, N)``."""
    log_likelihood: Array
    """Log-likelihood of the last measurement under each hypothesis, ``(M, N)``."""
    nis: Array
    """NIS of each hypothesis, ``(M, N)``."""
    action: Array
    """Last action, ``(M, N)``."""


class MultipleModelBank(Bank[StateSpaceProblem, StateSpaceMeasurement, Mixture]):
    """Bank of the control ``evidence``: an interacting multiple model (IMM) of extended Kalman filters.

    Args:
        process_noise: factor on Q of all hypotheses, a number or ``(N,)``.
        measurement_noise: factor on R of all hypotheses, a number or ``(N,)``.
        of_sources: factors on some terms of Q, by their names.
        of_sensors: factors on R of some sensors, by their names.
    """

    parameters: StateSpaceParameters

    def __init__(
        self,
        task: StateSpaceProblem,
        control: str,
        process_noise: Any = 1.0,
        measurement_noise: Any = 1.0,
        of_sources: Mapping[str, Any] | None = None,
        of_sensors: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(task, control)
        self.count: int = len(task.filter_equations)
        self.factor = process_noise
        self.of_sources = of_sources
        self.sensor_factors: tuple[Any, Mapping[str, Any] | None] = measurement_noise, of_sensors

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium space of the evidence, one number for each hypothesis."""
        return bank_action_space(self.control, self.count)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: NIS, likelihoods, predicted and posterior probabilities, availability, last action."""
        xp, modes = self.xp, self.task.modes
        parts = tuple(map(str, range(1, self.task.definition.filters[0].h.size + 1)))
        return (
            nis_block(modes),
            relative_likelihood_block(xp, modes, text="log-likelihoods relative to the largest"),
            Block(
                "predicted_probability",
                lambda f, _: f.log_predicted,
                "predicted probabilities",
                modes,
                STORED_AS_LOG,
            ),
            Block(
                "probability",
                lambda f, _: f.probabilities,
                "probabilities after the last action",
                modes,
                SHARE,
            ),
            availability_block(parts=parts if len(parts) > 1 else ()),
            last_action_block(modes),
        )

    def start(self, initial: Initial) -> Mixture:
        """Return the IMM's state at the start: all hypotheses at the initial estimate, equally probable."""
        xp, zero = self.xp, 0.0 * initial.mean[0]
        one = xp.stack([zero] * self.count)
        return Mixture(
            initial.mean,
            initial.covariance,
            xp.stack([initial.mean] * self.count, axis=1),
            xp.stack([initial.covariance] * self.count, axis=2),
            one - math.log(self.count),
            one + 1.0 / self.count,
            one,
            one,
            one,
        )

    def predict(self, state: Mixture, measurement: StateSpaceMeasurement) -> Mixture:
        """Return the hypotheses mixed, predicted and updated with the measurement; the action comes later."""
        xp = self.xp
        chain = imm.predict_mode_probabilities(self.task.transition, state.probabilities)
        means, covariances = imm.mix(self._align(state.means), state.covariances, chain.mixing)
        updates = []
        for j, equations in enumerate(self.task.filter_equations):
            mean, carried = equations.predict_moments(means[:, j], covariances[:, :, j], measurement)
            P = carried + self.factor * equations.process_noise(mean, measurement, self.of_sources)
            R = equations.sensor_noise(mean, measurement, *self.sensor_factors)
            received = equations.receive(measurement, mean, R)
            updates.append(update_with_gain(mean, P, received, equations.gain(P, received)))
        return state._replace(
            means=xp.stack([u.mean for u in updates], axis=1),
            covariances=xp.stack([u.covariance for u in updates], axis=2),
            log_predicted=imm.log_probabilities(chain.probabilities),
            log_likelihood=xp.stack([u.log_likelihood for u in updates]),
            nis=xp.stack([u.squared_distance for u in updates]),
        )

    def _align(self, means: Array) -> Array:
        """Return the means ``(n, M, N)`` with angles moved by whole turns next to the first hypothesis."""
        return unwrap(means, means[:, :1], self.task.periods)

    def act(self, state: Mixture, measurement: StateSpaceMeasurement, action: Array) -> Mixture:
        """Return the hypotheses weighted by Bayes' rule with the action's evidence, and combined."""
        probabilities = bank_probabilities(
            self.control,
            action,
            state.log_predicted,
            state.log_likelihood,
            self.parameters.evidence_scale,
            self.xp,
        )
        mean, covariance = imm.combine(self._align(state.means), state.covariances, probabilities)
        action = self.xp.clip(action, -1.0, 1.0)
        return state._replace(mean=mean, covariance=covariance, probabilities=probabilities, action=action)

    def records(self, state: Mixture, measurement: StateSpaceMeasurement) -> dict[str, Array]:
        """Return the log-likelihood of the measurement and the hypotheses' probabilities, by name."""
        there = ordered_sum(measurement.available) > 0.0
        density = imm.log_mixture_density(state.log_predicted, state.log_likelihood)
        return {
            "log_likelihood": self.xp.where(there, density, math.nan),
            "mode_probability": state.probabilities,
        }


def bank_tables(count: int) -> tuple[Mapping[str, Any], Mapping[str, str]]:
    """Return the bank classes, and the descriptions of actions, by control, the default control first."""
    banks: dict[str, Any] = {"noise": StateSpaceNoiseBank, "gain": StateSpaceGainBank}
    actions = {
        "noise": "times `noise_decades` decades: factors on Q and R; **0 is the filter as written**",
        "gain": "`gain_factor` to its power: factors on the Kalman gain of each component; "
        "**0 is the filter as written**",
    }
    if count > 1:
        banks = {"evidence": MultipleModelBank, **banks}
        actions["evidence"] = (
            "times `evidence_scale` nats, added to the log-posterior of each hypothesis; **0 is the IMM**"
        )
    return banks, actions
