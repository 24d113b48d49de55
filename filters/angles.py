"""Differences of vectors of which some components are angles.

An angle with the period c, 2 pi rad or 360 degrees, is known up to whole turns, so a difference d of two is one of
d + k c. The shortest is ``d - c round(d / c)``, between minus and plus half a turn.
"""

import math
from collections.abc import Mapping

from .array_namespace import Array, namespace

PERIODS = {"rad": 2.0 * math.pi, "deg": 360.0}
"""Of angles, by their units."""


def unwrap(values: Array, reference: Array, periods: Mapping[int, float]) -> Array:
    """Return the values with their angles on the turn nearest to a reference; values already there keep their bits.

    Args:
        values: ``(n, ...)``.
        reference: ``(n, ...)``, of a shape that broadcasts.
        periods: of the rows that are angles, by their numbers.
    """
    if not periods:
        return values
    xp, rows = namespace(values), [values[row] for row in range(values.shape[0])]
    for row, period in periods.items():
        rows[row] = rows[row] - period * xp.round((rows[row] - reference[row]) / period)
    return xp.stack(rows)


def shorten(difference: Array, periods: Mapping[int, float]) -> Array:
    """Return the difference ``(n, ...)`` without whole turns; ``periods`` as of :func:`unwrap`."""
    return unwrap(difference, 0.0 * difference, periods) if periods else difference
