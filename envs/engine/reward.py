"""The reward of an agent for one measurement.

* ``cost``: minus the counted cost of the estimate, in units of its mean for the paper's algorithm, and compressed: of a
  cost ``x`` in that unit the reward is ``-30 log(1 + x / 30)``. That is about ``-x`` while the estimator works, and
  falls by 30 log(2) with every doubling once the track is lost. So recovering a track always pays, and
  one lost track does not dominate the gradient of all others.
* ``log-likelihood``: the logarithm of the reported Gaussian's density at the truth. It also rewards a consistent
  covariance.
* ``cost-and-likelihood``: the sum of ``cost`` and of ``log-likelihood`` over the number of components, for
  estimates that must be both accurate and consistent.
* ``relative``: the ``cost`` reward minus that of the paper's algorithm on the same noise (a control variate):
  positive where the agent does better than the paper.
* ``log-relative``: ``log(1 + x0) - log(1 + x)``, where ``x`` is the counted cost of the agent and ``x0`` that of the
  zero action of the same control on the same noise, both in units of the paper's average, or where few lost
  tracks dominate that, of an ordinary episode (``Reward.log_unit``). It is zero for the zero action, the
  difference of small costs, and the logarithm of the ratio of large ones. So a few extreme
  episodes, which dominate the mean of the cost, do not hide the effect of an action in all others.

:attr:`.Reward.kind` of the task is the default.

The counted cost is the cost, or the part of it that :meth:`.World.counted_cost` leaves. An evaluation compares
the whole cost, neither compressed nor in another unit.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from ...filters.gaussian import log_density
from ...filters.ordered_sums import ordered_sum
from ...filters.small_matrices import solve_definite
from ..contract.model import Model
from ..contract.observation import Array

COMPRESSED_BEYOND = 30.0
"""Counted cost, in units of the paper's average one, from which on the reward falls slowly."""


def compress(model: Model, counted: Array) -> Array:
    """Return a counted cost over the paper's mean cost, compressed to ``30 log(1 + x / 30)``, ``(N,)``."""
    return COMPRESSED_BEYOND * model.task.xp.log1p(
        counted * (1.0 / (COMPRESSED_BEYOND * model.task.reward.unit))
    )


def compressed_cost(model: Model, state: Any) -> Array:
    """Return the compressed cost of an estimate over the paper's mean cost, ``(N,)``."""
    return compress(model, model.counted_cost(state))


def cost_reward(model: Model, state: Any) -> Array:
    """Return minus the compressed cost of the estimate, ``(N,)``."""
    return -compressed_cost(model, state)


def log_cost_reward(model: Model, state: Any) -> Array:
    """Return ``-log(1 + x)``, x the cost of the estimate over that of an ordinary episode, ``(N,)``."""
    unit = model.task.reward.log_unit or model.task.reward.unit
    return -model.task.xp.log1p(model.counted_cost(state) * (1.0 / unit))


def log_likelihood_reward(model: Model, state: Any) -> Array:
    """Return the log-density of the truth under the Gaussian of reported mean and covariance, ``(N,)``."""
    return log_density(model.error(state), model.covariance(state))[0]


def cost_and_likelihood_reward(model: Model, state: Any) -> Array:
    """Return minus the compressed cost, plus the log-density of the truth per component, ``(N,)``."""
    return cost_reward(model, state) + log_likelihood_reward(model, state) * (
        1.0 / len(model.task.components)
    )


LIKELIHOOD_WEIGHTS = {"cost": 0.0, "cost-and-likelihood": 1.0}
"""Weight of the log-density per component, in the rewards that :func:`teacher_reward` gives."""


def teacher_reward(kind: str, model: Model, state: Any, mean: Array, covariance: Array) -> Array:
    """Return the expected reward, up to a constant, if the truth has a teacher's mean and covariance, ``(N,)``.

    With d = x - m, the student's estimate less the teacher's, and their covariances P and S, the log-density is
    expected to be ``log N(d; 0, P) - tr(P^-1 S) / 2``. A cost is a square of errors, and adds that of the teacher's own
    errors, which the student cannot change: only the cost of d counts.

    Args:
        kind: of reward, one of ``LIKELIHOOD_WEIGHTS``.
        model: of the student.
        state: its episodes after the action.
        mean: of the teacher, ``(C, N)``.
        covariance: S, ``(C, C, N)``.
    """
    world, difference = model.task.world, model.task.subtract(model.mean(state), mean)
    reward = -compress(model, world.counted_cost(state.truth, world.state(state.truth) + difference))
    weight = LIKELIHOOD_WEIGHTS[kind] / len(model.task.components)
    if not weight:
        return reward
    P = model.covariance(state)
    ratio = solve_definite(P, covariance)
    trace = ordered_sum(ratio[i, i] for i in range(ratio.shape[0]))
    return reward + weight * (log_density(difference, P)[0] - 0.5 * trace)


def no_reward(model: Model, state: Any) -> Array:
    """Return rewards of zero, ``(N,)``, for an unknown truth."""
    return 0.0 * model.mean(state)[0]


REWARD_FUNCTIONS: dict[str, Callable[[Model, Any], Array]] = {
    "cost": cost_reward,
    "log-likelihood": log_likelihood_reward,
    "cost-and-likelihood": cost_and_likelihood_reward,
    "relative": cost_reward,
    "log-relative": log_cost_reward,
    "none": no_reward,
}
"""Functions of a model and its episodes. The reward of a :func:`reward_baseline` is subtracted later. "none" is for
recordings without truth."""
REWARDS = tuple(kind for kind in REWARD_FUNCTIONS if kind != "none")
"""Kinds of reward that a user can choose."""


class RewardBaseline(NamedTuple):
    """Model and constant action whose reward on the same noise a relative reward subtracts."""

    model: Model
    """Model of the same task under the baseline's control."""
    action: tuple[float, ...] | int
    """Action of the baseline in every decision, an element of the control's space."""


def reward_baseline(kind: str, model: Model) -> RewardBaseline | None:
    """Return the :class:`RewardBaseline` of a kind of reward for an agent's model; None if it is not relative."""
    if kind == "relative":
        paper = model.task.paper_policy
        return RewardBaseline(model.with_control(paper.control), paper.action)
    if kind == "log-relative":
        return RewardBaseline(model, (0.0,) * model.action_space.shape[0] if model.action_space.shape else 0)
    return None
