"""Read named points of an image or a mesh from a user's table."""

import csv
import math
from pathlib import Path

LANDMARK_COLUMNS = ("name", "x", "y")
POINT_COLUMNS = ("name", "x", "y", "z")


class LandmarkError(ValueError):
    """A table of landmarks that cannot be read."""


def read_landmark_table(path: str | Path) -> dict[str, tuple[float, float]]:
    """Read named points of an image from a CSV file with the header ``name,x,y``.

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
    return {name: (x, y) for name, (x, y) in _read_table(path, LANDMARK_COLUMNS).items()}


def read_point_table(path: str | Path) -> dict[str, tuple[float, float, float]]:
    """Read named points of a mesh from a CSV file with the header ``name,x,y,z``.

    Parameters
    ----------
    path
        The table, otherwise as in `read_landmark_table`.

    Returns
    -------
    dict
        Name to (x, y, z), in the frame and unit of the mesh.

    Raises
    ------
    LandmarkError
        As in `read_landmark_table`.
    """
    return {name: (x, y, z) for name, (x, y, z) in _read_table(path, POINT_COLUMNS).items()}


def _read_table(path: str | Path, columns: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    """Return the coordinates by name of a table with these columns."""
    found: dict[str, tuple[float, ...]] = {}
    lines: dict[str, int] = {}
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise LandmarkError(f"{path}: got another encoding, expected UTF-8; save it so") from error
    header, expected = False, ", ".join(columns)
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        cells = [cell.strip() for cell in next(csv.reader([line]))]
        if not header:
            if cells != list(columns):
                raise LandmarkError(
                    f"{where}: got columns {cells}, expected {expected}; correct the header "
                    "[SR-REC-021]"
                )
            header = True
            continue
        if len(cells) != len(columns):
            got = f"got {len(cells)} cells, expected {len(columns)}: {expected}"
            raise LandmarkError(f"{where}: {got}; correct the line")
        name = cells[0]
        if not name:
            raise LandmarkError(f"{where}, column name: got an empty name; fill it in")
        if name in found:
            raise LandmarkError(
                f"{where}, column name: got {name!r} twice, first in line {lines[name]}; remove one"
            )
        found[name] = tuple(
            _number(cells[k], f"{where}, column {columns[k]}") for k in range(1, len(columns))
        )
        lines[name] = number
    if not header:
        raise LandmarkError(f"{path}: is empty, expected the columns {expected}; fill it in")
    return found


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise LandmarkError(f"{where}: got {cell!r}, expected a number; correct it") from error
    if not math.isfinite(value):
        raise LandmarkError(f"{where}: got {cell!r}, expected a finite number; correct it")
    return value
