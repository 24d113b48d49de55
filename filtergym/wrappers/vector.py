"""The wrappers of :mod:`filtergym.wrappers` for vector environments: many lanes, one update of all filters."""

from typing import Any

import gymnasium
import numpy
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from . import (
    check_model,
    check_observations,
    check_shown,
    find_readings,
    inputs_of,
    joint_space,
    readings_of,
    split_action,
)
from .estimates import Estimates
from .models import EnvironmentModel, find_model
from .readings import EnvironmentSensor, Reading, Readings

__all__ = ["EstimatedObservation", "NoisyObservation"]


def autoreset_of(env: Any) -> AutoresetMode:
    """Return the autoreset mode of a vector environment, by default that of the next step."""
    mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
    return mode if isinstance(mode, AutoresetMode) else AutoresetMode(mode)


class NoisyObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """Readings of sensors in place of the full observations; arguments as of the wrapper of one environment.

    A lane has the readings, bit for bit, that a single environment of its seed has. With autoreset in the same step
    ``infos["final_obs"]`` holds the last readings of an episode.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], sensors: Any, model: Any = None) -> None:
        super().__init__(env)
        self.fields: int = check_observations(env.single_observation_space, env.spec)
        self.model: EnvironmentModel | None = find_model(model, env.spec)
        self.sensors: dict[str, EnvironmentSensor]
        self._readings: Readings
        self.single_observation_space: gymnasium.spaces.Box
        self.sensors, self._readings, self.single_observation_space = readings_of(
            env.single_observation_space, self.model, sensors, env.num_envs
        )
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, env.num_envs
        )
        self.mode: AutoresetMode = autoreset_of(env)
        self.every: numpy.ndarray = numpy.ones(env.num_envs, dtype=bool)
        self.reading: Reading | None = None
        """The last readings of all lanes, not rounded to the type of the observation."""
        self.final: Reading | None = None
        """Readings before an autoreset in the same step; None where no lane began anew in the last step."""
        self.began: numpy.ndarray = self.every
        """Lanes that began an episode in the last step."""
        self._ended = ~self.every

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin episodes of the environments, of some alone with the option ``reset_mask``, and their readings."""
        mask = (options or {}).get("reset_mask")  # Gymnasium takes it out of the options
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        lanes = self.every if mask is None else numpy.asarray(mask, dtype=bool)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        self.reading = self._readings.begin(lanes, self._state(observations), seeds)
        self.final, self.began = None, lanes
        self._ended = self._ended & ~lanes
        return self._show(infos)

    def step(self, actions: Any) -> tuple[numpy.ndarray, Any, Any, Any, dict[str, Any]]:
        """Step the environments, and read the sensors."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        ended = numpy.logical_or(terminations, truncations)
        state, self.final = self._state(observations), None
        if self.mode is AutoresetMode.SAME_STEP:
            self.began = ended
            if ended.any():
                final = numpy.stack([
                    last if was else now
                    for last, was, now in zip(infos["final_obs"], infos["_final_obs"], observations, strict=True)
                ])  # fmt: skip
                self.final = self._readings.advance(None, self._state(final))
                begun = self._readings.begin(ended, state, None)
                chosen = ended[:, None]
                self.reading = Reading(
                    *(numpy.where(chosen, *each) for each in zip(begun, self.final, strict=True))
                )
                shown = numpy.empty(self.num_envs, dtype=object)
                shown[:] = [
                    values if was else None
                    for values, was in zip(self._typed(self.final.values), ended, strict=True)
                ]
                infos = {**infos, "final_obs": shown}
            else:
                self.reading = self._readings.advance(None, state)
        else:
            self.began = self._ended if self.mode is AutoresetMode.NEXT_STEP else ~self.every
            reading = self._readings.advance(~self._ended if self._ended.any() else None, state)
            if self.began.any():
                begun = self._readings.begin(self.began, state, None)
                chosen = self.began[:, None]
                reading = Reading(*(numpy.where(chosen, *each) for each in zip(begun, reading, strict=True)))
            self.reading = reading
            self._ended = ended
        shown, infos = self._show(infos)
        return shown, rewards, terminations, truncations, infos

    def _state(self, observations: Any) -> numpy.ndarray:
        state = numpy.asarray(observations, dtype=float)
        return state if self.model is None else self.model.state(state)

    def _typed(self, values: numpy.ndarray) -> numpy.ndarray:
        return values.astype(self.single_observation_space.dtype)

    def _show(self, infos: dict[str, Any]) -> tuple[numpy.ndarray, dict[str, Any]]:
        assert self.reading is not None
        infos = {**infos, "available": self.reading.available.copy(), "_available": self.every.copy()}
        return self._typed(self.reading.values), infos


class EstimatedObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """The estimates of filters in place of readings; arguments as of the wrapper of one environment.

    A lane has the estimates, bit for bit, that a single environment of its seed has. With autoreset in the same step
    ``infos["final_obs"]`` holds the last estimate of an episode.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        model: Any = None,
        competitor: Any = "extended",
        show: Any = None,
        control: str | None = None,
    ) -> None:
        super().__init__(env)
        self._sensors: NoisyObservation = find_readings(env, NoisyObservation)
        found = self._sensors.model if model is None else find_model(model, env.spec)
        self.model: EnvironmentModel = check_model(found, self._sensors, env.single_action_space)
        shown = check_shown(show, self.model)
        self._estimates: Estimates = Estimates(
            self.model, self._sensors.sensors, competitor, control, shown, env.num_envs
        )
        dtype: Any = self._sensors.single_observation_space.dtype
        self.single_observation_space: gymnasium.spaces.Box = self._estimates.space(dtype)
        self.single_action_space: gymnasium.Space[Any] = joint_space(
            env.single_action_space, self._estimates.action_space
        )
        self.observation_space, self.action_space = (
            gymnasium.vector.utils.batch_space(one, env.num_envs)
            for one in (self.single_observation_space, self.single_action_space)
        )
        self._joins: bool = isinstance(self.single_action_space, gymnasium.spaces.Box)

    @property
    def estimates(self) -> Estimates:
        """The filters, with mean, deviation, NIS and innovation of all lanes."""
        return self._estimates

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin episodes, and the filters of these lanes."""
        _, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        assert self._sensors.reading is not None
        self._estimates.begin(self._sensors.began, self._sensors.reading)
        return self._shown(), infos

    def step(self, actions: Any) -> tuple[numpy.ndarray, Any, Any, Any, dict[str, Any]]:
        """Step the environments, and take their readings in."""
        own, sensors, estimates = None, self._sensors, self._estimates
        if estimates.action_space is not None:
            actions, own = split_action(actions, self.env.single_action_space, self._joins)
        waiting = sensors._ended
        _, rewards, terminations, truncations, infos = self.env.step(actions)
        inputs, began = inputs_of(self.model, numpy.asarray(actions)), sensors.began
        assert sensors.reading is not None
        if sensors.final is not None:
            estimates.advance(None, inputs, sensors.final, own)
            last = numpy.empty(self.num_envs, dtype=object)
            last[:] = [values if was else None for values, was in zip(self._shown(), began, strict=True)]
            infos = {**infos, "final_obs": last}
        else:
            stays = waiting if sensors.mode is not AutoresetMode.SAME_STEP and waiting.any() else None
            estimates.advance(None if stays is None else ~stays, inputs, sensors.reading, own)
        if began.any():
            estimates.begin(began, sensors.reading)
        return self._shown(), rewards, terminations, truncations, infos

    def _shown(self) -> numpy.ndarray:
        return self._estimates.show(self.single_observation_space.dtype)
