"""The two Gymnasium faces of a task: ``TaskEnv`` with one episode, ``TaskVectorEnv`` with many."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from .catalogue import make_task, nearest
from .lanes import Lanes
from .reward import REWARDS, paper_task, reward
from .task import Array, Field, Task
from .trajectory import Trajectory


def _observation_space(task: Task) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-numpy.inf, numpy.inf, (len(task.fields),), numpy.float64)


def _checked_action(space: gymnasium.Space, action: Any, count: int | None) -> numpy.ndarray:
    """Return the action as an array, or say what arrived and what was expected."""
    array = numpy.asarray(action)
    if isinstance(space, gymnasium.spaces.Discrete):
        shape: tuple[int, ...] = () if count is None else (count,)
        n = int(space.n)
        if array.shape != shape or array.dtype.kind not in "iu" or (array < 0).any() or (array >= n).any():
            raise ValueError(
                f"expected integer actions from 0 to {n - 1} of shape {shape}, "
                f"got {array.dtype} of shape {array.shape}: {numpy.array2string(array, threshold=8)}"
            )
        return array
    assert space.shape is not None
    shape = space.shape if count is None else (count, *space.shape)
    # The sum is finite unless an entry is not, and costs a third of asking for every entry.
    if array.shape != shape or array.dtype.kind not in "fiu" or not numpy.isfinite(array.sum()):
        raise ValueError(
            f"expected finite actions of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}: {numpy.array2string(array, threshold=8)}"
        )
    return array


class _Face:
    """What both faces share: a task, its spaces, and the reward."""

    task: Task
    lanes: Lanes
    reward_kind: str
    detailed_info: bool

    def _open(self, task: Task, reward_kind: str, count: int, detailed_info: bool) -> None:
        if reward_kind not in REWARDS:
            raise nearest("reward", reward_kind, REWARDS)
        self.task = task
        self.reward_kind = reward_kind
        self.detailed_info = detailed_info
        self.lanes = Lanes(task, count, paper_task(task) if reward_kind == "relative" else None)

    def _pay(self, action: Array, info: dict[str, Array]) -> Array:
        """Step the lanes and return the mean reward over the measurements of this decision."""
        task = self.task
        rewards: list[Array] = []

        def record(state: Any, paper_state: Any) -> None:
            rewards.append(reward(self.reward_kind, task, state, self.lanes.paper, paper_state))
            if self.detailed_info:
                batch_last = {"error": task.error(state), "cost": task.cost(state), **task.records(state)}
                info.update({name: values.T for name, values in batch_last.items()})

        self.lanes.step(lambda state: task.act(state, action), record)
        total = rewards[0]
        for one in rewards[1:]:
            total = total + one
        return total / len(rewards) if len(rewards) > 1 else total

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every component of the observation."""
        return self.task.fields


