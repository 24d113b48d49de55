"""Filters and policies in loops of one's own, one measurement at a time, with the numbers of an evaluation.

A filter of a compiled model takes in a measurement by one native call (:class:`CompiledUpdate`), any other by the
functions of its model (:class:`ModelUpdate`). A policy is asked about any number of episodes (:class:`SteppingPolicy`).
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...compiler.functions import (
    DTYPES,
    UNCOUNTED,
    Call,
    Leaf,
    Specialised,
    empty_lanes,
    leaves,
    map_arrays,
    round_up_lanes,
    run_over,
)
from ...compiler.sequence import CallList
from ...envs.contract.model import Episode, Model
from ...envs.engine.compiled import CompiledModel
from ...envs.engine.programs import Report
from ...envs.interface.requests import check_action
from .kinds import Policy
from .steered_filter import compile_policy, trace_decision

MODEL_ROWS = 128
"""Observations that a model of Stable-Baselines3 is asked about at once, always as many."""


class PolicyMemory(NamedTuple):
    """What a policy remembers between two steps."""

    calls: list[Any]
    """Of each call of the policy."""
    fresh: bool
    """Whether the episodes have yet to begin."""


class SteppingPolicy(Policy):
    """A policy for loops of one's own, where it answers what it answers in an evaluation, to the last bit.

    Matrix products round by their shape, and an episode must not depend on how many others there are. So the policy
    is asked about a multiple of eight observations, a model of Stable-Baselines3 always about as many, and the last
    one is repeated to fill up. A policy that is ``traceable`` is asked in compiled code where the model's steps are.

    Args:
        model: task with the bank that the policy steers.
        policy: anything with Stable-Baselines3's ``predict``.
        scenario: of the environment; None is its default.
        task_keywords: parameters of the task that the environment must be made with.
    """

    def __init__(
        self, model: Model, policy: Any, scenario: Any = None, task_keywords: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(model)
        self.policy = policy
        self.control = model.control  # type: ignore[misc]  # made for it
        self.scenario, self.task_keywords = scenario, dict(task_keywords or {})
        self._traced: Any = None
        self._is_traced = False

    @property
    def keywords(self) -> dict[str, Any]:
        """What ``gymnasium.make`` takes for an environment that the policy acts in."""
        scenario = {} if self.scenario is None else {"scenario": self.scenario}
        return {"control": self.control, **scenario, **self.task_keywords}

    def begin(self, seeds: Sequence[int]) -> PolicyMemory:
        """Return the state for the first :meth:`predict` of the episodes with these seeds.

        Only policies that draw numbers need it, ``random`` for one; for the others None does.
        """
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
        """Choose actions.

        Args:
            observation: ``(N, len(model.fields))``, or one observation without the batch axis.
            state: what the last call returned; at the first None, or what :meth:`begin` has returned.
            episode_start: ``(N,)`` booleans, or one; true where a new episode begins, as it does everywhere at the
                first call.
            deterministic: as in Stable-Baselines3.

        Returns:
            Actions, with the batch axis where the observation has it, and the state for the next call.

        Raises:
            ValueError: for a state of another number of episodes, or if the policy answers with no actions.
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
            raise ValueError(f"the state is not one of {len(batch)} episodes: begin anew with state=None")
        answers, kept = [], []
        for call, memory in zip(calls, memories, strict=True):
            answer, after = self._ask(batch[call], memory, start[call], deterministic)
            answers.append(check_action(self.model.action_space, answer, len(call)))
            kept.append(after)
        action = numpy.concatenate(answers)[: len(batch)]
        return (action[0] if single else action), PolicyMemory(kept, False)

    def _ask(
        self, observation: numpy.ndarray, memory: Any, start: numpy.ndarray, deterministic: bool
    ) -> tuple[Any, Any]:
        """Ask the policy, in code of the processor where it can be traced."""
        if not self._is_traced:
            self._traced, self._is_traced = compile_policy(self.model, self.policy, trace_decision), True
        if self._traced is None:
            answer: tuple[Any, Any] = self.policy.predict(
                observation, memory, start, deterministic=deterministic
            )
            return answer
        decide, nothing = self._traced
        width = len(observation)
        before = memory or map_arrays(lambda array: numpy.zeros((*array.shape[:-1], width)), nothing)
        action, after = decide(observation.T, before._replace(count=numpy.where(start, 0.0, 1.0)))
        return action.T, after

    def __getstate__(self) -> dict[str, Any]:
        """All but the code: a copy makes its own."""
        return {**self.__dict__, "_traced": None, "_is_traced": False}

    def _calls(self, count: int) -> list[numpy.ndarray]:
        """Episodes that each call of the policy is shown."""
        rows = MODEL_ROWS if hasattr(self.policy, "observation_space") else round_up_lanes(count)
        return [
            numpy.minimum(numpy.arange(first, first + rows), count - 1) for first in range(0, count, rows)
        ]


