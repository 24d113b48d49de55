r"""Interacting multiple model (IMM): mixing, mode probabilities, combination.

M filters run in parallel, one for each mode of the target; the mode is a Markov chain with matrix
``transition[i, j] = P{mode j at k | mode i at k-1}`` (row = from, column = to, rows sum to one). Equation
numbers are those of the paper by Bakulev, Sychev and Nguyen (the recursion itself is Blom and Bar-Shalom's,
1988). One cycle: :func:`predict_mode_probabilities`, :func:`mix`, the M filters, :func:`mode_posterior`,
:func:`combine`.

Shapes: mode probabilities ``(M, N)``, means ``(n, M, N)``, covariances ``(n, n, M, N)``.

Reading: (9) is lost in the scan and restored with the spread of the means, as in (16).
Reading: (10), (12)-(14) are damaged; the sums run over the first index of ``p_ij``.
"""

import math
from typing import NamedTuple

from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum, weighted_sum
from .small_matrices import outer


class ModePrediction(NamedTuple):
    """Predicted mode probabilities and mixing weights, before the measurement."""

    probabilities: Array
    """Predicted mode probabilities (13), ``(M, N)``."""
    mixing: Array
    """Mixing weights (10), ``[i, j] = mu_{i|j}``, ``(M, M, N)``; every column sums to one."""


def predict_mode_probabilities(transition: Array, probabilities: Array) -> ModePrediction:
    """Return predicted mode probabilities (13) and mixing weights (10) from the mode probabilities before.

    A mode that cannot be reached (predicted probability zero) keeps its own estimate.

    Args:
        transition: transition matrix, row = from, column = to, ``(M, M)`` or ``(M, M, N)``.
        probabilities: mode probabilities ``mu_i(k-1)``, ``(M, N)``.
    """
    xp = namespace(probabilities)
    if transition.ndim == 2:
        transition = transition[:, :, None]
    joint = transition * probabilities[:, None]
    predicted = ordered_sum(joint)
    reachable = predicted > 0.0
    stay = xp.eye(joint.shape[0], dtype=joint.dtype, device=joint.device)[:, :, None]
    mixing = xp.where(reachable, joint / xp.where(reachable, predicted, 1.0), stay)
    return ModePrediction(predicted, mixing)


def mix(mean: Array, covariance: Array, mixing: Array) -> tuple[Array, Array]:
    """Return the mixed means and covariances at the input of the M filters, equations (8) and (9).

    Args:
        mean: means ``x^i(k-1|k-1)``, ``(n, M, N)``.
        covariance: covariances ``P^i(k-1|k-1)``, ``(n, n, M, N)``.
        mixing: mixing weights ``mu_{i|j}``, ``(M, M, N)``.

    Returns:
        Means ``x^{0j}`` and covariances ``P^{0j}``, of the same shapes.
    """
    return combine(mean[:, :, None], covariance[:, :, :, None], mixing)


def combine(mean: Array, covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Return mean and covariance of a Gaussian mixture, equations (15) and (16).

    Args:
        mean: means of the components, ``(n, M, ...)``.
        covariance: their covariances, ``(n, n, M, ...)``.
        weights: their weights, ``(M, ...)``, which sum to one.

    Returns:
        Mean ``(n, ...)`` and covariance ``(n, n, ...)``, trailing axes broadcast; the covariance includes the spread of
        the means.
    """
    centre = weighted_sum(weights, mean)
    differences = (mean[:, i] - centre for i in range(weights.shape[0]))
    spread = ordered_sum(
        weights[i] * (covariance[:, :, i] + outer(difference, difference))
        for i, difference in enumerate(differences)
    )
    return centre, spread


def log_probabilities(probabilities: Array) -> Array:
    """Return the natural logarithms of probabilities, limited below to log 1e-300."""
    xp = namespace(probabilities)
    if probabilities.dtype == xp.float64:
        return xp.log(xp.clip(probabilities, 1e-300, None))
    # In single precision, in which weights may arrive as actions, the floor is zero but its logarithm is not.
    possible = probabilities > 0.0
    return xp.where(possible, xp.log(xp.where(possible, probabilities, 1.0)), math.log(1e-300))


def softmax(logarithms: Array) -> Array:
    """Return the probabilities ``(M, N)`` from their logarithms up to a constant, normalised over the first axis."""
    xp = namespace(logarithms)
    scaled = xp.exp(logarithms - xp.max(logarithms, axis=0))
    return scaled / ordered_sum(scaled)


def log_mixture_density(log_weights: Array, log_likelihood: Array) -> Array:
    """Return the log-density of a mixture, ``log sum_j w_j Lambda_j``, ``(N,)``.

    Args:
        log_weights: logarithms of the weights, ``(M, N)``; the weights sum to one.
        log_likelihood: logarithms of the components' densities, ``(M, N)``.
    """
    return log_sum(log_weights + log_likelihood)


def log_sum(logarithms: Array) -> Array:
    """Return the logarithm of the sum of exponentials over the first axis, ``(M, ...)`` to ``(...)``."""
    xp = namespace(logarithms)
    largest = xp.max(logarithms, axis=0)
    return largest + xp.log(ordered_sum(xp.exp(logarithms - largest)))


def mode_posterior(log_predicted: Array, log_likelihood: Array) -> Array:
    """Return the posterior mode probabilities ``(M, N)``, equations (12) and (14), computed in logarithms.

    Working in logarithms, probabilities survive likelihoods that underflow (an innovation of 500 sigma).

    Args:
        log_predicted: logarithm of the predicted probabilities, ``(M, N)``.
        log_likelihood: ``log Lambda_j`` (11), ``(M, N)``.
    """
    return softmax(log_predicted + log_likelihood)
