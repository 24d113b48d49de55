"""What the wrappers of one environment and of many share: an environment is one lane, a vector environment has N."""

import contextlib
from typing import Any

import gymnasium
import numpy
from gymnasium.vector import VectorEnv, VectorWrapper

from .estimates import PARTS, Estimate, Estimates
from .models import CLASSIC_CONTROL, EnvironmentModel, find_model
from .readings import EnvironmentSensor, Reading, Readings, read_sensors


class SensorLanes(gymnasium.utils.RecordConstructorArgs):
    """What both kinds of NoisyObservation share: sensors of one environment, or of each of many."""

    def __init__(self, env: Any, sensors: Any, model: Any = None) -> None:
        super().__init__(sensors=sensors, model=model, _disable_deepcopy=True)
        space, _, lanes = _wrap(self, env)
        self.fields: int = check_observations(space, env.spec)
        self.model: EnvironmentModel | None = find_model(model, env.spec)
        names, angles = [str(i) for i in range(self.fields)], dict[str, str]()
        if self.model is not None:
            names, angles = check_state(self.model, self.fields), dict(self.model.angles)
        self.sensors: dict[str, EnvironmentSensor] = read_sensors(sensors, names, angles)
        self._readings: Readings = Readings(self.sensors, self.model, self.fields, lanes)
        is_real = numpy.issubdtype(space.dtype, numpy.floating)
        self._dtype: Any = numpy.dtype(space.dtype if is_real else numpy.float32)
        limit = self._readings.limit.astype(self._dtype)
        _set_space(self, "observation", gymnasium.spaces.Box(-limit, limit, dtype=self._dtype.type))

    @property
    def reading(self) -> Reading:
        """The last readings of all lanes, not rounded to the type of the observation."""
        values, available = numpy.atleast_2d(self._readings.values, self._readings.available)
        return Reading(values.copy(), available > 0.0)

    def _read(
        self, observations: Any, begins: Any = None, steps: Any = None, seeds: Any = None
    ) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Return the readings of a step, see :meth:`.Readings.begin`, and whether they are received."""
        readings = self._readings
        readings.place[...] = observations
        if begins is None:
            readings.run()
        else:
            readings.begin(begins, steps, seeds)
        return readings.values.astype(self._dtype), readings.available.astype(bool)


class FilterLanes(gymnasium.utils.RecordConstructorArgs):
    """What both kinds of EstimatedObservation share: a filter of one environment, or of each of many."""

    def __init__(
        self, env: Any, model: Any = None, competitor: Any = "extended", show: Any = None, control: Any = None
    ) -> None:
        super().__init__(
            model=model, competitor=competitor, show=show, control=control, _disable_deepcopy=True
        )
        _, actions, _ = _wrap(self, env)
        self._sensors: SensorLanes = find_sensors(env)
        found = self._sensors.model if model is None else find_model(model, env.spec)
        self.model: EnvironmentModel = check_model(found, self._sensors, actions)
        kept = competitor, control, check_shown(show, self.model), actions
        self._estimates: Estimates = Estimates(self.model, self._sensors._readings, *kept)
        self._dtype: Any = self._sensors._dtype
        shape = self._estimates.shown.shape[-1:]
        _set_space(self, "observation", gymnasium.spaces.Box(-numpy.inf, numpy.inf, shape, self._dtype.type))
        if self._estimates.action_space is not None:
            both: gymnasium.Space[Any] = gymnasium.spaces.Tuple((actions, self._estimates.action_space))
            is_vector = isinstance(actions, gymnasium.spaces.Box) and len(actions.shape) == 1
            _set_space(self, "action", gymnasium.spaces.flatten_space(both) if is_vector else both)

    @property
    def estimates(self) -> Estimate:
        """The last estimates of all lanes, not rounded to the type of the observation."""
        return Estimate(*(one[..., : self._estimates.lanes].T for one in self._estimates.state[-1]))

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[numpy.ndarray, dict[str, Any]]:
        """Begin episodes, and return the estimates of their filters after the first readings."""
        _, info = self.env.reset(seed=seed, options=options)  # type: ignore[attr-defined]
        return self._estimates.shown.astype(self._dtype), info

    def step(self, action: Any) -> tuple[numpy.ndarray, Any, Any, Any, dict[str, Any]]:
        """Step with an action, behind which that of the filter is, and return the estimates after the new readings."""
        estimates, applied = self._estimates, action
        if estimates.action_space is not None:
            if not isinstance(self.action_space, gymnasium.spaces.Tuple):  # type: ignore[attr-defined]
                both, count = numpy.asarray(action), estimates.steering.shape[-1]
                action = both[..., :-count], both[..., -count:]
            applied, estimates.steering[...] = action
        if self.model.inputs:
            estimates.place[...] = applied
        _, reward, terminated, truncated, info = self.env.step(applied)  # type: ignore[attr-defined]
        if "_final_obs" in info:
            finals = estimates.final.astype(self._dtype)
            info = {**info, "final_obs": rows_of(info["_final_obs"], finals)}
        return estimates.shown.astype(self._dtype), reward, terminated, truncated, info


def _wrap(wrapper: Any, env: Any) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any], int]:
    """Make an object a wrapper of an environment; return a lane's observations and actions, and the number of lanes."""
    if isinstance(wrapper, VectorWrapper):
        VectorWrapper.__init__(wrapper, env)
        return env.single_observation_space, env.single_action_space, env.num_envs
    gymnasium.Wrapper.__init__(wrapper, env)
    return env.observation_space, env.action_space, 1


