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
    kept = {name: {field: getattr(one, field) for field in fields} for name, one in sensors.items()}
    key = id(model), *((name, *map(_key, values.values())) for name, values in kept.items())
    if key not in _PROBLEMS:
        Q = model.matrix("noise")
        task = state_space(
            f"wrapped/Model{len(_PROBLEMS) + 1}-v0", f=model.f, sensors={name: Sensor(**kept[name]) for name in kept},
            Q=lambda dt: [[number * dt for number in row] for row in Q.tolist()], sampling_interval=model.interval,
            mean=model.mean, covariance=model.matrix("covariance"), names=tuple(model.names),
            angles=dict(model.angles), inputs={one: Input() for one in model.inputs}, registered=False,
        )  # fmt: skip
        _PROBLEMS[key] = Problem(task, state_space_baselines(task)), (model, sensors)
    return _PROBLEMS[key][0]


def _key(value: Any) -> Any:
    """Return numbers and words as text, and a function by its identity."""
    plain = value.tolist() if isinstance(value, numpy.ndarray) else value
    return id(value) if callable(value) else repr(plain)


def report_estimate(model: Any, episode: Any) -> dict[str, Any]:
    """Report a filter in one array: its mean, the same without whole turns, deviations, NIS, and whether it is lost."""
    xp, covariance = model.task.xp, model.filter.covariance(episode.filter)
    mean, available = model.filter.mean(episode.filter), episode.measurement.available
    nis = model.filter.records(episode.filter, episode.measurement).get("nis", 0.0 * mean[0])
    received, held = available[0] > 0.0, abs(mean[0]) < LARGEST
    for one in available[1:]:
        received = received | (one > 0.0)
    deviations, turned = [], []
    for i in range(mean.shape[0]):
        held = held & (abs(mean[i]) < LARGEST) & (covariance[i, i] < LARGEST)
        deviations.append(xp.sqrt(covariance[i, i]))
        period = model.task.periods.get(i)
        turned.append(mean[i] - (0.0 if period is None else period * xp.round(mean[i] / period)))
    nis, lost = xp.where(received, nis, 0.0), xp.where(held, 0.0, 1.0)
    return {"estimate": xp.stack([*(one for one in mean), *turned, *deviations, nis, lost])}


