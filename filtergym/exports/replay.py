"""Test vectors of an exported filter: measurements of episodes, and the estimates of the Python competitor."""

import collections
import copy
import functools
import math
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ..compiler.functions import address_of, empty_lanes, leaves, round_up_lanes
from ..compiler.interpretation import first_steps, in_range, interpret
from ..compiler.library import portable_library
from ..compiler.native import AVAILABLE, native
from ..compiler.program import StraightLineProgram
from ..envs.contract.model import Episode, Model
from ..envs.engine.backend import make_model
from ..evaluation.competitors.kinds import kind_of
from ..evaluation.running.evaluate import control_of
from ..evaluation.running.rollout import rollout, start_lanes
from ..evaluation.running.seeds import episode_seeds
from .request import ExportRequest
from .traced_filter import (
    ANSWER,
    DERIVED,
    INITIAL,
    MEASUREMENT,
    SHOWN,
    STATE,
    TracedFilter,
    trace_filter,
)

if TYPE_CHECKING:
    from ..agents.learned_policy import LearnedPolicy


class Replay(NamedTuple):
    """Test vectors: initial estimates and measurements of E episodes, and the competitor's estimates in Python."""

    initial: numpy.ndarray
    """Initial estimate, ``(rows, E)``."""
    measurements: numpy.ndarray
    """Measurements, ``(T, rows, E)``."""
    mean: numpy.ndarray
    """Mean of the competitor, ``(T, C, E)``."""
    covariance: numpy.ndarray
    """Covariance of the competitor, ``(T, C, C, E)``."""
    components: list[tuple[str, str]]
    """Name and unit of the estimated components."""

    @property
    def sigma(self) -> numpy.ndarray:
        """Standard deviations that the competitor reports, ``(T, C, E)``."""
        variance = numpy.moveaxis(numpy.diagonal(self.covariance, axis1=1, axis2=2), -1, 1)
        return numpy.sqrt(numpy.maximum(variance, 0.0))

    def largest_difference(self, mean: numpy.ndarray) -> float:
        """Return the largest difference of means ``(T, C, E)`` to the competitor's, in standard deviations."""
        with numpy.errstate(all="ignore"):
            difference = numpy.abs(mean - self.mean) / self.sigma
        same = (mean == self.mean) | (numpy.isnan(mean) & numpy.isnan(self.mean))
        difference = numpy.where(same, 0.0, numpy.where(numpy.isnan(difference), math.inf, difference))
        return float(difference.max(initial=0.0))


def _report(model: Model, episode: Episode) -> dict[str, Any]:
    mean, covariance = model.mean(episode), model.covariance(episode)
    return {"measurement": episode.measurement, "mean": mean, "covariance": covariance}


def _report_estimator(model: Model, episode: Episode) -> dict[str, Any]:
    """Return an estimator's measurement, mean and covariance by name, and ``lost``, positive where it failed."""
    return {
        **_report(model, episode),
        "lost": model.filter.records(episode.filter, episode.measurement)["lost"],
    }


def _rows(part: Any, count: int) -> numpy.ndarray:
    """Return nested tuples of arrays ``(..., N)`` as one matrix ``(rows, count)`` of the first ``count`` lanes."""
    arrays = [numpy.asarray(array, dtype=float) for array in leaves(part)]
    return numpy.concatenate([array.reshape(-1, array.shape[-1])[:, :count] for array in arrays])


def replay(
    request: ExportRequest, episodes: int = 8, measurements: int | None = None
) -> tuple[TracedFilter, Replay]:
    """Trace a competitor, and run it over episodes of the test split; return traced filter and test vectors.

    Raises:
        ValueError: for a competitor that cannot be exported, or loses every episode.
    """
    problem, name, maker, scenario, keywords = request[:5]
    kind = kind_of(maker)
    control = control_of(maker, None, problem.task, name)
    given = {**getattr(maker, "task_keywords", {}), **keywords}
    plain = make_model(problem.task, control, scenario, **given)
    model = make_model(problem.task, control, scenario, backend="auto", **given)
    seeds = episode_seeds("test", 0, episodes)
    started: list[Any] = []
    start_lanes(plain, seeds, lambda episode: started.append(episode.measurement))
    kept: dict[str, list[numpy.ndarray]] = {"measurement": [], "mean": [], "covariance": []}
    # Competitors that cannot be exported fail before they run. Measurements have the same form for every control.
    first = start_lanes(plain, seeds[:1]).state.measurement
    known = problem.baselines.tunable
    traced = trace_filter(problem.task, control, maker, name, plain, (started[0], first), known)
    report = _report_estimator if kind == "estimator" else _report
    lost = numpy.zeros(episodes, dtype=bool)
    for found, _ in islice(rollout(model, maker, seeds, report, kind=kind, name=name), measurements):
        lost |= found.get("lost", numpy.zeros(episodes))[:episodes] > 0.0
        kept["measurement"].append(_rows(found["measurement"], episodes))
        kept["mean"].append(numpy.array(found["mean"][..., :episodes]))
        kept["covariance"].append(numpy.array(found["covariance"][..., :episodes]))
    if lost.all():
        raise ValueError(f"{name!r} lost every episode of the comparison: its estimates are not valid")
    measured, mean, covariance = (numpy.stack(values)[..., ~lost] for values in kept.values())
    components = [(component.name, component.unit) for component in plain.task.components]
    initial = _rows(started[0], episodes)[:, ~lost]
    return traced, Replay(initial, measured, mean, covariance, components)


