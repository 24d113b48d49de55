"""The two Gymnasium faces of a task: ``TaskEnv`` with one episode, ``TaskVectorEnv`` with many."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from .backend import host_array, is_tensor, task_on, tensor_on
from .catalogue import find_scenario, nearest
from .lanes import Lanes, mean_of
from .observation import Array, Field
from .reward import REWARDS, paper_task, reward
from .task import Task
from .trajectory import Trajectory

if TYPE_CHECKING:
    from .rendering import EpisodePicture


def _observation_space(task: Task) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-numpy.inf, numpy.inf, (len(task.fields),), numpy.float64)


FEW = 16
"""Numbers that are looked at one by one sooner than by NumPy."""


def _all_finite(values: Array) -> bool:
    if isinstance(values, numpy.ndarray) and values.size <= FEW:
        return all(map(math.isfinite, values.ravel().tolist()))
    # The sum is finite unless an entry is not, and costs a third of asking for every entry. It may overflow.
    with numpy.errstate(over="ignore", invalid="ignore"):
        return math.isfinite(values.sum()) or all(map(math.isfinite, values.reshape(-1).tolist()))


def checked_action(space: gymnasium.Space, action: Any, count: int | None) -> Array:
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
    if array.shape != shape or not real or not _all_finite(values):
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

    @property
    def backend(self) -> str:
        """What computes the steps: "compiled", "numpy" or "torch"."""
        return self.task.backend

    def _pay(
        self, action: Array, info: dict[str, Array], watch: Callable[[Any], None] | None = None
    ) -> Array:
        """Step the lanes and return the mean reward over the measurements of this decision, ``(count,)``.

        ``watch`` is called with the state after the action, once for each measurement.
        """
        if not self.detailed_info and watch is None:
            return self.lanes.pay(action, self.reward_kind)
        task = self.task
        rewards: list[Array] = []
        widened = self.lanes.widened(action)

        def record(state: Any, paper_state: Any) -> None:
            rewards.append(reward(self.reward_kind, task, state, self.lanes.paper, paper_state))
            if self.detailed_info:
                batch_last = {
                    "error": task.error(state),
                    "cost": task.cost(state),
                    **task.track(state),
                    **task.records(state),
                }
                # A copy: some of these arrays are the state's own, and the caller may overwrite them.
                for name, values in batch_last.items():
                    moved = task.xp.moveaxis(values[..., : self.lanes.count], -1, 0)
                    info[name] = task.xp.asarray(moved, copy=True)
            if watch is not None:
                watch(state)

        self.lanes.step(lambda state: task.act(state, widened), record)
        return mean_of(rewards)[: self.lanes.count]

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
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Task.track`), error,
            cost and what else an evaluation records.
        backend: "auto" (default), "compiled" or "numpy"; see :func:`~.backend.task_on`.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name or a value out of its limits.
        ImportError: for the compiled backend without llvmlite.
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
        backend: str = "auto",
        **keywords: Any,
    ) -> None:
        if backend == "torch":
            raise ValueError("backend 'torch' is for many episodes at once: use gymnasium.make_vec")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        self._open(task_on(backend, task, control, scenario, **keywords), reward, 1, detailed_info)
        self.render_mode = render_mode
        self.picture: EpisodePicture | None = None
        """What keeps and draws the episode; None without a render mode."""
        if render_mode is not None:
            # Only here: matplotlib takes longer to import than an episode takes to run.
            from . import rendering

            name = find_scenario(type(self.task), scenario).name
            self.picture = rendering.EpisodePicture(self.task, name, render_mode, self.metadata["render_fps"])
        self.observation_space = _observation_space(self.task)
        self.action_space = self.task.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Start an episode and show its first measurement."""
        super().reset(seed=seed)
        self.lanes.seed(0, self.np_random)
        self.lanes.restart()
        if self.picture is not None:
            self.picture.begin(self.lanes.state)
            self._show()
        return self.lanes.observe()[0], {}

    def step(self, action: Any) -> tuple[numpy.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply the action to the measurement just shown, then show the next one."""
        if not self.lanes.begun:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        array = checked_action(self.action_space, action, None)
        info: dict[str, Any] = {}
        watch: Callable[[Any], None] | None = None
        if self.picture is not None:
            picture, shown = self.picture, self.lanes.observe()[0]

            def watch(state: Any) -> None:
                picture.keep(state, array, shown)

        paid = self._pay(array[None], info, watch)
        if self.picture is not None:
            self._show()
        if info:
            info = {name: values[0] for name, values in info.items()}
        return self.lanes.observe()[0], float(paid[0]), False, bool(self.lanes.finished[0]), info

    def _show(self) -> None:
        """Draw into the window of render mode "human"."""
        if self.picture is not None and self.render_mode == "human":
            self.picture.show(self.lanes.state)

    def render(self) -> numpy.ndarray | None:
        """Draw the episode so far.

        Returns:
            ``(height, width, 3)`` bytes in render mode "rgb_array"; None in "human", whose window is drawn by
            every reset and step anyway.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.picture is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gym.make(..., render_mode="rgb_array")'
            )
            return None
        if not self.lanes.begun:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        if self.render_mode == "human":
            self._show()
            return None
        return self.picture.frame(self.lanes.state)

    def close(self) -> None:
        """Close the window."""
        if self.picture is not None:
            self.picture.close()


