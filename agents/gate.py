"""Do no harm: an agent is trusted only while something is wrong that it has met in its training.

Where filters and sensors are as modelled a classical filter is hard to beat and easy to harm, and what a network
answers to what it never saw nobody knows. So an agent is trusted while an alarm (:mod:`..baselines.alarm`) has spoken
within the last decisions, and what it is shown lies within what it saw in training (:mod:`.envelope`). Who is not
trusted goes on all the same, so that it remembers the whole episode when its time comes.

There are two gates. ``gated:NAME`` runs two filters side by side, the agent's and a classical one, and answers with the
estimate of the one that is trusted (:class:`GatedEstimator`): the fallback may be any policy or estimator, whatever the
agent steers, and in a closed loop the estimate that is trusted flies. In training (``--gated``) both share one filter,
and the gate holds back the agent's action (:class:`Gated`): the fallback is an action of the same control.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy

from ..baselines.alarm import Alarm, InnovationAlarm
from ..baselines.problem import Problem, problem_of
from ..envs.contract.failures import explain_errors
from ..envs.contract.filter import Filter, FilterInput, Likelihood
from ..envs.contract.model import Model
from ..envs.contract.observation import Array
from ..envs.contract.task import Task
from ..evaluation.competitors.filters import Adapter, as_filter
from ..evaluation.competitors.kinds import (
    Competitor,
    ConstantPolicy,
    Kind,
    Policy,
    RandomPolicy,
    check_competitor,
    expose_spaces,
    kind_of,
    make_competitor,
    says_traceable,
)
from ..evaluation.competitors.steered_filter import Decider
from ..evaluation.running.evaluate import control_of
from ..evaluation.running.metrics import mean_cost
from .envelope import EnvelopeAlarm, TrainingRange, training_range
from .learned_estimator import EstimatorMaker, LearnedEstimator
from .residual import ResidualPolicy, policy_to_correct

CHECKED_EPISODES = 128
"""Of the validation split on which a fallback is compared with the paper's algorithm."""
MOST_ODDS = math.log(100.0)
"""Log-odds of one filter to another beyond which nothing is remembered (ours: decisive by Jeffreys' scale)."""
SIGNIFICANT = 3.0
"""Standard errors by which a fallback that is refused costs more, and normalised innovations are too large."""
NIS_MEMORY = 50.0
"""Measurements over which the normalised innovation squared is averaged, and degrees that count as one before any;
ours."""


