"""A bank closed by a policy: a filter like any other, which needs nobody who asks the policy.

Traced for one track, its arithmetic is a straight line: what steers is then compiled and exported with its bank.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy

from ..compiler.functions import leaves, map_arrays
from ..envs.filter import Filter, Input
from ..envs.model import Episode, Model
from ..envs.observation import Array
from .competitors import Policy


class Steered(NamedTuple):
    """State of a steered filter."""

    bank: Any
    """Of the bank."""
    memory: Any
    """What the policy remembers, every array as ``(entries, N)``; before its first decision zeros."""
    count: Array
    """Measurements taken in since the last decision, that of the decision among them; zero before the first one,
    ``(N,)``."""
    action: Array
    """In force, ``(A, N)``."""
    total: Array
    """Sums over the measurements since the last decision of the fields that are shown as means, ``(fields, N)``."""


Act = Callable[[Array, Any, Array], tuple[Array, Any]]
"""From an observation ``(N, fields)``, memory, and whether the episode begins ``(N,)``, to an action ``(N, A)`` or
``(N,)`` and the memory."""


class SteeredFilter(Filter[Any, Any, Steered]):
    """A bank closed by a policy.

    Args:
        model: with the bank.
        act: asks the policy.
        memory: that the policy returns, arrays of one track; their values do not matter. Where one is not batch first,
            the filter is for one track: N is 1, or the arrays are traced.
        interval: measurements for which an action holds; default: the task's decision interval.
    """

    def __init__(self, model: Model, act: Act, memory: Any, interval: int | None = None) -> None:
        super().__init__(model.task)
        self.model, self.bank, self.ask = model, model.filter, act
        self._shapes = shapes_of(memory)
        self._template = memory
        self.interval = self.task.decision_interval if interval is None else interval
        averaged = [i for i, f in enumerate(model.fields) if f.over_interval == "mean"]
        self.averaged = averaged if self.interval > 1 else []

    def start(self, initial: Any) -> Steered:
        """Start the bank; the policy begins at its first decision."""
        zero = 0.0 * initial.mean[0]
        memory = map_arrays(
            lambda array: self.xp.stack([zero] * max(int(numpy.size(array)), 1)), self._template
        )
        size = int(numpy.prod(self.bank.action_space.shape or (1,)))
        return Steered(
            self.bank.start(initial),
            memory,
            zero,
            self.xp.stack([zero] * size),
            self.xp.stack([zero] * max(len(self.averaged), 1)),
        )

    def predict(self, state: Steered, measurement: Any) -> Steered:
        """Predict in the bank."""
        return state._replace(bank=self.bank.predict(state.bank, measurement))

    def is_due(self, state: Steered) -> Array:
        """Whether the policy is asked at the next measurement, ``(N,)``."""
        first = state.count == 0.0
        return first | (state.count >= float(self.interval))

    def update(self, state: Steered, given: Input) -> Steered:
        """Ask the policy where a decision is due, and apply its action."""
        xp, K = self.xp, self.interval
        observation = self.model.observe(Episode(None, given.measurement, state.bank))
        first = state.count == 0.0
        due, total = self.is_due(state), state.total
        if self.averaged:
            total = xp.where(first, 0.0, total + xp.stack([observation[i] for i in self.averaged]))
            means = xp.where(first, xp.stack([observation[i] for i in self.averaged]), total / K)
            place = {field: i for i, field in enumerate(self.averaged)}
            observation = xp.stack(
                [means[place[i]] if i in place else observation[i] for i in range(len(self.model.fields))]
            )
            total = xp.where(due, 0.0, total)
        answer, memory = self._decide(observation, state.memory, first)
        if K > 1:
            answer = xp.where(due, answer, state.action)
            kept = iter(leaves(state.memory))
            memory = map_arrays(lambda array: xp.where(due, array, next(kept)), memory)
        action = answer if self.bank.action_space.shape else xp.astype(answer[0], xp.int64)
        bank = self.bank.act(state.bank, given.measurement, action)
        # Never more than the interval: float has no whole numbers beyond 2^24 for a filter that runs for days.
        count = xp.where(due, 1.0, state.count + 1.0) if K > 1 else xp.ones_like(state.count)
        return Steered(bank, memory, count, answer, total)

    def _decide(self, observation: Array, memory: Any, first: Array) -> tuple[Array, Any]:
        """Action ``(A, N)`` and memory, every array ``(entries, N)``."""
        shapes, N = iter(self._shapes), observation.shape[-1]

        def restore(array: Array) -> Array:
            shape, kind = next(shapes)
            several = shape[:1] == (1,)
            number = self.xp.reshape(array.T, (-1, *shape[1:])) if several else self.xp.reshape(array, shape)
            return number > 0.5 if kind == "b" else number

        def flatten(array: Array, several: bool = True) -> Array:
            rows = self.xp.reshape(self.xp.asarray(array), (N, -1) if several else (1, -1))
            return self.xp.astype(rows.T, self.xp.float64)

        answer, memory = self.ask(observation.T, map_arrays(restore, memory), first)
        batched = iter(shape[:1] == (1,) for shape, _ in self._shapes)
        return flatten(answer), map_arrays(lambda array: flatten(array, next(batched)), memory)

    def mean(self, state: Steered) -> Array:
        """That of the bank."""
        return self.bank.mean(state.bank)

    def covariance(self, state: Steered) -> Array:
        """That of the bank."""
        return self.bank.covariance(state.bank)

    def feedback(self, state: Steered, measurement: Any) -> Any:
        """That of the bank."""
        return self.bank.feedback(state.bank, measurement)

    def records(self, state: Steered, measurement: Any) -> dict[str, Array]:
        """Those of the bank."""
        return self.bank.records(state.bank, measurement)


def shapes_of(memory: Any) -> list[tuple[tuple[int, ...], str]]:
    """Shapes and kinds of the arrays that a policy remembers."""
    return [(numpy.shape(array), numpy.asarray(array).dtype.kind) for array in leaves(memory)]


def steer(model: Model, policy: Policy, interval: int | None = None) -> SteeredFilter:
    """Close the bank of a model by a policy, made for the same task on NumPy arrays.

    Args:
        model: on NumPy or traced arrays.
        policy: whose ``act`` is arithmetic of NumPy.
        interval: measurements for which an action holds; default: the task's decision interval.

    Raises:
        NotTraceable: on traced arrays, where it is not.
    """
    blank = numpy.zeros((1, len(model.fields)))
    with numpy.errstate(all="ignore"):
        _, memory = policy.act(blank, None, numpy.ones(1, dtype=bool))
    return SteeredFilter(model, policy.act, memory, interval)
