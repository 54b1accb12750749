"""Read named points of an image from a user's table ``name,x,y``."""

import csv
import math
from pathlib import Path

LANDMARK_COLUMNS = ("name", "x", "y")


class LandmarkError(ValueError):
    """A table of landmarks that cannot be read."""


def read_landmark_table(path: str | Path) -> dict[str, tuple[float, float]]:
    """Read named points from a CSV file with the header ``name,x,y``.

    Parameters
    ----------
    path
        The table. Lines that begin with ``#`` and empty ones are skipped.

    Returns
    -------
    dict
        Name to (x, y), px: x to the right and y down from the center of the upper left pixel.

    Raises
    ------
    LandmarkError
        For another header, an empty or repeated name, or a coordinate that is not a finite number;
        the message names line and column.
    """
    found: dict[str, tuple[float, float]] = {}
    lines: dict[str, int] = {}
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise LandmarkError(f"{path}: got another encoding, expected UTF-8; save it so") from error
    header = False
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        cells = [cell.strip() for cell in next(csv.reader([line]))]
        if not header:
            if cells != list(LANDMARK_COLUMNS):
                raise LandmarkError(
                    f"{where}: got columns {cells}, expected name, x, y; correct the header "
                    "[SR-REC-021]"
                )
            header = True
            continue
        if len(cells) != len(LANDMARK_COLUMNS):
            got = f"got {len(cells)} cells, expected 3: name, x, y"
            raise LandmarkError(f"{where}: {got}; correct the line")
        name = cells[0]
        if not name:
            raise LandmarkError(f"{where}, column name: got an empty name; fill it in")
        if name in found:
            raise LandmarkError(
                f"{where}, column name: got {name!r} twice, first in line {lines[name]}; remove one"
            )
        x, y = (_number(cells[k], f"{where}, column {LANDMARK_COLUMNS[k]}") for k in (1, 2))
        found[name], lines[name] = (x, y), number
    if not header:
        raise LandmarkError(f"{path}: is empty, expected the columns name, x, y; fill it in")
    return found


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise LandmarkError(f"{where}: got {cell!r}, expected a number; correct it") from error
    if not math.isfinite(value):
        raise LandmarkError(f"{where}: got {cell!r}, expected a finite number; correct it")
    return value
