r"""A bank of extended Kalman filters over motion and sensor faults of TightlyCoupledNavigation.

The bank has the paper's three hypotheses on the motion: rest, constant velocity, Singer manoeuvre. Legs follow each
other so: a manoeuvre begins with an acceleration that is independent of the past, also after another manoeuvre;
constant velocity follows a manoeuvre; rest does not return. So before each measurement a fourth hypothesis, "a
manoeuvre has begun at this step", is made of the predictions of all three, with an acceleration of zero and the
variance of the prior; after the measurement it is merged with the manoeuvre by moments.

Each filter has, beside the 17 states of the paper, one error for every pseudorange (``filters/range_errors.py``). Under
an open sky it is a Gauss-Markov process. Between houses, which the C/N0 indicates, it is constant for about a second
and is then drawn anew, with a mean and a variance that depend on the C/N0. The update by a pseudorange tests each
satellite for that: a jump of a pseudorange is assigned to its own error and excluded from the position.

The noise of every rate is at one of L levels, a Markov chain that all hypotheses share; the rate enters each filter as
a Gaussian sum. Accelerometer readings that repeat exactly are excluded: noise never repeats.

Reading: levels and renewals are weighted under each hypothesis on the motion, and the levels then averaged over them.

The control ``hypotheses`` steers this estimator, ``fault-hypotheses``. Before the readings the hypotheses on the
motion have probabilities p', each range error j is drawn anew with the probability p_j, and the level l of every rate
has the probability q'(l). Factors f of its settings change the update:

    p'(begun) <- p'(begun) f1,  p'(manoeuvre) <- p'(manoeuvre) f2                          renormalised by Bayes' rule
    p_j / (1 - p_j) <- f3 p_j / (1 - p_j)
    q'(l) <- q'(l) f4^s(l)                                                            renormalised
    Q <- Q f5,  R_k <- R_k f(5 + k)                                                        k = 1, 2, 3

begun: a manoeuvre begins at this step; manoeuvre: one continues; s(l): logarithm of level l over the nominal one,
one for the highest; Q: process noise of the 17 states; R_k: variance of pseudoranges, of rates at all their levels, of
accelerometers. Where a rate is missing its levels keep their predicted probabilities.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...filters import extended_kalman, gnss_ins, imm, range_errors
from ...filters.array_namespace import zeros_for
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ...filters.packed_covariance import pack, unpack
from ..contract.controls import SteerableFilter
from ..contract.filter import FilterInput, Initial, Likelihood
from ..contract.observation import Array
from .parameters import LINE, REST, SINGER
from .problem import NavigationProblem
from .world import Measurement

LEAST_PROBABILITY = 1e-30
"""Smallest probability of constant velocity: the weights of merged hypotheses are never zero by zero."""
CN0_LIMITS = (30.0, 38.0, 44.0)
"""Limits of C/N0 classes, dB-Hz, within which the errors between houses have the same distribution."""


class FaultPrior(NamedTuple):
    """Prior of the bank on motion, range errors and noise levels."""

    quiet: float = 1.0
    """Time from the start within which no leg ends, s."""
    leg: float = 2.0
    """Mean duration of a leg, s."""
    acceleration: float = 13.0
    """Standard deviation of the initial acceleration of a manoeuvre, m/s^2 per axis."""
    acceleration_between_houses: float = 1.3
    start: tuple[float, float, float] = (0.425, 0.425, 0.15)
    """Probabilities of rest, constant velocity and manoeuvre at the start."""
    levels: tuple[float, ...] = (1.0, 2.5, 4.5, 8.0)
    """Ratios of a rate's standard deviation to the nominal one, ascending, the first one 1."""
    noisy_rate: float = 0.012
    """Expected number of faults of one satellite's rate per second."""
    noisy_time: float = 2.0
    """Mean duration of such a fault, s."""
    coloured: float = 1.15
    """Standard deviation of the error of a pseudorange under an open sky, m."""
    correlation_time: float = 4.5
    """Correlation time of that error, s."""
    jump: float = 0.0
    """Expected number of pseudorange jumps of one satellite under an open sky per second."""
    jump_sigma: float = 30.0
    """Standard deviation of the error after such a jump, m."""
    hold: float = 1.25
    """Mean duration of an error between houses, s."""
    error_mean: tuple[float, ...] = (62.8, 31.9, 14.1, 4.6)
    """Mean of errors between houses, m, below each of ``CN0_LIMITS`` and above the last one: those of the lognormal
    and the half normal distributions of the environment."""
    error_sigma: tuple[float, ...] = (48.0, 25.0, 24.5, 6.7)
    """Standard deviation of these errors, m."""


