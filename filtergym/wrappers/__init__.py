"""Noisy sensors and a filter around any Gymnasium environment.

:class:`NoisyObservation` turns the full observation of an environment into readings of sensors, and
:class:`EstimatedObservation` puts a filter behind these: the observation is then its estimate. Vector environments have
wrappers of the same names in :mod:`filtergym.wrappers.vector`.
"""

from typing import Any

import gymnasium
import numpy

from .estimates import PARTS, Estimates
from .fitting import fit_model
from .models import CLASSIC_CONTROL, EnvironmentModel, find_model
from .readings import EnvironmentSensor, Reading, Readings, sensors_of

__all__ = [
    "CLASSIC_CONTROL",
    "EnvironmentModel",
    "EnvironmentSensor",
    "EstimatedObservation",
    "NoisyObservation",
    "fit_model",
]
ONE = numpy.ones(1, dtype=bool)
"""The lane of a single environment."""


def check_observations(space: gymnasium.Space[Any], spec: Any) -> int:
    """Return the number of fields of observations, or raise ValueError where they are no vector of numbers."""
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1:
        return int(space.shape[0])
    kind = "an image" if isinstance(space, gymnasium.spaces.Box) and len(space.shape) > 1 else repr(space)
    name = getattr(spec, "id", "the environment")
    raise ValueError(
        f"sensors read a vector of numbers, and the observation of {name} is {kind}: wrap it in "
        "gymnasium.wrappers.FlattenObservation first, or give sensors to an environment whose observation is its state"
    )


def find_readings(env: Any, kind: type) -> Any:
    """Return the wrapper with sensors below a filter, or raise ValueError where there is none."""
    inner = env
    while not isinstance(inner, kind):
        inner = getattr(inner, "env", None)
        if inner is None:
            raise ValueError(
                "EstimatedObservation needs sensors: wrap the environment in NoisyObservation first"
                + ("" if "vector" not in kind.__module__ else " of filtergym.wrappers.vector")
            )
    return inner


def check_model(
    model: EnvironmentModel | None, readings: Any, space: gymnasium.Space[Any]
) -> EnvironmentModel:
    """Return the model of a filter, or raise ValueError where there is none or it does not fit the sensors."""
    if model is None:
        raise ValueError(
            f"no model is known of {getattr(readings.spec, 'id', 'this environment')}: give EstimatedObservation a "
            "model=EnvironmentModel(...), or one of filtergym.wrappers.fit_model"
        )
    known = readings.model
    names = None if known is None else tuple(known.names)
    fields = readings.fields
    if names is None and len(model.names) != fields:
        raise ValueError(
            f"the model has {len(model.names)} components and the sensors read an observation of {fields}: give "
            "NoisyObservation the same model"
        )
    if names is not None and names != tuple(model.names):
        raise ValueError(
            f"the model has the components {', '.join(model.names)}, and the sensors those of a model of "
            f"{', '.join(names)}: give both wrappers one model"
        )
    if model.inputs and model.action is None and not isinstance(space, gymnasium.spaces.Box):
        raise ValueError(
            f"the action space is {space}, and the model takes {', '.join(model.inputs)}: give the model "
            "action=, a function from actions to these inputs"
        )
    bounded = isinstance(space, gymnasium.spaces.Box) and space.is_bounded()
    if model in CLASSIC_CONTROL.values() and bounded:
        largest = inputs_of(model, numpy.full((1, *space.shape), 1e9))  # type: ignore[misc]
        if (largest != space.high).any():  # type: ignore[attr-defined]
            raise ValueError(
                f"the action space is {space}, and the model takes actions of the environment itself: let "
                "EstimatedObservation stand below wrappers that change the action, or give a model with action="
            )
    if model.inputs:
        example: Any = gymnasium.vector.utils.create_empty_array(space, 1, fn=numpy.zeros)
        found = inputs_of(model, example)
        if found.shape != (1, len(model.inputs)):
            raise ValueError(
                f"action of the model must return the {len(model.inputs)} inputs {', '.join(model.inputs)}, got the "
                f"shape {found.shape[1:]}"
            )
    return model


def check_shown(show: Any, model: EnvironmentModel) -> tuple[str, ...]:
    """Return what is shown of an estimate, by default the form of the environment's observation where there is one."""
    default = ("mean",) if model.observation is None else ("observation",)
    show = default if show is None else (show,) if isinstance(show, str) else tuple(show)
    known = PARTS if model.observation is not None else PARTS[1:]
    if not show or not {*show} <= {*known} or len({*show}) != len(show):
        raise ValueError(f"show must be different words of {', '.join(known)}, got {show!r}")
    return show


def inputs_of(model: EnvironmentModel, action: numpy.ndarray) -> numpy.ndarray:
    """Return the inputs ``(N, p)`` of actions ``(N, ...)``."""
    if not model.inputs:
        return numpy.zeros((len(action), 0))
    found = action if model.action is None else model.action(action)
    return numpy.asarray(found, dtype=float).reshape(len(action), -1)


def joint_space(env: gymnasium.Space[Any], own: gymnasium.Space[Any] | None) -> gymnasium.Space[Any]:
    """Return the space of actions of the environment and of the filter: one box of both where they are boxes."""
    if own is None:
        return env
    boxes = isinstance(env, gymnasium.spaces.Box) and isinstance(own, gymnasium.spaces.Box)
    if boxes and len(env.shape) == 1:  # type: ignore[arg-type]
        low, high = (numpy.concatenate([getattr(one, end) for one in (env, own)]) for end in ("low", "high"))
        return gymnasium.spaces.Box(low.astype(env.dtype), high.astype(env.dtype), dtype=env.dtype)  # type: ignore[arg-type]
    return gymnasium.spaces.Tuple((env, own))


