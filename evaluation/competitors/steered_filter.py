"""Bank and policy combined in one filter, which computes the policy's actions itself.

So the policy is compiled and exported with its bank.
"""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler import namespace
from ...compiler.block import LANES
from ...compiler.functions import Specialised, leaves, map_arrays
from ...compiler.namespace import NotTraceable
from ...compiler.program import Graph
from ...envs.contract.filter import FilterInput
from ...envs.contract.model import Episode, Model
from ...envs.contract.observation import Array, DecisionMeans
from ...envs.engine.compiled import CompiledModel, warn_not_compiled
from .filters import AroundBank
from .kinds import Policy, is_traceable


class Decisions(NamedTuple):
    """State of a policy in a filter: its memory, the present action, and sums since the last decision."""

    memory: Any
    """Memory of the policy, every array as ``(entries, N)``; zeros before its first decision."""
    count: Array
    """Number of measurements since the last decision, including that of the decision; zero before the first one,
    ``(N,)``."""
    action: Array
    """Present action, ``(A, N)``."""
    total: Array
    """Sums since the last decision of the fields that are observed as means, ``(fields, N)``."""


Act = Callable[[Array, Any, Array], tuple[Array, Any]]
"""Function from observations ``(N, fields)``, a memory and a mask of new episodes ``(N,)`` to actions ``(N, A)`` or
``(N,)`` and the memory.
"""


class Decider:
    """Policy inside a filter: its action changes only at measurements where a decision is due.

    Args:
        model: model that defines the observations.
        act: function that computes the actions.
        memory: a memory of the policy for one track, as template. The batch is the first axis of each array
            or else the last.
        interval: number of measurements for which an action holds; default: the task's decision interval.
    """

    def __init__(self, model: Model, act: Act, memory: Any, interval: int | None = None) -> None:
        self._template = memory
        self.xp: ModuleType = model.task.xp
        self.act = act
        self._shapes = [(numpy.shape(array), numpy.asarray(array).dtype.kind) for array in leaves(memory)]
        self.space: gymnasium.Space[Any] = model.action_space
        self.size: int = math.prod(self.space.shape or (1,))
        self.interval: int = model.task.decision_interval if interval is None else interval
        self.means: DecisionMeans = DecisionMeans(model.fields, self.interval)

    def start(self, zero: Array) -> Decisions:
        """Return the policy's state before the first decision, for as many tracks as there are zeros in
        ``zero``.
        """
        memory = map_arrays(
            lambda array: self.xp.stack([zero] * max(int(numpy.size(array)), 1)), self._template
        )
        action = self.xp.stack([zero] * self.size)
        return Decisions(memory, zero, action, self.xp.stack([zero] * max(len(self.means.columns), 1)))

    def is_due(self, state: Decisions) -> Array:
        """Return a mask ``(N,)`` of tracks for which a decision is due at the next measurement."""
        return (state.count == 0.0) | (state.count >= float(self.interval))

    def decide(self, observation: Array, state: Decisions) -> tuple[Array, Decisions]:
        """Update the policy's state with an observation ``(fields, N)``; return the present action and the
        state.
        """
        xp, K = self.xp, self.interval
        first = state.count == 0.0
        due, total = self.is_due(state), state.total
        if self.means.columns:
            total = xp.where(first, 0.0, self.means.add(total, observation))
            observation = xp.where(first, observation, self.means.show(observation, total, xp))
            total = xp.where(due, 0.0, total)
        chosen, memory = self._act(observation, state.memory, first)
        if K > 1:
            chosen = xp.where(due, chosen, state.action)
            kept = iter(leaves(state.memory))
            memory = map_arrays(lambda array: xp.where(due, array, next(kept)), memory)
        action = chosen if self.space.shape else xp.astype(chosen[0], xp.int64)
        # Never more than the interval: float has no consecutive whole numbers beyond 2^24, for a filter that runs for
        # days.
        count = xp.where(due, 1.0, state.count + 1.0) if K > 1 else xp.ones_like(state.count)
        return action, Decisions(memory, count, chosen, total)

    def _act(self, observation: Array, memory: Any, first: Array) -> tuple[Array, Any]:
        """Call the policy; return its action ``(A, N)`` and its memory, arrays ``(entries, N)``."""
        shapes, N = iter(self._shapes), observation.shape[-1]

        def restore(array: Array) -> Array:
            shape, kind = next(shapes)
            if shape[:1] == (1,):
                number = self.xp.reshape(array.T, (-1, *shape[1:]))
            else:
                number = self.xp.reshape(array, (*shape[:-1], N) if shape[-1:] == (1,) else shape)
            return number > 0.5 if kind == "b" else number

        def flatten(array: Array, shape: tuple[int, ...] = (1,)) -> Array:
            array = self.xp.asarray(array)
            if shape[:1] != (1,) and shape[-1:] == (1,):
                rows = self.xp.reshape(array, (-1, N))
            else:
                rows = self.xp.reshape(array, (N if shape[:1] == (1,) else 1, -1)).T
            return self.xp.astype(rows, self.xp.float64)

        chosen, memory = self.act(observation.T, map_arrays(restore, memory), first)
        chosen = self.xp.asarray(chosen)
        if chosen.size != self.size * N or (chosen.dtype.kind == "f" and not self.space.shape):
            raise ValueError(
                f"expected an action of {self.space}, got {chosen.dtype} of shape {chosen.shape}"
            )
        remembered = iter(shape for shape, _ in self._shapes)
        return flatten(chosen), map_arrays(lambda array: flatten(array, next(remembered)), memory)


