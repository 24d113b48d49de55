"""Time stamps: seconds of a log, or units since 1970."""

SINCE_1970 = 1e8
"""Smallest time that counts from 1970, s: that of a log of three years from zero on is below it, a date after 1973
above."""
TIME_UNITS = 1e9, 1e6, 1e3
"""Units per second of times since 1970."""


def time_unit(time: float) -> float:
    """Return how many units of a time stamp are a second, by its size: 1, or 1e3, 1e6, 1e9 since 1970.

    1e11 seconds after 1970 are in the year 5138, 1e11 milliseconds in 1973; and so on in steps of a thousand.
    """
    return next((unit for unit in TIME_UNITS if time > SINCE_1970 * unit), 1.0)
