"""Models whose steps are compiled: the same functions, traced once and run as code of the processor.

:class:`CompiledModel` is used like any other; its methods run native code. :class:`Stepper` goes
further where episodes are only stepped: it keeps the episodes in its own memory, bound to the code once and for all.
"""

import copy
import functools
import itertools
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler import namespace
from ...compiler.functions import (
    DTYPES,
    UNCOUNTED,
    Call,
    Function,
    Leaf,
    Specialised,
    empty_lanes,
    leaves,
    map_arrays,
    run_over,
)
from ...compiler.namespace import NotTraceable
from ...compiler.native import AVAILABLE
from ...compiler.program import Graph
from ...compiler.sequence import CallSequence, Moving, moving_array
from ..contract.draws import Draws
from ..contract.filter import Filter, Input
from ..contract.model import Episode, Model
from ..contract.observation import Array
from ..contract.task import Task
from .episode_noise import EpisodeNoise
from .reward import OWN_PAY

TILE = 1024
"""Lanes that go through all parts of a step before the next: they stay in the second-level cache."""
PROGRAM_CACHE_SIZE = 8
"""Tasks whose programs a process keeps."""
MANY = 64
"""Lanes from which on observations are written where the caller will keep them, instead of into a copy."""


Report = Callable[[Model, Episode], Any]
"""Function of a task and its episodes after the action: nested tuples or dictionaries of arrays."""


# A step in four parts. Apart, because scenarios differ in the world, controls in the action and callers in the report:
# what is long, world and filter, is compiled once for all of them.


def _update(model: Model, truth: Any, state: Any, measurement: Any, action: Array) -> tuple[Any, Any]:
    """Filter after the measurement, and what it gives back to the world."""
    after = model.filter.update(state, Input(measurement, truth, action))
    return after, model.filter.feedback(after, measurement)


def _advance(model: Model, truth: Any, feedback: Any, noise: Array) -> tuple[Any, Any]:
    """Truth at the next measurement, and the measurement."""
    return model.task.world.advance(truth, noise, feedback)


def _predict(model: Model, state: Any, measurement: Any) -> tuple[Any, Array]:
    """Filter at the measurement, and what is shown of it."""
    predicted = model.filter.predict(state, measurement)
    return predicted, model.observe(Episode(None, measurement, predicted))


def _predict_unseen(model: Model, state: Any, measurement: Any) -> Any:
    """Filter at the measurement, of which nothing is shown."""
    return model.filter.predict(state, measurement)


def _begin_world(model: Model, uniforms: Array, normals: Array) -> tuple[Any, Any]:
    """Truth at the start of the track, and the initial estimate."""
    return model.task.world.begin(Draws(uniforms, model.task.xp), normals)


def _start_filter(model: Model, initial: Any, truth: Any) -> tuple[Any, Any]:
    """Filter at the start of the track, and what it gives back to the world."""
    state = model.filter.initialise(Input(initial, truth))
    return state, model.filter.feedback(state, initial)


def _feedback(model: Model, state: Any, measurement: Any) -> Any:
    """What a filter gives back to the world."""
    return model.filter.feedback(state, measurement)


class Parts(NamedTuple):
    """Programs of a step, and what they are made for."""

    update: Specialised
    advance: Specialised
    predict: Specialised
    episode: Episode
    """After the measurement, its arrays of the right shapes."""


def step_episodes(
    kind: str, model: Model, episode: Episode, action: Array, noise: Array
) -> tuple[Episode, Array, Array]:
    """A whole step: episodes at the next measurement, the reward of the action, and the observation."""
    after = model.act(episode, action)
    following = model.measure(after, noise)
    return following, OWN_PAY[kind](model, after), model.observe(following)


class _Once:
    """A property that is computed once, as of functools from Python 3.12 on: before, it holds a lock that a fork would
    leave to a child for ever.
    """

    def __init__(self, compute: Callable[[Any], Any]) -> None:
        self.compute, self.__doc__ = compute, compute.__doc__

    def __get__(self, holder: Any, owner: type) -> Any:
        found = holder.__dict__[self.compute.__name__] = self.compute(holder)
        return found


