r"""Tracking a target of unknown class: a filter for each class, weighed by a radar and by a type recogniser.

The algorithm of the paper by Ivanov and Seliverstov; equation numbers are theirs. A target of class s moves
by x(k) = Phi(s) x(k-1) + xi(s), a radar measures z = H x + noise at every scan k, and at some scans the
electronic support measures (ESM) decide for a type rho with the known probabilities pi(rho | type). The
class may jump with probabilities q(s(k) | s(k-1)). One cycle, in the order of (8)-(10):

    1  each filter predicts and updates with the model of s(k-1)         x~, R~, Delta, Theta, mu, Omega
    2  Lambda(s(k-1)) = N(Delta; 0, Theta) weighs it by the radar        w(s') = P(s') Lambda(s')
    3  the class jumps                                                   P-(s) = sum_s' q(s | s') w(s')
       and the filters mix                                               x(s), R(s)            (9), (10)
    4  the ESM decision is a factor, where there is one that may be used P(s) ~ pi(rho | s) P-(s)   (8)
    5  output                                                            x, R                (11), (12)

Steps 1 to 3 are :func:`advance`, 4 is :func:`~filtergym.filters.imm.mode_posterior`, 5 is
:func:`~filtergym.filters.imm.combine`. An IMM mixes before it predicts; here mixing ends the cycle, so that
an ESM decision judges the class after a jump.

With a constant class, q = identity, nothing mixes: a bank of Kalman filters whose covariances and gains do
not depend on the data (:func:`design_channels`, :func:`update_channels`).

Reading: the first sum of (8) is over s(k-1), for a fixed s(k). The type probabilities of a class are
pi(rho | s) = sum_j pi(rho | type j) P(type j | s).
Reading: in the gate (6), (7) the inverse is that of the standard normal distribution function and P_err the
probability of *refusing* two bearings of one target, although the damaged prose reads otherwise.

Shapes: M classes, J types, n states, m measured components; probabilities ``(M, N)``, means ``(n, M, N)``,
covariances ``(n, n, M, N)``, models ``(n, n, M)``.
"""

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy

from . import imm
from .array_namespace import Array, namespace
from .gaussian import log_density
from .ordered_sums import ordered_sum
from .small_matrices import apply, cholesky, product, solve_lower, transpose

# --- the general recursion


class Models(NamedTuple):
    """Linear motion models of M classes, and the measurement model of the radar."""

    Phi: Array
    """Transition matrices, ``(n, n, M)``."""
    Q: Array
    """Covariances of the process noise, ``(n, n, M)``."""
    H: Array
    """Measurement matrix, ``(m, n)``."""
    R: Array
    """Covariance of the measurement noise, ``(m, m)``."""


class Advance(NamedTuple):
    """Estimates and probabilities of all classes after radar update and class transition, before the ESM decision."""

    mean: Array
    """Conditional estimates (9), ``(n, M, N)``."""
    covariance: Array
    """Their covariances (10), ``(n, n, M, N)``."""
    log_predicted: Array
    """Logarithm of P-(s), normalised, ``(M, N)``."""
    innovation: Array
    """Whitened innovations of the filters before mixing, ``(m, M, N)``: :func:`whiten`."""
    log_likelihood: Array
    """Log-likelihood log Lambda of the radar measurement under each filter before mixing, ``(M, N)``."""


def whiten(factor: list[list[Array]], innovation: Array) -> Array:
    """Return the whitened innovation ``L^-1 Delta`` with ``Theta = L L^T``, ``(m, ...)``.

    ``factor`` is L. The first component is the first innovation over its predicted sigma, the next the part of the
    second innovation that the first does not explain, over its sigma, and so on. The sum of their squares is the
    normalised innovation squared.
    """
    return namespace(innovation).stack(solve_lower(factor, innovation))


