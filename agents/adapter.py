"""Adapter of a filtergym vector environment to ``VecEnv`` of Stable-Baselines3.

``VecEnv`` is older than Gymnasium's vector environments: it resets finished environments in the same step and passes
their last observation in ``info["terminal_observation"]``. The adapter works on whole arrays; all environments that do
not finish in a step share one info.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import numpy
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from ..envs.interface.environment import TaskEnv
from ..envs.interface.vector_environment import TaskVectorEnv
from .gate import Gate
from .residual import check_residual

STAGGERED_GROUPS = 16
"""Groups of environments that finish together, where episodes are staggered. A step with resets takes much longer than
another; with sixteen groups a rollout still covers all parts of an episode evenly.
"""


def to_sb3(
    vector_env: Any, staggered: bool = False, residual_to: Any = None, gate: Gate | None = None
) -> "TaskVecEnv":
    """Return a filtergym vector environment as a Stable-Baselines3 ``VecEnv``.

    Observations, rewards (rounded to float32), dones and infos equal those of ``DummyVecEnv`` over as many single
    environments, each in a ``Monitor``.

    Args:
        vector_env: environment from ``gymnasium.make_vec(id, num_envs, autoreset_mode="SameStep")``.
        staggered: shorten the episodes that a reset starts to lengths spread evenly over the horizon, so that
            environments finish one group after another; later episodes are whole. For training only: a score over
            the shortened ones is not a score of whole episodes.
        residual_to: a policy to whose actions the agent's are added; see :mod:`.residual`.
        gate: gate that decides whether the agent acts; see :mod:`.gate`.

    Raises:
        ValueError: for a vector environment that cannot be adapted, with the reason.
    """
    if not isinstance(vector_env, TaskVectorEnv):
        raise ValueError(
            "to_sb3 takes a native vector environment of filtergym, made by gymnasium.make_vec, "
            f"got {type(vector_env).__name__}"
        )
    if vector_env.autoreset_mode is not AutoresetMode.SAME_STEP:
        raise ValueError(
            "Stable-Baselines3 resets a finished environment in the same step: make the vector environment "
            f'with autoreset_mode="SameStep", got {vector_env.autoreset_mode.value!r}'
        )
    if vector_env.backend == "torch":
        raise ValueError(
            f"Stable-Baselines3 takes NumPy arrays: use backend='numpy', got {vector_env.backend!r}"
        )
    if vector_env.options.detailed_info:
        raise ValueError(
            "to_sb3 has no detailed_info for each environment: leave it out, and evaluate instead"
        )
    if vector_env.options.context:
        raise ValueError(
            "to_sb3 has no context for each environment: leave it out, or show it to critics with "
            "observation='asymmetric'"
        )
    if residual_to is not None:
        check_residual(vector_env.model, residual_to)
    return TaskVecEnv(vector_env, staggered, residual_to, gate)


class TaskVecEnv(VecEnv):
    """A filtergym vector environment with the interface of Stable-Baselines3, made by :func:`to_sb3`."""

    def __init__(self, env: TaskVectorEnv, staggered: bool, residual_to: Any, gate: Gate | None) -> None:
        self.env = env
        self.residual_to = residual_to
        self.gate = gate
        self._policy_memory: Any = None
        self._gate_memory: Any = None
        self._shown: Any = None
        self._start = numpy.ones(env.num_envs, dtype=bool)
        self.staggered = staggered
        self.started: float = time.time()
        self.returns: numpy.ndarray = numpy.zeros(env.num_envs)
        """Sum of rewards of the running episodes."""
        self.lengths: numpy.ndarray = numpy.zeros(env.num_envs, dtype=int)
        """Decisions in the running episodes."""
        self._actions: Any = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.metadata: dict[str, Any] = env.metadata

    def reset(self) -> Any:
        """Start an episode in every environment, with the seeds and options set before; return the observations.

        Raises:
            ValueError: for options that differ between environments, or other options than "scenario" and "parameters".
        """
        options: dict[str, Any] = dict(self._options[0])
        known = TaskEnv.reset_options
        if any(own != options for own in self._options) or not options.keys() <= set(known):
            raise ValueError(
                f"options of a reset, {' and '.join(known)}, must be the same for all environments, got "
                f"{self._options!r}"
            )
        count = self.num_envs
        if self.staggered:
            groups = min(count, STAGGERED_GROUPS)
            group = numpy.arange(count) * groups // count
            options["shortened_by"] = group * self.env.last_decision // groups
        observation, _ = self.env.reset(seed=self._seeds, options=options)
        self.returns[:] = 0.0
        self.lengths[:] = 0
        self._reset_seeds()
        self._reset_options()
        self._shown, self._start = observation, numpy.ones(count, dtype=bool)
        return observation

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Set the seed of every environment's next episode."""
        self._seeds = list(seeds)

    def step_async(self, actions: numpy.ndarray) -> None:
        """Store the actions for :meth:`step_wait`, after residual policy and gate, if any, have changed them."""
        if self.residual_to is not None or self.gate is not None:
            shown = self._shown["observation"] if self.env.privileged else self._shown
        if self.residual_to is not None:
            own, self._policy_memory = self.residual_to.predict(
                shown, self._policy_memory, self._start, deterministic=True
            )
            actions = own + actions
        if self.gate is not None:
            actions, _, self._gate_memory = self.gate.choose(shown, actions, self._gate_memory, self._start)
        self._actions = actions

    def step_wait(self) -> tuple[Any, numpy.ndarray, numpy.ndarray, list[dict[str, Any]]]:
        """Step every environment with the stored actions; return observations, rewards, dones and infos."""
        observation, reward, _, finished, info = self.env.step(self._actions)
        self.returns += reward
        self.lengths += 1
        self._shown, self._start = observation, finished
        # One new dictionary per step for all running episodes: a caller that writes into it affects this step only.
        running: dict[str, Any] = {"TimeLimit.truncated": False}
        infos = [running] * self.num_envs
        if finished.any():
            seconds = round(time.time() - self.started, 6)
            for lane in numpy.flatnonzero(finished).tolist():
                infos[lane] = {
                    "TimeLimit.truncated": True,
                    "terminal_observation": info["final_obs"][lane],
                    "episode": {
                        "r": round(float(self.returns[lane]), 6),
                        "l": int(self.lengths[lane]),
                        "t": seconds,
                    },
                }
            self.returns[finished] = 0.0
            self.lengths[finished] = 0
        return observation, reward.astype(numpy.float32), finished, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    # --- whole state, for checkpoints

    def snapshot(self) -> dict[str, Any]:
        """Return the state on which later steps depend: episodes, running returns, memories of policy and gate.

        Returns and memory are shared with this object, so pickle the snapshot before the next step.
        """
        policy = self._policy_memory, self._gate_memory, self._shown, self._start
        lanes = self.env.fleet.snapshot()
        return {"lanes": lanes, "returns": self.returns, "lengths": self.lengths, "policy": policy}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore a state from :meth:`snapshot`, of an environment made with the same arguments.

        Raises:
            ValueError: if the number of environments differs.
        """
        self.env.fleet.restore(snapshot["lanes"])
        self.returns, self.lengths = snapshot["returns"], snapshot["lengths"]
        self._policy_memory, self._gate_memory, self._shown, self._start = snapshot["policy"]

    # --- the rest of Stable-Baselines3's interface

    def _indices(self, indices: int | Iterable[int] | None) -> Sequence[int]:
        return list(self._get_indices(indices))

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the vector environment in a list, once for each of the given environments."""
        return [getattr(self.env, attr_name) for _ in self._indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Raise NotImplementedError: the environments are one object with fixed parameters."""
        raise NotImplementedError(
            f"cannot set {attr_name!r}: a task is fixed when it is made; make a new vector environment"
        )

    def env_method(
        self, method_name: str, *args: Any, indices: int | Iterable[int] | None = None, **keywords: Any
    ) -> list[Any]:
        """Raise NotImplementedError: there are no separate environments."""
        raise NotImplementedError(
            f"cannot call {method_name!r} on one environment: they are one native object"
        )

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Return whether each environment has a wrapper: true for ``Monitor``, whose statistics the adapter reports."""
        return [wrapper_class is Monitor for _ in self._indices(indices)]