class FallbackAction(ConstantPolicy):
    """The paper's algorithm as a constant action of a task's control.

    It is the one that the paper's policy has; under another control whose actions lie around zero, zero: the paper's
    algorithm there, or the classical filter that the environment's page names.

    Raises:
        ValueError: if the control has no such action.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # made for it
        own, space = getattr(model.task, "paper_policy", None), model.action_space
        if own is not None and own.control == model.control:
            self.action: tuple[float, ...] = tuple(own.action)
        elif isinstance(space, gymnasium.spaces.Box) and (space.low < 0.0).all() and (space.high > 0.0).all():
            self.action = (0.0,) * space.shape[0]
        else:
            raise ValueError(
                f"control {model.control!r} of {model.task.id} has no constant action that is the paper's: give the "
                "gate a fallback, or choose another control"
            )


class TrustMemory(NamedTuple):
    """What is remembered of alarms."""

    alarm: Any
    envelope: Any
    """None where there is none."""
    heeded: Array
    """Decisions for which the alarm is still heeded, ``(N,)``."""
    outside: Array
    """Decisions for which the agent is not trusted because it was shown what it had not met, ``(N,)``."""


class Trust:
    """Decides at every decision whether an agent is trusted.

    Args:
        model: whose observations it is shown.
        alarm: an object with a method ``hear`` (:class:`.Alarm`), or what makes one for the model; default: that of the
            environment's baselines, or :class:`.InnovationAlarm`.
        window: decisions for which an alarm is heeded, that at which it speaks among them; default: the alarm's.
        envelope: of the agent's training; without it, it is trusted whatever it is shown.

    Raises:
        ValueError: if the alarm cannot serve the task, or the window is empty.
    """

    def __init__(
        self,
        model: Model,
        alarm: Any = None,
        window: int | None = None,
        envelope: TrainingRange | None = None,
    ) -> None:
        alarm = alarm or Problem.of(type(model.task)).baselines.alarm or InnovationAlarm
        self.alarm: Alarm = make_competitor(alarm, model)
        self.window: int = self.alarm.window if window is None else window
        if self.window < 1:
            raise ValueError(f"window must be at least one decision, got {self.window!r}")
        self.envelope: EnvelopeAlarm | None = None if envelope is None else EnvelopeAlarm(model, envelope)

    def listen(
        self, observation: numpy.ndarray, memory: TrustMemory | None, start: numpy.ndarray
    ) -> tuple[numpy.ndarray, TrustMemory]:
        """Say where the agent is trusted.

        Args:
            observation: ``(N, fields)``.
            memory: what the last call returned; None at the first.
            start: true where an episode begins, ``(N,)``.

        Returns:
            Booleans ``(N,)``, and memory.
        """
        none = 0.0 * observation[:, 0]
        alarm, envelope, heeded, outside = (None, None, none, none) if memory is None else memory
        spoken, alarm = self.alarm.hear(observation, alarm, start)
        heeded = self._count_down(spoken, heeded, start)
        if self.envelope is not None:
            left, envelope = self.envelope.hear(observation, envelope, start)
            outside = self._count_down(left, outside, start)
        return (heeded > 0.0) & (outside <= 0.0), TrustMemory(alarm, envelope, heeded, outside)

    def _count_down(self, spoken: Array, before: Array, start: Array) -> Array:
        left = numpy.maximum(numpy.where(start, 0.0, before) - 1.0, 0.0)
        return numpy.where(spoken, float(self.window), left)


# --- two actions of one filter


class GateMemory(NamedTuple):
    """What a gate remembers."""

    trust: TrustMemory | None
    fallback: Any


class Gate:
    """Decides between an action and the fallback's, in training.

    Args:
        model: whose observations it is shown.
        fallback: a policy, or what makes one for the model; default: :class:`FallbackAction`.
        alarm: as of :class:`Trust`.
        window: likewise.

    Raises:
        ValueError: if a default cannot serve the task, the fallback has another control, or the window is empty.
    """

    def __init__(
        self, model: Model, fallback: Any = None, alarm: Any = None, window: int | None = None
    ) -> None:
        self.trust: Trust = Trust(model, alarm, window)
        self.fallback: Any = check_competitor(
            "fallback", make_competitor(fallback or FallbackAction, model), "policy"
        )
        own = getattr(self.fallback, "control", model.control)
        if own != model.control:
            raise ValueError(f"the fallback is made for control {own!r}, but the task has {model.control!r}")

    def begin(self, seeds: Sequence[int]) -> GateMemory:
        """Memory at the start of the episodes with these seeds."""
        return GateMemory(None, self.fallback.begin(seeds) if isinstance(self.fallback, Policy) else None)

    def choose(
        self,
        observation: numpy.ndarray,
        action: numpy.ndarray,
        memory: GateMemory | None,
        start: numpy.ndarray,
    ) -> tuple[numpy.ndarray, numpy.ndarray, GateMemory]:
        """Answer for every episode the action where the gate is open, and elsewhere the fallback's.

        Args:
            observation: ``(N, fields)``.
            action: batch first.
            memory: what the last call returned; None at the first.
            start: true where an episode begins, ``(N,)``.

        Returns:
            Actions, where the gate is open, ``(N,)``, and memory.
        """
        memory = self.begin(range(len(observation))) if memory is None else memory
        opened, trust = self.trust.listen(observation, memory.trust, start)
        other, fallback = self.fallback.predict(observation, memory.fallback, start, deterministic=True)
        aligned = opened.reshape(-1, *[1] * (numpy.ndim(action) - 1))
        return numpy.where(aligned, action, other), opened, GateMemory(trust, fallback)


class Gated(Policy):
    """A policy behind a :class:`Gate`, as it acts in its training.

    Args:
        model: of all of them.
        policy: anything with Stable-Baselines3's ``predict``, or what makes it for the model.
        fallback: as of :class:`Gate`.
        alarm: likewise.
        window: likewise.

    Raises:
        ValueError: likewise.
    """

    inner: ClassVar[str] = "policy"
    """Attribute that holds the policy inside."""

    def __init__(
        self, model: Model, policy: Any, fallback: Any = None, alarm: Any = None, window: int | None = None
    ) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # made for it
        self.policy: Any = check_competitor("policy", make_competitor(policy, model), "policy")
        own = getattr(self.policy, "control", model.control)
        if own != model.control:
            raise ValueError(f"the policy is made for control {own!r}, but the task has {model.control!r}")
        self.gate: Gate = Gate(model, fallback, alarm, window)
        parts = self.policy, self.gate.fallback
        self.traceable: bool = all(map(says_traceable, parts))  # type: ignore[misc]  # of these two
        expose_spaces(self, self.policy)

    def begin(self, seeds: Sequence[int]) -> tuple[Any, GateMemory] | None:
        """Memories of policy and gate; none of what can be traced, which draws nothing."""
        if self.traceable:
            return None
        return (self.policy.begin(seeds) if isinstance(self.policy, Policy) else None), self.gate.begin(seeds)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Ask the policy, then the gate."""
        memory, gate_memory = (None, None) if state is None else state
        own, memory = self.policy.predict(observation, memory, start, deterministic=True)
        action, _, gate_memory = self.gate.choose(observation, own, gate_memory, start)
        return action, (memory, gate_memory)


