"""An environment from a state-space model in a few lines."""

import dataclasses
import functools
import itertools
import sys
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy

from . import register_task
from .baselines.state_space import state_space_baselines
from .envs.contract.model import Model
from .envs.contract.parameters import ParameterLimits, check, check_integer, quote_shortened
from .envs.contract.task import Component
from .envs.engine.catalogue import nearest
from .envs.linear.equations import StateSpaceDefinition, StateSpaceModel
from .envs.linear.inputs import Input
from .envs.linear.parameters import StateSpaceParameters
from .envs.linear.sensors import Sensor
from .envs.linear.state_space import StateSpace, measurement_indices, state_space_attributes
from .evaluation.running.seeds import episode_seeds
from .own_angles import find_periods, warn_of_turns
from .own_equations import (
    Function,
    Surroundings,
    arguments,
    check_array,
    check_covariance,
    further_arguments,
    make_model,
    trace_measurement,
)
from .own_sensors import NOISES, check_columns, find_channels, replace_sensors, sensor_columns, stack_sensors

EQUATIONS = ("f", "Q", "drift", "diffusion", "h", "R", "sensors")
TRIED = 32, 64
"""Episodes and measurements from which the unit of the reward is estimated."""
SMALL, FEWEST = 12, 8
"""Number of states up to which all these measurements are used, since their time grows with its cube; and the least
number of measurements.
"""


