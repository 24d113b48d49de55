r"""A bank of Kalman filters over what nobody says of LooselyCoupledNavigation: noise levels, coloured error, spoofing.

Every hypothesis is a pair: what the noises are (J points of the INS's drift, coloured and white noise and of the
receiver's coloured error; the first is what the task models), and since when the receiver is pulled off (not at all, or
since one of B onsets). Its filter estimates the INS error, the receiver's coloured error and the rate of the pull
(``filters/receiver_faults.py``). The level of the receiver's white noise is a Markov chain of L levels, which all
hypotheses share; it enters each filter as a Gaussian sum.

Before each measurement, every ``spacing`` measurements, each hypothesis without a pull gives birth to one that is
pulled from here on, in the place of the oldest. A pull ends with the hazard of a duration that is uniform between
``shortest`` and ``longest``; what ends is merged with the hypothesis of the same noises that knows of no pull, by its
moments. What is as modelled is never pulled off: nothing befalls an undisturbed episode, and a drift of the INS looks
like a slow pull. So there are J + (J - 1) B filters.

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
from ...filters import imm
from ...filters import receiver_faults as faults
from ...filters.loosely_coupled import AugmentedCovariance
from ...filters.ordered_sums import ordered_sum, weighted_sum

LEVELS = tuple(100 ** (i / 3) for i in range(-2, 5))
"""Variances of the receiver over the reported one that are told apart."""


class FaultPrior(NamedTuple):
    """What a bank expects before it has seen anything; times in s."""

    points: int = 6
    """Points of noises beside the modelled one."""
    modelled: float = 0.5
    """Probability that all noises are as modelled and nothing is pulled off. Ours, as likely as not: in the training
    distribution one of six, of which a bank is a percent better there, and pays for it where nothing is wrong."""
    drift: tuple[float, float] = (0.05, 10**0.5)
    """Limits of the drift's standard deviation over the modelled one."""
    intensity: tuple[float, float] = (0.005, 10**0.5)
    """Limits of the intensities of coloured and white noise over the modelled ones."""
    wandering: tuple[float, float] = (0.0, 0.5)
    """Limits of the standard deviation of the receiver's coloured error, m."""
    lasting: tuple[float, float] = (0.5, 5.0)
    """Limits of the correlation time of that error."""
    onset: tuple[float, float] = (0.5, 3.5)
    """When a pull may begin."""
    onset_rate: float = 0.07
    """Pulls expected in a second of that time."""
    onsets: int = 6
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
    wandering=(0.0, 1.5),
    lasting=(0.5, 20.0),
    onset=(0.0, math.inf),
    onset_rate=0.05,
    shortest=0.0,
    longest=3.0,
    rate=3.0,
    outlier=0.01,
)


def spread_points(points: int, dimensions: int) -> numpy.ndarray:
    """Points that fill the unit cube evenly, ``(points, dimensions)``: the Kronecker sequence of the powers of the
    root of ``x^(d + 1) = x + 1`` (Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
    """
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -numpy.arange(1.0, dimensions + 1)
    return (0.5 + numpy.arange(points)[:, None] * steps) % 1.0


class Hypotheses(NamedTuple):
    """Hypotheses of J noises and M onsets, with S = 4 states (delta, beta, eta, e) or 5 (and the rate of a pull)."""

    mean: Array
    """``(S, A, J, M, N)``."""
    covariance: faults.FaultCovariance
    """``(..., J, M, N)``."""
    weights: Array
    """Probabilities, ``(J, M, N)``."""


class Memory(NamedTuple):
    """Memory of the bank."""

    free: Hypotheses
    """Those without a pull, M = 1."""
    pulled: Hypotheses
    """Those of all noises but the modelled ones, M = B."""
    levels: Array
    """Probabilities of the receiver's levels, ``(L, N)``."""
    reported: Array
    """Variance last reported, m^2, ``(N,)``."""


class Noises(NamedTuple):
    """Noises of the hypotheses, ``(J, 1, 1)`` each."""

    drift: Array
    """Standard deviation, m/s."""
    coloured: Array
    """Stationary standard deviation of the coloured rate error, m/s."""
    coloured_growth: Array
    """Variance that it gains in a step, m^2/s^2."""
    white_growth: Array
    """Variance of the displacement in a step that this gain does not explain, m^2."""
    wandering: Array
    """Stationary standard deviation of the receiver's coloured error, m."""
    decay: Array
    """What is left of that error after a step."""


