"""Do no harm: a policy that acts only while something is wrong.

Where filters and sensors are as modelled the paper's algorithm is hard to beat and easy to harm. So the gate answers
the paper's action, or another policy's, unless an alarm (:mod:`..baselines.alarm`) has spoken within the last
decisions. The policy inside is asked at every decision, so that it remembers the whole episode when its time comes.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ..baselines.alarm import Alarm, InnovationAlarm
from ..baselines.problem import Problem
from ..envs.model import Model
from ..evaluation.competitors import (
    ConstantPolicy,
    Policy,
    check_competitor,
    expose_spaces,
    kind_of,
    make_competitor,
)
from .residual import ResidualPolicy, policy_to_correct

NEVER = numpy.iinfo(numpy.int64).max // 2
"""Decisions since an alarm that has not spoken."""


class PaperAction(ConstantPolicy):
    """The paper's algorithm as a constant action of a task's control.

    It is the one that the paper's policy has; under another control whose actions lie around zero, zero: the paper's
    algorithm there, or the classical filter that the environment's page names.

    Raises:
        ValueError: if the control has no such action.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.control = model.control  # type: ignore[misc]  # made for it
        own, space = getattr(model.task, "paper_policy", None), model.action_space
        if own is not None and own.control == model.control:
            self.action = tuple(own.action)
        elif isinstance(space, gymnasium.spaces.Box) and (space.low < 0.0).all() and (space.high > 0.0).all():
            self.action = (0.0,) * space.shape[0]
        else:
            raise ValueError(
                f"control {model.control!r} of {model.task.id} has no constant action that is the paper's: give the "
                "gate a fallback, or choose another control"
            )


class GateMemory(NamedTuple):
    """What a gate remembers."""

    alarm: Any
    fallback: Any
    since: numpy.ndarray
    """Decisions since the alarm spoke, ``(N,)``."""


class Gate:
    """Decides between an action and the fallback's.

    Args:
        model: whose observations it is shown.
        fallback: a policy, or what makes one for the model; default: :class:`PaperAction`.
        alarm: an object with a method ``hear`` (:class:`.Alarm`), or what makes one for the model; default: that of the
            environment's baselines, or :class:`.InnovationAlarm`.
        window: decisions for which an alarm opens the gate, that at which it speaks among them; default: the alarm's.

    Raises:
        ValueError: if a default cannot serve the task, the fallback has another control, or the window is empty.
    """

    def __init__(
        self, model: Model, fallback: Any = None, alarm: Any = None, window: int | None = None
    ) -> None:
        alarm = alarm or Problem.of(type(model.task)).baselines.alarm or InnovationAlarm
        self.alarm: Alarm = make_competitor(alarm, model)
        self.fallback: Any = check_competitor(
            "fallback", make_competitor(fallback or PaperAction, model), "policy"
        )
        own = getattr(self.fallback, "control", model.control)
        if own != model.control:
            raise ValueError(f"the fallback is made for control {own!r}, but the task has {model.control!r}")
        self.window = self.alarm.window if window is None else window
        if self.window < 1:
            raise ValueError(f"window must be at least one decision, got {self.window!r}")

    def begin(self, seeds: Sequence[int]) -> GateMemory:
        """Memory at the start of the episodes with these seeds."""
        fallback = self.fallback.begin(seeds) if isinstance(self.fallback, Policy) else None
        return GateMemory(None, fallback, numpy.full(len(seeds), NEVER))

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
        spoken, alarm = self.alarm.hear(observation, memory.alarm, start)
        other, fallback = self.fallback.predict(observation, memory.fallback, start, deterministic=True)
        since = numpy.where(spoken, 0, numpy.where(start, NEVER, memory.since + 1))
        opened = since < self.window
        aligned = opened.reshape(-1, *[1] * (numpy.ndim(action) - 1))
        return numpy.where(aligned, action, other), opened, GateMemory(alarm, fallback, since)


class Gated(Policy):
    """A policy behind a :class:`Gate`.

    Args:
        model: of all of them.
        policy: anything with Stable-Baselines3's ``predict``, or what makes it for the model.
        fallback: as of :class:`Gate`.
        alarm: likewise.
        window: likewise.

    Raises:
        ValueError: likewise.
    """

    def __init__(
        self, model: Model, policy: Any, fallback: Any = None, alarm: Any = None, window: int | None = None
    ) -> None:
        super().__init__(model)
        self.control = model.control  # type: ignore[misc]  # made for it
        self.policy = check_competitor("policy", make_competitor(policy, model), "policy")
        own = getattr(self.policy, "control", model.control)
        if own != model.control:
            raise ValueError(f"the policy is made for control {own!r}, but the task has {model.control!r}")
        self.gate = Gate(model, fallback, alarm, window)
        expose_spaces(self, self.policy)

    def begin(self, seeds: Sequence[int]) -> tuple[Any, GateMemory]:
        """Memories of policy and gate."""
        return (self.policy.begin(seeds) if isinstance(self.policy, Policy) else None), self.gate.begin(seeds)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Ask the policy, then the gate."""
        memory, gate_memory = (None, None) if state is None else state
        own, memory = self.policy.predict(observation, memory, start, deterministic=True)
        action, _, gate_memory = self.gate.choose(observation, own, gate_memory, start)
        return action, (memory, gate_memory)


class PolicyMaker:
    """Makes for a model a policy with others around it.

    Args:
        maker: of the policy inside, or that policy.
        wrap: from the task and the policy inside to the whole.
        control: of both; default: the maker's own.
    """

    kind = "policy"

    def __init__(self, maker: Any, wrap: Callable[[Model, Any], Any], control: str | None = None) -> None:
        self.maker, self.wrap = maker, wrap
        expose_spaces(self, maker, "control", "task_keywords")
        if control is not None:
            self.control = control

    def __call__(self, model: Model) -> Any:
        """Make it."""
        return self.wrap(model, make_competitor(self.maker, model))


def add_gate(name: str, maker: Any) -> PolicyMaker:
    """Return what makes a policy behind a gate: what a name ``gated:POLICY`` stands for.

    Args:
        name: of the policy, in errors.
        maker: of the policy, or the policy itself.

    Raises:
        ValueError: if it does not act.
    """
    kind = kind_of(maker)
    if kind != "policy":
        raise ValueError(f"{name!r} is of kind {kind} and has no actions that a gate could hold back")
    return PolicyMaker(maker, Gated)


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