def state_space(
    id: str,
    *,
    mean: Any,
    covariance: Any,
    f: Function | None = None,
    Q: Any = None,
    drift: Function | None = None,
    diffusion: Any = None,
    integration_steps: int = 1,
    h: Function | None = None,
    R: Any = None,
    sensors: Mapping[str, Sensor] | None = None,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    angles: Mapping[str, str] = MappingProxyType({}),
    measured: Sequence[str] = (),
    inputs: Mapping[str, Input] | Sequence[str] = (),
    weights: Any = None,
    filter_model: Mapping[str, Any] | None = None,
    hypotheses: Sequence[Mapping[str, Any]] = (),
    transition: Any = None,
    switching: bool = True,
    registered: bool = True,
    **parameters: Any,
) -> type[StateSpace]:
    """Return a new environment's task of a state-space model ``x = f(x) + w``, ``z = h(x) + v``, registered.

    Call it where your module is imported, as :func:`filtergym.register_task`. The class is also stored in your module,
    under the name in its id, where other processes find it.

    Args:
        id: with your name and a version, such as ``"mine/Tracker-v0"``.
        mean: of the initial state, ``(n,)``.
        covariance: of the initial state, ``(n, n)``.
        f: the state at the next measurement, from the state ``(n,)`` to a list of n numbers, written with NumPy's
            functions and without branches on numbers; or a matrix ``(n, n)``. With a second argument called ``dt``
            it is the state that interval later, s: the model is timed, and measurements may come at any time. With an
            argument called ``u`` it receives the inputs ``(p,)`` that act until then.
        Q: covariance of the process noise, ``(n, n)``; of a timed model a function that returns that of an interval,
            ``Q(dt)``. Or several covariances by the names of their sources, which are summed: ``tune`` and
            ``advise`` then search a factor of each.
        drift: in place of f and Q the derivative of the state, ``drift(x)`` or ``drift(x, u)``, or a matrix: the model
            is timed, see :mod:`filtergym.filters.discretisation`.
        diffusion: spectral density of the noise of that derivative, ``(n, n)``; or several by their sources.
        integration_steps: steps of the Runge-Kutta method between two measurements, for a drift that is not linear.
        h: the measurement, m numbers, ``h(x)`` or ``h(x, u)``, written as f is; or a matrix ``(m, n)``.
        R: covariance of the measurement noise, ``(m, m)``, positive definite; or a function that returns it,
            of any of the state, ``dt`` and ``u``, such as ``R(x)`` or ``R(u)``.
        sensors: sensors by their names, in place of h, R and ``measured``.
        names: of the components; default: ``x1``, ``x2`` and so on.
        units: of the components; default: ``1``, of an angle its unit.
        angles: components that are angles, ``"rad"`` or ``"deg"`` by their names: their errors are the shortest
            differences, whatever turn the truth, an estimate or f is on.
        measured: names of the m numbers that h returns, which are the columns of your table; default: ``z1``,
            ``z2`` and so on.
        inputs: known inputs, each with its distribution in a simulation and the noise of its reported value; or
            their names. They are also columns of a table.
        weights: weights of the squared errors in the cost, ``(n,)``; default: 1 / n, for the mean squared error.
        filter_model: the filters' own f, Q, drift, diffusion, h, R, or some of the sensors, where they differ.
        hypotheses: further models between which the world switches, each given by its differences to the first. The
            filters are then interacting multiple models of all of them.
        transition: probabilities that one model follows another (row = from), ``(M, M)``; default: it stays with 0.95.
        switching: whether the world switches; otherwise only the filters assume that it may.
        registered: whether Gymnasium and the commands find it by its id.
        **parameters: fields of :class:`filtergym.envs.linear.parameters.StateSpaceParameters` in the training
            distribution, such as ``horizon`` and ``process_noise``.

    Returns:
        The class of the task.

    Raises:
        ValueError: for arrays that do not fit each other, functions that cannot be traced or return too few
            numbers, and all errors of :func:`filtergym.register_task`.
    """
    allowed = [field.name for field in dataclasses.fields(StateSpaceParameters)]
    for parameter in parameters:
        if parameter not in allowed:
            raise nearest("argument of state_space", parameter, allowed)
    if not isinstance(id, str):
        raise ValueError(f"an id is a word such as 'mine/Tracker-v0', got {quote_shortened(id)}")
    mean = check_array("mean", mean, (None,))
    n = len(mean)
    hypotheses, names, units, measured = (
        _sequence(what, given)
        for what, given in (
            ("hypotheses", hypotheses),
            ("names", names),
            ("units", units),
            ("measured", measured),
        )
    )
    check("switching", switching, bool, ParameterLimits())
    sensors = _sensors(sensors, (h, R, measured))
    first = {"f": f, "Q": Q, "drift": drift, "diffusion": diffusion, "h": h, "R": R, "sensors": sensors}
    _check_motion(first)
    given = [first, *(_replace("hypotheses", first, one) for one in hypotheses)]
    rates = [one.interval for one in sensors.values() if one.interval is not None]
    if rates:
        parameters.setdefault("sampling_interval", min(rates))
    interval = float(StateSpaceParameters(**parameters).sampling_interval)
    inputs = _inputs(inputs)
    steps = check_integer("integration_steps", integration_steps, 1)
    around = Surroundings(mean, interval, inputs, steps)
    motion = "drift" if f is None else "f"
    acted = [
        call for one in given for call in (one[motion], one["h"], *(s.h for s in one["sensors"].values()))
    ]
    noises = [R for one in given for R in (one["R"], *(s.R for s in one["sensors"].values()))]
    taken = [
        *(name for call in acted for name in further_arguments(call)),
        *itertools.chain(*map(arguments, noises)),
    ]
    if inputs and "u" not in taken:
        raise ValueError(
            f"there are inputs, {', '.join(inputs)}, and neither {motion}, h nor R takes u: write "
            f"{'drift(x, u)' if f is None else 'f(x, u) or f(x, dt, u)'}"
        )
    world = tuple(make_model(_stack(one, n, len(inputs)), around) for one in given)
    filters = world
    if filter_model is not None:
        filters = tuple(
            make_model(_stack(_replace("filter_model", one, filter_model), n, len(inputs)), around)
            for one in given
        )
    if len({model.h.size for model in (*world, *filters)}) > 1:
        raise ValueError("all models must measure as many numbers")
    if len({model.timed for model in (*world, *filters)}) > 1:
        raise ValueError("all models must take the interval, or none: write f(x, dt) and Q(dt) in each")
    _check_sources(filters, sensors)
    count = len(world)
    names = names or tuple(f"x{i + 1}" for i in range(n))
    m = world[0].h.size
    counts = [trace_measurement("h", one.h, n, len(inputs)).size for one in sensors.values()] or [m]
    channels = find_channels(sensors, counts, interval)
    places = measurement_indices(world[0].h)
    periods = find_periods(angles, names, places, channels)
    units = units or tuple(angles.get(name, "1") for name in names)
    if len(names) != n or len(units) != n:
        raise ValueError(
            f"names and units must be {n} each, got {quote_shortened(names)} and {quote_shortened(units)}"
        )
    components = tuple(
        Component(*one, periods.get(i)) for i, one in enumerate(zip(names, units, strict=True))
    )
    columns = dict.fromkeys(measured or [f"z{j + 1}" for j in range(m)], "")
    columns = sensor_columns(sensors, channels) if sensors else columns
    check_columns(measured or tuple(columns), m, inputs)
    usual = numpy.concatenate([mean, [interval], around.nominal_inputs])
    warn_of_turns(world[0], usual, {name: i in periods for i, name in enumerate(names)}, channels)
    measures = [units[places.index(j)] if j in places else "1" for j in range(m)]
    definition = StateSpaceDefinition(
        world,
        filters,
        _chain(transition, count),
        switching,
        mean,
        check_covariance("covariance", covariance, n),
        numpy.full(n, 1.0 / n) if weights is None else check_array("weights", weights, (n,)),
        {name: unit or own for (name, unit), own in zip(columns.items(), measures, strict=True)},
        inputs,
        channels,
    )
    if not (definition.weights >= 0.0).all() or not definition.weights.any():
        raise ValueError(f"weights must not be negative, nor all zero, got {definition.weights.tolist()}")
    name = id.rpartition("/")[2].rpartition("-")[0] or id
    module = sys._getframe(1).f_globals.get("__name__", "__main__")
    attributes = state_space_attributes(definition, components, dict(parameters))
    attributes |= {"id": id, "__module__": module, "__qualname__": name, "__doc__": StateSpace.__doc__}
    cls: Any = type(name, (StateSpace,), attributes)
    cls.reward = _EstimatedReward(cls, StateSpaceParameters(**parameters))
    made: type[StateSpace] = cls
    if not registered:
        return made
    try:
        register_task(cls, state_space_baselines(cls))
    except ValueError as error:
        for reason in (reason for model in (*world, *filters) for reason in model.warned.values()):
            raise ValueError(f"{error}: {reason}") from error
        raise
    if module in sys.modules:
        setattr(sys.modules[module], name, cls)
    return made


