"""An environment from a state-space model in a few lines."""

import dataclasses
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy

from . import register_task
from .baselines.state_space import state_space_baselines
from .compiler.namespace import NotTraceable
from .compiler.vector_functions import VectorFunction
from .envs.contract.model import Model
from .envs.contract.parameters import Limits, check, quote_shortened, read_numbers
from .envs.data.recorded_tables import RECORDING, TIME, TRUTH
from .envs.engine.catalogue import nearest
from .envs.linear.state_space import (
    StateSpace,
    StateSpaceDefinition,
    StateSpaceModel,
    StateSpaceParameters,
    state_space_attributes,
)
from .evaluation.running.seeds import episode_seeds

Function = Callable[..., Any] | Sequence[Sequence[float]] | numpy.ndarray
"""A function of the state ``(n,)`` that returns a list of numbers, or a matrix; of a timed model see
:func:`state_space`."""
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
            it is the state that interval later, s: the model is timed, and measurements may come at any time.
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
    if not isinstance(id, str):
        raise ValueError(f"an id is a word such as 'mine/Tracker-v0', got {quote_shortened(id)}")
    mean = _array("mean", mean, (None,))
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
    first = {"f": f, "h": h, "Q": Q, "R": R}
    given = [first, *({**first, **_known("hypotheses", one)} for one in hypotheses)]
    check("switching", switching, bool, Limits())
    interval = StateSpaceParameters(**parameters).sampling_interval
    world = tuple(_model(one, n, interval) for one in given)
    mistaken = {} if filter_model is None else _known("filter_model", filter_model)
    filters = tuple(_model({**one, **mistaken}, n, interval) for one in given) if mistaken else world
    if len({model.h.size for model in (*world, *filters)}) > 1:
        raise ValueError("all models must measure as many numbers")
    if len({model.timed for model in (*world, *filters)}) > 1:
        raise ValueError("all models must take the interval, or none: write f(x, dt) and Q(dt) in each")
    count = len(world)
    definition = StateSpaceDefinition(
        world,
        filters,
        _chain(transition, count),
        switching,
        mean,
        _covariance("covariance", covariance, n),
        numpy.full(n, 1.0 / n) if weights is None else _array("weights", weights, (n,)),
    )
    if not (definition.weights >= 0.0).all() or not definition.weights.any():
        raise ValueError(f"weights must not be negative, nor all zero, got {definition.weights.tolist()}")
    names = names or tuple(f"x{i + 1}" for i in range(n))
    units = units or ("1",) * n
    if len(names) != n or len(units) != n:
        raise ValueError(
            f"names and units must be {n} each, got {quote_shortened(names)} and {quote_shortened(units)}"
        )
    measured = _measured(measured, world[0].h.size)
    name = id.rpartition("/")[2].rpartition("-")[0] or id
    module = sys._getframe(1).f_globals.get("__name__", "__main__")
    attributes = state_space_attributes(definition, names, units, measured, dict(parameters))
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
    if not isinstance(part, Mapping):
        raise ValueError(f"{what} says f, h, Q or R by name, got {quote_shortened(part)}")
    unknown = [name for name in part if name not in EQUATIONS]
    if unknown:
        raise ValueError(f"{what} says f, h, Q or R, got {quote_shortened(unknown[0])}")
    return dict(part)


def _sequence(what: str, given: Any) -> tuple[Any, ...]:
    """Return words, or models, as a tuple."""
    kind, of = (Mapping, "models") if what == "hypotheses" else (str, "words")
    if (
        not isinstance(given, Sequence)
        or isinstance(given, str)
        or not all(isinstance(one, kind) for one in given)
    ):
        raise ValueError(f"{what} must be a sequence of {of}, got {quote_shortened(given)}")
    return tuple(given)