# --- two filters


class ListeningMemory(NamedTuple):
    """What a policy remembers, and its alarms."""

    policy: Any
    trust: TrustMemory
    trusted: Array
    """Whether it is trusted, booleans ``(N,)``."""


class ListeningPolicy(Policy):
    """A policy that acts as it would alone, and keeps whether it is trusted.

    Args:
        policy: anything with Stable-Baselines3's ``predict``.
        trust: that decides about it.
        model: of both.
    """

    def __init__(self, policy: Any, trust: Trust, model: Model) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # made for it
        self.policy = policy
        self.trust = trust

    def act(
        self, observation: numpy.ndarray, state: ListeningMemory | None, start: numpy.ndarray
    ) -> tuple[numpy.ndarray, ListeningMemory]:
        """Ask the policy, then the alarms."""
        memory, trust = (None, None) if state is None else state[:2]
        action, memory = self.policy.predict(observation, memory, start, deterministic=True)
        trusted, trust = self.trust.listen(observation, trust, start)
        return action, ListeningMemory(memory, trust, trusted)


class GatedState(NamedTuple):
    """State of a gated filter."""

    agent: Any
    """Of the agent's filter."""
    fallback: Any
    """Of the other."""
    trusted: Array
    """Whether the agent's filter answers, booleans ``(N,)``."""
    odds: Array
    """Log-odds of the fallback to the agent's filter by how well they have predicted the measurements, ``(N,)``."""
    squares: Array
    """Weighted sum of the fallback's normalised innovations squared, ``(N,)``."""
    degrees: Array
    """Likewise of their degrees of freedom."""