def _sequence(what: str, given: Any) -> tuple[Any, ...]:
    kind, of = (Mapping, "models") if what == "hypotheses" else (str, "words")
    if isinstance(given, str) or not (
        isinstance(given, Sequence) and all(isinstance(one, kind) for one in given)
    ):
        raise ValueError(f"{what} must be a sequence of {of}, got {quote_shortened(given)}")
    return tuple(given)


def _sensors(
    sensors: Mapping[str, Sensor] | None, others: tuple[Any, Any, Sequence[str]]
) -> dict[str, Sensor]:
    """Return the sensors of a model by name; empty for a model with h and R instead.

    Raises:
        ValueError: if neither is given, or both.
    """
    h, R, measured = others
    if sensors is None:
        if h is None or R is None:
            raise ValueError("give the measurement by h and R, or by sensors")
        return {}
    if h is not None or R is not None or len(measured):
        raise ValueError("sensors contain h, R and the names: leave out h, R and measured")
    if not sensors:
        raise ValueError("sensors must name at least one")
    return replace_sensors(None, sensors)


def _check_motion(first: Mapping[str, Any]) -> None:
    """Raise ValueError unless the motion is given by either f and Q, or drift and diffusion."""
    there = [name for name in EQUATIONS[:4] if first[name] is not None]
    if there not in (["f", "Q"], ["drift", "diffusion"]):
        raise ValueError(
            f"give the motion by f and Q, or by drift and diffusion, got {', '.join(there) or 'neither'}"
        )


def _replace(what: str, first: Mapping[str, Any], part: Mapping[str, Any]) -> dict[str, Any]:
    """Return a model's equations by name, some of them replaced; raise ValueError for an unknown name."""
    own = first["sensors"]
    unused = {*(("h", "R") if own else ("sensors",))}
    unused |= {"f", "Q"} if first["f"] is None else {"drift", "diffusion"}
    known = [name for name in EQUATIONS if name not in unused]
    unknown = [name for name in part if name not in known] if isinstance(part, Mapping) else [part]
    if unknown:
        raise ValueError(
            f"{what} can contain {', '.join(known[:-1])} or {known[-1]}, got {quote_shortened(unknown[0])}"
        )
    if "sensors" in part:
        part = {**part, "sensors": replace_sensors(own, part["sensors"])}
    return {**first, **part}