def _measured(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Names of what is measured, which can be told apart in a table."""
    names = tuple(names) or tuple(f"z{j + 1}" for j in range(count))
    lower = {name.lower() for name in names}
    if len(names) != count or len(lower) != count or lower & {*TIME, RECORDING, ""}:
        raise ValueError(f"measured must be {count} different names, none of them a time, got {names!r}")
    if any(name.startswith(TRUTH) for name in lower):
        raise ValueError(f"names of what is measured must not begin with {TRUTH}, got {names!r}")
    return names


def _array(what: str, values: Any, shape: tuple[int | None, ...]) -> numpy.ndarray:
    array = read_numbers(what, values)
    fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
    if not fits or not numpy.isfinite(array).all() or not array.size:
        words = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"{what} must be finite numbers of shape ({words}), got the shape {array.shape}")
    return array


def _covariance(what: str, values: Any, size: int, definite: bool = False) -> numpy.ndarray:
    matrix = _array(what, values, (size, size))
    scale = float(numpy.abs(matrix).max())
    smallest = float(numpy.linalg.eigvalsh(matrix).min())
    symmetric = bool((numpy.abs(matrix - matrix.T) <= 1e-12 * scale).all())
    if not symmetric or smallest < -1e-12 * scale or (definite and smallest <= 0.0):
        kind = "positive definite" if definite else "without negative eigenvalues"
        raise ValueError(f"{what} must be symmetric and {kind}, got {matrix.tolist()}")
    return 0.5 * (matrix + matrix.T)


def _function(
    what: str, function: Function, size: int, answers: int | None, given: int = 0
) -> VectorFunction:
    if not callable(function):
        function = _array(what, function, (answers, size))
    try:
        made = VectorFunction(function, size, given)
    except NotTraceable as error:
        raise ValueError(
            f"{what} cannot be traced ({error}): write it with NumPy's functions of the state, return a list, and let "
            "numpy.where choose where something depends on numbers"
        ) from error
    except ValueError as error:
        raise ValueError(f"{what} {error}") from error
    if answers not in (None, made.size):
        raise ValueError(f"{what} must return {answers} numbers, got {made.size}")
    return made


def _takes_interval(function: Any) -> bool:
    """Whether a function's second argument is the interval."""
    if not callable(function):
        return False
    try:
        return list(inspect.signature(function).parameters)[1:2] == ["dt"]
    except (TypeError, ValueError):
        return False


def _entries(matrix: Any) -> list[Any]:
    """Numbers of a matrix, or of a list of its rows, row by row."""
    try:
        return [entry for row in matrix for entry in row]
    except TypeError:
        raise ValueError("must return a matrix, as a list of its rows") from None


def _model(given: Mapping[str, Any], size: int, interval: float) -> StateSpaceModel:
    """Trace a model; the covariance of a timed one is checked at its usual interval, s."""
    h = _function("h", given["h"], size, None)
    f, Q = given["f"], given["Q"]
    timed = _takes_interval(f)
    noise: numpy.ndarray | VectorFunction
    if timed != callable(Q):
        raise ValueError(
            "a timed model has f(x, dt) and Q(dt), any other takes the interval in neither: got "
            f"{'f(x, dt)' if timed else 'f without dt'} and {'Q(dt)' if callable(Q) else 'Q as a matrix'}"
        )
    if not timed:
        traced, noise = _function("f", f, size, size), _covariance("Q", Q, size)
    else:
        traced = _function("f", lambda v: f(v[:size], v[size]), size, size, given=1)
        noise = _function("Q", lambda v: _entries(Q(v[0])), 1, size * size)
    model = StateSpaceModel(
        traced,
        h,
        noise,
        _covariance("R", given["R"], h.size, definite=True),
    )
    _covariance("Q", model.process_noise(interval), size)
    return model


def _chain(transition: Any, count: int) -> tuple[tuple[float, ...], ...]:
    if transition is None:
        away = 0.05 / max(count - 1, 1)
        transition = [[0.95 if i == j else away for j in range(count)] for i in range(count)]
        transition = [[1.0]] if count == 1 else transition
    matrix = _array("transition", transition, (count, count))
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