def _set_space(wrapper: Any, kind: str, space: gymnasium.Space[Any]) -> None:
    """Set the space of a lane's observations or actions, and in a vector environment that of all lanes."""
    if isinstance(wrapper, VectorWrapper):
        setattr(wrapper, f"single_{kind}_space", space)
        space = gymnasium.vector.utils.batch_space(space, wrapper.num_envs)
    setattr(wrapper, f"{kind}_space", space)


def rows_of(lanes: numpy.ndarray, values: numpy.ndarray) -> numpy.ndarray:
    """Return the rows of some lanes as objects, and None for the others, as Gymnasium stores final observations."""
    rows = numpy.empty(len(lanes), dtype=object)
    rows[:] = [row if is_chosen else None for row, is_chosen in zip(values, lanes, strict=True)]
    return rows


def check_observations(space: gymnasium.Space[Any], spec: Any) -> int:
    """Return the number of fields of observations, or raise ValueError where they are no vector of numbers."""
    axes = len(space.shape) if isinstance(space, gymnasium.spaces.Box) else 0
    if axes == 1:
        return int(space.shape[0])  # type: ignore[index]
    kind, name = "an image" if axes > 1 else repr(space), getattr(spec, "id", "the environment")
    raise ValueError(
        f"sensors read a vector of numbers, and the observation of {name} is {kind}: wrap it in "
        "gymnasium.wrappers.FlattenObservation first, or give sensors to an environment whose observation is its state"
    )


def check_state(model: EnvironmentModel, fields: int) -> list[str]:
    """Return the names of a model's components, or raise ValueError where it makes no state of the observation."""
    names = [*model.names]
    with contextlib.suppress(IndexError):
        if model.state(numpy.zeros((1, fields))).shape == (1, len(names)):
            return names
    raise ValueError(
        f"the observation has {fields} fields, of which the model does not make its state of {len(names)}, "
        f"{', '.join(model.names)}: let NoisyObservation stand below wrappers that change the observation, or give a "
        "model whose state= reads it"
    )


def find_sensors(env: Any) -> SensorLanes:
    """Return the wrapper with sensors below a filter, or raise ValueError where there is none."""
    inner, module = env, " of filtergym.wrappers.vector" if isinstance(env, VectorEnv) else ""
    while inner is not None and not isinstance(inner, SensorLanes):
        inner = getattr(inner, "env", None)
    if inner is None:
        raise ValueError(
            f"EstimatedObservation needs sensors: wrap the environment in NoisyObservation{module} first"
        )
    return inner


def check_model(model: EnvironmentModel | None, readings: Any, space: Any) -> EnvironmentModel:
    """Return the model of a filter, or raise ValueError where there is none or it does not fit the sensors."""
    if model is None:
        raise ValueError(
            f"no model is known of {getattr(readings.spec, 'id', 'this environment')}: give EstimatedObservation a "
            "model=EnvironmentModel(...), or one of filtergym.wrappers.fit_model"
        )
    names, known, fields = tuple(model.names), readings.model, readings.fields
    if len(names) != fields if known is None else names != tuple(known.names):
        read = f"an observation of {fields} fields" if known is None else ", ".join(known.names)
        raise ValueError(
            f"the model has the components {', '.join(names)}, and the sensors read {read}: give both wrappers one "
            "model"
        )
    if not model.inputs:
        return model
    is_box, inputs = isinstance(space, gymnasium.spaces.Box), ", ".join(model.inputs)
    if model.action is None and not is_box:
        raise ValueError(
            f"the action space is {space}, and the model takes {inputs}: give the model action=, a function from "
            "actions to these inputs"
        )
    is_bounded = model in CLASSIC_CONTROL.values() and is_box and space.is_bounded()
    if is_bounded and (model.inputs_of(numpy.full((1, *space.shape), 1e9)) != space.high).any():
        raise ValueError(
            f"the action space is {space}, and the model takes actions of the environment itself: let "
            "EstimatedObservation stand below wrappers that change the action, or give a model with action="
        )
    found = numpy.shape(model.inputs_of(numpy.zeros((1, *space.shape), space.dtype)))
    if found != (1, len(model.inputs)):
        raise ValueError(
            f"action of the model must return the {len(model.inputs)} inputs {inputs}, got the shape {found[1:]}"
        )
    return model


def check_shown(show: Any, model: EnvironmentModel) -> tuple[str, ...]:
    """Return the checked parts to show, by default the form of the environment's observation where there is one."""
    known = PARTS[model.observation is None :]
    show = known[:1] if show is None else (show,) if isinstance(show, str) else tuple(show)
    if not show or not {*show} <= {*known} or len({*show}) != len(show):
        raise ValueError(f"show must be different words of {', '.join(known)}, got {show!r}")
    return show
