"""Estimate, history and complete state of a filter in real-time use."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy

from ...envs.engine.programs import Report


class Watch(Protocol):
    """Protocol of a monitor that compares a network's inputs with those of its training."""

    memory: Any
    """Statistics of the inputs so far."""
    observe: Report | None
    """Function of model and episode that returns the inputs ``(fields, N)`` of an estimator's network; None: the
    network is a policy, and its inputs are the observations.
    """

    def look(self, observation: numpy.ndarray, start: numpy.ndarray) -> None:
        """Add a network's inputs ``(N, fields)`` to the statistics; ``start`` marks tracks that have just
        begun.
        """
        ...

    def describe(self) -> list[str]:
        """Return a description of each track's unusual inputs, empty for usual ones."""
        ...


@dataclass(frozen=True)
class Estimate:
    """Estimate of C components after a measurement; for N parallel tracks arrays have a last axis of N."""

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
    """Normalised innovation squared of the measurement; NaN where none was received. This and the next three are None
    if the filter does not report them.
    """
    nis_degrees: Any = None
    """Degrees of freedom of ``nis``: its mean for a consistent filter."""
    log_likelihood: Any = None
    """Log-density of the measurement under its prediction, nats."""
    mode_probability: Any = None
    """Probabilities of the hypotheses, ``(M,)``."""
    lost: Any = ""
    """Reason why a track is lost, as text, or empty; a list for several tracks."""
    departure: Any = ""
    """Description of a network's unusual inputs, or empty; a list for several tracks."""

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
    """A measurement that an online filter has processed, stored in order to repeat it after a late one."""

    time: numpy.ndarray
    """Time, s, ``(N,)``."""
    values: Mapping[str, Any]
    """Values of the sensors by name."""
    before: "OnlineState"
    """State before the measurement, without a history."""


@dataclass(frozen=True)
class History:
    """The last measurements of an online filter in the order of their times; immutable, so that copies share it."""

    taken: tuple[Taken, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> "History":
        return self


class OnlineState(NamedTuple):
    """Complete state of an online filter; it can be pickled."""

    filter: Any
    """State of the filter, arrays ``(..., N)``."""
    input: Any
    """Values of earlier measurements that the next one needs: ``time`` and others."""
    policy: Any = None
    """Memory of a policy."""
    fresh: numpy.ndarray | None = None
    """Mask of tracks that have just begun, for the policy, ``(N,)``."""
    measurements: int = 0
    """Number of measurements so far."""
    action: Any = None
    """Present action, where one applies to several measurements."""
    total: Any = 0.0
    """Sums since the last decision of the fields that are observed as means."""
    python: Any = None
    """Memory of an estimator that runs in Python."""
    watch: Any = None
    """Memory of the comparison of a network's inputs."""
    owner: tuple[str, ...] = ()
    """Identity of the filter; other filters reject the state."""
    history: History = History()
    """Measurements to process again after a late one, for a filter with a lag."""
    too_late: int = 0
    """Number of measurements so far that were older than the history."""
