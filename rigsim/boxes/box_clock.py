"""Whole microseconds: the resolution of a controller's clock, and its rounding of times.

Times are world times in s, as floats. A time on the clock's grid is the float nearest to a whole
number of microseconds, so that two equal times compare as equal, whatever sums they come from.
"""

import math

_FLOAT_ERROR_US = 1e-4


def whole_us(seconds: float) -> int:
    """Return the whole microseconds that have passed in `seconds`; a float's error is no loss.

    Examples
    --------
    >>> whole_us(0.1 + 0.2), whole_us(2.9e-6)
    (300000, 2)
    """
    return math.floor(seconds * 1e6 + _FLOAT_ERROR_US)


def on_clock(seconds: float) -> float:
    """Return a time on the clock's grid, in s: the last whole microsecond; inf stays."""
    return whole_us(seconds) / 1e6 if math.isfinite(seconds) else seconds


def add_us(now: float, duration_us: float) -> float:
    """Return the time on the grid that is `duration_us` after `now`, halves rounded up."""
    return (whole_us(now) + math.floor(duration_us + 0.5)) / 1e6


def elapsed_us(start: float, now: float) -> int:
    """Return the microseconds between two times on the grid."""
    return whole_us(now) - whole_us(start)


def elapsed_s(start: float, now: float) -> float:
    """Return the time between two times on the grid, in s, without their floats' errors."""
    return elapsed_us(start, now) / 1e6


def ceil_ms(duration_us: int) -> int:
    """Return a duration in ms, a part of one counted as a whole.

    Examples
    --------
    >>> ceil_ms(1500), ceil_ms(2000)
    (2, 2)
    """
    return -(-duration_us // 1000)


def rotation_us(angle_mdeg: int, quarter_turn_us: int) -> int:
    """Return how long a rotation takes that needs `quarter_turn_us` for 90 degrees.

    Examples
    --------
    >>> rotation_us(45_000, 500_000)
    250000
    """
    return (2 * abs(angle_mdeg) * quarter_turn_us + 90_000) // 180_000
