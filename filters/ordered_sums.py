"""Sums in a fixed order, whose rounding does not depend on the width of the batch.

The reductions of NumPy and torch choose the order of their additions by the shape of the array, so that lane
i of a wide batch would differ in the last bit from the same episode alone. Here the terms are added one after
the other.
"""

import functools
import operator
from collections.abc import Iterable

from .array_namespace import Array


def ordered_sum(values: Iterable[Array]) -> Array:
    """Return the sum ``(...)`` over the first axis, ``((values[0] + values[1]) + values[2]) + ...``.

    Args:
        values: terms, an array ``(M, ...)`` or any series of at least one array.
    """
    return functools.reduce(operator.add, values)


def weighted_sum(weights: Array, values: Array) -> Array:
    """Return the weighted sum over M hypotheses, ``sum_j weights[j] values[..., j, :]``.

    Args:
        weights: weights, ``(M, ...)``.
        values: values, ``(M, ...)``, ``(n, M, ...)`` or ``(n, n, M, ...)``: the axes behind M are as many as those of
            ``weights`` and broadcast against them.

    Returns:
        ``values`` without its axis M.
    """
    before = (slice(None),) * (values.ndim - weights.ndim)
    return ordered_sum(weights[j] * values[(*before, j)] for j in range(weights.shape[0]))
