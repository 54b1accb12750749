"""Format numbers with units, for pages and for the terminal, and tables as CSV."""

import csv
import io
import re
from collections.abc import Iterable
from typing import Final

_INNER_FORMULA: Final = re.compile(r"([;\t\n]\s*)([=+\-@])")
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


def format_csv(rows: Iterable[Iterable[object]]) -> str:
    r"""Return rows as CSV in which no text is a formula.

    Spreadsheets run a cell that begins with one of ``= + - @``, also after blanks; some begin a
    cell after a semicolon or a tab. Names in other people's sessions may be such; an apostrophe
    makes them text. Numbers given as text stay; carriage returns become blanks.

    Parameters
    ----------
    rows
        Cells, row by row.

    Examples
    --------
    >>> format_csv([("name", "error"), ("=HYPERLINK(1)", -0.5), ("-x", "-1e-3")])
    "name,error\n'=HYPERLINK(1),-0.5\n'-x,-1e-3\n"
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(
        [_disarm(cell) if isinstance(cell, str) else cell for cell in row] for row in rows
    )
    return text.getvalue()


def _disarm(cell: str) -> str:
    cell = _INNER_FORMULA.sub(r"\1'\2", cell.replace("\r", " "))  # \r would end a row
    if not cell.lstrip().startswith(("=", "+", "-", "@")):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
