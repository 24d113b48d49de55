"""Bank of the control ``hypotheses``: the estimator ``exact-bayes``, whose settings the action multiplies."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ...filters import class_fusion, imm
from ...filters.ordered_sums import ordered_sum
from ...filters.small_matrices import cholesky
from ..contract.controls import SettingsBank
from ..contract.filter import Likelihood
from ..contract.observation import (
    SHARE,
    Array,
    Block,
    entropy_block,
    expected_nis_block,
    innovation_block,
    last_action_block,
    log_density_block,
    predicted_block,
    prior_block,
    probability_block,
)
from .banks import clock_block, decision_blocks
from .exact_bayes import ClassState, ExactBayes
from .problem import RadarEsmProblem
from .world import Measurement, Start

READINGS = ("range", "range_rate")
LEAST = 1e-9
"""Smallest observed probability of a group: smaller ones are rounding."""


class HypothesesState(NamedTuple):
    """State of the estimator ``exact-bayes`` with the values that the agent observes; S classes."""

    own: ClassState
    """State of the estimator after the last action."""
    likelihood: Likelihood
    """Likelihood of the radar measurement under the estimator's prediction."""
    action: Array
    """Last action, ``(S + 4, N)``."""
    innovation: Array
    """Whitened innovation of all hypotheses together, ``(2, N)``."""
    prior: Array
    """Logarithm of the predicted sigma of range and range rate over the radar's, ``(2, N)``."""
    predicted: Array
    """Probabilities before the scan, at least :data:`LEAST`, of classes that have not changed, then of those that have,
    ``(2 S, N)``."""
    probability: Array
    """Probabilities of these groups after the scan under action zero, ``(2 S, N)``."""
    second_emitter: Array
    """Probability of a second emitter given an unchanged class, after the scan under the action zero, ``(N,)``."""
    entropy: Array
    """Entropy of the hypotheses, after the scan under the action zero, over the largest possible, ``(N,)``."""
    mean: Array
    """Estimate of each class after the last action, ``(3, S, N)``."""
    probabilities: Array
    """Probabilities of the classes after the last action, ``(S, N)``."""
    used: Array
    """Whether there is an ESM decision at this scan, booleans ``(N,)``; every decision is used."""


class HypothesesBank(SettingsBank):
    """Bank of ``hypotheses``: estimator ``exact-bayes`` with factors on probabilities and noises."""

    filter_class = ExactBayes
    task: RadarEsmProblem

    def __init__(self, task: RadarEsmProblem, control: str) -> None:
        super().__init__(task, control)
        self.groups = tuple(
            f"{name}{end}" for end in ("", "_changed") for name in task.parameters.class_names
        )

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks, such as innovation, probabilities of classes and second emitter, ESM decisions."""
        xp, p = self.xp, self.parameters
        unit = math.log(2.0 * math.pi * p.range_sigma * p.range_rate_sigma)
        return (
            innovation_block(
                READINGS,
                text="whitened innovation of all hypotheses together; the range rate without what the range explains",
            ),
            expected_nis_block(xp, lambda measurement: measurement.scan >= 0),
            log_density_block(
                lambda f, _: f.likelihood.log_likelihood + unit,
                "the log-density of the radar measurement in units of its sigmas, nats",
            ),
            prior_block(READINGS, "the sigma of the prediction over that of the radar"),
            predicted_block(self.groups, "scan"),
            probability_block(
                xp, self.groups, "probability after the scan if the action is zero", value=lambda f: f.probability
            ),
            Block(
                "second_emitter",
                lambda f, _: xp.clip(f.second_emitter, 0.0, 1.0),
                "probability then of a second emitter if the class has not changed",
                compression=SHARE,
            ),
            entropy_block(xp),
            *decision_blocks(self.task),
            last_action_block(tuple(self.own.settings)),
            clock_block(self.task),
        )  # fmt: skip

    def start(self, initial: Start) -> HypothesesState:
        """Return the bank's state at the start of the track, from the initial estimate."""
        xp, own, none = self.xp, self.own.start(initial), 0.0 * initial.mean[0]
        groups = self.group(own.tracks.weights)
        return HypothesesState(
            own=own,
            likelihood=own.likelihood,
            action=xp.stack([none] * len(self.own.settings)),
            innovation=0.0 * initial.first.radar,
            prior=xp.stack([none, none]),
            predicted=xp.clip(groups, LEAST, None),
            probability=groups,
            second_emitter=none,
            entropy=none,
            used=initial.first.decision < self.task.types,
            **self.class_estimates(own),
        )

    def group(self, weights: Array) -> Array:
        """Return the probabilities of unchanged and changed classes, ``(2 S, N)``, from hypotheses ``(S, M, N)``."""
        changed = ordered_sum(weights[:, h] for h in range(1, weights.shape[1]))
        return self.xp.concat([weights[:, 0], changed])

    def class_estimates(self, own: ClassState) -> dict[str, Array]:
        """Return the mean, ``(3, S, N)``, and probability, ``(S, N)``, of each class, by name."""
        tracks, hypotheses = own.tracks, range(own.tracks.weights.shape[1])
        probabilities = ordered_sum(tracks.weights[:, h] for h in hypotheses)
        total = ordered_sum(tracks.weights[:, h] * tracks.mean[:3, :, h] for h in hypotheses)
        return {
            "mean": total / self.xp.clip(probabilities, 1e-300, None),
            "probabilities": probabilities,
        }

    def add_observed(
        self, state: HypothesesState, result: ClassState, measurement: Measurement
    ) -> HypothesesState:
        """Return the state with innovation statistics, and probabilities before and after the scan, filled in."""
        xp, bank, tracks = self.xp, self.own, state.own.tracks
        size = tracks.weights.shape[0] * tracks.weights.shape[1]
        mean, P = bank.predict_motion(tracks)
        mean, P = imm.combine(
            xp.reshape(mean, (bank.states, size, -1))[:2],
            xp.reshape(P, (bank.states, bank.states, size, -1))[:2, :2],
            xp.reshape(tracks.weights, (size, -1)),
        )
        R, none = bank.variance[:, 0, 0], 0.0 * mean[0]
        noise = xp.stack([xp.stack([R[0] + none, none]), xp.stack([none, R[1] + none])])
        after = result.tracks
        disturbed, every = (
            ordered_sum(after.unchanged * bank.class_likelihoods(after.first, points))
            for points in (bank.disturbed_by_type, bank.by_type)
        )
        p = xp.reshape(after.weights, (size, -1))
        return state._replace(
            likelihood=result.likelihood,
            innovation=class_fusion.whiten(cholesky(P + noise), measurement.radar - mean),
            prior=0.5 * xp.log(xp.stack([P[0, 0], P[1, 1]]) / R),
            predicted=xp.clip(self.group(tracks.weights), LEAST, None),
            probability=self.group(after.weights),
            second_emitter=disturbed / every,
            entropy=-ordered_sum(p * imm.log_probabilities(p)) / math.log(size),
            used=measurement.decision < self.task.types,
        )

    def act(self, state: HypothesesState, measurement: Measurement, action: Array) -> HypothesesState:
        """Return the state updated with the estimator's settings multiplied by the action's factors."""
        after = super().act(state, measurement, action)
        return after._replace(**self.class_estimates(after.own))

    def records(self, state: HypothesesState, measurement: Measurement) -> dict[str, Array]:
        """Return class probabilities, and likelihood and NIS of the radar measurement, to record, by name."""
        return {"mode_probability": state.probabilities, **state.likelihood._asdict()}
