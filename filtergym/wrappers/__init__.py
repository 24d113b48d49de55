"""Noisy sensors and a filter around any Gymnasium environment.

:class:`NoisyObservation` turns the full observation of an environment into readings of sensors, and
:class:`EstimatedObservation` puts a filter behind these: the observation is then its estimate. Vector environments have
wrappers of the same names in :mod:`filtergym.wrappers.vector`.
"""

from typing import Any

import gymnasium
import numpy

from .fitting import fit_model
from .lanes import FilterLanes, SensorLanes
from .models import CLASSIC_CONTROL, EnvironmentModel
from .readings import EnvironmentSensor

__all__ = [
    "CLASSIC_CONTROL",
    "EnvironmentModel",
    "EnvironmentSensor",
    "EstimatedObservation",
    "NoisyObservation",
    "fit_model",
]
ONE, NONE = numpy.ones(1, dtype=bool), numpy.zeros(1, dtype=bool)
"""Whether the lane of a single environment begins an episode, and whether it goes on, in a reset."""


class NoisyObservation(SensorLanes, gymnasium.Wrapper[Any, Any, Any, Any]):
    """Readings of sensors in place of the full observation.

    The observation is the readings of all sensors, one after the other, ``(m,)``; where a reading is not received it
    is the last one, and ``info["available"]`` marks those received, ``(m,)``. All are received when an episode begins,
    but for the delay. The noise follows from the seed of ``reset``, see :mod:`.readings`.

    Args:
        env: whose observation is a vector.
        sensors: by their names: :class:`filtergym.Sensor`, :class:`EnvironmentSensor`, or mappings of their fields,
            such as ``{"encoder": {"h": "angle", "R": 0.01}}``, which a spec stores as JSON.
        model: of the environment, whose state the sensors read, see :func:`.models.find_model`; default: that of the
            environment where it is known; otherwise its observation is the state, ``h`` numbers its fields, and the
            ``interval`` of a sensor is one of steps.

    Raises:
        ValueError: for an observation that is no vector, and sensors that do not fit.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin an episode of the environment, and its readings."""
        observation, info = self.env.reset(seed=seed, options=options)
        values, info["available"] = self._read(observation, ONE, NONE, [seed])
        return values, info

    def step(self, action: Any) -> tuple[numpy.ndarray, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and read the sensors."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        own = self._readings
        own.place[...] = observation
        own.run()
        info["available"] = own.available.astype(bool)
        return own.values.astype(self._dtype), reward, terminated, truncated, info


class EstimatedObservation(FilterLanes, gymnasium.Wrapper[Any, Any, Any, Any]):
    """The estimate of a filter in place of readings.

    Args:
        env: with :class:`NoisyObservation` in it.
        model: of the environment, see :func:`.models.find_model`; default: that of the sensors.
        competitor: name of an estimator of a state-space model, such as ``"extended"`` or ``"unscented"``; or what
            makes one.
        show: parts of the observation, in this order: ``"observation"``, the estimate in the form of the environment's
            own observation, by default where the model has that form, so that an agent of the environment acts
            unchanged; ``"mean"``; ``"deviation"``; ``"nis"``, the normalised innovation squared; ``"innovation"`` of
            every number.
        control: ``"noise"`` or ``"gain"``: the action then is that of the environment and behind it that of the filter,
            which steers the update by the next readings; zero is the extended Kalman filter, bit for bit.

    Raises:
        ValueError: where no sensors are below, or the model does not fit.
    """
