"""A smoother in the loop: run forward like an estimator, then asked again with all that it has kept."""

from collections.abc import Sequence
from typing import Any

import numpy

from ...compiler.functions import map_arrays
from ...envs.contract.failures import explain_errors
from ...envs.contract.filter import Filter, FilterInput
from ...envs.contract.model import Episode, Model
from ...envs.contract.observation import Array
from ...envs.contract.task import Task
from ...envs.engine.compiled import can_step
from ...envs.engine.lanes import Lanes, whole_episode


class SmoothedTrack(Filter[Task, Any, int]):
    """An estimator that answers what a smoother has found before; its state counts the measurements.

    Args:
        task: the estimation problem.
        means: ``(C, K, N)``.
        covariances: ``(C, C, K, N)``.
    """

    in_python = True

    def __init__(self, task: Task, means: numpy.ndarray, covariances: numpy.ndarray) -> None:
        super().__init__(task)
        self.means, self.covariances = means, covariances

    def start(self, initial: Any) -> int:
        """Nothing is measured yet."""
        return 0

    def update(self, state: int, given: FilterInput) -> int:
        """Count the measurement."""
        return state + 1

    def mean(self, state: int) -> Array:
        """What was found at the last measurement."""
        return self.means[:, state - 1]

    def covariance(self, state: int) -> Array:
        """Likewise."""
        return self.covariances[:, :, state - 1]


def check_open_loop(model: Model, name: str) -> None:
    """Raise ValueError if the estimate decides what is measured next: then there is nothing to be smoothed, or to be
    answered from a file.

    Args:
        model: in which a smoother, or what answers from a file, is to run.
        name: what it is, and its name.
    """
    if model.task.closes_loop:
        raise ValueError(
            f"{name} cannot run in {model.task.id}, a closed loop with these parameters, in which the "
            "estimate steers what is measured later: leave it out"
        )


def run_forward(looped: Model, lanes: Lanes, length: int, name: str) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Run a smoother forward over episodes, then let it smooth them.

    Args:
        looped: model whose filter it is.
        lanes: its episodes, with their first measurement made.
        length: measurements of each of them.
        name: of the smoother, in errors.

    Returns:
        Means ``(C, K, N)`` and covariances ``(C, C, K, N)`` of K measurements.

    Raises:
        ValueError: if what it returns has other shapes.
    """
    run = _run_compiled if can_step(looped, report_forward) else _step_forward
    measurements, memories = run(looped, lanes, length)
    own = looped.filter.own.own if looped.filter.in_python else looped.filter.own
    with explain_errors(f"smoother {name!r} failed after {length} measurements"):
        means, covariances = own.smooth(measurements, memories)
    C = len(looped.task.components)
    return (
        _check_shape("means", means, (C, length, lanes.width), name),
        _check_shape("covariances", covariances, (C, C, length, lanes.width), name),
    )


def _step_forward(looped: Model, lanes: Lanes, length: int) -> tuple[list[Any], list[Any]]:
    """Measurements and memories of a smoother that is stepped."""

    def memory_in(episode: Any) -> Any:
        return looped.filter.own.memory if looped.filter.in_python else episode.filter.own

    measurements: list[Any] = []
    memories = [memory_in(lanes.state)]
    action = numpy.zeros(lanes.count, dtype=numpy.int64)
    while len(measurements) < length:
        for episode, _ in lanes.decide(action, whole_episode):
            measurements.append(looped.task.world.mask_missing(episode.measurement))
            memories.append(memory_in(episode))
    return measurements, memories


def report_forward(model: Model, episode: Episode) -> tuple[Any, Any]:
    """Report what a smoother is given back."""
    return episode.measurement, episode.filter.own


def _run_compiled(looped: Model, lanes: Lanes, length: int) -> tuple[list[Any], list[Any]]:
    """The same of one that is compiled; its measurements are masked afterwards, as it is shown them."""
    first = lanes.state.filter.own
    kept, _ = lanes.run(report_forward, measurements=length)
    moments = [_moment(kept, k) for k in range(length)]
    measurements = [looped.task.world.mask_missing(measurement) for measurement, _ in moments]
    return measurements, [first, *(memory for _, memory in moments)]


def _moment(kept: Any, k: int) -> Any:
    """What was kept of a measurement, rows one after the other: by these matrix products round."""
    return map_arrays(lambda values: numpy.ascontiguousarray(values[k]), kept)


def _check_shape(word: str, values: Any, shape: Sequence[int], name: str) -> numpy.ndarray:
    array = numpy.asarray(values, dtype=numpy.float64)
    if array.shape != tuple(shape):
        raise ValueError(
            f"smoother {name!r}: the {word} must have shape {tuple(shape)}, components, measurements and episodes, "
            f"got {array.shape}"
        )
    return array