def advance(
    probabilities: Array, mean: Array, covariance: Array, z: Array, models: Models, class_transition: Array
) -> Advance:
    """Return the estimates of all classes after radar update, class transition and mixing: steps 1 to 3.

    A class that cannot be reached keeps its own estimate.

    Args:
        probabilities: P(s(k-1)), ``(M, N)``.
        mean: x(s(k-1)), ``(n, M, N)``.
        covariance: R(s(k-1)), ``(n, n, M, N)``.
        z: radar measurement, ``(m, N)``.
        models: models of the classes.
        class_transition: q, ``(M, M)``, row = from, column = to.
    """
    xp = namespace(mean)
    Phi, Q = models.Phi[..., None], models.Q[..., None]
    H, R = models.H[..., None, None], models.R[..., None, None]
    predicted = apply(Phi, mean)
    predicted_covariance = product(product(Phi, covariance), transpose(Phi)) + Q
    innovation = z[:, None] - apply(H, predicted)
    HP = product(H, predicted_covariance)
    Theta = product(HP, transpose(H)) + R
    factor = cholesky(Theta)
    whitened = whiten(factor, innovation)
    # G = L^-1 H R~, so that the gain is G^T L^-1.
    G = xp.stack(solve_lower(factor, HP))
    updated = predicted + apply(transpose(G), whitened)
    gain = transpose(_solve_upper(factor, G))
    rest = xp.eye(mean.shape[0], dtype=mean.dtype, device=mean.device)[..., None, None] - product(gain, H)
    # Joseph form: positive definite whatever the rounding.
    updated_covariance = product(product(rest, predicted_covariance), transpose(rest)) + product(
        product(gain, R), transpose(gain)
    )
    log_likelihood, _ = log_density(innovation, Theta)
    weights = imm.mode_posterior(imm.log_probabilities(probabilities), log_likelihood)
    jump = imm.predict_mode_probabilities(class_transition, weights)
    mixed, mixed_covariance = imm.mix(updated, updated_covariance, jump.mixing)
    return Advance(
        mixed, mixed_covariance, imm.log_probabilities(jump.probabilities), whitened, log_likelihood
    )


def _solve_upper(L: list[list[Array]], B: Array) -> Array:
    """Return X with ``L^T X = B``, for a list of the rows of L."""
    size = len(L)
    x: list[Array] = [None] * size
    for i in reversed(range(size)):
        entry = B[i]
        for j in range(i + 1, size):
            entry = entry - L[j][i] * x[j]
        x[i] = entry / L[i][i]
    return namespace(B).stack(x)


# --- the bank of constant classes


class Channels(NamedTuple):
    """Gains, covariances and innovation statistics of filters of constant classes, for every scan."""

    gain: Array
    """Kalman gains, ``(n, m, M, K + 1)``; zero at scan 0, where the track starts."""
    covariance: Array
    """Covariances after the update, ``(n, n, M, K + 1)``."""
    whitening: Array
    """Inverse Cholesky factors of Theta, lower triangular, ``(m, m, M, K + 1)``; zero at scan 0."""
    log_normaliser: Array
    """``-1/2 log det(2 pi Theta)``, ``(M, K + 1)``; zero at scan 0."""


def design_channels(models: Models, start: numpy.ndarray, scans: int) -> Channels:
    """Compute gains, covariances and innovation statistics of the Kalman filters of all classes, for K scans.

    Args:
        models: models of the classes, NumPy arrays.
        start: covariances at scan 0, ``(n, n, M)``.
        scans: K, the last scan.
    """
    n, classes = start.shape[0], start.shape[2]
    m = models.H.shape[0]
    gain = numpy.zeros((n, m, classes, scans + 1))
    covariance = numpy.zeros((n, n, classes, scans + 1))
    whitening = numpy.zeros((m, m, classes, scans + 1))
    log_normaliser = numpy.zeros((classes, scans + 1))
    covariance[..., 0] = start
    H, R = models.H, models.R
    for s in range(classes):
        P = start[..., s]
        for k in range(1, scans + 1):
            P = models.Phi[..., s] @ P @ models.Phi[..., s].T + models.Q[..., s]
            Theta = H @ P @ H.T + R
            K = numpy.linalg.solve(Theta, H @ P).T
            rest = numpy.eye(n) - K @ H
            P = rest @ P @ rest.T + K @ R @ K.T
            L = numpy.linalg.cholesky(Theta)
            gain[..., s, k], covariance[..., s, k] = K, P
            whitening[..., s, k] = numpy.linalg.inv(L)
            log_normaliser[s, k] = -numpy.log(numpy.diag(L)).sum() - 0.5 * m * math.log(2.0 * math.pi)
    return Channels(gain, covariance, whitening, log_normaliser)


