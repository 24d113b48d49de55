"""Times as numbers: seconds of a log or since 1970, and in which unit."""

SINCE_1970 = 1e8
"""s, from which on a time in seconds is one since 1970: a log of three years begins with zero, a date after 1973."""
TIME_UNITS = 1e9, 1e6, 1e3
"""Of a second, in which numbers since 1970 may count."""


def time_unit(time: float) -> float:
    """Return the number of units of a time in a second: 1e9, 1e6 or 1e3 of a number that is too large for seconds since
    1970.

    1e11 seconds after 1970 are in the year 5138, 1e11 milliseconds in 1973; and so on in steps of a thousand.
    """
    return next((unit for unit in TIME_UNITS if time > SINCE_1970 * unit), 1.0)
