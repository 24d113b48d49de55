"""Tasks whose steps are compiled: the same functions, traced once and run as code of the processor.

:func:`compiled` returns a task that is used like any other; its methods run native code. :class:`Stepper` goes
further for whoever only steps: it keeps the episodes in its own memory, bound to the code once and for all.
"""

import functools
import importlib.util
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy

from ..compiler import namespace
from ..compiler.functions import DTYPES, Function, Specialised, empty_lanes, leaves, mapped, run_over
from ..compiler.namespace import NotTraceable
from ..compiler.program import Graph
from .observation import Array
from .reward import reward
from .task import Episode, Task

AVAILABLE = importlib.util.find_spec("llvmlite") is not None
"""Whether steps can be compiled here."""
METHODS = ("begin", "measure", "act", "observe", "mean", "cost", "error", "covariance", "track", "records")
"""Of a task, those that are compiled."""
TILE = 1024
"""Lanes that go through both halves of a step before the next: they stay in the second-level cache."""
REMEMBERED = 64
"""Tasks whose programs a process keeps."""
MANY = 64
"""Lanes from which on observations are written where the caller will keep them, instead of into a copy."""


def _steered(kind: str, task: Task, episode: Episode, action: Array) -> tuple[Any, Array]:
    """Bank after the action, and what is paid for it."""
    after = task.act(episode, action)
    return after.bank, reward(kind, task, after, None, None)


def _moved_on(task: Task, truth: Any, bank: Any, noise: Array) -> tuple[Any, Any, Any, Array]:
    """Truth, measurement and bank at the next measurement, and what is shown of them."""
    episode = task.measure(Episode(truth, None, bank), noise)
    return episode.truth, episode.measurement, episode.bank, task.observe(episode)


def steered_and_moved_on(
    kind: str, task: Task, episode: Episode, action: Array, noise: Array
) -> tuple[Episode, Array, Array]:
    """Both halves of a step: episodes at the next measurement, what is paid for the action, and what is shown."""
    bank, paid = _steered(kind, task, episode, action)
    truth, measurement, bank, shown = _moved_on(task, episode.truth, bank, noise)
    return Episode(truth, measurement, bank), paid, shown


class Programs:
    """What is traced of a task, for all that have its parameters.

    Args:
        traced: the task on traced arrays.
        graph: where its constants were made.
    """

    def __init__(self, traced: Task, graph: Graph) -> None:
        self.traced = traced
        self.graph = graph
        self.refused: set[Any] = set()
        """Functions that could not be traced."""
        self._functions: dict[Any, Function] = {}
        self._halves: dict[str, tuple[Specialised, Specialised]] = {}

    @functools.cached_property
    def episode(self) -> Episode:
        """An episode at a measurement, its arrays of the right shapes."""
        noise, cls = self.traced.noise, type(self.traced)
        start = self.function(cls.begin).specialised(
            numpy.zeros((noise.uniforms, 8)), numpy.zeros((noise.initial_normals, 8))
        )
        return self.function(cls.measure).specialised(start.example(), self.row).example()

    @property
    def row(self) -> numpy.ndarray:
        """Noise of a measurement."""
        return numpy.zeros((self.traced.noise.normals + self.traced.noise.row_uniforms, 8))

    def function(self, function: Callable[..., Any]) -> Function:
        """Compiled form of ``function(task, ...)``."""
        if function not in self._functions:
            self._functions[function] = Function(functools.partial(function, self.traced), self.graph)
        return self._functions[function]

    def halves(self, kind: str) -> tuple[Specialised, Specialised]:
        """Both halves of a step: the action with its reward of some kind, and the way to the next observation.

        Raises:
            NotTraceable: if the task is no straight line of arithmetic.
        """
        if kind not in self._halves:
            episode, space = self.episode, self.traced.action_space
            discrete = isinstance(space, gymnasium.spaces.Discrete)
            action = numpy.zeros((*(space.shape or ()), 8), dtype=int if discrete else float)
            steer = Specialised(
                functools.partial(_steered, kind, self.traced),
                self.graph,
                (episode, action),
                # A part of the bank that the action leaves alone; never what is paid, which comes last.
                shared=lambda output, input: (
                    input < len(leaves(episode)) and output < len(leaves(episode.bank))
                ),
            )
            advance = Specialised(
                functools.partial(_moved_on, self.traced),
                self.graph,
                (episode.truth, steer.example()[0], self.row),
                turned=True,
                # A part of the truth that stays: both copies of the episodes may have the same one.
                shared=lambda output, input: output == input < len(leaves(episode.truth)),
            )
            if [leaf.shape for leaf in advance.outputs[:-1]] != [leaf.shape[:-1] for leaf in leaves(episode)]:
                raise NotTraceable("the arrays of an episode change their shapes from step to step")
            self._halves[kind] = steer, advance
        return self._halves[kind]


class _Compiled(Task):
    """Put in front of a task's class; see :func:`compiled`."""

    original: Task
    programs: Programs
    threads: int

    def __reduce__(self) -> Any:
        return compiled, (self.original, self.threads)

    def under(self, control: str) -> Task:
        """Return the same problem with another control."""
        return compiled(self.original.under(control), self.threads)

    def estimated_outside(self) -> Task:
        """Return this task with an outside estimate in place of its bank."""
        programs = Programs(self.programs.traced.estimated_outside(), self.programs.graph)
        return _wrapped(self.original.estimated_outside(), programs, self.threads)

    def run(self, function: Callable[..., Any], *parts: Any) -> Any:
        """Call ``function(task, *parts)`` as code of the processor, or with NumPy where it cannot be traced."""
        if function not in self.programs.refused:
            try:
                return self.programs.function(function)(*parts, threads=self.threads)
            except NotTraceable as error:
                self.programs.refused.add(function)
                warn_of(f"{function.__qualname__} of {self.id}", error)
        return function(self.original, *parts)


