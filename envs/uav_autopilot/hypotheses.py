"""Bank of the control ``hypotheses``: the estimator ``level-bank``, whose settings the action multiplies."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from ...filters import imm, noise_levels, packed_covariance
from ...filters.noise_levels import LevelHypotheses
from ...filters.ordered_sums import ordered_sum
from ..contract.controls import SettingsBank, SteerableFilter
from ..contract.filter import Likelihood
from ..contract.observation import (
    Array,
    Block,
    entropy_block,
    expected_nis_block,
    last_action_block,
    limited,
    log_density_block,
    predicted_block,
    probability_block,
)
from .banks import AutopilotBank
from .level_bank import LevelBank, Levels, grid
from .problem import AutopilotProblem
from .world import Measurement, Start


class HypothesesState(NamedTuple):
    """State of the bank over noise levels, with the values that the agent observes."""

    own: Levels
    """State of the bank, predicted between :meth:`HypothesesBank.predict` and the action."""
    likelihood: Likelihood
    """Likelihood of the readings under the bank's prediction."""
    action: Array
    """Last action, ``(3 + m, N)``."""
    innovation: Array
    """Innovation of all hypotheses together over its sigma; 0 in a dropout, ``(m, N)``."""
    nis: Array
    """Normalised innovation squared per available reading, ``(N,)``."""
    mean_innovation: Array
    """Short average of the innovation, ``(m, N)``."""
    mean_square: Array
    """Short average of the squared innovation, ``(m, N)``."""
    mean_nis: Array
    """Short average of the NIS, ``(N,)``."""
    log_trace: Array
    """Log of the trace of the predicted covariance over that of the settled filter, ``(N,)``."""
    log_likelihood: Array
    """Log-density of the readings by the moments of all hypotheses together, ``(N,)``."""
    predicted: Array
    """Probabilities of the levels of the gusts before the readings, ``(G, N)``."""
    probabilities: Array
    """Probabilities of these levels after the readings under the action zero, ``(G, N)``."""
    entropy: Array
    """Entropy of the hypotheses after the readings under the action zero, over the largest possible, ``(N,)``."""
    sensor_levels: Array
    """Expected log of the factor on each sensor's deviation, after the readings under the action zero, ``(m, N)``."""