class GatedEstimator(Filter[Any, Any, GatedState]):
    """An agent's filter and a fallback side by side.

    Beside its alarms the agent has to stand the comparison: it is not trusted while the fallback has predicted the
    measurements better. The log-likelihood ratios of the two are summed within :data:`MOST_ODDS`, so that old ones are
    forgotten as soon as new ones speak against them. Where the fallback takes in what the agent is not told of, such as
    all plots of a scan, it has no density of the measurement to compare; that speaks against the agent with all odds.

    Where the fallback's innovations have been significantly larger than it expects, its covariance is answered times
    their mean square: the variance factor of an adjustment (Teunissen, Adjustment Theory, 2000), as if all noise were
    larger alike. Errors that last show little in the innovations, and are not healed. The agent's covariance stays: its
    innovations are those before its action.

    Args:
        agent: a filter whose policy is a :class:`ListeningPolicy`.
        fallback: a filter.
    """

    def __init__(self, agent: LearnedEstimator, fallback: Filter[Any, Any, Any]) -> None:
        super().__init__(agent.task)
        self.agent = agent
        self.fallback = fallback
        self.network: Policy = agent.network
        self.decider: Decider = agent.decider
        policy: Any = agent.network
        self.in_python: bool = fallback.in_python or not says_traceable(policy.policy)

    def start(self, initial: Any) -> GatedState:
        """Start both where everyone starts."""
        none = 0.0 * initial.mean[0]
        expected = none + NIS_MEMORY
        states = self.agent.start(initial), self.fallback.start(initial)
        return GatedState(*states, none > 0.0, none, expected, expected)

    def predict(self, state: GatedState, measurement: Any) -> GatedState:
        """Let both predict."""
        return state._replace(
            agent=self.agent.predict(state.agent, measurement),
            fallback=self.fallback.predict(state.fallback, measurement),
        )

    def update(self, state: GatedState, given: FilterInput) -> GatedState:
        """Let both take the measurement in, and decide who is trusted."""
        xp, measurement = self.xp, given.measurement
        agent, fallback = self.agent.update(state.agent, given), self.fallback.update(state.fallback, given)
        mean, other_mean = self.agent.mean(agent), self.fallback.mean(fallback)
        own = Likelihood.of_records(self.agent.records(agent, measurement))
        other = Likelihood.of_records(self.fallback.records(fallback, measurement))
        if isinstance(self.fallback, Adapter) and not self.fallback.tells:
            other = Likelihood(None)
        # A track that is lost altogether, so that its estimate is no number, is no answer either.
        odds, sound = state.odds, xp.all(xp.isfinite(mean), axis=0)
        if other.log_likelihood is not None:
            silent = xp.isnan(other.log_likelihood) & xp.all(xp.isfinite(other_mean), axis=0)
            if own.log_likelihood is None:
                # Whether it was told less, or nothing was received, this agent does not say.
                sound = sound & ~silent
            else:
                ratio = other.log_likelihood - own.log_likelihood
                odds = xp.clip(odds + xp.where(xp.isfinite(ratio), ratio, 0.0), -MOST_ODDS, MOST_ODDS)
                odds = xp.where(silent & xp.isfinite(own.log_likelihood), MOST_ODDS, odds)
        squares, degrees = self._sum_squares(state, other)
        trusted = (agent.policy.memory.trusted[0] > 0.5) & (odds <= 0.0) & sound
        return GatedState(agent, fallback, trusted, odds, squares, degrees)

    def mean(self, state: GatedState) -> Array:
        """That of the filter that is trusted."""
        return self.xp.where(state.trusted, self.agent.mean(state.agent), self.fallback.mean(state.fallback))

    def covariance(self, state: GatedState) -> Array:
        """Likewise."""
        other = self._variance_factor(state.squares, state.degrees) * self.fallback.covariance(state.fallback)
        return self.xp.where(state.trusted, self.agent.covariance(state.agent), other)

    def records(self, state: GatedState, measurement: Any) -> dict[str, Array]:
        """Nothing: the one that answers changes."""
        return {}

    def _sum_squares(self, memory: GatedState, told: Likelihood) -> tuple[Array, Array]:
        """Sums of the fallback's normalised innovations squared, and of their degrees; what is not told, or not
        received, leaves them as they are.
        """
        if self.fallback.adapts_covariance or told.nis is None or told.nis_degrees is None:
            return memory.squares, memory.degrees
        xp, keep = self.xp, 1.0 - 1.0 / NIS_MEMORY
        there = xp.isfinite(told.nis) & (told.nis_degrees > 0.0)
        return (
            xp.where(there, keep * memory.squares + told.nis, memory.squares),
            xp.where(there, keep * memory.degrees + told.nis_degrees, memory.degrees),
        )

    def _variance_factor(self, squares: Array, degrees: Array) -> Array:
        """Mean square of the fallback's innovations where it is significantly above one, else one, ``(N,)``.

        Squares have the variance 2, and weights that fade slowly halve that of their mean: its deviation is one over
        the root of the degrees.
        """
        mean = squares / degrees
        return self.xp.where(mean > 1.0 + SIGNIFICANT / self.xp.sqrt(degrees), mean, 1.0)


