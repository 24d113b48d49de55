r"""A bank of Kalman filters over the faults of LooselyCoupledNavigation: INS level, receiver's noise, spoofing.

Every hypothesis is a pair: how good the INS is (J points of its drift, coloured and white noise), and since when the
receiver is pulled off (not at all, or since one of B onsets). Its filter estimates the INS error and the rate of the
pull (``filters/receiver_faults.py``). The noise level of the receiver is a Markov chain of L levels, which all
hypotheses share; it enters each filter as a Gaussian sum.

Before each measurement, every ``spacing`` measurements, the hypothesis without a pull gives birth to one that is
pulled from here on, in the place of the oldest. A pull ends with the hazard of a duration that is uniform between
``shortest`` and ``longest``; what ends is merged with the hypothesis that knows of no pull, by its moments. So the
number of filters is always J (B + 1).

Reading: one pull and one chain of levels serve all axes, but the rate of the pull is estimated on each axis alone.
"""

import math
from typing import Any, NamedTuple

import numpy

from ...envs.filter import Initial
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...envs.loosely_coupled_navigation.world import Measurement
from ...envs.observation import Array
from ...evaluation.competitors import Likelihood
from ...filters import receiver_faults as faults
from ...filters.imm import log_probabilities
from ...filters.loosely_coupled import AugmentedCovariance
from ...filters.ordered_sums import ordered_sum

LEVELS = tuple(10 ** (i / 2) for i in range(-2, 7))
"""Variances of the receiver over the reported one that are told apart."""


class FaultPrior(NamedTuple):
    """What a bank expects before it has seen anything; times in s."""

    points: int = 8
    """INS levels beside the modelled one."""
    modelled: float = 0.2
    """Probability that the INS is as modelled."""
    drift: tuple[float, float] = (0.05, 10**0.5)
    """Limits of the drift's standard deviation over the modelled one."""
    intensity: tuple[float, float] = (0.005, 10**0.5)
    """Limits of the intensities of coloured and white noise over the modelled ones."""
    onset: tuple[float, float] = (0.5, 3.5)
    """When a pull may begin."""
    onset_rate: float = 0.07
    """Pulls expected in a second of that time."""
    onsets: int = 8
    """B, hypotheses of a pull that are kept."""
    shortest: float = 0.5
    longest: float = 2.0
    rate: float = 3**0.5
    """Standard deviation of the rate of a pull, m/s."""
    levels: tuple[float, ...] = LEVELS
    """Variances of the receiver over the reported one, ascending, one of them 1."""
    level_rate: float = 0.3
    """Changes of the level expected in a second."""
    distrust: float = 0.05
    """Probability that a report is wrong from the start."""
    outlier: float = 0.0
    """Probability of an outlier."""
    outlier_factor: float = 100.0
    """Its variance over that of the others."""


TRAINING = FaultPrior()
VAGUE = FaultPrior(
    drift=(0.02, 5.0),
    intensity=(0.002, 10.0),
    onset=(0.0, math.inf),
    onset_rate=0.05,
    shortest=0.0,
    longest=3.0,
    rate=3.0,
    level_rate=0.3,
    outlier=0.01,
)


def halton(points: int) -> numpy.ndarray:
    """The first points of Halton's sequence in three dimensions, ``(points, 3)``, each in the unit cube."""
    from scipy.stats import qmc

    return numpy.asarray(qmc.Halton(3, scramble=False).random(points + 1)[1:])


class Hypotheses(NamedTuple):
    """Memory of the bank; M = B + 1 hypotheses of the pull, the first without any."""

    delta: Array
    """Estimate of the INS error, m, ``(A, J, M, N)``."""
    drift: Array
    coloured: Array
    rate: Array
    """Of the pull, m/s, likewise."""
    covariance: faults.FaultCovariance
    """``(J, M, N)`` each."""
    weights: Array
    """Probabilities, ``(J, M, N)``."""
    levels: Array
    """Probabilities of the receiver's levels, ``(L, N)``."""
    reported: Array
    """Variance last reported, m^2, ``(N,)``."""


