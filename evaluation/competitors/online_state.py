"""Estimate of a running filter after a measurement, and the filter's complete state."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy

from ...envs.engine.programs import Report


class Watch(Protocol):
    """Functions that compare the inputs of a network with those of its training."""

    memory: Any
    """Memory of the inputs so far."""
    observe: Report | None
    """Function of model and episode that returns the inputs of an estimator's network, ``(fields, N)``; None: the
    network is a policy, whose inputs are the observations."""

    def look(self, observation: numpy.ndarray, start: numpy.ndarray) -> None:
        """Update the memory with inputs ``(N, fields)``; ``start`` where the track has just begun."""
        ...

    def describe(self) -> list[str]:
        """Return a description of unusual inputs for each track; empty where there are none."""
        ...


@dataclass(frozen=True)
class Estimate:
    """Estimate of a filter after a measurement; C components, and for N tracks side by side a last axis of N."""

    time: Any
    """Time, s."""
    names: tuple[str, ...]
    """Names of the components."""
    units: tuple[str, ...]
    """Units of the components."""
    mean: numpy.ndarray
    """Mean of the components, ``(C,)``."""
    covariance: numpy.ndarray
    """Covariance of the components, ``(C, C)``."""
    nis: Any = None
    """Normalised innovation squared of the measurement; NaN where none was received. This and the following are None
    where the filter does not report them."""
    nis_degrees: Any = None
    """Degrees of freedom of ``nis``: its mean, if the filter is consistent."""
    log_likelihood: Any = None
    """Log-density of the measurement under its prediction, nats."""
    mode_probability: Any = None
    """Probabilities of the hypotheses, ``(M,)``."""
    lost: Any = ""
    """Reason why an estimator's track is lost; a list for several tracks."""
    departure: Any = ""
    """Difference of a network's inputs from those of its training; a list for several tracks."""

    @property
    def sigma(self) -> numpy.ndarray:
        """Standard deviations that the filter reports, ``(C,)``."""
        return numpy.sqrt(numpy.einsum("ii...->i...", self.covariance))

    def __getitem__(self, name: str) -> Any:
        """Return the mean of a component, by its name."""
        return self.mean[self.names.index(name)]

    def __str__(self) -> str:
        if self.mean.ndim > 1:
            return f"<Estimate of {self.mean.shape[1]} tracks: {', '.join(self.names)}>"
        each = zip(self.names, self.mean, self.sigma, self.units, strict=True)
        return ", ".join(f"{name} {mean:.6g} ± {sigma:.2g} {unit}" for name, mean, sigma, unit in each)


class Taken(NamedTuple):
    """A measurement that the filter has processed."""

    time: numpy.ndarray
    """Time, s, ``(N,)``."""
    values: Mapping[str, Any]
    """Values of the sensors."""
    before: "OnlineState"
    """State before the measurement, without a history."""


@dataclass(frozen=True)
class History:
    """The last measurements in the order of their times. Nothing in it ever changes, so that copies share it."""

    taken: tuple[Taken, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> "History":
        return self


class OnlineState(NamedTuple):
    """Complete state of a running filter; it can be pickled.

    ``owner`` identifies the filter: environment and its interface, filter, tracks, version of the package.
    """

    filter: Any
    """State of the filter, arrays ``(..., N)``."""
    input: Any
    """Memory of the measurements before: ``time`` and other values."""
    policy: Any = None
    """Memory of a policy."""
    fresh: numpy.ndarray | None = None
    """True for tracks that have just begun, for the policy, ``(N,)``."""
    measurements: int = 0
    """Number of measurements so far."""
    action: Any = None
    """Action in force, where one holds for several measurements."""
    total: Any = 0.0
    """Sums since the last decision of the fields observed as means."""
    python: Any = None
    """Memory of an estimator that runs in Python."""
    watch: Any = None
    """Memory of the watch."""
    owner: tuple[str, ...] = ()
    """Identity of the filter; no other filter accepts the state."""
    history: History = History()
    """Measurements that must be processed again after a late one, for a filter with a lag."""
    too_late: int = 0
    """Number of measurements so far that were older than the history."""