def _make_filter(problem: Problem, competitor: Any, control: str | None, lanes: int) -> Any:
    """Return the model of a problem with the bank of a control, or with a competitor, in the loop."""
    scenario = find_scenario(problem.task, None, {})
    scenario = dataclasses.replace(scenario, flights=(), recording=Feed(False, False, (), None, None))
    own = make_model(problem.task, control or problem.task.controls[0], scenario, backend="auto")
    if control is not None:
        return own
    maker = problem.find(competitor) if isinstance(competitor, str) else competitor
    if maker is None or kind_of(maker) != "estimator":
        known = ", ".join(problem.baselines.estimators)
        raise ValueError(f"competitor must be an estimator, one of {known}, got {competitor!r}")
    return close_loop(own, maker, "estimator", str(competitor), lanes)


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
        if control is not None and control not in CONTROLS:
            raise ValueError(f"control must be {' or '.join(CONTROLS)}, or None, got {control!r}")
        self._own = own = _make_filter(define_problem(model, sensors), competitor, control, lanes)
        self.action_space: Any = None if control is None else own.action_space
        is_compiled, world = can_step(own, report_estimate), own.task.world
        self._acts: bool = not is_compiled or control is not None
        self._update: Any = (
            CompiledUpdate(own, report_estimate, lanes, None, self._acts, None)
            if is_compiled
            else ModelUpdate(own, report_estimate, lanes, world.measurement, None)
        )
        self._width = round_up_lanes(lanes)
        self._pad = numpy.minimum(numpy.arange(self._width), lanes - 1)
        self._no_action = numpy.zeros((self._width, *(own.action_space.shape or ())))
        self._begun: Any = None
        """Filters of all lanes at the start of an episode, made once."""
        self._motion, self._h = (getattr(own.task.definition.filters[0], name) for name in ("f", "h"))
        channels = own.task.definition.channels
        self._behind = max(one.delay for one in sensors.values())
        self._periods = numpy.array([one.period or numpy.inf for one in channels for _ in one.numbers])
        n, m, p = len(model.names), len(self._periods), len(model.inputs)
        self._inputs = numpy.zeros((self._behind + 2, lanes, p))
        """Inputs of the last steps, by the clock modulo their number."""
        self._clock, self._starts = 0, numpy.zeros(lanes, dtype=numpy.int64)
        """Steps of all lanes, and those at the start of each one's episode."""
        self.mean: Array = numpy.zeros((lanes, n))
        self.deviation: Array = numpy.zeros((lanes, n))
        self.nis: Array = numpy.zeros(lanes)
        self.innovation: Array = numpy.zeros((lanes, m))
        self._filtered = numpy.zeros((n, lanes))
        """Means of the filters."""
        self._no_inputs, self._no_interval = numpy.zeros((lanes, p)), numpy.zeros(lanes)
        self._intervals, self._needs_innovation = numpy.full(lanes, model.interval), "innovation" in show

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments, arrays and the state of the filters; their code is made anew."""
        kinds = (numpy.ndarray, int)
        values = {name: value for name, value in vars(self).items() if isinstance(value, kinds)}
        return {"arguments": self._arguments, "values": values, "filters": self._update.state}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        vars(self).update(state["values"])
        if state["filters"] is not None:
            self._update.resume(state["filters"], ())

    def begin(self, lanes: Array, reading: Reading) -> None:
        """Begin episodes of some lanes with their first readings; the others stay as they are."""
        self._restart(lanes)
        self._starts[lanes] = self._clock
        self._inputs[self._clock % len(self._inputs), lanes] = 0.0
        self._take(lanes, self._no_interval, self._no_inputs, reading, None)

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
            reading: of these lanes, of one time: :attr:`.Readings.complete`.
            action: of the control, ``(N, ...)``.
        """
        self._clock += 1
        moves, interval = lanes, self._intervals
        if self._behind:
            self._inputs[self._clock % len(self._inputs)] = inputs
            inputs = self._inputs[(self._clock - self._behind) % len(self._inputs)]
            late = self._clock - self._starts > self._behind
            moves = late if lanes is None else lanes & late
        if moves is not None:
            interval = numpy.where(moves, interval, 0.0)
        if action is not None:
            action = numpy.asarray(action, dtype=float)[self._pad]
            action = action if moves is None else numpy.where(moves[self._pad][:, None], action, 0.0)
        self._take(lanes, interval, inputs, reading, action)

    def _take(
        self, lanes: Array | None, interval: Array, inputs: Array, reading: Reading, action: Array | None
    ) -> None:
        """Give a measurement to the filters, and keep what they report of some lanes."""
        values, available = reading
        if self._lanes == 1:
            sent = StateSpaceMeasurement(values[0], available[0], interval[0], inputs[0])
        else:
            sent = StateSpaceMeasurement(values.T, available.T, interval, inputs.T)
        self._update.receive(sent if self.model.inputs else sent[:3])
        if self._acts:
            self._update.act(self._no_action if action is None else action)
        n, N = len(self.model.names), self._lanes
        found = self._update.report()["estimate"].reshape(-1, N)
        if self._needs_innovation:
            self._find_innovation(lanes, reading, interval, inputs.T)
        self._filtered, shown = found[:n], found[n : 2 * n]
        if self._behind:
            shown = self._present()
        new: Any = (shown.T, found[2 * n : 3 * n].T, found[3 * n])
        if lanes is not None:
            old = zip(new, (self.mean, self.deviation, self.nis), strict=True)
            new = (numpy.where(lanes, one.T, other.T).T for one, other in old)
        self.mean, self.deviation, self.nis = new
        if numpy.count_nonzero(found[-1]):
            lost = found[-1] > 0.0
            self._restart(lost)
            deviation = numpy.sqrt(numpy.diag(self.model.matrix("covariance")))
            self.mean[lost], self.deviation[lost], self.nis[lost] = self.model.mean, deviation, 0.0

    def _present(self) -> Array:
        """Return the means of the filters carried to the present, without whole turns, ``(n, N)``."""
        mean = self._filtered
        for back in range(self._behind - 1, -1, -1):
            going = numpy.where(self._clock - self._starts > back, self.model.interval, 0.0)
            mean = self._motion_of(mean, going, self._inputs[(self._clock - back) % len(self._inputs)].T)
        for i, period in self._own.task.periods.items():
            mean[i] -= period * numpy.rint(mean[i] / period)
        return mean

    def _find_innovation(self, lanes: Array | None, reading: Reading, interval: Array, inputs: Array) -> None:
        """Compare readings with those predicted at the last estimate."""
        predicted = self._motion_of(self._filtered, interval, inputs)
        innovation = reading.values - numpy.asarray(self._h.value(predicted, numpy)).T
        for i in numpy.flatnonzero(self._periods < numpy.inf):
            innovation[:, i] -= numpy.rint(innovation[:, i] / self._periods[i]) * self._periods[i]
        innovation = numpy.where(reading.available, innovation, 0.0)
        kept = innovation if lanes is None else numpy.where(lanes[:, None], innovation, self.innovation)
        self.innovation = kept

    def _motion_of(self, mean: Array, interval: Array, inputs: Array) -> Array:
        """Return states ``(n, N)`` an interval later."""
        return numpy.asarray(self._motion.value(numpy.concatenate([mean, interval[None], inputs]), numpy))

    def space(self, dtype: Any) -> gymnasium.spaces.Box:
        """Return the space of what is shown of one lane."""
        return gymnasium.spaces.Box(-numpy.inf, numpy.inf, self.show(dtype).shape[1:], dtype)

    def show(self, dtype: Any) -> Array:
        """Return what is shown, ``(N, fields)``."""
        parts = []
        for name in self._show:
            if name == "observation":
                parts.append(self.model.observation(self.mean))  # type: ignore[misc]
            else:
                parts.append(self.nis[:, None] if name == "nis" else getattr(self, name))
        return (parts[0] if len(parts) == 1 else numpy.concatenate(parts, axis=1)).astype(dtype, order="C")
