"""NumPy functions on traced arrays, so that functions written with NumPy can be traced.

NumPy dispatches its functions to the arrays of a call (protocols ``__array_ufunc__`` and ``__array_function__``).
Functions of the array API standard are computed by :mod:`.namespace`, others here. NumPy computes the remaining
functions of arrays, such as ``cross`` and ``einsum``, itself on arrays of objects, whose arithmetic is traced.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy

from . import namespace
from .namespace import NotTraceable, Traced


def log_add_exp(one: Any, other: Any) -> Traced:
    """Return ``log(exp(one) + exp(other))`` without overflow, as ``numpy.logaddexp``."""
    larger = namespace.maximum(one, other)
    apart = namespace.abs(namespace.subtract(one, other))
    # The difference of two equal infinities is NaN.
    sum_of = namespace.add(larger, namespace.log1p(namespace.exp(-apart)))
    return namespace.where(namespace.equal(one, other), namespace.add(larger, numpy.log(2.0)), sum_of)


def arg_max(x: Any, axis: int) -> Traced:
    """Return the index of the first largest entry along an axis, ``numpy.argmax``."""
    rows = namespace.moveaxis(x, axis, 0)
    place: Any = namespace.zeros_like(rows[0], dtype=namespace.float64)
    largest: Any = rows[0]
    for i in range(1, len(rows)):
        here = namespace.greater(rows[i], largest)
        place = namespace.where(here, float(i), place)
        largest = namespace.where(here, rows[i], largest)
    return namespace.astype(place, namespace.int64)


def mean(x: Any, axis: Any = None) -> Traced:
    """Return the mean along an axis, or of all entries."""
    axes = range(x.ndim) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    return namespace.divide(namespace.sum(x, axis=axis), float(numpy.prod([x.shape[i] for i in axes])))


def replace_not_finite(x: Any) -> Traced:
    """Return NaN replaced by zero and infinities by the largest numbers, as ``numpy.nan_to_num``."""
    largest = float(numpy.finfo(float).max)
    return namespace.clip(namespace.where(namespace.isnan(x), 0.0, x), -largest, largest)


def copy_array(x: Any, order: str = "K") -> Traced:
    """Return the array itself, since traced arrays are immutable."""
    return namespace.asarray(x)


def full_like(x: Any, value: Any, dtype: Any = None) -> Traced:
    """Return an array filled with one value, with the shape of another array."""
    return namespace.full_like(x, value, dtype=dtype)


def concatenate(arrays: Sequence[Any], axis: int | None = 0) -> Traced:
    """Return arrays joined along an axis."""
    return namespace.concat(list(arrays), axis=axis)


def stack(arrays: Sequence[Any], axis: int = 0) -> Traced:
    """Return arrays joined along a new axis."""
    return namespace.stack(list(arrays), axis=axis)


def split(x: Any, sections: int, axis: int = 0) -> list[Traced]:
    """Return the equal parts of an array along an axis, as a list."""
    return [Traced(part, x.dtype) for part in numpy.split(x.nodes, sections, axis)]


def interpolate(
    x: Any, places: Any, values: Any, left: Any = None, right: Any = None, period: None = None
) -> Traced:
    """Return linear interpolations between points with increasing coordinates, ``numpy.interp``."""
    if period is not None:
        raise _refusal(numpy.interp, {"period": period})
    places = numpy.asarray(places, dtype=float)
    found: Any = namespace.asarray(values[0] if left is None else left)
    for i, (one, other) in enumerate(itertools.pairwise(places)):
        slope = (values[i + 1] - values[i]) / (other - one)
        found = namespace.where(x >= one, slope * (x - one) + values[i], found)
    found = namespace.where(x >= places[-1], values[-1], found)
    if right is not None:
        found = namespace.where(x > places[-1], right, found)
    return namespace.where(namespace.isnan(x), x, found)


def norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Traced:
    """Return the Euclidean norm along an axis, or of all entries."""
    if ord not in (None, 2) or (ord == 2 and x.ndim > 1 and not isinstance(axis, int)):
        raise _refusal(numpy.linalg.norm, {"ord": ord})
    return namespace.sqrt(namespace.sum(namespace.square(x), axis=axis, keepdims=keepdims))


def dot(one: Any, other: Any) -> Traced:
    """Return the product of vectors, matrices or numbers, ``numpy.dot``."""
    one, other = namespace.asarray(one), namespace.asarray(other)
    return namespace.matmul(one, other) if one.ndim and other.ndim else namespace.multiply(one, other)


def select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0) -> Traced:
    """Return for each entry the choice of the first true condition, ``numpy.select``."""
    found = default
    for condition, choice in reversed([*zip(conditions, choices, strict=True)]):
        found = namespace.where(condition, choice, found)
    return namespace.asarray(found)


def cube_root(x: Any) -> Traced:
    """Return the real cube root, also of negative numbers, ``numpy.cbrt``."""
    return namespace.multiply(namespace.sign(x), namespace.pow(namespace.abs(x), 1.0 / 3.0))


def remainder_of_dividend(one: Any, other: Any) -> Traced:
    """Return the remainder with the sign of the dividend, ``numpy.fmod``."""
    size = namespace.remainder(namespace.abs(one), namespace.abs(other))
    return namespace.multiply(namespace.where(namespace.less(one, 0.0), -1.0, 1.0), size)


_STANDARD = [
    "add",
    "subtract",
    "multiply",
    "divide",
    "remainder",
    "maximum",
    "minimum",
    "less",
    "less_equal",
    "greater",
    "greater_equal",
    "equal",
    "not_equal",
    "logical_and",
    "logical_or",
    "logical_not",
    "floor_divide",
    "negative",
    "sign",
    "floor",
    "ceil",
    "trunc",
    "sqrt",
    "exp",
    "expm1",
    "exp2",
    "log",
    "log1p",
    "log2",
    "log10",
    "sin",
    "cos",
    "tan",
    "sinh",
    "cosh",
    "tanh",
    "hypot",
    "square",
    "isnan",
    "isfinite",
    "matmul",
]
UFUNCS: Mapping[Any, Callable[..., Any]] = {
    **{getattr(numpy, name): getattr(namespace, name) for name in _STANDARD},
    numpy.absolute: namespace.abs,
    numpy.rint: namespace.round,
    numpy.power: namespace.pow,
    numpy.arctan2: namespace.atan2,
    numpy.arcsin: namespace.asin,
    numpy.arccos: namespace.acos,
    numpy.arctan: namespace.atan,
    numpy.arcsinh: namespace.asinh,
    numpy.arccosh: namespace.acosh,
    numpy.arctanh: namespace.atanh,
    numpy.bitwise_and: namespace.logical_and,
    numpy.bitwise_or: namespace.logical_or,
    numpy.invert: namespace.logical_not,
    numpy.logaddexp: log_add_exp,
    numpy.float_power: namespace.pow,
    numpy.positive: lambda x: namespace.asarray(x),
    numpy.fabs: namespace.abs,
    numpy.reciprocal: lambda x: namespace.divide(1.0, x),
    numpy.cbrt: cube_root,
    numpy.fmod: remainder_of_dividend,
    **dict.fromkeys((numpy.degrees, numpy.rad2deg), lambda x: namespace.multiply(x, 180.0 / numpy.pi)),
    **dict.fromkeys((numpy.radians, numpy.deg2rad), lambda x: namespace.multiply(x, numpy.pi / 180.0)),
}
"""Traced form of each elementwise NumPy function."""
REDUCTIONS: Mapping[Any, Callable[..., Any]] = {
    numpy.add: namespace.sum,
    numpy.multiply: namespace.prod,
    numpy.maximum: namespace.max,
    numpy.minimum: namespace.min,
    numpy.logical_and: namespace.all,
    numpy.logical_or: namespace.any,
    numpy.logaddexp: namespace._reduction(log_add_exp),
}
"""Traced form of ``reduce`` of each elementwise NumPy function."""
FUNCTIONS: Mapping[Any, Callable[..., Any]] = {
    **{
        getattr(numpy, name): getattr(namespace, name)
        for name in [
            "where",
            "clip",
            "sum",
            "prod",
            "max",
            "min",
            "any",
            "all",
            "reshape",
            "moveaxis",
            "broadcast_to",
            "expand_dims",
            "squeeze",
            "flip",
            "roll",
            "tile",
            "repeat",
            "tril",
            "triu",
            "zeros_like",
            "ones_like",
            "sort",
        ]
    },
    numpy.full_like: full_like,
    numpy.concatenate: concatenate,
    numpy.stack: stack,
    numpy.split: split,
    numpy.argmax: arg_max,
    numpy.mean: mean,
    numpy.copy: copy_array,
    numpy.ndim: lambda x: x.ndim,
    numpy.nan_to_num: replace_not_finite,
    numpy.interp: interpolate,
    numpy.select: select,
    numpy.linalg.norm: norm,
    numpy.dot: dot,
}
"""Traced form of NumPy functions of arrays."""
INVERSES = (numpy.linalg.inv, numpy.linalg.solve, numpy.linalg.det, numpy.linalg.pinv, numpy.linalg.lstsq)
"""NumPy functions that cannot be traced, since their pivots depend on numbers."""
OTHERWISE = "write it with arithmetic, numpy.sum and numpy.where"
"""Advice in the error for all other functions."""
for _function, _own in UFUNCS.items():
    if not hasattr(Traced, _function.__name__):  # NumPy calls it on entries of arrays of objects
        setattr(Traced, _function.__name__, _own)


def call_ufunc(function: Any, method: str, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> Traced:
    """Return the result of a NumPy ufunc on traced arrays, elementwise or reduced along an axis.

    Raises:
        NotTraceable: for a function that cannot be traced.
    """
    keywords = {name: value for name, value in keywords.items() if value is not None}
    if method == "__call__" and not keywords and function in UFUNCS:
        found: Traced = UFUNCS[function](*arguments)
    elif method == "reduce" and set(keywords) <= {"axis", "keepdims"} and function in REDUCTIONS:
        found = REDUCTIONS[function](*arguments, **{"axis": 0, **keywords})
    else:
        raise _refusal(function, keywords)
    return found


def call_function(function: Any, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> Traced:
    """Return the result of a NumPy function of traced arrays.

    Raises:
        NotTraceable: for a function that cannot be traced.
    """
    found: Traced = (
        FUNCTIONS[function](*arguments, **keywords)
        if function in FUNCTIONS
        else _on_objects(function, arguments, keywords)
    )
    return found


def _on_objects(function: Any, arguments: Any, keywords: Mapping[str, Any]) -> Any:
    def objects(given: Any) -> Any:
        if isinstance(given, list | tuple):
            return type(given)(map(objects, given))
        return numpy.asarray(given) if isinstance(given, Traced) else given

    try:
        if function in INVERSES:
            raise NotTraceable
        found = function(*objects(arguments), **{name: objects(value) for name, value in keywords.items()})
    except Exception as error:
        raise _refusal(function, keywords) from error
    is_traced = isinstance(found, numpy.ndarray) and found.dtype == object
    return namespace.asarray(found) if is_traced else found


def _refusal(function: Any, keywords: Mapping[str, Any]) -> NotTraceable:
    given = f" with {', '.join(keywords)}" if keywords else ""
    name = function.__name__
    for prefix, module in (("numpy.", numpy), ("numpy.linalg.", numpy.linalg)):
        if getattr(module, name, None) is function:
            name = prefix + name
    other = "write out the formula of the small matrix" if function in INVERSES else OTHERWISE
    return NotTraceable(f"{name}{given} cannot be traced: {other}")