def is_gateable(maker: Any) -> bool:
    """Whether a competitor has actions that follow from what is measured, so that there is something to hold back."""
    return isinstance(maker, EstimatorMaker) or (kind_of(maker) == "policy" and maker is not RandomPolicy)


class GatedMaker:
    """Makes an agent behind a gate for a task; what an evaluation calls.

    Args:
        problem: of both.
        name: of the agent, in errors.
        maker: of it.
        fallback: name of one of the environment's own policies or estimators; default: ``Baselines.fallback``, or the
            paper's algorithm.
        alarm: as of :class:`Trust`.
        window: likewise.

    Raises:
        ValueError: if the agent has no actions, nothing is known to fall back on, or that is significantly worse than
            the paper's algorithm.
    """

    kind: ClassVar[Kind] = "estimator"
    traced_as: ClassVar[str] = "gated"

    def __init__(
        self,
        problem: Problem,
        name: str,
        maker: Any,
        fallback: str = "",
        alarm: Any = None,
        window: int | None = None,
    ) -> None:
        if not is_gateable(maker):
            raise ValueError(
                f"{name!r} is of kind {kind_of(maker)} and has no actions that follow from what is measured: an alarm "
                "has nothing to listen to"
            )
        self.problem = problem
        self.name = name
        self.maker = maker
        self.fallback: str = fallback or problem.baselines.fallback or problem.paper
        self.alarm = alarm
        self.window = window
        learned = isinstance(maker, EstimatorMaker)
        self._policy = maker.policy if learned else maker
        self._is_asked_always = learned
        self.control: str = maker.bank if learned else control_of(maker, None, problem.task, name)
        self.task_keywords: Any = getattr(maker, "task_keywords", {})
        self._fallback = problem.competitor(self.fallback)
        self._check_fallback()
        self.envelope: TrainingRange | None = training_range(problem.task, maker)
        """What the agent saw in its training; None where nobody knows."""

    def _check_fallback(self) -> None:
        kind, keywords = kind_of(self._fallback), dict(getattr(self._fallback, "task_keywords", {}))
        # Its actions hold for as long as it says, whatever the agent's do.
        keywords.pop("decision_interval", None)
        if kind not in ("policy", "estimator") or self._fallback is RandomPolicy:
            raise ValueError(f"{self.fallback!r} is of kind {kind} and nothing that a gate can fall back on")
        if keywords:
            raise ValueError(
                f"{self.fallback!r} has parameters of the task of its own ({', '.join(keywords)}) and cannot run "
                "beside an agent: choose another fallback"
            )
        excess, errors = excess_cost(self.problem, self.fallback)
        if errors > SIGNIFICANT:
            raise ValueError(
                f"the fallback {self.fallback!r} costs {100.0 * excess:.1f} % more than the paper's algorithm "
                f"{self.problem.paper!r} on validation episodes ({errors:.1f} standard errors): a gate that falls back "
                "on it would do harm; choose another fallback"
            )

    def __call__(self, task: Task, replace: Callable[[Any], Any] | None = None) -> GatedEstimator:
        """Make it.

        Args:
            task: that it is made for.
            replace: from the agent's policy to what stands in its place.
        """
        model = Model(task, self.control)
        shown = model.on_numpy()
        policy = check_competitor(self.name, make_competitor(self._policy, shown), "policy")
        if replace is not None:
            policy = replace(policy)
        trust = Trust(shown, self.alarm, self.window, self.envelope)
        interval = 1 if self._is_asked_always else task.decision_interval
        agent = LearnedEstimator(model, ListeningPolicy(policy, trust, shown), interval)
        return GatedEstimator(agent, self._make_fallback(task))

    def _make_fallback(self, task: Task) -> Filter[Any, Any, Any]:
        if kind_of(self._fallback) == "estimator":
            with explain_errors(f"fallback {self.fallback!r} cannot be made"):
                return as_filter(task, make_competitor(self._fallback, task))
        control = control_of(self._fallback, None, self.problem.task, self.fallback)
        model = Model(task, control)
        policy = make_competitor(self._fallback, model.on_numpy())
        own = getattr(self._fallback, "task_keywords", {})
        return LearnedEstimator(model, policy, own.get("decision_interval", task.decision_interval))


