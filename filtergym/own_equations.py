"""The equations of a user's state-space model, checked and traced."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy

from .compiler import namespace
from .compiler.namespace import NotTraceable
from .compiler.vector_functions import VectorFunction
from .envs.contract.parameters import read_numbers
from .envs.linear.equations import StateSpaceModel, nominal_sensor_noise, process_noise, sensor_noise
from .envs.linear.inputs import Input
from .own_drifts import Discretised, discretise_drift

Function = Callable[..., Any] | Sequence[Sequence[float]] | numpy.ndarray
"""A function of the state ``(n,)`` that returns a list of numbers, or a matrix; with more arguments see
:func:`.own_models.state_space`.
"""
FURTHER = ("dt", "u")
"""Names of the further arguments that f may take after the state."""
FAR = 3.0
"""Standard deviations of the inputs from their means up to which R must be a covariance."""


class NoiseBlock(NamedTuple):
    """Covariance R of some of the measured numbers, independent of that of all others."""

    what: str
    """Name of the noise, in errors."""
    R: Any
    """A number, a matrix ``(size, size)``, or a function that returns either."""
    size: int


@dataclass(frozen=True, eq=False)
class Surroundings:
    """State, interval and inputs that the equations of a user's model must fit."""

    mean: numpy.ndarray
    """Mean of the initial state, ``(n,)``."""
    interval: float
    """Typical time between measurements, s."""
    inputs: Mapping[str, Input]
    """Inputs by their names."""
    integration_steps: int = 1
    """Number of steps of the Runge-Kutta method in an interval, for a drift that is not linear."""

    @property
    def nominal_inputs(self) -> numpy.ndarray:
        """Mean of each input in a simulation, ``(p,)``."""
        return numpy.array([one.mean for one in self.inputs.values()])


def make_model(equations: Mapping[str, Any], around: Surroundings) -> StateSpaceModel:
    """Check the equations of a state-space model, and return them traced.

    Args:
        equations: equations by name: f and Q, or drift and diffusion; h and R; with sensors the blocks of R.
        around: state, interval and inputs that they must fit; a timed covariance is checked at the typical interval.

    Raises:
        ValueError: for equations that do not fit, or cannot be traced.
    """
    n = len(around.mean)
    h = trace_measurement("h", equations["h"], n, len(around.inputs))
    motion = (
        _continuous(equations, around) if equations.get("drift") is not None else _discrete(equations, around)
    )
    blocks = equations["R"] if equations.get("sensors") else [NoiseBlock("R", equations["R"], h.size)]
    R = _sensor_noise(blocks, around, isinstance(motion.Q, VectorFunction))
    model = StateSpaceModel(
        motion.f, h, motion.Q, R, motion.G, _of_inputs(equations["h"], h, around), motion.sources
    )
    check_covariance("Q", process_noise(model, around.mean, around.interval, around.nominal_inputs), n)
    _check_sensor_noise(model, blocks, around)
    return model


def _sensor_noise(
    blocks: Sequence[NoiseBlock], around: Surroundings, timed: bool
) -> numpy.ndarray | VectorFunction:
    """Return R of all sensors: a matrix ``(m, m)``, or a traced function of state, interval and inputs."""
    n, further, size = len(around.mean), int(timed), sum(block.size for block in blocks)
    ends = numpy.cumsum([0, *(block.size for block in blocks)]).tolist()
    takes = [_noise_arguments(block, around, timed) for block in blocks]
    if not any(map(callable, (block.R for block in blocks))):
        R = numpy.zeros((size, size))
        for first, block in zip(ends, blocks, strict=False):
            own = slice(first, first + block.size)
            given = read_numbers(block.what, block.R)
            given = given if given.ndim else given.reshape(1, 1)
            R[own, own] = check_covariance(block.what, given, block.size, definite=True)
        return R

    def entries(v: Any) -> list[Any]:
        given = {"x": v[:n], "dt": v[n] if timed else None, "u": v[n + further :]}
        rows: list[list[Any]] = [[0.0] * size for _ in range(size)]
        for first, block, names in zip(ends, blocks, takes, strict=False):
            found = _matrix(block.R(*(given[name] for name in names)) if callable(block.R) else block.R)
            if found.shape != (block.size, block.size):
                raise ValueError(
                    f"{block.what} must return a matrix ({block.size}, {block.size}), got the shape {found.shape}"
                )
            for i in range(block.size):
                rows[first + i][first : first + block.size] = [found[i, j] for j in range(block.size)]
        return [entry for row in rows for entry in row]

    return trace("R", entries, 0, size * size, n + further + len(around.inputs))


