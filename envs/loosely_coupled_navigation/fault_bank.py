r"""A bank of Kalman filters over the hidden faults of LooselyCoupledNavigation: noise levels, coloured error, spoofing.

Every hypothesis is a pair. Its first part is the noises: J points of the INS's drift, coloured and white noise and of
the receiver's coloured error, the first of them as the task models it. Its second part is the onset of spoofing, which
pulls the fix off: none, or one of B onsets. The hypothesis' filter estimates the INS error, the receiver's coloured
error and the rate of the pull (``filters/receiver_faults.py``). The level of the receiver's white noise is a Markov
chain of L levels, which all hypotheses share; it enters each filter as a Gaussian sum.

Every ``spacing`` measurements each hypothesis without a pull starts one with a pull from this measurement on, which
replaces the oldest. A pull ends with the hazard of a duration that is uniform between ``shortest`` and ``longest``; the
ended hypothesis is merged by its moments with the hypothesis of the same noises without a pull. The modelled noises
have no hypotheses of a pull: an undisturbed episode has no hidden disturbance, and a drift of the INS looks like a slow
pull. So there are J + (J - 1) B filters.

Reading: one pull and one chain of levels serve all axes, but the rate of the pull is estimated on each axis alone.

The control ``hypotheses`` steers this estimator, ``fault-bank``. H hypotheses predict to the fix with weights p' and
covariances P', and the levels of the receiver have probabilities q'. Factors f of its settings change the update with
this fix alone:

    p'(h) <- p'(h) f1^pulled(h) f2^modelled(h)                                              renormalised by Bayes' rule
    q'(l) <- q'(l) f3^s(l),    R <- R f4
    P'(h) <- P'(h) + (f5 - 1) Q(h) + (f6 - 1) W(h)

pulled: the hypothesis has a pull; modelled: all its noises are as modelled; s(l): logarithm of level l over the
reported variance, one for the highest. So f1 multiplies the odds of a pull as other hazards would, f2 is the prior of a
fault, f3 shifts the level of the receiver and f4 scales its present error. Q is the covariance that the coloured and
the white rate error of the INS add in a step, and W that of the receiver's coloured error: a prediction with ``f5 Q``
and ``f6 W``. Without a fix nothing changes.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...filters import imm
from ...filters import receiver_faults as faults
from ...filters.array_namespace import namespace
from ...filters.loosely_coupled import AugmentedCovariance, Sampling
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ..contract.controls import SteerableFilter
from ..contract.filter import FilterInput, Initial, Likelihood
from ..contract.observation import Array
from ..contract.task import Task
from .fault_prior import TRAINING, FaultPrior, Noises, draw_noises
from .world import Measurement

SAME_REPORT = 1e-9
"""Relative change of the reported variance below which the report counts as unchanged: more than rounding."""


class Hypotheses(NamedTuple):
    """Gaussian hypotheses of J noises and M spoofing onsets, with S = 4 states (delta, beta, eta, e) or 5."""

    mean: Array
    """Means, ``(S, A, J, M, N)``."""
    covariance: faults.FaultCovariance
    """Covariances, ``(..., J, M, N)``."""
    weights: Array
    """Probabilities, ``(J, M, N)``."""


class Memory(NamedTuple):
    """Hypotheses and receiver noise levels that the bank keeps between measurements."""

    free: Hypotheses
    """Hypotheses without a pull, M = 1."""
    pulled: Hypotheses
    """Hypotheses with a pull, of all noises but the modelled ones, M = B."""
    levels: Array
    """Probabilities of the receiver's levels, ``(L, N)``."""
    reported: Array
    """Last reported variance, m^2, ``(N,)``."""


class Weighing(NamedTuple):
    """Predicted hypotheses weighted by a measurement: weights, level probabilities, innovations; H in all."""

    log_likelihood: Array
    """Log-likelihood of the measurement, ``(N,)``."""
    weights: Array
    """Posterior probabilities of the hypotheses, ``(H, N)``."""
    levels: Array
    """Posterior probabilities of the receiver's levels, ``(L, N)``."""
    expected: Array
    """Predicted difference of INS and receiver positions, m, ``(A, N)``."""
    own: Array
    """Mean of the hypotheses' variances of that difference without the receiver's noise, m^2, ``(N,)``."""
    nis: Array
    """Normalised innovation squared of the whole bank, ``(N,)``."""
    innovations: tuple[Array, Array]
    """Innovations of the hypotheses without and with a pull, m, ``(A, J, M, N)`` each."""
    directions: tuple[faults.Direction, faults.Direction]
    """Directions of their updates."""
    noises: tuple[faults.NoiseMixture, faults.NoiseMixture]
    """Receiver noise that their innovations indicate."""


