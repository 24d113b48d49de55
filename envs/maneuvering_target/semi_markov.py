"""The semi-Markov Gaussian sum of ManeuveringTarget: hypotheses of straight flight, thrust and turns, each with its
age.

Equations: ``filters/semi_markov.py``. Constant thrust and coordinated turns are the manoeuvres of the training
distribution; the filter's parameters are its prior of them. The control ``hypotheses`` steers this estimator,
``semi-markov``. H hypotheses of kind and age predict to the scan with weights p', means x' and covariances P'. Factors
f of its settings change the update with this measurement alone:

    p'(h) <- p'(h) f1^begun(h) f2^ended(h) f3^turning(h)                                    renormalised by Bayes' rule
    P'(h) <- P'(h) f4 in straight flight, P'(h) f5 in manoeuvres,    R <- R f6

begun: a manoeuvre of the first age; ended: straight flight of the first age; turning: a turn of any age. So f1 and f2
multiply the odds that a manoeuvre has just begun, or ended, as other hazards would; f3 those of a turn against all
else; f4 and f5 scale the predicted covariance, as in a filter of fading memory (H. W. Sorenson and J. E. Sacks,
Recursive fading memory filtering, Information Sciences 3, 1971, 101-119). In a scan that missed the target there is
only a prediction.
"""

import functools
import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from ...filters import contaminated_normal, coordinated_turn, imm, kalman, semi_markov
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ...filters.semi_markov import AgedHypotheses
from ...filters.small_matrices import mirror_lower
from ..contract.controls import SteerableFilter
from ..contract.filter import FilterInput, Initial, Likelihood
from ..contract.observation import Array
from .constant_velocity import ConstantVelocityModel
from .problem import TargetProblem
from .world import Measurement

DURATIONS = (0.0, 0.0, *[1.0] * 10)
"""Relative probabilities of manoeuvres of 1, 2, ... scans in the training distribution."""
SLOWEST = 30.0
"""Smallest speed by which the acceleration of a turn is divided, m/s, as in the training distribution."""


class SemiMarkovPrior(NamedTuple):
    """Prior of a semi-Markov filter on the flights: hazards and sizes of manoeuvres."""

    begin: float = 0.0157
    """Probability that a manoeuvre begins before a scan."""
    turning: float = 0.5
    """Share of turns among manoeuvres."""
    hazards: tuple[float, ...] = tuple(semi_markov.hazards(DURATIONS, 4))
    """Probability that a manoeuvre ends after each age in scans; the last one for all later ages."""
    thrust: float = 2.56
    """Standard deviation of the acceleration of thrust along x and y, m/s^2."""
    turns: tuple[float, ...] = (1.875, 4.625)
    """Mean acceleration in gentle, steep, ... turns, m/s^2; empty: all manoeuvres are thrust."""
    turn_spread: float = 0.8
    """Standard deviation of the acceleration in each, m/s^2."""
    hard_turns: float = 0.0
    """Share of harder turns among turns, with hypotheses of their own; zero: there are none."""
    hard_turn: tuple[float, float] = (11.0, 2.5)
    """Mean and standard deviation of the acceleration in these, m/s^2."""
    noise: float = 0.01
    """Standard deviation of an acceleration that changes from scan to scan in all flight, m/s^2."""
    change: float = 0.01
    """Standard deviation of the change of a manoeuvre's acceleration in a scan period, m/s^2."""
    outliers: float = 1e-4
    """Probability that a measurement is an outlier."""
    outlier_factor: float = 5.0
    """Ratio of the standard deviation of an outlier's errors to the stated one."""
    straight_ages: int = 12
    """Number of scans for which straight flights after different manoeuvres remain separate hypotheses. With one, a
    false manoeuvre spoils the estimate of long straight flight in every scan."""


