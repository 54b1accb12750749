"""Format numbers with units, for pages and for the terminal."""

from typing import Final

DEGREE_SIGN: Final = "°"
_SIGN_BY_UNIT: Final = {"deg": DEGREE_SIGN, "1": ""}


def format_unit(unit: str) -> str:
    """Return the printed form of a unit; empty for a dimensionless number.

    Parameters
    ----------
    unit
        Unit, as named by documents and maps.

    Examples
    --------
    >>> format_unit("deg"), format_unit("1"), format_unit("1/mm")
    ('°', '', '1/mm')
    """
    return _SIGN_BY_UNIT.get(unit, unit)


def format_quantity(number: str, unit: str) -> str:
    """Join a number and its unit.

    A space separates them, except before the sign of degrees: SI Brochure, 9th edition,
    section 5.4.3.

    Parameters
    ----------
    number
        Formatted number.
    unit
        Unit, as named by documents and maps.

    Examples
    --------
    >>> format_quantity("1.5", "deg"), format_quantity("1.5", "°")
    ('1.5°', '1.5°')
    >>> format_quantity("12", "%"), format_quantity("3", "1")
    ('12 %', '3')
    """
    sign = format_unit(unit)
    return number + ("" if sign == DEGREE_SIGN or not sign else " ") + sign
