"""Filters and policies called by the user for one measurement at a time, with the same numbers as an evaluation.

A compiled filter processes a measurement by one native call (:class:`CompiledUpdate`), any other by its
model's functions (:class:`ModelUpdate`). :class:`SteppingPolicy` computes the actions of any number of
episodes.
"""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...compiler.functions import (
    Call,
    Specialised,
    copy_arrays,
    empty_lanes,
    leaves,
    map_arrays,
    memory_of,
    round_up_lanes,
)
from ...compiler.sequence import CallSequence
from ...envs.contract.model import Episode, Model
from ...envs.engine.compiled import CompiledModel
from ...envs.engine.programs import Report
from ...envs.interface.requests import check_action
from .kinds import Policy
from .steered_filter import compile_policy, trace_policy

MODEL_ROWS = 128
"""Fixed number of observations in a call of a Stable-Baselines3 model."""


class PolicyMemory(NamedTuple):
    """Memory of a :class:`SteppingPolicy` between two calls."""

    calls: list[Any]
    """Memory of the policy for each of its calls."""
    fresh: bool
    """Whether the episodes have not begun yet."""


class SteppingPolicy(Policy):
    """Policy for a user's loop, whose actions equal those in an evaluation to the last bit.

    Rounding in matrix products depends on their shape, so the policy is called with a multiple of eight
    observations, a Stable-Baselines3 model with ``MODEL_ROWS``, the last one repeated.

    Args:
        model: task with the bank that the policy controls.
        policy: object with Stable-Baselines3's method ``predict``.
        scenario: scenario of the environment; None: its default.
        task_keywords: parameters of the task with which the environment must be made.
    """

    def __init__(
        self, model: Model, policy: Any, scenario: Any = None, task_keywords: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(model)
        self.policy = policy
        self.control: str = model.control  # type: ignore[misc]  # the control of its model
        self.scenario = scenario
        self.task_keywords: dict[str, Any] = dict(task_keywords or {})
        self._traced: Specialised | None = None
        self._is_traced = False
        self._bound: dict[int, tuple[list[numpy.ndarray], list[numpy.ndarray], Call]] = {}
        """Inputs and outputs of the traced policy, and the call, by the number of observations."""

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gymnasium.make`` for the environment of the policy."""
        scenario = {} if self.scenario is None else {"scenario": self.scenario}
        return {"control": self.control, **scenario, **self.task_keywords}

    def begin(self, seeds: Sequence[int]) -> PolicyMemory:
        """Return the memory before the first :meth:`predict`; only random policies need it."""
        own = self.policy
        return PolicyMemory(
            [
                own.begin([seeds[i] for i in call]) if isinstance(own, Policy) else None
                for call in self._calls(len(seeds))
            ],
            True,
        )

    def predict(
        self,
        observation: numpy.ndarray,
        state: PolicyMemory | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[numpy.ndarray, PolicyMemory]:
        """Return the actions for a batch of observations or for one, and the memory for the next call.

        Args:
            observation: ``(N, len(model.fields))``, or one observation without the batch axis.
            state: memory that the last call returned; at the first call None, or the memory of :meth:`begin`.
            episode_start: mask of new episodes, ``(N,)`` booleans, or one; all are new at the first call.
            deterministic: as in Stable-Baselines3.

        Raises:
            ValueError: for a state of another number of episodes, or if the policy returns no actions.
        """
        single = numpy.ndim(observation) == 1
        batch = numpy.atleast_2d(observation)
        calls = self._calls(len(batch))
        start = numpy.zeros(len(batch), dtype=bool)
        if state is None or state.fresh:
            start[:] = True
        elif episode_start is not None:
            start[:] = episode_start
        memories = [None] * len(calls) if state is None else state.calls
        if len(memories) != len(calls):
            raise ValueError(f"the state is not one of {len(batch)} episodes: start again with state=None")
        answers, kept = [], []
        for call, memory in zip(calls, memories, strict=True):
            answer, after = self._act(batch[call], memory, start[call], deterministic)
            answers.append(check_action(self.model.action_space, answer, len(call)))
            kept.append(after)
        action = numpy.concatenate(answers)[: len(batch)]
        return (action[0] if single else action), PolicyMemory(kept, False)

    def _act(
        self, observation: numpy.ndarray, memory: Any, start: numpy.ndarray, deterministic: bool
    ) -> tuple[Any, Any]:
        """Return actions and memory of one call of the policy, in native code where it can be traced."""
        if not self._is_traced:
            trace = functools.partial(trace_policy, interval=1)
            self._traced, self._is_traced = compile_policy(self.model, self.policy, trace), True
        traced = self._traced
        if traced is None:
            answer: tuple[Any, Any] = self.policy.predict(
                observation, memory, start, deterministic=deterministic
            )
            return answer
        width = len(observation)
        if width not in self._bound:
            read = [numpy.zeros(observation.shape), *memory_of(traced.inputs[1:], width)]
            written = memory_of(traced.outputs, width)
            self._bound[width] = read, written, traced.bound(read, written)
        read, written, call = self._bound[width]
        before = leaves(memory and memory._replace(count=numpy.where(start, 0.0, 1.0)))
        for array, values in zip(read, [observation, *(before or [0.0] * (len(read) - 1))], strict=True):
            array[...] = values
        call(0, width)
        action, after = copy_arrays(traced.template, written, [leaf.kind for leaf in traced.outputs])
        return action.T, after

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without compiled code, since a copy compiles its own."""
        return {**self.__dict__, "_traced": None, "_is_traced": False, "_bound": {}}

    def _calls(self, count: int) -> list[numpy.ndarray]:
        """Return the episodes' indices for each call of the policy, padded with the last one."""
        rows = MODEL_ROWS if hasattr(self.policy, "observation_space") else round_up_lanes(count)
        return [
            numpy.minimum(numpy.arange(first, first + rows), count - 1) for first in range(0, count, rows)
        ]


class MeasurementMemory:
    """Preallocated arrays ``(..., width)`` for a measurement of all tracks, padded to a multiple of eight
    lanes.
    """

    def __init__(self, like: Any, tracks: int) -> None:
        width, self._like = round_up_lanes(tracks), like
        self.parts: list[numpy.ndarray] = [empty_lanes(array.shape[:-1], width) for array in leaves(like)]
        self._is_flat = not any(isinstance(part, tuple) for part in like)
        self._pad = None if tracks == 1 else numpy.minimum(numpy.arange(width), tracks - 1)
        self._places = self.parts if tracks > 1 else [numpy.moveaxis(part, -1, 0) for part in self.parts]

    def put(self, measurement: Any) -> None:
        """Write a measurement into the arrays: of several tracks, ``(..., N)``, or of one without this axis."""
        found = [part for part in measurement if part is not None] if self._is_flat else leaves(measurement)
        for place, values in zip(self._places, found, strict=True):
            place[...] = values if self._pad is None else values[..., self._pad]

    def copy(self) -> Any:
        """Return the measurement in new arrays of its own types."""
        parts = iter(self.parts)
        return map_arrays(lambda array: next(parts).astype(array.dtype, order="C"), self._like)


class CompiledUpdate:
    """Filter of a compiled model with its own memory, run by one native call for each measurement.

    Where a policy acts in Python there are two calls, one before the action and one after it.

    Two memories are used alternately, since outputs may share memory with inputs.

    Args:
        model: compiled model, whose world takes measurements from outside.
        report: function that returns a dictionary of arrays after the update.
        tracks: number of parallel tracks.
        policy: traced policy, see :func:`.steered_filter.trace_policy`; None without.
        in_python: whether a policy acts in Python.
        observe: function that returns ``(fields, N)`` before the update; None: the observation of a policy.

    Attributes:
        observation: observation of a policy, ``(width, fields)``.
        observed: values of ``observe``, ``(width, fields)``.
        blank_policy: memory of the traced policy before its first decision.
    """

    def __init__(
        self,
        model: CompiledModel,
        report: Report,
        tracks: int,
        policy: Specialised | None = None,
        in_python: bool = False,
        observe: Report | None = None,
    ) -> None:
        update, _, predict, episode = model.programs.later
        tell, first = model.programs.report_program(report), model.programs.first.predict
        watch = observe and model.programs.function(observe).specialise(episode)
        self._width = width = round_up_lanes(tracks)
        self._threads, count = model.threads, itertools.count()
        self._template = map_arrays(lambda _: next(count), episode.filter)
        self._kinds = [array.dtype.kind for array in leaves(episode.filter)]
        self._policy_template = map_arrays(lambda i: i - 1, policy and policy.template[1])
        self._policies = [memory_of(policy.outputs[1:] if policy else (), width) for _ in range(2)]
        self.blank_policy: Any = map_arrays(
            lambda i: numpy.zeros_like(self._policies[0][i]), self._policy_template
        )
        self._received = [MeasurementMemory(episode.measurement, tracks) for _ in range(2)]
        predicted = [memory_of(predict.outputs[:-1], width) for _ in range(2)]
        written, reported = memory_of(update.outputs, width), memory_of(tell.outputs, width)
        (self._action,), fields = (
            memory_of(update.inputs[-1:], width),
            memory_of(watch.outputs if watch else (), width),
        )
        self._action[...] = 0.0
        self.observation: numpy.ndarray = numpy.zeros((width, predict.outputs[-1].shape[0]))
        self.observed: numpy.ndarray = fields[0].T if fields else self.observation
        self._states: list[list[numpy.ndarray]] = []
        """States after the update in each memory, and one set from outside."""
        looks, answers = [], []
        for now, received in enumerate(self._received):
            given = [*predicted[now], *received.parts, self._action]
            after = [own if i is None else given[i] for own, i in zip(written, update.same, strict=True)]
            self._states.append(after[: len(self._kinds)])
            memories = [self.observation, *self._policies[1 - now]], [self._action, *self._policies[now]]
            looks.append([watch.bound([*received.parts, *predicted[now]], fields)] if watch else [])
            report_call = tell.bound([*received.parts, *self._states[now]], reported)
            steer = [policy.bound(*memories)] if policy else []
            answers.append([*steer, update.bound(given, written), report_call])
        self._states.append(written[: len(self._kinds)])
        arrivals = []
        for before, program, now in ((0, predict, 1), (1, predict, 0), (2, first, 0)):
            read, ahead = (
                [*self._states[before], *self._received[now].parts],
                [*predicted[now], self.observation],
            )
            answered = [] if in_python else answers[now]
            arrivals.append([program.bound(read, ahead), *looks[now], *answered])
        self._arrivals, self._answers = [CallSequence(calls) for calls in arrivals], []
        if in_python:
            self._answers = [CallSequence(calls) for calls in answers]
        self._now = 2
        cut: Any = (..., 0) if tracks == 1 else (..., slice(tracks))
        self._report = [(name, reported[i][cut]) for name, i in tell.template.items()]

    def receive(self, measurement: Any) -> None:
        """Predict to a measurement, and update with it unless a policy acts in Python."""
        before, now = self._now, int(self._now == 0)
        self._received[now].put(measurement)
        self._now = now
        self._arrivals[before].run(self._width, self._threads)

    def act(self, action: numpy.ndarray) -> None:
        """Update with the received measurement and an action from Python, ``(width, ...)``."""
        self._action[...] = action.T
        self._answers[self._now].run(self._width, self._threads)

    def report(self) -> dict[str, Any]:
        """Return a copy of the report after the update: arrays ``(..., N)`` by name."""
        return {name: array.copy() if array.ndim else array[()] for name, array in self._report}

    @property
    def state(self) -> Any:
        """Copy of the state of the filter."""
        return copy_arrays(self._template, self._states[self._now], self._kinds)

    @property
    def policy_state(self) -> Any:
        """Copy of the memory of the traced policy."""
        return map_arrays(lambda i: self._policies[self._now > 0][i].copy(), self._policy_template)

    def resume(self, state: Any, policy: Any) -> None:
        """Set the state of the filter and the memory of the traced policy."""
        self._now = 2
        arrays = leaves(state) + (leaves(policy) if self._policy_template else [])
        for memory, values in zip([*self._states[2], *self._policies[1]], arrays, strict=True):
            memory[...] = values


class ModelUpdate:
    """Filter of a model, run by the model's own functions for each measurement.

    Arguments as of :class:`CompiledUpdate`; ``like`` is a measurement, as template of shapes and types.
    """

    blank_policy = policy_state = None

    def __init__(self, model: Model, report: Report, tracks: int, like: Any, observe: Report | None) -> None:
        self._model, self._make_report = model, report
        self._observe: Any = observe
        self._cut: Any = (..., 0) if tracks == 1 else (..., slice(tracks))
        self._received = MeasurementMemory(like, tracks)
        self.state: Any = None
        """State of the filter, in arrays that are never changed."""

    def receive(self, measurement: Any) -> None:
        """Store a measurement and predict the filter to its time."""
        self._received.put(measurement)
        measured = self._received.copy()
        self._episode = Episode((), measured, self._model.predict_filter(self.state, measured))

    @property
    def observation(self) -> numpy.ndarray:
        """Observation for a policy, ``(width, fields)``."""
        return numpy.asarray(self._model.observe(self._episode)).T

    @property
    def observed(self) -> numpy.ndarray:
        """Values of the function ``observe``, ``(width, fields)``."""
        return numpy.asarray(self._model.run(self._observe, self._episode)).T

    def act(self, action: numpy.ndarray) -> None:
        """Update with the received measurement and an action, ``(width, ...)``."""
        turned = numpy.asarray(action.T, dtype=float if self._model.action_space.shape else None)
        self._episode = self._model.act(self._episode, turned)
        self.state = self._episode.filter

    def report(self) -> dict[str, Any]:
        """Return a copy of the report after the update: arrays ``(..., N)`` by name, without N for one track."""
        reported = self._model.run(self._make_report, self._episode)
        return {name: numpy.copy(array[self._cut])[()] for name, array in reported.items()}

    def resume(self, state: Any, policy: Any) -> None:
        """Set the state of the filter."""
        self.state = state
