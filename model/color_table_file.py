"""Write and read color tables (Jimenez 2010, eq. 7): OpenEXR images and CSV, on cube-root axes.

An image has melanin along its columns, from left to right, and blood along its rows, from bottom to
top: texture coordinates are u = cbrt(C_m / c_m_max) and v = cbrt(C_hd / c_hd_max). A CSV file has
one node per row. Both hold the table's description; a file without one is a table of Table 1's
ranges.
"""

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.arrays import Float64Array
from model.checks.files import decode_json
from model.color_table import ColorTable, ColorTableError
from model.tissue_optics.constants import TissueConstants, TissueError

SCHEMA: Final = "skinrig.color-table/1"
DESCRIPTION_ATTRIBUTE: Final = "skinrigColorTable"
"""Attribute of an image's header that holds the description."""
CSV_COLUMNS: Final = ("cbrt_c_m", "cbrt_c_hd", "c_m", "c_hd", "red", "green", "blue")
FILE_SUFFIXES: Final = (".exr", ".csv")
IMAGE_ORIENTATION: Final = "columns: cbrt of melanin, from 0; rows: cbrt of blood, 0 at the bottom"
UNKNOWN_ORIGIN: Final = "not named in the file"


def write_color_table(path: str | Path, table: ColorTable) -> None:
    """Write a table as an image or as CSV, by the file's suffix.

    Parameters
    ----------
    path
        File NAME.exr (32-bit float) or NAME.csv (all digits); an older one is replaced.
    table
        The table. Its covariance of optics is not written.

    Raises
    ------
    ColorTableError
        For another suffix.
    StoreError
        If an image cannot be written.
    """
    path = Path(path)
    description = json.dumps(
        {
            "schema": SCHEMA,
            "camera": table.camera,
            "illuminant": table.illuminant,
            "c_m_max": table.c_m_max,
            "c_hd_max": table.c_hd_max,
            "anisotropy": table.anisotropy,
            "constants": dataclasses.asdict(table.constants),
        }
    )
    if _suffix(path) == ".exr":
        image = table.rgb.transpose(1, 0, 2)[::-1]  # row 0: most blood
        header = {DESCRIPTION_ATTRIBUTE: description, "comments": IMAGE_ORIENTATION}
        store.write_exr(path, image.astype(np.float32), attributes=header)
        return
    ends = np.cbrt([table.c_m_max, table.c_hd_max])
    axes = [np.linspace(0.0, end, table.size) for end in ends]
    u, v = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    nodes = np.column_stack([u, v, u**3, v**3, table.rgb.reshape(-1, 3)])
    text = io.StringIO()
    text.write(f"# {description}\n")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(CSV_COLUMNS)
    rows.writerows([repr(float(value)) for value in row] for row in nodes)
    path.write_text(text.getvalue(), encoding="utf-8")


def read_color_table(path: str | Path) -> ColorTable:
    """Read a table from an image or CSV file.

    Parameters
    ----------
    path
        File NAME.exr or NAME.csv, as written by `write_color_table`, or an image without its
        description: square, RGB, with Table 1's ranges.

    Returns
    -------
    ColorTable
        Without a covariance of optics.

    Raises
    ------
    ColorTableError
        For another suffix, shape, axis or description.
    StoreError
        If an image cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> from model import color_table
    >>> made = color_table.build("linear sRGB", "D65", size=8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_color_table(Path(folder) / "table.csv", made)
    ...     bool(np.all(read_color_table(Path(folder) / "table.csv").rgb == made.rgb))
    True
    """
    path = Path(path)
    if _suffix(path) == ".exr":
        image, attributes = store.read_exr_with_attributes(path)
        rgb = np.asarray(image, np.float64)
        if rgb.ndim != 3 or rgb.shape[0] != rgb.shape[1]:
            raise ColorTableError(f"{path}: got shape {rgb.shape}, expected a square RGB image")
        nodes, text = rgb[::-1].transpose(1, 0, 2), attributes.get(DESCRIPTION_ATTRIBUTE)
    else:
        nodes, text = _read_nodes(path)
    return _table(path, nodes, text)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in FILE_SUFFIXES:
        raise ColorTableError(
            f"{path}: got suffix {path.suffix!r}, expected {' or '.join(FILE_SUFFIXES)}; rename it"
        )
    return suffix


def _read_nodes(path: Path) -> tuple[Float64Array, str | None]:
    """Return colors (size, size, 3) and the description of a CSV file, with its axes checked."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ColorTableError(f"{path}: cannot be read ({error}); name a CSV file") from error
    text = lines.pop(0)[1:] if lines and lines[0].startswith("#") else None
    if not lines or tuple(lines[0].split(",")) != CSV_COLUMNS:
        got = lines[0] if lines else "nothing"
        raise ColorTableError(f"{path}: got columns {got}, expected {','.join(CSV_COLUMNS)}")
    try:
        rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    except ValueError as error:
        raise ColorTableError(f"{path}: {error}, expected numbers") from error
    size = round(len(rows) ** 0.5)
    if rows.shape != (size * size, len(CSV_COLUMNS)) or size < 2:
        raise ColorTableError(f"{path}: got shape {rows.shape}, expected the nodes of a square")
    u, v = (axis.reshape(size, size) for axis in rows[:, :2].T)
    even = np.linspace(0.0, 1.0, size)
    regular = np.allclose(u, even[:, None] * u[-1, -1]) and np.allclose(v, even * v[-1, -1])
    if not regular:
        raise ColorTableError(
            f"{path}: got other nodes, expected an even grid of cube roots, melanin slowest"
        )
    return rows[:, 4:].reshape(size, size, 3), text


def _table(path: Path, nodes: Float64Array, text: str | None) -> ColorTable:
    """Return the table of colors and a description; without one, with Table 1's ranges."""
    if text is None:
        return ColorTable(UNKNOWN_ORIGIN, UNKNOWN_ORIGIN, nodes)
    try:
        found: dict[str, Any] = decode_json(text)
        if found.pop("schema") != SCHEMA:
            raise ValueError("another schema")
        constants = TissueConstants(**found.pop("constants"))
        return ColorTable(rgb=nodes, constants=constants, **found)
    except ColorTableError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, TissueError) as error:
        raise ColorTableError(
            f"{path}: got a description that is not of {SCHEMA} ({error}); write the file again"
        ) from error
