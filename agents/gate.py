"""Gates that use an agent only while an alarm is active and the observations resemble its training.

Where filters and sensors are as modelled, a classical filter is hard to beat and easy to harm, and the output of a
network far from its training data is unpredictable. So an agent is trusted if an alarm (:mod:`..baselines.alarm`) has
sounded within the last decisions, and the observations lie within the range of the training (:mod:`.envelope`). Without
trust an agent still runs, so that its memory covers the whole episode.

``gated:NAME`` runs two filters side by side, the agent's and a classical one, and returns the estimate of the trusted
one (:class:`GatedEstimator`). The fallback may be any policy or estimator; in a closed loop the vehicle follows the
trusted estimate. In training (``--gated``) both share one filter, and the gate replaces the agent's action
(:class:`Gated`): the fallback is an action of the same control.
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
    is_traceable,
    kind_of,
    make_competitor,
)
from ..evaluation.competitors.steered_filter import Decider
from ..evaluation.running.evaluate import control_of
from ..evaluation.running.metrics import mean_cost
from .envelope import EnvelopeAlarm, TrainingRange, training_range
from .learned_estimator import EstimatorMaker, LearnedEstimator
from .residual import ResidualPolicy, policy_to_correct

CHECKED_EPISODES = 128
"""Episodes of the validation split on which a fallback is compared with the paper's algorithm."""
MOST_ODDS = math.log(100.0)
"""Largest log-odds of one filter to another that are accumulated (ours: decisive by Jeffreys' scale)."""
SIGNIFICANT = 3.0
"""Standard errors beyond which a fallback is rejected for its cost, and normalised innovations are too large."""
NIS_MEMORY = 50.0
"""Measurements over which the normalised innovation squared is averaged, and degrees of freedom of the initial mean of
one; ours.
"""


class FallbackAction(ConstantPolicy):
    """The paper's algorithm as a constant action of a task's control.

    It is the action of the paper's policy. Under another control whose actions lie around zero it is zero: the paper's
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
                f"control {model.control!r} of {model.task.id} has no constant action of the paper's algorithm: "
                "give the gate a fallback, or choose another control"
            )


class TrustMemory(NamedTuple):
    """Memory of a :class:`Trust` for N episodes: its alarms, and for how long they are active."""

    alarm: Any
    envelope: Any
    """Memory of the alarm on observations outside the training; None without an envelope."""
    active: Array
    """Remaining decisions for which the alarm is active, ``(N,)``."""
    outside: Array
    """Remaining decisions for which the agent is not trusted after an observation outside its training, ``(N,)``."""


class Trust:
    """Rule that decides at every decision whether an agent is trusted.

    Args:
        model: the model whose observations are passed.
        alarm: an object with a method ``update`` (:class:`.Alarm`), or a factory of one for the model; default: that of
            the environment's baselines, or :class:`.InnovationAlarm`.
        window: decisions for which an alarm is active, including the one at which it sounds; default: the alarm's.
        envelope: range of the agent's training; without it, the agent is trusted for all observations.

    Raises:
        ValueError: if the alarm does not fit the task, or the window is empty.
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

    def update(
        self, observation: numpy.ndarray, memory: TrustMemory | None, start: numpy.ndarray
    ) -> tuple[numpy.ndarray, TrustMemory]:
        """Update the alarms with observations ``(N, fields)``; return the mask ``(N,)`` of trusted lanes, and memory.

        ``start`` is true where an episode begins, ``(N,)``; ``memory`` is that of the last call, None at the
        first.
        """
        none = 0.0 * observation[:, 0]
        alarm, envelope, active, outside = (None, None, none, none) if memory is None else memory
        spoken, alarm = self.alarm.update(observation, alarm, start)
        active = self._count_down(spoken, active, start)
        if self.envelope is not None:
            left, envelope = self.envelope.update(observation, envelope, start)
            outside = self._count_down(left, outside, start)
        return (active > 0.0) & (outside <= 0.0), TrustMemory(alarm, envelope, active, outside)

    def _count_down(self, spoken: Array, before: Array, start: Array) -> Array:
        left = numpy.maximum(numpy.where(start, 0.0, before) - 1.0, 0.0)
        return numpy.where(spoken, float(self.window), left)


# --- two actions of one filter


class GateMemory(NamedTuple):
    """Memory of a :class:`Gate`: that of its alarms, and that of the fallback policy."""

    trust: TrustMemory | None
    fallback: Any


