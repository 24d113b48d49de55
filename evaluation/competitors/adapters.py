"""Adapters that run an estimator of a single track for many episodes in parallel.

One estimator object for each episode is updated in turn, which is slow. An estimator in a separate process
can also import this module (:data:`.isolation.SHARED`), so it imports nothing else of the package.
"""

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy

if TYPE_CHECKING:
    from ...envs.contract.task import Task

Array = Any
"""A NumPy array."""


def select_lanes(part: Any, lanes: numpy.ndarray | int) -> Any:
    """Return lanes (entries of the last axis) of nested arrays, as copies; an integer removes the axis."""
    if part is None:
        return None
    if isinstance(part, dict):
        return {name: select_lanes(item, lanes) for name, item in part.items()}
    if isinstance(part, tuple):
        parts = [select_lanes(item, lanes) for item in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return part[..., lanes]


def takes_problem(maker: Any) -> bool:
    """Return whether a maker takes the task or model: a first argument without default, or so named."""
    try:
        first = next(iter(inspect.signature(maker).parameters.values()), None)
    except ValueError:  # for a compiled class
        return True
    return first is not None and (first.default is first.empty or first.name in ("task", "model"))


READINGS = ("z", "zk", "y", "meas", "measurement", "obs", "observation")
"""Usual names of the first argument of ``update`` in filters of a single track whose state is in the object."""


def check_update_order(estimator: Any) -> None:
    """Raise ValueError if an estimator's ``update`` takes the memory after the measurement, or no memory."""
    try:
        names = [name for name in inspect.signature(estimator.update).parameters if name != "self"]
    except (AttributeError, TypeError, ValueError):  # without one, or compiled
        return
    if "memory" in names[1:]:
        raise ValueError(
            f"update takes the memory first, as update({', '.join(['memory', *(n for n in names if n != 'memory')])}), "
            f"but this one is update({', '.join(names)}): change the order of its arguments"
        )
    if names and names[0].lower() in READINGS:
        raise ValueError(
            f"update({', '.join(names)}) is of a single-track filter, but N tracks run side by side: put "
            "it behind filtergym.adapters.SingleTrackEstimator, whose begin(initial), step(track, measurement) and "
            "estimate(track) call yours (docs/adapters.md)"
        )


class SingleTrackEstimator(ABC):
    """Base class of estimators of a single track; it runs one track object for each episode.

    Subclasses define :meth:`begin`, :meth:`step` and :meth:`estimate`. They may change a track in place, and
    must seed random numbers for each track.

    Raises:
        ValueError: if ``state`` lacks a component of the task.
    """

    kind: ClassVar[Literal["estimator"]] = "estimator"
    state: Sequence[str] = ()
    """Names of the components of the estimator's state vector, in its order: those of the task in any order, and any
    others. Default: the task's components.
    """

    def __init__(self, task: "Task") -> None:
        self.task = task
        components = [component.name for component in task.components]
        self.state = tuple(self.state) or tuple(components)
        missing = [name for name in components if name not in self.state]
        if missing:
            raise ValueError(
                f"the state of {type(self).__name__}, {', '.join(self.state)}, lacks {', '.join(missing)} of "
                f"{task.id}: `state` names its numbers in their order"
            )
        self._places = [self.state.index(name) for name in components]

    @abstractmethod
    def begin(self, initial: Any) -> Any:
        """Return a track object, such as a filter, at the initial estimate of one track.

        Args:
            initial: initial estimate of the track, without the axis of episodes; ``mean`` ``(n,)`` and ``covariance``
                ``(n, n)`` are those of ``state``, zero for numbers that are no component of the task.
        """

    @abstractmethod
    def step(self, track: Any, measurement: Any) -> Any:
        """Predict a track to the time of a measurement and update it with the measurement.

        Args:
            track: the track object that :meth:`begin` or the last call returned.
            measurement: the task's ``Measurement``, without the axis of episodes.

        Returns:
            The track, or None if it was changed in place.
        """

    @abstractmethod
    def estimate(self, track: Any) -> tuple[Array, Array]:
        """Return mean ``(n,)`` and covariance ``(n, n)`` of a track, in the order of ``state``."""

    def reading(self, measurement: Any) -> tuple[Array, Array]:
        """Return the measured vector, ``(m,)``, or None if it was not received, and its noise covariance,
        ``(m, m)``.

        It must be a linear function of the state. By default it is the position, for tasks whose measurement
        has ``position`` and ``variance``.
        """
        if not hasattr(measurement, "position") or not hasattr(measurement, "variance"):
            raise ValueError(
                f"{self.task.id} measures {', '.join(measurement._fields)}: {type(self).__name__} must define a method "
                "`reading` or `step` for it"
            )
        missed = getattr(measurement, "available", 1.0) == 0.0
        return None if missed else measurement.position, numpy.diag(measurement.variance)

    def start(self, initial: Any, N: int) -> list[Any]:
        """Return a list of N track objects, one for each episode."""
        tracks = []
        for lane in range(N):
            own = select_lanes(initial, lane)
            mean, covariance = numpy.zeros(len(self.state)), numpy.zeros((len(self.state),) * 2)
            mean[self._places] = own.mean
            covariance[numpy.ix_(self._places, self._places)] = own.covariance
            tracks.append(self.begin(own._replace(mean=mean, covariance=covariance)))
            self._components(tracks[-1])
        return tracks

    def update(self, memory: list[Any], measurement: Any) -> tuple[Array, Array, list[Any]]:
        """Update every track with its measurement; return means ``(C, N)``, covariances ``(C, C, N)`` and the
        tracks.
        """
        tracks, estimates = [], []
        for lane, track in enumerate(memory):
            moved = self.step(track, select_lanes(measurement, lane))
            tracks.append(track if moved is None else moved)
            estimates.append(self._components(tracks[-1]))
        means, covariances = zip(*estimates, strict=True)
        return numpy.stack(means, axis=-1), numpy.stack(covariances, axis=-1), tracks

    def _components(self, track: Any) -> tuple[numpy.ndarray, numpy.ndarray]:
        mean, covariance = (numpy.asarray(part, dtype=float) for part in self.estimate(track))
        n = len(self.state)
        if mean.size != n or covariance.shape != (n, n):
            raise ValueError(
                f"the state of {type(self).__name__} has {mean.size} numbers and a covariance of shape "
                f"{covariance.shape}, but `state` names {n}: {', '.join(self.state)}"
            )
        return mean.reshape(-1)[self._places], covariance[numpy.ix_(self._places, self._places)]


class FilterpyEstimator(SingleTrackEstimator):
    """Base class of estimators by a filter of filterpy: Kalman, extended, unscented or IMM.

    Subclasses return in :meth:`begin` a filter with ``x`` and ``P`` set to the initial estimate, also in each filter of
    an IMMEstimator. For measurements at irregular times they define :meth:`predict`. Where an update needs more than
    :meth:`reading` and the filter's H, as with a control or in an ExtendedKalmanFilter, they define :meth:`step`.
    """

    def step(self, track: Any, measurement: Any) -> None:
        """Predict a filterpy filter and update it with the measurement, if one was received."""
        z, R = self.reading(measurement)
        self.predict(track, getattr(measurement, "interval", None))
        for model in getattr(track, "filters", [track]):
            model.R = R
        if z is not None:
            track.update(z)
        elif hasattr(track, "filters"):
            # filterpy stores the predicted probabilities of its modes only in an update.
            track.mu = track.cbar.copy()
            track._compute_mixing_probabilities()
            track._compute_state_estimate()

    def predict(self, track: Any, interval: float | None) -> None:
        """Predict a filter to the time of a measurement; by default over the constant ``sampling_interval``.

        Args:
            track: filter of filterpy.
            interval: time since the previous measurement, s; None where the measurement does not contain it.

        Raises:
            ValueError: for another interval: a subclass must set F and Q for it, or ``dt`` of an unscented filter.
        """
        usual = getattr(self.task.parameters, "sampling_interval", None)
        if interval is not None and usual is not None and not math.isclose(interval, usual, rel_tol=1e-9):
            raise ValueError(
                f"{type(self).__name__} predicts over {usual:g} s, and a measurement comes after {interval:g} s: it "
                "must define a method `predict(track, interval)` for that"
            )
        track.predict()

    def estimate(self, track: Any) -> tuple[Array, Array]:
        """Return mean ``x`` and covariance ``P`` of a filterpy filter."""
        return track.x, track.P