class ChannelUpdate(NamedTuple):
    """Result of the radar update of one scan in filters of constant classes."""

    mean: Array
    """Updated means, ``(n, M, N)``."""
    innovation: Array
    """Whitened innovations, ``(m, M, N)``."""
    log_likelihood: Array
    """Log-likelihoods of the measurement under each class, ``(M, N)``."""


def update_channels(mean: Array, z: Array, models: Models, channels: Channels) -> ChannelUpdate:
    """Return the means of all classes updated with a radar measurement, by precomputed gains (step 1).

    Args:
        mean: x(s), ``(n, M, N)``.
        z: radar measurement, ``(m, N)``.
        models: models of the classes.
        channels: design of the filters at the present scan of each episode, ``(..., N)`` instead of ``(..., K + 1)``.
    """
    predicted = apply(models.Phi[..., None], mean)
    innovation = z[:, None] - apply(models.H[..., None, None], predicted)
    whitened = apply(channels.whitening, innovation)
    squared = ordered_sum(whitened * whitened)
    updated = predicted + apply(channels.gain, innovation)
    return ChannelUpdate(updated, whitened, channels.log_normaliser - 0.5 * squared)


# --- coloured errors of the radar


def add_coloured_errors(
    models: Models, start: numpy.ndarray, share: float, decay: float
) -> tuple[Models, numpy.ndarray]:
    """Return motion models and start covariances of states augmented by coloured errors of the radar; NumPy
    arrays.

    With x the state and e the errors, ``e(k) = decay e(k-1) + w``, the new state is (x + H^T e, e): each
    measured component includes its error, so that measurements are the first m components and white errors.

    Args:
        models: models of the classes, with ``H = [I 0]``.
        start: covariances at scan 0, ``(n, n, M)``.
        share: variance of a coloured error over that of the white one.
        decay: factor on the coloured error from scan to scan.
    """
    n, m = start.shape[0], models.H.shape[0]
    white = numpy.diagonal(models.R)
    mixing = numpy.eye(n + m)
    mixing[range(m), range(n, n + m)] = 1.0
    own, errors = slice(0, n), range(n, n + m)

    def augmented(matrices: numpy.ndarray, diagonal: numpy.ndarray) -> numpy.ndarray:
        whole = numpy.zeros((matrices.shape[-1], n + m, n + m))
        whole[:, own, own] = numpy.moveaxis(matrices, -1, 0)
        whole[:, errors, errors] = diagonal
        return whole

    Phi = mixing @ augmented(models.Phi, numpy.full(m, decay)) @ numpy.linalg.inv(mixing)
    Q = mixing @ augmented(models.Q, share * (1.0 - decay**2) * white) @ mixing.T
    P = augmented(start, share * white)
    whole = Models(numpy.moveaxis(Phi, 0, -1), numpy.moveaxis(Q, 0, -1), numpy.eye(m, n + m), models.R)
    return whole, numpy.moveaxis(P, 0, -1)