class Gate:
    """Switch in training between the actions of an agent and of a fallback, by whether the agent is trusted.

    Args:
        model: the model whose observations are passed.
        fallback: a policy, or a factory of one for the model; default: :class:`FallbackAction`.
        alarm: an alarm, or a factory of one, see :class:`Trust`.
        window: decisions for which an alarm is active, see :class:`Trust`.

    Raises:
        ValueError: if a default does not fit the task, the fallback has another control, or the window is empty.
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
        """Return the memory of a gate at the start of the episodes with these seeds."""
        return GateMemory(None, self.fallback.begin(seeds) if isinstance(self.fallback, Policy) else None)

    def choose(
        self,
        observation: numpy.ndarray,
        action: numpy.ndarray,
        memory: GateMemory | None,
        start: numpy.ndarray,
    ) -> tuple[numpy.ndarray, numpy.ndarray, GateMemory]:
        """Return the agent's actions where the gate is open and the fallback's elsewhere, the mask, and the memory.

        Actions are batch first; ``start`` is true where an episode begins; ``memory`` is that of the last
        call, or None.
        """
        memory = self.begin(range(len(observation))) if memory is None else memory
        opened, trust = self.trust.update(observation, memory.trust, start)
        other, fallback = self.fallback.predict(observation, memory.fallback, start, deterministic=True)
        aligned = opened.reshape(-1, *[1] * (numpy.ndim(action) - 1))
        return numpy.where(aligned, action, other), opened, GateMemory(trust, fallback)


class Gated(Policy):
    """A policy behind a :class:`Gate`, as it acts in its training.

    Args:
        model: the model of policy and fallback.
        policy: an object with Stable-Baselines3's ``predict``, or a factory of one for the model.
        fallback: a policy, or a factory of one, see :class:`Gate`.
        alarm: an alarm, or a factory of one, see :class:`Trust`.
        window: decisions for which an alarm is active, see :class:`Trust`.

    Raises:
        ValueError: if the policy has another control, or the gate cannot be made, see :class:`Gate`.
    """

    inner: ClassVar[str] = "policy"
    """Attribute that contains the policy inside."""

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
        self.traceable: bool = all(map(is_traceable, parts))  # type: ignore[misc]  # of these two
        expose_spaces(self, self.policy)

    def begin(self, seeds: Sequence[int]) -> tuple[Any, GateMemory] | None:
        """Return the initial memories of policy and gate for seeds; None if neither draws random numbers."""
        if self.traceable:
            return None
        return (self.policy.begin(seeds) if isinstance(self.policy, Policy) else None), self.gate.begin(seeds)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the policy's actions, replaced by the fallback's where the gate is closed, and the memory."""
        memory, gate_memory = (None, None) if state is None else state
        own, memory = self.policy.predict(observation, memory, start, deterministic=True)
        action, _, gate_memory = self.gate.choose(observation, own, gate_memory, start)
        return action, (memory, gate_memory)


# --- two filters


class MonitoredMemory(NamedTuple):
    """Memory of a :class:`MonitoredPolicy`: that of the policy, that of its alarms, and the mask of trust."""

    policy: Any
    trust: TrustMemory
    trusted: Array
    """Whether the policy is trusted, booleans ``(N,)``."""


class MonitoredPolicy(Policy):
    """A policy whose memory includes whether it is trusted; its actions do not change."""

    def __init__(self, policy: Any, trust: Trust, model: Model) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # made for it
        self.policy = policy
        self.trust = trust

    def act(
        self, observation: numpy.ndarray, state: MonitoredMemory | None, start: numpy.ndarray
    ) -> tuple[numpy.ndarray, MonitoredMemory]:
        """Return the policy's actions unchanged, and the memory with the mask of trust."""
        memory, trust = (None, None) if state is None else state[:2]
        action, memory = self.policy.predict(observation, memory, start, deterministic=True)
        trusted, trust = self.trust.update(observation, trust, start)
        return action, MonitoredMemory(memory, trust, trusted)


class GatedState(NamedTuple):
    """State of a :class:`GatedEstimator`: both filters, the mask of trust, and the evidence for each filter."""

    agent: Any
    """State of the agent's filter."""
    fallback: Any
    """State of the fallback."""
    trusted: Array
    """Whether the estimate is that of the agent's filter, booleans ``(N,)``."""
    odds: Array
    """Log-odds of the fallback to the agent's filter, from the likelihoods of the measurements, ``(N,)``."""
    squares: Array
    """Weighted sum of the fallback's normalised innovations squared, ``(N,)``."""
    degrees: Array
    """Weighted sum of their degrees of freedom, ``(N,)``."""


