r"""Control ``hypotheses``: the estimator ``fault-bank``, whose prior and noises the action sets at every fix.

The filters stand in ``fault_bank.py``; H hypotheses of noises and of pulls predict to the fix with weights p' and
covariances P', and the levels of the receiver have probabilities q'. The action a in [-1, 1]^6 then changes what the
fix is weighed with:

    p'(h) <- p'(h) r1^(a1 pulled(h)) r2^(a2 modelled(h))                                    renormalised by Bayes' rule
    q'(l) <- q'(l) r3^(a3 s(l)),    R <- R r4^a4, this once
    P'(h) <- P'(h) + (r5^a5 - 1) Q(h) + (r6^a6 - 1) W(h)

pulled: the receiver is pulled off, whenever that began; modelled: all noises are as modelled; s(l): how far the level
lies above the reported variance, logarithmically, one for the highest. So a1 multiplies the odds of a pull as other
hazards would, a2 is the prior of a fault, a3 says that the receiver has become worse or better and a4 that it errs now.
Q is what the coloured and the white rate error of the INS add in a step and W what the receiver's coloured error gains:
a prediction with ``r5^a5 Q`` and ``r6^a6 W``, as these only add. All zero is the estimator itself, bit for bit: an
agent begins where the strongest classical filter ends. Without a fix the action does nothing.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import gymnasium
import numpy

from ...filters import imm
from ...filters import receiver_faults as faults
from ...filters.array_namespace import namespace
from ...filters.loosely_coupled import AugmentedCovariance, Sampling
from ...filters.ordered_sums import ordered_sum
from ..contract.filter import Initial
from ..contract.observation import ACTION, BOUNDED_LOG, KEPT_AS_LOG, LOG1P, SHARE, SIGNED_LOG, Array, Block
from ..contract.task import Task
from .banks import Innovations, KalmanBucyBank
from .fault_bank import FaultBank, Hypotheses, Memory, Noises
from .world import Measurement

ACTIONS = ("pull", "modelled", "level", "receiver", "inertial", "wandering")
REACH = (1.05, 1.05, 1.5, 1.25, 2.0, 2.0)
"""Factors by which actions of one multiply: so small that white noise of deviation one, with which a new policy
explores, costs a twentieth at most."""


class SteeredBank(NamedTuple):
    """The bank over faults at one moment."""

    mean: Array
    """Position estimated, m, ``(A, N)``."""
    covariance: Array
    """m^2, ``(A, A, N)``."""
    memory: Memory
    """Hypotheses and levels; predicted between :meth:`HypothesesBank.predict` and the action."""
    seen: Innovations
    """Of all hypotheses together, over the deviation that goes with the reported noise."""
    prior: Array
    """Logarithm of the sigma of the predicted position over the reported one, ``(N,)``."""
    predicted: Array
    """Probabilities of groups of hypotheses before the fix, ``(G, N)``."""
    probabilities: Array
    """After it, if the action is zero, likewise."""
    levels: Array
    """Of the receiver's levels then, ``(L, N)``."""
    entropy: Array
    """Of the hypotheses then, over the largest possible, ``(N,)``."""
    log_likelihood: Array
    """Of the fix, nats, ``(N,)``; zero where there is none."""
    nis: Array
    """Likewise its normalised innovation squared."""
    action: Array
    """Last action, ``(6, N)``."""


def noise_of_a_step(noises: Noises, s: Sampling, pulls: int) -> tuple[faults.FaultCovariance, ...]:
    """What a step adds to the covariance of hypotheses by the INS, Q, and by the receiver's coloured error, W.

    Args:
        noises: of the hypotheses.
        s: sampling of the INS error.
        pulls: errors of the receiver beside the coloured one.
    """
    none = 0.0 * noises.decay
    ins = AugmentedCovariance(none, none, none, none, none, none)
    xp = namespace(none)
    rows = xp.stack([none] * (1 + pulls))
    nothing = faults.FaultCovariance(ins, xp.stack([rows] * 3), xp.stack([rows] * (1 + pulls)))
    gained = noises.wandering**2 * (1.0 - noises.decay**2)
    errors = xp.stack([gained, *[none] * pulls])
    return (
        faults.predict_fault(nothing, s, noises.coloured_growth, noises.white_growth, rows, rows),
        faults.predict_fault(nothing, s, none, none, rows, errors),
    )


