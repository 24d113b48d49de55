"""A filter of a state-space model behind the sensors of an environment, for many lanes."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy

from ..baselines.problem import Problem
from ..baselines.state_space import state_space_baselines
from ..compiler.functions import round_up_lanes
from ..envs.contract.filter import Initial
from ..envs.data.recorded_world import Feed
from ..envs.engine.backend import make_model
from ..envs.engine.compiled import can_step
from ..envs.engine.scenario_choice import find_scenario
from ..envs.linear.equations import StateSpaceMeasurement
from ..envs.linear.inputs import Input
from ..envs.linear.sensors import Sensor
from ..evaluation.competitors.filters import close_loop
from ..evaluation.competitors.kinds import kind_of
from ..evaluation.competitors.stepping import CompiledUpdate, ModelUpdate
from ..filters.angles import PERIODS
from ..filters.array_namespace import select_nested
from ..own_models import state_space
from .models import EnvironmentModel
from .readings import Array, EnvironmentSensor, Reading

PARTS = ("observation", "mean", "deviation", "nis", "innovation")
"""What an observation may hold of an estimate."""
LARGEST = 1e38
"""Mean or variance of a filter that is lost, as observations of 32 bits cannot hold more: it begins anew."""
CONTROLS = ("noise", "gain")
"""What an action may change of the filter."""
_PROBLEMS: dict[tuple[Any, ...], tuple[Problem, Any]] = {}
"""State-space models of this process, with the objects by which they are found."""


def define_problem(model: EnvironmentModel, sensors: Mapping[str, EnvironmentSensor]) -> Problem:
    """Return the estimation problem of a model and sensors, which is defined once.

    Raises:
        ValueError: for a model that :func:`filtergym.state_space` refuses.
    """
    fields = [one.name for one in dataclasses.fields(Sensor) if one.name != "interval"]
    key = (id(model), *((name, *(_key(getattr(one, f)) for f in fields)) for name, one in sensors.items()))
    if key not in _PROBLEMS:
        Q = model.matrix("noise")
        task = state_space(
            f"wrapped/Model{len(_PROBLEMS) + 1}-v0",
            f=model.f,
            Q=lambda dt: [[number * dt for number in row] for row in Q.tolist()],
            sensors={
                name: Sensor(**{field: getattr(one, field) for field in fields})
                for name, one in sensors.items()
            },
            mean=model.mean,
            covariance=model.matrix("covariance"),
            names=tuple(model.names),
            angles=dict(model.angles),
            inputs={one: Input() for one in model.inputs},
            sampling_interval=model.interval,
            registered=False,
        )
        _PROBLEMS[key] = Problem(task, state_space_baselines(task)), (model, sensors)
    return _PROBLEMS[key][0]


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
        show: words of :data:`PARTS`.
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
        show: tuple[str, ...],
        lanes: int,
    ) -> None:
        self._arguments = model, sensors, competitor, control, show, lanes
        self.model: EnvironmentModel = model
        self._lanes, self._show = lanes, show
        problem = define_problem(model, sensors)
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
            own = close_loop(own, maker, "estimator", str(competitor), lanes)
        self.action_space: Any = None if control is None else own.action_space
        self._own, world = own, own.task.world
        self._is_compiled = can_step(own, report_estimate)
        self._is_asked = not self._is_compiled or control is not None
        self._update: Any = (
            CompiledUpdate(own, report_estimate, lanes, None, self._is_asked, None)
            if self._is_compiled
            else ModelUpdate(own, report_estimate, lanes, world.measurement, None)
        )
        self._width = round_up_lanes(lanes)
        self._pad = numpy.minimum(numpy.arange(self._width), lanes - 1)
        self._no_action = numpy.zeros((self._width, *(own.action_space.shape or ())))
        self._begun: Any = None
        """Filters of all lanes at the start of an episode, made once."""
        self._motion = own.task.definition.filters[0].f
        self._h = own.task.definition.filters[0].h
        numbers = [one for one, channel in zip(sensors.values(), own.task.definition.channels, strict=True)
                   for _ in channel.numbers]  # fmt: skip
        delays = numpy.array([one.delay for one in numbers])
        self._behind, self._held = int(delays.max()), int(delays.max()) - delays
        """Steps for which each number waits for the slowest."""
        self.periods: Array = numpy.array([PERIODS[one.wraps] if one.wraps else numpy.inf for one in numbers])
        self.turns: list[tuple[int, float]] = [
            (i, PERIODS[model.angles[one]]) for i, one in enumerate(model.names) if one in model.angles
        ]
        m, p = len(numbers), len(model.inputs)
        depth = self._behind + 1
        self._values = numpy.zeros((depth, lanes, m))
        self._available = numpy.zeros((depth, lanes, m), dtype=bool)
        self._inputs = numpy.zeros((depth + 1, lanes, p))
        self._steps = numpy.zeros(lanes, dtype=numpy.int64)
        self.mean: Array = numpy.zeros((lanes, len(model.names)))
        self.deviation: Array = numpy.zeros_like(self.mean)
        self.nis: Array = numpy.zeros(lanes)
        self.innovation: Array = numpy.zeros((lanes, m))
        self._filtered = self.mean.T
        """Means of the filters, ``(n, N)``."""
        self._each, self._no_inputs = numpy.arange(lanes), numpy.zeros((lanes, p))
        self._intervals, self._needs_innovation = numpy.full(lanes, model.interval), "innovation" in show

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments, arrays and the state of the filters; their code is made anew."""
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, numpy.ndarray)}
        return {"arguments": self._arguments, "arrays": arrays, "filters": self._update.state}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        vars(self).update(state["arrays"])
        if state["filters"] is not None:
            self._update.resume(state["filters"], ())

    def begin(self, lanes: Array, reading: Reading) -> None:
        """Begin episodes of some lanes with their first readings; the others stay as they are."""
        self._restart(lanes)
        self._steps[lanes] = 0
        self._take(lanes, reading, self._no_inputs, None)

    def _restart(self, lanes: Array) -> None:
        model, N = self.model, self._width
        mean = numpy.repeat(numpy.array(model.mean, dtype=float)[:, None], N, axis=1)
        if self._begun is None:
            covariance = numpy.repeat(model.matrix("covariance")[:, :, None], N, axis=2)
            self._begun = self._own.start_filter(Initial(mean, covariance))
        begun = self._begun
        if not lanes.all():
            begun = select_nested(lanes[self._pad], begun, self._update.state)
        self._update.resume(begun, ())
        self._filtered = numpy.where(lanes, mean[:, : self._lanes], self._filtered)

    def advance(
        self, lanes: Array | None, inputs: Array, reading: Reading, action: Array | None = None
    ) -> None:
        """Take in the readings of a step of some lanes.

        Args:
            lanes: which step, booleans ``(N,)``; None: all.
            inputs: that acted in the step, ``(N, p)``.
            reading: of all lanes.
            action: of the control, ``(N, ...)``.
        """
        self._steps += 1 if lanes is None else lanes
        self._take(lanes, reading, inputs, action)

    def _take(self, lanes: Array | None, reading: Reading, inputs: Array, action: Array | None) -> None:
        values, available, acted, moves = reading.values, reading.available, inputs, lanes
        if self._behind:
            values, available, acted = self._align(lanes, reading, inputs)
            moves = self._steps > self._behind if lanes is None else lanes & (self._steps > self._behind)
        elif lanes is not None:
            available = available & lanes[:, None]
            moves = lanes & (self._steps > 0)
        interval = self._intervals if moves is None else numpy.where(moves, self.model.interval, 0.0)
        self._send(values.T, available.T, interval, acted.T)
        if self._is_asked:
            self._update.act(self._no_action if action is None else self._actions(action, moves))
        found = self._update.report()
        mean, variance = found["mean"].reshape(-1, self._lanes), found["variance"].reshape(-1, self._lanes)
        if self._needs_innovation:
            self._find_innovation(lanes, values, available, interval, acted.T)
        self._filtered, present = mean, mean
        for back in range(self._behind - 1, -1, -1):
            going = numpy.where(self._steps > back, self.model.interval, 0.0)
            u = self._inputs[(self._steps - back) % (self._behind + 2), self._each].T
            present = self._motion_of(present, going, u)
        nis = (
            found["nis"].reshape(self._lanes)
            if available.all()
            else numpy.where(available.any(axis=1), found["nis"], 0.0)
        )
        shown: tuple[Array, ...] = present.T.copy(), numpy.sqrt(variance.T), nis
        for i, period in self.turns:
            angle = shown[0][:, i]
            angle -= period * numpy.rint(angle / period)
        if lanes is not None:
            old = self.mean, self.deviation, self.nis
            shown = tuple(
                numpy.where(lanes if new.ndim == 1 else lanes[:, None], new, before)
                for new, before in zip(shown, old, strict=True)
            )
        self.mean, self.deviation, self.nis = shown
        if not abs(mean.sum()) + variance.sum() < LARGEST:
            lost = ~((abs(mean) < LARGEST).all(axis=0) & (variance < LARGEST).all(axis=0))
            self._restart(lost)
            deviation = numpy.sqrt(numpy.diag(self.model.matrix("covariance")))
            self.mean[lost], self.deviation[lost], self.nis[lost] = self.model.mean, deviation, 0.0

    def _align(self, lanes: Array | None, reading: Reading, inputs: Array) -> tuple[Array, Array, Array]:
        """Return the readings of the time for which the slowest sensor has come, and the inputs until then."""
        depth, step, each = self._behind + 1, self._steps, self._each
        which = each if lanes is None else numpy.flatnonzero(lanes)
        self._values[step[which] % depth, which] = reading.values[which]
        self._available[step[which] % depth, which] = reading.available[which]
        self._inputs[step[which] % (depth + 1), which] = inputs[which]
        place, columns = (step[:, None] - self._held) % depth, numpy.arange(self._values.shape[2])
        ready = (step >= self._behind)[:, None]
        ready = ready if lanes is None else ready & lanes[:, None]
        values = self._values[place, each[:, None], columns]
        available = self._available[place, each[:, None], columns] & ready
        return values, available, self._inputs[(step - self._behind) % (depth + 1), each]

    def _find_innovation(
        self, lanes: Array | None, values: Array, available: Array, interval: Array, acted: Array
    ) -> None:
        """Compare readings with those predicted at the last estimate."""
        predicted = self._motion_of(self._filtered, interval, acted)
        innovation = values - numpy.asarray(self._h.value(predicted, numpy)).T
        turning = numpy.isfinite(self.periods)
        periods = numpy.where(turning, self.periods, 1.0)
        innovation -= numpy.where(turning, numpy.rint(innovation / periods) * periods, 0.0)
        innovation = numpy.where(available, innovation, 0.0)
        self.innovation = (
            innovation if lanes is None else numpy.where(lanes[:, None], innovation, self.innovation)
        )

    def _send(self, values: Array, available: Array, interval: Array, inputs: Array) -> None:
        """Give a measurement to the filters; arrays ``(..., N)``, without this axis where there is one lane."""
        parts: tuple[Any, ...] = (
            values,
            available,
            interval,
            inputs if self.model.inputs else None,
            None,
            None,
        )
        if self._lanes == 1:
            parts = tuple(None if part is None else part[..., 0] for part in parts)
        self._update.receive(StateSpaceMeasurement(*parts))

    def _actions(self, action: Array, moves: Array | None) -> Array:
        """Return actions of the whole width; zero in lanes whose filter stands still."""
        padded = numpy.asarray(action, dtype=float)[self._pad]
        return padded if moves is None else numpy.where(moves[self._pad][:, None], padded, 0.0)

    def _motion_of(self, mean: Array, interval: Array, inputs: Array) -> Array:
        """Return states ``(n, N)`` an interval later."""
        return numpy.asarray(self._motion.value(numpy.concatenate([mean, interval[None], inputs]), numpy))

    def space(self, dtype: Any) -> gymnasium.spaces.Box:
        """Return the space of what is shown of one lane."""
        size, n, show = 0, len(self.model.names), self._show
        if "observation" in show:
            size += self.model.observation(numpy.zeros((1, n))).shape[1]  # type: ignore[misc]
        size += n * (("mean" in show) + ("deviation" in show)) + ("nis" in show)
        size += self.innovation.shape[1] * ("innovation" in show)
        return gymnasium.spaces.Box(-numpy.inf, numpy.inf, (size,), dtype)

    def show(self, dtype: Any) -> Array:
        """Return what is shown, ``(N, fields)``."""
        parts = []
        for name in self._show:
            if name == "observation":
                parts.append(self.model.observation(self.mean))  # type: ignore[misc]
            else:
                value = getattr(self, name)
                parts.append(value[:, None] if value.ndim == 1 else value)
        return (parts[0] if len(parts) == 1 else numpy.concatenate(parts, axis=1)).astype(dtype, order="C")
