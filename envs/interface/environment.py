"""A Gymnasium environment that runs one episode of a task at a time; for many see :mod:`.vector_environment`."""

import functools
import math
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy

from ..contract.model import Model
from ..engine.backend import make_model
from ..engine.catalogue import nearest
from ..engine.scenario_choice import ScenarioChoice
from .environment_base import FRAMES_PER_SECOND, EnvBase
from .requests import EnvOptions, check_action, check_options, check_seed

if TYPE_CHECKING:
    from ..drawing.rendering import EpisodePicture
    from .late_picture import LatePicture


class TaskEnv(EnvBase, gymnasium.Env[Any, Any]):
    """Gymnasium environment that runs one episode of a task at a time.

    Args:
        task: environment id.
        control: name of a control; default: the first of the environment.
        scenario: name of a scenario, a :class:`~filtergym.envs.data.trajectory.Trajectory` or a dictionary of its
            fields, or the path of a file with one; a :class:`~filtergym.envs.data.recording.Recording`, or its file; or
            a mixture, ``{"random": 0.8, "paper": 0.2}``, of which every episode flies one scenario, drawn by these
            weights from ``np_random``.
        reward: "cost", "log-likelihood", "cost-and-likelihood" or "relative", see :mod:`.reward`; default: the
            environment's own, and zero on a recording without truth.
        render_mode: None, "rgb_array" or "human".
        detailed_info: whether ``info`` carries truth, measurement, estimate, covariance (:meth:`.Model.track`), error,
            cost and the further records of an evaluation.
        backend: "auto" (default), "compiled" or "numpy"; see :func:`~.backend.make_model`.
        dtype: type of observations and rewards: "float64" (default), or "float32", to which they are rounded on return.
        context: whether ``info["context"]`` contains the episode's random draws (:meth:`.World.context`).
        observation: "measured" (default), or "asymmetric", for critics in training: a dictionary of the "observation"
            and of "privileged" values, the context and the error after the last action in units of its reported
            standard deviation (zero at a reset). No policy may observe them where it is evaluated.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name or a value out of its limits; an unknown keyword is a TypeError too.
        ImportError: for the compiled backend without llvmlite.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in gymnasium.Env)
        "render_modes": ["human", "rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        task: str,
        control: str | None = None,
        scenario: ScenarioChoice = None,
        reward: str | None = None,
        render_mode: str | None = None,
        detailed_info: bool = False,
        backend: str = "auto",
        dtype: str = "float64",
        context: bool = False,
        observation: str = "measured",
        **keywords: Any,
    ) -> None:
        self._set_options(task, EnvOptions(reward, detailed_info, dtype, context, observation), keywords)
        if backend == "torch":
            raise ValueError("backend 'torch' is for many episodes at once: use gymnasium.make_vec")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise nearest("render_mode", render_mode, self.metadata["render_modes"])
        self._open(
            functools.partial(make_model, self._class, control, backend=backend), scenario, keywords, 1, None
        )
        self.render_mode = render_mode
        self._late: LatePicture | None = None
        if render_mode is not None:
            self._picture_of(self._first_distribution.names[0])
        self.observation_space: gymnasium.Space[Any] = self._observation_space()
        self.action_space: gymnasium.Space[Any] = self.model.action_space
        is_row = isinstance(self.action_space, gymnasium.spaces.Box) and len(self.action_space.shape) == 1
        self._plain_action = self.action_space.shape if is_row else None

    def _picture_of(self, scenario: str) -> None:
        # Only here: matplotlib takes longer to import than an episode takes to run.
        from ..drawing.rendering import EpisodePicture
        from .late_picture import LatePicture

        assert self.render_mode is not None
        self._late = LatePicture(EpisodePicture(self.model, scenario, self.render_mode, FRAMES_PER_SECOND))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode; return the observation of its first measurement, and ``info``.

        ``options["scenario"]``: as the environment's argument ``scenario``; None: the environment's own again.
        ``options["parameters"]``: parameters that override those of the environment; ``{}`` for none. Each applies
        until a reset names another.

        Raises:
            ValueError: for an invalid seed, other options, an unknown name or a value out of its limits in them,
                and for a scenario or parameters that would change the spaces.
        """
        wanted, seed = check_options(options, self.reset_options), check_seed(seed)
        self._apply_reset_options(wanted, [0])
        super().reset(seed=seed)
        self.fleet.seed(0, self.np_random)
        self.fleet.restart()
        self._forget_errors([0])
        self.model: Model = self.fleet.model_of(0)
        if self._late is not None and self._late.model is not self.model:
            self._late.close()
            self._picture_of(self.fleet.scenario_of(0))
        if self._late is not None:
            self._late.begin(self.fleet.identity_of(0))
            self._show()
        return self._single_observation(), self._with_context({})

    def _single_observation(self) -> Any:
        if not self.privileged:
            return self._to_dtype(self.fleet.observe()[0])
        return {name: values[0] for name, values in self._observations().items()}

    def _with_context(self, info: dict[str, Any]) -> dict[str, Any]:
        if self.options.context:
            info["context"] = {name: values[0] for name, values in self._context()[0].items()}
        return info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply the action to the last measurement; return the next observation and Gymnasium's further results."""
        lanes = self.fleet.whole if self._plain and self._late is None else None
        if lanes is not None and lanes.has_running_episode:
            if not (
                action.__class__ is numpy.ndarray
                and action.shape == self._plain_action
                and action.dtype.kind == "f"
                and all(map(math.isfinite, action.tolist()))
            ):  # otherwise no picture is needed
                action = check_action(self.action_space, action, None)
            observation, reward, over = lanes.step_alone(action, self.reward_kind)
            return observation, reward, False, over, {}
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        if self.fleet.done[0]:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset before the next step")
        array = check_action(self.action_space, action, None)
        info: dict[str, Any] = {}
        reward = self._step_lanes(array[None], info)
        if self._late is not None:
            self._late.keep(array)
            self._show()
        if info:
            info = {name: values[0] for name, values in info.items()}
        if self.options.context:
            self._with_context(info)
        reward = float(self._to_dtype(reward)[0])
        return self._single_observation(), reward, False, bool(self.fleet.done[0]), info

    def _show(self) -> None:
        if self._late is not None and self.render_mode == "human":
            self._late.show()

    @property
    def picture(self) -> "EpisodePicture | None":
        """Up-to-date picture of the episode; None without a render mode."""
        return None if self._late is None else self._late.picture

    def render(self) -> numpy.ndarray | None:
        """Return an image of the episode so far in mode "rgb_array"; None in mode "human" or without a mode.

        Returns:
            ``(height, width, 3)`` bytes, or None: every reset and step draws the window of "human" anyway.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._late is None:
            gymnasium.logger.warn(
                'render was called without a render mode: use gym.make(..., render_mode="rgb_array")'
            )
            return None
        if not self.fleet.has_episodes:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        if self.render_mode == "human":
            self._show()
            return None
        return self._late.frame()

    def close(self) -> None:
        """Close the window of render mode "human"."""
        if self._late is not None:
            self._late.close()
