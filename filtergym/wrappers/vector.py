"""The wrappers of :mod:`filtergym.wrappers` for vector environments: many lanes, one update of all filters."""

from typing import Any

import numpy
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from .lanes import FilterLanes, SensorLanes, rows_of

__all__ = ["EstimatedObservation", "NoisyObservation"]


class NoisyObservation(SensorLanes, VectorWrapper[Any, Any, Any, Any, Any]):
    """Readings of sensors in place of the full observations; arguments as of the wrapper of one environment.

    A lane has the readings, bit for bit, that a single environment of its seed has. With autoreset in the same step
    ``infos["final_obs"]`` holds the last readings of an episode.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], sensors: Any, model: Any = None) -> None:
        super().__init__(env, sensors, model)
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._every = numpy.ones(env.num_envs, dtype=bool)
        self._ended = ~self._every
        """Lanes whose episode ended in the last step, and that have not begun anew."""

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin episodes, of some environments alone with the option ``reset_mask``, and return their readings."""
        mask = (options or {}).get("reset_mask")  # Gymnasium takes it out of the options
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        lanes = self._every if mask is None else numpy.asarray(mask, dtype=bool)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        self._ended = self._ended & ~lanes
        values, available = self._read(observations, lanes, ~self._every, seeds)
        return values, self._with_available(infos, available)

    def step(self, actions: Any) -> tuple[numpy.ndarray, Any, Any, Any, dict[str, Any]]:
        """Step the environments, and read the sensors."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        ended, begins = numpy.logical_or(terminations, truncations), self._ended
        if self._mode is AutoresetMode.SAME_STEP and ended.any():
            finals = zip(infos["final_obs"], ended, observations, strict=True)
            values, available = self._read(numpy.stack([last if was else now for last, was, now in finals]))
            infos = {**infos, "final_obs": rows_of(ended, values)}
            for one in self._readings.followers:
                one.final = one.shown.copy()
            values, begun = self._read(observations, ended, ~self._every)
            available = numpy.where(ended[:, None], begun, available)
        elif begins.any():
            is_begun = begins & (self._mode is AutoresetMode.NEXT_STEP)
            values, available = self._read(observations, is_begun, ~begins)
        else:
            values, available = self._read(observations)
        if self._mode is not AutoresetMode.SAME_STEP:
            self._ended = ended
        return values, rewards, terminations, truncations, self._with_available(infos, available)

    def _with_available(self, infos: dict[str, Any], available: numpy.ndarray) -> dict[str, Any]:
        return {**infos, "available": available, "_available": self._every.copy()}


class EstimatedObservation(FilterLanes, VectorWrapper[Any, Any, Any, Any, Any]):
    """The estimates of filters in place of readings; arguments as of the wrapper of one environment.

    A lane has the estimates, bit for bit, that a single environment of its seed has. With autoreset in the same step
    ``infos["final_obs"]`` holds the last estimate of an episode.
    """
