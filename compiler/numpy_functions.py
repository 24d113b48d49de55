"""NumPy's own functions on traced arrays, so that what is written with NumPy can be traced, too.

NumPy hands a function of its own over to the arrays that it is called with (its protocols ``__array_ufunc__`` and
``__array_function__``). Those that the array API standard has are computed by :mod:`.namespace`; the others here.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy

from . import namespace
from .namespace import NotTraceable, Traced


def log_add_exp(one: Any, other: Any) -> Traced:
    """Logarithm of the sum of two exponentials, which do not overflow."""
    larger = namespace.maximum(one, other)
    apart = namespace.abs(namespace.subtract(one, other))
    # Of two equal infinities the difference is no number.
    sum_of = namespace.add(larger, namespace.log1p(namespace.exp(-apart)))
    return namespace.where(namespace.equal(one, other), namespace.add(larger, numpy.log(2.0)), sum_of)


def arg_max(x: Any, axis: int) -> Traced:
    """Place of the largest entry along an axis, of several the first."""
    rows = namespace.moveaxis(x, axis, 0)
    place: Any = namespace.zeros_like(rows[0], dtype=namespace.float64)
    largest: Any = rows[0]
    for i in range(1, len(rows)):
        here = namespace.greater(rows[i], largest)
        place = namespace.where(here, float(i), place)
        largest = namespace.where(here, rows[i], largest)
    return namespace.astype(place, namespace.int64)


def mean(x: Any, axis: Any = None) -> Traced:
    """Mean along an axis, or of all."""
    axes = range(x.ndim) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    return namespace.divide(namespace.sum(x, axis=axis), float(numpy.prod([x.shape[i] for i in axes])))


def replace_not_finite(x: Any) -> Traced:
    """Zero where an entry is no number, and the largest number in place of an infinite one."""
    largest = float(numpy.finfo(float).max)
    return namespace.clip(namespace.where(namespace.isnan(x), 0.0, x), -largest, largest)


def copy_array(x: Any, order: str = "K") -> Traced:
    """Return the array itself, as nothing changes it."""
    return namespace.asarray(x)


def full_like(x: Any, value: Any, dtype: Any = None) -> Traced:
    """Array of one value, shaped like another."""
    return namespace.full_like(x, value, dtype=dtype)


def concatenate(arrays: Sequence[Any], axis: int | None = 0) -> Traced:
    """Join arrays along an axis."""
    return namespace.concat(list(arrays), axis=axis)


def stack(arrays: Sequence[Any], axis: int = 0) -> Traced:
    """Join arrays along a new axis."""
    return namespace.stack(list(arrays), axis=axis)


def split(x: Any, sections: int, axis: int = 0) -> list[Traced]:
    """Cut an array into equal parts."""
    return [Traced(part, x.dtype) for part in numpy.split(x.nodes, sections, axis)]


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
}
"""Functions of entries, by NumPy's objects."""
REDUCTIONS: Mapping[Any, Callable[..., Any]] = {
    numpy.add: namespace.sum,
    numpy.multiply: namespace.prod,
    numpy.maximum: namespace.max,
    numpy.minimum: namespace.min,
    numpy.logical_and: namespace.all,
    numpy.logical_or: namespace.any,
    numpy.logaddexp: namespace._reduction(log_add_exp),
}
"""What ``function.reduce`` computes."""
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
}
"""Functions of arrays, likewise."""


def call_ufunc(function: Any, method: str, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> Traced:
    """Compute a function of entries, or its reduction along an axis.

    Raises:
        NotTraceable: for what cannot be traced.
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
    """Compute a function of arrays.

    Raises:
        NotTraceable: for what cannot be traced.
    """
    if function not in FUNCTIONS:
        raise _refusal(function, keywords)
    found: Traced = FUNCTIONS[function](*arguments, **keywords)
    return found


def _refusal(function: Any, keywords: Mapping[str, Any]) -> NotTraceable:
    given = f" with {', '.join(keywords)}" if keywords else ""
    return NotTraceable(f"numpy.{function.__name__}{given} cannot be traced")
