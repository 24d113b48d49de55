r"""Control ``hypotheses``: the estimator ``semi-markov``, whose prior and noises the action sets at every scan.

The filter stands in ``semi_markov.py``; H hypotheses of kind and age predict to the scan with weights p', means x' and
covariances P'. The action a in [-1, 1]^6 then changes what the measurement is weighed with, this once:

    p'(h) <- p'(h) r1^(a1 begun(h)) r2^(a2 ended(h)) r3^(a3 turning(h))                     renormalised by Bayes' rule
    P'(h) <- P'(h) r4^a4 in straight flight, P'(h) r5^a5 in manoeuvres,    R <- R r6^a6

begun: a manoeuvre of the first age; ended: straight flight of the first age; turning: a turn of any age. So a1 and a2
multiply the odds that a manoeuvre has just begun, or ended, as other hazards would; a3 those of a turn against all
else; a4 and a5 say that the prediction is worse or better than the filter believes, as in a filter of fading memory (H.
W. Sorenson and J. E. Sacks, Recursive fading memory filtering, Information Sciences 3, 1971, 101-119). All zero is the
estimator itself, bit for bit: an agent begins where the strongest classical filter ends. A scan that missed the target
is prediction only, whatever the action.
"""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import gymnasium
import numpy

from ...filters import imm
from ...filters.ordered_sums import ordered_sum
from ...filters.semi_markov import Hypotheses
from ...filters.small_matrices import apply, product, transpose
from ..contract.filter import Initial
from ..contract.observation import BOUNDED_LOG, KEPT_AS_LOG, LOG1P, SHARE, SIGNED_LOG, Array, Block
from .banks import RadarBank
from .kalman_net import FRAME, frame_of
from .semi_markov import SemiMarkov, SemiMarkovTrack, Tables
from .world import Measurement

if TYPE_CHECKING:
    from .task import ManeuveringTarget

REACH = (3.0, 9.0, 1.5, 1.25, 1.25, 1.25)
"""Factors by which actions of one multiply: so small that white noise of deviation one, with which a new policy
explores, costs a twentieth; what learns through the filter rarely comes to their edge."""
GROUPS = ("straight", "ended", "begun", "thrust", "left", "right", "old_thrust", "old_left", "old_right")
"""Of hypotheses whose probabilities are shown: straight flight older than the first age and of the first age,
manoeuvres of the first age, kinds of manoeuvres of the ages between, and of the last age."""


class Steered(NamedTuple):
    """The filter at one moment."""

    mean: Array
    """x, y (m), vx, vy (m/s) estimated, ``(4, N)``."""
    covariance: Array
    """``(4, 4, N)``."""
    track: SemiMarkovTrack
    """Hypotheses; predicted between :meth:`HypothesesBank.predict` and the action."""
    innovation: Array
    """Of all hypotheses together over its sigma, along and across the predicted velocity, ``(2, N)``."""
    prior: Array
    """Logarithm of the sigma of the predicted position over that of the measurement, likewise."""
    predicted: Array
    """Probabilities of groups of hypotheses before the measurement, ``(G, N)``."""
    probabilities: Array
    """After it, if the action is zero, likewise."""
    entropy: Array
    """Of the hypotheses then, over the largest possible, ``(N,)``."""
    log_likelihood: Array
    """Of the measurement, nats, ``(N,)``; zero where there is none."""
    nis: Array
    """Mean of the hypotheses' normalised innovations squared by their posterior weights, likewise."""