TRAINING = SemiMarkovPrior()
"""Prior of the flights of ``random``: on average 1.5 manoeuvres of 3 to 12 scans, all durations equally probable, in
100
scans; half of them turns. Accelerations are uniform from 0.5 to 6 m/s^2, whose halves have these means and deviations,
and whose mean square on each axis is that of the thrust. Nothing else disturbs them and there are no outliers; small
numbers for these let the filter survive both."""
WIDE = TRAINING._replace(thrust=4.0, hard_turns=0.03)
"""Prior of manoeuvres of any strength: most as in training, some twice as hard. On the validation split of ``random``
it costs as much as ``TRAINING`` within chance."""
VAGUE = SemiMarkovPrior(
    begin=0.03,
    hazards=(0.1, 0.1, 0.1, 0.1),
    thrust=3.0,
    turns=(1.5, 4.5),
    turn_spread=1.2,
    noise=0.05,
    change=0.1,
    outliers=0.02,
)
"""Prior, ours, for little-known flights: a manoeuvre every few minutes, of any duration, ten scans on average."""


def training_prior(hypotheses: int) -> SemiMarkovPrior:
    """Return the prior of the training distribution for a filter of few hypotheses.

    Manoeuvres have one age: thrust, and from nine hypotheses on a turn to either side. All others are ages of straight
    flight, which matter most: they keep false manoeuvres apart.

    Args:
        hypotheses: H, at least 2.
    """
    turns = (3.25,) if hypotheses >= 9 else ()
    return TRAINING._replace(
        hazards=tuple(semi_markov.hazards(DURATIONS, 1)),
        turns=turns,
        turn_spread=5.5 / math.sqrt(12.0),
        straight_ages=hypotheses - 1 - 2 * len(turns),
    )


Tables = tuple[AgedHypotheses, ...]
"""Hypotheses of straight flight by the time since the last manoeuvre, with position and velocity; of thrust by age,
with
the acceleration along x and y; and of turns, if the prior has any, by age, one kind of turn after another, with the
turn rate."""


class Turn(NamedTuple):
    """A kind of turn: its acceleration and its share of all turns."""

    acceleration: float
    """Mean acceleration, to the left positive, m/s^2."""
    spread: float
    """Standard deviation of the acceleration, m/s^2."""
    share: float
    """Share of this kind among turns."""


class SemiMarkovState(NamedTuple):
    """State of the semi-Markov filter: estimate, hypotheses with their ages, likelihood."""

    mean: Array
    """Mean of all hypotheses together, ``(4, N)``."""
    covariance: Array
    """Covariance of all hypotheses together, ``(4, 4, N)``."""
    likelihood: Likelihood
    track: Tables
    """Hypotheses, with packed covariances."""