def readings_of(
    space: Any, model: EnvironmentModel | None, given: Any, lanes: int
) -> tuple[dict[str, EnvironmentSensor], Readings, gymnasium.spaces.Box]:
    """Return sensors, their readings, and the space of these in one lane.

    Raises:
        ValueError: for sensors that do not fit, or observations of which the model makes no state.
    """
    size = n = space.shape[0]
    if model is not None:
        n = len(model.names)
        try:
            fits = model.state(numpy.zeros((1, size))).shape == (1, n)
        except IndexError:
            fits = False
        if not fits:
            raise ValueError(
                f"the observation has {size} fields, of which the model does not make its state of {n}, "
                f"{', '.join(model.names)}: let NoisyObservation stand below wrappers that change the observation, or "
                "give a model whose state= reads it"
            )
    sensors, interval = sensors_of(model, given, size)
    readings = Readings(sensors, n, interval, lanes)
    dtype: Any = space.dtype if numpy.issubdtype(space.dtype, numpy.floating) else numpy.dtype(numpy.float32)
    limit = readings.limit.astype(dtype)
    return sensors, readings, gymnasium.spaces.Box(-limit, limit, dtype=dtype)


class NoisyObservation(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
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

    def __init__(self, env: gymnasium.Env[Any, Any], sensors: Any, model: Any = None) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, sensors=sensors, model=model, _disable_deepcopy=True
        )
        gymnasium.Wrapper.__init__(self, env)
        self.fields: int = check_observations(env.observation_space, env.spec)
        self.model: EnvironmentModel | None = find_model(model, env.spec)
        self.sensors: dict[str, EnvironmentSensor]
        self._readings: Readings

        self.sensors, self._readings, self.observation_space = readings_of(
            env.observation_space, self.model, sensors, 1
        )
        self.reading: Reading | None = None
        """The last readings, of one lane, not rounded to the type of the observation."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin an episode of the environment, and its readings."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.reading = self._readings.begin(ONE, self._state(observation), [seed])
        return self._show(info)

    def step(self, action: Any) -> tuple[numpy.ndarray, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and read the sensors."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.reading = self._readings.advance(None, self._state(observation))
        shown, info = self._show(info)
        return shown, reward, terminated, truncated, info

    def _state(self, observation: Any) -> numpy.ndarray:
        state = numpy.asarray(observation, dtype=float)[None]
        return state if self.model is None else self.model.state(state)

    def _show(self, info: dict[str, Any]) -> tuple[numpy.ndarray, dict[str, Any]]:
        assert self.reading is not None
        values = self.reading.values[0].astype(self.observation_space.dtype)
        return values, {**info, "available": self.reading.available[0].copy()}


class EstimatedObservation(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
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

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        model: Any = None,
        competitor: Any = "extended",
        show: Any = None,
        control: str | None = None,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, model=model, competitor=competitor, show=show, control=control, _disable_deepcopy=True
        )
        gymnasium.Wrapper.__init__(self, env)
        self._sensors: NoisyObservation = find_readings(env, NoisyObservation)
        found = self._sensors.model if model is None else find_model(model, env.spec)
        self.model: EnvironmentModel = check_model(found, self._sensors, env.action_space)
        shown = check_shown(show, self.model)
        self._estimates: Estimates = Estimates(
            self.model, self._sensors.sensors, competitor, control, shown, 1
        )
        dtype: Any = self._sensors.observation_space.dtype
        self.observation_space: Any = self._estimates.space(dtype)
        self.action_space: Any = joint_space(env.action_space, self._estimates.action_space)
        self._joins: bool = isinstance(self.action_space, gymnasium.spaces.Box)

    @property
    def estimates(self) -> Estimates:
        """The filter, with mean, deviation, NIS and innovation of one lane."""
        return self._estimates

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin an episode, and the filter with its first readings."""
        _, info = self.env.reset(seed=seed, options=options)
        assert self._sensors.reading is not None
        self._estimates.begin(ONE, self._sensors.reading)
        return self._shown(), info

    def step(self, action: Any) -> tuple[numpy.ndarray, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and take its readings in."""
        own = None
        if self._estimates.action_space is not None:
            action, own = split_action(action, self.env.action_space, self._joins)
            own = own[None]
        _, reward, terminated, truncated, info = self.env.step(action)
        assert self._sensors.reading is not None
        inputs = inputs_of(self.model, numpy.asarray(action)[None])
        self._estimates.advance(None, inputs, self._sensors.reading, own)
        return self._shown(), reward, terminated, truncated, info

    def _shown(self) -> numpy.ndarray:
        return self._estimates.show(self.observation_space.dtype)[0]


def split_action(action: Any, space: gymnasium.Space[Any], joins: bool) -> tuple[Any, numpy.ndarray]:
    """Return the environment's action, and that of the filter behind it on the last axis."""
    if not joins:
        return action[0], numpy.asarray(action[1], dtype=float)
    count = space.shape[-1]  # type: ignore[index]
    joined = numpy.asarray(action)
    return joined[..., :count], joined[..., count:].astype(float)
