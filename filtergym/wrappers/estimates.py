"""A filter of a state-space model behind the sensors of an environment, for many lanes."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy

from ..baselines.problem import Problem
from ..baselines.state_space import state_space_baselines
from ..compiler.functions import map_arrays
from ..envs.contract.filter import FilterInput, Initial
from ..envs.data.recorded_world import Feed
from ..envs.engine.backend import make_model
from ..envs.engine.compiled import CompiledModel
from ..envs.engine.scenario_choice import find_scenario
from ..envs.linear.equations import Passage, StateSpaceMeasurement
from ..envs.linear.inputs import Input
from ..envs.linear.sensors import Sensor
from ..evaluation.competitors.filters import close_loop
from ..evaluation.competitors.kinds import kind_of
from ..filters.angles import shorten
from ..filters.array_namespace import select_nested
from ..own_models import state_space
from .models import EnvironmentModel
from .readings import EnvironmentSensor, Readings
from .recursions import Array, Recursion

PARTS = ("observation", "mean", "deviation", "nis", "innovation")
"""What an observation may hold of an estimate."""
LARGEST = 1e38
"""Mean or variance of a filter that is lost, as observations of 32 bits cannot hold more: it begins anew."""
CONTROLS = ("noise", "gain")
"""What an action may change of the filter."""
_PROBLEMS: dict[str, tuple[Problem, Any]] = {}
"""State-space models of this process, with the objects by which they are found."""


def define_problem(model: EnvironmentModel, sensors: Mapping[str, EnvironmentSensor]) -> Problem:
    """Return the estimation problem of a model and sensors, which :func:`filtergym.state_space` defines once."""
    fields = [one.name for one in dataclasses.fields(Sensor) if one.name != "interval"]
    kept = {name: {field: getattr(one, field) for field in fields} for name, one in sensors.items()}
    plain = lambda value: id(value) if callable(value) else numpy.asarray(value).tolist()  # noqa: E731
    own = [plain(getattr(model, field.name)) for field in dataclasses.fields(model)]
    key = repr((own, [(name, [*map(plain, one.values())]) for name, one in kept.items()]))
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


def _make_filter(problem: Problem, competitor: Any, control: str | None, lanes: int) -> Any:
    """Return the model of a problem with the bank of a control, or with a competitor, in the loop."""
    scenario = find_scenario(problem.task, None, {})
    scenario = dataclasses.replace(scenario, flights=(), recording=Feed(False, False, (), None, None))
    own = make_model(problem.task, control or problem.task.controls[0], scenario, backend="auto")
    if control is not None:
        return own
    maker = problem.find(competitor) if isinstance(competitor, str) else competitor
    if maker is None or kind_of(maker) != "estimator":
        known = f"one of {', '.join(problem.baselines.estimators)}"
        raise ValueError(f"competitor must be an estimator, {known}, got {competitor!r}")
    return close_loop(own, maker, "estimator", str(competitor), lanes)


class Estimate(NamedTuple):
    """Estimates of filters."""

    mean: Array
    """``(N, n)``, angles within half a turn."""
    deviation: Array
    """Standard deviations, ``(N, n)``."""
    nis: Array
    """Normalised innovation squared of the last readings, ``(N,)``; zero where none was received."""
    innovation: Array
    """Readings minus those predicted at the last estimate, ``(N, m)``; zero where none was received."""


class Estimates(Recursion):
    """Filters of N lanes (parallel episodes) behind their sensors.

    Sensors of several delays are taken in together when the last of them has come: the filter then runs as many steps
    behind, and the mean is carried to the present by the motion and the inputs since.

    Attributes:
        action_space: of the control; None without.
        place, steering: where actions of the environment and of the control are written before a step.
        shown: what is shown, ``(fields,)`` of one lane, ``(N, fields)`` of several.
        final: the same before episodes began in the same step.
    """

    def __init__(
        self,
        model: EnvironmentModel,
        readings: Readings,
        competitor: Any,
        control: Any,
        show: Any,
        space: Any,
    ) -> None:
        super().__init__((model, readings, competitor, control, show, space), readings.lanes, readings)
        self._model, self._show = model, show
        if control is not None and control not in CONTROLS:
            raise ValueError(f"control must be {' or '.join(CONTROLS)}, or None, got {control!r}")
        own = _make_filter(define_problem(model, readings.sensors), competitor, control, readings.lanes)
        if own.filter.in_python and self.lanes > 1:
            raise ValueError(
                f"{competitor!r} runs in Python, where lanes have one memory: wrap each environment"
            )
        self.action_space: Any = None if control is None else own.action_space
        self._behind = max(one.delay for one in readings.sensors.values())
        n, m, p, width = len(model.names), len(readings.complete) // 2, len(model.inputs), self._width
        self._kind = space.dtype
        taken = numpy.zeros((width, *(space.shape or ())))
        steered = numpy.zeros((*(own.action_space.shape or ()), width))
        self.place, self.steering = taken[self.own], steered.T[self.own]
        mean, covariance = numpy.array(model.mean, dtype=float), model.matrix("covariance")
        self._initial = Initial(*(numpy.repeat(one[..., None], width, axis=-1) for one in (mean, covariance)))
        self._deviation = numpy.sqrt(numpy.diag(covariance))[:, None]
        self._first: Any = map_arrays(lambda one: one[..., :1], own.start_filter(self._initial))
        """State of a filter at the start of an episode."""
        zeros = numpy.zeros((n + m, 1))
        estimate = Estimate(zeros[:n], zeros[:n], zeros[0], zeros[:m])
        past = numpy.zeros((self._behind, p, 1)) if p and self._behind else None
        traced, step = None, functools.partial(self._step_of, own)
        if isinstance(own, CompiledModel) and not own.filter.in_python:
            traced = functools.partial(self._step_of, own.programs.traced), own.programs.graph
        state = zeros[0], self._first, past, estimate
        self.bind(step, traced, state, taken, readings.complete, steered)
        self.shown: Array = self.outputs[0][self.own]
        self.final: Array = self.shown

    def _step_of(self, model: Any, given: Any, state: Any) -> tuple[Any, tuple[Array]]:
        """Return the next state, and the parts of the estimate that are shown.

        The state is the step of the episode, that of the filters, inputs of the last steps ``(delay, p, W)``, the
        newest first, and the :class:`Estimate` of the present, ``(..., W)``.
        """
        (actions, phases, complete, steering), (step, before, waiting, _) = given, state
        xp, equations, filter = model.task.xp, model.task.filter_equations[0], model.filter
        own: Any = self._model
        n, m, begins = len(own.names), complete.shape[0] // 2, phases > 0.0
        past: Any = None
        values, available = complete[:m], complete[m:]
        if filter.in_python and begins.any():
            model.start_filter(self._initial)  # it keeps its memory itself
        step = xp.where(begins, 0.0, step + 1.0)
        is_moving = (phases == 0.0) & (step > float(self._behind))
        if own.inputs:
            past = own.inputs_of(xp.moveaxis(xp.astype(actions, self._kind), -1, 0), xp).T[None]
            past = past if waiting is None else xp.concat([past, waiting])
            past = xp.where(begins, 0.0, past)
        interval = xp.where(is_moving, own.interval, 0.0)
        measurement = StateSpaceMeasurement(values, available, interval, past if past is None else past[-1])
        before = select_nested(begins, self._first, before)
        predicted = equations.measure(equations.move(filter.mean(before), measurement), measurement)
        innovation = xp.where(available > 0.0, equations.subtract(values, predicted), 0.0)
        action = xp.where(is_moving, steering, 0.0)
        after = filter.update(filter.predict(before, measurement), FilterInput(measurement, None, action))
        mean, covariance = filter.mean(after), filter.covariance(after)
        nis = filter.records(after, measurement).get("nis", 0.0 * mean[0])
        nis = xp.where(xp.any(available > 0.0, axis=0), nis, 0.0)
        variances = xp.stack([covariance[i, i] for i in range(n)])
        is_kept = xp.all((xp.abs(mean) < LARGEST) & (variances < LARGEST), axis=0)
        is_kept = is_kept & (getattr(after, "fault", 0.0 * step) == 0.0)
        for back in range(self._behind - 1, -1, -1):
            going = xp.where(step > float(back), own.interval, 0.0)
            mean = equations.move(mean, Passage(going, None if past is None else past[back]))
        mean = xp.where(is_kept, shorten(mean, model.task.periods), self._initial.mean[:, :1])
        deviation = xp.where(is_kept, xp.sqrt(variances), self._deviation)
        estimate = Estimate(mean, deviation, xp.where(is_kept, nis, 0.0), innovation)
        after = select_nested(is_kept, after, self._first)
        found = step, after, None if past is None or waiting is None else past[:-1], estimate
        found = select_nested(phases >= 0.0, found, state)
        parts = {**found[-1]._asdict(), "nis": found[-1].nis[None]}
        if "observation" in self._show:
            parts["observation"] = xp.asarray(own.observation(parts["mean"].T)).T
        return found, (xp.concat([parts[name] for name in self._show]),)