class TaskVectorEnv(_Face, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many episodes of a task side by side, natively vectorised.

    Args:
        task: environment id.
        num_envs: number of sub-environments; sub-environment i equals the single environment with the same
            seed, whatever the number.
        control: what the action steers.
        scenario: name of a scenario, or a trajectory.
        reward: "cost" (default), "log-likelihood" or "relative".
        backend: "auto" (default), "compiled" or "numpy", see :func:`~.backend.task_on`; or "torch": observations,
            rewards, masks and ``info`` are tensors, actions may be. Episodes are the same everywhere, drawn by the
            same NumPy generators; float64 results differ by rounding. Torch's gradients flow from rewards and
            observations back to actions that require them, over all steps since the last reset; pass detached
            actions where none are wanted.
        device: where the torch backend computes, such as "cpu" (default) or "cuda".
        threads: how many share the sub-environments, of the compiled backend; the numbers stay the same.
        autoreset_mode: a :class:`gymnasium.vector.AutoresetMode` or its value.
        max_episode_steps: truncate earlier than the task's horizon (``make_vec`` passes it on).
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Task.track`), error,
            cost and what else an evaluation records.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name, a value out of its limits, or a device that is not there.
        ImportError: for a backend whose library is not installed.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        control: str | None = None,
        scenario: str | Trajectory | None = None,
        reward: str = "cost",
        backend: str = "auto",
        device: Any = None,
        threads: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        detailed_info: bool = False,
        **keywords: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        made = task_on(backend, task, control, scenario, device=device, threads=threads, **keywords)
        self.device = made.device
        self._open(made, reward, num_envs, detailed_info)
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
        """Start new episodes everywhere, or where ``options["reset_mask"]`` is true.

        ``options["shortened_by"]``: integers ``(num_envs,)``, by how many decisions each of these episodes ends
        early (later ones are whole again), so that episodes of one horizon need not all end together.
        """
        mask = (options or {}).get("reset_mask")
        shortened = numpy.asarray((options or {}).get("shortened_by", numpy.zeros(self.num_envs, dtype=int)))
        if (
            shortened.shape != (self.num_envs,)
            or shortened.dtype.kind not in "iu"
            or (shortened < 0).any()
            or (shortened >= self.last_decision).any()
        ):
            raise ValueError(
                f"options['shortened_by'] must hold {self.num_envs} integers from 0 to "
                f"{self.last_decision - 1}, got {shortened!r}"
            )
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
                    f"options['reset_mask'] must be a boolean array of shape ({self.num_envs},) with "
                    f"at least one True, got {mask!r}"
                )
            if not self.lanes.begun and not mask.all():
                raise gymnasium.error.ResetNeeded("reset every sub-environment once before resetting some")
            chosen = numpy.flatnonzero(mask).tolist()
        self._seed(seed, chosen)
        self.lanes.restart(chosen)
        self.lanes.decisions[list(chosen)] = shortened[list(chosen)]
        self._finished = self._finished.copy()
        self._finished[list(chosen)] = False
        return self.lanes.observe(), {}

    def step(self, actions: Any) -> tuple[Array, Array, numpy.ndarray, numpy.ndarray, dict[str, Any]]:
        """Apply the actions to the measurements just shown, then show the next ones."""
        if not self.lanes.begun:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        waiting = self._finished
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {numpy.flatnonzero(waiting).tolist()} are finished: reset them with "
                "options={'reset_mask': ...}"
            )
        array = self._actions(actions)
        info: dict[str, Any] = {}
        paid = self._pay(array, info)
        if waiting.any():
            # NEXT_STEP: this step only resets those that finished in the last one; their action is ignored.
            self.lanes.restart(numpy.flatnonzero(waiting).tolist())
            paid = self.task.xp.where(self._mask(waiting), 0.0, paid)
        finished = self.lanes.decisions >= self.last_decision
        if self.autoreset_mode is AutoresetMode.SAME_STEP and finished.any():
            done = numpy.flatnonzero(finished)
            info = self._masked(info, ~finished) | {
                "final_obs": self._final_observations(self.lanes.observe(), done),
                "_final_obs": self._mask(finished),
                "final_info": self._masked(info, finished),
                "_final_info": self._mask(finished),
            }
            self.lanes.restart(done.tolist())
            self._finished = self._never
        else:
            info = self._masked(info, ~waiting)
            self._finished = finished
        return self.lanes.observe(), paid, self._mask(self._never), self._mask(finished), info

    def _masked(self, info: dict[str, Any], mask: numpy.ndarray) -> dict[str, Any]:
        """Gymnasium's form of what some sub-environments report: a mask beside every key."""
        if not mask.any():
            return {}
        masked = {}
        for name, values in info.items():
            masked[name], masked[f"_{name}"] = values, self._mask(mask)
        return masked

    def _actions(self, actions: Any) -> Array:
        array = checked_action(self.single_action_space, actions, self.num_envs)
        if self.backend != "torch":
            return host_array(array)
        tensor = tensor_on(array, self.device)
        # As in NumPy, where clipping whole numbers to limits that are floats gives floats.
        whole = isinstance(self.single_action_space, gymnasium.spaces.Box) and not tensor.is_floating_point()
        return tensor.double() if whole else tensor

    def _mask(self, lanes: numpy.ndarray) -> Array:
        """Return booleans of the lanes for the caller to keep: a copy, on the device of the backend."""
        return lanes.copy() if self.backend != "torch" else tensor_on(lanes, self.device)

    def _final_observations(self, last: Array, done: numpy.ndarray) -> Array:
        """Gymnasium's form: an object for each finished sub-environment, None elsewhere.

        With the torch backend one tensor, the last observation of every lane: taking it apart would cost a
        transfer for each lane.
        """
        if self.backend == "torch":
            return last
        final = numpy.full(self.num_envs, None, dtype=object)
        for lane in done:
            final[lane] = last[lane]
        return final
