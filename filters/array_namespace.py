"""Array namespace (array API standard) of NumPy arrays and torch tensors, and operations on nested arrays."""

import functools
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import array_api_compat
import numpy

Array = Any
"""A NumPy array or a torch tensor."""


_BY_TYPE: dict[type, ModuleType] = {numpy.ndarray: numpy}
"""Cache of the namespaces by type of array."""


def namespace(array: Array) -> ModuleType:
    """Return the array API namespace of an array: NumPy or that of torch.

    The result is stored by type: asking ``array_api_compat`` costs as much as three small array operations.
    """
    kind = type(array)
    if kind not in _BY_TYPE:
        _BY_TYPE[kind] = numpy if issubclass(kind, numpy.generic) else array_api_compat.array_namespace(array)
    return _BY_TYPE[kind]


def lane_arrays(values: Any) -> list[Array]:
    """Return a flat list of the arrays ``(..., N)`` in nested lists, without plain numbers."""
    if isinstance(values, list | tuple):
        return [array for value in values for array in lane_arrays(value)]
    return [values] if getattr(values, "ndim", 0) else []


def stack_nested(values: Any, zero: Array, xp: Any) -> Array:
    """Stack nested lists of numbers and arrays ``(N,)`` into one array ``(..., N)``.

    Args:
        values: nested lists.
        zero: zeros ``(N,)``, added to every number.
        xp: array namespace.
    """
    if isinstance(values, list | tuple):
        return xp.stack([stack_nested(value, zero, xp) for value in values])
    return values + zero


def zeros_for(shape: Sequence[int], *parts: Any) -> numpy.ndarray:
    """Return a NumPy array of zeros whose type (float or wider) can store the values of ``parts``."""
    return numpy.zeros(shape, numpy.result_type(float, *map(numpy.asarray, parts)))


def map_nested(function: Callable[..., Array], *parts: Any) -> Any:
    """Apply a function to each array of nested tuples and dictionaries, which may contain None."""
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
    """Return nested arrays ``(..., N)``: those of ``one`` in lanes where a mask ``(N,)`` is true, else of
    ``other``.
    """
    return map_nested(functools.partial(namespace(which).where, which), one, other)


def is_tensor(values: Any) -> bool:
    """Return whether a value is a torch tensor; torch is not imported."""
    return type(values).__module__.partition(".")[0] == "torch"


def host_array(values: Any) -> numpy.ndarray:
    """Return an array or a tensor on any device as a NumPy array."""
    return values.detach().cpu().numpy() if is_tensor(values) else numpy.asarray(values)


def tensor_on(values: Any, device: Any) -> Array:
    """Return a value as a torch tensor on a device; a tensor keeps its gradient and type."""
    import torch

    return values.to(device) if is_tensor(values) else torch.tensor(values, device=device)