def _matrix(R: Any) -> Any:
    """Return a covariance, or the variance of one number, as a traced matrix."""
    if isinstance(R, list | tuple):
        R = namespace.stack([namespace.asarray(row) for row in R])
    found = namespace.asarray(R)
    return found if found.shape else namespace.reshape(found, (1, 1))


def _noise_arguments(block: NoiseBlock, around: Surroundings, timed: bool) -> tuple[str, ...]:
    """Return which of x, dt and u a block's function R takes, in its order; empty for a matrix."""
    if not callable(block.R):
        return ()
    names = arguments(block.R) or ("x",)
    takes = tuple(name if name in FURTHER else "x" for name in names)
    if len({*takes}) < len(takes):
        raise ValueError(
            f"{block.what} may take the state, dt and u, each once, such as R(x), R(u) or R(x, dt, u), got the "
            f"arguments {', '.join(names)}"
        )
    if "dt" in takes and not timed:
        raise ValueError(f"{block.what} takes dt, and the model is not timed: write f(x, dt) and Q(dt)")
    if "u" in takes and not around.inputs:
        raise ValueError(
            f"{block.what} takes u, and there are no inputs: name them, such as inputs=['accuracy']"
        )
    return takes


def _check_sensor_noise(model: StateSpaceModel, blocks: Sequence[NoiseBlock], around: Surroundings) -> None:
    """Raise ValueError if a function R is no covariance at the initial mean and likely inputs."""
    if not isinstance(model.R, VectorFunction):
        return
    deviations = numpy.array([one.deviation for one in around.inputs.values()])
    inputs = around.nominal_inputs[:, None] + deviations[:, None] * numpy.linspace(-FAR, FAR, 7)
    R = sensor_noise(model, around.mean, numpy.full(inputs.shape[1], around.interval), inputs)
    usual = nominal_sensor_noise(model, around.mean, around.interval, around.inputs)
    first = 0
    for block in blocks:
        own = slice(first, first + block.size)
        first += block.size
        try:
            for k in range(inputs.shape[1]):
                check_covariance(block.what, R[own, own, k], block.size)
            check_covariance(block.what, usual[own, own], block.size, definite=True)
        except ValueError as error:
            raise ValueError(
                f"{error} at the initial mean and inputs up to {FAR:g} deviations from their means: write a function "
                "that cannot be negative, such as u[0] ** 2, or give the usual inputs, such as "
                "inputs={'accuracy': Input(mean=3.0, deviation=0.5)}"
            ) from error


class _Motion(NamedTuple):
    """Motion of the state: f, G, Q and its sources, as in :class:`StateSpaceModel`."""

    f: VectorFunction
    G: VectorFunction | None
    Q: numpy.ndarray | VectorFunction
    sources: Mapping[str, numpy.ndarray | VectorFunction]


