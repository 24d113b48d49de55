"""The array library that an array belongs to: NumPy or torch, through the array API standard."""

from types import ModuleType
from typing import Any

import array_api_compat
import numpy

Array = Any
"""A NumPy array or a torch tensor."""


def namespace(array: Array) -> ModuleType:
    """Return the array API namespace of ``array``.

    NumPy 2 implements the standard itself, and asking ``array_api_compat`` costs as much as three small
    array operations, so NumPy arrays take the short way.
    """
    if isinstance(array, numpy.ndarray | numpy.generic):
        return numpy
    return array_api_compat.array_namespace(array)
