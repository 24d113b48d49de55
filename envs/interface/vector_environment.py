"""A Gymnasium vector environment that runs many episodes of a task in parallel."""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ...filters.array_namespace import host_array, is_tensor, tensor_on
from ..contract.observation import Array
from ..contract.parameters import ParameterLimits, check, freeze
from ..engine.backend import make_model
from ..engine.catalogue import nearest
from ..engine.scenario_choice import ScenarioChoice
from .environment_base import FRAMES_PER_SECOND, EnvBase
from .requests import EnvOptions, check_action, check_options, check_seed

if TYPE_CHECKING:
    from ..drawing.rendering import EpisodePictures


class _OneThread:
    """Context manager that admits one thread at a time; unlike a lock it can be copied and pickled."""

    def __init__(self) -> None:
        self._free = [True]

    def __enter__(self) -> None:
        try:
            self._free.pop()
        except IndexError:
            raise gymnasium.error.Error(
                "another thread steps or resets these environments at the same time: give each thread its own"
            ) from None

    def __exit__(self, *_: object) -> None:
        self._free.append(True)


class TaskVectorEnv(EnvBase, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Gymnasium vector environment that runs many episodes of a task in parallel.

    Args:
        task: environment id.
        num_envs: number of sub-environments; sub-environment i equals the single environment with the same
            seed, for every number.
        control: name of a control; default: the first of the environment.
        scenario: name of a scenario, a trajectory or its fields, a file with one, or a mixture, see :class:`.TaskEnv`.
        reward: "cost", "log-likelihood", "cost-and-likelihood", "relative" or "log-relative"; default: the
            environment's own.
        render_mode: None, or "rgb_array": :meth:`render` draws the first few sub-environments.
        backend: "auto" (default), "compiled" or "numpy", see :func:`~.backend.make_model`; or "torch": observations,
            rewards, masks and ``info`` are tensors, actions may be. Episodes are the same; float64 results differ by
            rounding. Torch's gradients flow from rewards and observations back to actions that require them, over all
            steps since the last reset; pass detached actions where none are wanted.
        device: where the torch backend computes, such as "cpu" (default) or "cuda".
        threads: number of threads of the compiled backend; results do not depend on it.
        autoreset_mode: a :class:`gymnasium.vector.AutoresetMode` or its value.
        max_episode_steps: truncate earlier than the task's horizon (``make_vec`` passes it on); None or -1: do not.
        detailed_info: whether ``info`` carries the details that :class:`.TaskEnv` lists.
        dtype: type of observations and rewards: "float64" (default), or "float32".
        context: whether ``info["context"]`` contains the random draws of the episode (:meth:`.World.context`).
        observation: "measured" (default), or "asymmetric" with privileged values, see :class:`.TaskEnv`.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name, a value out of its limits, or a missing device; an unknown keyword is
            a TypeError too.
        ImportError: for a backend whose library is not installed.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in gymnasium.vector.VectorEnv)
        "render_modes": ["rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }
    reset_options: ClassVar[tuple[str, ...]] = ("reset_mask", "shortened_by", "scenario", "parameters")
    pictures: "EpisodePictures | None" = None
    """History and pictures of the first few episodes; None without a render mode."""

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        control: str | None = None,
        scenario: ScenarioChoice = None,
        reward: str | None = None,
        render_mode: str | None = None,
        backend: str = "auto",
        device: Any = None,
        threads: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        detailed_info: bool = False,
        dtype: str = "float64",
        context: bool = False,
        observation: str = "measured",
        **keywords: Any,
    ) -> None:
        self._set_options(task, EnvOptions(reward, detailed_info, dtype, context, observation), keywords)
        num_envs, max_episode_steps = freeze(num_envs), freeze(max_episode_steps)
        check("num_envs", num_envs, int, ParameterLimits(at_least=1))
        if max_episode_steps not in (None, -1):
            check("max_episode_steps", max_episode_steps, int, ParameterLimits(at_least=1))
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
        make = functools.partial(
            make_model, self._class, control, backend=backend, device=device, threads=threads
        )
        self._open(make, scenario, keywords, num_envs, None if max_episode_steps == -1 else max_episode_steps)
        self.device: Any = self.task.device
        self.autoreset_mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.num_envs = num_envs
        self.render_mode = render_mode
        if render_mode is not None:
            from ..drawing.rendering import EpisodePictures

            if self.fleet.mixes_scenarios:
                raise ValueError(
                    "a vector of environments that mix scenarios cannot be drawn: use gymnasium.make, or one scenario"
                )
            name = self._first_distribution.names[0]
            self.pictures = EpisodePictures(self.model, name, num_envs, FRAMES_PER_SECOND)
        self.single_observation_space: gymnasium.Space[Any] = self._observation_space()
        self.single_action_space: gymnasium.Space[Any] = self.model.action_space
        self.observation_space: gymnasium.Space[Any] = batch_space(self.single_observation_space, num_envs)
        self.action_space: gymnasium.Space[Any] = batch_space(self.single_action_space, num_envs)
        self._in_use = _OneThread()
        self._finished = numpy.zeros(num_envs, dtype=bool)
        self._never = numpy.zeros(num_envs, dtype=bool)

    def _check_seeds(self, seed: Any) -> list[int | None]:
        if not isinstance(seed, Sequence | numpy.ndarray) or isinstance(seed, str):
            first = check_seed(seed)
            return [None if first is None else first + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, one for each sub-environment, got {len(seed)}")
        return [check_seed(one) for one in seed]

    def _seed(self, seeds: Sequence[int | None], lanes: Sequence[int]) -> None:
        unseeded = not self.fleet.generators
        for lane in range(self.num_envs) if unseeded else lanes:
            if unseeded or seeds[lane] is not None:
                self.fleet.seed(lane, seeding.np_random(seeds[lane])[0])

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes in all sub-environments, or where ``options["reset_mask"]`` is true.

        ``options["shortened_by"]``: integers ``(num_envs,)``, by how many decisions each of these episodes ends
        early (later ones are whole again), so that episodes of one horizon need not all end together.

        ``options["scenario"]`` and ``options["parameters"]``: as of the single environment, of the sub-environments
        that are reset; each applies to their coming episodes, also after an autoreset, until a reset names another.

        Raises:
            ValueError: for other options, an unknown name or a value out of its limits in them, a scenario or
                parameters that would change the spaces, and for invalid seeds.
            gymnasium.error.ResetNeeded: for a mask before the first reset.
        """
        with self._in_use:
            return self._reset(seed, options)

    def _reset(
        self, seed: int | Sequence[int | None] | None, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        wanted = check_options(options, self.reset_options)
        seeds = self._check_seeds(seed)
        mask = wanted.get("reset_mask")
        if self.pictures is not None and {"scenario", "parameters"} & wanted.keys():
            raise ValueError(
                "a vector environment with a render_mode has one scenario: omit render_mode, or scenario and "
                "parameters in the options of a reset"
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
            if not self.fleet.has_episodes and not mask.all():
                raise gymnasium.error.ResetNeeded("reset every sub-environment once before resetting some")
            chosen = numpy.flatnonzero(mask).tolist()
        shortened = wanted.get("shortened_by")
        if shortened is not None:
            shortened = self._check_shortening(shortened)
        self._apply_reset_options(wanted, chosen)
        self._seed(seeds, chosen)
        self._restart(chosen)
        if shortened is not None:
            self.fleet.shorten(chosen, shortened[list(chosen)])
        self._finished = self._finished.copy()
        self._finished[list(chosen)] = False
        begun = numpy.isin(numpy.arange(self.num_envs), chosen)
        return self._observations(), self._with_context({}, begun)

    def _with_context(self, info: dict[str, Any], lanes: numpy.ndarray) -> dict[str, Any]:
        if self.options.context and lanes.any():
            values, present = self._context()
            context = {}
            for name, array in values.items():
                context[name], context[f"_{name}"] = array, self._mask(present[name] & lanes)
            info["context"], info["_context"] = context, self._mask(lanes)
        return info

    def _check_shortening(self, values: Any) -> numpy.ndarray:
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
        self.fleet.restart(lanes)
        self._forget_errors(lanes)
        if self.pictures is not None:
            self.pictures.begin(self.fleet.only.state, lanes)

    def step(self, actions: Any) -> tuple[Any, Array, numpy.ndarray, numpy.ndarray, dict[str, Any]]:
        """Apply the actions to the last measurements; return the next observations and Gymnasium's further results.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, and where an episode has ended without a reset.
            gymnasium.error.Error: where another thread steps or resets the same environments.
        """
        with self._in_use:
            return self._step(actions)

    def _step(self, actions: Any) -> tuple[Any, Array, numpy.ndarray, numpy.ndarray, dict[str, Any]]:
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        waiting = self._finished
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {numpy.flatnonzero(waiting).tolist()} are finished: reset them with "
                "options={'reset_mask': ...}"
            )
        array = self._actions(actions)
        info: dict[str, Any] = {}
        reward = self._step_lanes(array, info, self._watch(array))
        if waiting.any():
            # NEXT_STEP: this step only resets those that finished in the last one; their action is ignored.
            self._restart(numpy.flatnonzero(waiting).tolist())
            reward = self.task.xp.where(self._mask(waiting), 0.0, reward)
        finished = self.fleet.done
        if self.autoreset_mode is AutoresetMode.SAME_STEP and finished.any():
            done = numpy.flatnonzero(finished)
            info = self._with_masks(info, ~finished) | {
                "final_obs": self._final_observations(self._observations(), done),
                "_final_obs": self._mask(finished),
                "final_info": self._with_context(self._with_masks(info, finished), finished),
                "_final_info": self._mask(finished),
            }
            self._restart(done.tolist())
            self._finished = self._never
        else:
            info = self._with_masks(info, ~waiting)
            self._finished = finished
        if self.options.context:
            self._with_context(info, ~self._never)
        shown, reward = self._observations(), self._to_dtype(reward)
        return shown, reward, self._mask(self._never), self._mask(finished), info

    def _watch(self, action: Array) -> Callable[[Any], None] | None:
        if self.pictures is None:
            return None
        pictures, actions, shown = self.pictures, host_array(action), host_array(self.fleet.observe())
        return lambda state: pictures.keep(state, actions, shown)

    def render(self) -> tuple[numpy.ndarray, ...] | None:
        """Return images of the first few sub-environments in mode "rgb_array"; None otherwise.

        Returns:
            A frame for each sub-environment, ``(height, width, 3)`` bytes, blank beyond the first few.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.pictures is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gymnasium.make_vec(..., render_mode="rgb_array")'
            )
            return None
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        return self.pictures.frames(self.fleet.only.state)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the figures in which sub-environments are drawn."""
        if self.pictures is not None:
            self.pictures.close()

    def _with_masks(self, info: dict[str, Any], mask: numpy.ndarray) -> dict[str, Any]:
        if not mask.any():
            return {}
        masked = {}
        for name, values in info.items():
            masked[name], masked[f"_{name}"] = values, self._mask(mask)
        return masked

    def _actions(self, actions: Any) -> Array:
        array = check_action(self.single_action_space, actions, self.num_envs)
        if self.backend != "torch":
            return host_array(array)
        return tensor_on(array, self.device)

    def _mask(self, lanes: numpy.ndarray) -> Array:
        return lanes.copy() if self.backend != "torch" else tensor_on(lanes, self.device)

    def _final_observations(self, last: Any, done: numpy.ndarray) -> Array:
        """Return last observations in Gymnasium's form: an object for each finished lane, else None.

        With the torch backend one tensor, the last observation of every lane: splitting it would need a
        transfer for each lane.
        """
        if self.backend == "torch":
            return last
        final = numpy.full(self.num_envs, None, dtype=object)
        for lane in done:
            final[lane] = {name: v[lane] for name, v in last.items()} if self.privileged else last[lane]
        return final
