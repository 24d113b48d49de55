r"""Controls ``sigma-points`` and ``unscented``: the filter ``unscented-turn`` with settings that an action multiplies.

Both are rivals of 2026, made from their abstracts without their code. At a scan that saw the target, with X_i the
sigma points after the turn (i = 0 that of the mean, n = 5), W_i their weights and f the factors of the action,

    sigma-points   x' = sum V_i X_i,  V_i = W_i f_i / sum W_j f_j,   P' = sum W_i^c f_i^c (X_i - x')(X_i - x')^T + Q
    unscented      alpha <- alpha f_1,   Q <- Q (f_2: acceleration, f_3: turn rate),   R <- R f_4

``sigma-points`` is of K. Majewski, M. Modzelewski, M. Zugaj and P. Lichota, "Robust Unscented Kalman Filtering via
Recurrent Meta-Adaptation of Sigma-Point Weights" (MA-UKF, arXiv 2603.04360, 2026). The abstract states: a recurrent
encoder compresses the history of innovations, and from it a policy network sets the weights of the sigma points for
mean and covariance at each step; both are trained through the filter. Reading: the network sees the innovation under
the plain weights, and its weights apply to the points of the same scan; they are factors of the plain ones, so that
they stay positive and those for the mean sum to one. The mean's own point, of weight zero, has no factor for the mean.

``unscented`` is of O. Straka, F. Giraldo-Grueso and R. Zanetti, "Learning Adaptive Parameter Policies for Nonlinear
Bayesian Filtering" (arXiv 2603.19910, 2026). The abstract states: a policy of reinforcement learning selects
parameters of a filter's numerical approximation at each step, among them scaling parameters, with experiments on the
unscented filter. That is f_1. The factors of the noises are ours: the measurement is linear here, and the scaling
alone, at the ends of its range, changes the cost by less than a hundredth of a per cent.

Both limit the deviation of the turn rate, which factors of every scan could raise until nothing determines it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

from ...filters import coordinated_turn, unscented
from ...filters.gaussian import log_density
from ...filters.ordered_sums import ordered_sum
from ...filters.small_matrices import outer
from ..contract.controls import SettingsBank, SteerableFilter
from ..contract.filter import EstimateState, FilterInput, Initial, Likelihood
from ..contract.observation import (
    SIGNED_LOG,
    STORED_AS_LOG,
    Array,
    Block,
    average_block,
    average_log_squared_block,
    innovation_block,
    limited,
    log_squared_block,
    prior_block,
)
from .banks import RadarBank
from .kalman_net import frame_of, speed_of
from .problem import TargetProblem
from .unscented_turn import UnscentedTurn
from .world import Measurement

STATES = 5
POINTS = range(2 * STATES + 1)
AXES = ("x", "y", "vx", "vy", "turn")
"""Columns of the root of the covariance, by the first state that each moves."""
PLAIN_FILTER = {"acceleration": 1.0, "turn_rate_change": 0.03, "turn_rate_start": 0.1}
"""Values of the plain filter, the zero action; chosen on validation with agents trained in it."""
LARGEST_DEVIATION = 0.5
"""Of the turn rate, rad/s: far more than any aircraft needs, and an action may multiply its variance at every scan."""
SPEED = 100.0
"""Unit of the speed in the observation, m/s."""


class Prediction(NamedTuple):
    """Prediction of the unscented filter without an action, for a measurement."""

    innovation: Array
    """m, ``(2, N)``; zero where the scan missed the target."""
    variance: Array
    """Of the predicted position along x and y, m^2, ``(2, N)``."""
    innovation_variance: Array
    """m^2, ``(2, N)``."""
    likelihood: Likelihood
    mean: Array
    """``(5, N)``."""


class SteeredUnscentedTurn(UnscentedTurn, SteerableFilter[TargetProblem, Measurement, EstimateState]):
    """Base class of unscented filters of the turn with settings that an action multiplies."""

    def __init__(self, task: TargetProblem) -> None:
        super().__init__(task, **PLAIN_FILTER)

    def has_effect(self, measurement: Measurement) -> Array:
        """Return 1 where the scan saw the target, else 0, ``(N,)``."""
        return measurement.available

    def examine(self, state: EstimateState, measurement: Measurement) -> Prediction:
        """Return the prediction without an action, with the innovation and its likelihood."""
        xp = self.xp
        mean, covariance = self.predict_turn(state.mean, state.covariance, measurement.interval)
        innovation = measurement.position - mean[:2]
        S = covariance[:2, :2] + self.identity * measurement.variance
        prior, sensor = xp.stack([covariance[0, 0], covariance[1, 1]]), xp.stack([S[0, 0], S[1, 1]])
        likelihood = self.likelihood(measurement, *log_density(innovation, S))
        return Prediction(measurement.available * innovation, prior, sensor, likelihood, mean)

    def limit(self, covariance: Array) -> Array:
        """Return the covariance with a limited deviation of the turn rate, so that scans still determine it."""
        xp = self.xp
        ratio = xp.minimum(LARGEST_DEVIATION / xp.sqrt(covariance[4, 4]), 1.0)
        factors = xp.stack([*([1.0 + 0.0 * ratio] * 4), ratio])
        return covariance * outer(factors, factors)


class WeightedUnscentedTurn(SteeredUnscentedTurn):
    """Unscented filter of the turn: an action multiplies the weights of the sigma points."""

    settings: Mapping[str, float] = {
        **{f"mean_{side}{axis}": 5.0 for side in "+-" for axis in AXES},
        **{f"covariance_{name}": 5.0 for name in ("0", *(side + axis for side in "+-" for axis in AXES))},
    }

    def update(self, state: EstimateState, inputs: FilterInput) -> EstimateState:
        """Return the state: propagated sigma points weighted by the action's factors, updated with the position."""
        if inputs.action is None:
            return super().update(state, inputs)
        T, factors = inputs.measurement.interval, self.xp.exp(inputs.action)
        for_mean, for_covariance = unscented.weights(STATES)
        total = ordered_sum(factors[: 2 * STATES]) * (0.5 / STATES)
        for_mean = [for_mean[0], *(for_mean[i] * (factors[i - 1] / total) for i in POINTS if i)]
        for_covariance = [for_covariance[i] * factors[2 * STATES + i] for i in POINTS]
        points = coordinated_turn.propagate(unscented.sigma_points(state.mean, state.covariance), T)
        mean, covariance = unscented.combine(points, for_mean, for_covariance)
        predicted = mean, self.limit(covariance + self.noise(T))
        return self.track(inputs.measurement, self.update_estimate(predicted, inputs.measurement))


