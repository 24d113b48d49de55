"""What the wrappers of one environment and of many share: an environment is one lane, a vector environment has N."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy
from gymnasium.vector import AutoresetMode

from .estimates import PARTS, Estimates
from .models import CLASSIC_CONTROL, EnvironmentModel, find_model
from .readings import EnvironmentSensor, Reading, Readings, sensors_of


class SensorLanes:
    """Sensors of the lanes of an environment."""

    fields: int
    """Of the full observation."""
    model: EnvironmentModel | None
    """Whose state the sensors read."""
    sensors: dict[str, EnvironmentSensor]
    reading: Reading
    """The last readings of all lanes, not rounded to the type of the observation."""
    events: list[tuple[bool, Any, Reading]]
    """Readings of one time that a filter takes in at the last step or reset (:attr:`.Readings.complete`), after whether
    lanes begin an episode or step and which lanes, booleans ``(N,)``; None: all."""

    def _place_sensors(
        self, env: Any, space: gymnasium.Space[Any], lanes: int, sensors: Any, model: Any
    ) -> gymnasium.spaces.Box:
        """Make the sensors, and return the space of a lane's readings.

        Raises:
            ValueError: for sensors that do not fit, or observations that are no vector or of which the model makes no
                state.
        """
        self.fields = check_observations(space, env.spec)
        self.model = found = find_model(model, env.spec)
        n = self.fields if found is None else len(found.names)
        if found is not None:
            try:
                fits = found.state(numpy.zeros((1, self.fields))).shape == (1, n)
            except IndexError:
                fits = False
            if not fits:
                raise ValueError(
                    f"the observation has {self.fields} fields, of which the model does not make its state of {n}, "
                    f"{', '.join(found.names)}: let NoisyObservation stand below wrappers that change the "
                    "observation, or give a model whose state= reads it"
                )
        self.sensors, interval = sensors_of(found, sensors, self.fields)
        self._readings: Readings = Readings(self.sensors, n, interval, lanes)
        dtype: Any = space.dtype if numpy.issubdtype(space.dtype, numpy.floating) else numpy.float32
        self._dtype: Any = numpy.dtype(dtype)
        limit = self._readings.limit.astype(self._dtype)
        return gymnasium.spaces.Box(-limit, limit, dtype=self._dtype.type)

    def _begin(
        self, lanes: numpy.ndarray, observations: Any, seeds: Sequence[int | None] | None, received: Any = False
    ) -> numpy.ndarray:
        """Begin episodes of some lanes, and return the readings of all."""
        self.reading = self._readings.begin(lanes, self._state(observations), seeds, received)
        self.events = [*self.events, (True, lanes, self._readings.complete)]
        return self.reading.values.astype(self._dtype)

    def _advance(self, lanes: numpy.ndarray | None, observations: Any) -> numpy.ndarray:
        """Return the readings after a step of some lanes; None: of all."""
        self.reading = self._readings.advance(lanes, self._state(observations))
        self.events = [(False, lanes, self._readings.complete)]
        return self.reading.values.astype(self._dtype)

    def _state(self, observations: Any) -> numpy.ndarray:
        state = numpy.asarray(observations, dtype=float)
        return state if self.model is None else self.model.state(state)


class FilterLanes:
    """Filters of the lanes of an environment."""

    model: EnvironmentModel

    def _place_filters(
        self, env: Any, lanes: int, actions: gymnasium.Space[Any], model: Any, competitor: Any, show: Any, control: Any
    ) -> tuple[gymnasium.spaces.Box, gymnasium.Space[Any]]:
        """Make the filters, and return the spaces of a lane's observation and action.

        Raises:
            ValueError: where no sensors are below, or the model does not fit.
        """
        self._sensors: SensorLanes = find_sensors(env)
        found = self._sensors.model if model is None else find_model(model, env.spec)
        self.model = check_model(found, self._sensors, actions)
        shown = check_shown(show, self.model)
        self._estimates = Estimates(self.model, self._sensors.sensors, competitor, control, shown, lanes)
        joined = joint_space(actions, self._estimates.action_space)
        self._joins, self._own_actions = isinstance(joined, gymnasium.spaces.Box), actions
        return self._estimates.space(self._sensors._dtype.type), joined

    @property
    def estimates(self) -> Estimates:
        """The filters, with mean, deviation, NIS and innovation of all lanes."""
        return self._estimates

    def _split(self, action: Any) -> tuple[Any, numpy.ndarray | None]:
        """Return the environment's action, and that of the filter behind it on the last axis; None without control."""
        if self._estimates.action_space is None:
            return action, None
        if not self._joins:
            return action[0], numpy.asarray(action[1], dtype=float)
        count, joined = self._own_actions.shape[-1], numpy.asarray(action)  # type: ignore[index]
        return joined[..., :count], joined[..., count:].astype(float)

    def _take(self, actions: Any, own: numpy.ndarray | None) -> numpy.ndarray | None:
        """Take in the readings of a step or reset; return the estimates before lanes began anew, None where none did.

        Args:
            actions: of all lanes; None: of a reset.
            own: of the filters.
        """
        last, estimates = None, self._estimates
        for begins, lanes, reading in self._sensors.events:
            if begins:
                last = None if actions is None else self._shown()
                estimates.begin(lanes, reading)
            else:
                estimates.advance(lanes, inputs_of(self.model, actions), reading, own)
        return last

    def _shown(self) -> numpy.ndarray:
        """Return the observations of all lanes."""
        return self._estimates.show(self._sensors._dtype)


def autoreset_of(env: Any) -> AutoresetMode:
    """Return the autoreset mode of a vector environment, by default that of the next step."""
    mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
    return mode if isinstance(mode, AutoresetMode) else AutoresetMode(mode)


def rows_of(lanes: numpy.ndarray, values: numpy.ndarray) -> numpy.ndarray:
    """Return the rows of some lanes as objects, and None for the others, as Gymnasium stores final observations."""
    rows = numpy.empty(len(lanes), dtype=object)
    rows[:] = [row if is_chosen else None for row, is_chosen in zip(values, lanes, strict=True)]
    return rows


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


def find_sensors(env: Any) -> SensorLanes:
    """Return the wrapper with sensors below a filter, or raise ValueError where there is none."""
    inner, module = env, " of filtergym.wrappers.vector" if isinstance(env, gymnasium.vector.VectorEnv) else ""
    while not isinstance(inner, SensorLanes):
        inner = getattr(inner, "env", None)
        if inner is None:
            raise ValueError(
                f"EstimatedObservation needs sensors: wrap the environment in NoisyObservation{module} first"
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