class FaultBank:
    """Bank.

    Args:
        task: the problem.
        prior: what it expects.
        **changed: fields of the prior.
    """

    kind = "estimator"
    traceable = True

    def __init__(self, task: LooselyCoupledNavigation, prior: FaultPrior = TRAINING, **changed: Any) -> None:
        self.prior = prior = prior._replace(**changed)
        p = self.parameters = task.parameters
        self.xp, self.step = task.xp, p.sampling_interval
        self.eye = task.constant(numpy.eye(p.axes))[:, :, None]
        self.spacing = max(round(prior.longest / (prior.onsets * self.step)), 1)
        self.noises = Noises(*(task.constant(each)[:, None, None] for each in self.draw_noises()))
        self.noise_weights = task.constant(
            numpy.array([prior.modelled] + [(1.0 - prior.modelled) / prior.points] * prior.points)
        )[:, None, None]
        self.factors = task.constant(numpy.array([*prior.levels]))[:, None]
        uniform = numpy.full(len(prior.levels), 1.0 / len(prior.levels))
        exact = numpy.isclose(prior.levels, 1.0).astype(float)
        self.uniform = task.constant(uniform)[:, None]
        self.fresh = task.constant((1.0 - prior.distrust) * exact + prior.distrust * uniform)[:, None]
        self.onsets = task.constant(numpy.arange(prior.onsets) * float(self.spacing))[:, None]

    def draw_noises(self) -> Noises:
        """Points of noises, the modelled one first, ``(J,)`` each."""
        prior, p = self.prior, self.parameters
        unit = spread_points(prior.points, 5).T

        def between(limits: tuple[float, float], where: numpy.ndarray) -> numpy.ndarray:
            return limits[0] * (limits[1] / limits[0]) ** where

        def after(first: float, others: numpy.ndarray) -> numpy.ndarray:
            return numpy.concatenate([[first], others])

        low, high = prior.wandering
        coloured = p.coloured * numpy.sqrt(after(1.0, between(prior.intensity, unit[1])))
        white = p.white_intensity * after(1.0, between(prior.intensity, unit[2]))
        return Noises(
            p.drift * after(1.0, between(prior.drift, unit[0])),
            coloured,
            (coloured * p.sampling.coloured) ** 2,
            white * self.step + p.sampling.residual * coloured**2,
            after(0.0, low + (high - low) * unit[3]),
            numpy.exp(-self.step / after(prior.lasting[0], between(prior.lasting, unit[4]))),
        )

    def start(self, initial: Initial, N: int) -> Memory:
        """Start where INS and reference agree, without a pull."""
        xp, noises = self.xp, self.noises
        none = 0.0 * initial.mean[0]
        zero = none + 0.0 * noises.drift
        ins = AugmentedCovariance(zero, zero, zero, zero + noises.drift**2, zero, zero + noises.coloured**2)
        P = faults.FaultCovariance(ins, xp.stack([zero[None]] * 3), (zero + noises.wandering**2)[None, None])
        still = xp.stack([0.0 * initial.mean[:, None, None] + zero[None]] * 4)
        free = Hypotheses(still, P, zero + self.noise_weights)
        born = self.give_birth(free)
        others = [
            xp.stack([values[..., 0, :]] * self.prior.onsets, axis=-2) for values in (born.mean, *_flat(born))
        ]
        pulled = Hypotheses(others[0], _covariance(others[1:]), 0.0 * others[0][0, 0])
        return Memory(free, pulled, self.fresh + none, none)

    def give_birth(self, free: Hypotheses) -> Hypotheses:
        """Hypotheses of all noises but the modelled ones that are pulled from here on, ``(J - 1, 1)``."""
        xp = self.xp
        none = 0.0 * free.weights[1:]
        P = faults.FaultCovariance(
            AugmentedCovariance(*(values[1:] for values in free.covariance.ins)),
            free.covariance.cross[:, :, 1:],
            free.covariance.faults[:, :, 1:],
        )
        return Hypotheses(
            xp.concat([free.mean[:, :, 1:], 0.0 * free.mean[:1, :, 1:]]),
            faults.add_fault(P, self.prior.rate**2 + none),
            free.weights[1:],
        )

    def change(
        self, free: Hypotheses, pulled: Hypotheses, number: Array
    ) -> tuple[Hypotheses, Hypotheses, Array]:
        """End pulls and let others begin; hypotheses, and the age of each pull, s, ``(B, N)``."""
        xp, prior, T = self.xp, self.prior, self.step
        cycle = float(self.spacing * prior.onsets)
        since = number - self.onsets
        since = since - cycle * xp.floor(since / cycle)
        age = T * (since + 0.5 * (self.spacing + 1))
        born = (since == 0.0) & (number >= self.onsets)
        left = xp.clip(prior.longest - age, T, None)
        hazard = xp.where(age > prior.shortest, T / left, 0.0)
        hazard = xp.where(since == 0.0, 1.0, xp.clip(hazard, None, 1.0))
        begins = (number * T >= prior.onset[0]) & (number * T <= prior.onset[1])
        share = prior.onset_rate * self.spacing * T
        # At most one of the onsets is born at a measurement.
        given = xp.where(born & begins, share / (1.0 + share), 0.0)
        begun = self.give_birth(free)
        merged = self.merge(begun, pulled, 1.0 - ordered_sum(given), hazard)
        replaced = [xp.where(born, new, old) for new, old in zip(_flat(begun), _flat(pulled), strict=True)]
        free = Hypotheses(
            xp.concat([free.mean[:, :, :1], merged.mean], axis=2),
            _covariance(
                [
                    xp.concat([old[..., :1, :, :], new], axis=-3)
                    for old, new in zip(_flat(free), _flat(merged), strict=True)
                ]
            ),
            xp.concat([free.weights[:1], merged.weights]),
        )
        pulled = Hypotheses(
            xp.where(born, begun.mean, pulled.mean),
            _covariance(replaced),
            pulled.weights * (1.0 - hazard) + begun.weights * given,
        )
        return free, pulled, age

    def merge(self, begun: Hypotheses, pulled: Hypotheses, staying: Array, hazard: Array) -> Hypotheses:
        """What knows of no pull together with what ends, by their moments; S = 4, ``(J - 1, 1)``."""
        xp = self.xp
        weights = xp.concat([begun.weights * staying, pulled.weights * hazard], axis=1)
        mean = xp.concat([begun.mean, pulled.mean], axis=3)[:4]
        P = [xp.concat([a, b], axis=-2) for a, b in zip(_flat(begun), _flat(pulled), strict=True)]
        P = faults.matrix(_covariance(P))[:4, :4]
        total = ordered_sum(xp.moveaxis(weights, 1, 0))
        certain = total > 0.0
        shares = xp.moveaxis(weights, 1, 0) / xp.where(certain, total, 1.0)
        mean, P = xp.moveaxis(mean, 3, 2), xp.moveaxis(P, 3, 2)  # (4, A, M, J, N), (4, 4, M, J, N)
        centre = weighted_sum(shares, mean)
        offsets = mean - centre[:, :, None]
        spread = ordered_sum(offsets[:, None, a] * offsets[None, :, a] for a in range(mean.shape[1]))
        moments = weighted_sum(shares, P + spread / mean.shape[1])
        return Hypotheses(centre[:, :, :, None], faults.from_matrix(moments[:, :, :, None]), total[:, None])

    def update(self, measurement: Measurement, memory: Memory) -> tuple[Array, Array, Memory, Likelihood]:
        """Change hypotheses, predict, update, and report the moments of all."""
        xp, prior, axes = self.xp, self.prior, self.parameters.axes
        free, pulled, age = self.change(memory.free, memory.pulled, measurement.number)
        reported = measurement.reported_deviation * measurement.reported_deviation
        changing = 1.0 - math.exp(-prior.level_rate * self.step)
        chain = (1.0 - changing) * memory.levels + changing * self.uniform
        chain = xp.where(reported != memory.reported, self.fresh, chain)
        levels, q = self.factors * reported, chain
        white = 1.0 / ordered_sum(chain / levels)
        if prior.outlier:
            levels = xp.concat([levels, (prior.outlier_factor * white)[None]])
            q = xp.concat([(1.0 - prior.outlier) * chain, prior.outlier + 0.0 * chain[:1]])
        there = measurement.available > 0.0
        fix = xp.where(there, measurement.ins - measurement.fix, 0.0)
        others = Noises(*(each[1:] for each in self.noises))
        parts = [
            self.update_part(part, noises, h, fix, there, levels, q)
            for part, noises, h in (
                (free, self.noises, xp.ones((1, 1, 1))),
                (pulled, others, xp.stack([xp.ones_like(age), age])),
            )
        ]

        def join(values: Any, before: int) -> Array:
            """All hypotheses in a row behind some axes."""
            return xp.concat(
                [xp.reshape(each, (*each.shape[:before], -1, each.shape[-1])) for each in values], axis=before
            )

        log_weights = join([log_density for _, log_density, *_ in parts], 0)
        log_likelihood = imm.log_sum(log_weights)
        weights = xp.exp(log_weights - log_likelihood)
        posterior = weighted_sum(weights, join([shares for _, _, shares, *_ in parts], 1))
        if prior.outlier:
            posterior = posterior[:-1] + posterior[-1] * chain
        posterior = xp.where(there, posterior, chain)
        before = join([free.weights, pulled.weights], 0)
        innovation = weighted_sum(before, join([each for *_, each, _ in parts], 1))
        S = weighted_sum(before, join([variance for *_, variance in parts], 0)) + white
        split = free.weights.shape[0]
        (free, pulled) = (
            part._replace(weights=xp.reshape(each, part.weights.shape))
            for (part, *_), each in zip(parts, (weights[:split], weights[split:]), strict=True)
        )
        delta = join([free.mean[0], pulled.mean[0]], 1)
        mean = weighted_sum(weights, delta)
        own = weighted_sum(weights, join([each.covariance.ins.position for each in (free, pulled)], 0))
        offsets = delta - mean[:, None]
        spread = weighted_sum(weights, offsets[:, None] * offsets[None])
        nis = ordered_sum(innovation * innovation) / S
        likelihood = Likelihood(
            xp.where(there, log_likelihood, math.nan),
            xp.where(there, nis, math.nan),
            axes * measurement.available,
        )
        memory = Memory(free, pulled, posterior, reported)
        return measurement.ins - mean, self.eye * own + spread, memory, likelihood

    def update_part(
        self, h: Hypotheses, noises: Noises, shares: Array, fix: Array, there: Array, levels: Array, q: Array
    ) -> tuple[Hypotheses, Array, Array, Array, Array]:
        """Predict and update some hypotheses.

        Args:
            h: hypotheses.
            noises: of them.
            shares: of the receiver's errors in the measurement, ``(S - 3, M, N)``.
            fix: INS less receiver, m, ``(A, N)``.
            there: whether there is a fix, ``(N,)``.
            levels: variances of the receiver, ascending, m^2, ``(L, N)``.
            q: their probabilities, likewise.

        Returns:
            Hypotheses with their weights before, log-densities of weight and fix, ``(J, M, N)``, responsibilities of
            the levels, ``(L, J, M, N)``, innovations, m, ``(A, J, M, N)``, and their variance but for the noise, m^2.
        """
        xp, s = self.xp, self.parameters.sampling
        one, zero = 0.0 * noises.decay + 1.0, 0.0 * noises.decay
        pulls = shares.shape[0] - 1
        decay = xp.stack([noises.decay, *[one] * pulls])
        gained = xp.stack([noises.wandering**2 * (1.0 - noises.decay**2), *[zero] * pulls])
        delta, drift, eta = h.mean[:3]
        errors = decay[:, None] * h.mean[3:]
        delta = delta + s.step * drift + s.drive * eta
        P = faults.predict_fault(h.covariance, s, noises.coloured_growth, noises.white_growth, decay, gained)
        pull = ordered_sum(shares[i] * errors[i] for i in range(pulls + 1))
        innovation = xp.where(there, fix[:, None, None] - (delta - pull), 0.0)
        along = faults.measured_direction(P, shares)
        squares = ordered_sum(innovation * innovation)
        noise = faults.weigh_levels(
            squares, fix.shape[0], along.variance, levels[:, None, None], q[:, None, None]
        )
        push = xp.where(there, noise.score, 0.0) * innovation
        weight = xp.where(there, noise.score - noise.spread * squares / fix.shape[0], 0.0)
        mean = xp.concat(
            [
                xp.stack(
                    [
                        delta + along.position * push,
                        drift + along.drift * push,
                        s.decay * eta + along.coloured * push,
                    ]
                ),
                errors + along.faults[:, None] * push,
            ]
        )
        log_weights = imm.log_probabilities(h.weights) + xp.where(there, noise.log_density, 0.0)
        updated = Hypotheses(mean, faults.update_fault(P, along, weight), h.weights)
        return updated, log_weights, noise.responsibilities, innovation, along.variance


def _flat(h: Hypotheses) -> list[Array]:
    """Arrays of a covariance in a row."""
    return [*h.covariance.ins, h.covariance.cross, h.covariance.faults]


def _covariance(arrays: list[Array]) -> faults.FaultCovariance:
    """Undo :func:`_flat`."""
    return faults.FaultCovariance(AugmentedCovariance(*arrays[:6]), arrays[6], arrays[7])