class FaultBank:
    """Bank.

    Args:
        task: the problem.
        prior: what it expects.
    """

    kind = "estimator"
    traceable = True

    def __init__(self, task: LooselyCoupledNavigation, prior: FaultPrior = TRAINING, **changed: Any) -> None:
        self.prior = prior = prior._replace(**changed)
        p = self.parameters = task.parameters
        self.xp, self.step = task.xp, p.sampling_interval
        self.eye = task.constant(numpy.eye(p.axes))[:, :, None]
        self.spacing = max(round(prior.longest / (prior.onsets * self.step)), 1)
        unit = halton(prior.points)
        factors = numpy.ones((prior.points + 1, 3))
        for i, (low, high) in enumerate((prior.drift, prior.intensity, prior.intensity)):
            factors[1:, i] = low * (high / low) ** unit[:, i]
        column = (slice(None), None, None)
        self.drift = task.constant(p.drift * factors[:, 0])[column]
        coloured = p.coloured * numpy.sqrt(factors[:, 1])
        self.coloured = task.constant(coloured)[column]
        self.coloured_growth = task.constant((coloured * p.sampling.coloured) ** 2)[column]
        white = p.white_intensity * factors[:, 2] * self.step + p.sampling.residual * coloured**2
        self.white_growth = task.constant(white)[column]
        self.ins_weights = task.constant(
            numpy.array([prior.modelled] + [(1.0 - prior.modelled) / prior.points] * prior.points)
        )[column]
        self.factors = task.constant(numpy.array([*prior.levels]))[:, None]
        uniform = numpy.full(len(prior.levels), 1.0 / len(prior.levels))
        exact = numpy.isclose(prior.levels, 1.0).astype(float)
        self.uniform = task.constant(uniform)[:, None]
        self.fresh = task.constant((1.0 - prior.distrust) * exact + prior.distrust * uniform)[:, None]
        self.onsets = task.constant(numpy.arange(prior.onsets) * float(self.spacing))[:, None]

    def start(self, initial: Initial, N: int) -> Hypotheses:
        """Start where INS and reference agree, without a pull."""
        xp, M = self.xp, self.prior.onsets + 1
        none = 0.0 * initial.mean[0]
        many = none + 0.0 * self.drift + xp.zeros((1, M, 1))
        ins = AugmentedCovariance(many, many, many, many + self.drift**2, many, many + self.coloured**2)
        P = faults.FaultCovariance(ins, many, many, many, many)
        still = 0.0 * initial.mean[:, None, None] + many[None]
        unpulled = xp.concat([xp.ones((1, 1, 1)), xp.zeros((1, M - 1, 1))], axis=1)
        weights = self.ins_weights * unpulled + many
        return Hypotheses(still, still, still, still, P, weights, self.fresh + none, none)

    def change(self, h: Hypotheses, number: Array) -> tuple[Hypotheses, Array]:
        """End pulls and let others begin; hypotheses, and the age of each pull, s, ``(M, N)``, zero of the first."""
        xp, prior, T = self.xp, self.prior, self.step
        cycle = float(self.spacing * prior.onsets)
        since = number - self.onsets
        since = since - cycle * xp.floor(since / cycle)
        age = T * (since + 0.5 * (self.spacing + 1))
        born = (since == 0.0) & (number >= self.onsets)
        left = xp.clip(prior.longest - age, T, None)
        hazard = xp.where(age > prior.shortest, T / left, 0.0)
        hazard = xp.where(since == 0.0, 1.0, xp.clip(hazard, None, 1.0))
        ending = h.weights[:, 1:] * hazard
        begins = (number * T >= prior.onset[0]) & (number * T <= prior.onset[1])
        share = prior.onset_rate * self.spacing * T
        given = xp.where(born & begins, share / (1.0 + share), 0.0)
        # At most one of the onsets is born at a measurement.
        free = h.weights[:, 0]
        starting = free[:, None] * given
        stay = free * (1.0 - ordered_sum(given))
        merged = self._merge(h, stay, ending)
        total = stay + ordered_sum(xp.moveaxis(ending, 1, 0))

        def replace(values: Array, first: Array, others: Array) -> Array:
            return xp.concat([first[..., None, :], others], axis=-2)

        def copy(values: Array, new: Array) -> Array:
            """Values of pulls, in the place of the born ones that of no pull."""
            return xp.where(born, new[..., None, :], values[..., 1:, :])

        (delta, drift, coloured), ins = merged
        zero = 0.0 * total
        P, old = h.covariance, h.covariance.ins
        moved = AugmentedCovariance(
            *(replace(v, m, copy(v, v[..., 0, :])) for v, m in zip(old, ins, strict=True))
        )

        def couple(values: Array) -> Array:
            """Covariances with the rate of the pull: none of those born."""
            return replace(values, zero, xp.where(born, 0.0, values[:, 1:]))

        covariance = faults.FaultCovariance(
            moved,
            couple(P.position_fault),
            couple(P.drift_fault),
            couple(P.coloured_fault),
            replace(P.fault, zero, xp.where(born, prior.rate**2, P.fault[:, 1:])),
        )
        means = (
            replace(v, m, copy(v, v[..., 0, :]))
            for v, m in ((h.delta, delta), (h.drift, drift), (h.coloured, coloured))
        )
        rate = replace(h.rate, 0.0 * delta, xp.where(born, 0.0, h.rate[..., 1:, :]))
        weights = replace(h.weights, total, h.weights[:, 1:] * (1.0 - hazard) + starting)
        return (
            h._replace(
                **dict(zip(("delta", "drift", "coloured"), means, strict=True)),
                rate=rate,
                covariance=covariance,
                weights=weights,
            ),
            xp.concat([0.0 * age[:1], age]),
        )

    def _merge(self, h: Hypotheses, stay: Array, ending: Array) -> tuple[Any, AugmentedCovariance]:
        """Moments of what knows of no pull and of what ends: means ``(A, J, N)``, covariance ``(J, N)`` each."""
        xp = self.xp
        parts = [stay, *(ending[:, b] for b in range(ending.shape[1]))]
        total = ordered_sum(parts)
        certain = total > 0.0
        w = [xp.where(certain, part / xp.where(certain, total, 1.0), 0.0) for part in parts]
        means = [ordered_sum(w[m] * v[:, :, m] for m in range(len(w))) for v in h[:3]]
        offsets = [[v[:, :, m] - mean for v, mean in zip(h[:3], means, strict=True)] for m in range(len(w))]
        A = h.delta.shape[0]

        def entry(values: Array, i: int, j: int) -> Array:
            return ordered_sum(
                w[m] * (values[:, m] + ordered_sum(offsets[m][i] * offsets[m][j]) / A) for m in range(len(w))
            )

        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        P = (entry(v, i, j) for v, (i, j) in zip(h.covariance.ins, pairs, strict=True))
        return means, AugmentedCovariance(*P)

    def update(
        self, measurement: Measurement, memory: Hypotheses
    ) -> tuple[Array, Array, Hypotheses, Likelihood]:
        """Change hypotheses, predict, update, and report the moments of all."""
        xp, prior, s, axes = self.xp, self.prior, self.parameters.sampling, self.parameters.axes
        h, age = self.change(memory, measurement.number)
        delta = h.delta + s.step * h.drift + s.drive * h.coloured
        coloured = s.decay * h.coloured
        P = faults.predict_fault(h.covariance, s, self.coloured_growth, self.white_growth)

        reported = measurement.reported_deviation * measurement.reported_deviation
        changing = 1.0 - math.exp(-prior.level_rate * self.step)
        chain = (1.0 - changing) * h.levels + changing * self.uniform
        chain = xp.where(reported != h.reported, self.fresh, chain)
        R = self.factors * reported
        there = measurement.available > 0.0
        fix = xp.where(there, measurement.ins - measurement.fix, 0.0)
        innovation = xp.where(there, fix[:, None, None] - (delta - age * h.rate), 0.0)
        along = faults.measured_direction(P, age)
        levels, q = R, chain
        if prior.outlier:
            wide = prior.outlier_factor / ordered_sum(chain / R)
            levels = xp.concat([R, wide[None]])
            q = xp.concat([(1.0 - prior.outlier) * chain, prior.outlier + 0.0 * chain[:1]])
        squares = ordered_sum(innovation * innovation)
        noise = faults.weigh_levels(squares, axes, along.variance, levels[:, None, None], q[:, None, None])

        log_weights = log_probabilities(h.weights) + xp.where(there, noise.log_density, 0.0)
        flat = xp.reshape(log_weights, (-1, log_weights.shape[-1]))
        top = xp.max(flat, axis=0)
        weights = xp.exp(log_weights - top)
        W = xp.reshape(weights, flat.shape)
        total = ordered_sum(W)
        log_likelihood = top + xp.log(total)
        W, weights = W / total, weights / total

        L = levels.shape[0]
        shares = xp.reshape(noise.responsibilities, (L, *flat.shape))
        posterior = ordered_sum(W[i] * shares[:, i] for i in range(flat.shape[0]))
        if prior.outlier:
            posterior = posterior[:-1] + posterior[-1] * chain
        posterior = xp.where(there, posterior, chain)

        gain = xp.where(there, noise.score, 0.0)
        weight = xp.where(there, noise.score - noise.spread * squares / axes, 0.0)
        push = gain * innovation
        delta = delta + along.position * push
        P = faults.update_fault(P, along, weight)
        memory = Hypotheses(
            delta,
            h.drift + along.drift * push,
            coloured + along.coloured * push,
            h.rate + along.fault * push,
            P,
            weights,
            posterior,
            reported,
        )
        each = xp.reshape(delta, (axes, *flat.shape))
        mean = ordered_sum(W[i] * each[:, i] for i in range(flat.shape[0]))
        own = ordered_sum(W * xp.reshape(P.ins.position, flat.shape))
        offsets = each - mean[:, None]
        spread = ordered_sum(W[i] * offsets[:, None, i] * offsets[None, :, i] for i in range(flat.shape[0]))
        S = ordered_sum(W * xp.reshape(along.variance, flat.shape)) + 1.0 / ordered_sum(chain / R)
        seen = xp.where(there, ordered_sum(innovation[:, 0, 0] ** 2) / S, math.nan)
        likelihood = Likelihood(xp.where(there, log_likelihood, math.nan), seen, axes * measurement.available)
        return measurement.ins - mean, self.eye * own + spread, memory, likelihood


def task_first(xp: Any, M: int) -> Array:
    """One for the first hypothesis."""
    return xp.concat([xp.ones((1, 1, 1)), xp.zeros((1, M - 1, 1))], axis=1)
