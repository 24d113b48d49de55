"""Conversion of small datasets, such as curves and tracks, to JSON and back."""

from collections.abc import Mapping
from typing import Any

import numpy
import xarray

from ...envs.contract.parameters import quote_shortened
from .stored import has_type

PARTS = ("coords", "variables", "attrs")


def dataset_as_json(dataset: xarray.Dataset, digits: Mapping[str, int], otherwise: int) -> dict[str, Any]:
    """Return a dataset of numbers and strings as a dictionary of JSON values; NaN becomes null.

    Args:
        dataset: dataset of numbers and strings.
        digits: significant digits of variables, by their names.
        otherwise: significant digits of the other variables.
    """

    def as_json(name: str, values: numpy.ndarray) -> Any:
        if values.dtype.kind != "f":
            return values.tolist()
        words = numpy.char.mod(f"%.{digits.get(name, otherwise)}g", values.ravel()).tolist()
        numbers = [float(word) if word[-1] not in "nf" else None for word in words]
        return {"shape": list(values.shape), "numbers": numbers}

    def part(variables: Any) -> dict[str, Any]:
        return {str(name): [list(v.dims), as_json(str(name), v.values)] for name, v in variables.items()}

    return {
        "coords": part(dataset.coords),
        "variables": part(dataset.data_vars),
        "attrs": {
            str(name): value.item() if hasattr(value, "item") else value
            for name, value in dataset.attrs.items()
        },
    }


def dataset_from_json(stored: Any) -> xarray.Dataset:
    """Return the dataset stored in the JSON values of :func:`dataset_as_json`; raise ValueError for others."""
    if not isinstance(stored, dict) or not all(isinstance(stored.get(part), dict) for part in PARTS):
        raise ValueError(f"expected {', '.join(PARTS)} of a dataset, got {quote_shortened(stored)}")

    def read(name: str, entry: Any) -> tuple[list[str], numpy.ndarray]:
        if not (isinstance(entry, list) and len(entry) == 2 and has_type(entry[0], list[str])):
            raise ValueError(f"{name!r} needs dimensions and values")
        values = entry[1]
        if isinstance(values, dict):
            shape, numbers = values.get("shape"), values.get("numbers")
            if not (isinstance(shape, list) and has_type(shape, list[int]) and min(shape, default=0) >= 0):
                raise ValueError(f"{name!r} needs a shape")
            if not has_type(numbers, list[float | None]):
                raise ValueError(f"{name!r} needs its numbers")
            array = _array(numbers, float).reshape(shape)
        elif has_type(values, list[str]) or isinstance(values, str):
            array = numpy.array(values)
        elif has_type(values, list[int]) or isinstance(values, int):
            array = _array(values, numpy.int64)
        else:
            raise ValueError(f"{name!r} must contain numbers or strings")
        if array.ndim != len(entry[0]):
            raise ValueError(f"{name!r} has {array.ndim} dimensions, but names {len(entry[0])}")
        return entry[0], array

    coords, variables = (
        {name: read(name, entry) for name, entry in stored[part].items()} for part in PARTS[:2]
    )
    if not has_type(stored["attrs"], dict[str, str | int | float]):
        raise ValueError("attributes must be words or numbers")
    return xarray.Dataset(variables, coords, stored["attrs"])


def _array(values: Any, kind: Any) -> numpy.ndarray:
    """Return a list of numbers as an array, with NaN for None; raise ValueError if one is too large."""
    try:
        return numpy.array(values, dtype=kind)
    except OverflowError as error:
        raise ValueError(f"a number is too large: {error}") from error
