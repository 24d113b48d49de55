"""The semi-Markov Gaussian sum of ManeuveringTarget: straight flight, thrust and turns, each with its age.

Equations: ``filters/semi_markov.py``. Constant thrust and coordinated turns are what the target flies in the training
distribution; the filter's parameters are its prior of them. It is the estimator ``semi-markov`` of the baselines, and
what the control ``hypotheses`` steers. H hypotheses of kind and age predict to the scan with weights p', means x' and
covariances P'. Factors f of its settings change what the measurement is weighed with, this once:

    p'(h) <- p'(h) f1^begun(h) f2^ended(h) f3^turning(h)                                    renormalised by Bayes' rule
    P'(h) <- P'(h) f4 in straight flight, P'(h) f5 in manoeuvres,    R <- R f6

begun: a manoeuvre of the first age; ended: straight flight of the first age; turning: a turn of any age. So f1 and f2
multiply the odds that a manoeuvre has just begun, or ended, as other hazards would; f3 those of a turn against all
else; f4 and f5 say that the prediction is worse or better than the filter believes, as in a filter of fading memory (H.
W. Sorenson and J. E. Sacks, Recursive fading memory filtering, Information Sciences 3, 1971, 101-119). A scan that
missed the target is prediction only.
"""

import functools
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from ...filters import contaminated_normal, coordinated_turn, imm, kalman, semi_markov
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ...filters.semi_markov import Hypotheses
from ...filters.small_matrices import mirror_lower
from ..contract.controls import Steerable
from ..contract.filter import Initial, Input, Likelihood
from ..contract.observation import Array
from .constant_velocity import ConstantVelocityModel
from .world import Measurement

if TYPE_CHECKING:
    from .task import ManeuveringTarget

SLOWEST = 30.0
"""m/s: turns of what is slower are no sharper, as in the training distribution."""


class SemiMarkovPrior(NamedTuple):
    """What a semi-Markov filter expects of flights."""

    begin: float = 0.0157
    """Probability that a manoeuvre begins before a scan."""
    turning: float = 0.5
    """Share of turns among manoeuvres."""
    hazards: tuple[float, ...] = tuple(semi_markov.hazards([0.0] * 2 + [1.0] * 10, 4))
    """Probability that a manoeuvre ends after each age in scans; the last one for all ages beyond."""
    thrust: float = 2.56
    """Standard deviation of the acceleration of thrust along x and y, m/s^2."""
    turns: tuple[float, ...] = (1.875, 4.625)
    """Mean acceleration in gentle, steep, ... turns, m/s^2."""
    turn_spread: float = 0.8
    """Its standard deviation in each, m/s^2."""
    noise: float = 0.01
    """Standard deviation of what disturbs all flight, an acceleration that changes from scan to scan, m/s^2."""
    change: float = 0.01
    """Of the change of a manoeuvre's acceleration in a scan period, m/s^2."""
    outliers: float = 1e-4
    """Probability that a measurement is one."""
    outlier_factor: float = 5.0
    """Standard deviation of its errors over the stated one."""


TRAINING = SemiMarkovPrior()
"""Of the flights of ``random``: on average 1.5 manoeuvres of 3 to 12 scans, all durations alike, in 100 scans; half of
them turns; accelerations uniform from 0.5 to 6 m/s^2, whose halves have these means and deviations, and whose mean
square on each axis is that of the thrust. Nothing disturbs them, and there are no outliers: numbers for these are
small, so that what is impossible there can still be survived."""
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
"""Ours, for flights of which little is known: a manoeuvre every few minutes, of any duration, ten scans on average."""


class SemiMarkovTrack(NamedTuple):
    """Hypotheses of the semi-Markov filter; covariances are packed."""

    straight: Hypotheses
    """By the time since the last manoeuvre; state of position and velocity."""
    thrust: Hypotheses
    """By age; with the acceleration along x and y."""
    turns: Hypotheses
    """By age, one kind of turn after another; with the turn rate."""


Tables = tuple[Hypotheses, Hypotheses, Hypotheses]
"""Of straight flight, thrust and turns, with whole covariances."""


class SemiMarkovState(NamedTuple):
    """State of the semi-Markov filter."""

    mean: Array
    """Of all hypotheses together, ``(4, N)``."""
    covariance: Array
    """``(4, 4, N)``."""
    likelihood: Likelihood
    track: SemiMarkovTrack