class FaultState(NamedTuple):
    """State of the fault bank: estimate, hypotheses and noise levels, likelihood."""

    mean: Array
    """Mean of the whole bank, m, ``(A, N)``."""
    covariance: Array
    """Covariance of the whole bank, m^2, ``(A, A, N)``."""
    memory: Memory
    likelihood: Likelihood


class FaultBank(SteerableFilter[Task, Measurement, FaultState]):
    """Estimator ``fault-bank``: Kalman filters over noises of INS and receiver and over the onset of spoofing.

    Args:
        **changed: fields of the prior.
    """

    def __init__(self, task: Task, prior: FaultPrior = TRAINING, **changed: Any) -> None:
        super().__init__(task)
        self.settings: Mapping[str, float] = {
            "pull": 1.05, "modelled": 1.05, "level": 1.5, "receiver": 1.25, "inertial": 2.0, "wandering": 2.0
        }  # fmt: skip
        p = task.parameters
        self.prior: FaultPrior = prior._replace(**changed)
        prior = self.prior
        self.interval: float = p.sampling_interval
        self.eye: Array = task.constant(numpy.eye(p.axes))[:, :, None]
        spacing = numpy.maximum(numpy.round(prior.longest / (prior.onsets * self.interval)), 1.0)
        self.spacing: Any = spacing if numpy.ndim(spacing) else int(spacing)
        self.noises: Noises = Noises(*(task.constant(each)[:, None, None] for each in draw_noises(prior, p)))
        self.others: Noises = Noises(*(each[1:] for each in self.noises))
        self.noise_weights: Array = task.constant(
            numpy.array([prior.modelled] + [(1.0 - prior.modelled) / prior.points] * prior.points)
        )[:, None, None]
        self.factors: Array = task.constant(numpy.array([*prior.levels]))[:, None]
        uniform = numpy.full(len(prior.levels), 1.0 / len(prior.levels))
        exact = numpy.isclose(prior.levels, 1.0).astype(float)
        self.uniform: Array = task.constant(uniform)[:, None]
        self.fresh: Array = task.constant((1.0 - prior.distrust) * exact + prior.distrust * uniform)[:, None]
        every = range((1 + prior.points) + prior.points * prior.onsets)
        raised = [[float(h > prior.points) for h in every], [float(h == 0) for h in every]]
        self.raised: Array = task.constant(raised)[:, :, None]
        """Mask of the hypotheses whose weights each of the first two settings multiplies, ``(2, H, 1)``."""
        highest = math.log(prior.levels[-1]) or 1.0
        self.heights: Array = task.constant([math.log(level) / highest for level in prior.levels])[:, None]
        self.onsets: Array = task.constant(numpy.arange(float(prior.onsets)))[:, None] * self.spacing

    def start(self, initial: Initial) -> FaultState:
        """Return the bank's state at the start of the track: INS and reference agree, no spoofing."""
        xp, noises = self.xp, self.noises
        none = 0.0 * initial.mean[0]
        zero = none + 0.0 * noises.drift
        ins = AugmentedCovariance(zero, zero, zero, zero + noises.drift**2, zero, zero + noises.coloured**2)
        P = faults.FaultCovariance(ins, xp.stack([zero[None]] * 3), (zero + noises.wandering**2)[None, None])
        still = xp.stack([0.0 * initial.mean[:, None, None] + zero[None]] * 4)
        free = Hypotheses(still, P, zero + self.noise_weights)
        born = self.start_pulls(free)
        others = [
            xp.stack([values[..., 0, :]] * self.prior.onsets, axis=-2) for values in (born.mean, *_flat(born))
        ]
        pulled = Hypotheses(others[0], _covariance(others[1:]), 0.0 * others[0][0, 0])
        memory = Memory(free, pulled, self.fresh + none, none)
        return FaultState(initial.mean, initial.covariance, memory, Likelihood.unknown(none))

    def start_pulls(self, free: Hypotheses) -> Hypotheses:
        """Return the hypotheses that spoofing begins now, ``(J - 1, 1)``, for all noises but the modelled one."""
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

    def since_onset(self, number: Array) -> Array:
        """Return the number of measurements since each hypothesis' onset of spoofing, ``(B, N)``."""
        cycle = 1.0 * self.spacing * self.prior.onsets
        since = number - self.onsets
        return since - cycle * self.xp.floor(since / cycle)

    def age(self, number: Array) -> Array:
        """Return the duration so far of each hypothesis' spoofing, s, ``(B, N)``; onsets lie midway between two."""
        return self.interval * (self.since_onset(number) + 0.5 * (self.spacing + 1))

    def switch_spoofing(
        self, free: Hypotheses, pulled: Hypotheses, number: Array
    ) -> tuple[Hypotheses, Hypotheses]:
        """Return the hypotheses with spoofing ended and begun at a measurement, by their hazards."""
        xp, prior, T = self.xp, self.prior, self.interval
        since, age = self.since_onset(number), self.age(number)
        born = (since == 0.0) & (number >= self.onsets)
        left = xp.clip(prior.longest - age, T, None)
        hazard = xp.where(age > prior.shortest, T / left, 0.0)
        hazard = xp.where(since == 0.0, 1.0, xp.clip(hazard, None, 1.0))
        begins = (number * T >= prior.onset[0]) & (number * T <= prior.onset[1])
        share = prior.onset_rate * self.spacing * T
        # At most one of the onsets is born at a measurement.
        given = xp.where(born & begins, share / (1.0 + share), 0.0)
        begun = self.start_pulls(free)
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
        return free, pulled

    def merge(self, begun: Hypotheses, pulled: Hypotheses, staying: Array, hazard: Array) -> Hypotheses:
        """Return the hypotheses without spoofing merged with those that ended, by their moments, ``(J - 1, 1)``."""
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

    def predict(self, state: FaultState, measurement: Measurement) -> FaultState:
        """Return the state predicted to a measurement, after spoofing may have begun or ended."""
        memory = state.memory
        free, pulled = self.switch_spoofing(memory.free, memory.pulled, measurement.number)
        reported = measurement.reported_deviation * measurement.reported_deviation
        changing = 1.0 - _exponential(-self.prior.level_rate * self.interval)
        chain = (1.0 - changing) * memory.levels + changing * self.uniform
        changed = self.xp.abs(reported - memory.reported) > SAME_REPORT * reported
        chain = self.xp.where(changed, self.fresh, chain)
        memory = Memory(
            self.predict_part(free, self.noises), self.predict_part(pulled, self.others), chain, reported
        )
        return state._replace(memory=memory)

    def has_effect(self, measurement: Measurement) -> Array:
        """Return 1 where there is a fix, so that an action has an effect, else 0, ``(N,)``."""
        return measurement.available

    def examine(self, state: FaultState, measurement: Measurement) -> Weighing:
        """Return the predicted hypotheses weighted by a fix, without the action's factors."""
        return self.weigh(state.memory, measurement)

    def apply_factors(
        self, predicted: Memory, measurement: Measurement, logarithms: Array
    ) -> tuple[Memory, Weighing]:
        """Return the predicted hypotheses with scaled process noise, and weighted by a fix with all factors.

        ``logarithms`` are those of the factors of the settings, ``(6, N)``.
        """
        xp = self.xp
        receiver, *noises = xp.exp(logarithms[3:])
        free = add_noise(predicted.free, noise_of_a_step(self.noises, self.parameters.sampling, 0), noises)
        pulled = add_noise(
            predicted.pulled, noise_of_a_step(self.others, self.parameters.sampling, 1), noises
        )
        predicted = predicted._replace(free=free, pulled=pulled)
        evidence, levels = (
            ordered_sum(self.raised * logarithms[:2, None]),
            xp.exp(self.heights * logarithms[2]),
        )
        return predicted, self.weigh(predicted, measurement, evidence, receiver, levels)

    def update(self, state: FaultState, inputs: FilterInput) -> FaultState:
        """Return the state with the predicted hypotheses weighted and updated by a fix, and their mean."""
        predicted, measurement = state.memory, inputs.measurement
        if inputs.action is None:
            weighing = self.weigh(predicted, measurement)
        else:
            predicted, weighing = self.apply_factors(predicted, measurement, inputs.action)
        return self.posterior_state(predicted, measurement, weighing)

    def likelihood(self, weighing: Weighing, measurement: Measurement) -> Likelihood:
        """Return the likelihood of a fix under its prediction; NaN where there is none."""
        there = measurement.available > 0.0
        return Likelihood(
            self.xp.where(there, weighing.log_likelihood, math.nan),
            self.xp.where(there, weighing.nis, math.nan),
            self.parameters.axes * measurement.available,
        )

    def predict_part(self, h: Hypotheses, noises: Noises) -> Hypotheses:
        """Return hypotheses predicted by one step, with these noises."""
        xp, s = self.xp, self.parameters.sampling
        one, zero = 0.0 * noises.decay + 1.0, 0.0 * noises.decay
        pulls = h.mean.shape[0] - 4
        decay = xp.stack([noises.decay, *[one] * pulls])
        gained = xp.stack([noises.wandering**2 * (1.0 - noises.decay**2), *[zero] * pulls])
        delta, drift, eta = h.mean[:3]
        moved = xp.stack([delta + s.step * drift + s.drive * eta, drift, s.decay * eta])
        P = faults.predict_fault(h.covariance, s, noises.coloured_growth, noises.white_growth, decay, gained)
        return Hypotheses(xp.concat([moved, decay[:, None] * h.mean[3:]]), P, h.weights)

    def weigh(
        self,
        predicted: Memory,
        measurement: Measurement,
        evidence: Array = 0.0,
        variance_factors: Array = 1.0,
        level_factors: Array = 1.0,
    ) -> Weighing:
        """Return the predicted hypotheses and noise levels with their posterior weights given a measurement.

        Args:
            predicted: result of :meth:`predict`.
            measurement: with or without a fix.
            evidence: added to the logarithms of the hypotheses' weights, nats, ``(H, N)`` or a number.
            variance_factors: multiply the variance of every level, ``(N,)`` or a number.
            level_factors: multiply the probabilities of the levels, ``(L, N)`` or a number.
        """
        xp, prior = self.xp, self.prior
        chain = level_factors * predicted.levels
        levels, q = variance_factors * (self.factors * predicted.reported), chain
        white = 1.0 / ordered_sum(chain / levels)
        if prior.outlier:
            levels = xp.concat([levels, (prior.outlier_factor * white)[None]])
            q = xp.concat([(1.0 - prior.outlier) * chain, prior.outlier + 0.0 * chain[:1]])
        there = measurement.available > 0.0
        fix = xp.where(there, measurement.ins - measurement.fix, 0.0)
        age = self.age(measurement.number)
        free, pulled = predicted.free, predicted.pulled
        parts = [
            self.weigh_part(free, xp.ones((1, 1, 1)), fix, there, levels, q),
            self.weigh_part(pulled, xp.stack([xp.ones_like(age), age]), fix, there, levels, q),
        ]
        expected, innovations, directions, noises = zip(*parts, strict=True)
        before = self.join_groups([free.weights, pulled.weights], 0)
        log_weights = self.join_groups(
            [
                imm.log_probabilities(part.weights) + xp.where(there, noise.log_density, 0.0)
                for part, noise in zip((free, pulled), noises, strict=True)
            ],
            0,
        )
        log_weights = log_weights + evidence
        log_likelihood = imm.log_sum(log_weights)
        weights = xp.exp(log_weights - log_likelihood)
        posterior = weighted_sum(weights, self.join_groups([noise.responsibilities for noise in noises], 1))
        if prior.outlier:
            posterior = posterior[:-1] + posterior[-1] * chain
        innovation = weighted_sum(before, self.join_groups(innovations, 1))
        own = weighted_sum(before, self.join_groups([along.variance for along in directions], 0))
        return Weighing(
            log_likelihood,
            weights,
            xp.where(there, posterior, chain),
            weighted_sum(before, self.join_groups(expected, 1)),
            own,
            ordered_sum(innovation * innovation) / (own + white),
            innovations,
            directions,
            noises,
        )

    def weigh_part(
        self, h: Hypotheses, shares: Array, fix: Array, there: Array, levels: Array, q: Array
    ) -> tuple[Array, Array, faults.Direction, faults.NoiseMixture]:
        """Return predicted difference, innovations, update directions and noise of hypotheses at a fix.

        Args:
            h: hypotheses.
            shares: of the receiver's errors in the measurement, ``(S - 3, M, N)``.
            fix: INS less receiver, m, ``(A, N)``.
            there: whether there is a fix, ``(N,)``.
            levels: variances of the receiver, ascending, m^2, ``(L, N)``.
            q: their probabilities, ``(L, N)``.

        Returns:
            INS less receiver as predicted and innovations, m, ``(A, J, M, N)``, direction of the update, and noise.
        """
        errors = h.mean[3:]
        pull = ordered_sum(shares[i] * errors[i] for i in range(shares.shape[0]))
        expected = h.mean[0] - pull
        innovation = self.xp.where(there, fix[:, None, None] - expected, 0.0)
        along = faults.measured_direction(h.covariance, shares)
        squares = ordered_sum(innovation * innovation)
        noise = faults.weigh_levels(
            squares, fix.shape[0], along.variance, levels[:, None, None], q[:, None, None]
        )
        return expected, innovation, along, noise

    def posterior_state(self, predicted: Memory, measurement: Measurement, weighing: Weighing) -> FaultState:
        """Return the state after the update of predicted hypotheses with their posterior weights."""
        xp = self.xp
        there = measurement.available > 0.0
        split = predicted.free.weights.shape[0]
        free, pulled = (
            self.update_part(part, innovation, along, noise, there)._replace(
                weights=xp.reshape(each, part.weights.shape)
            )
            for part, each, innovation, along, noise in zip(
                (predicted.free, predicted.pulled),
                (weighing.weights[:split], weighing.weights[split:]),
                weighing.innovations,
                weighing.directions,
                weighing.noises,
                strict=True,
            )
        )
        weights, delta = weighing.weights, self.join_groups([free.mean[0], pulled.mean[0]], 1)
        mean = weighted_sum(weights, delta)
        own = weighted_sum(
            weights, self.join_groups([each.covariance.ins.position for each in (free, pulled)], 0)
        )
        offsets = delta - mean[:, None]
        spread = weighted_sum(weights, offsets[:, None] * offsets[None])
        memory = Memory(free, pulled, weighing.levels, predicted.reported)
        likelihood = self.likelihood(weighing, measurement)
        return FaultState(measurement.ins - mean, self.eye * own + spread, memory, likelihood)

    def update_part(
        self,
        h: Hypotheses,
        innovation: Array,
        along: faults.Direction,
        noise: faults.NoiseMixture,
        there: Array,
    ) -> Hypotheses:
        """Return predicted hypotheses updated with their innovations; their weights do not change."""
        xp = self.xp
        squares = ordered_sum(innovation * innovation)
        push = xp.where(there, noise.score, 0.0) * innovation
        weight = xp.where(there, noise.score - noise.spread * squares / innovation.shape[0], 0.0)
        moved = [h.mean[i] + along[i] * push for i in range(3)]
        mean = xp.concat([xp.stack(moved), h.mean[3:] + along.faults[:, None] * push])
        return Hypotheses(mean, faults.update_fault(h.covariance, along, weight), h.weights)

    def join_groups(self, values: Sequence[Array], before: int) -> Array:
        """Return values of both groups of hypotheses as one array ``(..., H, N)``, with ``before`` leading axes."""
        return self.xp.concat(
            [self.xp.reshape(each, (*each.shape[:before], -1, each.shape[-1])) for each in values],
            axis=before,
        )