class TaskEnv(_Face, gymnasium.Env[numpy.ndarray, Any]):
    """One episode of a task at a time.

    Args:
        task: environment id.
        control: what the action steers; default: the first of the environment's controls.
        scenario: name of a scenario, or a :class:`~filtergym.envs.trajectory.Trajectory`.
        reward: "cost" (default), "log-likelihood" or "relative"; see :mod:`.reward`.
        render_mode: None, "rgb_array" or "human".
        detailed_info: whether ``info`` carries truth error, cost and what an evaluation records.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name or a value out of its limits.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012 (as in gymnasium.Env)

    def __init__(
        self,
        task: str,
        control: str | None = None,
        scenario: str | Trajectory | None = None,
        reward: str = "cost",
        render_mode: str | None = None,
        detailed_info: bool = False,
        **keywords: Any,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        self._open(make_task(task, control, scenario, **keywords), reward, 1, detailed_info)
        self.render_mode = render_mode
        self.observation_space = _observation_space(self.task)
        self.action_space = self.task.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Start an episode and show its first measurement."""
        super().reset(seed=seed)
        self.lanes.seed(0, self.np_random)
        self.lanes.restart()
        return self.lanes.observe()[0], {}

    def step(self, action: Any) -> tuple[numpy.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply the action to the measurement just shown, then show the next one."""
        if self.lanes.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        array = _checked_action(self.action_space, action, None)
        info: dict[str, Any] = {}
        paid = self._pay(self.lanes.widened(array[None]), info)
        info = {name: values[0] for name, values in info.items()}
        return self.lanes.observe()[0], float(paid[0]), False, bool(self.lanes.finished[0]), info


class TaskVectorEnv(_Face, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many episodes of a task side by side, natively vectorised.

    Args:
        task: environment id.
        num_envs: number of sub-environments; sub-environment i equals the single environment with the same
            seed, whatever the number.
        control: what the action steers.
        scenario: name of a scenario, or a trajectory.
        reward: "cost" (default), "log-likelihood" or "relative".
        autoreset_mode: a :class:`gymnasium.vector.AutoresetMode` or its value.
        max_episode_steps: truncate earlier than the task's horizon (``make_vec`` passes it on).
        detailed_info: whether ``info`` carries truth error, cost and what an evaluation records.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name or a value out of its limits.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        control: str | None = None,
        scenario: str | Trajectory | None = None,
        reward: str = "cost",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        detailed_info: bool = False,
        **keywords: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self._open(make_task(task, control, scenario, **keywords), reward, num_envs, detailed_info)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self.single_observation_space = _observation_space(self.task)
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.last_decision = min(self.lanes.decisions_per_episode, max_episode_steps or 10**9)
        self._finished = numpy.zeros(num_envs, dtype=bool)
        self._never = numpy.zeros(num_envs, dtype=bool)

    def _seed(self, seed: int | Sequence[int | None] | None, lanes: Sequence[int]) -> None:
        if seed is None or isinstance(seed, int | numpy.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(
                    f"expected {self.num_envs} seeds, one for each sub-environment, got {len(seeds)}"
                )
        unseeded = not self.lanes.generators
        for lane in range(self.num_envs) if unseeded else lanes:
            if unseeded or seeds[lane] is not None:
                self.lanes.seed(lane, gymnasium.utils.seeding.np_random(seeds[lane])[0])

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start new episodes everywhere, or where ``options["reset_mask"]`` is true."""
        mask = (options or {}).get("reset_mask")
        if mask is None:
            chosen: Sequence[int] = range(self.num_envs)
        else:
            if (
                not isinstance(mask, numpy.ndarray)
                or mask.dtype != bool
                or mask.shape != (self.num_envs,)
                or not mask.any()
            ):
                raise ValueError(
                    f"options['reset_mask'] must be a boolean array of shape ({self.num_envs},) with "
                    f"at least one True, got {mask!r}"
                )
            if self.lanes.state is None and not mask.all():
                raise gymnasium.error.ResetNeeded("reset every sub-environment once before resetting some")
            chosen = numpy.flatnonzero(mask).tolist()
        self._seed(seed, chosen)
        self.lanes.restart(chosen)
        self._finished = self._finished.copy()
        self._finished[list(chosen)] = False
        return self.lanes.observe(), {}

    def step(self, actions: Any) -> tuple[Array, Array, numpy.ndarray, numpy.ndarray, dict[str, Any]]:
        """Apply the actions to the measurements just shown, then show the next ones."""
        if self.lanes.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        waiting = self._finished
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {numpy.flatnonzero(waiting).tolist()} are finished: reset them with "
                "options={'reset_mask': ...}"
            )
        array = self._actions(actions)
        info: dict[str, Any] = {}
        paid = self._pay(self.lanes.widened(array), info)[: self.num_envs]
        if self.detailed_info:
            info = {name: values[: self.num_envs] for name, values in info.items()}
        if waiting.any():
            # NEXT_STEP: this step only resets those that finished in the last one; their action is ignored.
            self.lanes.restart(numpy.flatnonzero(waiting).tolist())
            paid = self.task.xp.where(self.task.xp.asarray(waiting, device=self.task.device), 0.0, paid)
        finished = self.lanes.decisions >= self.last_decision
        if self.autoreset_mode is AutoresetMode.SAME_STEP and finished.any():
            last = self.lanes.observe()
            done = numpy.flatnonzero(finished)
            info = self._final_info(info, last, done)
            self.lanes.restart(done.tolist())
            self._finished = self._never
        else:
            self._finished = finished
        return self.lanes.observe(), paid, self._never.copy(), finished, info

    def _actions(self, actions: Any) -> Array:
        return _checked_action(self.single_action_space, actions, self.num_envs)

    def _final_info(self, info: dict[str, Any], last: Array, done: numpy.ndarray) -> dict[str, Any]:
        """Gymnasium's form: objects for the finished ones, None elsewhere, and a mask beside every key."""
        mask = numpy.zeros(self.num_envs, dtype=bool)
        mask[done] = True
        final_obs = numpy.full(self.num_envs, None, dtype=object)
        for lane in done:
            final_obs[lane] = last[lane]
        final_info = {}
        for name, values in info.items():
            final_info[name], final_info[f"_{name}"] = values, mask
        return {
            "final_obs": final_obs,
            "_final_obs": mask,
            "final_info": final_info,
            "_final_info": mask.copy(),
        }
