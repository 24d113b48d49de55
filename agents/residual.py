"""Residual agents: the agent's action is added to that of a policy that already works.

Zero is exactly the policy, so learning starts from it instead of from nothing. The sum is taken at the edge
of the action space, as every action is. Training over many environments: ``to_sb3(env, residual_to=policy)``.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy

from ..baselines.problem import Problem
from ..envs.contract.model import Model
from ..envs.interface.environment import TaskEnv
from ..evaluation.competitors.kinds import Policy, expose_spaces, kind_of, make_competitor, says_traceable


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


class ResidualActions(gymnasium.Wrapper):
    """A single environment whose actions are added to a policy's.

    Args:
        env: a filtergym environment with a control of continuous actions.
        policy: anything with Stable-Baselines3's ``predict``, for the same control.

    Raises:
        ValueError: if actions cannot be added.
    """

    def __init__(self, env: gymnasium.Env, policy: Any) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        if not isinstance(inner, TaskEnv):
            raise ValueError(f"ResidualActions takes an environment of filtergym, got {type(inner).__name__}")
        check_residual(inner.model, policy)
        self.policy = policy
        self._shown: Any = None
        self._memory: Any = None
        self._start = numpy.ones(1, dtype=bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and the policy's memory with it."""
        self._shown, info = self.env.reset(seed=seed, options=options)
        self._memory, self._start = None, numpy.ones(1, dtype=bool)
        return self._shown, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Add the policy's action and step."""
        if self._shown is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        inner: Any = self.env.unwrapped
        shown = self._shown["observation"] if inner.privileged else self._shown
        own, self._memory = self.policy.predict(shown[None], self._memory, self._start, deterministic=True)
        self._start = numpy.zeros(1, dtype=bool)
        self._shown, reward, terminated, truncated, info = self.env.step(own[0] + numpy.asarray(action))
        return self._shown, reward, terminated, truncated, info


class ResidualPolicy(Policy):
    """A policy and the agent that corrects it, as one policy for an evaluation.

    Args:
        model: of both.
        policy: the one that is corrected.
        agent: the correction.

    Raises:
        ValueError: if actions cannot be added.
    """

    def __init__(self, model: Model, policy: Any, agent: Any) -> None:
        super().__init__(model)
        check_residual(model, policy)
        self.control = model.control  # type: ignore[misc]
        self.policy, self.agent = policy, agent
        self.traceable = says_traceable(policy) and says_traceable(agent)  # type: ignore[misc]  # of these two
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