class SemiMarkov(ConstantVelocityModel, Steerable["ManeuveringTarget", Measurement, SemiMarkovState]):
    """Gaussian sum over straight flight, constant thrust and coordinated turns with the time since each began.

    Every hypothesis of kind and age has a Kalman filter, an extended one of the turn, and manoeuvres last as their
    distribution says, not geometrically. Turns to the left and to the right are kinds of their own, and so are gentle
    and steep ones: about a turn rate of zero the extended filter would linearise where no turn is.

    Args:
        task: the problem.
        prior: what it expects.
        **changed: fields of the prior.
    """

    straight_ages = 12
    """Straight flights after different manoeuvres stay apart so long; with one, what has hardly been a manoeuvre
    spoils the long memory of straight flight in every scan."""

    settings: ClassVar[dict[str, float]] = {
        "begun": 3.0, "ended": 9.0, "turning": 1.5, "straight": 1.25, "manoeuvre": 1.25, "noise": 1.25
    }  # fmt: skip

    def __init__(self, task: "ManeuveringTarget", prior: SemiMarkovPrior = TRAINING, **changed: Any) -> None:
        super().__init__(task)
        self.prior = prior = prior._replace(**changed)
        self.ages, self.hazard = len(prior.hazards), task.constant(prior.hazards)[:, None]
        self.turns = [side * size for size in prior.turns for side in (1.0, -1.0)]
        """Mean acceleration of each kind of turn, to the left positive, m/s^2."""
        kinds, first = 1 + len(self.turns), self.straight_ages
        self.kinds = [range(first + i * self.ages, first + (i + 1) * self.ages) for i in range(kinds)]
        """Numbers of the hypotheses of thrust, and of each kind of turn; before them are those of straight flight."""
        every = range(self.kinds[-1][-1] + 1)
        begun, turning = [kind[0] for kind in self.kinds], range(self.kinds[1][0], len(every))
        raised = [[float(h in those) for h in every] for those in (begun, [0], turning)]
        self.raised = task.constant(raised)[:, :, None]
        """Whose weights each of the first three settings multiplies, ``(3, H, 1)``."""

    def start(self, initial: Initial) -> SemiMarkovState:
        """Start where everyone starts, long in straight flight."""
        xp, least = self.xp, semi_markov.LEAST_PROBABILITY
        none = 0.0 * initial.mean[0]

        def repeat(state: tuple[Array, Array], probabilities: list[float]) -> Hypotheses:
            return Hypotheses(
                xp.stack([state[0]] * len(probabilities), axis=1),
                xp.stack([state[1]] * len(probabilities), axis=2),
                xp.stack([probability + none for probability in probabilities]),
            )

        others = [least] * self.ages
        turns = [repeat(self.begin_turn(*initial, turn), others) for turn in self.turns]
        track = SemiMarkovTrack(
            repeat(initial, [least] * (self.straight_ages - 1) + [1.0]).pack(),
            repeat(self.begin_thrust(*initial), others).pack(),
            semi_markov.join(turns).pack(),
        )
        return SemiMarkovState(initial.mean, initial.covariance, Likelihood.unknown(none), track)

    def begin_thrust(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """State with an acceleration that is not known, ``(6, N)`` and ``(6, 6, N)``."""
        none = 0.0 * mean[:2]
        variance = self.prior.thrust**2 + none[0]
        return self.xp.concat([mean, none]), self.augment(covariance, [variance, variance])

    def begin_turn(self, mean: Array, covariance: Array, acceleration: float) -> tuple[Array, Array]:
        """State with the turn rate of a turn with a mean acceleration, ``(5, N)`` and ``(5, 5, N)``."""
        pace = self.xp.sqrt(self.squared_pace(mean))
        rate = acceleration / pace
        return self.xp.concat([mean, rate[None]]), self.augment(
            covariance, [(self.prior.turn_spread / pace) ** 2]
        )

    def squared_pace(self, mean: Array) -> Array:
        """Square of the speed that divides accelerations of turns, (m/s)^2."""
        return self.xp.clip(mean[2] ** 2 + mean[3] ** 2, SLOWEST**2, None)

    def augment(self, covariance: Array, variances: list[Array]) -> Array:
        """Covariance of a state and further components that are independent of it and of each other."""
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

    def switch(self, straight: Hypotheses, thrust: Hypotheses, turns: Hypotheses) -> Tables:
        """Let manoeuvres end and begin."""
        ages, each = self.ages, self.prior.turning * self.prior.begin / len(self.turns)
        thrusting = semi_markov.Mode(
            thrust, self.hazard, (1.0 - self.prior.turning) * self.prior.begin, self.begin_thrust
        )
        turning = [
            semi_markov.Mode(
                turns.take(slice(ages * i, ages * (i + 1))),
                self.hazard,
                each,
                functools.partial(self.begin_turn, acceleration=acceleration),
            )
            for i, acceleration in enumerate(self.turns)
        ]
        straight, (thrust, *kinds) = semi_markov.switch(straight, [thrusting, *turning])
        return straight, thrust, semi_markov.join(kinds)

    def fly(self, straight: Hypotheses, thrust: Hypotheses, turns: Hypotheses, T: Array) -> Tables:
        """Fly on for an interval (s) in the mode of each hypothesis."""
        F, unit = (matrix[:, :, None] for matrix in self.motion(T))
        Q = self.prior.noise**2 * unit
        change = self.prior.change**2 * T[None] / self.task.parameters.sampling_interval
        accelerated = kalman.constant_acceleration(T, axes=2)[:, :, None]
        square = self.squared_pace(turns.mean)
        return (
            _moved(straight, *kalman.predict(straight.mean, straight.covariance, F, Q)),
            _moved(
                thrust,
                *kalman.predict(
                    thrust.mean, thrust.covariance, accelerated, self.augment(Q, [change, change])
                ),
            ),
            _moved(
                turns,
                *coordinated_turn.predict(
                    turns.mean, turns.covariance, T, self.augment(Q + 0.0 * square, [change / square])
                ),
            ),
        )

    def predict(self, state: SemiMarkovState, measurement: Measurement) -> SemiMarkovState:
        """Let manoeuvres end and begin, and fly on to the scan."""
        tables = self.fly(*self.switch(*(table.unpack() for table in state.track)), measurement.interval)
        return state._replace(track=SemiMarkovTrack(*(table.pack() for table in tables)))

    def heeds(self, measurement: Measurement) -> Array:
        """Where the scan saw the target."""
        return measurement.available

    def steer(self, tables: Iterable[Hypotheses], logarithms: Array) -> list[Hypotheses]:
        """Multiply weights and covariances by factors of these logarithms, ``(5, N)``."""
        factors = self.xp.exp(ordered_sum(self.raised * logarithms[:3, None]))
        straight, manoeuvre = self.xp.exp(logarithms[3:])
        steered, first = [], 0
        for table, growth in zip(tables, (straight, manoeuvre, manoeuvre), strict=True):
            last = first + table.probability.shape[0]
            weights = factors[first:last] * table.probability
            steered.append(table._replace(probability=weights, covariance=growth * table.covariance))
            first = last
        return steered

    def update(self, state: SemiMarkovState, given: Input) -> SemiMarkovState:
        """Take in a measurement. Its normalised innovation squared is the mean of the filters' by their posterior
        weights.
        """
        xp, measurement = self.xp, given.measurement
        tables = [table.unpack() for table in state.track]
        if given.action is not None:
            tables = self.steer(tables, given.action[:5])
            measurement = measurement._replace(variance=xp.exp(given.action[5]) * measurement.variance)
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
        ends = [0, self.straight_ages, self.straight_ages + self.ages, probabilities.shape[0]]
        parts = [probabilities[i:j] for i, j in itertools.pairwise(ends)]
        track = SemiMarkovTrack(
            *(Hypotheses(r.mean, r.covariance, p).pack() for r, p in zip(results, parts, strict=True))
        )
        likelihood = self.likelihood(measurement, imm.log_sum(logarithms), nis)
        return SemiMarkovState(mean, covariance, likelihood, track)

    def update_table(self, table: Hypotheses, measurement: Measurement) -> kalman.Update:
        """Update every hypothesis with the measured position, or leave it as predicted."""
        result = contaminated_normal.update_position(
            table.mean,
            table.covariance,
            measurement.position[:, None],
            measurement.variance[:, None],
            self.prior.outliers,
            self.prior.outlier_factor,
        )
        return self.where_detected(measurement, result, kalman.Update(table.mean, table.covariance, 0.0, 0.0))


def _moved(table: Hypotheses, mean: Array, covariance: Array) -> Hypotheses:
    """Hypotheses after the time update."""
    return table._replace(mean=mean, covariance=mirror_lower(covariance))
