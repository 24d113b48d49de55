"""Estimators that are written for one episode, in the table beside those that take all of them at once.

One object an episode, each asked in turn: honest, and slow. An estimator in a process of its own has this module, too
(:data:`.isolation.SHARED`), so it imports nothing else of the package.
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
    """Return nested tuples and dictionaries of arrays with some entries of their last axis, each an array of its own,
    or with one entry, without that axis.
    """
    if part is None:
        return None
    if isinstance(part, dict):
        return {name: select_lanes(item, lanes) for name, item in part.items()}
    if isinstance(part, tuple):
        parts = [select_lanes(item, lanes) for item in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return part[..., lanes]


def takes_problem(maker: Any) -> bool:
    """Whether a class or function is given the problem: its first argument has no default, or is called so."""
    try:
        first = next(iter(inspect.signature(maker).parameters.values()), None)
    except ValueError:  # of a class that is compiled
        return True
    return first is not None and (first.default is first.empty or first.name in ("task", "model"))


READINGS = ("z", "zk", "y", "meas", "measurement", "obs", "observation")
"""Names of what the ``update`` of a filter of one track takes first; its own state is in the object."""


def check_update_order(found: Any) -> None:
    """Raise ValueError if the names of what ``update`` takes put the memory behind the measurement, or have none."""
    try:
        names = [name for name in inspect.signature(found.update).parameters if name != "self"]
    except (AttributeError, TypeError, ValueError):  # without one, or compiled
        return
    if "memory" in names[1:]:
        raise ValueError(
            f"update takes the memory first, as update({', '.join(['memory', *(n for n in names if n != 'memory')])}), "
            f"but this one is update({', '.join(names)}): change the order of its arguments"
        )
    if names and names[0].lower() in READINGS:
        raise ValueError(
            f"update({', '.join(names)}) is of a filter that knows one track, and here N tracks run side by side: put "
            "it behind filtergym.adapters.SingleTrackEstimator, whose begin(initial), step(track, measurement) and "
            "estimate(track) call yours (docs/adapters.md)"
        )


class SingleTrackEstimator(ABC):
    """Base of estimators that know one track only: an :class:`.Estimator` that keeps an object for each episode.

    Subclasses say how a track begins, what a measurement does to it and what it estimates. They may change a track
    in place. Those that draw numbers seed them for each track, so that an episode is the same in any company.

    Args:
        task: as ``self.task``; ``task.parameters`` holds every constant.

    Raises:
        ValueError: if ``state`` lacks a component of the task.
    """

    kind: ClassVar[Literal["estimator"]] = "estimator"
    state: Sequence[str] = ()
    """Names of the numbers of the estimator's state, in its order: the task's components in any order, and whatever
    else there is. Default: the task's components in theirs."""

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
        """Begin a track.

        Args:
            initial: the initial estimate, without the axis of episodes; ``mean`` ``(n,)`` and ``covariance``
                ``(n, n)`` are those of ``state``, zero for what is no component of the task.
        """

    @abstractmethod
    def step(self, track: Any, measurement: Any) -> Any:
        """Predict to the time of a measurement and take it in.

        Args:
            track: what :meth:`begin` or the last call returned.
            measurement: the task's ``Measurement``, without the axis of episodes.

        Returns:
            The track, or None if it was changed in place.
        """

    @abstractmethod
    def estimate(self, track: Any) -> tuple[Array, Array]:
        """Return the mean, n numbers, and covariance, ``(n, n)``, of ``state``."""

    def reading(self, measurement: Any) -> tuple[Array, Array]:
        """What is measured of a linear function of the state, ``(m,)`` or None, and its covariance, ``(m, m)``.

        Here the position, for tasks whose measurement has ``position`` and ``variance``; None where it is not
        ``available``.

        Raises:
            ValueError: if it has not.
        """
        if not hasattr(measurement, "position") or not hasattr(measurement, "variance"):
            raise ValueError(
                f"{self.task.id} measures {', '.join(measurement._fields)}: {type(self).__name__} must say by a method "
                "`reading` or `step` what that means"
            )
        missed = getattr(measurement, "available", 1.0) == 0.0
        return None if missed else measurement.position, numpy.diag(measurement.variance)

    def start(self, initial: Any, N: int) -> list[Any]:
        """Begin the tracks; see :meth:`.Estimator.start`."""
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
        """Ask every track in turn; see :meth:`.Estimator.update`."""
        tracks, estimates = [], []
        for lane, track in enumerate(memory):
            moved = self.step(track, select_lanes(measurement, lane))
            tracks.append(track if moved is None else moved)
            estimates.append(self._components(tracks[-1]))
        means, covariances = zip(*estimates, strict=True)
        return numpy.stack(means, axis=-1), numpy.stack(covariances, axis=-1), tracks

    def _components(self, track: Any) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Return the mean and covariance of the task's components."""
        mean, covariance = (numpy.asarray(part, dtype=float) for part in self.estimate(track))
        n = len(self.state)
        if mean.size != n or covariance.shape != (n, n):
            raise ValueError(
                f"the state of {type(self).__name__} has {mean.size} numbers and a covariance of shape "
                f"{covariance.shape}, but `state` names {n}: {', '.join(self.state)}"
            )
        return mean.reshape(-1)[self._places], covariance[numpy.ix_(self._places, self._places)]


class FilterpyEstimator(SingleTrackEstimator):
    """Filters of filterpy: KalmanFilter, ExtendedKalmanFilter, UnscentedKalmanFilter, IMMEstimator.

    Subclasses return in :meth:`begin` a filter whose ``x`` and ``P`` are at the start of the track, of an IMMEstimator
    those of each of its filters. Where measurements come at irregular times :meth:`predict` says what that means. Where
    a measurement is more than :meth:`reading` and the filter's H, such as
    with a control or in an ExtendedKalmanFilter, they define :meth:`step` in filterpy's own calls.
    """

    def step(self, track: Any, measurement: Any) -> None:
        """Predict, and update with the measurement and its covariance; without a measurement only predict."""
        z, R = self.reading(measurement)
        self.predict(track, getattr(measurement, "interval", None))
        for model in getattr(track, "filters", [track]):
            model.R = R
        if z is not None:
            track.update(z)
        elif hasattr(track, "filters"):
            # filterpy takes over the predicted probabilities of its modes in an update only.
            track.mu = track.cbar.copy()
            track._compute_mixing_probabilities()
            track._compute_state_estimate()

    def predict(self, track: Any, interval: float | None) -> None:
        """Predict to a measurement, here over ``sampling_interval``, which the filter's F and Q are for.

        Args:
            track: filter of filterpy.
            interval: s since the measurement before; None where the measurement does not say.

        Raises:
            ValueError: for another interval: a subclass sets F and Q for it first, or ``dt`` of an unscented filter.
        """
        usual = getattr(self.task.parameters, "sampling_interval", None)
        if interval is not None and usual is not None and not math.isclose(interval, usual, rel_tol=1e-9):
            raise ValueError(
                f"{type(self).__name__} predicts over {usual:g} s, and a measurement comes after {interval:g} s: it "
                "must say by a method `predict(track, interval)` what that means"
            )
        track.predict()

    def estimate(self, track: Any) -> tuple[Array, Array]:
        """``x`` and ``P``."""
        return track.x, track.P
