"""Evaluation of smoothers: a forward run as an estimator, then the smoothed estimates."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy

from ...compiler.functions import leaves, round_up_lanes
from ...envs.contract.failures import explain_errors
from ...envs.contract.filter import Filter, FilterInput, Likelihood
from ...envs.contract.model import Episode, Model
from ...envs.contract.observation import Array
from ...envs.contract.task import Task
from ...envs.engine.compiled import can_step
from ...envs.engine.lanes import Lanes, whole_episode
from ...envs.engine.programs import Report
from ...filters.array_namespace import map_nested
from ...filters.scans import TOGETHER, Scans, over_time, stack_scans
from .filters import AdaptedState, Checked, find_fault, is_lacking


class SmoothedTrack(Filter[Task, Any, int]):
    """Filter that replays the estimates of a smoother; its state is the number of measurements."""

    in_python = True

    def __init__(self, task: Task, means: numpy.ndarray, covariances: numpy.ndarray) -> None:
        super().__init__(task)
        self.means = means
        self.covariances = covariances
        count = means.shape[-1]
        self.lanes: numpy.ndarray = numpy.minimum(numpy.arange(round_up_lanes(count)), count - 1)
        """Index of the episode of each lane; further lanes repeat the last episode."""

    def start(self, initial: Any) -> int:
        """Return zero, the number of measurements so far."""
        return 0

    def update(self, state: int, inputs: FilterInput) -> int:
        """Return the number of measurements, increased by one."""
        return state + 1

    def mean(self, state: int) -> Array:
        """Return the smoothed mean at the last measurement, ``(C, N)``."""
        return self.means[:, state - 1, self.lanes]

    def covariance(self, state: int) -> Array:
        """Return the smoothed covariance at the last measurement, ``(C, C, N)``."""
        return self.covariances[:, :, state - 1, self.lanes]


def check_open_loop(model: Model, name: str) -> None:
    """Raise ValueError in a closed loop, where a model's estimates affect its later measurements."""
    if model.task.closes_loop:
        raise ValueError(
            f"{name} cannot run in {model.task.id}, a closed loop with these parameters, where the "
            "estimate determines later measurements: leave it out"
        )


def run_forward(model: Model, lanes: Lanes, length: int, name: str) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Run a smoother over episodes of one length; return means ``(C, K, N)`` and covariances
    ``(C, C, K, N)``.

    Raises:
        ValueError: if its estimates have other shapes.
    """
    run = _run_compiled if can_step(model, report_forward) else _step_forward
    measurements, memories = run(model, lanes, length)
    own = model.filter.own.own if model.filter.in_python else model.filter.own
    with explain_errors(f"smoother {name!r} failed after {length} measurements"):
        means, covariances = own.smooth(measurements, memories)
    C, N = len(model.task.components), lanes.count if run is _run_compiled else lanes.width
    return (
        _check_shape("means", means, (C, length, N), name),
        _check_shape("covariances", covariances, (C, C, length, N), name),
    )


def _step_forward(model: Model, lanes: Lanes, length: int) -> tuple[list[Any], list[Any]]:

    def memory_in(episode: Any) -> Any:
        return model.filter.own.memory if model.filter.in_python else episode.filter.own

    measurements: list[Any] = []
    memories = [memory_in(lanes.state)]
    action = numpy.zeros(lanes.count, dtype=numpy.int64)
    while len(measurements) < length:
        for episode, _ in lanes.decide(action, whole_episode):
            measurements.append(model.task.world.mask_missing(episode.measurement))
            memories.append(memory_in(episode))
    return measurements, memories


def report_forward(model: Model, episode: Episode) -> tuple[Any, Any]:
    """Return the measurement and the filter's memory, the inputs of ``smooth``."""
    return episode.measurement, episode.filter.own


