"""The two Gymnasium faces of a task: ``TaskEnv`` with one episode, ``TaskVectorEnv`` with many."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from .backend import array_backend, host_array, is_tensor, tensor_on
from .catalogue import make_task, nearest
from .lanes import Lanes
from .reward import REWARDS, paper_task, reward
from .task import Array, Field, Task
from .trajectory import Trajectory


def _observation_space(task: Task) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-numpy.inf, numpy.inf, (len(task.fields),), numpy.float64)


def _checked_action(space: gymnasium.Space, action: Any, count: int | None) -> Array:
    """Return the action as an array, or as the tensor that it is, or say what arrived and what was expected."""
    if is_tensor(action):
        array, values = action, action.detach()
        floating, real = (
            values.is_floating_point(),
            str(values.dtype) != "torch.bool" and not values.is_complex(),
        )
    else:
        array = values = numpy.asarray(action)
        floating, real = values.dtype.kind == "f", values.dtype.kind in "fiu"
    if isinstance(space, gymnasium.spaces.Discrete):
        shape: tuple[int, ...] = () if count is None else (count,)
        n = int(space.n)
        if array.shape != shape or floating or not real or (values < 0).any() or (values >= n).any():
            raise _unexpected_action(f"integer actions from 0 to {n - 1} of shape {shape}", values)
        return array
    assert space.shape is not None
    shape = space.shape if count is None else (count, *space.shape)
    # The sum is finite unless an entry is not, and costs a third of asking for every entry.
    if array.shape != shape or not real or not math.isfinite(values.sum()):
        raise _unexpected_action(f"finite actions of shape {shape}", values)
    return array


def _unexpected_action(expected: str, action: Array) -> ValueError:
    shown = numpy.array2string(host_array(action), threshold=8)
    return ValueError(f"expected {expected}, got {action.dtype} of shape {tuple(action.shape)}: {shown}")


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
                info.update(
                    {name: values.T if values.ndim == 2 else values for name, values in batch_last.items()}
                )

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

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 10}

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
        backend: "numpy", or "torch": observations, rewards, masks and ``info`` are tensors, actions may be.
            Episodes are the same, drawn by the same NumPy generators; float64 results differ by rounding.
            Gradients flow from rewards and observations back to actions that require them, over all steps
            since the last reset; pass detached actions where none are wanted.
        device: where the torch backend computes, such as "cpu" (default) or "cuda".
        autoreset_mode: a :class:`gymnasium.vector.AutoresetMode` or its value.
        max_episode_steps: truncate earlier than the task's horizon (Gymnasium passes it on from ``make_vec``).
        detailed_info: whether ``info`` carries truth error, cost and what an evaluation records.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name, a value out of its limits, or a device that is not there.
        ImportError: for the torch backend without torch.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        control: str | None = None,
        scenario: str | Trajectory | None = None,
        reward: str = "cost",
        backend: str = "numpy",
        device: Any = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        detailed_info: bool = False,
        **keywords: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        xp, self.device = array_backend(backend, device)
        self.backend = backend
        self._open(
            make_task(task, control, scenario, xp, self.device, **keywords), reward, num_envs, detailed_info
        )
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
            mask = host_array(mask) if is_tensor(mask) else mask
            if (
                not isinstance(mask, numpy.ndarray)
                or mask.dtype != bool
                or mask.shape != (self.num_envs,)
                or not mask.any()
            ):
                raise ValueError(
                    f"options['reset_mask'] must be a boolean array of shape ({self.num_envs},) with at least "
                    f"one True, got {mask!r}"
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
            paid = self.task.xp.where(self._mask(waiting), 0.0, paid)
        finished = self.lanes.decisions >= self.last_decision
        if self.autoreset_mode is AutoresetMode.SAME_STEP and finished.any():
            last = self.lanes.observe()
            done = numpy.flatnonzero(finished)
            info = self._final_info(info, last, done)
            self.lanes.restart(done.tolist())
            self._finished = self._never
        else:
            self._finished = finished
        return self.lanes.observe(), paid, self._mask(self._never), self._mask(finished), info

    def _actions(self, actions: Any) -> Array:
        array = _checked_action(self.single_action_space, actions, self.num_envs)
        if self.backend == "numpy":
            return host_array(array)
        tensor = tensor_on(array, self.device)
        # As in NumPy, where clipping whole numbers to limits that are floats gives floats.
        whole = isinstance(self.single_action_space, gymnasium.spaces.Box) and not tensor.is_floating_point()
        return tensor.double() if whole else tensor

    def _mask(self, lanes: numpy.ndarray) -> Array:
        """Return booleans of the lanes for the caller to keep: a copy, on the device of the backend."""
        return lanes.copy() if self.backend == "numpy" else tensor_on(lanes, self.device)

    def _final_info(self, info: dict[str, Any], last: Array, done: numpy.ndarray) -> dict[str, Any]:
        """Gymnasium's form: objects for the finished ones, None elsewhere, and a mask beside every key.

        With the torch backend ``final_obs`` is one tensor, the last observation of every lane: taking it
        apart would cost a transfer for each lane.
        """
        mask = numpy.zeros(self.num_envs, dtype=bool)
        mask[done] = True
        final_obs = last
        if self.backend == "numpy":
            final_obs = numpy.full(self.num_envs, None, dtype=object)
            for lane in done:
                final_obs[lane] = last[lane]
        final_info = {}
        for name, values in info.items():
            final_info[name], final_info[f"_{name}"] = values, self._mask(mask)
        return {
            "final_obs": final_obs,
            "_final_obs": self._mask(mask),
            "final_info": final_info,
            "_final_info": self._mask(mask),
        }
