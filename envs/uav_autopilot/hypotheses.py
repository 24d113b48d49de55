r"""Control ``hypotheses``: the estimator ``level-bank``, whose prior and noises the action sets at every measurement.

The filters stand in ``level_bank.py``; H hypotheses of the gusts predict to the measurement with weights p' and
covariances P'. The action a in [-1, 1]^(3 + m) then changes what the readings of m sensors are weighed with:

    p'(h) <- p'(h) r1^(a1 s(h)) r2^(a2 designed(h))                                         renormalised by Bayes' rule
    P'(h) <- P'(h) + (r3^a3 - 1) Q(h),    R_k <- R_k r4^a(3 + k), this once

s(h): how far the hypothesis' level of the gusts lies above the designed one, logarithmically, one for the highest;
designed: all noise is as designed. So a1 says that the gusts have risen or fallen and a2 that they are as designed, as
other probabilities of a change would; Q is the process noise of the hypothesis, so that the prediction is made with
``r3^a3 Q``; R_k are the variances of sensor k at all its levels. All zero is the estimator itself, bit for bit: an
agent begins where the strongest classical filter ends. Where no sensor answers the action does nothing.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import gymnasium
import numpy

from ...filters import imm, noise_levels, packed_covariance
from ...filters.noise_levels import Hypotheses
from ...filters.ordered_sums import ordered_sum
from ..contract.observation import ACTION, BOUNDED_LOG, LOG1P, SHARE, SIGNED_LOG, Array, Block, within
from .banks import AutopilotBank
from .level_bank import LevelBank, grid
from .world import Measurement, Start

if TYPE_CHECKING:
    from .task import UavAutopilot

ACTIONS = ("gusts", "designed", "process")
"""What comes before the sensors."""
REACH = (1.1, 1.25, 2.0)
SENSOR_REACH = 1.5
"""Factors by which actions of one multiply: so small that white noise of deviation one, with which a new policy
explores, costs a twentieth at most."""


class SteeredLevels(NamedTuple):
    """The bank over levels at one moment."""

    mean: Array
    """``(n, N)``."""
    covariance: Array
    """``(n, n, N)``."""
    memory: Hypotheses
    """Predicted between :meth:`HypothesesBank.predict` and the action."""
    action: Array
    """Last action, ``(3 + m, N)``."""
    innovation: Array
    """Of all hypotheses together over its sigma; 0 in a dropout, ``(m, N)``."""
    nis: Array
    """Normalised innovation squared per available reading, ``(N,)``."""
    mean_innovation: Array
    """Short average of the innovation, ``(m, N)``."""
    mean_square: Array
    """Short average of its square, ``(m, N)``."""
    mean_nis: Array
    """Short average of the NIS, ``(N,)``."""
    log_trace: Array
    """Log of the predicted covariance's trace over that of the settled filter, ``(N,)``."""
    log_likelihood: Array
    """Of the readings by the estimator, ``(N,)``."""
    squared_distance: Array
    """Normalised innovation squared of all readings by the estimator, ``(N,)``."""
    predicted: Array
    """Probabilities of the levels of the gusts before the readings, ``(G, N)``."""
    probabilities: Array
    """After them, if the action is zero, likewise."""
    entropy: Array
    """Of the hypotheses then, over the largest possible, ``(N,)``."""
    sensor_levels: Array
    """Expected logarithm of the factor on each sensor's deviation then, ``(m, N)``."""