class Programs:
    """What is traced of a task, for all that have its parameters.

    Args:
        traced: the task on traced arrays.
        graph: where its constants were made.
        of_world: what is traced of the same task with another filter; the world is the same.
    """

    def __init__(self, traced: Model, graph: Graph, of_world: "Programs | None" = None) -> None:
        self.traced = traced
        self.graph = graph
        self.refused: set[Any] = set()
        """Functions that could not be traced."""
        self._functions: dict[Any, Function] = {}
        self._of_world = of_world or self
        self._with_filter: dict[Any, Programs] = {}
        self._kept: dict[Any, Any] = {}

    def with_filter(self, make: Callable[[Model], Filter]) -> "Programs":
        """Return what is traced of the task with another filter; kept for the next time.

        Raises:
            NotTraceable: if the filter is no straight line of arithmetic.
        """
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
        """Return what is compiled for the task beside it, made where there is none by this key; the last ones stay."""
        if key not in self._kept:
            made = make()
            while len(self._kept) >= PROGRAM_CACHE_SIZE:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = made
        return self._kept[key]

    def function(self, function: Callable[..., Any], **options: Any) -> Function:
        """Compiled form of ``function(task, ...)``."""
        if function not in self._functions:
            options = {"unchanged": 0, **options}
            self._functions[function] = Function(
                functools.partial(function, self.traced), self.graph, **options
            )
        return self._functions[function]

    @_Once
    def filter_update(self) -> Function:
        """The filter with the measurement; a part of it that stays is not written again."""
        return self.function(_update, unchanged=None)

    @_Once
    def world_advance(self) -> Function:
        """The world; a part of the truth that stays is not written again."""
        if self._of_world is not self:
            return self._of_world.world_advance
        return self.function(_advance, unchanged=len(leaves(self.world_start.example()[0])))

    @_Once
    def filter_prediction(self) -> Function:
        """The filter at the next measurement."""
        return self.function(_predict, turned=True)

    @_Once
    def world_start(self) -> Specialised:
        """World at the start of the track."""
        if self._of_world is not self:
            return self._of_world.world_start
        noise = self.traced.task.noise
        uniforms, normals = numpy.zeros((noise.uniforms, 8)), numpy.zeros((noise.initial_normals, 8))
        return self.function(_begin_world).specialise(uniforms, normals)

    @_Once
    def start(self) -> tuple[Specialised, Specialised]:
        """World and filter at the start of the track."""
        truth, initial = self.world_start.example()
        return self.world_start, self.function(_start_filter).specialise(
            initial, self.traced.truth_for_filter(truth)
        )

    @_Once
    def first(self) -> Parts:
        """Parts of the way from the start of the track over the first measurement."""
        world, started = self.start
        return self._parts(world.example()[0], *started.example())

    @_Once
    def later(self) -> Parts:
        """Parts of the way from an action to the next.

        Raises:
            NotTraceable: if one is no straight line of arithmetic.
        """
        first = self.first
        later = self._parts(first.advance.example()[0], *first.update.example())
        shapes = [
            [leaf.shape for leaf in (*parts.advance.inputs, *parts.predict.inputs, *parts.predict.outputs)]
            for parts in (first, later)
        ]
        if shapes[0] != shapes[1] or first.advance.same != later.advance.same:
            raise NotTraceable("the arrays of an episode change their shapes from step to step")
        return later

    @_Once
    def unseen_predictions(self) -> tuple[Specialised, Specialised]:
        """The filter at the first measurement and at later ones, where nobody looks at what it shows."""
        states = self.start[1].example()[0], self.first.update.example()[0]
        predict, measurement = self.function(_predict_unseen), self.later.episode.measurement
        return predict.specialise(states[0], measurement), predict.specialise(states[1], measurement)

    @property
    def is_open_loop(self) -> bool:
        """Whether the filter gives nothing back to the world."""
        started, first, later = self.start[1], self.first.update, self.later.update
        states = len(leaves(self.later.episode.filter))
        return all(len(program.outputs) == states for program in (started, first, later))

    @property
    def row(self) -> numpy.ndarray:
        """Noise of a measurement."""
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
        """A report on an episode.

        Raises:
            NotTraceable: if it is no straight line of arithmetic.
        """
        return self.function(report).specialise(self.later.episode)


def _compile(method: Callable[..., Any]) -> Callable[..., Any]:
    """Let a method of a model run as code of the processor."""

    @functools.wraps(method)
    def run(self: "CompiledModel", episode: Episode) -> Any:
        return self.run(method, episode)

    return run