TRAINING = FaultPrior()
VAGUE = FaultPrior(
    quiet=0.0,
    leg=3.0,
    acceleration=20.0,
    acceleration_between_houses=20.0,
    start=(1 / 3, 1 / 3, 1 / 3),
    levels=(1.0, 3.0, 10.0, 30.0),
    noisy_rate=0.05,
    coloured=2.0,
    correlation_time=10.0,
    jump=0.02,
    error_mean=(40.0, 40.0, 20.0, 10.0),
    error_sigma=(60.0, 60.0, 40.0, 20.0),
)


class Hypotheses(NamedTuple):
    """Hypotheses on motion, rates' noise levels and last accelerometer readings; n = 17 + S states, M = 3."""

    means: Array
    """Means, ``(n, M, N)``."""
    covariances: Array
    """Covariances, packed, ``(n (n + 1) / 2, M, N)``."""
    probabilities: Array
    """Probabilities of the hypotheses on the motion, ``(M, N)``."""
    levels: Array
    """Probabilities of the noise levels of every rate, ``(L, S, N)``."""
    accelerometers: Array
    """Last readings of the accelerometers, ``(3, N)``, m/s^2; infinite before the first."""


class Factors(NamedTuple):
    """Factors of the settings at one measurement, ``(N,)`` or a number each."""

    begun: Array = 1.0
    """Factor on the probability that a manoeuvre has begun at this step."""
    manoeuvre: Array = 1.0
    """Factor on the odds that a manoeuvre continues."""
    renewal: Array = 1.0
    """Factor on the odds that a range error has been drawn anew."""
    levels: Array = 1.0
    """Factors on the probabilities of the levels of every available rate, ``(L, N)``."""
    motion: Array = 1.0
    """Factor on the process noise of the 17 states."""
    pseudoranges: Array = 1.0
    """Factor on the variance of the pseudoranges' white noise."""
    rates: Array = 1.0
    """Factor on the variance of every rate level."""
    accelerometers: Array = 1.0
    """Factor on the variance of the accelerometers."""


UNCHANGED = Factors()


class Posterior(NamedTuple):
    """Posterior of the bank's four hypotheses after a measurement.

    They are those on the motion, and a manoeuvre that has begun.
    """

    after: "FaultState"
    predicted: Array
    """Probabilities of the hypotheses before the readings, ``(4, N)``."""
    log_likelihoods: Array
    """Log-likelihood of the readings under each hypothesis, ``(4, N)``."""
    squares: Array
    """Normalised innovation squared of each group of sensors, conditional on the previous groups, ``(4, 4, N)``."""
    residual: Array
    """Innovation of every reading at the predicted mean of each hypothesis, ``(m, 4, N)``."""
    between: Array
    """Whether the C/N0 indicates reception between houses, ``(N,)``."""
    repeated: Array
    """Whether the accelerometers repeat their last readings exactly, ``(N,)``."""


class FaultState(NamedTuple):
    """State of the bank over motion and sensor faults."""

    mean: Array
    """Mean of all hypotheses together, ``(17, N)``."""
    covariance: Array
    """Covariance of all hypotheses together, ``(17, 17, N)``."""
    hypotheses: Hypotheses
    likelihood: Likelihood