class _Network:
    """The network of a filter in a replay, with its memory and its last output, computed in ``dtype``."""

    def __init__(self, network: "LearnedPolicy", dtype: Any) -> None:
        self.network = copy.copy(network)
        self.network.arrays = {name: values.astype(dtype) for name, values in network.arrays.items()}
        self.network.layers = [(weight.astype(dtype), bias.astype(dtype)) for weight, bias in network.layers]
        self.network.columns = slice(None)  # what it is shown is what it takes
        self.memory: Any = None
        self.answer: Any = None

    def __call__(self, shown: Any) -> None:
        """Compute and store the network's output, unless the first value, the flag of a decision, is zero."""
        flag, *rest = shown
        if not numpy.all(flag):
            return
        N = max(numpy.size(row) for row in rest)
        observation = numpy.stack([numpy.broadcast_to(row, (N,)) for row in rest], axis=1)
        fresh = numpy.full(N, self.memory is None)
        answer, self.memory = self.network.act(observation, self.memory, fresh)
        self.answer = numpy.atleast_2d(numpy.asarray(answer).T)


def run_filter(traced: TracedFilter, replayed: Replay, dtype: Any = numpy.float64) -> numpy.ndarray:
    """Run a traced filter over replayed measurements, and return the rows of its estimate, ``(T, rows, E)``.

    Compiled code runs in double where code can be compiled, with the C library's functions; NumPy otherwise.
    """
    E = replayed.initial.shape[1]
    compiled = AVAILABLE and dtype is numpy.float64
    network = None if traced.network is None else _Network(traced.network, dtype)
    own = list(in_range(numpy.array(traced.free.usual), dtype))
    derived = own[: traced.free.kept]
    given: dict[int, Any] = {
        INITIAL: replayed.initial,
        DERIVED: own,
        STATE: dict(enumerate(derived, len(traced.state) - len(derived))),
    }
    state = interpret(traced.start, lambda argument, row: given[argument][row], dtype) + derived
    update = _CompiledUpdate(traced, E) if compiled else functools.partial(_interpret_update, traced, dtype)
    answers = []
    for measured in replayed.measurements:
        found = update({STATE: state, MEASUREMENT: measured}, network)
        end = traced.shown + len(traced.state) - len(derived)
        state, rows = [*found[traced.shown : end], *derived], found[end:]
        answers.append(numpy.stack([numpy.broadcast_to(row, (E,)) for row in rows]).astype(float))
    return numpy.stack(answers)


def _network_rows(network: _Network | None) -> Any:
    """Return the rows of a network's last output; zeros before the first one."""
    if network is None or network.answer is None:
        return collections.defaultdict(float)
    return network.answer


def _interpret_update(
    traced: TracedFilter, dtype: Any, given: dict[int, Any], network: _Network | None
) -> list[numpy.ndarray]:

    def read(argument: int, row: int) -> Any:
        return (_network_rows(network) if argument == ANSWER else given[argument])[row]

    return interpret(traced.update, read, dtype, network, traced.shown)


class _CompiledUpdate:
    """The update of E traced filters as compiled code; a call returns the rows of the results."""

    def __init__(self, traced: TracedFilter, E: int) -> None:
        code, shown = traced.update, traced.shown
        self._whole, self._before = _Code(code, E), None
        if shown:  # the network's input is computed before its output, and once more with it
            first = first_steps(code, shown)
            steps, origins = code.steps[:first], code.origins[:first]
            self._before = _Code(StraightLineProgram(steps, code.constants, code.results[:shown], origins), E)

    def __call__(self, given: dict[int, Any], network: _Network | None) -> list[numpy.ndarray]:
        if network is not None and self._before is not None:
            network(self._before(given))
        return self._whole({**given, ANSWER: _network_rows(network)})


class _Code:
    def __init__(self, code: StraightLineProgram, E: int) -> None:
        self.E = E
        self._inputs = sorted({step.arguments for step in code.steps if step.operation == "input"})
        rows = {argument: 1 + row for argument, row in self._inputs}  # the last one counts
        width = round_up_lanes(E)
        self._arrays = [empty_lanes((rows.get(argument, 1),), width) for argument in range(SHOWN + 1)]
        results = [result._replace(argument=SHOWN + 1, row=i) for i, result in enumerate(code.results)]
        self._arrays.append(empty_lanes((max(len(results), 1),), width))
        self._constants, self._width = code.constants, width
        program = code._replace(results=results)
        self._run = native(program, [False] * len(self._arrays), portable_library()).expect(width)

    def __call__(self, given: dict[int, Any]) -> list[numpy.ndarray]:
        for argument, row in self._inputs:
            values = numpy.asarray(given[argument][row], dtype=float)
            self._arrays[argument][row] = values if values.ndim == 0 else values[0]
            self._arrays[argument][row, : self.E] = values
        table = [address_of(self._constants)]
        for array in self._arrays:
            table += [address_of(array), array.strides[0] // array.itemsize]
        self._run(address_of(numpy.array(table, dtype=numpy.int64)), 0, self._width)
        return list(self._arrays[-1][:, : self.E].copy())


def mean_rows(traced: TracedFilter) -> slice:
    """Return the rows of the estimate that are its mean."""
    return slice(0, sum(member.name == "mean" for member in traced.estimate))