class CompiledModel(Model):
    """A model whose methods run as code of the processor.

    Args:
        task: on NumPy arrays.
        control: what the action steers.
        threads: how many share the lanes.

    Raises:
        NotTraceable: if a step is no straight line of arithmetic.
        ImportError: without llvmlite.
    """

    observe = _compile(Model.observe)
    mean = _compile(Model.mean)
    cost = _compile(Model.cost)
    charge = _compile(Model.charge)
    error = _compile(Model.error)
    covariance = _compile(Model.covariance)
    track = _compile(Model.track)
    records = _compile(Model.records)

    def __init__(self, task: Task, control: str, threads: int = 1) -> None:
        if not AVAILABLE:
            raise ImportError("backend 'compiled' needs llvmlite: pip install 'filtergym[fast]'")
        super().__init__(task, control)
        # Parameters that hold arrays are traced each time.
        trace = _trace_once if _hashes(task.parameters) else _trace
        self.programs: Programs = trace(type(task), task.parameters, control, task.recording)
        self.threads = threads
        self._plain = Model(task, control)

    def __reduce__(self) -> Any:
        return type(self), (self.task, self.control, self.threads)

    @property
    def backend(self) -> str:
        """What computes its steps."""
        return "compiled"

    def under(self, control: str) -> Model:
        """Return the same problem with another control."""
        return CompiledModel(self.task, control, self.threads)

    def on_numpy(self) -> Model:
        """Return the same problem on NumPy arrays, not compiled."""
        return self._plain

    def with_filter(self, make: Callable[[Model], Filter]) -> "CompiledModel":
        """Return the same problem with another filter in place of the bank.

        Args:
            make: makes the filter for a model, on NumPy's arrays and on traced ones.

        Raises:
            NotTraceable: if the filter is no straight line of arithmetic, and does not say so.
        """
        other = copy.copy(self)
        other._plain = self._plain.with_filter(make)
        other._take_filter(other._plain.filter)
        other.programs = self.programs.with_filter(make)
        return other

    def run(self, function: Callable[..., Any], *parts: Any) -> Any:
        """Call ``function(model, *parts)`` as code of the processor, or with NumPy where it cannot be traced."""
        if function not in self.programs.refused:
            try:
                return self.programs.function(function)(*parts, threads=self.threads)
            except NotTraceable as error:
                self.programs.refused.add(function)
                warn_of(f"{_name_of(function)} of {self.task.id}", error)
        return function(self._plain, *parts)

    def start_filter(self, initial: Any, truth: Any = None) -> Any:
        """State of the filter at the start of the track."""
        if self.filter.in_python:
            return super().start_filter(initial, truth)
        return self.run(_start_filter, initial, truth)[0]

    def predict_filter(self, state: Any, measurement: Any) -> Any:
        """State of the filter when a measurement has come."""
        return self.programs.filter_prediction(state, measurement, threads=self.threads)[0]

    def update_filter(self, state: Any, measurement: Any, action: Array, truth: Any = None) -> Any:
        """State of the filter when the measurement is taken in."""
        if self.filter.in_python:
            return super().update_filter(state, measurement, action, truth)
        return self.programs.filter_update(truth, state, measurement, action, threads=self.threads)[0]

    def begin(self, uniforms: Array, normals: Array) -> Episode:
        """Episode at the start of the track."""
        truth, initial = self.run(_begin_world, uniforms, normals)
        return Episode(truth, initial, self.start_filter(initial, self.truth_for_filter(truth)))

    def measure(self, episode: Episode, noise: Array) -> Episode:
        """Steps 1 and 2."""
        given = episode.filter, episode.measurement
        feedback = self.filter.feedback(*given) if self.filter.in_python else self.run(_feedback, *given)
        truth, measurement = self.programs.world_advance(episode.truth, feedback, noise, threads=self.threads)
        return Episode(truth, measurement, self.predict_filter(episode.filter, measurement))


def _trace(cls: type[Task], parameters: Any, control: str, recording: Any) -> Programs:
    graph = Graph(loops=True)
    with namespace.tracing(graph):
        programs = Programs(Model(cls(parameters, namespace, None, recording), control), graph)
    _ = programs.later
    return programs


_trace_once = functools.lru_cache(PROGRAM_CACHE_SIZE)(_trace)


