"""Compiled programs of a model: the four parts of a step, and the reports.

A step has four parts. They are separate, because scenarios differ in the world, controls in the action and callers in
the report. The long parts, world and filter, are compiled once for all of them.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler import namespace
from ...compiler.functions import CompiledFunction, Specialised, leaves
from ...compiler.namespace import NotTraceable
from ...compiler.program import Graph
from ..contract.draws import Draws
from ..contract.filter import Filter, FilterInput
from ..contract.model import Episode, Model
from ..contract.observation import Array

PROGRAM_CACHE_SIZE = 8
"""Number of tasks whose programs a process stores."""

Report = Callable[[Model, Episode], Any]
"""Function of a task and its episodes after the action: nested tuples or dictionaries of arrays."""


def _update(model: Model, truth: Any, state: Any, measurement: Any, action: Array) -> tuple[Any, Any]:
    """Return the filter's state after the update with a measurement, and its feedback to the world."""
    after = model.filter.update(state, FilterInput(measurement, truth, action))
    return after, model.feedback(after, measurement)


def _advance(model: Model, truth: Any, feedback: Any, noise: Array) -> tuple[Any, Any]:
    return model.task.world.advance(truth, noise, feedback)


def _predict(model: Model, state: Any, measurement: Any) -> tuple[Any, Array]:
    """Return the filter's state predicted to a measurement, and the agent's observation."""
    predicted = model.filter.predict(state, measurement)
    return predicted, model.observe(Episode(None, measurement, predicted))


def _predict_unseen(model: Model, state: Any, measurement: Any) -> Any:
    return model.filter.predict(state, measurement)


def begin_world(model: Model, uniforms: Array, normals: Array) -> tuple[Any, Any]:
    """Simulate the start of the track: return the truth and the initial estimate."""
    return model.task.world.begin(Draws(uniforms, model.task.xp), normals)


def start_filter(model: Model, initial: Any, truth: Any) -> tuple[Any, Any]:
    """Return the filter's state at the start of the track, and its feedback to the world."""
    state = model.filter.initialise(FilterInput(initial, truth))
    return state, model.feedback(state, initial)


class Parts(NamedTuple):
    """Compiled programs of the parts of a step, and an episode with their shapes."""

    update: Specialised
    advance: Specialised
    predict: Specialised
    episode: Episode
    """Episode after the measurement, with arrays of the right shapes."""


class _ComputedOnce:
    """Property that is computed once, without a lock, which a fork could leave locked in the child.

    ``functools.cached_property`` has such a lock before Python 3.12.
    """

    def __init__(self, compute: Callable[[Any], Any]) -> None:
        self.__doc__ = compute.__doc__
        self.compute = compute

    def __get__(self, holder: Any, owner: type) -> Any:
        found = holder.__dict__[self.compute.__name__] = self.compute(holder)
        return found