@cache
def _excess_cost(name: str, fallback: str) -> tuple[float, float]:
    problem = problem_of(name)
    names = problem.paper, fallback
    makers = {each: problem.competitor(each) for each in names}
    found = problem.evaluate(makers, None, CHECKED_EPISODES, split="validation")
    paper, other = (mean_cost(found, each) for each in names)
    difference = other - paper
    excess, deviation = float(difference.mean()), float(difference.std(ddof=1)) / math.sqrt(len(difference))
    return excess / float(paper.mean()), excess / deviation if deviation else 0.0


def excess_cost(problem: Problem, fallback: str) -> tuple[float, float]:
    """How much more a competitor costs than the paper's algorithm, on validation episodes of the training distribution.

    Args:
        problem: of both.
        fallback: name of the competitor.

    Returns:
        Difference of the mean costs over the paper's, and the difference in standard errors over paired episodes.
    """
    if fallback == problem.paper:
        return 0.0, 0.0
    return _excess_cost(problem.name, fallback)


class PolicyMaker:
    """Makes for a model a policy with others around it.

    Args:
        maker: of the policy inside, or that policy.
        wrap: from the task and the policy inside to the whole.
        control: of both; default: the maker's own.
    """

    kind = "policy"

    def __init__(self, maker: Any, wrap: Callable[[Model, Any], Any], control: str | None = None) -> None:
        self.maker = maker
        self.wrap = wrap
        expose_spaces(self, maker, "control", "task_keywords")
        if control is not None:
            self.control = control

    def __call__(self, model: Model) -> Any:
        """Make it."""
        return self.wrap(model, make_competitor(self.maker, model))


def as_trained(model: Model, agent: Any, residual_to: str = "", gated: bool = False) -> Any:
    """Return an agent as it acts in its training run.

    Args:
        model: of the run.
        agent: the network alone.
        residual_to: name of the policy that it corrects, if there is one; a gate then holds back the correction.
        gated: whether it acts behind a gate.

    Raises:
        ValueError: if that cannot be.
    """
    corrected = policy_to_correct(model, residual_to) if residual_to else None
    if corrected is not None:
        agent = ResidualPolicy(model, corrected, agent)
    return Gated(model, agent, fallback=corrected) if gated else agent


def find_gated(name: str, inner: str, problem: Problem, find: Callable[[str], Competitor]) -> Competitor:
    """Return the competitor of ``gated:NAME``."""
    policy = find(inner)
    return Competitor(name, GatedMaker(problem, inner, policy.maker), policy.learned)
