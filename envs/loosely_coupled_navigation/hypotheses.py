"""Bank of the control ``hypotheses``: the estimator ``fault-bank``, whose settings the action multiplies."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from ...filters import imm
from ...filters.ordered_sums import ordered_sum
from ..contract.controls import SettingsBank, SteerableFilter
from ..contract.filter import Initial, Likelihood
from ..contract.observation import (
    Array,
    Block,
    entropy_block,
    expected_nis_block,
    last_action_block,
    log_density_block,
    predicted_block,
    prior_block,
    probability_block,
)
from ..contract.task import Task
from .banks import Innovations, KalmanBucyBank
from .fault_bank import FaultBank, FaultState, Weighing
from .world import Measurement


class HypothesesState(NamedTuple):
    """State of the fault bank with the values that the agent observes."""

    own: FaultState
    """State of the fault bank, predicted between :meth:`HypothesesBank.predict` and the action."""
    likelihood: Likelihood
    innovations: Innovations
    """Innovations of the whole bank, over the deviation by the reported noise."""
    prior: Array
    """Logarithm of the predicted standard deviation of the position over the reported one, ``(N,)``."""
    predicted: Array
    """Probabilities of groups of hypotheses before the fix, ``(G, N)``."""
    probabilities: Array
    """Probabilities of the groups after the fix under action zero, ``(G, N)``."""
    levels: Array
    """Probabilities of the receiver's levels after the fix under action zero, ``(L, N)``."""
    entropy: Array
    """Entropy of the hypotheses after the fix under action zero, over the largest possible, ``(N,)``."""
    action: Array
    """Last action, ``(6, N)``."""


class HypothesesBank(SettingsBank, KalmanBucyBank):
    """Bank of the control ``hypotheses``: estimator ``fault-bank`` with factors on weights, levels and noises."""

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]] = FaultBank

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        prior = self.own.prior
        points = (f"point_{j}" for j in range(1, prior.points + 1))
        self.noise_names: tuple[str, ...] = ("modelled", *points)
        self.groups: tuple[str, ...] = (*self.noise_names, "young_pull", "old_pull")
        """Names of the observed groups of hypotheses: by their noises, and pulls too young to end or older."""
        self.level_names: tuple[str, ...] = tuple(str(i) for i in range(1, len(prior.levels) + 1))

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of every bank here, and others, such as probabilities of the hypotheses."""
        xp = self.xp
        nominal = 0.5 * self.parameters.axes * math.log(2.0 * math.pi * self.parameters.receiver_variance)
        return (
            *super().blocks,
            expected_nis_block(
                xp,
                lambda measurement: measurement.available > 0.0,
                "the normalised innovation squared, with the noise that the bank expects",
                over_interval="mean",
            ),
            log_density_block(
                lambda f, measurement: xp.where(
                    measurement.available > 0.0, f.likelihood.log_likelihood + nominal, 0.0
                ),
                "the log-density of the fix, zero for the nominal one at its centre, nats",
                over_interval="mean",
            ),
            prior_block(text="the sigma of the predicted position over the reported one"),
            predicted_block(self.groups, "fix"),
            probability_block(xp, self.groups, "probability after the fix if the action is zero"),
            probability_block(
                xp,
                self.level_names,
                "probability then of the receiver's variance over the reported one",
                name="level_probability",
                value=lambda f: f.levels,
            ),
            entropy_block(xp),
        )

    def last_action(self) -> Block:
        """Return the observation block of the previous action."""
        return last_action_block(tuple(self.own.settings))

    def start(self, initial: Initial) -> HypothesesState:
        """Return the bank's state at the start of the track, from the initial estimate."""
        own, zero = self.own.start(initial), 0.0 * initial.mean
        memory, none = own.memory, zero[0]
        weights = self.own.join_groups([memory.free.weights, memory.pulled.weights], 0)
        groups = self.group(weights, self.own.age(none))
        return HypothesesState(
            own=own,
            likelihood=own.likelihood,
            innovations=self.no_innovations(zero),
            prior=none,
            predicted=groups,
            probabilities=groups,
            levels=memory.levels,
            entropy=none,
            action=self.xp.stack([none] * len(self.own.settings)),
        )

    def group(self, weights: Array, age: Array) -> Array:
        """Sum the probabilities of all hypotheses, ``(H, N)``, to those of observed groups, ``(G, N)``.

        ``age`` is that of the spoofing, s, ``(B, N)``.
        """
        xp, points, onsets = self.xp, self.own.prior.points, self.own.prior.onsets
        free = weights[: 1 + points]
        pulled = xp.reshape(weights[1 + points :], (points, onsets, weights.shape[-1]))
        noises = [ordered_sum([free[1 + j], *(pulled[j, b] for b in range(onsets))]) for j in range(points)]
        by_onset = ordered_sum(pulled)
        young = xp.where(age <= self.own.prior.shortest, by_onset, 0.0)
        return xp.stack([free[0], *noises, ordered_sum(young), ordered_sum(by_onset - young)])

    def add_observed(
        self, state: HypothesesState, result: Weighing, measurement: Measurement
    ) -> HypothesesState:
        """Return the state with innovation statistics, and probabilities before and after the fix, filled in."""
        bank, predicted, p = self.own, state.own.memory, result.weights
        age = bank.age(measurement.number)
        weights = bank.join_groups([predicted.free.weights, predicted.pulled.weights], 0)
        expected = measurement.ins - result.expected
        return state._replace(
            likelihood=bank.likelihood(result, measurement),
            innovations=self.update_innovations(state.innovations, measurement, expected, result.own),
            prior=0.5 * self.xp.log(result.own / predicted.reported),
            predicted=self.group(weights, age),
            probabilities=self.group(p, age),
            levels=result.levels,
            entropy=-ordered_sum(p * imm.log_probabilities(p)) / math.log(p.shape[0]),
        )
