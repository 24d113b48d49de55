"""Bank of the control ``hypotheses``: the estimator ``semi-markov``, whose settings the action multiplies."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from ...filters import imm
from ...filters.ordered_sums import ordered_sum
from ...filters.small_matrices import apply, product, transpose
from ..contract.controls import SettingsBank, SteerableFilter
from ..contract.filter import Initial, Likelihood
from ..contract.observation import (
    BOUNDED_LOG,
    Array,
    Block,
    entropy_block,
    expected_nis_block,
    innovation_block,
    log_density_block,
    predicted_block,
    prior_block,
    probability_block,
)
from .banks import RadarBank
from .kalman_net import FRAME, frame_of
from .problem import TargetProblem
from .semi_markov import SemiMarkov, SemiMarkovState
from .world import Measurement

GROUPS = ("straight", "ended", "begun", "thrust", "left", "right", "old_thrust", "old_left", "old_right")
"""Groups of hypotheses whose probabilities are observed: straight flight older than the first age and of the first age,
manoeuvres of the first age, kinds of manoeuvres of the ages between, and of the last age."""


class HypothesesState(NamedTuple):
    """State of the semi-Markov filter with the values that the agent observes."""

    own: SemiMarkovState
    """State of the filter, predicted between :meth:`HypothesesBank.predict` and the action."""
    likelihood: Likelihood
    action: Array
    """Last action, ``(6, N)``."""
    innovation: Array
    """Innovation of all hypotheses together over its sigma, along and across the predicted velocity, ``(2, N)``."""
    prior: Array
    """Logarithm of the predicted sigma of the position over that of the measurement, ``(2, N)``."""
    predicted: Array
    """Probabilities of groups of hypotheses before the measurement, ``(G, N)``."""
    probabilities: Array
    """Probabilities of the groups after the measurement under action zero, ``(G, N)``."""
    entropy: Array
    """Entropy of the hypotheses under action zero, over the largest possible, ``(N,)``."""


class HypothesesBank(SettingsBank, RadarBank):
    """Bank of the control ``hypotheses``: estimator ``semi-markov`` with factors on weights, covariances and R."""

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]] = SemiMarkov

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        thrust, *turns = self.own.kinds
        sided = list(zip(self.own.turns, turns, strict=True))
        sides = ([kind for turn, kind in sided if side * turn.acceleration > 0.0] for side in (1.0, -1.0))
        together = ([thrust], *sides)
        members = (
            list(range(1, self.own.prior.straight_ages)),
            [0],
            [kind[0] for kind in self.own.kinds],
            *([h for kind in kinds for h in kind[1:-1]] for kinds in together),
            *([kind[-1] for kind in kinds] for kinds in together),
        )
        self.groups: dict[str, list[int]] = dict(zip(GROUPS, members, strict=True))

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks, such as innovation, predicted deviation, and probabilities of the hypotheses."""
        xp = self.xp
        area = 2.0 * math.pi * self.parameters.range_sigma**2
        return (
            innovation_block(
                FRAME,
                text="the innovation of all hypotheses together over its predicted sigma",
                compression=BOUNDED_LOG,
            ),
            expected_nis_block(xp, lambda measurement: measurement.available > 0.0),
            log_density_block(
                lambda f, measurement: xp.where(
                    measurement.available > 0.0, f.likelihood.log_likelihood + math.log(area), 0.0
                ),
                "the log-density of the measurement where 2 pi range_sigma^2 is the unit of area, nats",
            ),
            prior_block(FRAME),
            predicted_block(GROUPS),
            probability_block(xp, GROUPS, "probability after the measurement if the action is zero"),
            entropy_block(xp),
            *self.surroundings(),
        )

    def start(self, initial: Initial) -> HypothesesState:
        """Return the bank's state at the start of the track, from the initial estimate."""
        own, none = self.own.start(initial), 0.0 * initial.mean[:2]
        groups = self.group(self.xp.concat([table.probability for table in own.track]))
        action = self.xp.stack([none[0]] * len(self.own.settings))
        return HypothesesState(own, own.likelihood, action, none, none, groups, groups, none[0])

    def group(self, probabilities: Array) -> Array:
        """Sum the probabilities of all hypotheses, ``(H, N)``, to those of observed groups, ``(G, N)``."""
        return self.xp.stack(
            [ordered_sum(probabilities[h] for h in members) for members in self.groups.values()]
        )

    def add_observed(
        self, state: HypothesesState, result: SemiMarkovState, measurement: Measurement
    ) -> HypothesesState:
        """Return the state with innovation statistics, and probabilities before and after the scan, filled in."""
        xp, tables = self.xp, [table.unpack() for table in state.own.track]
        weights = xp.concat([table.probability for table in tables])
        weights = weights / ordered_sum(weights)
        mean, covariance = imm.combine(
            xp.concat([table.mean[:4] for table in tables], axis=1),
            xp.concat([table.covariance[:4, :4] for table in tables], axis=2),
            weights,
        )
        frame = frame_of(mean[2:])
        none = 0.0 * measurement.variance[0]
        R = xp.stack([xp.stack([measurement.variance[0], none]), xp.stack([none, measurement.variance[1]])])
        rotated = [product(product(frame, P), transpose(frame)) for P in (covariance[:2, :2], R)]
        own, sensor = (xp.stack([P[0, 0], P[1, 1]]) for P in rotated)
        innovation = measurement.available * (measurement.position - mean[:2])
        p = xp.concat([table.probability for table in result.track])
        surprise = ordered_sum(p * xp.log(xp.clip(p, 1e-300, None)))
        return state._replace(
            likelihood=result.likelihood,
            innovation=apply(frame, innovation) / xp.sqrt(own + sensor),
            prior=0.5 * xp.log(own / sensor),
            predicted=self.group(weights),
            probabilities=self.group(p),
            entropy=-surprise / math.log(p.shape[0]),
        )
