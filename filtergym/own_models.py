"""An environment from a state-space model in a few lines."""

import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy

from . import register_task
from .baselines.state_space import state_space_baselines
from .envs.contract.model import Model
from .envs.data.recorded_tables import RECORDING, TIME, TRUTH
from .envs.engine.catalogue import nearest
from .envs.linear.equations import StateSpaceDefinition
from .envs.linear.inputs import Input
from .envs.linear.state_space import (
    StateSpace,
    StateSpaceParameters,
    components_measured,
    state_space_attributes,
)
from .evaluation.running.seeds import episode_seeds
from .own_equations import (
    Function,
    Surroundings,
    check_array,
    check_covariance,
    further_arguments,
    make_model,
)

RESERVED = (RECORDING, "values", "available")
"""Names that mean something else in a table or a measurement."""
EQUATIONS = ("f", "h", "Q", "R")
TRIED = 32, 64
"""Episodes and measurements from which the unit of the reward is estimated."""


def state_space(
    id: str,
    *,
    f: Function,
    h: Function,
    Q: Any,
    R: Any,
    mean: Any,
    covariance: Any,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    measured: Sequence[str] = (),
    inputs: Mapping[str, Input] | Sequence[str] = (),
    weights: Any = None,
    filter_model: Mapping[str, Any] | None = None,
    hypotheses: Sequence[Mapping[str, Any]] = (),
    transition: Any = None,
    switching: bool = True,
    **parameters: Any,
) -> type[StateSpace]:
    """Make an environment of a state-space model and register it: ``x = f(x) + w``, ``z = h(x) + v``.

    Call it where your module is imported, as :func:`filtergym.register_task`. The class is also kept in your module, by
    the name in its id, where other processes look for it.

    Args:
        id: with your name and a version, such as ``"mine/Tracker-v0"``.
        f: the state at the next measurement, from the state ``(n,)`` to a list of n numbers, written with NumPy's
            functions and without branches on numbers; or a matrix ``(n, n)``. With a second argument called ``dt``
            it is the state that interval later, s: the model is timed, and measurements may come at any time. With an
            argument called ``u`` it is given the inputs ``(p,)`` that act until then.
        h: likewise what is measured, m numbers; or a matrix ``(m, n)``.
        Q: covariance of the process noise, ``(n, n)``; of a timed model a function that returns that of an interval,
            ``Q(dt)``.
        R: covariance of the measurement noise, ``(m, m)``, positive definite.
        mean: of the initial state, ``(n,)``.
        covariance: of the initial state, ``(n, n)``.
        names: of the components; default: ``x1``, ``x2`` and so on.
        units: of the components; default: ``1``.
        measured: names of the m numbers that h returns, which are the columns of a table of yours; default: ``z1``,
            ``z2`` and so on.
        inputs: known inputs, each with what a simulation draws for it and the noise with which it is told; or their
            names. They are columns of a table, too.
        weights: of their squared errors in the cost, ``(n,)``; default: 1 / n, for the mean squared error.
        filter_model: what the filters believe in place of f, h, Q or R.
        hypotheses: further models between which the world switches, each by what differs from the first: f, h, Q, R.
            Filters then are interacting multiple models of all of them.
        transition: probabilities that one model follows another (row = from), ``(M, M)``; default: it stays with 0.95.
        switching: whether the world switches; otherwise only the filters take it for possible.
        **parameters: of :class:`filtergym.envs.linear.state_space.StateSpaceParameters` in the training distribution,
            such as ``horizon`` and ``process_noise``.

    Returns:
        The class of the task.

    Raises:
        ValueError: for arrays that do not fit each other, functions that cannot be traced or do not answer with enough
            numbers, and whatever :func:`filtergym.register_task` refuses.
    """
    allowed = [field.name for field in dataclasses.fields(StateSpaceParameters)]
    for parameter in parameters:
        if parameter not in allowed:
            raise nearest("argument of state_space", parameter, allowed)
    mean = check_array("mean", mean, (None,))
    n = len(mean)
    first = {"f": f, "h": h, "Q": Q, "R": R}
    given = [first, *({**first, **_known("hypotheses", one)} for one in hypotheses)]
    interval = float(parameters.get("sampling_interval", StateSpaceParameters.sampling_interval))
    inputs = _inputs(inputs)
    around = Surroundings(mean, interval, inputs)
    if inputs and not any("u" in further_arguments(one["f"]) for one in given):
        raise ValueError(
            f"there are inputs, {', '.join(inputs)}, and f does not take u: write f(x, u) or f(x, dt, u)"
        )
    world = tuple(make_model(one, around) for one in given)
    mistaken = _known("filter_model", filter_model or {})
    filters = tuple(make_model({**one, **mistaken}, around) for one in given) if mistaken else world
    if len({model.h.size for model in (*world, *filters)}) > 1:
        raise ValueError("all models must measure as many numbers")
    if len({model.timed for model in (*world, *filters)}) > 1:
        raise ValueError("all models must take the interval, or none: write f(x, dt) and Q(dt) in each")
    count = len(world)
    names = tuple(names) or tuple(f"x{i + 1}" for i in range(n))
    units = tuple(units) or ("1",) * n
    if len(names) != n or len(units) != n:
        raise ValueError(f"names and units must be {n} each, got {names!r} and {units!r}")
    places = components_measured(world[0].h)
    measured = _measured(measured, world[0].h.size, inputs)
    definition = StateSpaceDefinition(
        world,
        filters,
        _chain(transition, count),
        bool(switching),
        mean,
        check_covariance("covariance", covariance, n),
        numpy.full(n, 1.0 / n) if weights is None else check_array("weights", weights, (n,)),
        {name: units[places.index(j)] if j in places else "1" for j, name in enumerate(measured)},
        inputs,
    )
    if not (definition.weights >= 0.0).all() or not definition.weights.any():
        raise ValueError(f"weights must not be negative, nor all zero, got {definition.weights.tolist()}")
    name = id.rpartition("/")[2].rpartition("-")[0] or id
    module = sys._getframe(1).f_globals.get("__name__", "__main__")
    attributes = state_space_attributes(definition, names, units, dict(parameters))
    attributes |= {"id": id, "__module__": module, "__qualname__": name, "__doc__": StateSpace.__doc__}
    cls: Any = type(name, (StateSpace,), attributes)
    cls.reward_unit = _typical_cost(cls, StateSpaceParameters(**parameters))
    register_task(cls, state_space_baselines(cls))
    if module in sys.modules:
        setattr(sys.modules[module], name, cls)
    made: type[StateSpace] = cls
    return made