def remove_coloured_errors(mean: Array, covariance: Array, measured: int = 2) -> tuple[Array, Array]:
    """Return mean and covariance of the state x itself, from those of :func:`add_coloured_errors`.

    Args:
        mean: mean of the augmented state, ``(n + m, N)``.
        covariance: covariance of the augmented state, ``(n + m, n + m, N)``.
        measured: number m of measured components.
    """
    xp, n = namespace(mean), mean.shape[0] - measured
    states = xp.concat([mean[:measured] - mean[n:], mean[measured:n]])
    rows = xp.concat([covariance[:measured] - covariance[n:], covariance[measured:n]])
    both = xp.concat([rows[:, :measured] - rows[:, n:], rows[:, measured:n]], axis=1)
    return states, both


# --- the ESM


def decision_probabilities(confusion: numpy.ndarray, composition: numpy.ndarray) -> numpy.ndarray:
    """Return the probability pi(rho | s) of each ESM decision rho for each class s, ``(M, J)``.

    Args:
        confusion: pi(rho | type), ``(J, J)``, row = true type, column = decision; equation (5).
        composition: P(type | s), ``(M, J)``, rows sum to one.
    """
    return numpy.asarray(composition) @ numpy.asarray(confusion)


def constant_class_log_likelihood(counts: Array, log_confusion: Array, log_composition: Array) -> Array:
    """Return the log-likelihood of each class if all decisions are on one constant type, ``(M, N)``.

    (8) multiplies pi(rho | s) at every decision, which is Bayes' rule only if the type is drawn anew each
    time. For one type ``log sum_j P(type j | s) prod_rho pi(rho | type j)^count(rho)``: the posterior of type
    and class together, summed over the type.

    Args:
        counts: number of decisions for each type, ``(J, N)``.
        log_confusion: log pi(rho | type), ``(J, J)``, row = true type; finite.
        log_composition: log P(type | s), ``(M, J)``; finite.
    """
    xp = namespace(counts)
    evidence = apply(log_confusion[..., None], counts)
    joint = log_composition[..., None] + evidence[None]
    largest = xp.max(joint, axis=1)
    terms = xp.exp(joint - largest[:, None])
    return largest + xp.log(ordered_sum(terms[:, j] for j in range(terms.shape[1])))


def change_class_and_type(log_joint: Array, log_composition: Array, change: float) -> Array:
    """Return log-probabilities of class and type after a possible class change, with a new type,
    ``(M, J, N)``.

    ``P(s, j) <- (1 - c) P(s, j) + c P(type j | s) sum_{s' != s} P(s') / (M - 1)``: the transition q of (8),
    for a type that changes only together with the class.

    Args:
        log_joint: log P(s, j), up to a constant, ``(M, J, N)``.
        log_composition: log P(type j | s), ``(M, J)``; finite.
        change: c, the probability that the class changes; all others are equally probable then.
    """
    xp, classes = namespace(log_joint), log_joint.shape[0]
    joint = xp.exp(log_joint - xp.max(log_joint, axis=(0, 1)))
    of_class = [ordered_sum(joint[s]) for s in range(classes)]
    others = xp.stack([ordered_sum(of_class[r] for r in range(classes) if r != s) for s in range(classes)])
    entered = xp.exp(log_composition)[..., None] * (change / (classes - 1) * others)[:, None]
    return imm.log_probabilities((1.0 - change) * joint + entered)


def bearing_gate(radar_sigma: float, esm_sigma: float, error_probability: float) -> float:
    """Return the largest difference of two bearings of one target at an error probability, equation (7).

    ``sqrt(sigma_Z^2 + sigma_Y^2) F^-1(1 - P_err / 2)``, in the unit of the sigmas.

    Raises:
        ValueError: if ``error_probability`` is not between 0 and 1.
    """
    if not 0.0 < error_probability < 1.0:
        raise ValueError(f"error_probability must be above 0 and below 1, got {error_probability!r}")
    return math.hypot(radar_sigma, esm_sigma) * NormalDist().inv_cdf(1.0 - error_probability / 2.0)


def bearing_difference(first: Array, second: Array) -> Array:
    """Return the difference of two bearings, degrees, wrapped to [-180, 180)."""
    difference = first - second
    return difference - 360.0 * namespace(difference).floor((difference + 180.0) / 360.0)