class GatedEstimator(Filter[Any, Any, GatedState]):
    """An agent's filter and a fallback side by side; the estimate is that of the trusted one.

    The agent is not trusted while the fallback has predicted the measurements better. The log-likelihood ratios of the
    two are summed within :data:`MOST_ODDS`, so that new ratios soon outweigh old ones. A fallback that uses data that
    the agent does not receive, such as all plots of a scan, has no density of the measurement to compare; the odds are
    then the largest ones against the agent.

    Where the fallback's innovations have been significantly larger than predicted, its covariance is multiplied by
    their mean square: the variance factor of an adjustment (Teunissen, Adjustment Theory, 2000), as if all noise were
    larger by one factor. Persistent errors hardly change the innovations and are not corrected. The agent's covariance
    is not scaled: its innovations are those before its action.

    The policy of ``agent`` is a :class:`MonitoredPolicy`.
    """

    def __init__(self, agent: LearnedEstimator, fallback: Filter[Any, Any, Any]) -> None:
        super().__init__(agent.task)
        self.agent = agent
        self.fallback = fallback
        self.network: Policy = agent.network
        self.decider: Decider = agent.decider
        policy: Any = agent.network
        self.in_python: bool = fallback.in_python or not is_traceable(policy.policy)

    def start(self, initial: Any) -> GatedState:
        """Return the state with both filters at the initial estimate."""
        none = 0.0 * initial.mean[0]
        expected = none + NIS_MEMORY
        states = self.agent.start(initial), self.fallback.start(initial)
        return GatedState(*states, none > 0.0, none, expected, expected)

    def predict(self, state: GatedState, measurement: Any) -> GatedState:
        """Return the state with both filters predicted to a measurement."""
        return state._replace(
            agent=self.agent.predict(state.agent, measurement),
            fallback=self.fallback.predict(state.fallback, measurement),
        )

    def update(self, state: GatedState, inputs: FilterInput) -> GatedState:
        """Return the state with both filters updated by a measurement, and the choice of the trusted one."""
        xp, measurement = self.xp, inputs.measurement
        agent, fallback = self.agent.update(state.agent, inputs), self.fallback.update(state.fallback, inputs)
        mean, other_mean = self.agent.mean(agent), self.fallback.mean(fallback)
        own = Likelihood.of_records(self.agent.records(agent, measurement))
        other = Likelihood.of_records(self.fallback.records(fallback, measurement))
        if isinstance(self.fallback, Adapter) and not self.fallback.has_likelihood:
            other = Likelihood(None)
        # A lost track, whose estimate is not finite, is not trusted.
        odds, sound = state.odds, xp.all(xp.isfinite(mean), axis=0)
        if other.log_likelihood is not None:
            silent = xp.isnan(other.log_likelihood) & xp.all(xp.isfinite(other_mean), axis=0)
            if own.log_likelihood is None:
                # This agent does not report whether it received less data, or none.
                sound = sound & ~silent
            else:
                ratio = other.log_likelihood - own.log_likelihood
                odds = xp.clip(odds + xp.where(xp.isfinite(ratio), ratio, 0.0), -MOST_ODDS, MOST_ODDS)
                odds = xp.where(silent & xp.isfinite(own.log_likelihood), MOST_ODDS, odds)
        squares, degrees = self._sum_squares(state, other)
        trusted = (agent.policy.memory.trusted[0] > 0.5) & (odds <= 0.0) & sound
        return GatedState(agent, fallback, trusted, odds, squares, degrees)

    def mean(self, state: GatedState) -> Array:
        """Return the mean of the trusted filter's estimate in each lane, ``(C, N)``."""
        return self.xp.where(state.trusted, self.agent.mean(state.agent), self.fallback.mean(state.fallback))

    def covariance(self, state: GatedState) -> Array:
        """Return the trusted filter's covariance ``(C, C, N)``; the fallback's is scaled by its variance factor."""
        other = self._variance_factor(state.squares, state.degrees) * self.fallback.covariance(state.fallback)
        return self.xp.where(state.trusted, self.agent.covariance(state.agent), other)

    def records(self, state: GatedState, measurement: Any) -> dict[str, Array]:
        """Return no records: the estimate switches between two filters."""
        return {}

    def _sum_squares(self, memory: GatedState, likelihood: Likelihood) -> tuple[Array, Array]:
        """Add a measurement's NIS and degrees of freedom to the fallback's fading sums; missing ones add nothing."""
        if self.fallback.adapts_covariance or likelihood.nis is None or likelihood.nis_degrees is None:
            return memory.squares, memory.degrees
        xp, keep = self.xp, 1.0 - 1.0 / NIS_MEMORY
        there = xp.isfinite(likelihood.nis) & (likelihood.nis_degrees > 0.0)
        return (
            xp.where(there, keep * memory.squares + likelihood.nis, memory.squares),
            xp.where(there, keep * memory.degrees + likelihood.nis_degrees, memory.degrees),
        )

    def _variance_factor(self, squares: Array, degrees: Array) -> Array:
        """Return the mean square of the fallback's innovations where it is significantly above one, else one, ``(N,)``.

        Squares have the variance 2, and weights that fade slowly halve that of their mean. So the standard deviation of
        the mean is one over the root of the degrees of freedom.
        """
        mean = squares / degrees
        return self.xp.where(mean > 1.0 + SIGNIFICANT / self.xp.sqrt(degrees), mean, 1.0)


