"""Filters, and the likelihood that they report.

A **filter** starts at a given initial estimate, predicts to every measurement, updates with it, and reports mean and
covariance. Every competitor is a filter: a bank that a policy steers, an estimator of a user, a learned estimator, a
reference with additional information, a bound.

State and measurement are NamedTuples of arrays ``(..., N)``, which are never changed in place.
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
    """Covariance of the mean, ``(C, C, N)``."""


class FilterInput(NamedTuple):
    """Input of a filter at a measurement: the measurement, the truth for a reference, and the action."""

    measurement: Any
    truth: Any = None
    """The world's NamedTuple for a filter that ``knows`` something; else None."""
    action: Array = None
    """Action of a bank: ``(A, N)`` floats for a box, ``(N,)`` integers for a discrete space."""


class Likelihood(NamedTuple):
    """Likelihood of a measurement under its prediction: log-likelihood, NIS and its degrees of freedom."""

    log_likelihood: Array
    """Log-density of the measurement as it was predicted, in nats, ``(N,)``; NaN where nothing was received."""
    nis: Array = None
    """Normalised innovation squared, ``(N,)``; None where it is not known."""
    nis_degrees: Array = None
    """Degrees of freedom of the NIS, ``(N,)``; None where they are not known."""

    @classmethod
    def of(cls, values: Any) -> "Likelihood":
        """Return a :class:`Likelihood` from a tuple of its values, or from a log-likelihood alone."""
        return cls(*values) if isinstance(values, tuple) else cls(values)

    @classmethod
    def unknown(cls, like: Array) -> "Likelihood":
        """Return a :class:`Likelihood` of NaN in the shape of an array ``(N,)``."""
        return cls(None).fill_unknown(like)

    @classmethod
    def of_records(cls, records: Mapping[str, Array]) -> "Likelihood":
        """Return the :class:`Likelihood` contained in the records of a filter; missing values are None."""
        return cls(*(records.get(name) for name in cls._fields))

    def fill_unknown(self, like: Array) -> "Likelihood":
        """Return the likelihood with NaN ``(N,)`` in place of values that are None."""
        none = math.nan + 0.0 * like
        return Likelihood(*(none if values is None else values for values in self))


class ReportedParts(NamedTuple):
    """The parts of the estimate that a filter reports, if it does not report all of it; the rest is NaN."""

    components: tuple[bool, ...]
    """Whether it estimates each component, booleans ``(C,)``."""
    deviations: tuple[bool, ...]
    """Whether it reports the variance of each component, booleans ``(C,)``."""


class EstimateState(NamedTuple):
    """State of a filter that consists of estimate and likelihood alone."""

    mean: Array
    covariance: Array
    likelihood: Likelihood


class Filter(ABC, Generic[TaskT, Measurement, State]):
    """Base class of every filter. Arrays of N episodes are ``(..., N)``, whereas policies have the batch first."""

    knows: str = ""
    """Information that no competitor receives, in words; empty for a competitor."""
    kind: str = "estimator"
    """Kind of competitor, such as ``estimator``."""
    in_python: bool = False
    """Whether it runs as Python code on every backend, since it cannot be traced."""
    adapts_covariance: bool = False
    """Whether the reported covariance grows with the innovations."""
    stated: ReportedParts | None = None
    """Parts of the estimate that it reports; None: mean and covariance of all components at every measurement."""
    least_interval: ClassVar[float] = 0.0
    """Smallest interval between measurements, as a share of the sampling interval, for which its gains are valid."""

    def __init__(self, task: TaskT) -> None:
        self.task = task
        self.parameters: Any = task.parameters  # type: ignore[attr-defined]
        self.xp: ModuleType = task.xp  # type: ignore[attr-defined]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium space of the actions; here a single action, as a filter is not steered."""
        return gymnasium.spaces.Discrete(1)

    @property
    def blocks(self) -> Sequence[Block]:
        """Blocks of the agent's observation, computed from this filter's state and the measurement; by default none."""
        return ()

    @property
    def quantities(self) -> Sequence[Quantity]:
        """Further quantities that a policy can compute from an observation; by default none."""
        return ()

    @abstractmethod
    def start(self, initial: Any) -> State:
        """Return the filter's state at the start of the track, from the initial mean and covariance."""

    def initialise(self, inputs: FilterInput) -> State:
        """Return the filter's state at the start from a whole input, whose measurement is the initial estimate."""
        return self.start(inputs.measurement)

    def predict(self, state: State, measurement: Measurement) -> State:
        """Return the state predicted to the time of a measurement, with its innovation; by default unchanged."""
        return state

    @abstractmethod
    def update(self, state: State, inputs: FilterInput) -> State:
        """Return the predicted state updated with the measurement (step 4 of the clock).

        Args:
            state: after :meth:`predict`.
            inputs: the same measurement, the action, and what a reference knows of the truth.
        """

    def step(self, state: State, inputs: FilterInput) -> State:
        """Return the state predicted to the measurement of an input and updated with that input."""
        return self.update(self.predict(state, inputs.measurement), inputs)

    def mean(self, state: State) -> Array:
        """Return the mean of the task's components, ``(C, N)``; by default the state's ``mean``."""
        mean: Array = state.mean  # type: ignore[attr-defined]
        return mean

    def covariance(self, state: State) -> Array:
        """Return the reported covariance of the mean, ``(C, C, N)``; by default the state's ``covariance``."""
        covariance: Array = state.covariance  # type: ignore[attr-defined]
        return covariance

    def feedback(self, state: State, measurement: Any) -> Any:
        """Return the feedback to the world in a closed loop; None if :meth:`.Task.feedback` computes it."""
        return None

    def records(self, state: State, measurement: Measurement) -> dict[str, Array]:
        """Return further values to record at each measurement by name, ``(N,)``; ``mode_probability`` ``(M, N)``.

        The quality of the prediction is reported by ``log_likelihood`` (log-density of the measurement as it was
        predicted, NaN where nothing was received), ``nis``, the normalised innovation squared, and ``nis_degrees``, its
        dimension. By default those of the state's ``likelihood``, if it has one.
        """
        likelihood = getattr(state, "likelihood", None)
        return {} if likelihood is None else likelihood._asdict()


class Bank(Filter[TaskT, Measurement, State]):
    """Base class of filters, usually several in parallel, that an action of the agent steers.

    Args:
        control: name under which the task offers this bank; several may share one class.
    """

    def __init__(self, task: TaskT, control: str) -> None:
        super().__init__(task)
        self.control = control

    @property
    @abstractmethod
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium space of the actions that steer the filters."""

    @property
    @abstractmethod
    def blocks(self) -> Sequence[Block]:
        """Blocks of the agent's observation, computed from this bank's state and the measurement."""

    @abstractmethod
    def predict(self, state: State, measurement: Measurement) -> State:
        """Return the state predicted to the time of a measurement, with the innovations (step 2 of the clock)."""

    @abstractmethod
    def act(self, state: State, measurement: Measurement, action: Array) -> State:
        """Return the predicted state updated with the measurement as the action directs (step 4 of the clock).

        Args:
            state: after :meth:`predict`.
            measurement: the same.
            action: ``(A, N)`` floats for a box, ``(N,)`` integers for a discrete space.
        """

    def update(self, state: State, inputs: FilterInput) -> State:
        """Return the predicted state updated with the measurement and the action of the input."""
        return self.act(state, inputs.measurement, inputs.action)