def _exponential(power: Any) -> Any:
    return math.exp(power) if isinstance(power, int | float) else namespace(power).exp(power)


def _flat(h: Hypotheses) -> list[Array]:
    return [*h.covariance.ins, h.covariance.cross, h.covariance.faults]


def _covariance(arrays: list[Array]) -> faults.FaultCovariance:
    return faults.FaultCovariance(AugmentedCovariance(*arrays[:6]), arrays[6], arrays[7])


def noise_of_a_step(noises: Noises, s: Sampling, pulls: int) -> tuple[faults.FaultCovariance, ...]:
    """Return the process noise covariances of one step: Q of the INS, W of the receiver's coloured error.

    ``pulls`` is the number of receiver errors beside the coloured one.
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


def add_noise(h: Hypotheses, steps: Sequence[faults.FaultCovariance], factors: Sequence[Array]) -> Hypotheses:
    """Return predicted hypotheses with each process noise of a step multiplied by a factor, ``(N,)``."""
    inertial, wandering = steps
    more, further = (factor - 1.0 for factor in factors)
    ins = (P + more * Q for P, Q in zip(h.covariance.ins, inertial.ins, strict=True))
    P = faults.FaultCovariance(
        AugmentedCovariance(*ins), h.covariance.cross, h.covariance.faults + further * wandering.faults
    )
    return h._replace(covariance=P)