def _check_sources(filters: Sequence[StateSpaceModel], sensors: Iterable[str]) -> None:
    """Raise ValueError if sources of process noise differ between models, or share names with sensors."""
    first, *others = ([*model.sources] for model in filters)
    if any(one != first for one in others):
        raise ValueError(f"all models must name the same sources of noise, got {first} and {others}")
    taken = {*first} & {*NOISES, *sensors}
    if taken:
        raise ValueError(
            f"the source of noise {min(taken)!r} must have another name than {', '.join(NOISES)} and sensors"
        )


def _stack(given: dict[str, Any], size: int, inputs: int) -> dict[str, Any]:
    """Return a model's equations with h and R stacked from all its sensors; unchanged without sensors."""
    if not given["sensors"]:
        return given
    h, R = stack_sensors(given["sensors"], size, inputs)
    return {**given, "h": h, "R": R}


def _inputs(given: Mapping[str, Input] | Sequence[str]) -> dict[str, Input]:
    """Return a model's inputs as :class:`Input` by name; raise ValueError for an invalid one."""
    is_list = isinstance(given, Mapping | Sequence) and not isinstance(given, str)
    if not is_list or not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"inputs must be names, or a mapping from names to Input, got {quote_shortened(given)}"
        )
    found = dict(given) if isinstance(given, Mapping) else {name: Input() for name in given}
    for name, one in found.items():
        if not isinstance(one, Input):
            raise ValueError(f"the input {name!r} must be an Input, got {quote_shortened(one)}")
    return found


def _chain(transition: Any, count: int) -> tuple[tuple[float, ...], ...]:
    if transition is None:
        away = 0.05 / max(count - 1, 1)
        transition = [[0.95 if i == j else away for j in range(count)] for i in range(count)]
        transition = [[1.0]] if count == 1 else transition
    matrix = check_array("transition", transition, (count, count))
    if (matrix < 0.0).any() or (numpy.abs(matrix.sum(axis=1) - 1.0) > 1e-9).any():
        raise ValueError(
            f"transition must hold probabilities, each row with the sum 1, got {matrix.tolist()}"
        )
    return tuple(map(tuple, matrix.tolist()))


class _EstimatedReward:
    """Reward of a user's model, whose unit is estimated by simulation on first use, in 0.1 to 0.5 s."""

    cost, kind, log_unit = StateSpace.reward.cost, StateSpace.reward.kind, None

    def __init__(self, cls: type[StateSpace], parameters: StateSpaceParameters) -> None:
        self._cls, self._parameters = cls, parameters

    @functools.cached_property
    def unit(self) -> float:
        return _typical_cost(self._cls, self._parameters)


def _typical_cost(cls: type[StateSpace], parameters: StateSpaceParameters) -> float:
    """Return the median episode cost of the model's filter in a simulation, to two digits; 1 if unusable."""
    model: Any = Model(cls(parameters), cls.paper_policy.control)
    episodes, measurements = TRIED
    share = min(1.0, SMALL / cls.definition.world[0].f.size) ** 3
    measurements = max(int(measurements * share), FEWEST)
    generator = numpy.random.default_rng(episode_seeds("train", 0, 1))
    noise = model.task.noise
    action = numpy.zeros((*model.action_space.shape, episodes))
    with numpy.errstate(all="ignore"):
        episode = model.begin(
            generator.random((noise.uniforms, episodes)),
            generator.standard_normal((noise.initial_normals, episodes)),
        )
        total: Any = 0.0
        for _ in range(min(measurements, parameters.horizon)):
            row = [
                generator.standard_normal((noise.normals, episodes)),
                generator.random((noise.row_uniforms, episodes)),
            ]
            episode = model.act(model.measure(episode, numpy.concatenate(row)), action)
            total = total + model.cost(episode)
        cost = float(numpy.median(total)) / min(measurements, parameters.horizon)
    return float(f"{cost:.1e}") if numpy.isfinite(cost) and cost > 0.0 else 1.0