class HypothesesBank(KalmanBucyBank):
    """The bank over faults, steered by factors of its weights, of its levels and of its noises."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(ACTIONS),), numpy.float32)

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        bank = self.bank = FaultBank(task)
        prior, s = bank.prior, self.parameters.sampling
        self.noise_names = ("modelled", *(f"point_{j}" for j in range(1, prior.points + 1)))
        self.groups = (*self.noise_names, "young_pull", "old_pull")
        """Of hypotheses whose probabilities are shown: by their noises, and those of pulls too young to end, or not."""
        self.level_names = tuple(str(i) for i in range(1, len(prior.levels) + 1))
        self.log_reach = task.constant([math.log(factor) for factor in REACH])[:, None]
        count = (1 + prior.points) + prior.points * prior.onsets
        every = range(count)
        raised = [[float(h > prior.points) for h in every], [float(h == 0) for h in every]]
        self.raised = task.constant(raised)[:, :, None]
        """Whose weights each of the first two actions multiplies, ``(2, H, 1)``."""
        heights = [math.log(level) / math.log(prior.levels[-1]) for level in prior.levels]
        self.heights = task.constant(heights)[:, None]
        self.steps = noise_of_a_step(bank.noises, s, 0), noise_of_a_step(bank.others, s, 1)

    @property
    def blocks(self) -> Sequence[Block]:
        """What every filter shows, how well this one has predicted the fix, and what it believes."""
        xp = self.xp
        nominal = 0.5 * self.parameters.axes * math.log(2.0 * math.pi * self.parameters.receiver_variance)
        return (
            *super().blocks,
            Block(
                "squared_innovation",
                lambda f, _: f.nis,
                "the normalised innovation squared, with the noise that the bank expects",
                shown=LOG1P,
                over_interval="mean",
            ),
            Block(
                "log_likelihood",
                lambda f, measurement: f.log_likelihood + measurement.available * nominal,
                "the log-density of the fix, zero for the nominal one at its centre, nats",
                shown=BOUNDED_LOG,
                over_interval="mean",
            ),
            Block(
                "prior",
                lambda f, _: f.prior,
                "the sigma of the predicted position over the reported one",
                shown=KEPT_AS_LOG,
            ),
            Block(
                "log_predicted",
                lambda f, _: imm.log_probabilities(f.predicted),
                "the logarithm of the probability before the fix",
                self.groups,
                SIGNED_LOG,
            ),
            Block(
                "probability",
                lambda f, _: xp.clip(f.probabilities, 0.0, 1.0),
                "probability after the fix if the action is zero",
                self.groups,
                SHARE,
            ),
            Block(
                "level_probability",
                lambda f, _: xp.clip(f.levels, 0.0, 1.0),
                "likewise of the receiver's variance over the reported one",
                self.level_names,
                SHARE,
            ),
            Block(
                "entropy",
                lambda f, _: xp.clip(f.entropy, 0.0, 1.0),
                "entropy of the hypotheses then over the largest possible",
                shown=SHARE,
            ),
        )

    def last_action(self) -> Block:
        """Block of the action applied before."""
        return Block("last_action", lambda f, _: f.action, "action applied before", ACTIONS, ACTION)

    def start(self, initial: Initial) -> SteeredBank:
        """Start where the estimator starts."""
        xp, bank = self.xp, self.bank
        memory = bank.start_bank(initial)
        zero = 0.0 * initial.mean
        none = zero[0]
        weights = bank.join([memory.free.weights, memory.pulled.weights], 0)
        groups = self.group(weights, bank.age(none))
        return SteeredBank(
            mean=initial.mean,
            covariance=initial.covariance,
            memory=memory,
            seen=self.no_innovations(zero),
            prior=none,
            predicted=groups,
            probabilities=groups,
            levels=memory.levels,
            entropy=none,
            log_likelihood=none,
            nis=none,
            action=xp.stack([none] * len(ACTIONS)),
        )

    def group(self, weights: Array, age: Array) -> Array:
        """Probabilities of groups, ``(G, N)``, of those of hypotheses, ``(H, N)``, and of the age of pulls, s."""
        xp, points, onsets = self.xp, self.bank.prior.points, self.bank.prior.onsets
        free = weights[: 1 + points]
        pulled = xp.reshape(weights[1 + points :], (points, onsets, weights.shape[-1]))
        noises = [ordered_sum([free[1 + j], *(pulled[j, b] for b in range(onsets))]) for j in range(points)]
        by_onset = ordered_sum(pulled)
        young = xp.where(age <= self.bank.prior.shortest, by_onset, 0.0)
        return xp.stack([free[0], *noises, ordered_sum(young), ordered_sum(by_onset - young)])

    def predict(self, state: SteeredBank, measurement: Measurement) -> SteeredBank:
        """Predict to the fix as the estimator does, and see what it would make of it."""
        xp, bank, available = self.xp, self.bank, measurement.available
        predicted = bank.predict_bank(state.memory, measurement)
        weighing = bank.weigh(predicted, measurement)
        age = bank.age(measurement.number)
        weights = bank.join([predicted.free.weights, predicted.pulled.weights], 0)
        p = weighing.weights
        surprise = ordered_sum(p * imm.log_probabilities(p))
        return state._replace(
            memory=predicted,
            seen=self.update_innovations(
                state.seen, measurement, measurement.ins - weighing.expected, weighing.own
            ),
            prior=0.5 * xp.log(weighing.own / predicted.reported),
            predicted=self.group(weights, age),
            probabilities=self.group(p, age),
            levels=weighing.levels,
            entropy=-surprise / math.log(p.shape[0]),
            log_likelihood=available * weighing.log_likelihood,
            nis=available * weighing.nis,
        )

    def act(self, state: SteeredBank, measurement: Measurement, action: Array) -> SteeredBank:
        """Update as the estimator does, by the weights, levels and noises that the action sets."""
        xp, bank = self.xp, self.bank
        action = xp.clip(action, -1.0, 1.0)
        logarithms = measurement.available * self.log_reach * action
        factors = xp.exp(logarithms[3:])
        free, pulled = (
            add_noise(part, steps, factors[1:])
            for part, steps in zip((state.memory.free, state.memory.pulled), self.steps, strict=True)
        )
        predicted = state.memory._replace(free=free, pulled=pulled)
        weighing = bank.weigh(
            predicted,
            measurement,
            ordered_sum(self.raised * logarithms[:2, None]),
            factors[0],
            xp.exp(self.heights * logarithms[2]),
        )
        found = bank.update_bank(predicted, measurement, weighing)
        return state._replace(
            mean=found.mean, covariance=found.covariance, memory=found.memory, action=action
        )

    def mean(self, state: SteeredBank) -> Array:
        """Position, ``(A, N)``, m."""
        return state.mean

    def covariance(self, state: SteeredBank) -> Array:
        """Covariance of all hypotheses together, ``(A, A, N)``, m^2."""
        return state.covariance

    def records(self, state: SteeredBank, measurement: Measurement) -> dict[str, Array]:
        """How well the fix was predicted, NaN where there is none."""
        there = measurement.available > 0.0
        return {
            "nis": self.xp.where(there, state.nis, math.nan),
            "nis_degrees": self.parameters.axes * measurement.available,
            "log_likelihood": self.xp.where(there, state.log_likelihood, math.nan),
        }


def add_noise(h: Hypotheses, steps: Sequence[faults.FaultCovariance], factors: Array) -> Hypotheses:
    """Predicted hypotheses with the noises of a step multiplied, each by its factor, ``(N,)``."""
    inertial, wandering = steps
    more, further = (factor - 1.0 for factor in factors)
    ins = (P + more * Q for P, Q in zip(h.covariance.ins, inertial.ins, strict=True))
    P = faults.FaultCovariance(
        AugmentedCovariance(*ins), h.covariance.cross, h.covariance.faults + further * wandering.faults
    )
    return h._replace(covariance=P)
