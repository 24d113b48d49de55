"""Models whose steps are compiled: their functions are traced once and run as native code.

:class:`CompiledModel` is used like any other; its methods run native code of its :class:`~.programs.Programs`.
Where episodes are only stepped, :class:`~.stepper.Stepper` is faster: it has the episodes in its own memory, bound
to the code once.
"""

import copy
import functools
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...compiler import namespace
from ...compiler.namespace import NotTraceable
from ...compiler.native import AVAILABLE
from ...compiler.program import Graph
from ..contract.filter import Filter
from ..contract.model import Episode, Model
from ..contract.observation import Array
from ..contract.task import Task
from .programs import PROGRAM_CACHE_SIZE, Programs, Report, begin_world, start_filter


def _compile(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method of :class:`CompiledModel` that runs as native code (decorator)."""

    @functools.wraps(method)
    def run(self: "CompiledModel", episode: Episode) -> Any:
        return self.run(method, episode)

    return run


class CompiledModel(Model):
    """A model whose methods run as native code, traced and compiled once.

    Args:
        threads: number of threads for the lanes.

    Raises:
        NotTraceable: if a step is no straight line of arithmetic.
        ImportError: without llvmlite.
    """

    observe = _compile(Model.observe)
    mean = _compile(Model.mean)
    cost = _compile(Model.cost)
    counted_cost = _compile(Model.counted_cost)
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
        """Name of the backend: "compiled"."""
        return "compiled"

    def with_control(self, control: str) -> Model:
        """Return a compiled model of the same task with the bank of another control."""
        return CompiledModel(self.task, control, self.threads)

    def on_numpy(self) -> Model:
        """Return a model of the same task on NumPy arrays, not compiled."""
        return self._plain

    def with_filter(self, make: Callable[[Model], Filter[Any, Any, Any]]) -> "CompiledModel":
        """Return a compiled model of the same task with another filter in place of the bank.

        ``make`` must work on NumPy arrays and on traced ones.
        """
        other = copy.copy(self)
        other._plain = self._plain.with_filter(make)
        other._take_filter(other._plain.filter)
        other.programs = self.programs.with_filter(make)
        return other

    def run(self, function: Callable[..., Any], *parts: Any) -> Any:
        """Return ``function(model, *parts)``, computed by native code, or by NumPy if it cannot be traced."""
        if function not in self.programs.refused:
            try:
                return self.programs.function(function)(*parts, threads=self.threads)
            except NotTraceable as error:
                self.programs.refused.add(function)
                warn_not_compiled(f"{_name_of(function)} of {self.task.id}", error)
        return function(self._plain, *parts)

    def start_filter(self, initial: Any, truth: Any = None) -> Any:
        """Return the filter's state at the start of the track."""
        if self.filter.in_python:
            return super().start_filter(initial, truth)
        return self.run(start_filter, initial, truth)[0]

    def predict_filter(self, state: Any, measurement: Any) -> Any:
        """Return the filter's state predicted to a measurement."""
        return self.programs.filter_prediction(state, measurement, threads=self.threads)[0]

    def update_filter(self, state: Any, measurement: Any, action: Array, truth: Any = None) -> Any:
        """Return the filter's state after the update with a measurement."""
        if self.filter.in_python:
            return super().update_filter(state, measurement, action, truth)
        return self.programs.filter_update(truth, state, measurement, action, threads=self.threads)[0]

    def feedback(self, state: Any, measurement: Any) -> Any:
        """Return the feedback of a filter's estimate to the world; None in an open loop."""
        if self.filter.in_python:
            return super().feedback(state, measurement)
        return self.run(Model.feedback, state, measurement)

    def begin(self, uniforms: Array, normals: Array) -> Episode:
        """Return N episodes at the start of the track, made from random numbers."""
        truth, initial = self.run(begin_world, uniforms, normals)
        return Episode(truth, initial, self.start_filter(initial, self.truth_for_filter(truth)))

    def measure(self, episode: Episode, noise: Array) -> Episode:
        """Return the episodes at the next measurement, with the filter predicted to it (steps 1 and 2 of the clock)."""
        feedback = self.feedback(episode.filter, episode.measurement)
        truth, measurement = self.programs.world_advance(episode.truth, feedback, noise, threads=self.threads)
        return Episode(truth, measurement, self.predict_filter(episode.filter, measurement))


def compiled_model(
    cls: type[Task], parameters: Any, control: str, recording: Any = None, threads: int = 1
) -> CompiledModel:
    """Return the :class:`CompiledModel` of a task with these parameters, from a cache of the most recent ones."""
    make = _make_once if _hashes(parameters) else _make
    return make(cls, parameters, control, recording, threads)


def _make(cls: type[Task], parameters: Any, control: str, recording: Any, threads: int) -> CompiledModel:
    return CompiledModel(cls(parameters, recording=recording), control, threads)


_make_once = functools.lru_cache(PROGRAM_CACHE_SIZE)(_make)


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
    return getattr(function, "__qualname__", type(function).__name__)


def warn_not_compiled(what: str, error: BaseException) -> None:
    """Warn that a function runs with NumPy, and quote the line of code that prevents its compilation."""
    found: BaseException = error.__cause__ or error
    own = Path(namespace.__file__).parent
    frames = [f for f in traceback.extract_tb(found.__traceback__) if Path(f.filename).parent != own]
    line = (
        f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line})" if frames else ""
    )
    warnings.warn(f"{what} is not compiled and runs with NumPy: {error}{line}", stacklevel=2)


def share_world(model: Any, other: Any) -> bool:
    """Return whether two compiled models can share a simulated world: one task, and no feedback of either filter."""
    return model.task is other.task and model.programs.is_open_loop and other.programs.is_open_loop


def can_step(model: Any, report: Report) -> bool:
    """Return whether native code can step a model: it is compiled, and so can be this report on its steps."""
    if not isinstance(model, CompiledModel) or model.filter.in_python or report in model.programs.refused:
        return False
    try:
        model.programs.report_program(report)
    except NotTraceable as error:
        model.programs.refused.add(report)
        warn_not_compiled(f"{_name_of(report)} of {model.task.id}", error)
        return False
    return True