class HypothesesBank(RadarBank):
    """The semi-Markov Gaussian sum, steered by factors of its weights, covariances and measurement noise."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(REACH),), numpy.float32)

    def __init__(self, task: "ManeuveringTarget", control: str) -> None:
        super().__init__(task, control)
        self.filter = SemiMarkov(task)
        ages, straight = self.filter.ages, self.filter.straight_ages
        tables = [
            range(straight + i * ages, straight + (i + 1) * ages) for i in range(1 + len(self.filter.turns))
        ]
        begun = [table[0] for table in tables]
        turns = list(zip(self.filter.turns, tables[1:], strict=True))
        sides = ([table for turn, table in turns if side * turn > 0.0] for side in (1.0, -1.0))
        kinds = (tables[:1], *sides)
        members = (
            list(range(1, straight)),
            [0],
            begun,
            *([h for table in kind for h in table[1:-1]] for kind in kinds),
            *([table[-1] for table in kind] for kind in kinds),
        )
        self.groups = dict(zip(GROUPS, members, strict=True))
        every = range(tables[-1][-1] + 1)
        turning = [h for table in tables[1:] for h in table]
        self.log_reach = task.constant([math.log(factor) for factor in REACH])[:, None]
        raised = [[float(h in those) for h in every] for those in (begun, [0], turning)]
        self.raised = task.constant(raised)[:, :, None]
        """Whose weights each of the first three actions multiplies, ``(3, H, 1)``."""

    @property
    def blocks(self) -> Sequence[Block]:
        """The innovation, how well the filter has predicted it, and what it believes."""
        xp = self.xp
        area = 2.0 * math.pi * self.parameters.range_sigma**2
        return (
            Block(
                "innovation",
                lambda f, _: f.innovation,
                "the innovation of all hypotheses together over its predicted sigma",
                FRAME,
                BOUNDED_LOG,
            ),
            Block(
                "squared_innovation",
                lambda f, _: f.nis,
                "the hypotheses' mean normalised innovation squared",
                shown=LOG1P,
            ),
            Block(
                "log_likelihood",
                lambda f, measurement: f.log_likelihood + measurement.available * math.log(area),
                "the log-density of the measurement where 2 pi range_sigma^2 is the unit of area, nats",
                shown=BOUNDED_LOG,
            ),
            Block(
                "prior",
                lambda f, _: f.prior,
                "the sigma of the predicted position over that of the measurement",
                FRAME,
                KEPT_AS_LOG,
            ),
            Block(
                "log_predicted",
                lambda f, _: imm.log_probabilities(f.predicted),
                "the logarithm of the probability before the measurement",
                GROUPS,
                SIGNED_LOG,
            ),
            Block(
                "probability",
                lambda f, _: xp.clip(f.probabilities, 0.0, 1.0),
                "probability after the measurement if the action is zero",
                GROUPS,
                SHARE,
            ),
            Block(
                "entropy",
                lambda f, _: xp.clip(f.entropy, 0.0, 1.0),
                "entropy of the hypotheses then over the largest possible",
                shown=SHARE,
            ),
            *self.surroundings(),
        )

    def start(self, initial: Initial) -> Steered:
        """Start where the estimator starts."""
        track = self.filter.start_track(initial)
        none = 0.0 * initial.mean[:2]
        groups = self.group(self.xp.concat([table.probability for table in track]))
        return Steered(*initial[:2], track, none, none, groups, groups, none[0], none[0], none[0])

    def group(self, probabilities: Array) -> Array:
        """Probabilities of groups, ``(G, N)``, of those of hypotheses, ``(H, N)``."""
        return self.xp.stack(
            [ordered_sum(probabilities[h] for h in members) for members in self.groups.values()]
        )

    def predict(self, state: Steered, measurement: Measurement) -> Steered:
        """Predict to the scan as the estimator does, and see what it would make of the measurement."""
        xp = self.xp
        tables = self.filter.predict_track(state.track, measurement.interval)
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
        unsteered = self.filter.update_track(tables, measurement)
        p = unsteered.probabilities
        surprise = ordered_sum(p * xp.log(xp.clip(p, 1e-300, None)))
        return state._replace(
            track=SemiMarkovTrack(*(table.pack() for table in tables)),
            innovation=apply(frame, innovation) / xp.sqrt(own + sensor),
            prior=0.5 * xp.log(own / sensor),
            predicted=self.group(weights),
            probabilities=self.group(p),
            entropy=-surprise / math.log(p.shape[0]),
            log_likelihood=measurement.available * unsteered.log_likelihood,
            nis=measurement.available * unsteered.nis,
        )

    def act(self, state: Steered, measurement: Measurement, action: Array) -> Steered:
        """Update as the estimator does, by the weights and noises that the action sets."""
        xp = self.xp
        logarithms = measurement.available * self.log_reach * xp.clip(action, -1.0, 1.0)
        factors = xp.exp(logarithms[3:])
        straight, thrust, turns = self.reweigh([table.unpack() for table in state.track], logarithms[:3])
        tables = (
            _scaled(straight, factors[0]),
            _scaled(thrust, factors[1]),
            _scaled(turns, factors[1]),
        )
        measured = measurement._replace(variance=factors[2] * measurement.variance)
        found = self.filter.update_track(tables, measured)
        return state._replace(mean=found.mean, covariance=found.covariance, track=found.track)

    def reweigh(self, tables: Iterable[Hypotheses], logarithms: Array) -> Tables:
        """Tables with the odds of what has begun, what has ended, and turns multiplied; of logarithms ``(3, N)``."""
        factors = self.xp.exp(ordered_sum(self.raised * logarithms[:, None]))
        weighed, first = [], 0
        for table in tables:
            last = first + table.probability.shape[0]
            weighed.append(table._replace(probability=factors[first:last] * table.probability))
            first = last
        straight, thrust, turns = weighed
        return straight, thrust, turns

    def records(self, state: Steered, measurement: Measurement) -> dict[str, Array]:
        """How well the measurement was predicted, NaN where there is none."""
        there = measurement.available > 0.0
        return {
            "nis": self.xp.where(there, state.nis, math.nan),
            "nis_degrees": 2.0 * measurement.available,
            "log_likelihood": self.xp.where(there, state.log_likelihood, math.nan),
        }


def _scaled(table: Hypotheses, factor: Array) -> Hypotheses:
    """Hypotheses whose covariances are multiplied."""
    return table._replace(covariance=factor * table.covariance)
