"""A filter of a state-space model behind the sensors of an environment, for many lanes."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy

from ..baselines.problem import import_problem
from ..compiler.functions import round_up_lanes
from ..envs.contract.filter import Initial
from ..envs.data.recorded_world import Feed
from ..envs.engine.backend import make_model
from ..envs.engine.compiled import can_step
from ..envs.engine.scenario_choice import find_scenario
from ..envs.linear.inputs import Input
from ..envs.linear.sensors import Sensor
from ..evaluation.competitors.filters import put_in_loop
from ..evaluation.competitors.kinds import kind_of
from ..evaluation.competitors.stepping import CompiledUpdate, ModelUpdate
from ..filters.angles import PERIODS
from ..filters.array_namespace import select_nested
from ..own_models import state_space
from .models import EnvironmentModel
from .readings import Array, EnvironmentSensor, Reading

PARTS = ("observation", "mean", "deviation", "nis", "innovation")
"""What an observation may hold of an estimate."""
CONTROLS = ("noise", "gain")
"""What an action may change of the filter."""
_IDS: dict[tuple[Any, ...], tuple[str, Any]] = {}
"""Environments of state-space models of this process, with model and sensors, by these."""


def state_space_id(model: EnvironmentModel, sensors: Mapping[str, EnvironmentSensor]) -> str:
    """Return the id of the environment of a state-space model, which is made once.

    Raises:
        ValueError: for a model that :func:`filtergym.state_space` refuses.
    """
    fields = [one.name for one in dataclasses.fields(Sensor) if one.name != "interval"]
    key = (id(model), *((name, *(_key(getattr(one, f)) for f in fields)) for name, one in sensors.items()))
    if key in _IDS:
        return _IDS[key][0]
    Q, name = model.matrix("noise"), f"wrapped/Model{len(_IDS) + 1}-v0"
    state_space(
        name,
        f=model.f,
        Q=lambda dt: [[number * dt for number in row] for row in Q.tolist()],
        sensors={
            label: Sensor(**{field: getattr(one, field) for field in fields})
            for label, one in sensors.items()
        },
        mean=model.mean,
        covariance=model.matrix("covariance"),
        names=tuple(model.names),
        angles=dict(model.angles),
        inputs={one: Input() for one in model.inputs},
        sampling_interval=model.interval,
    )
    _IDS[key] = name, (model, sensors)
    return name


def _key(value: Any) -> Any:
    """Return numbers and words as they are, and a function by its identity."""
    if callable(value):
        return id(value)
    return value.tolist().__repr__() if isinstance(value, numpy.ndarray) else repr(value)


def report_estimate(model: Any, episode: Any) -> dict[str, Any]:
    """Report mean, variances and normalised innovation squared of a filter."""
    covariance = model.filter.covariance(episode.filter)
    xp = model.task.xp
    mean = model.filter.mean(episode.filter)
    nis = model.filter.records(episode.filter, episode.measurement).get("nis", 0.0 * mean[0])
    variance = xp.stack([covariance[i, i] for i in range(mean.shape[0])])
    return {"mean": mean, "variance": variance, "nis": nis}


class Estimates:
    """The filters of N lanes.

    Sensors of several delays are taken in together when the last of them has come: the filter then runs as many steps
    behind, and the mean is carried to the present by the motion and the inputs since.

    Args:
        model: of the environment.
        sensors: that read its state.
        competitor: name of an estimator of a state-space model, such as ``"extended"``, or what makes one.
        control: ``"noise"`` or ``"gain"``: an action multiplies these of the filter as written, in place of a
            competitor; None: nothing does.
        lanes: N.

    Attributes:
        action_space: of the control; None without.

    Raises:
        ValueError: for an unknown competitor or control, or a model that cannot be one.
    """

    def __init__(
        self,
        model: EnvironmentModel,
        sensors: Mapping[str, EnvironmentSensor],
        competitor: Any,
        control: str | None,
        lanes: int,
    ) -> None:
        self.model, self._lanes = model, lanes
        problem = import_problem(state_space_id(model, sensors))
        if control is not None and control not in CONTROLS:
            raise ValueError(f"control must be {' or '.join(CONTROLS)}, or None, got {control!r}")
        scenario = dataclasses.replace(
            find_scenario(problem.task, None, {}), flights=(), recording=Feed(False, False, (), None, None)
        )
        own: Any = make_model(problem.task, control or problem.task.controls[0], scenario, backend="auto")
        if control is None:
            maker = problem.find(competitor) if isinstance(competitor, str) else competitor
            known = [*problem.baselines.estimators]
            if maker is None or kind_of(maker) != "estimator":
                raise ValueError(
                    f"competitor must be an estimator, one of {', '.join(known)}, got {competitor!r}"
                )
            own = put_in_loop(own, maker, "estimator", str(competitor), lanes)
        self.action_space = None if control is None else own.action_space
        self._own, world = own, own.task.world
        self._initial, self._measurement = world.initial, world.measurement
        self._is_compiled = can_step(own, report_estimate)
        self._is_asked = not self._is_compiled or control is not None
        self._update: Any = (
            CompiledUpdate(own, report_estimate, lanes, None, self._is_asked, None)
            if self._is_compiled
            else ModelUpdate(own, report_estimate, lanes, self._measurement, None)
        )
        self._width = round_up_lanes(lanes)
        self._pad = numpy.minimum(numpy.arange(self._width), lanes - 1)
        self._no_action = numpy.zeros((self._width, *(own.action_space.shape or ())))
        self._motion = own.task.definition.filters[0].f
        self._h = own.task.definition.filters[0].h
        numbers = [one for one, channel in zip(sensors.values(), own.task.definition.channels, strict=True)
                   for _ in channel.numbers]  # fmt: skip
        delays = numpy.array([one.delay for one in numbers])
        self._behind, self._held = int(delays.max()), int(delays.max()) - delays
        """Steps for which each number waits for the slowest."""
        self.periods = numpy.array([PERIODS[one.wraps] if one.wraps else numpy.inf for one in numbers])
        self.turns = [
            (i, PERIODS[model.angles[one]]) for i, one in enumerate(model.names) if one in model.angles
        ]
        m, p = len(numbers), len(model.inputs)
        depth = self._behind + 1
        self._values = numpy.zeros((depth, lanes, m))
        self._available = numpy.zeros((depth, lanes, m))
        self._inputs = numpy.zeros((depth + 1, lanes, p))
        self._steps = numpy.zeros(lanes, dtype=numpy.int64)
        self.mean = numpy.zeros((lanes, len(model.names)))
        self.deviation = numpy.zeros_like(self.mean)
        self.nis = numpy.zeros(lanes)
        self.innovation = numpy.zeros((lanes, m))
        self.lost = numpy.zeros(lanes, dtype=bool)
        """Whether the filter of a lane has just begun anew because its estimate was not finite."""

    def begin(self, lanes: Array, reading: Reading) -> None:
        """Begin episodes of some lanes with their first readings; the others stay as they are."""
        self._restart(lanes)
        self._steps[lanes] = 0
        self._take(lanes, reading, None)

    def _restart(self, lanes: Array) -> None:
        model, N = self.model, self._width
        mean = numpy.repeat(numpy.array(model.mean, dtype=float)[:, None], N, axis=1)
        covariance = numpy.repeat(model.matrix("covariance")[:, :, None], N, axis=2)
        begun = self._own.start_filter(Initial(mean, covariance))
        if not lanes.all():
            begun = select_nested(lanes[self._pad], begun, self._update.state)
        self._update.go_on(begun, ())
        self.mean[lanes], self.deviation[lanes] = mean[:, 0], numpy.sqrt(numpy.diag(covariance[..., 0]))
        self._filtered = numpy.where(
            lanes[:, None], mean[:, : self._lanes].T, getattr(self, "_filtered", self.mean)
        )

    def advance(self, lanes: Array, inputs: Array, reading: Reading, action: Array | None = None) -> None:
        """Take in the readings of a step of some lanes.

        Args:
            lanes: which step, booleans ``(N,)``.
            inputs: that acted in the step, ``(N, p)``.
            reading: of all lanes.
            action: of the control, ``(N, ...)``.
        """
        self._steps[lanes] += 1
        self._take(lanes, reading, inputs, action)

    def _take(
        self, lanes: Array, reading: Reading, inputs: Array | None, action: Array | None = None
    ) -> None:
        depth, each, own = self._behind + 1, numpy.arange(self._lanes), self.model
        step = self._steps
        if depth == 1:
            values, available = reading.values, reading.available * lanes[:, None]
            acted = inputs
        else:
            self._values[step[lanes] % depth, each[lanes]] = reading.values[lanes]
            self._available[step[lanes] % depth, each[lanes]] = reading.available[lanes]
            if inputs is not None:
                self._inputs[step[lanes] % (depth + 1), each[lanes]] = inputs[lanes]
            place = (step[:, None] - self._held) % depth
            columns = numpy.arange(self._values.shape[2])
            ready = (step >= self._behind)[:, None] & lanes[:, None]
            values = self._values[place, each[:, None], columns]
            available = self._available[place, each[:, None], columns] * ready
            acted = self._inputs[(step - self._behind) % (depth + 1), each]
        at = step - self._behind
        moves = lanes & (at > 0)
        interval = numpy.where(moves, own.interval, 0.0)
        acted = numpy.zeros((self._lanes, len(own.inputs))) if acted is None else acted
        self._send(values.T, available.T, interval, acted.T)
        if self._is_asked:
            self._update.answer(self._no_action if action is None else self._actions(action, moves))
        found = self._update.report()
        mean, variance, nis = (
            numpy.reshape(found[name], (-1, self._lanes)) for name in ("mean", "variance", "nis")
        )
        finite = numpy.isfinite(mean).all(axis=0) & numpy.isfinite(variance).all(axis=0)
        predicted = self._motion_of(self._filtered.T, interval, acted.T)
        innovation = values - self._h_of(predicted).T
        turning = numpy.isfinite(self.periods)
        if turning.any():
            periods = numpy.where(turning, self.periods, 1.0)
            innovation = innovation - numpy.where(turning, numpy.round(innovation / periods) * periods, 0.0)
        used = (available > 0.0) & lanes[:, None]
        self.innovation = numpy.where(lanes[:, None], numpy.where(used, innovation, 0.0), self.innovation)
        self._filtered = mean.T.copy()
        present = mean
        for back in range(self._behind - 1, -1, -1):
            going = lanes & (step - back > 0)
            u = self._inputs[(step - back) % (depth + 1), each].T
            present = self._motion_of(present, numpy.where(going, own.interval, 0.0), u)
        self.mean = numpy.where(lanes[:, None], present.T, self.mean)
        self.deviation = numpy.where(
            lanes[:, None], numpy.sqrt(numpy.clip(variance, 0.0, None)).T, self.deviation
        )
        self.nis = numpy.where(lanes & used.any(axis=1), nis[0], numpy.where(lanes, 0.0, self.nis))
        self.lost = lanes & ~finite
        if self.lost.any():
            self._restart(self.lost)
        for i, period in self.turns:
            self.mean[:, i] -= period * numpy.round(self.mean[:, i] / period)

    def _send(self, values: Array, available: Array, interval: Array, inputs: Array) -> None:
        """Give a measurement to the filters; arrays ``(..., N)``, without this axis where there is one lane."""
        parts = [values, numpy.asarray(available, dtype=float), interval]
        measurement = self._measurement._replace(
            values=parts[0],
            available=parts[1],
            interval=parts[2],
            inputs=inputs if len(self.model.inputs) else None,
        )
        if self._lanes == 1:
            one = {
                name: None if part is None else part[..., 0] for name, part in measurement._asdict().items()
            }
            measurement = measurement._replace(**one)
        self._update.arrive(measurement)

    def _actions(self, action: Array, moves: Array) -> Array:
        """Return actions of the whole width; zero in lanes whose filter stands still."""
        padded = numpy.asarray(action, dtype=float)[self._pad]
        padded[~moves[self._pad]] = 0.0
        return padded

    def _motion_of(self, mean: Array, interval: Array, inputs: Array) -> Array:
        """Return states ``(n, N)`` an interval later."""
        return numpy.asarray(self._motion.value(numpy.concatenate([mean, interval[None], inputs]), numpy))

    def _h_of(self, mean: Array) -> Array:
        return numpy.asarray(self._h.value(mean, numpy))

    def space(self, show: tuple[str, ...], dtype: Any) -> gymnasium.spaces.Box:
        """Return the space of what is shown of one lane."""
        size, n = 0, len(self.model.names)
        if "observation" in show:
            size += self.model.observation(numpy.zeros((1, n))).shape[1]  # type: ignore[misc]
        size += n * (("mean" in show) + ("deviation" in show)) + ("nis" in show)
        size += self.innovation.shape[1] * ("innovation" in show)
        return gymnasium.spaces.Box(-numpy.inf, numpy.inf, (size,), dtype)

    def show(self, show: tuple[str, ...], dtype: Any) -> Array:
        """Return what is shown, ``(N, fields)``."""
        parts = []
        for name in show:
            if name == "observation":
                parts.append(self.model.observation(self.mean))  # type: ignore[misc]
            else:
                value = getattr(self, name)
                parts.append(value[:, None] if value.ndim == 1 else value)
        return numpy.concatenate(parts, axis=1).astype(dtype)