def _known(what: str, part: Mapping[str, Any]) -> dict[str, Any]:
    """Return a mapping, or raise ValueError for what is none of f, h, Q and R."""
    unknown = [name for name in part if name not in EQUATIONS]
    if unknown:
        raise ValueError(f"{what} says f, h, Q or R, got {unknown[0]!r}")
    return dict(part)


def _inputs(given: Mapping[str, Input] | Sequence[str]) -> dict[str, Input]:
    """Return inputs by their names, or raise ValueError for what is none."""
    if isinstance(given, str) or not all(isinstance(name, str) for name in given):
        raise ValueError(f"inputs must be names, or a mapping from names to Input, got {given!r}")
    found = dict(given) if isinstance(given, Mapping) else {name: Input() for name in given}
    for name, one in found.items():
        if not isinstance(one, Input):
            raise ValueError(f"the input {name!r} must be an Input, got {one!r}")
    return found


def _measured(names: Sequence[str], count: int, inputs: Iterable[str]) -> tuple[str, ...]:
    """Names of what is measured, which can be told apart in a table, also from the inputs."""
    names = tuple(names) or tuple(f"z{j + 1}" for j in range(count))
    lower = [str(name).lower() for name in (*names, *inputs)]
    if len(names) != count or len({*lower}) != len(lower) or {*lower} & {*TIME, *RESERVED, ""}:
        raise ValueError(
            f"measured must be {count} different names, none of them a time or an input, got {names!r}; names may not "
            f"be {', '.join(RESERVED)} either"
        )
    if any(name.startswith(TRUTH) for name in lower):
        raise ValueError(f"names of what is measured must not begin with {TRUTH}, got {names!r}")
    return names


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


def _typical_cost(cls: type[StateSpace], parameters: StateSpaceParameters) -> float:
    """Median over some episodes of what the filter as written is charged, to two digits; 1 where that is no unit."""
    episodes, measurements = TRIED
    model: Any = Model(cls(parameters), cls.paper_policy.control)
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