def is_gateable(maker: Any) -> bool:
    """Return whether a gate can guard a competitor: a learned estimator, or any policy but the random one."""
    return isinstance(maker, EstimatorMaker) or (kind_of(maker) == "policy" and maker is not RandomPolicy)


class GatedMaker:
    """Factory of an agent behind a gate; an evaluation calls it with a task.

    Args:
        problem: the problem of agent and fallback.
        name: name of the agent, for errors.
        maker: factory of the agent.
        fallback: name of one of the environment's own policies or estimators; default: ``Baselines.fallback``, or the
            paper's algorithm.
        alarm: an alarm, or a factory of one, see :class:`Trust`.
        window: decisions for which an alarm is active, see :class:`Trust`.

    Raises:
        ValueError: if the agent has no actions, there is no fallback, or its cost is significantly above that of the
            paper's algorithm.
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
                f"{name!r} is of kind {kind_of(maker)} and has no actions that depend on measurements for a gate"
            )
        self.problem = problem
        self.name = name
        self.maker = maker
        self.fallback: str = fallback or problem.baselines.fallback or problem.paper
        self.alarm = alarm
        self.window = window
        learned = isinstance(maker, EstimatorMaker)
        self._policy = maker.policy if learned else maker
        self._decides_always = learned
        self.control: str = maker.bank if learned else control_of(maker, None, problem.task, name)
        self.task_keywords: Any = getattr(maker, "task_keywords", {})
        self._fallback = problem.competitor(self.fallback)
        self._check_fallback()
        self.envelope: TrainingRange | None = training_range(problem.task, maker)
        """Range of the agent's training; None if unknown."""

    def _check_fallback(self) -> None:
        kind, keywords = kind_of(self._fallback), dict(getattr(self._fallback, "task_keywords", {}))
        # Its actions last for its own decision interval, independent of the agent's.
        keywords.pop("decision_interval", None)
        if kind not in ("policy", "estimator") or self._fallback is RandomPolicy:
            raise ValueError(f"{self.fallback!r} is of kind {kind} and cannot be the fallback of a gate")
        if keywords:
            raise ValueError(
                f"{self.fallback!r} has task parameters of its own ({', '.join(keywords)}) and cannot run "
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
        """Return the gated estimator for a task; ``replace`` maps the agent's policy to a replacement."""
        model = Model(task, self.control)
        shown = model.on_numpy()
        policy = check_competitor(self.name, make_competitor(self._policy, shown), "policy")
        if replace is not None:
            policy = replace(policy)
        trust = Trust(shown, self.alarm, self.window, self.envelope)
        interval = 1 if self._decides_always else task.decision_interval
        agent = LearnedEstimator(model, MonitoredPolicy(policy, trust, shown), interval)
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
    """Return a competitor's relative excess cost over the paper's algorithm, and that in standard errors.

    The episodes are validation episodes of the training distribution.
    """
    if fallback == problem.paper:
        return 0.0, 0.0
    return _excess_cost(problem.name, fallback)


class PolicyMaker:
    """Factory of a wrapped policy, which is called with a model.

    ``wrap`` maps a model and the policy inside to the wrapped policy.
    """

    kind = "policy"

    def __init__(self, maker: Any, wrap: Callable[[Model, Any], Any], control: str | None = None) -> None:
        self.maker = maker
        self.wrap = wrap
        expose_spaces(self, maker, "control", "task_keywords")
        if control is not None:
            self.control = control

    def __call__(self, model: Model) -> Any:
        """Return the wrapped policy for a model."""
        return self.wrap(model, make_competitor(self.maker, model))


def wrap_as_trained(model: Model, agent: Any, residual_to: str = "", gated: bool = False) -> Any:
    """Return an agent's network wrapped as in its training: added to a corrected policy, behind a gate.

    Args:
        model: model of the run.
        agent: the network alone.
        residual_to: name of the policy that the agent corrects; empty: none. A gate then removes the correction.
        gated: whether the agent acts behind a gate.

    Raises:
        ValueError: if the policy cannot be corrected, or the gate cannot be made.
    """
    corrected = policy_to_correct(model, residual_to) if residual_to else None
    if corrected is not None:
        agent = ResidualPolicy(model, corrected, agent)
    return Gated(model, agent, fallback=corrected) if gated else agent


def find_gated(name: str, inner: str, problem: Problem, find: Callable[[str], Competitor]) -> Competitor:
    """Return the competitor ``gated:NAME``: the agent ``inner`` behind a gate, with the environment's fallback."""
    policy = find(inner)
    return Competitor(name, GatedMaker(problem, inner, policy.maker), policy.learned)