def _run_compiled(model: Model, lanes: Lanes, length: int) -> tuple[Scans, Scans]:
    """Run a compiled smoother forward; return masked measurements and memories of all scans."""
    start = map_nested(lambda values: values[None, ..., : lanes.count], lanes.state.filter.own)
    measured: list[Any] = []
    memories = [start]
    for stretch in run_stretches(lanes, report_forward, length):
        # Copies without the padding lanes, which make the arrays of one episode eight times as long.
        measurement, memory = map_nested(lambda values: values[..., : lanes.count].copy(), stretch)
        masked = over_time(model.task.world.mask_missing, stack_scans(Scans(measurement)))
        measured.append(map_nested(lambda values: numpy.moveaxis(values, -2, 0), masked))
        memories.append(memory)
    return Scans(_join(measured)), Scans(_join(memories))


def run_stretches(lanes: Lanes, report: Report, length: int) -> Iterator[Any]:
    """Run compiled episodes; yield reports on successive stretches of measurements, ``(scans, ..., N)``."""
    together = max(1, TOGETHER // lanes.width)
    for first in range(0, length, together):
        yield lanes.run(report, measurements=min(together, length - first))[0]


def _join(stretches: Sequence[Any]) -> Any:
    return map_nested(lambda *arrays: numpy.concatenate(arrays), *stretches)


# --- reports on the smoothed track


def report_world(model: Model, episode: Episode) -> tuple[Any, Any]:
    """Return truth and measurement of an episode, which do not depend on the estimate."""
    return episode.truth, episode.measurement


def report_smoothed(
    model: Model, lanes: Lanes, track: SmoothedTrack, report: Report, length: int
) -> Iterator[dict[str, numpy.ndarray]]:
    """Yield reports on the smoothed estimates by stretches of measurements, arrays ``(scans, ..., N)`` by
    name.
    """
    start, none, first = lanes.state.filter, numpy.zeros(lanes.width), 0
    state = Checked(None, start.mean, start.covariance, none, none)
    for stretch in run_stretches(lanes, report_world, length):
        world = map_nested(lambda values: numpy.moveaxis(values, 0, -2), stretch)
        some = slice(first, first := first + len(leaves(stretch)[0]))
        estimates = track.means[:, some][..., track.lanes], track.covariances[:, :, some][..., track.lanes]
        checked = _check_estimates(model.task, state, world[1], *estimates)
        found = over_time(lambda episode: model.run(report, episode), Episode(world[0], world[1], checked))
        yield map_nested(lambda values: numpy.moveaxis(values, -2, 0), found)
        state = map_nested(lambda values: values[..., -1, :], checked)


def _check_estimates(
    task: Task, before: Checked, measurement: Any, means: numpy.ndarray, covariances: numpy.ndarray
) -> Checked:
    """Apply the checks of a :class:`.CheckedFilter` to many measurements at once; lost estimates change in
    place.
    """
    lacking = over_time(lambda some: is_lacking(task.world.mask_missing(some), numpy), measurement)
    missed = numpy.maximum.accumulate(numpy.where(lacking, 1.0, before.missed), axis=0)

    def fault_of(mean: Array, covariance: Array, missed: Array) -> Array:
        return find_fault(mean, covariance, 0.0 * missed, missed, numpy)

    fault = numpy.where(before.fault > 0.0, before.fault, over_time(fault_of, means, covariances, missed))
    # From its first fault on an episode is lost for that reason, and its last valid estimate is repeated.
    for lane in numpy.flatnonzero((fault > 0.0).any(axis=0)):
        first = numpy.argmax(fault[:, lane] > 0.0)
        fault[first:, lane] = fault[first, lane]
        for estimates, start in ((means, before.mean), (covariances, before.covariance)):
            last = estimates[..., first - 1, lane] if first else start[..., lane]
            estimates[..., first:, lane] = last[..., None]
    own = AdaptedState(means, covariances, None, Likelihood.unknown(fault))
    return Checked(own, means, covariances, fault, missed)


def _check_shape(word: str, values: Any, shape: Sequence[int], name: str) -> numpy.ndarray:
    array = numpy.asarray(values, dtype=numpy.float64)
    if array.shape != tuple(shape):
        raise ValueError(
            f"smoother {name!r}: the {word} must have shape {tuple(shape)}, components, measurements and episodes, "
            f"got {array.shape}"
        )
    return array