class HypothesesBank(AutopilotBank):
    """The bank over levels, steered by factors of its weights and of its noises."""

    def __init__(self, task: "UavAutopilot", control: str) -> None:
        super().__init__(task, control)
        bank = self.bank = LevelBank(task)
        prior = bank.prior
        self.no_action = (0.0,) * (len(ACTIONS) + len(task.sensors))
        self.names = ("designed", *(f"level_{i}" for i in range(1, prior.gust_points + 1)))
        """Of the hypotheses of each kind."""
        factors = (*REACH, *[SENSOR_REACH] * len(task.sensors))
        self.log_reach = task.constant([math.log(factor) for factor in factors])[:, None]
        self.gust_levels = grid(prior.gusts, prior.gust_points)
        heights = numpy.log(self.gust_levels)
        heights = numpy.array([0.0, *heights / heights[-1]])
        designed = numpy.arange(len(heights)) == 0.0
        raised = numpy.tile([heights, designed.astype(float)], (1, bank.groups))
        self.raised = task.constant(raised)[:, :, None]
        """By how much the first two actions multiply each weight, logarithmically, ``(2, H, 1)``."""
        self.sensor_limits = tuple(math.log(limit) for limit in prior.sensors)
        self.log_levels = [
            0.5 * self.xp.log(v / R) for v, R in zip(bank.variances, task.sensor_variances, strict=True)
        ]

    @property
    def action_space(self) -> gymnasium.Space:
        """Gusts, noise as designed, process noise, then each sensor."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.no_action),), numpy.float32)

    @property
    def action_block(self) -> Block:
        """Last action."""
        return Block("action", lambda f, _: f.action, "last action", (*ACTIONS, *self.task.sensors), ACTION)

    @property
    def blocks(self) -> Sequence[Block]:
        """What every filter shows, how well this one has predicted the readings, and what it believes."""
        xp, low, high = self.xp, *self.sensor_limits
        unit = math.prod(self.task.sensor_variances) ** 0.5 * (2.0 * math.pi) ** (
            0.5 * len(self.task.sensors)
        )
        return (
            *super().blocks,
            Block(
                "log_likelihood",
                lambda f, _: f.log_likelihood + math.log(unit),
                "the log-density of the readings in units of their nominal sigmas, nats",
                shown=BOUNDED_LOG,
            ),
            Block(
                "squared_innovation",
                lambda f, _: f.squared_distance,
                "the hypotheses' mean normalised innovation squared",
                shown=LOG1P,
            ),
            Block(
                "log_predicted",
                lambda f, _: imm.log_probabilities(f.predicted),
                "the logarithm of the probability of the gusts' level before the readings",
                self.names,
                SIGNED_LOG,
            ),
            Block(
                "probability",
                lambda f, _: xp.clip(f.probabilities, 0.0, 1.0),
                "probability after them if the action is zero",
                self.names,
                SHARE,
            ),
            Block(
                "sensor_level",
                lambda f, _: xp.clip(f.sensor_levels, low, high),
                "expected log of the factor on the sensor's sigma then",
                self.task.sensors,
                within(low, high),
            ),
            Block(
                "entropy",
                lambda f, _: xp.clip(f.entropy, 0.0, 1.0),
                "entropy of the hypotheses then over the largest possible",
                shown=SHARE,
            ),
        )

    def log_trace(self, state: SteeredLevels) -> Array:
        """Log of the predicted covariance's trace, the spread of the hypotheses included."""
        return state.log_trace

    def start(self, initial: Start) -> SteeredLevels:
        """Start where the estimator starts, with averages as a consistent filter has them."""
        memory = self.bank.start_bank(initial)
        zeros = 0.0 * self.task.readings_of(initial.mean)
        none = zeros[0]
        groups = self.group(memory.probability)
        variances = self.xp.stack([initial.covariance[i, i] for i in range(initial.mean.shape[0])])
        return SteeredLevels(
            mean=initial.mean,
            covariance=initial.covariance,
            memory=memory,
            action=self.xp.stack([none] * len(self.no_action)),
            innovation=zeros,
            nis=none + 1.0,
            mean_innovation=zeros,
            mean_square=zeros + 1.0,
            mean_nis=none + 1.0,
            log_trace=self.xp.log(ordered_sum(self.trace_weights * variances)),
            log_likelihood=none,
            squared_distance=none,
            predicted=groups,
            probabilities=groups,
            entropy=none,
            sensor_levels=self.expect_levels(memory),
        )

    def group(self, probability: Array) -> Array:
        """Probabilities of the gusts' levels, ``(G, N)``, of those of hypotheses of every kind, ``(H, N)``."""
        each = len(self.names)
        return ordered_sum(probability[each * i : each * (i + 1)] for i in range(self.bank.groups))

    def expect_levels(self, h: Hypotheses) -> Array:
        """Expected logarithm of the factor on the deviation of each sensor, ``(m, N)``."""
        of_each = [ordered_sum(q * level) for q, level in zip(h.sensors, self.log_levels, strict=True)]
        return self.xp.stack([ordered_sum(h.probability * levels) for levels in of_each])

    def predict(self, state: SteeredLevels, measurement: Measurement) -> SteeredLevels:
        """Predict to the measurement as the estimator does, and see what it would make of the readings."""
        xp, bank, rows = self.xp, self.bank, self.bank.rows
        h = bank.predict_bank(state.memory, measurement)
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
        found = bank.update_bank(h, measurement)
        p = found.memory.probability
        n = len(self.task.components)
        compared: SteeredLevels = self.compare(state, measurement, readings, S)
        return compared._replace(
            memory=h,
            log_trace=xp.log(ordered_sum(self.trace_weights[i] * P[i, i] for i in range(n))),
            log_likelihood=found.log_likelihood,
            squared_distance=found.nis,
            predicted=self.group(whole.shares),
            probabilities=self.group(p),
            entropy=-ordered_sum(p * imm.log_probabilities(p)) / math.log(p.shape[0]),
            sensor_levels=self.expect_levels(found.memory),
        )

    def act(self, state: SteeredLevels, measurement: Measurement, action: Array) -> SteeredLevels:
        """Update as the estimator does, by the weights and noises that the action sets."""
        xp, h = self.xp, state.memory
        shown = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        answered = xp.where(ordered_sum(measurement.available) > 0.0, 1.0, 0.0)
        logarithms = answered * self.log_reach * shown
        factors = xp.exp(logarithms[2:])
        steered = h._replace(
            probability=xp.exp(ordered_sum(self.raised * logarithms[:2, None])) * h.probability,
            covariance=h.covariance + (factors[0] - 1.0) * self.bank.process,
        )
        found = self.bank.update_bank(steered, measurement, factors[1:])
        return state._replace(mean=found.mean, covariance=found.covariance, memory=found.memory, action=shown)

    def mean(self, state: SteeredLevels) -> Array:
        """What the autopilot uses, ``(n, N)``."""
        return state.mean

    def covariance(self, state: SteeredLevels) -> Array:
        """Covariance of all hypotheses together, ``(n, n, N)``."""
        return state.covariance

    def records(self, state: SteeredLevels, measurement: Measurement) -> dict[str, Array]:
        """Report as the other filters do, likelihood and NIS as the estimator finds them."""
        answered = ordered_sum(measurement.available) > 0.0
        return {
            **super().records(state, measurement),
            "nis": self.xp.where(answered, state.squared_distance, math.nan),
            "log_likelihood": self.xp.where(answered, state.log_likelihood, math.nan),
        }