def _hashes(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True


def _name_of(function: Callable[..., Any]) -> str:
    """Name of a function, or of the class of an object that is called."""
    return getattr(function, "__qualname__", type(function).__name__)


def warn_of(what: str, error: BaseException) -> None:
    """Warn that something runs with NumPy, and name the line that is to blame."""
    found: BaseException = error.__cause__ or error
    frames = [
        f for f in traceback.extract_tb(found.__traceback__) if "compiler" not in Path(f.filename).parts
    ]
    line = (
        f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line})" if frames else ""
    )
    warnings.warn(f"{what} is not compiled and runs with NumPy: {error}{line}", stacklevel=2)


def share_world(model: Any, other: Any) -> bool:
    """Whether two compiled models are of one task, and neither filter gives anything back to its world."""
    return model.task is other.task and model.programs.is_open_loop and other.programs.is_open_loop


def can_step(model: Any, report: Report) -> bool:
    """Whether a model's steps are compiled, and a report on them can be."""
    if not isinstance(model, CompiledModel) or model.filter.in_python or report in model.programs.refused:
        return False
    try:
        model.programs.report_program(report)
    except NotTraceable as error:
        model.programs.refused.add(report)
        warn_of(f"{_name_of(report)} of {model.task.id}", error)
        return False
    return True