class MeasurementMemory:
    """Fixed memory of a measurement.

    Args:
        like: a measurement, for its shapes and types.
        tracks: how many come side by side; the last one is repeated up to a multiple of eight, as rounding in products
            of matrices must not depend on their number.

    Attributes:
        parts: its arrays, ``(..., width)``, of floats.
    """

    def __init__(self, like: Any, tracks: int) -> None:
        width, self._like = round_up_lanes(tracks), like
        self.parts = [empty_lanes(array.shape[:-1], width) for array in leaves(like)]
        self._is_nested = any(isinstance(part, tuple) for part in like)
        self._pad = None if tracks == 1 else numpy.minimum(numpy.arange(width), tracks - 1)
        self._lanes_first = [numpy.moveaxis(part, -1, 0) for part in self.parts]

    def put(self, measurement: Any) -> None:
        """Write a measurement of tracks, ``(..., N)``, or of one track without this axis."""
        found = leaves(measurement) if self._is_nested else [part for part in measurement if part is not None]
        if self._pad is None:
            for part, values in zip(self._lanes_first, found, strict=True):
                part[...] = values
        else:
            for part, values in zip(self.parts, found, strict=True):
                part[...] = values[..., self._pad]

    def copy(self) -> Any:
        """Return the measurement in new arrays of its own types."""
        parts = iter(self.parts)
        return map_arrays(lambda array: next(parts).astype(array.dtype, order="C"), self._like)


