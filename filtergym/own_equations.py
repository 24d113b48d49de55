"""The equations of somebody's state-space model, checked and traced."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy

from .compiler.namespace import NotTraceable
from .compiler.vector_functions import VectorFunction
from .envs.linear.equations import StateSpaceModel, process_noise
from .envs.linear.inputs import Input

Function = Callable[..., Any] | Sequence[Sequence[float]] | numpy.ndarray
"""A function of the state ``(n,)`` that returns a list of numbers, or a matrix; with more arguments see
:func:`.own_models.state_space`."""
FURTHER = ("dt", "u")
"""What f may take after the state, by these names."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the equations of a model have to fit."""

    mean: numpy.ndarray
    """Of the initial state, ``(n,)``."""
    interval: float
    """Usual time between measurements, s."""
    inputs: Mapping[str, Input]
    """By their names."""

    @property
    def usual_inputs(self) -> numpy.ndarray:
        """Means of the inputs, ``(p,)``."""
        return numpy.array([one.mean for one in self.inputs.values()])


def make_model(given: Mapping[str, Any], around: Surroundings) -> StateSpaceModel:
    """Trace a model.

    Args:
        given: f, h, Q and R.
        around: what they have to fit; the covariance of a timed model is checked at its usual interval.

    Raises:
        ValueError: for what does not, or cannot be traced.
    """
    n, f, Q = len(around.mean), given["f"], given["Q"]
    h = trace("h", given["h"], n, None)
    timed = "dt" in further_arguments(f)
    noise: numpy.ndarray | VectorFunction
    if timed != callable(Q):
        raise ValueError(
            "a timed model has f(x, dt) and Q(dt), any other takes the interval in neither: got "
            f"{'f(x, dt)' if timed else 'f without dt'} and {'Q(dt)' if callable(Q) else 'Q as a matrix'}"
        )
    if timed:
        noise = trace("Q", lambda v: _entries(Q(v[n])), 0, n * n, n + 1 + len(around.inputs))
    else:
        noise = check_covariance("Q", Q, n)
    motion, of_inputs = _motion(f, timed, around)
    R = check_covariance("R", given["R"], h.size, definite=True)
    model = StateSpaceModel(motion, h, noise, R, of_inputs)
    check_covariance("Q", process_noise(model, around.mean, around.interval, around.usual_inputs), n)
    return model


def _motion(f: Function, timed: bool, around: Surroundings) -> tuple[VectorFunction, VectorFunction | None]:
    """f, and where an input has noise f as a function of the inputs."""
    n, p = len(around.mean), len(around.inputs)
    takes = further_arguments(f)
    if "u" in takes and not p:
        raise ValueError("f takes u, and there are no inputs: name them, such as inputs=['current']")
    if not takes and not p:
        return trace("f", f, n, n), None

    def call(x: Any, dt: Any, u: Any) -> Any:
        given = {"dt": dt, "u": u}
        return f(x, **{name: given[name] for name in takes}) if callable(f) else f @ x

    if not callable(f):
        f = check_array("f", f, (n, n))
    further = int(timed)  # the interval stands between state and inputs, or nothing does
    of_state = lambda v: call(v[:n], v[n] if timed else None, v[n + further :])  # noqa: E731
    motion = trace("f", of_state, n, n, further + p)
    if not any(one.noise > 0.0 for one in around.inputs.values()):
        return motion, None
    of_inputs = lambda v: call(v[p : p + n], v[p + n] if timed else None, v[:p])  # noqa: E731
    return motion, trace("f", of_inputs, p, n, n + further)


def further_arguments(function: Any) -> tuple[str, ...]:
    """Which of :data:`FURTHER` a function takes after the state."""
    if not callable(function):
        return ()
    try:
        names = list(inspect.signature(function).parameters)[1:]
    except (TypeError, ValueError):
        return ()
    return tuple(name for name in FURTHER if name in names)


def check_array(what: str, values: Any, shape: tuple[int | None, ...]) -> numpy.ndarray:
    """Return finite numbers of a shape, None for any number, or raise ValueError."""
    array = numpy.asarray(values, dtype=float)
    fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
    if not fits or not numpy.isfinite(array).all() or not array.size:
        words = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"{what} must be finite numbers of shape ({words}), got the shape {array.shape}")
    return array


def check_covariance(what: str, values: Any, size: int, definite: bool = False) -> numpy.ndarray:
    """Return a covariance, or raise ValueError."""
    matrix = check_array(what, values, (size, size))
    scale = float(numpy.abs(matrix).max())
    smallest = float(numpy.linalg.eigvalsh(matrix).min())
    symmetric = bool((numpy.abs(matrix - matrix.T) <= 1e-12 * scale).all())
    if not symmetric or smallest < -1e-12 * scale or (definite and smallest <= 0.0):
        kind = "positive definite" if definite else "without negative eigenvalues"
        raise ValueError(f"{what} must be symmetric and {kind}, got {matrix.tolist()}")
    return 0.5 * (matrix + matrix.T)


def trace(what: str, function: Function, size: int, answers: int | None, given: int = 0) -> VectorFunction:
    """Trace a function of so many numbers, and others without a derivative; None for any number of answers.

    Raises:
        ValueError: if it cannot be traced, or answers with another number.
    """
    if not callable(function):
        function = check_array(what, function, (answers, size))
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


def _entries(matrix: Any) -> list[Any]:
    """Numbers of a matrix, or of a list of its rows, row by row."""
    try:
        return [entry for row in matrix for entry in row]
    except TypeError:
        raise ValueError("must return a matrix, as a list of its rows") from None