class Programs:
    """Compiled programs of a model's steps, shared by all models with the same parameters.

    Args:
        traced: the task on traced arrays.
        graph: graph of its constants.
        of_world: programs of the same task with another filter, whose world is shared.
    """

    def __init__(self, traced: Model, graph: Graph, of_world: "Programs | None" = None) -> None:
        self.traced = traced
        self.graph = graph
        self.refused: set[Any] = set()
        """Functions that could not be traced."""
        self._functions: dict[Any, CompiledFunction] = {}
        self._of_world = of_world or self
        self._with_filter: dict[Any, Programs] = {}
        self._kept: dict[Any, Any] = {}

    def with_filter(self, make: Callable[[Model], Filter[Any, Any, Any]]) -> "Programs":
        """Return the programs of the same task with another filter, from a cache."""
        if make not in self._with_filter:
            with namespace.tracing(self.graph):
                programs = Programs(self.traced.with_filter(make), self.graph, self._of_world)
            if not programs.traced.filter.in_python:
                _ = programs.later
            while len(self._with_filter) >= PROGRAM_CACHE_SIZE:
                self._with_filter.pop(next(iter(self._with_filter)))
            self._with_filter[make] = programs
        return self._with_filter[make]

    def keep(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the object with a key from the cache; if it is missing, make it and drop the oldest."""
        if key not in self._kept:
            made = make()
            while len(self._kept) >= PROGRAM_CACHE_SIZE:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = made
        return self._kept[key]

    def function(self, function: Callable[..., Any], **options: Any) -> CompiledFunction:
        """Return the compiled form of ``function(model, ...)``, from a cache."""
        if function not in self._functions:
            options = {"unchanged": 0, **options}
            self._functions[function] = CompiledFunction(
                functools.partial(function, self.traced), self.graph, **options
            )
        return self._functions[function]

    @_ComputedOnce
    def filter_update(self) -> CompiledFunction:
        """Compiled update of the filter; constant arrays of its state are not written again."""
        return self.function(_update, unchanged=None)

    @_ComputedOnce
    def world_advance(self) -> CompiledFunction:
        """Compiled step of the world to the next measurement; constant arrays of the truth are not written again."""
        if self._of_world is not self:
            return self._of_world.world_advance
        return self.function(_advance, unchanged=len(leaves(self.world_start.example()[0])))

    @_ComputedOnce
    def filter_prediction(self) -> CompiledFunction:
        """Compiled prediction of the filter to a measurement, with the observation."""
        return self.function(_predict, turned=True)

    @_ComputedOnce
    def world_start(self) -> Specialised:
        """Compiled start of the world: truth and initial estimate."""
        if self._of_world is not self:
            return self._of_world.world_start
        noise = self.traced.task.noise
        uniforms, normals = numpy.zeros((noise.uniforms, 8)), numpy.zeros((noise.initial_normals, 8))
        return self.function(begin_world).specialise(uniforms, normals)

    @_ComputedOnce
    def start(self) -> tuple[Specialised, Specialised]:
        """Compiled starts of the world and of the filter."""
        truth, initial = self.world_start.example()
        return self.world_start, self.function(start_filter).specialise(
            initial, self.traced.truth_for_filter(truth)
        )

    @_ComputedOnce
    def first(self) -> Parts:
        """Compiled parts of the first step, from the start of the track to the first measurement."""
        world, started = self.start
        return self._parts(world.example()[0], *started.example())

    @_ComputedOnce
    def later(self) -> Parts:
        """Compiled parts of every later step, from an action to the next measurement."""
        first = self.first
        later = self._parts(first.advance.example()[0], *first.update.example())
        shapes = [
            [leaf.shape for leaf in (*parts.advance.inputs, *parts.predict.inputs, *parts.predict.outputs)]
            for parts in (first, later)
        ]
        if shapes[0] != shapes[1] or first.advance.same != later.advance.same:
            raise NotTraceable("the arrays of an episode change their shapes from step to step")
        return later

    @_ComputedOnce
    def unseen_predictions(self) -> tuple[Specialised, Specialised]:
        """Compiled filter predictions without an observation, at the first and at later measurements."""
        states = self.start[1].example()[0], self.first.update.example()[0]
        predict, measurement = self.function(_predict_unseen), self.later.episode.measurement
        return predict.specialise(states[0], measurement), predict.specialise(states[1], measurement)

    @property
    def is_open_loop(self) -> bool:
        """Whether the filter has no feedback to the world."""
        started, first, later = self.start[1], self.first.update, self.later.update
        states = len(leaves(self.later.episode.filter))
        return all(len(program.outputs) == states for program in (started, first, later))

    @property
    def row(self) -> numpy.ndarray:
        """Zeros in the shape of the random numbers of a measurement, ``(normals + row_uniforms, 8)``."""
        return numpy.zeros((self.traced.task.noise.normals + self.traced.task.noise.row_uniforms, 8))

    def _parts(self, truth: Any, state: Any, feedback: Any) -> Parts:
        space = self.traced.action_space
        discrete = isinstance(space, gymnasium.spaces.Discrete)
        action = numpy.zeros((*(space.shape or ()), 8), dtype=int if discrete else float)
        advance = self.world_advance.specialise(truth, feedback, self.row)
        following, measurement = advance.example()
        predict = self.filter_prediction.specialise(state, measurement)
        predicted = predict.example()[0]
        known = self.traced.truth_for_filter(following)
        update = self.filter_update.specialise(known, predicted, measurement, action)
        return Parts(update, advance, predict, Episode(following, measurement, predicted))

    def report_program(self, report: Report) -> Specialised:
        """Return the compiled program of a report function on the episodes."""
        return self.function(report).specialise(self.later.episode)