def _discrete(given: Mapping[str, Any], around: Surroundings) -> _Motion:
    n, f, parts = len(around.mean), given["f"], _sources("Q", given["Q"])
    takes = further_arguments(f)
    wrong = next((Q for Q in parts.values() if ("dt" in takes) != callable(Q)), None)
    if wrong is not None:
        raise ValueError(
            "a timed model has f(x, dt) and Q(dt), any other takes the interval in neither: got "
            f"{'f(x, dt)' if 'dt' in takes else 'f without dt'} and {'Q(dt)' if callable(wrong) else 'Q as a matrix'}"
        )
    if not callable(f):
        f = check_array("f", f, (n, n))
    elif "u" in takes and not around.inputs:
        raise ValueError("f takes u, and there are no inputs: name them, such as inputs=['current']")

    def call(x: Any, dt: Any, u: Any) -> Any:
        further = {"dt": dt, "u": u}
        return f(x, **{name: further[name] for name in takes}) if callable(f) else f @ x

    def noise(parts: Sequence[Any]) -> numpy.ndarray | VectorFunction:
        if "dt" not in takes:
            return numpy.sum([check_covariance("Q", Q, n) for Q in parts], axis=0)
        entries = lambda v: _sum([_entries(Q(v[n])) for Q in parts])  # noqa: E731
        return trace("Q", entries, 0, n * n, n + 1 + len(around.inputs))

    moved = (
        _with_inputs("f", call, "dt" in takes, around)
        if takes or around.inputs
        else (trace("f", f, n, n), None)
    )
    return _Motion(*moved, noise([*parts.values()]), {name: noise([Q]) for name, Q in parts.items() if name})


def _sources(what: str, given: Any) -> Mapping[str, Any]:
    """Return covariances of process noise by the names of their sources; a single one has the name ""."""
    if not isinstance(given, Mapping):
        return {"": given}
    if not given or not all(isinstance(name, str) and name for name in given):
        raise ValueError(
            f"{what} by its sources names at least one, such as {{'wind': ...}}, got {[*given]!r}"
        )
    return given


def _sum(parts: Sequence[Sequence[Any]]) -> list[Any]:
    return [sum(numbers[1:], numbers[0]) for numbers in zip(*parts, strict=True)]


def _continuous(given: Mapping[str, Any], around: Surroundings) -> _Motion:
    n, p, drift = len(around.mean), len(around.inputs), given["drift"]
    if callable(drift):
        takes = further_arguments(drift)
        if "dt" in takes or ("u" in takes and not p):
            raise ValueError("drift takes the state, and u where there are inputs: drift(x) or drift(x, u)")
        own = drift
        drift = lambda v: own(v[:n], v[n:]) if takes else own(v[:n])  # noqa: E731
    else:
        drift = numpy.concatenate([check_array("drift", drift, (n, n)), numpy.zeros((n, p))], axis=1)
    parts = {
        name: check_covariance("diffusion", one, n)
        for name, one in _sources("diffusion", given["diffusion"]).items()
    }
    traced = trace("drift", drift, n + p, n)

    def discretised(diffusion: numpy.ndarray) -> Discretised:
        return discretise_drift(traced, diffusion, around.interval, around.integration_steps)

    def noise(diffusion: numpy.ndarray) -> VectorFunction:
        found = discretised(diffusion)
        return trace("drift", lambda v: _entries(found.noise(v[:n], v[n], v[n + 1 :])), 0, n * n, n + 1 + p)

    total = numpy.sum([*parts.values()], axis=0)
    motion = discretised(total).motion
    sources = {name: noise(one) for name, one in parts.items() if name}
    return _Motion(*_with_inputs("drift", motion, True, around), noise(total), sources)


def _with_inputs(
    what: str, call: Callable[[Any, Any, Any], Any], timed: bool, around: Surroundings
) -> tuple[VectorFunction, VectorFunction | None]:
    """Return the motion traced as a function of the state first, and of the noisy inputs first (None: none)."""
    n, p = len(around.mean), len(around.inputs)
    further = int(timed)  # the interval stands between state and inputs, or nothing does
    of_state = lambda v: call(v[:n], v[n] if timed else None, v[n + further :])  # noqa: E731
    motion = trace(what, of_state, n, n, further + p)
    if not any(one.noise > 0.0 for one in around.inputs.values()):
        return motion, None
    of_inputs = lambda v: call(v[p : p + n], v[p + n] if timed else None, v[:p])  # noqa: E731
    return motion, trace(what, of_inputs, p, n, n + further)


