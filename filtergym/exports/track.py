"""A filter that runs in somebody's own loop: what stands around its equations in a file of its own.

Its text goes into the files that :mod:`.python_source` writes.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

Array = Any


LANES = 8
"""Arrays are filled up to a multiple of this width: matrix products round by their shape, and a track is to be what it
is in any company."""


class Estimate(NamedTuple):
    """What a filter says after a measurement."""

    mean: Array
    """Of the components, ``(C,)``; ``(C, N)`` of N tracks."""
    covariance: Array
    """That the filter reports for it, ``(C, C)`` or ``(C, C, N)``."""
    statistics: Mapping[str, Array]
    """How well the measurement was predicted, and what else the filter reports: ``log_likelihood`` (nats, NaN where
    nothing was received), ``nis``, the normalised innovation squared, of ``nis_degrees`` numbers."""
    components: Sequence[tuple[str, str]]
    """Name and unit of each component."""

    def named(self) -> dict[str, Array]:
        """Return the mean of every component by its name."""
        return {name: value for (name, _), value in zip(self.components, self.mean, strict=True)}


class Track:
    """One track, or several side by side.

    Args:
        filter: the equations, for any number of tracks.
        components: name and unit of each component that is estimated.
        shapes: of what the filter is given, by name: type of its numbers, and shape for one track.
    """

    def __init__(
        self,
        filter: Any,
        components: Sequence[tuple[str, str]],
        shapes: Mapping[str, tuple[str, tuple[int, ...]]],
    ) -> None:
        self.filter, self.components, self.shapes = filter, components, shapes
        self.single, self.count = True, 1
        self.lanes = numpy.zeros(LANES, dtype=int)
        """Track of each lane; those beyond the tracks repeat the last."""
        self.memory: Any = None
        """All that later estimates depend on: keep it to go back to this measurement, pickle it to go on elsewhere."""

    def arrays(self, **given: Any) -> dict[str, Array]:
        """Return what is given as arrays with a last axis of lanes.

        Raises:
            ValueError: for an array of another shape.
        """
        found = {}
        for name, value in given.items():
            dtype, shape = self.shapes[name]
            array = numpy.asarray(value, dtype=dtype)
            expected = shape if self.single else (*shape, self.count)
            if array.shape != expected:
                raise ValueError(f"{name} must have shape {expected}, got {array.shape}")
            found[name] = (array[..., None] if self.single else array)[..., self.lanes]
        return found

    def count_tracks(self, mean: Any) -> None:
        """Learn from the first mean how many tracks there are."""
        self.single = numpy.ndim(mean) == 1
        self.count = 1 if self.single else numpy.shape(mean)[-1]
        width = -(-self.count // LANES) * LANES
        self.lanes = numpy.minimum(numpy.arange(width), self.count - 1)

    def estimate(self, mean: Array, covariance: Array, statistics: Mapping[str, Array]) -> Estimate:
        """Return an estimate, of one track without their axis."""
        lane: Any = (..., 0) if self.single else (..., slice(self.count))
        said = {name: values[lane] for name, values in statistics.items()}
        return Estimate(mean[lane].copy(), covariance[lane].copy(), said, self.components)


class NotReceived:
    """Puts NaN in place of the values of a measurement that were not received, where it is not ``available``.

    Args:
        field: with these values; empty where all are always received.
    """

    def __init__(self, field: str) -> None:
        self.field = field

    def __call__(self, measurement: Any) -> Any:
        """Return the measurement as an estimator takes it."""
        if not self.field:
            return measurement
        values = getattr(measurement, self.field)
        return measurement._replace(
            **{self.field: numpy.where(measurement.available > 0.0, values, numpy.nan)}
        )


class EstimatorTrack(Track):
    """An estimator.

    Args:
        filter: with ``start`` and ``update``.
        components: as of :class:`Track`, likewise what follows.
        shapes: likewise.
        mask: puts NaN in place of what was not received.
    """

    def __init__(self, filter: Any, components: Any, shapes: Any, mask: Any) -> None:
        super().__init__(filter, components, shapes)
        self.mask = mask

    def start_track(self, initial: Any) -> None:
        """Start at an initial estimate."""
        self.memory = self.filter.start(initial, len(self.lanes))

    def update_track(self, measurement: Any) -> Estimate:
        """Predict to a measurement and take it in."""
        mean, covariance, self.memory, *reported = self.filter.update(self.mask(measurement), self.memory)
        likelihood = reported[0] if reported else {}
        if not isinstance(likelihood, dict):
            names = getattr(likelihood, "_fields", ("log_likelihood",))
            values = likelihood if isinstance(likelihood, tuple) else (likelihood,)
            likelihood = {n: v for n, v in zip(names, values, strict=True) if v is not None}
        return self.estimate(mean, covariance, likelihood)


class ConstantTrack(Track):
    """A bank of filters under an action that never changes.

    Args:
        filter: the bank.
        components: as of :class:`Track`, likewise what follows.
        shapes: likewise.
        action: numbers ``(A,)``, or that of a hypothesis.
    """

    def __init__(self, filter: Any, components: Any, shapes: Any, action: Any) -> None:
        super().__init__(filter, components, shapes)
        self.action = numpy.asarray(action)

    def start_track(self, initial: Any) -> None:
        """Start at an initial estimate."""
        self.memory = self.filter.start(initial)

    def update_track(self, measurement: Any) -> Estimate:
        """Predict to a measurement and take it in."""
        state = self.filter.predict(self.memory, measurement)
        action = numpy.repeat(self.action[..., None], len(self.lanes), axis=-1)
        self.memory = state = self.filter.act(state, measurement, action)
        said = self.filter.records(state, measurement)
        return self.estimate(self.filter.mean(state), self.filter.covariance(state), said)


class SteeredMemory(NamedTuple):
    """What a bank with its policy remembers."""

    state: Any
    """Of the bank."""
    policy: Any
    """Of the policy; None before its first decision."""
    action: Any
    """In force, as the bank takes it."""
    measurements: int
    """So far."""
    total: Any
    """Sum of what was shown since the last decision, of the fields that are shown as a mean."""


class SteeredTrack(Track):
    """A bank of filters that a policy steers by what it observes.

    Args:
        filter: the bank.
        components: as of :class:`Track`, likewise what follows.
        shapes: likewise.
        observation: what the policy is shown.
        policy: chooses an action by ``predict``.
        decision_interval: measurements for which an action holds.
    """

    def __init__(
        self, filter: Any, components: Any, shapes: Any, observation: Any, policy: Any, decision_interval: int
    ) -> None:
        super().__init__(filter, components, shapes)
        self.policy, self.observation, self.decision_interval = policy, observation, decision_interval
        fields = enumerate(observation.fields)
        self.averaged = [i for i, field in fields if field.over_interval == "mean" and decision_interval > 1]

    def start_track(self, initial: Any) -> None:
        """Start at an initial estimate."""
        self.memory = SteeredMemory(self.filter.start(initial), None, None, 0, 0.0)

    def update_track(self, measurement: Any) -> Estimate:
        """Predict to a measurement, show the policy what comes of it, and take the measurement in by its action."""
        before = self.memory
        state = self.filter.predict(before.state, measurement)
        shown = self.observation.observe(state, measurement)
        policy, action, number = before.policy, before.action, before.measurements
        total = before.total + shown[self.averaged] if number else 0.0
        if number % self.decision_interval == 0:
            if self.averaged and number:
                shown = shown.copy()
                shown[self.averaged] = total / self.decision_interval
            start = numpy.full(len(self.lanes), number == 0)
            chosen, policy = self.policy.predict(numpy.ascontiguousarray(shown.T), policy, start)
            # In double: arithmetic with constants would stay in a network's precision.
            action = chosen if chosen.ndim == 1 else chosen.T.astype(numpy.float64)
            total = 0.0
        state = self.filter.act(state, measurement, action)
        self.memory = SteeredMemory(state, policy, action, number + 1, total)
        said = self.filter.records(state, measurement)
        return self.estimate(self.filter.mean(state), self.filter.covariance(state), said)
