"""Report function of an environment, computed at every measurement after the action."""

import functools
from typing import Any, NamedTuple

from ..contract.model import Episode, Model
from ..contract.observation import Array
from ..engine.programs import Report
from ..engine.reward import REWARD_FUNCTIONS


class StepReport(NamedTuple):
    """Report on one measurement: requested quantities, lanes (parallel episodes) last; the others are None."""

    reward: Array
    """Reward, ``(N,)``; a relative one before that of the baseline is subtracted."""
    error: Array = None
    """Estimate minus truth, ``(C, N)``."""
    covariance: Array = None
    """Reported covariance of the error, ``(C, C, N)``."""
    details: dict[str, Array] | None = None
    """Content of ``info`` with ``detailed_info``."""
    episode: Any = None
    """Episodes after the action."""


@functools.cache
def step_report(kind: str, errors: bool = False, details: bool = False, episode: bool = False) -> Report:
    """Return the function that computes a :class:`StepReport`, the same one for equal arguments.

    It reports the reward of this kind, and if wanted error and covariance, the details of the measurement, and the
    statistics of the episode for ``info``.
    """
    reward = REWARD_FUNCTIONS[kind]

    def report(model: Model, state: Episode) -> StepReport:
        found = StepReport(reward(model, state))
        if errors:
            found = found._replace(error=model.error(state), covariance=model.covariance(state))
        if details:
            judged = {"error": model.error(state), "cost": model.cost(state)} if model.task.has_truth else {}
            found = found._replace(details={**judged, **model.track(state), **model.records(state)})
        return found._replace(episode=state) if episode else found

    return report
