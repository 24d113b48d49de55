"""What an agent is paid for one measurement.

``cost`` (default): minus the task's cost, linear beyond its Huber bound. ``log-likelihood``: the logarithm of
the reported Gaussian's density at the truth, which pays for an honest covariance too. ``relative``: the
``cost`` reward with the cost of the paper's algorithm on the same noise added back (a control variate):
positive where the agent does better than the paper.
"""

from collections.abc import Callable
from typing import Any

from ..filters.gaussian import log_density
from .observation import Array
from .task import Task, huber


def capped_cost(task: Task, state: Any) -> Array:
    """Cost of the estimate, linear beyond the task's Huber bound, ``(N,)``."""
    return huber(task.cost(state), task.huber_bound, task.xp)


def cost_reward(task: Task, state: Any) -> Array:
    """Minus the capped cost of the estimate, ``(N,)``."""
    return -capped_cost(task, state)


def log_likelihood_reward(task: Task, state: Any) -> Array:
    """Log-density of the truth under what is reported, ``(N,)``."""
    return log_density(task.error(state), task.covariance(state))[0]


OWN_PAY: dict[str, Callable[[Task, Any], Array]] = {
    "cost": cost_reward,
    "log-likelihood": log_likelihood_reward,
    "relative": cost_reward,
}
"""What each reward pays for an estimate; from "relative" the same of the paper's algorithm is then taken away."""
REWARDS = tuple(OWN_PAY)


def reward(kind: str, task: Task, state: Any, paper: Task | None, paper_state: Any) -> Array:
    """Pay for the estimate in ``state``, ``(N,)``.

    Args:
        kind: one of ``REWARDS``.
        task: whose state it is.
        state: after the action.
        paper: the same task under the control of the paper's algorithm, for "relative".
        paper_state: its state on the same noise.
    """
    paid = OWN_PAY[kind](task, state)
    if kind == "relative":
        assert paper is not None
        return paid - OWN_PAY[kind](paper, paper_state)
    return paid


def paper_task(task: Task) -> Task:
    """Return the same task under the control of the paper's algorithm."""
    return task.under(task.paper_policy.control)
