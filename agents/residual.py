"""Residual agents: the agent's action is added to that of an existing policy.

The action zero gives exactly that policy, so training starts from it. The sum is clipped to the action space, as every
action is. Training over many environments: ``to_sb3(env, residual_to=policy)``.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy

from ..baselines.problem import Problem
from ..envs.contract.model import Model
from ..evaluation.competitors.kinds import Policy, expose_spaces, is_traceable, kind_of, make_competitor


def check_residual(model: Model, policy: Any) -> None:
    """Raise ValueError if an agent's actions cannot be added to a policy's: another control, or discrete actions."""
    if not isinstance(model.action_space, gymnasium.spaces.Box):
        raise ValueError(
            f"a residual action needs a continuous control: {model.control!r} has {model.action_space}, choose another"
        )
    own = getattr(policy, "control", model.control)
    if own != model.control:
        raise ValueError(f"the policy is made for control {own!r}, but the environment has {model.control!r}")


def policy_to_correct(model: Model, name: str) -> Any:
    """Return the policy that an agent corrects in a training run, made for a model.

    Args:
        model: the model of both.
        name: one of the environment's own policies, tuned or not.

    Raises:
        ValueError: for an unknown name, a competitor without actions, a policy with parameters of the task of its own,
            or one that cannot be corrected.
    """
    maker = Problem.of(type(model.task)).competitor(name)
    if kind_of(maker) != "policy":
        raise ValueError(f"{name!r} is of kind {kind_of(maker)} and has no actions to correct")
    if getattr(maker, "task_keywords", {}):
        raise ValueError(
            f"policy {name!r} has task parameters of its own, and an agent trains with the environment's: choose "
            "another policy to correct"
        )
    check_residual(model, maker)
    return make_competitor(maker, model)


class ResidualPolicy(Policy):
    """A policy and the agent that corrects it, as one policy for an evaluation.

    Args:
        model: the model of both.
        policy: the corrected policy.
        agent: the correction.

    Raises:
        ValueError: if actions cannot be added.
    """

    inner: ClassVar[str] = "agent"
    """Attribute that contains the policy inside."""

    def __init__(self, model: Model, policy: Any, agent: Any) -> None:
        super().__init__(model)
        check_residual(model, policy)
        self.control: str = model.control  # type: ignore[misc]
        self.policy = policy
        self.agent = agent
        self.traceable: bool = is_traceable(policy) and is_traceable(agent)  # type: ignore[misc]  # of these two
        expose_spaces(self, agent)

    def begin(self, seeds: Sequence[int]) -> tuple[Any, Any] | None:
        """Return the initial memories of both policies for seeds; None if neither draws random numbers."""
        if self.traceable:
            return None
        both = self.policy, self.agent
        first, second = (part.begin(seeds) if isinstance(part, Policy) else None for part in both)
        return first, second

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the sum of the policy's and the agent's actions, and both memories."""
        memory, agent_memory = (None, None) if state is None else state
        own, memory = self.policy.predict(observation, memory, start, deterministic=True)
        correction, agent_memory = self.agent.predict(observation, agent_memory, start, deterministic=True)
        return own + correction, (memory, agent_memory)