class HypothesesBank(SettingsBank, AutopilotBank):
    """Bank of ``hypotheses``: estimator ``level-bank`` with factors on its weights and noises."""

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]] = LevelBank

    def __init__(self, task: AutopilotProblem, control: str) -> None:
        super().__init__(task, control)
        prior = self.own.prior
        levels = (f"level_{i}" for i in range(1, prior.gust_points + 1))
        self.names: tuple[str, ...] = ("designed", *levels)
        """Names of the hypotheses of each kind."""
        self.gust_levels: Array = grid(prior.gusts, prior.gust_points)
        self.sensor_limits: tuple[float, ...] = tuple(math.log(limit) for limit in prior.sensors)
        self.log_levels: list[Any] = [
            0.5 * self.xp.log(v / R) for v, R in zip(self.own.variances, task.sensor_variances, strict=True)
        ]

    @property
    def action_block(self) -> Block:
        """Observation block of the last action."""
        return last_action_block(tuple(self.own.settings), name="action")

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of every bank here, and others, such as probabilities of the noise levels."""
        xp, low, high = self.xp, *self.sensor_limits
        unit = math.prod(self.task.sensor_variances) ** 0.5 * (2.0 * math.pi) ** (
            0.5 * len(self.task.sensors)
        )
        return (
            *super().blocks,
            log_density_block(
                lambda f, y: xp.where(self.has_reading(y), f.likelihood.log_likelihood, 0.0) + math.log(unit),
                "the log-density of the readings in units of their nominal sigmas, nats",
            ),
            expected_nis_block(xp, self.has_reading),
            predicted_block(self.names, "readings", of=" of the gusts' level"),
            probability_block(xp, self.names, "probability after them if the action is zero"),
            Block(
                "sensor_level",
                lambda f, _: xp.clip(f.sensor_levels, low, high),
                "expected log of the factor on the sensor's sigma then",
                self.task.sensors,
                limited(low, high),
            ),
            entropy_block(xp),
        )

    def log_trace(self, state: HypothesesState) -> Array:
        """Return the logarithm of the trace of the predicted covariance with the spread of hypotheses, ``(N,)``."""
        return state.log_trace

    def start(self, initial: Start) -> HypothesesState:
        """Return the bank's state at the start of the track, with the averages of a consistent filter."""
        own = self.own.start(initial)
        zeros = 0.0 * self.task.readings_of(initial.mean)
        none = zeros[0]
        groups = self.group(own.hypotheses.probability)
        variances = self.xp.stack([initial.covariance[i, i] for i in range(initial.mean.shape[0])])
        return HypothesesState(
            own=own,
            likelihood=own.likelihood,
            action=self.xp.stack([none] * len(self.own.settings)),
            innovation=zeros,
            nis=none + 1.0,
            mean_innovation=zeros,
            mean_square=zeros + 1.0,
            mean_nis=none + 1.0,
            log_trace=self.xp.log(ordered_sum(self.trace_weights * variances)),
            log_likelihood=none,
            predicted=groups,
            probabilities=groups,
            entropy=none,
            sensor_levels=self.expect_levels(own.hypotheses),
        )

    def group(self, probability: Array) -> Array:
        """Return the probabilities of the gust levels, ``(G, N)``, from those of the hypotheses, ``(H, N)``."""
        each = len(self.names)
        return ordered_sum(probability[each * i : each * (i + 1)] for i in range(self.own.groups))

    def expect_levels(self, h: LevelHypotheses) -> Array:
        """Return the expected logarithm of the factor on each sensor's standard deviation, ``(m, N)``."""
        of_each = [ordered_sum(q * level) for q, level in zip(h.sensors, self.log_levels, strict=True)]
        return self.xp.stack([ordered_sum(h.probability * levels) for levels in of_each])

    def has_reading(self, measurement: Measurement) -> Array:
        """Return booleans ``(N,)``: whether any sensor has a reading."""
        return ordered_sum(measurement.available) > 0.0

    def add_observed(
        self, state: HypothesesState, result: Levels, measurement: Measurement
    ) -> HypothesesState:
        """Return the state with innovation statistics, and probabilities before and after the readings, filled in."""
        xp, bank, rows, h = self.xp, self.own, self.own.rows, state.own.hypotheses
        whole = noise_levels.merge(h.mean, h.covariance, h.probability)
        P = packed_covariance.unpack(whole.covariance, bank.size)
        readings = xp.stack([ordered_sum(whole.mean[i] for i in those) for those in rows])
        noises = [
            ordered_sum(whole.shares * ordered_sum(q * variances))
            for q, variances in zip(h.sensors, bank.variances, strict=True)
        ]
        S = xp.stack(
            [
                xp.stack(
                    [
                        ordered_sum([*(P[i, j] for i in a for j in b), *([noise] if a == b else [])])
                        for b in rows
                    ]
                )
                for a, noise in zip(rows, noises, strict=True)
            ]
        )
        p = result.hypotheses.probability
        n = len(self.task.components)
        compared: HypothesesState = self.compare(state, measurement, readings, S)
        return compared._replace(
            likelihood=result.likelihood,
            log_trace=xp.log(ordered_sum(self.trace_weights[i] * P[i, i] for i in range(n))),
            predicted=self.group(whole.shares),
            probabilities=self.group(p),
            entropy=-ordered_sum(p * imm.log_probabilities(p)) / math.log(p.shape[0]),
            sensor_levels=self.expect_levels(result.hypotheses),
        )

    def records(self, state: HypothesesState, measurement: Measurement) -> dict[str, Array]:
        """Return the records of the other banks, with likelihood and NIS of the estimator, by name."""
        return {**super().records(state, measurement), **state.likelihood._asdict()}
