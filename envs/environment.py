"""The two Gymnasium faces of a task: ``TaskEnv`` with one episode, ``TaskVectorEnv`` with many."""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from .backend import host_array, is_tensor, task_on, tensor_on
from .catalogue import ScenarioChoice, check_names, find_scenario, nearest, task_class
from .lanes import Lanes, mean_of
from .observation import Array, Field
from .parameters import Limits, check, frozen
from .reward import REWARDS, paper_task, reward
from .specification import told
from .task import Task

if TYPE_CHECKING:
    from .rendering import EpisodePicture, EpisodePictures, LatePicture

FRAMES_PER_SECOND = 10
DTYPES = ("float64", "float32")
"""Types of observations and rewards; inside everything is float64."""


def _checked_seed(seed: Any) -> int | None:
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | numpy.integer) or seed < 0:
        raise ValueError(f"a seed is None or an integer of at least 0, got {seed!r}")
    return int(seed)


def _checked_options(options: Any, known: Iterable[str]) -> Mapping[str, Any]:
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"options of a reset are a dictionary or None, got {options!r}")
    for name in options:
        if name not in known:
            raise nearest("option of a reset", name, known)
    return options


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
    dtype: str
    """Of observations and rewards: "float64" or "float32"."""
    last_decision: int
    """Actions after which an episode is truncated."""
    reset_options: ClassVar[tuple[str, ...]] = ()
    """Names that ``options`` of a reset may have."""
    _spec: EnvSpec | None = None

    def _check(
        self, task: str, reward_kind: str, detailed_info: bool, dtype: str, names: Iterable[str]
    ) -> None:
        """Refuse keywords that are unknown or of a wrong kind, before anything is made."""
        check_names(task_class(task), names, inspect.signature(type(self)).parameters)
        if reward_kind not in REWARDS:
            raise nearest("reward", reward_kind, REWARDS)
        if not isinstance(dtype, str) or dtype not in DTYPES:  # a NumPy dtype equals its name
            raise nearest("dtype", dtype, DTYPES)
        check("detailed_info", detailed_info, bool, Limits())
        self.reward_kind, self.detailed_info, self.dtype = reward_kind, detailed_info, dtype

    def _open(self, task: Task, count: int) -> None:
        self.task = task
        self.lanes = Lanes(task, count, paper_task(task) if self.reward_kind == "relative" else None)
        self.last_decision = self.lanes.decisions_per_episode

    def _observation_space(self) -> gymnasium.spaces.Box:
        return gymnasium.spaces.Box(
            -numpy.inf, numpy.inf, (len(self.task.fields),), numpy.dtype(self.dtype).type
        )

    def _rounded(self, values: Array) -> Array:
        """Numbers in the type that was asked for."""
        if self.dtype == "float64":
            return values
        return self.task.xp.astype(values, self.task.xp.float32)

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made this from; its ``max_episode_steps`` is the length of an episode in decisions."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else told(spec, self.last_decision)

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
        scenario: name of a scenario, a :class:`~filtergym.envs.trajectory.Trajectory` or a dictionary of its fields, or
            the path of a file with one.
        reward: "cost" (default), "log-likelihood" or "relative"; see :mod:`.reward`.
        render_mode: None, "rgb_array" or "human".
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Task.track`), error,
            cost and what else an evaluation records.
        backend: "auto" (default), "compiled" or "numpy"; see :func:`~.backend.task_on`.
        dtype: of observations and rewards: "float64" (default), or "float32", to which they are rounded when they are
            given out.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name or a value out of its limits; an unknown keyword is a TypeError too.
        ImportError: for the compiled backend without llvmlite.
    """

    metadata = {  # noqa: RUF012 (as in gymnasium.Env)
        "render_modes": ["human", "rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        task: str,
        control: str | None = None,
        scenario: ScenarioChoice = None,
        reward: str = "cost",
        render_mode: str | None = None,
        detailed_info: bool = False,
        backend: str = "auto",
        dtype: str = "float64",
        **keywords: Any,
    ) -> None:
        self._check(task, reward, detailed_info, dtype, keywords)
        if backend == "torch":
            raise ValueError("backend 'torch' is for many episodes at once: use gymnasium.make_vec")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        self._open(task_on(backend, task, control, scenario, **keywords), 1)
        self.render_mode = render_mode
        self._late: LatePicture | None = None
        if render_mode is not None:
            # Only here: matplotlib takes longer to import than an episode takes to run.
            from . import rendering

            name = find_scenario(type(self.task), scenario, keywords).name
            self._late = rendering.LatePicture(
                rendering.EpisodePicture(self.task, name, render_mode, FRAMES_PER_SECOND)
            )
        self.observation_space = self._observation_space()
        self.action_space = self.task.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Start an episode and show its first measurement.

        Raises:
            ValueError: for a seed that is none, and for options, of which there are none.
        """
        _checked_options(options, self.reset_options)
        super().reset(seed=_checked_seed(seed))
        self.lanes.seed(0, self.np_random)
        if self._late is not None:
            self._late.begin(self.np_random)
        self.lanes.restart()
        self._show()
        return self._rounded(self.lanes.observe()[0]), {}

    def step(self, action: Any) -> tuple[numpy.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply the action to the measurement just shown, then show the next one."""
        if not self.lanes.begun:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        array = checked_action(self.action_space, action, None)
        info: dict[str, Any] = {}
        paid = self._pay(array[None], info)
        if self._late is not None:
            self._late.keep(array)
            self._show()
        if info:
            info = {name: values[0] for name, values in info.items()}
        shown_next, earned = self._rounded(self.lanes.observe()[0]), float(self._rounded(paid)[0])
        return shown_next, earned, False, bool(self.lanes.finished[0]), info

    def _show(self) -> None:
        """Draw into the window of render mode "human"."""
        if self._late is not None and self.render_mode == "human":
            self._late.show()

    @property
    def picture(self) -> "EpisodePicture | None":
        """What keeps and draws the episode, up to date; None without a render mode."""
        return None if self._late is None else self._late.picture

    def render(self) -> numpy.ndarray | None:
        """Draw the episode so far.

        Returns:
            ``(height, width, 3)`` bytes in render mode "rgb_array"; None in "human", whose window is drawn by
            every reset and step anyway.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._late is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gym.make(..., render_mode="rgb_array")'
            )
            return None
        if not self.lanes.begun:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        if self.render_mode == "human":
            self._show()
            return None
        return self._late.frame()

    def close(self) -> None:
        """Close the window."""
        if self._late is not None:
            self._late.close()


class TaskVectorEnv(_Face, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many episodes of a task side by side, natively vectorised.

    Args:
        task: environment id.
        num_envs: number of sub-environments; sub-environment i equals the single environment with the same
            seed, whatever the number.
        control: what the action steers.
        scenario: name of a scenario, a trajectory or a dictionary of its fields, or the path of a file with one.
        reward: "cost" (default), "log-likelihood" or "relative".
        render_mode: None, or "rgb_array": :meth:`render` draws the first few sub-environments.
        backend: "auto" (default), "compiled" or "numpy", see :func:`~.backend.task_on`; or "torch": observations,
            rewards, masks and ``info`` are tensors, actions may be. Episodes are the same everywhere, drawn by the
            same NumPy generators; float64 results differ by rounding. Torch's gradients flow from rewards and
            observations back to actions that require them, over all steps since the last reset; pass detached
            actions where none are wanted.
        device: where the torch backend computes, such as "cpu" (default) or "cuda".
        threads: how many share the sub-environments, of the compiled backend; the numbers stay the same.
        autoreset_mode: a :class:`gymnasium.vector.AutoresetMode` or its value.
        max_episode_steps: truncate earlier than the task's horizon (``make_vec`` passes it on); None or -1: do not.
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Task.track`), error,
            cost and what else an evaluation records.
        dtype: of observations and rewards: "float64" (default), or "float32", to which they are rounded when they are
            given out.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name, a value out of its limits, or a device that is not there; an unknown keyword is
            a TypeError too.
        ImportError: for a backend whose library is not installed.
    """

    metadata = {  # noqa: RUF012 (as in gymnasium.vector.VectorEnv)
        "render_modes": ["rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }
    reset_options = ("reset_mask", "shortened_by")
    pictures: "EpisodePictures | None" = None
    """What keeps and draws the first few episodes; None without a render mode."""

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        control: str | None = None,
        scenario: ScenarioChoice = None,
        reward: str = "cost",
        render_mode: str | None = None,
        backend: str = "auto",
        device: Any = None,
        threads: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        detailed_info: bool = False,
        dtype: str = "float64",
        **keywords: Any,
    ) -> None:
        self._check(task, reward, detailed_info, dtype, keywords)
        num_envs, max_episode_steps = frozen(num_envs), frozen(max_episode_steps)
        check("num_envs", num_envs, int, Limits(at_least=1))
        if max_episode_steps not in (None, -1):
            check("max_episode_steps", max_episode_steps, int, Limits(at_least=1))
        modes = {mode.value: mode for mode in AutoresetMode}
        if not isinstance(autoreset_mode, AutoresetMode):
            if not isinstance(autoreset_mode, str) or autoreset_mode not in modes:
                raise nearest("autoreset_mode", autoreset_mode, modes)
            autoreset_mode = modes[autoreset_mode]
        if render_mode == "human":
            raise ValueError(
                "render_mode 'human' is a window for one episode: use gymnasium.make, or render_mode='rgb_array'"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        made = task_on(backend, task, control, scenario, device=device, threads=threads, **keywords)
        self.device = made.device
        self._open(made, num_envs)
        self.autoreset_mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.num_envs = num_envs
        self.render_mode = render_mode
        if render_mode is not None:
            from . import rendering

            name = find_scenario(type(self.task), scenario, keywords).name
            self.pictures = rendering.EpisodePictures(self.task, name, num_envs, FRAMES_PER_SECOND)
        self.single_observation_space = self._observation_space()
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        if max_episode_steps not in (None, -1):
            self.last_decision = min(self.last_decision, max_episode_steps)
        self._finished = numpy.zeros(num_envs, dtype=bool)
        self._never = numpy.zeros(num_envs, dtype=bool)

    def _checked_seeds(self, seed: Any) -> list[int | None]:
        if not isinstance(seed, Sequence | numpy.ndarray) or isinstance(seed, str):
            first = _checked_seed(seed)
            return [None if first is None else first + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, one for each sub-environment, got {len(seed)}")
        return [_checked_seed(one) for one in seed]

    def _seed(self, seeds: Sequence[int | None], lanes: Sequence[int]) -> None:
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

        Raises:
            ValueError: for other options, and for seeds that are none.
            gymnasium.error.ResetNeeded: for a mask before the first reset.
        """
        wanted = _checked_options(options, self.reset_options)
        seeds = self._checked_seeds(seed)
        mask = wanted.get("reset_mask")
        shortened = self._checked_shortening(wanted.get("shortened_by", [0] * self.num_envs))
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
        self._seed(seeds, chosen)
        self._restart(chosen)
        self.lanes.decisions[list(chosen)] = shortened[list(chosen)]
        self._finished = self._finished.copy()
        self._finished[list(chosen)] = False
        return self._rounded(self.lanes.observe()), {}

    def _checked_shortening(self, values: Any) -> numpy.ndarray:
        try:
            shortened = numpy.asarray(values)
        except (ValueError, TypeError):  # rows of different lengths, a tensor on a device
            shortened = numpy.empty(0)
        if (
            shortened.shape != (self.num_envs,)
            or shortened.dtype.kind not in "iu"
            or (shortened < 0).any()
            or (shortened >= self.last_decision).any()
        ):
            raise ValueError(
                f"options['shortened_by'] must hold {self.num_envs} integers from 0 to "
                f"{self.last_decision - 1}, got {values!r}"
            )
        return shortened

    def _restart(self, lanes: Sequence[int]) -> None:
        self.lanes.restart(lanes)
        if self.pictures is not None:
            self.pictures.begin(self.lanes.state, lanes)

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
        paid = self._pay(array, info, self._watch(array))
        if waiting.any():
            # NEXT_STEP: this step only resets those that finished in the last one; their action is ignored.
            self._restart(numpy.flatnonzero(waiting).tolist())
            paid = self.task.xp.where(self._mask(waiting), 0.0, paid)
        finished = self.lanes.decisions >= self.last_decision
        if self.autoreset_mode is AutoresetMode.SAME_STEP and finished.any():
            done = numpy.flatnonzero(finished)
            info = self._masked(info, ~finished) | {
                "final_obs": self._final_observations(self._rounded(self.lanes.observe()), done),
                "_final_obs": self._mask(finished),
                "final_info": self._masked(info, finished),
                "_final_info": self._mask(finished),
            }
            self._restart(done.tolist())
            self._finished = self._never
        else:
            info = self._masked(info, ~waiting)
            self._finished = finished
        shown, paid = self._rounded(self.lanes.observe()), self._rounded(paid)
        return shown, paid, self._mask(self._never), self._mask(finished), info

    def _watch(self, action: Array) -> Callable[[Any], None] | None:
        """Return what keeps the states of this step for the pictures; None without a render mode."""
        if self.pictures is None:
            return None
        pictures, actions, shown = self.pictures, host_array(action), host_array(self.lanes.observe())
        return lambda state: pictures.keep(state, actions, shown)

    def render(self) -> tuple[numpy.ndarray, ...] | None:
        """Draw the episodes so far of the first few sub-environments (:data:`.rendering.DRAWN`).

        Returns:
            A frame for each sub-environment, ``(height, width, 3)`` bytes, blank beyond the first few: drawing takes
            far longer than stepping. None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.pictures is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gymnasium.make_vec(..., render_mode="rgb_array")'
            )
            return None
        if not self.lanes.begun:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        return self.pictures.frames(self.lanes.state)

    def close_extras(self, **kwargs: Any) -> None:
        """Forget the figures."""
        if self.pictures is not None:
            self.pictures.close()

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
        return tensor_on(array, self.device)

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