class SemiMarkov(ConstantVelocityModel, SteerableFilter[TargetProblem, Measurement, SemiMarkovState]):
    """Estimator ``semi-markov``: Gaussian sum over straight flight, constant thrust and turns, each with its age.

    Every hypothesis of kind and age has a Kalman filter, an extended one of the turn. Turns to the left and to the
    right are kinds of their own, and so are gentle and steep ones: about a turn rate of zero the extended filter would
    linearise where no turn is.

    Args:
        **changed: fields of the prior.
    """

    def __init__(self, task: TargetProblem, prior: SemiMarkovPrior = TRAINING, **changed: Any) -> None:
        super().__init__(task)
        self.settings: Mapping[str, float] = {
            "begun": 3.0, "ended": 9.0, "turning": 1.5, "straight": 1.25, "manoeuvre": 1.25, "noise": 1.25
        }  # fmt: skip
        prior = prior._replace(**changed)
        self.prior = prior
        self.ages: int = len(prior.hazards)
        self.hazard: Array = task.constant(prior.hazards)[:, None]
        sizes = [(size, prior.turn_spread, 1.0 - prior.hard_turns) for size in prior.turns]
        self.turns: list[Turn] = [
            Turn(side * size, spread, share / (2 * len(sizes)))
            for size, spread, share in sizes
            for side in (1.0, -1.0)
        ]
        if prior.hard_turns:
            mean, spread = prior.hard_turn
            self.turns += [Turn(side * mean, spread, 0.5 * prior.hard_turns) for side in (1.0, -1.0)]
        kinds, first = 1 + len(self.turns), prior.straight_ages
        self.kinds = [range(first + i * self.ages, first + (i + 1) * self.ages) for i in range(kinds)]
        """Indices of the hypotheses of thrust, and of each kind of turn; those before are straight flight."""
        every = range(self.kinds[-1][-1] + 1)
        begun, turning = [kind[0] for kind in self.kinds], range(self.kinds[0][-1] + 1, len(every))
        raised = [[float(h in those) for h in every] for those in (begun, [0], turning)]
        self.raised: Array = task.constant(raised)[:, :, None]
        """Mask of the hypotheses whose weights each of the first three settings multiplies, ``(3, H, 1)``."""

    def start(self, initial: Initial) -> SemiMarkovState:
        """Return the filter's state at the start: the initial estimate, in straight flight for long."""
        xp, least = self.xp, semi_markov.LEAST_PROBABILITY
        none = 0.0 * initial.mean[0]

        def repeat(state: tuple[Array, Array], probabilities: list[float]) -> AgedHypotheses:
            return AgedHypotheses(
                xp.stack([state[0]] * len(probabilities), axis=1),
                xp.stack([state[1]] * len(probabilities), axis=2),
                xp.stack([probability + none for probability in probabilities]),
            )

        others = [least] * self.ages
        track = [
            repeat(initial, [least] * (self.prior.straight_ages - 1) + [1.0]),
            repeat(self.begin_thrust(*initial), others),
        ]
        if self.turns:
            turns = [repeat(self.begin_turn(*initial, turn), others) for turn in self.turns]
            track.append(semi_markov.join(turns))
        packed = tuple(table.pack() for table in track)
        return SemiMarkovState(initial.mean, initial.covariance, Likelihood.unknown(none), packed)

    def begin_thrust(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Return the state extended by an unknown acceleration: mean ``(6, N)``, covariance ``(6, 6, N)``."""
        none = 0.0 * mean[:2]
        variance = self.prior.thrust**2 + none[0]
        return self.xp.concat([mean, none]), self.augment(covariance, [variance, variance])

    def begin_turn(self, mean: Array, covariance: Array, turn: Turn) -> tuple[Array, Array]:
        """Return the state extended by the turn rate of a kind of turn: mean ``(5, N)``, covariance ``(5, 5, N)``."""
        pace = self.xp.sqrt(self.squared_pace(mean))
        rate = turn.acceleration / pace
        return self.xp.concat([mean, rate[None]]), self.augment(covariance, [(turn.spread / pace) ** 2])

    def squared_pace(self, mean: Array) -> Array:
        """Return the squared speed, (m/s)^2, that converts accelerations of turns to turn rates."""
        return self.xp.clip(mean[2] ** 2 + mean[3] ** 2, SLOWEST**2, None)

    def augment(self, covariance: Array, variances: list[Array]) -> Array:
        """Return the covariance of a state extended by components that are independent of it and each other."""
        n, none = covariance.shape[0], 0.0 * variances[0]
        size = range(n + len(variances))
        return self.xp.stack(
            [
                self.xp.stack(
                    [
                        covariance[i, j] if max(i, j) < n else variances[i - n] if i == j else none
                        for j in size
                    ]
                )
                for i in size
            ]
        )

    def switch(self, straight: AgedHypotheses, thrust: AgedHypotheses, *turns: AgedHypotheses) -> Tables:
        """Return the hypotheses after manoeuvres have begun and ended with their hazards."""
        ages, turning = self.ages, self.prior.turning if self.turns else 0.0
        modes = [semi_markov.Mode(thrust, self.hazard, (1.0 - turning) * self.prior.begin, self.begin_thrust)]
        for table in turns:
            modes += [
                semi_markov.Mode(
                    table.take(slice(ages * i, ages * (i + 1))),
                    self.hazard,
                    turning * self.prior.begin * turn.share,
                    functools.partial(self.begin_turn, turn=turn),
                )
                for i, turn in enumerate(self.turns)
            ]
        straight, (thrust, *kinds) = semi_markov.switch(straight, modes)
        return straight, thrust, *([semi_markov.join(kinds)] if kinds else [])

    def predict_hypotheses(
        self, straight: AgedHypotheses, thrust: AgedHypotheses, *turns: AgedHypotheses, T: Array
    ) -> Tables:
        """Return the hypotheses predicted over an interval (s), each by its kind of motion."""
        F, unit = (matrix[:, :, None] for matrix in self.motion(T))
        Q = self.prior.noise**2 * unit
        change = self.prior.change**2 * T[None] / self.task.parameters.sampling_interval
        accelerated = kalman.constant_acceleration(T, axes=2)[:, :, None]
        moved = [
            _moved(straight, *kalman.predict(straight.mean, straight.covariance, F, Q)),
            _moved(
                thrust,
                *kalman.predict(
                    thrust.mean, thrust.covariance, accelerated, self.augment(Q, [change, change])
                ),
            ),
        ]
        for table in turns:
            square = self.squared_pace(table.mean)
            noise = self.augment(Q + 0.0 * square, [change / square])
            moved.append(_moved(table, *coordinated_turn.predict(table.mean, table.covariance, T, noise)))
        return tuple(moved)

    def predict(self, state: SemiMarkovState, measurement: Measurement) -> SemiMarkovState:
        """Return the hypotheses predicted to the scan, after manoeuvres may have begun or ended."""
        switched = self.switch(*(table.unpack() for table in state.track))
        tables = self.predict_hypotheses(*switched, T=measurement.interval)
        return state._replace(track=tuple(table.pack() for table in tables))

    def has_effect(self, measurement: Measurement) -> Array:
        """Return 1 where the scan saw the target, so that an action has an effect, else 0, ``(N,)``."""
        return measurement.available

    def apply_factors(self, tables: Iterable[AgedHypotheses], logarithms: Array) -> list[AgedHypotheses]:
        """Return the hypotheses with weights and covariances multiplied by the action's factors.

        ``logarithms`` are those of the factors, ``(5, N)``.
        """
        factors = self.xp.exp(ordered_sum(self.raised * logarithms[:3, None]))
        straight, manoeuvre = self.xp.exp(logarithms[3:])
        scaled, first = [], 0
        for i, table in enumerate(tables):
            growth = manoeuvre if i else straight
            last = first + table.probability.shape[0]
            weights = factors[first:last] * table.probability
            scaled.append(table._replace(probability=weights, covariance=growth * table.covariance))
            first = last
        return scaled

    def update(self, state: SemiMarkovState, inputs: FilterInput) -> SemiMarkovState:
        """Return all hypotheses and their weights updated with a measurement.

        Its normalised innovation squared is the mean of the filters', by their posterior weights.
        """
        xp, measurement = self.xp, inputs.measurement
        tables = [table.unpack() for table in state.track]
        if inputs.action is not None:
            tables = self.apply_factors(tables, inputs.action[:5])
            measurement = measurement._replace(variance=xp.exp(inputs.action[5]) * measurement.variance)
        results = [self.update_table(table, measurement) for table in tables]
        logarithms = xp.concat(
            [xp.log(table.probability) + r.log_likelihood for table, r in zip(tables, results, strict=True)]
        )
        probabilities = imm.softmax(logarithms)
        mean, covariance = imm.combine(
            xp.concat([r.mean[:4] for r in results], axis=1),
            xp.concat([r.covariance[:4, :4] for r in results], axis=2),
            probabilities,
        )
        nis = weighted_sum(probabilities, xp.concat([r.squared_distance for r in results]))
        ends = itertools.accumulate((table.probability.shape[0] for table in tables), initial=0)
        parts = [probabilities[i:j] for i, j in itertools.pairwise(ends)]
        track = tuple(
            AgedHypotheses(r.mean, r.covariance, p).pack() for r, p in zip(results, parts, strict=True)
        )
        likelihood = self.likelihood(measurement, imm.log_sum(logarithms), nis)
        return SemiMarkovState(mean, covariance, likelihood, track)

    def update_table(self, table: AgedHypotheses, measurement: Measurement) -> kalman.Update:
        """Return the hypotheses of one kind updated with the measured position, or unchanged without one."""
        result = contaminated_normal.update_position(
            table.mean,
            table.covariance,
            measurement.position[:, None],
            measurement.variance[:, None],
            self.prior.outliers,
            self.prior.outlier_factor,
        )
        return self.where_detected(measurement, result, kalman.Update(table.mean, table.covariance, 0.0, 0.0))


def _moved(table: AgedHypotheses, mean: Array, covariance: Array) -> AgedHypotheses:
    return table._replace(mean=mean, covariance=mirror_lower(covariance))