class PolicyFilterState(NamedTuple):
    """State of a :class:`SteeredFilter`."""

    bank: Any
    """State of the bank."""
    policy: Decisions
    """State of the policy."""


class SteeredFilter(AroundBank[PolicyFilterState]):
    """Filter that consists of a bank and the policy that steers it."""

    def __init__(self, model: Model, decider: Decider) -> None:
        super().__init__(model.task)
        self.model = model
        self.bank: Any = model.filter
        self.decider = decider
        self.adapts_covariance: bool = self.bank.adapts_covariance

    def start(self, initial: Any) -> PolicyFilterState:
        """Start bank and policy; return their states."""
        return PolicyFilterState(self.bank.start(initial), self.decider.start(0.0 * initial.mean[0]))

    def update(self, state: PolicyFilterState, inputs: FilterInput) -> PolicyFilterState:
        """Choose the policy's action where a decision is due, and update the bank with it; return the states."""
        observation = self.model.observe(Episode(None, inputs.measurement, state.bank))
        action, decisions = self.decider.decide(observation, state.policy)
        return PolicyFilterState(self.bank.act(state.bank, inputs.measurement, action), decisions)

    def records(self, state: PolicyFilterState, measurement: Any) -> dict[str, Array]:
        """Return the bank's statistics of the measurement by name."""
        return self.bank.records(state.bank, measurement)


def decider_of(model: Model, policy: Policy, interval: int | None = None) -> Decider:
    """Make the :class:`Decider` of a policy in a model."""
    blank = numpy.zeros((1, len(model.fields)))
    with numpy.errstate(all="ignore"):
        _, memory = policy.act(blank, None, numpy.ones(1, dtype=bool))
    return Decider(model, policy.act, memory, interval)


def steer(model: Model, policy: Policy, interval: int | None = None) -> SteeredFilter:
    """Return a filter that combines the bank of a model with a policy; arguments as of :func:`decider_of`."""
    return SteeredFilter(model, decider_of(model, policy, interval))


def trace_policy(model: CompiledModel, policy: Policy, interval: int | None = None) -> Specialised:
    """Trace a policy as a function of observation and :class:`Decisions`, ready for compilation.

    The function returns an action and the next :class:`Decisions`, which are zero before the first decision.

    Args:
        model: compiled model of the policy.
        policy: policy made for that model.
        interval: number of measurements for which an action holds.

    Raises:
        NotTraceable: if its arithmetic cannot be traced.
    """
    graph = Graph(loops=True)
    with namespace.tracing(graph):
        decider = decider_of(model.programs.traced, policy, interval)
        nothing = decider_of(model, policy, interval).start(numpy.zeros(LANES))
    shown = numpy.zeros((len(model.fields), LANES))
    return Specialised(decider.decide, graph, (shown, nothing), unchanged=0, given_turned=True)


def compile_policy(model: Model, policy: Any, trace: Callable[[CompiledModel, Policy], Any]) -> Any:
    """Trace a policy that is declared traceable; None, with a warning if tracing fails, where it must run in
    Python.
    """
    if not (isinstance(model, CompiledModel) and isinstance(policy, Policy) and is_traceable(policy)):
        return None
    try:
        return trace(model, policy)
    except NotTraceable as error:
        warn_not_compiled(f"policy {type(policy).__name__} of {model.task.id}", error)
        return None
