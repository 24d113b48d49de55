"""What an agent is paid for one measurement.

``cost`` (default): minus the task's cost, linear beyond its Huber bound. ``log-likelihood``: the logarithm of
the reported Gaussian's density at the truth, which pays for an honest covariance too. ``relative``: the
``cost`` reward with the cost of the paper's algorithm on the same noise added back (a control variate):
positive where the agent does better than the paper.
"""

from typing import Any

from ..filters.gaussian import log_density
from .observation import Array
from .task import Task, huber

REWARDS = ("cost", "log-likelihood", "relative")


def capped_cost(task: Task, state: Any) -> Array:
    """Cost of the estimate, linear beyond the task's Huber bound, ``(N,)``."""
    return huber(task.cost(state), task.huber_bound, task.xp)


def reward(kind: str, task: Task, state: Any, paper: Task | None, paper_state: Any) -> Array:
    """Pay for the estimate in ``state``, ``(N,)``.

    Args:
        kind: one of ``REWARDS``.
        task: whose state it is.
        state: after the action.
        paper: the same task under the control of the paper's algorithm, for "relative".
        paper_state: its state on the same noise.
    """
    if kind == "log-likelihood":
        return log_density(task.error(state), task.covariance(state))[0]
    if kind == "relative":
        assert paper is not None
        return capped_cost(paper, paper_state) - capped_cost(task, state)
    return -capped_cost(task, state)


def paper_task(task: Task) -> Task:
    """Return the same task under the control of the paper's algorithm."""
    return task.under(task.paper_policy.control)