class TunedUnscentedTurn(SteeredUnscentedTurn):
    """Unscented filter of the turn: an action multiplies its scaling and noises."""

    settings: Mapping[str, float] = {
        "spread": 2.0**0.5,
        "acceleration": 30.0,
        "turn_rate": 30.0,
        "noise": 10.0,
    }

    def update(self, state: EstimateState, inputs: FilterInput) -> EstimateState:
        """Return the state predicted with scaling and noises times the action's factors, and updated."""
        if inputs.action is None:
            return super().update(state, inputs)
        xp, measurement, T = self.xp, inputs.measurement, inputs.measurement.interval
        spread, acceleration, turn_rate, noise = xp.exp(inputs.action)
        mean, covariance = unscented.transform(
            state.mean,
            state.covariance,
            lambda points: coordinated_turn.propagate(points, T),
            unscented.Spread(spread),
        )
        predicted = mean, self.limit(covariance + self.noise(T, acceleration, turn_rate))
        measurement = measurement._replace(variance=noise * measurement.variance)
        return self.track(inputs.measurement, self.update_estimate(predicted, measurement))


class UnscentedState(NamedTuple):
    """State of a steered unscented filter, with the values that the agent observes."""

    own: EstimateState
    likelihood: Likelihood
    action: Array
    """Last action, ``(n, N)``."""
    innovation: Array
    """Over its sigma, ``(2, N)``."""
    prior: Array
    """Logarithm of the sigma of the predicted position over that of the measurement, ``(2, N)``."""
    mean: Array
    """Predicted, ``(5, N)``."""
    log_squared: Array
    """log(1 + normalised innovation squared), ``(N,)``."""
    average_innovation: Array
    """Exponential average, ``(2, N)``."""
    average_log_squared: Array
    """Exponential average, ``(N,)``."""


class UnscentedBank(SettingsBank, RadarBank):
    """Base class of the banks of one unscented filter of the turn, whose settings the action multiplies."""

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: innovation statistics, predicted deviation and motion, detection and times."""
        xp = self.xp
        return (
            innovation_block("xy"),
            log_squared_block(),
            average_block(
                "average_innovation", lambda f, _: f.average_innovation, f"its {self.average}", "xy"
            ),
            average_log_squared_block(self.average),
            prior_block("xy"),
            Block(
                "course",
                lambda f, _: frame_of(f.mean[2:4])[0],
                "direction of the predicted velocity",
                "xy",
                limited(-1.0, 1.0),
            ),
            Block(
                "speed",
                lambda f, _: xp.log(speed_of(f.mean[2:4]) * (1.0 / SPEED)),
                f"predicted speed over {SPEED:g} m/s",
                compression=STORED_AS_LOG,
            ),
            Block(
                "turn",
                lambda f, _: f.mean[4] * self.T,
                "predicted turn in sampling_interval, anticlockwise",
                compression=SIGNED_LOG,
                unit="rad",
            ),
            *self.surroundings(),
        )

    def start(self, initial: Initial) -> UnscentedState:
        """Return the filter's state at the initial estimate, with zero action."""
        own, none = self.own.start(initial), 0.0 * initial.mean[:2]
        action = self.xp.stack([none[0]] * len(self.own.settings))
        return UnscentedState(own, own.likelihood, action, none, none, own.mean, none[0], none, none[0])

    def add_observed(
        self, state: UnscentedState, found: Prediction, measurement: Measurement
    ) -> UnscentedState:
        """Return the state with innovation statistics and the prediction filled in."""
        xp = self.xp
        innovation = found.innovation / xp.sqrt(found.innovation_variance)
        squares = innovation * innovation
        log_squared = xp.log1p(squares[0] + squares[1])
        return state._replace(
            likelihood=found.likelihood,
            innovation=innovation,
            prior=0.5 * xp.log(found.variance / measurement.variance),
            mean=found.mean,
            log_squared=log_squared,
            average_innovation=self.exponential_average(measurement, state.average_innovation, innovation),
            average_log_squared=self.exponential_average(measurement, state.average_log_squared, log_squared),
        )


class SigmaPointsBank(UnscentedBank):
    """Bank of the control ``sigma-points``: the action multiplies the weights of the sigma points."""

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]] = WeightedUnscentedTurn


class ScalingBank(UnscentedBank):
    """Bank of the control ``unscented``: the action multiplies the scaling and the noises."""

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]] = TunedUnscentedTurn
