"""The array library that an array belongs to, NumPy or torch through the array API standard, and ways between them."""

import functools
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import array_api_compat
import numpy

Array = Any
"""A NumPy array or a torch tensor."""


_BY_TYPE: dict[type, ModuleType] = {numpy.ndarray: numpy}
"""Namespaces of the types of array seen so far."""


def namespace(array: Array) -> ModuleType:
    """Return the array API namespace of ``array``.

    NumPy 2 implements the standard itself. Asking ``array_api_compat`` costs as much as three small array
    operations, and ``torch.compile`` cannot follow it, so the result is stored by type.
    """
    kind = type(array)
    if kind not in _BY_TYPE:
        _BY_TYPE[kind] = numpy if issubclass(kind, numpy.generic) else array_api_compat.array_namespace(array)
    return _BY_TYPE[kind]


def lane_arrays(values: Any) -> list[Array]:
    """Return the arrays with axes that stand among the numbers of nested lists."""
    if isinstance(values, list | tuple):
        return [array for value in values for array in lane_arrays(value)]
    return [values] if getattr(values, "ndim", 0) else []


def stack_nested(values: Any, zero: Array, xp: Any) -> Array:
    """Return the array of nested lists of numbers and arrays ``(N,)``, ``(..., N)``.

    Args:
        values: nested lists.
        zero: ``(N,)``, added to every number.
        xp: array namespace.
    """
    if isinstance(values, list | tuple):
        return xp.stack([stack_nested(value, zero, xp) for value in values])
    return values + zero


def zeros_for(shape: Sequence[int], *parts: Any) -> numpy.ndarray:
    """Zeros of NumPy whose entries may be set to those of the parts, which may be expressions in place of numbers."""
    return numpy.zeros(shape, numpy.result_type(float, *map(numpy.asarray, parts)))


def map_nested(function: Callable[..., Array], *parts: Any) -> Any:
    """Apply a function to the arrays of nested tuples and dictionaries; None contains no array."""
    first = parts[0]
    if first is None:
        return None
    if isinstance(first, dict):
        return {name: map_nested(function, *(part[name] for part in parts)) for name in first}
    if isinstance(first, tuple):
        answers = [map_nested(function, *each) for each in zip(*parts, strict=True)]
        return type(first)(*answers) if hasattr(first, "_fields") else tuple(answers)
    return function(*parts)


def select_nested(which: Array, one: Any, other: Any) -> Any:
    """Return the entries of one nested tuple or dictionary of arrays ``(..., N)`` where ``which``, ``(N,)``, is
    true, and of another elsewhere; None contains no array.
    """
    return map_nested(functools.partial(namespace(which).where, which), one, other)


def is_tensor(values: Any) -> bool:
    """Return whether this is a torch tensor, without importing torch."""
    return type(values).__module__.partition(".")[0] == "torch"


def host_array(values: Any) -> numpy.ndarray:
    """Return an array or tensor of any device as a NumPy array, without its gradient."""
    return values.detach().cpu().numpy() if is_tensor(values) else numpy.asarray(values)


def tensor_on(values: Any, device: Any) -> Array:
    """Return a tensor on ``device``: a tensor keeps its gradient and precision, anything else is copied."""
    import torch

    return values.to(device) if is_tensor(values) else torch.tensor(values, device=device)
