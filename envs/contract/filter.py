"""Filters, and the likelihood that they report.

A **filter** starts at the initial estimate given to every filter, predicts to every measurement, updates with it, and
reports mean and covariance. Every competitor is a filter: a bank of filters that a policy steers, an estimator of a
user, a learned estimator, a reference with additional information, a bound. So one rollout and one compilation serve
all of them.

State and measurement are NamedTuples of arrays ``(..., N)``, batch on the last axis, and are never changed in place.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import gymnasium

from .observation import Array, Block, Quantity

TaskT = TypeVar("TaskT")
Measurement = TypeVar("Measurement")
State = TypeVar("State")


class Initial(NamedTuple):
    """The initial estimate given to every filter; a task may use a NamedTuple with more fields."""

    mean: Array
    """Mean in the units of the task's components, ``(C, N)``."""
    covariance: Array
    """Its covariance, ``(C, C, N)``."""


class FilterInput(NamedTuple):
    """Input of a filter at a measurement."""

    measurement: Any
    truth: Any = None
    """The world's NamedTuple for a filter that ``knows`` something; else None."""
    action: Array = None
    """Action of a bank: ``(A, N)`` floats for a box, ``(N,)`` integers for a discrete space."""


class Likelihood(NamedTuple):
    """Likelihood of a measurement under its prediction."""

    log_likelihood: Array
    """Log-density of the measurement as it was predicted, in nats, ``(N,)``; NaN where nothing was received."""
    nis: Array = None
    """Normalised innovation squared, ``(N,)``; None where it is not known."""
    nis_degrees: Array = None
    """Degrees of freedom of the NIS, ``(N,)``; None where they are not known."""

    @classmethod
    def of(cls, values: Any) -> "Likelihood":
        """Return a likelihood from its values, or from a log-likelihood alone."""
        return cls(*values) if isinstance(values, tuple) else cls(values)

    @classmethod
    def unknown(cls, like: Array) -> "Likelihood":
        """Return a likelihood of NaN, in the shape of an array ``(N,)``."""
        return cls(None).fill_unknown(like)

    @classmethod
    def of_records(cls, records: Mapping[str, Array]) -> "Likelihood":
        """Return the likelihood in the records of a filter, see :meth:`Filter.records`; None for missing parts."""
        return cls(*(records.get(name) for name in cls._fields))

    def fill_unknown(self, like: Array) -> "Likelihood":
        """Replace missing parts with NaN, in the shape of an array ``(N,)``."""
        none = math.nan + 0.0 * like
        return Likelihood(*(none if values is None else values for values in self))


class Stated(NamedTuple):
    """Estimate of a filter that does not always report all of it; the rest is NaN."""

    components: tuple[bool, ...]
    """Which components it estimates, ``(C,)``."""
    deviations: tuple[bool, ...]
    """Components whose errors it estimates, ``(C,)``."""


class EstimateState(NamedTuple):
    """State of a filter that remembers its estimate alone."""

    mean: Array
    covariance: Array
    likelihood: Likelihood


class Filter(ABC, Generic[TaskT, Measurement, State]):
    """A filter, batch last: arrays of N episodes are ``(..., N)``. Policies have the batch first.

    Args:
        task: the estimation problem, with the constants that world and filter share.
    """

    knows: str = ""
    """Information that no competitor receives, in words; empty for a competitor."""
    kind: str = "estimator"
    """Kind of competitor."""
    in_python: bool = False
    """Whether it runs as Python code on every backend, since it cannot be traced."""
    adapts_covariance: bool = False
    """Whether the covariance that is reported grows with the innovations."""
    stated: Stated | None = None
    """Parts of the estimate that it reports; None: mean and covariance of all components at every measurement."""
    least_interval: ClassVar[float] = 0.0
    """Share of the sampling interval from which on its gains are good for the time between two measurements."""

    def __init__(self, task: TaskT) -> None:
        self.task = task
        self.parameters: Any = task.parameters  # type: ignore[attr-defined]
        self.xp: ModuleType = task.xp  # type: ignore[attr-defined]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Action space; here without a choice."""
        return gymnasium.spaces.Discrete(1)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of this state and the measurement, in order."""
        return ()

    @property
    def quantities(self) -> Sequence[Quantity]:
        """Further quantities that a policy can read from an observation."""
        return ()

    @abstractmethod
    def start(self, initial: Any) -> State:
        """Return the state at the start of the track from the initial estimate, an :class:`Initial` of the task."""

    def initialise(self, given: FilterInput) -> State:
        """Return the state at the start of the track from the whole input; its measurement is the initial estimate."""
        return self.start(given.measurement)

    def predict(self, state: State, measurement: Measurement) -> State:
        """Step 2: predict to the time of a measurement and compare with it; by default return the state unchanged."""
        return state

    @abstractmethod
    def update(self, state: State, given: FilterInput) -> State:
        """Step 4: update with the measurement that was predicted.

        Args:
            state: after :meth:`predict`.
            given: the same measurement, and the further input of this filter.
        """

    def step(self, state: State, given: FilterInput) -> State:
        """Predict to a measurement and update with it, without an action in between."""
        return self.update(self.predict(state, given.measurement), given)

    def mean(self, state: State) -> Array:
        """Return the estimate of the task's components, after :meth:`update`, ``(C, N)``; by default the state's
        ``mean``.
        """
        mean: Array = state.mean  # type: ignore[attr-defined]
        return mean

    def covariance(self, state: State) -> Array:
        """Return the covariance that is reported for it, ``(C, C, N)``; by default the state's ``covariance``."""
        covariance: Array = state.covariance  # type: ignore[attr-defined]
        return covariance

    def feedback(self, state: State, measurement: Any) -> Any:
        """Return a feedback to the world that does not follow from the estimate; by default None, where it does, see
        :meth:`.Task.feedback`.

        Args:
            state: after :meth:`start` or :meth:`update`.
            measurement: of the last update, or the initial estimate.
        """
        return None

    def records(self, state: State, measurement: Measurement) -> dict[str, Array]:
        """Return further records of each measurement, for an evaluation: arrays ``(N,)``, or ``(M, N)`` for
        ``mode_probability``.

        The quality of the prediction is reported by ``log_likelihood`` (log-density of the measurement as it was
        predicted, NaN where nothing was received), ``nis``, the normalised innovation squared, and ``nis_degrees``, its
        dimension. By default those of the state's ``likelihood``, if it has one.
        """
        likelihood = getattr(state, "likelihood", None)
        return {} if likelihood is None else likelihood._asdict()


class Bank(Filter[TaskT, Measurement, State]):
    """A filter that an action steers: the filters of a task under one control.

    Args:
        task: the estimation problem.
        control: name under which the task offers this bank; several may share one class.
    """

    def __init__(self, task: TaskT, control: str) -> None:
        super().__init__(task)
        self.control = control

    @property
    @abstractmethod
    def action_space(self) -> gymnasium.Space[Any]:
        """Action space."""

    @property
    @abstractmethod
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of this state and the measurement, in order."""

    @abstractmethod
    def predict(self, state: State, measurement: Measurement) -> State:
        """Step 2: predict to the time of a measurement and compare with it."""

    @abstractmethod
    def act(self, state: State, measurement: Measurement, action: Array) -> State:
        """Step 4: apply the action to the measurement.

        Args:
            state: after :meth:`predict`.
            measurement: the same.
            action: ``(A, N)`` floats for a box, ``(N,)`` integers for a discrete space.
        """

    def update(self, state: State, given: FilterInput) -> State:
        """Apply the action of the input."""
        return self.act(state, given.measurement, given.action)
