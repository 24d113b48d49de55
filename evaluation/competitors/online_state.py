"""What a running filter says after a measurement, and all that it remembers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy

from ...envs.engine.programs import Report


class Watch(Protocol):
    """Compares what a network is shown with its training."""

    memory: Any
    """What it has seen so far."""
    observe: Report | None
    """Function of model and episode: what the network of an estimator is shown, ``(fields, N)``; None: the network is a
    policy, and is shown what policies are."""

    def look(self, observation: numpy.ndarray, start: numpy.ndarray) -> None:
        """Look at what is shown, ``(N, fields)``; ``start`` where the track has just begun."""
        ...

    def describe(self) -> list[str]:
        """Return what is unusual, in words, for each track; empty where nothing is."""
        ...


@dataclass(frozen=True)
class Estimate:
    """What a filter says after a measurement; C components, and for N tracks side by side a last axis of N."""

    time: Any
    """s."""
    names: tuple[str, ...]
    """Of the components."""
    units: tuple[str, ...]
    """Of the components."""
    mean: numpy.ndarray
    """``(C,)``."""
    covariance: numpy.ndarray
    """``(C, C)``."""
    nis: Any = None
    """Normalised innovation squared of the measurement; NaN where none was received, None where the filter does not
    say it; likewise what follows."""
    nis_degrees: Any = None
    """Numbers of the measurement that it counts: its mean, if the filter is consistent."""
    log_likelihood: Any = None
    """Log-density of the measurement as it was predicted, nats."""
    mode_probability: Any = None
    """Probabilities of the hypotheses, ``(M,)``."""
    lost: Any = ""
    """Why an estimator's answers are no estimates any more; a list for several tracks."""
    departure: Any = ""
    """What is unlike the training of a network inside; likewise."""

    @property
    def sigma(self) -> numpy.ndarray:
        """Standard deviations that the filter states, ``(C,)``."""
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
    """A measurement that was taken in."""

    time: numpy.ndarray
    """s, ``(N,)``."""
    values: Mapping[str, Any]
    """What the sensors said."""
    before: "OnlineState"
    """Without a history."""


@dataclass(frozen=True)
class History:
    """The last measurements in the order of their times. Nothing in it ever changes, so that copies share it."""

    taken: tuple[Taken, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> "History":
        return self


class OnlineState(NamedTuple):
    """All that a running filter remembers; it can be pickled.

    ``owner`` says whose it is: environment and its interface, filter, tracks, version of the package.
    """

    filter: Any
    """Of the filter, arrays ``(..., N)``."""
    input: Any
    """Of the measurements before: ``time`` and whatever else."""
    policy: Any = None
    """What a policy remembers."""
    fresh: numpy.ndarray | None = None
    """Which tracks have just begun, for the policy, ``(N,)``."""
    measurements: int = 0
    """So far."""
    action: Any = None
    """In force, where one holds for several measurements."""
    total: Any = 0.0
    """Sums of what is shown as a mean since the last decision."""
    python: Any = None
    """Memory of an estimator that runs in Python."""
    watch: Any = None
    """Memory of the watch."""
    owner: tuple[str, ...] = ()
    """Of which filter it is; no other goes on from it."""
    history: History = History()
    """Of a filter that takes late measurements, what these may have to be followed by again."""
    too_late: int = 0
    """Measurements so far that were older than the history."""
