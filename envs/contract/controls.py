"""What an action means to a bank of filters: mode, weights, evidence."""

from types import ModuleType

import gymnasium
import numpy

from ...filters import imm
from ...filters.ordered_sums import ordered_sum
from .observation import Array


def bank_action_space(control: str, count: int) -> gymnasium.Space:
    """Action space of a control over a bank of ``count`` hypotheses.

    ``mode``: the one hypothesis that is believed. ``weights``: absolute weights, normalised by the task (all
    zero = uniform). ``evidence``: scaled and added to the log-posterior of Bayes' rule; zero is the paper.
    """
    if control == "mode":
        return gymnasium.spaces.Discrete(count)
    low = {"weights": 0.0, "evidence": -1.0}[control]
    return gymnasium.spaces.Box(low, 1.0, (count,), numpy.float32)


def bank_probabilities(
    control: str,
    action: Array,
    log_predicted: Array,
    log_likelihood: Array,
    evidence_scale: float,
    xp: ModuleType,
) -> Array:
    """Weights of the bank that an action puts in force, ``(M, N)``.

    Args:
        control: "mode", "weights" or "evidence".
        action: ``(N,)`` integers for mode, otherwise ``(M, N)``; limits of the space are enforced here.
        log_predicted: logarithm of the predicted probabilities, ``(M, N)``.
        log_likelihood: of each hypothesis, ``(M, N)``.
        evidence_scale: nats that an evidence of one adds to the log-posterior.
        xp: array namespace.
    """
    if control == "mode":
        hypotheses = xp.arange(log_likelihood.shape[0], device=log_likelihood.device)
        return xp.astype(hypotheses[:, None] == action[None], log_likelihood.dtype)
    if control == "weights":
        weights = xp.clip(action, 0.0, 1.0)
        total = ordered_sum(weights)
        positive = total > 0.0
        uniform = 1.0 / weights.shape[0]
        return xp.where(positive, weights / xp.where(positive, total, 1.0), uniform)
    return imm.mode_posterior(log_predicted, log_likelihood + evidence_scale * xp.clip(action, -1.0, 1.0))
