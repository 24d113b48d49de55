"""Controls of a bank of filters: mode, weights, evidence; or factors of a filter's settings."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from types import ModuleType
from typing import Any, ClassVar

import gymnasium
import numpy

from ...filters import imm
from ...filters.ordered_sums import ordered_sum
from .filter import Bank, Filter, FilterInput, Measurement, State, TaskT
from .observation import Array


def bank_action_space(control: str, count: int) -> gymnasium.Space[Any]:
    """Return the Gymnasium action space of a control (mode, weights or evidence) over ``count`` hypotheses.

    ``mode``: the selected hypothesis. ``weights``: absolute weights, normalised by the task (all
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
    """Return the weights ``(M, N)`` of a bank's M hypotheses that an action sets under a control.

    Args:
        control: "mode", "weights" or "evidence".
        action: ``(N,)`` integers for mode, otherwise ``(M, N)``; clipped to the limits of the space.
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


class SteerableFilter(Filter[TaskT, Measurement, State]):
    """Base class of filters whose settings (noise levels, gains) an action multiplies at each measurement.

    The action of :meth:`update` is the logarithm of each factor, ``(n, N)``. Without an action the filter is an
    estimator.
    """

    settings: Mapping[str, float]
    """Factor by which an action of one multiplies each setting: white noise of deviation one, with which a new policy
    explores, then increases the cost by a twentieth at most."""

    def has_effect(self, measurement: Measurement) -> Array:
        """Return 1 where an action affects the update with a measurement, else 0, ``(N,)``; by default 1."""
        return 1.0

    def examine(self, state: State, measurement: Measurement) -> Any:
        """Return the result of an update with a measurement without an action, to compute the observation from."""
        return self.update(state, FilterInput(measurement))


class SettingsBank(Bank[Any, Any, Any]):
    """Base class of banks of one filter whose settings the action multiplies.

    The action a in [-1, 1]^n multiplies setting k by ``r_k^a_k``, where the filter declares r_k. The zero action is
    the filter itself, bit for bit: an agent starts from the strongest classical filter.

    The state is a NamedTuple with ``own``, the state of the filter, ``likelihood``, that of the measurement under its
    prediction, ``action``, the last one, ``(n, N)``, and further values of the observation.
    """

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]]
    """Class of the steered filter."""
    own: Any
    """The steered filter."""

    def __init__(self, task: Any, control: str) -> None:
        super().__init__(task, control)
        self.own = self.filter_class(task)
        factors = self.own.settings.values()
        self.log_reach: Array = task.constant([math.log(factor) for factor in factors])[:, None]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box [-1, 1] with one number for each setting of the filter."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.own.settings),), numpy.float32)

    @abstractmethod
    def add_observed(self, state: Any, result: Any, measurement: Any) -> Any:
        """Return the bank's state with the values that the agent observes at a measurement filled in."""

    def predict(self, state: Any, measurement: Any) -> Any:
        """Return the bank's state predicted to a measurement, with the values that the agent observes."""
        own = self.own.predict(state.own, measurement)
        return self.add_observed(state._replace(own=own), self.own.examine(own, measurement), measurement)

    def act(self, state: Any, measurement: Any, action: Array) -> Any:
        """Return the state updated with a measurement, the filter's settings multiplied by the action's factors."""
        shown = self.xp.clip(self.xp.astype(action, self.xp.float64), -1.0, 1.0)
        logarithms = self.own.has_effect(measurement) * self.log_reach * shown
        own = self.own.update(state.own, FilterInput(measurement, None, logarithms))
        return state._replace(own=own, action=shown)

    def mean(self, state: Any) -> Array:
        """Return the mean of the filter's estimate, ``(C, N)``."""
        return self.own.mean(state.own)

    def covariance(self, state: Any) -> Array:
        """Return the covariance of the filter's estimate, ``(C, C, N)``."""
        return self.own.covariance(state.own)