def _method(name: str) -> Callable[..., Any]:
    def method(self: _Compiled, *parts: Any) -> Any:
        return self.run(getattr(type(self.original), name), *parts)

    method.__name__, method.__doc__ = name, getattr(Task, name).__doc__
    return method


for _name in METHODS:
    setattr(_Compiled, _name, _method(_name))


@functools.cache
def _class_of(cls: type[Task]) -> type[_Compiled]:
    return type(cls.__name__, (_Compiled, cls), {"__module__": cls.__module__, "__doc__": cls.__doc__})


def _wrapped(task: Task, programs: Programs, threads: int) -> Task:
    other: _Compiled = object.__new__(_class_of(type(task)))
    other.__dict__.update(task.__dict__)
    other.backend, other.original, other.programs, other.threads = "compiled", task, programs, threads
    return other


@functools.lru_cache(REMEMBERED)
def _programs(cls: type[Task], parameters: Any, control: str) -> Programs:
    graph = Graph()
    with namespace.tracing(graph):
        programs = Programs(cls(parameters, control, namespace), graph)  # type: ignore[arg-type]
    programs.halves("cost")
    return programs


def compiled(task: Task, threads: int = 1) -> Task:
    """Return a task whose methods run as code of the processor.

    Args:
        task: on NumPy arrays.
        threads: how many share the lanes.

    Raises:
        NotTraceable: if a step is no straight line of arithmetic.
        ImportError: without llvmlite.
    """
    if not AVAILABLE:
        raise ImportError("backend 'compiled' needs llvmlite: pip install 'filtergym[fast]'")
    try:
        hash(task.parameters)
        make = _programs
    except TypeError:
        make = _programs.__wrapped__  # parameters that hold arrays are traced each time
    try:
        return _wrapped(task, make(type(task), task.parameters, task.control), threads)
    except NotTraceable:
        raise
    except Exception as error:  # a task may stumble over symbols in any way
        raise NotTraceable(f"{type(error).__name__}: {error}") from error


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


class Stepper:
    """Episodes of a compiled task in memory of their own, stepped by actions.

    Args:
        task: compiled.
        kind: reward that is paid.
        width: lanes, a multiple of eight.

    Attributes:
        action: to be written before a step, ``(..., width)``.
        paid: for the last action, ``(width,)``.
        shown: last observation, ``(width, fields)``.
    """

    def __init__(self, task: Any, kind: str, width: int) -> None:
        steer, advance = task.programs.halves(kind)
        episode = task.programs.episode
        truths = len(leaves(episode.truth))
        self.width, self._threads = width, task.threads
        self._template, self._kinds = advance.template, advance.outputs
        self.action = empty_lanes(steer.inputs[-1].shape, width)
        self.action[...] = 0.0
        self.paid = numpy.empty(width)
        self.shown = numpy.empty((width, *advance.outputs[-1].shape))
        first = [empty_lanes(leaf.shape, width) for leaf in advance.outputs[:-1]]
        second = [
            first[i] if same is not None else empty_lanes(first[i].shape[:-1], width)
            for i, same in enumerate(advance.same[:-1])
        ]
        self._copies = (first, second)
        steered = [empty_lanes(leaf.shape, width) for leaf in steer.outputs[:-1]]
        nothing = numpy.zeros((len(task.programs.row), width))
        self._steer, self._advance = [], []
        for now, then in ((first, second), (second, first)):
            self._steer.append(steer.bound([*now, self.action], [*steered, self.paid]))
            bank = [steered[i] if same is None else now[same] for i, same in enumerate(steer.same[:-1])]
            self._advance.append(advance.bound([*now[:truths], *bank, nothing], [*then, self.shown]))
        self._now = 0
        self._row_entry = 1 + 2 * (truths + len(steer.same) - 1)

    def load(self, episode: Episode) -> None:
        """Go on from other episodes."""
        for memory, values in zip(self._copies[self._now], leaves(episode), strict=True):
            memory[...] = values

    def replace(self, episode: Episode, lanes: numpy.ndarray) -> None:
        """Put the first episodes of others in place of those in some lanes."""
        for memory, values in zip(self._copies[self._now], leaves(episode), strict=True):
            memory[..., lanes] = values[..., : len(lanes)]

    def episode(self) -> Episode:
        """Return the episodes, in arrays that stay as they are."""
        memory = self._copies[self._now]
        return Episode(
            *mapped(lambda i: memory[i].astype(DTYPES[self._kinds[i].kind], order="C"), self._template[:3])
        )

    def step(self, row: int) -> None:
        """Apply the action and go on to the next measurement.

        Args:
            row: address of its noise.
        """
        steer, advance = self._steer[self._now], self._advance[self._now]
        advance.table[self._row_entry] = row
        self._now = 1 - self._now
        if self.width <= TILE:
            steer.native(steer.address, 0, self.width)
            advance.native(advance.address, 0, self.width)
            return

        def tiles(first: int, last: int) -> None:
            for start in range(first, last, TILE):
                end = min(start + TILE, last)
                steer(start, end)
                advance(start, end)

        run_over(tiles, self.width, self._threads)

    def show_in(self, memory: numpy.ndarray) -> None:
        """Write observations into other memory, ``(width, fields)``, from now on."""
        self.shown = memory
        for advance in self._advance:
            advance.replace(len(advance.arrays) - 1, memory)
