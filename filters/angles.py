"""Differences of vectors with angles among their components, without whole turns.

An angle with the period c, 2 pi rad or 360 degrees, is known up to whole turns, so a difference d of two is one of
d + k c. The shortest is ``d - c round(d / c)``, between minus and plus half a turn.
"""

import math
from collections.abc import Mapping

from .array_namespace import Array, namespace

PERIODS = {"rad": 2.0 * math.pi, "deg": 360.0}
"""Periods of angles, by their units."""


def unwrap(values: Array, reference: Array, periods: Mapping[int, float]) -> Array:
    """Return values whose angles are shifted by whole turns to within half a turn of a reference.

    Args:
        values: vectors, ``(n, ...)``; angles within half a turn keep their bits.
        reference: vectors, ``(n, ...)``, of a shape that broadcasts.
        periods: period of each row that is an angle, by its number.
    """
    if not periods:
        return values
    xp, rows = namespace(values), [values[row] for row in range(values.shape[0])]
    for row, period in periods.items():
        rows[row] = rows[row] - period * xp.round((rows[row] - reference[row]) / period)
    return xp.stack(rows)


def shorten(difference: Array, periods: Mapping[int, float]) -> Array:
    """Return differences ``(n, ...)`` with their angles shortened to within half a turn; ``periods`` by row
    number.
    """
    return unwrap(difference, 0.0 * difference, periods) if periods else difference