def trace_measurement(what: str, h: Function, n: int, p: int) -> VectorFunction:
    """Return the traced measurement h of a state of n numbers and, if it takes them, p inputs.

    Raises:
        ValueError: if it cannot be traced, or takes an argument that does not exist.
    """
    takes = further_arguments(h)
    if "dt" in takes or ("u" in takes and not p):
        raise ValueError(f"{what} takes the state, and u where there are inputs: h(x) or h(x, u)")
    if not callable(h) or not takes:
        return trace(what, h, n, None)
    return trace(what, lambda v: h(v[:n], v[n:]), n, None, p)


def _of_inputs(h: Function, traced: VectorFunction, around: Surroundings) -> VectorFunction | None:
    """Return the measurement h traced as a function of the inputs first; None if no noisy input acts on it."""
    p = len(around.inputs)
    if not callable(h) or not traced.given or not any(one.noise > 0.0 for one in around.inputs.values()):
        return None
    return trace("h", lambda v: h(v[p:], v[:p]), p, traced.size, len(around.mean))


def further_arguments(function: Any) -> tuple[str, ...]:
    """Return which of the arguments ``dt`` and ``u`` a function takes after the state."""
    return tuple(name for name in FURTHER if name in arguments(function)[1:])


def arguments(function: Any) -> tuple[str, ...]:
    """Return the argument names of a function; empty if it is none, or has no signature."""
    if not callable(function):
        return ()
    try:
        return tuple(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return ()


def check_array(what: str, values: Any, shape: tuple[int | None, ...]) -> numpy.ndarray:
    """Return values as an array; raise ValueError unless finite and of the shape, where None is any size."""
    array = read_numbers(what, values)
    fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
    if fits and not numpy.isfinite(array).all():
        raise ValueError(f"{what} must be finite, got {float(array[~numpy.isfinite(array)][0])}")
    if not fits or not array.size:
        words = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"{what} must be finite numbers of shape ({words}), got the shape {array.shape}")
    return array


def check_covariance(what: str, values: Any, size: int, definite: bool = False) -> numpy.ndarray:
    """Return a matrix ``(size, size)``, made symmetric; raise ValueError if it is no covariance."""
    matrix = check_array(what, values, (size, size))
    scale = float(numpy.abs(matrix).max())
    smallest = float(numpy.linalg.eigvalsh(matrix).min())
    symmetric = bool((numpy.abs(matrix - matrix.T) <= 1e-12 * scale).all())
    if not symmetric or smallest < -1e-12 * scale or (definite and smallest <= 0.0):
        kind = "positive definite" if definite else "without negative eigenvalues"
        raise ValueError(f"{what} must be symmetric and {kind}, got {matrix.tolist()}")
    return 0.5 * (matrix + matrix.T)


def trace(what: str, function: Function, size: int, results: int | None, further: int = 0) -> VectorFunction:
    """Return the traced form of a function of ``size`` numbers, and of ``further`` ones without derivative.

    The function has ``results`` results; None: any number of them.

    Raises:
        ValueError: if it cannot be traced, or returns another number of results.
    """
    if not callable(function):
        function = check_array(what, function, (results, size))
    try:
        made = VectorFunction(function, size, further)
    except NotTraceable as error:
        raise ValueError(
            f"{what} cannot be traced ({error}): write it with NumPy's functions of the state, return a list, and use "
            "numpy.where in place of branches on numbers"
        ) from error
    except ValueError as error:
        raise ValueError(f"{what} {error}") from error
    if results not in (None, made.size):
        raise ValueError(f"{what} must return {results} numbers, got {made.size}")
    return made


def _entries(matrix: Any) -> list[Any]:
    """Return the entries of a matrix, or of a list of rows, as one flat list, row by row."""
    try:
        return [entry for row in matrix for entry in row]
    except TypeError:
        raise ValueError("must return a matrix, as a list of its rows") from None
