"""Residual agents: the agent's action is added to that of a policy that already works.

Zero is exactly the policy, so learning starts from it instead of from nothing. The sum is taken at the edge
of the action space, as every action is. Training over many environments: ``to_sb3(env, residual_to=policy)``.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy

from ..baselines.problem import Problem
from ..envs.contract.model import Model
from ..evaluation.competitors.kinds import Policy, expose_spaces, is_traceable, kind_of, make_competitor


def check_residual(model: Model, policy: Any) -> None:
    """Raise ValueError if actions of this task and policy cannot be added."""
    if not isinstance(model.action_space, gymnasium.spaces.Box):
        raise ValueError(
            f"a residual action is added: control {model.control!r} has {model.action_space}, choose another"
        )
    own = getattr(policy, "control", model.control)
    if own != model.control:
        raise ValueError(f"the policy is made for control {own!r}, but the environment has {model.control!r}")


def policy_to_correct(model: Model, name: str) -> Any:
    """Make the policy that an agent corrects in a training run.

    Args:
        model: of both.
        name: one of the environment's own policies, tuned or not.

    Raises:
        ValueError: for an unknown name, what does not act, acts under parameters of its own, or cannot be corrected.
    """
    maker = Problem.of(type(model.task)).competitor(name)
    if kind_of(maker) != "policy":
        raise ValueError(f"{name!r} is of kind {kind_of(maker)} and has no actions that could be corrected")
    if getattr(maker, "task_keywords", {}):
        raise ValueError(
            f"policy {name!r} acts under parameters of its own, and an agent trains under the environment's: choose "
            "another policy to correct"
        )
    check_residual(model, maker)
    return make_competitor(maker, model)


class ResidualPolicy(Policy):
    """A policy and the agent that corrects it, as one policy for an evaluation.

    Args:
        model: of both.
        policy: the one that is corrected.
        agent: the correction.

    Raises:
        ValueError: if actions cannot be added.
    """

    inner: ClassVar[str] = "agent"
    """Attribute that holds the policy inside."""

    def __init__(self, model: Model, policy: Any, agent: Any) -> None:
        super().__init__(model)
        check_residual(model, policy)
        self.control: str = model.control  # type: ignore[misc]
        self.policy = policy
        self.agent = agent
        self.traceable: bool = is_traceable(policy) and is_traceable(agent)  # type: ignore[misc]  # of these two
        expose_spaces(self, agent)

    def begin(self, seeds: Sequence[int]) -> tuple[Any, Any] | None:
        """Memories of both; none of what can be traced, which draws nothing."""
        if self.traceable:
            return None
        both = self.policy, self.agent
        first, second = (part.begin(seeds) if isinstance(part, Policy) else None for part in both)
        return first, second

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Add both answers."""
        memory, agent_memory = (None, None) if state is None else state
        own, memory = self.policy.predict(observation, memory, start, deterministic=True)
        correction, agent_memory = self.agent.predict(observation, agent_memory, start, deterministic=True)
        return own + correction, (memory, agent_memory)