class CompiledUpdate:
    """The filter of a compiled model that takes in one measurement after another, bound to memory of its own: one native
    call a measurement, or two with an answer in Python between them.

    What the update hands on as it is stays in the memory of the prediction and of the measurement, so there are two of
    each by turns.

    Args:
        model: compiled, of a world that is live.
        report: dictionary of arrays, made after the measurement was taken in.
        tracks: how many are followed side by side.
        policy: traced (:func:`.steered_filter.trace_policy`); None: actions are put by :meth:`take`.
        is_asked: whether a policy answers in Python between :meth:`arrive` and :meth:`answer`.
        observe: report on a measurement before it is taken in, by an array ``(fields, N)``; None: what is shown.

    Attributes:
        shown: to a policy, ``(width, fields)``.
        observed: by ``observe``, likewise.
        blank_policy: memory of the traced policy before its first decision; None without.
    """

    def __init__(
        self,
        model: CompiledModel,
        report: Report,
        tracks: int,
        policy: Specialised | None = None,
        is_asked: bool = False,
        observe: Report | None = None,
    ) -> None:
        update, _, predict, episode = model.programs.later
        tell, first = model.programs.report_program(report), model.programs.first.predict
        watch = None if observe is None else model.programs.function(observe).specialise(episode)
        self._width, self._threads = round_up_lanes(tracks), model.threads
        count = itertools.count()
        self._template = map_arrays(lambda _: next(count), episode.filter)
        self._kinds = [array.dtype.kind for array in leaves(episode.filter)]
        self.shown = self.observed = numpy.zeros((self._width, predict.outputs[-1].shape[0]))
        fields = [] if watch is None else self._memory(watch.outputs)
        if fields:
            self.observed = fields[0].T
        self._written, reported = self._memory(update.outputs), self._memory(tell.outputs)
        self._action = empty_lanes(update.inputs[-1].shape, self._width)
        self._action[...] = 0.0
        self._policy = [self._memory(policy.outputs[1:] if policy else ()) for _ in range(2)]
        self._policy_template = None if policy is None else map_arrays(lambda i: i - 1, policy.template[1])
        self.blank_policy = map_arrays(lambda i: 0.0 * numpy.ones_like(self._policy[0][i]), self._policy_template)
        self._received = [MeasurementMemory(episode.measurement, tracks) for _ in range(2)]
        predicted = [self._memory(predict.outputs[:-1]) for _ in range(2)]
        self._states: list[list[numpy.ndarray]] = []
        answers: list[list[Call]] = []
        for now, received in enumerate(self._received):
            given = [*predicted[now], *received.parts, self._action]
            after = [own if i is None else given[i] for own, i in zip(self._written, update.same, strict=True)]
            self._states.append(after[: len(self._kinds)])
            steer = [] if policy is None else [
                policy.bound([self.shown, *self._policy[1 - now]], [self._action, *self._policy[now]])
            ]
            told = tell.bound([*received.parts, *self._states[now]], reported)
            answers.append([*steer, update.bound(given, self._written), told])
        self._states.append(self._written[: len(self._kinds)])
        self._calls: list[Call] = []
        self._arrivals: list[CallList] = []
        for before, program, now in ((0, predict, 1), (1, predict, 0), (2, first, 0)):
            parts = self._received[now].parts
            calls = [program.bound([*self._states[before], *parts], [*predicted[now], self.shown])]
            if watch is not None:
                calls.append(watch.bound([*parts, *predicted[now]], fields))
            calls += [] if is_asked else answers[now]
            self._arrivals.append(CallList(calls))
            self._calls += calls
        self._answers = [CallList(calls) for calls in answers] if is_asked else []
        self._calls += [call for calls in answers if is_asked for call in calls]
        self._now, self._stepped = 2, 0
        cut: Any = (..., 0) if tracks == 1 else (..., slice(tracks))
        self._report = [(name, reported[i][cut]) for name, i in tell.template.items()]

    def _memory(self, outputs: Sequence[Leaf]) -> list[numpy.ndarray]:
        return [empty_lanes(leaf.shape, self._width) for leaf in outputs]

    def arrive(self, measurement: Any) -> None:
        """Predict to a measurement, and take it in where nothing is asked in Python."""
        self._stepped += self._width
        if self._stepped > UNCOUNTED:
            for call in self._calls:
                call.expect(self._stepped // 2)
            self._stepped = 0
        before, self._now = self._now, 1 if self._now == 0 else 0
        self._received[self._now].put(measurement)
        run_over(self._arrivals[before], self._width, self._threads)

    def take(self, action: numpy.ndarray) -> None:
        """Apply an action from now on, ``(width, ...)``."""
        self._action[...] = action.T

    def answer(self) -> None:
        """Take the measurement in, where that was not done."""
        if self._answers:
            run_over(self._answers[self._now], self._width, self._threads)

    def report(self) -> dict[str, Any]:
        """Return the report in arrays ``(..., N)`` of the caller's own, of one track without this axis."""
        return {name: array.copy() if array.ndim else array[()] for name, array in self._report}

    @property
    def state(self) -> Any:
        """State of the filter, in arrays of the caller's own."""
        arrays = self._states[self._now]
        return map_arrays(lambda i: arrays[i].astype(DTYPES[self._kinds[i]], order="C"), self._template)

    @property
    def policy_state(self) -> Any:
        """Memory of the traced policy, likewise."""
        return map_arrays(lambda i: self._policy[1 if self._now else 0][i].copy(), self._policy_template)

    def go_on(self, state: Any, policy: Any) -> None:
        """Go on from a state of the filter, and from a memory of the traced policy."""
        for memory, values in zip(self._written, leaves(state), strict=False):
            memory[...] = values
        if self._policy_template is not None:
            for memory, values in zip(self._policy[1], leaves(policy), strict=True):
                memory[...] = values
        self._now = 2


class ModelUpdate:
    """The same by the functions of a model, whatever computes them; arguments as of :class:`CompiledUpdate`."""

    blank_policy = policy_state = None

    def __init__(self, model: Model, report: Report, tracks: int, like: Any, observe: Report | None) -> None:
        self._model, self._make_report, self._tracks, self._observe = model, report, tracks, observe
        self._received = MeasurementMemory(like, tracks)
        self._episode: Any = None
        shape = model.action_space.shape or ()
        self._is_box, self._action = bool(shape), numpy.zeros((*shape, round_up_lanes(tracks)))
        self._reported: dict[str, numpy.ndarray] = {}
        self.state: Any = None
        """Of the filter, arrays that never change."""
        self.observed: Any = None

    @property
    def shown(self) -> numpy.ndarray:
        """Shown to a policy, ``(width, fields)``."""
        return numpy.asarray(self._model.observe(self._episode)).T

    def arrive(self, measurement: Any) -> None:
        """Predict to a measurement."""
        self._received.put(measurement)
        measured = self._received.copy()
        self._episode = Episode((), measured, self._model.predict_filter(self.state, measured))
        if self._observe is not None:
            self.observed = self._model.run(self._observe, self._episode).T

    def take(self, action: numpy.ndarray) -> None:
        """Apply an action from now on, ``(width, ...)``."""
        self._action = numpy.asarray(action.T, dtype=float) if self._is_box else action.T

    def answer(self) -> None:
        """Take the measurement in."""
        after = self._model.act(self._episode, self._action)
        self.state, self._reported = after.filter, self._model.run(self._make_report, after)

    def report(self) -> dict[str, Any]:
        """Return the report in arrays ``(..., N)`` of the caller's own, of one track without this axis."""
        cut: Any = (..., 0) if self._tracks == 1 else (..., slice(self._tracks))
        return {name: numpy.copy(array[cut])[()] for name, array in self._reported.items()}

    def go_on(self, state: Any, policy: Any) -> None:
        """Go on from a state of the filter."""
        self.state = state