class Stepper:
    """Episodes of a compiled model in memory of their own, stepped by actions.

    Args:
        model: compiled.
        report: made of every episode after the action.
        width: lanes, a multiple of eight.
        world_of: a stepper of the same task, both filters in an open loop. Its world is this one's too, and nobody
            looks at what this one shows. Whatever is done with both is done with it first.

    Attributes:
        action: applied at every step, ``(..., width)``.
    """

    def __init__(self, model: Any, report: Report, width: int, world_of: "Stepper | None" = None) -> None:
        update, advance, predict, episode = model.programs.later
        tell = model.programs.report_program(report)
        truths, measured, states = (len(leaves(part)) for part in episode)
        self.width, self._threads, self._model, self._report = width, model.threads, model, report
        self._world_of, self._shared = world_of, 0 if world_of is None else truths + measured
        count = itertools.count()
        self._template, self._kinds = map_arrays(lambda _: next(count), episode), _kinds(leaves(episode))
        self._report_template, self._report_kinds = tell.template, [leaf.kind for leaf in tell.outputs]

        def memory(outputs: Sequence[Leaf]) -> list[numpy.ndarray]:
            return [empty_lanes(leaf.shape, width) for leaf in outputs]

        self.action = empty_lanes(update.inputs[-1].shape, width)
        self.action[...] = 0.0
        fields = predict.outputs[-1].shape[0] if world_of is None else 0
        self._shown, self._given = numpy.empty((width, fields)), False
        self._reported = memory(tell.outputs)
        knows = bool(model.filter.knows)
        # Episodes go to and fro between two copies, which share what stays as it is. Of the filter they share what is
        # not read any more when the prediction is written: all but what the update has handed on.
        outputs = [*advance.outputs, *predict.outputs[:-1]][self._shared :]
        ahead_of_filter = truths if knows else 0
        handed_on = [ahead_of_filter + i in update.same for i in range(states)]
        stays = [*(same is not None for same in advance.same), *(not handed for handed in handed_on)]
        stays = stays[self._shared :]
        self._staying, staying = _side_by_side([o for o, s in zip(outputs, stays, strict=True) if s], width)
        self._going: list[numpy.ndarray] = []
        """Of each copy the numbers of all arrays that are not shared, ``(numbers, width)``."""
        self._copies: list[list[numpy.ndarray]] = []
        for world in ([], []) if world_of is None else world_of._copies:
            numbers, going = _side_by_side([o for o, s in zip(outputs, stays, strict=True) if not s], width)
            self._going.append(numbers)
            kept, own = iter(staying), iter(going)
            self._copies.append([*world[: self._shared], *(next(kept if s else own) for s in stays)])
        first, second = self._copies
        written = memory(update.outputs)
        row = empty_lanes((advance.inputs[-1].rows,), width)  # its place is taken by that of the noise
        self._calls, self._begin = [], []
        world, start = model.programs.start
        begun = model.programs.first
        self._drawn = memory(world.inputs)
        self._initial: list[numpy.ndarray] = (
            memory(world.outputs[truths:]) if world_of is None else world_of._initial
        )
        for now, then in ((first, second), (second, first)):
            truth, measurement = now[:truths], now[truths : truths + measured]
            given = [*(truth if knows else []), *now[truths + measured :], *measurement, self.action]
            updated = [own if i is None else given[i] for own, i in zip(written, update.same, strict=True)]
            ahead, predicted = then[: truths + measured], then[truths + measured :]
            step = [
                update.bound(given, written),
                tell.bound([*truth, *measurement, *updated[:states]], self._reported),
            ]
            begin = [start.bound([*self._initial, *(truth if knows else [])], written)]
            came = ahead[truths:]
            if world_of is None:
                step += [
                    advance.bound([*truth, *updated[states:], row], ahead),
                    predict.bound([*updated[:states], *came], [*predicted, self._shown]),
                ]
                begin = [
                    world.bound(self._drawn, [*truth, *self._initial]),
                    *begin,
                    begun.advance.bound([*truth, *written[states:], row], ahead),
                    begun.predict.bound([*written[:states], *came], [*predicted, self._shown]),
                ]
            else:
                at_first, later = model.programs.unseen_predictions
                step.append(later.bound([*updated[:states], *came], predicted))
                begin.append(at_first.bound([*written[:states], *came], predicted))
            self._calls.append(step)
            self._begin.append(begin)
        self._now = 0
        self._stepped = 0
        """Lanes that steps went over and that no code was told of."""
        self._small: dict[int, Stepper] = {}
        """Steppers in which the episodes of a few lanes begin, by their width."""
        self._row_entry = 1 + 2 * (len(advance.inputs) - 1)
        self._action_place, self._report_place = len(update.inputs) - 1, len(tell.inputs)

    def load(self, episode: Episode, shown: Array = None) -> None:
        """Go on from other episodes, which show what is given, ``(fields, width)``."""
        own = zip(self._copies[self._now], leaves(episode), strict=True)
        for memory, values in itertools.islice(own, self._shared, None):
            memory[...] = values
        if shown is not None:
            self._shown[...] = shown.T

    def episode(self) -> Episode:
        """Return the episodes, in arrays that stay as they are."""
        return _copy_numbers(self._template, self._copies[self._now], self._kinds)

    def begin(self, uniforms: numpy.ndarray, normals: numpy.ndarray, noise: EpisodeNoise) -> None:
        """Start new episodes everywhere and let their first measurement arrive.

        Args:
            uniforms: of the scenario, ``(uniforms, width)``.
            normals: of the start of the track, ``(initial_normals, width)``.
            noise: of the measurements.
        """
        for memory, values in zip(self._drawn, (uniforms, normals), strict=True):
            memory[...] = values
        for call in self._begin[self._now]:
            call.expect(self.width)
        self._run(self._begin[self._now], noise)

    def begin_some(
        self, lanes: numpy.ndarray, uniforms: numpy.ndarray, normals: numpy.ndarray, noise: EpisodeNoise
    ) -> None:
        """Start new episodes in some lanes and let their first measurement arrive.

        Args:
            lanes: which.
            uniforms: theirs, padded to the width of ``noise``, likewise what follows.
            normals: as in :meth:`begin`.
            noise: of these episodes.
        """
        small = self._small.get(noise.width)
        if small is None:
            beside = None if self._world_of is None else self._world_of._small[noise.width]
            small = self._small[noise.width] = Stepper(self._model, self._report, noise.width, beside)
        small.begin(uniforms, normals, noise)
        for numbers, begun in (
            (self._staying, small._staying),
            (self._going[self._now], small._going[small._now]),
        ):
            numbers[:, lanes] = begun[:, : len(lanes)]
        if self._given:
            self._show_in(self._shown.copy())
        self._shown[lanes] = small._shown[: len(lanes)]

    def take(self, action: numpy.ndarray) -> None:
        """Apply an action from the next step on, batch first, of all lanes or of the first."""
        self.action[..., : len(action)] = action.T if action.ndim == 2 else action

    def step(self, noise: EpisodeNoise) -> None:
        """Apply the action and go on to the next measurement."""
        self._stepped += self.width
        if self._stepped > UNCOUNTED:
            for call in itertools.chain(*self._calls):
                call.expect(self._stepped // 2)
            self._stepped = 0
        self._run(self._calls[self._now], noise)

    def _run(self, calls: Sequence[Call], noise: EpisodeNoise) -> None:
        if self._given:
            self._show_in(numpy.empty_like(self._shown))
        if self._world_of is None:
            calls[2].table[self._row_entry] = noise.address
        calls = (*noise.calls(), *calls)
        self._now = 1 - self._now
        if self.width <= TILE:
            for call in calls:
                call.native(call.address, 0, self.width)
            return

        def tiles(first: int, last: int) -> None:
            for start in range(first, last, TILE):
                for call in calls:
                    call(start, min(start + TILE, last))

        run_over(tiles, self.width, self._threads)

    def run(self, noise: EpisodeNoise, steps: int, steering: Specialised | None) -> tuple[Any, Any]:
        """Go through many measurements without going back to Python between them.

        Args:
            noise: of the measurements.
            steps: how many.
            steering: function of what is shown, read lane by lane, and of a memory that begins with zeros, to an action
                and the memory. None: the action stays as it is.

        Returns:
            The report on every measurement, in arrays ``(steps, ..., width)``, and the actions, likewise; None where
            nothing steers.
        """
        if self._given:
            self._show_in(self._shown.copy())
        reported = [empty_lanes((steps, *array.shape[:-1]), self.width) for array in self._reported]
        actions, memories = None, [self._blank_memory(steering), self._blank_memory(steering)]
        if steering is not None:
            actions = empty_lanes((steps, *self.action.shape[:-1]), self.width)
        draw = noise.call_of_each()
        turns: list[list[Call]] = []
        moving: list[Moving] = []
        for now in (self._now, 1 - self._now):
            update, tell, advance, predict = (call.copy() for call in self._calls[now])
            advance.table[self._row_entry] = noise.address
            moving += [moving_array(tell, self._report_place + i, each) for i, each in enumerate(reported)]
            turns.append([update, tell, draw, advance, predict])
            if steering is not None and actions is not None:
                steer = steering.bound([self._shown, *memories[0]], [actions[0], *memories[1]])
                turns[-1].insert(0, steer)
                moving.append(moving_array(steer, 1 + len(memories[0]), actions))
                moving.append(moving_array(update, self._action_place, actions))
                memories.reverse()
        CallSequence(turns[0], turns[1], moving).run(steps, self.width, self._threads)
        self._now = (self._now + steps) % 2
        answers = [
            array if kind == "f" else array.astype(DTYPES[kind])
            for array, kind in zip(reported, self._report_kinds, strict=True)
        ]
        return map_arrays(lambda i: answers[i], self._report_template), actions

    def _blank_memory(self, steering: Specialised | None) -> list[numpy.ndarray]:
        """Memory of what steers before its first action."""
        blank = [empty_lanes(leaf.shape, self.width) for leaf in steering.outputs[1:]] if steering else []
        for array in blank:
            array[...] = 0.0
        return blank

    def report(self) -> Any:
        """Return the last report, in arrays ``(..., width)`` that stay as they are."""
        return _copy_numbers(self._report_template, self._reported, self._report_kinds)

    def observation_by_field(self) -> numpy.ndarray:
        """What is shown, ``(fields, width)``, until the next step."""
        return self._shown.T

    def show_means(self, fields: Sequence[int], means: numpy.ndarray) -> None:
        """Show other values of some fields, ``(fields, width)``."""
        self._shown[:, fields] = means.T

    def observation(self, count: int) -> numpy.ndarray:
        """Observation of the first lanes, batch first; the caller may keep it."""
        if count < MANY:
            return self._shown[:count].copy()
        self._given = True
        return self._shown[:count]

    def _show_in(self, memory: numpy.ndarray) -> None:
        """Write observations into other memory, ``(width, fields)``, from now on."""
        self._shown, self._given = memory, False
        for *_, predict in (*self._calls, *self._begin):
            predict.replace(len(predict.arrays) - 1, memory)


class FilterStepper:
    """The filter of a compiled model in memory of its own, to which measurements come from outside.

    Args:
        model: compiled.
        report: made of measurement and filter after every update.
        width: lanes, a multiple of eight.
    """

    def __init__(self, model: Any, report: Report, width: int) -> None:
        update, _, predict, episode = model.programs.later
        tell = model.programs.report_program(report)
        truths, measured, states = (len(leaves(part)) for part in episode)
        count = itertools.count()
        self._template, self._kinds = (
            map_arrays(lambda _: next(count), episode.filter),
            _kinds(leaves(episode.filter)),
        )
        self._report_template, self._report_kinds = tell.template, [leaf.kind for leaf in tell.outputs]
        self.width = width

        def memory(arrays: Sequence[Leaf]) -> list[numpy.ndarray]:
            return [empty_lanes(leaf.shape, width) for leaf in arrays]

        unknown = memory(tell.inputs[:truths])
        self._measurement = memory(tell.inputs[truths : truths + measured])
        predicted, self._shown = (
            memory(predict.outputs[:-1]),
            numpy.empty((width, *predict.outputs[-1].shape)),
        )
        written, self._reported = memory(update.outputs), memory(tell.outputs)
        self._state, self._action = written[:states], empty_lanes(update.inputs[-1].shape, width)
        self._action[...] = 0.0
        given = [*predicted, *self._measurement, self._action]
        self._kept = [(own, given[i]) for own, i in zip(written, update.same, strict=True) if i is not None]
        self._predict = predict.bound([*self._state, *self._measurement], [*predicted, self._shown])
        self._update = update.bound(given, written)
        self._tell = tell.bound([*unknown, *self._measurement, *self._state], self._reported)

    @property
    def state(self) -> Any:
        """State of the filter, in arrays that stay as they are."""
        return _copy_numbers(self._template, self._state, self._kinds)

    @state.setter
    def state(self, state: Any) -> None:
        for memory, values in zip(self._state, leaves(state), strict=True):
            memory[...] = values

    def predict(self, measurement: Any) -> None:
        """Let a measurement come."""
        for memory, values in zip(self._measurement, leaves(measurement), strict=True):
            memory[...] = values
        self._predict(0, self.width)

    def observe(self) -> Array:
        """What is shown, ``(fields, width)``, until the next measurement."""
        return self._shown.T

    def update(self, action: Array) -> None:
        """Take the measurement in."""
        self._action[...] = action
        self._update(0, self.width)
        for memory, values in self._kept:
            memory[...] = values

    def report(self) -> Any:
        """Return the report, in arrays ``(..., width)`` that stay as they are."""
        self._tell(0, self.width)
        return _copy_numbers(self._report_template, self._reported, self._report_kinds)


class ModelFilterStepper:
    """The same for any model, by its functions, in arrays that never change.

    Args:
        model: any.
        report: as of :class:`FilterStepper`.
        width: likewise.
    """

    def __init__(self, model: Model, report: Report, width: int) -> None:
        self._model, self._report, self.width = model, report, width
        self.state: Any = None
        self._measurement: Any = None

    def predict(self, measurement: Any) -> None:
        """Let a measurement come."""
        self._measurement = measurement
        self.state = self._model.predict_filter(self.state, measurement)

    def observe(self) -> Array:
        """What is shown, ``(fields, width)``."""
        return self._model.observe(Episode(None, self._measurement, self.state))

    def update(self, action: Array) -> None:
        """Take the measurement in."""
        self.state = self._model.update_filter(self.state, self._measurement, action)

    def report(self) -> Any:
        """Return the report, in arrays ``(..., width)``."""
        return self._model.run(self._report, Episode(None, self._measurement, self.state))


def filter_stepper(model: Model, report: Report, width: int) -> FilterStepper | ModelFilterStepper:
    """Return what steps the filter of a model alone."""
    kind = FilterStepper if can_step(model, report) else ModelFilterStepper
    return kind(model, report, width)


def _side_by_side(arrays: Sequence[Leaf], width: int) -> tuple[numpy.ndarray, list[numpy.ndarray]]:
    """Memory of all numbers of some arrays, ``(numbers, width)``, and the arrays in it, ``(..., width)``."""
    numbers = empty_lanes((sum(leaf.rows for leaf in arrays),), width)
    starts = numpy.cumsum([0, *(leaf.rows for leaf in arrays)]).tolist()
    parts = zip(arrays, starts, strict=False)
    return numbers, [numbers[at : at + leaf.rows].reshape(*leaf.shape, width) for leaf, at in parts]


def _kinds(arrays: Sequence[numpy.ndarray]) -> list[str]:
    return [array.dtype.kind for array in arrays]


def _copy_numbers(template: Any, memory: Sequence[numpy.ndarray], kinds: Sequence[str]) -> Any:
    """Copies of arrays of numbers in their places, in their own types."""
    return map_arrays(lambda i: memory[i].astype(DTYPES[kinds[i]], order="C"), template)