class FaultHypotheses(SteerableFilter[NavigationProblem, Measurement, FaultState]):
    """Estimator ``fault-hypotheses``: Kalman filters over motion, pseudorange errors and rates' noise levels.

    Args:
        **changed: fields of the prior.
    """

    def __init__(self, task: NavigationProblem, prior: FaultPrior = TRAINING, **changed: Any) -> None:
        super().__init__(task)
        self.settings: Mapping[str, float] = {
            "begun": 4.0, "manoeuvre": 1.05, "renewal": 4.0, "levels": 1.5,
            "motion": 2.0, "pseudoranges": 2.0, "rates": 2.0, "accelerometers": 4.0,
        }  # fmt: skip
        prior = prior._replace(**changed)
        self.prior = prior
        T, S, n = task.common.T, task.satellites, gnss_ins.SIZE + task.satellites
        self.size = n
        noises, known = [gnss_ins.process_noise(m, task.common) for m in task.models], gnss_ins.SIZE
        noise = zeros_for((n, n, 3, 1), *noises)
        for i, own in enumerate(noises):
            noise[:known, :known, i, 0] = own
        self.noise: Array = task.constant(noise)
        open_sky = math.exp(-T / prior.correlation_time)
        # Arrays: of two plain numbers torch would choose in single precision.
        self.open_sky: Array = task.constant(open_sky)
        self.gained: Array = task.constant(prior.coloured**2 * (1.0 - open_sky**2))
        self.ending: Array = task.constant(1.0 - math.exp(-T / prior.leg))
        self.lost: Array = task.constant(1.0 - math.exp(-T / prior.hold))
        self.jump: Array = task.constant(1.0 - math.exp(-T * prior.jump))
        self.acceleration: Array = task.constant(prior.acceleration)
        self.last_error = task.constant(prior.error_mean[-1]), task.constant(prior.error_sigma[-1])
        squares = numpy.array(prior.levels) ** 2
        self.level_variance: list[Array] = [
            task.constant(squares * task.sensor_variance[S + j])[:, None, None] for j in range(S)
        ]
        L = len(squares)
        onset = 1.0 - math.exp(-T * prior.noisy_rate)
        over = 1.0 - math.exp(-T / prior.noisy_time)
        chain = numpy.diag([1.0 - onset] + [1.0 - over] * (L - 1))
        chain[0, 1:], chain[1:, 0] = onset / (L - 1), over
        self.level_chain = chain.tolist()
        self.first_levels = task.constant(numpy.array([1.0 - 1e-3] + [1e-3 / (L - 1)] * (L - 1)))[:, None]

        heights = [math.log(level) / math.log(prior.levels[-1]) for level in prior.levels]
        self.heights: Array = task.constant(heights)[:, None]

    def start(self, initial: Initial) -> FaultState:
        """Return every filter at the initial estimate, with the prior probabilities."""
        xp, S, task = self.xp, self.task.satellites, self.task
        none = 0.0 * initial.mean[0]
        mean, covariance = range_errors.start(
            initial.mean, initial.covariance, S, none + self.prior.coloured**2
        )
        levels = self.first_levels[:, None] + xp.stack([none] * S)
        hypotheses = Hypotheses(
            xp.stack([mean] * 3, axis=1),
            xp.stack([pack(covariance)] * 3, axis=1),
            task.constant(self.prior.start)[:, None] + none,
            levels,
            xp.stack([none + math.inf] * 3),
        )
        return FaultState(initial.mean, initial.covariance, hypotheses, Likelihood.unknown(none))

    def update(self, state: FaultState, inputs: FilterInput) -> FaultState:
        """Return the state predicted and updated with a measurement: hypotheses, levels, renewals, moments."""
        if inputs.action is None:
            return self.examine(state, inputs.measurement).after
        factors = Factors(*self.xp.exp(inputs.action))
        levels = self.xp.exp(self.heights * inputs.action[Factors._fields.index("levels")])
        return self.examine(state, inputs.measurement, factors._replace(levels=levels)).after

    def _predict(
        self, memory: Hypotheses, measurement: Measurement, between: Array, factors: Factors
    ) -> tuple[Array, Array, Array]:
        xp, task, prior, common = self.xp, self.task, self.prior, self.task.common
        number = xp.astype(measurement.number, memory.means.dtype)
        # Half a step further, or rounding would choose the measurement at which the time is over.
        ending = xp.where((number + 0.5) * common.T < prior.quiet, 0.0, self.ending)
        rest, line, singer = (memory.probabilities[i] for i in range(3))
        to_line, begins = 0.5 * ending * singer, ending * (rest + line) + 0.5 * ending * singer
        P = unpack(memory.covariances, self.size)
        x = memory.means
        lines, entering = (1.0 - ending) * line, to_line
        total = xp.clip(lines + entering, LEAST_PROBABILITY, None)
        entering = entering / total
        weights = xp.stack([1.0 - entering, entering])
        mean, covariance = imm.combine(x[:, LINE:], P[:, :, LINE:], weights)
        x = xp.stack([x[:, REST], mean, x[:, SINGER]], axis=1)
        P = xp.stack([P[:, :, REST], covariance, P[:, :, SINGER]], axis=2)
        kept, gained = self._error_process(between)
        mean, covariance = range_errors.predict(
            x, P, task.axis, common.T, common.decay, factors.motion * self.noise, kept, gained
        )
        # A manoeuvre that begins: the step is one of the motion before it, the acceleration is new.
        weights = xp.stack([ending * rest, ending * line, 0.5 * ending * singer])
        total_new = ordered_sum(weights)
        here = total_new > 0.0
        weights = xp.where(here, weights / xp.where(here, total_new, 1.0), 1.0 / 3.0)
        new, new_covariance = imm.combine(mean, covariance, weights)
        strength = xp.where(between, prior.acceleration_between_houses, self.acceleration)
        a = gnss_ins.ACCELERATION
        zero = 0.0 * new[a]
        new = xp.concat([new[: a.start], zero, new[a.stop :]])
        none = 0.0 * new_covariance[a]
        C = xp.concat([new_covariance[: a.start], none, new_covariance[a.stop :]])
        none = 0.0 * C[:, a]
        C = xp.concat([C[:, : a.start], none, C[:, a.stop :]], axis=1)
        own = numpy.zeros((self.size, self.size))
        own[a, a] = numpy.eye(3)
        C = C + task.constant(own)[:, :, None] * (strength * strength)
        singer = factors.manoeuvre * ((1.0 - ending) * singer)
        probabilities = xp.stack([(1.0 - ending) * rest, total, singer, factors.begun * begins])
        mean = xp.concat([mean, new[:, None]], axis=1)
        return mean, xp.concat([covariance, C[:, :, None]], axis=2), probabilities

    def _error_process(self, between: Array) -> tuple[Any, Any]:
        """Return the decay of a range error in a step and its variance gain, m^2, for all satellites or a list."""
        xp = self.xp
        return xp.where(between, 1.0, self.open_sky), xp.where(between, 0.0, self.gained)

    def _renewals(self, measurement: Measurement, between: Array, odds: Array) -> list[range_errors.Renewal]:
        """Return the distribution of each satellite's range error in case it is drawn anew."""
        xp, prior = self.xp, self.prior
        first = measurement.number <= 1
        renewals = []
        for j in range(self.task.satellites):
            cn0 = measurement.cn0[j]
            mean, sigma = self.last_error
            for limit, m, s in zip(
                reversed(CN0_LIMITS), prior.error_mean[-2::-1], prior.error_sigma[-2::-1], strict=True
            ):
                mean, sigma = xp.where(cn0 < limit, m, mean), xp.where(cn0 < limit, s, sigma)
            probability = xp.where(between, xp.where(first, 1.0, self.lost), self.jump)
            renewals.append(
                range_errors.Renewal(
                    odds * probability / (1.0 + (odds - 1.0) * probability),
                    xp.where(between, mean, 0.0),
                    xp.where(between, sigma * sigma, prior.jump_sigma**2),
                )
            )
        return renewals

    def examine(self, state: FaultState, measurement: Measurement, factors: Factors = UNCHANGED) -> Posterior:
        """Return the posterior of hypotheses, levels and renewals given a measurement, with factors on the prior.

        Args:
            state: state after the previous measurement.
            measurement: readings of all sensors.
            factors: on the prior. Probabilities need not sum to one with them; then neither the log-likelihood
                nor the NIS is that of a density.
        """
        xp, task, S, memory = self.xp, self.task, self.task.satellites, state.hypotheses
        forces, angles = (sensor.readings for sensor in task.sensors[2:])
        available = measurement.available
        readings = xp.where(available > 0.0, measurement.readings, 0.0)
        fresh = xp.any(readings[forces] != memory.accelerometers, axis=0)
        usable = available[forces] * xp.astype(fresh, available.dtype)
        between = xp.any(measurement.cn0 != task.parameters.clear_cn0, axis=0)
        mean, covariance, probabilities = self._predict(memory, measurement, between, factors)
        expected, rows = range_errors.observe(
            mean,
            measurement.satellite_position[:, :, None],
            measurement.satellite_velocity[:, :, None],
            measurement.ins_angles[:, None],
            task.parameters.gravity,
        )
        residual = readings[:, None] - expected
        taken = range_errors.begin(mean, covariance)
        for j, renewal in enumerate(self._renewals(measurement, between, factors.renewal)):
            place = gnss_ins.SIZE + j
            taken = range_errors.take_pseudorange(
                taken,
                mean[place],
                place,
                residual[j],
                rows[j],
                factors.pseudoranges * task.sensor_variance[j],
                renewal,
                available[j],
            )
        of_ranges = taken.squared_distance
        shares, predicted_levels = [], []
        for j in range(S):
            i = S + j
            levels = self._move_levels(memory.levels[:, j])
            taken, share = range_errors.take_reading(
                taken,
                residual[i],
                rows[i],
                factors.rates * self.level_variance[j],
                (factors.levels * levels)[:, None],
                available[i],
            )
            shares.append(share)
            predicted_levels.append(levels)
        others = slice(forces.start, angles.stop)
        left = [
            residual[i] - ordered_sum([taken.shift[c] * v for c, v in zip(*rows[i], strict=True)])
            for i in range(others.start, others.stop)
        ]
        rest_available = xp.concat([usable, available[angles]])
        variance = [
            *(factors.accelerometers * r for r in task.sensor_variance[forces]),
            *task.sensor_variance[angles],
        ]
        update = extended_kalman.update_one_by_one(
            mean + taken.shift,
            taken.covariance,
            xp.stack(left),
            rows[others],
            variance,
            rest_available,
        )
        log_likelihood = taken.log_likelihood + update.log_likelihood
        log_prior = imm.log_probabilities(probabilities)
        weights = imm.mode_posterior(log_prior, log_likelihood)
        nis = weighted_sum(weights, taken.squared_distance + ordered_sum(update.squared_residuals))
        learned = [
            xp.where(available[S + j] > 0.0, weighted_sum(weights, shares[j]), predicted_levels[j])
            for j in range(S)
        ]
        means, covariances, weights = self._merge(update.mean, update.covariance, weights)
        known = gnss_ins.SIZE
        centre, spread = imm.combine(means[:known], covariances[:known, :known], weights)
        after = Hypotheses(means, pack(covariances), weights, xp.stack(learned, axis=1), readings[forces])
        likelihood = Likelihood(
            imm.log_mixture_density(log_prior, log_likelihood),
            nis,
            ordered_sum(available[: forces.start]) + ordered_sum(rest_available),
        )
        of_forces, of_angles = update.squared_residuals[:3], update.squared_residuals[3:]
        return Posterior(
            FaultState(centre, spread, after, likelihood),
            probabilities,
            log_likelihood,
            xp.stack(
                [
                    of_ranges,
                    taken.squared_distance - of_ranges,
                    ordered_sum(of_forces),
                    ordered_sum(of_angles),
                ]
            ),
            residual,
            between,
            ~fresh,
        )

    def _move_levels(self, levels: Array) -> Array:
        L = levels.shape[0]
        return self.xp.stack(
            [
                ordered_sum([self.level_chain[i][j] * levels[i] for i in range(L) if self.level_chain[i][j]])
                for j in range(L)
            ]
        )

    def _merge(self, means: Array, covariances: Array, weights: Array) -> tuple[Array, Array, Array]:
        """Return the hypotheses with a begun manoeuvre merged into the continued one, by moments."""
        xp = self.xp
        pair: Sequence[Array] = (weights[SINGER], weights[3])
        total = pair[0] + pair[1]
        there = total > 0.0
        share = xp.where(there, pair[0] / xp.where(there, total, 1.0), 0.5)
        mean, covariance = imm.combine(
            means[:, SINGER:], covariances[:, :, SINGER:], xp.stack([share, 1.0 - share])
        )
        return (
            xp.concat([means[:, :SINGER], mean[:, None]], axis=1),
            xp.concat([covariances[:, :, :SINGER], covariance[:, :, None]], axis=2),
            xp.stack([weights[REST], weights[LINE], total]),
        )
