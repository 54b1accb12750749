"""Read tables of face labels: binary traits and continuous values by name."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skinrig.arrays import BoolArray, Float64Array
from skinrig.errors import UnusableError


@dataclass(frozen=True, slots=True, eq=False)
class TraitLabels:
    """Labels of n faces.

    Attributes
    ----------
    names
        Names of the faces, n.
    binary
        Trait to (n,) bool.
    continuous
        Trait to (n,) float.
    ignored
        Names of the table that are not among the faces.
    """

    names: tuple[str, ...]
    binary: dict[str, BoolArray]
    continuous: dict[str, Float64Array]
    ignored: tuple[str, ...]


def read(path: Path, faces: Sequence[str]) -> TraitLabels:
    """Read a table of labels for the given faces.

    Parameters
    ----------
    path
        CSV with the header ``name,TRAIT,...``. A column of only 0 and 1 is a binary trait, any
        other column of numbers a value such as an age. Lines that begin with ``#`` are skipped.
    faces
        Names that the table must contain, in the order of the result.

    Raises
    ------
    UnusableError
        With line and column.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnusableError(f"{path}: is not UTF-8 text; save it as UTF-8 CSV") from error
    rows = [
        (number, [cell.strip() for cell in next(csv.reader([line]))])
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise UnusableError(f"{path}: is empty, expected a line name,TRAIT,...; add it")
    header = rows[0][1]
    traits = header[1:]
    if header[0] != "name" or not traits:
        raise UnusableError(
            f"{path}, line {rows[0][0]}: got columns {header}, expected name,TRAIT,..."
        )
    if len(set(header)) < len(header) or not all(header):
        twice = next(c for c in header if header.count(c) > 1 or not c)
        raise UnusableError(f"{path}: column {twice!r} occurs twice or has no name; rename it")
    values: dict[str, list[float]] = {}
    for number, cells in rows[1:]:
        where = f"{path}, line {number}"
        if len(cells) != len(header):
            raise UnusableError(
                f"{where}: got {len(cells)} cells, expected {len(header)}; correct the line"
            )
        cells[0] = cells[0].removeprefix("appearance-")
        if cells[0] in values:
            raise UnusableError(f"{where}: {cells[0]!r} occurs twice; remove one line")
        values[cells[0]] = [
            _number(cell, f"{where}, column {trait}")
            for cell, trait in zip(cells[1:], traits, strict=True)
        ]
    missing = [name for name in faces if name not in values]
    if missing:
        raise UnusableError(
            f"{path}: has no line for {', '.join(missing)}, only for "
            f"{', '.join(list(values)[:5])}, ...; use the names of the folders, with or without "
            "appearance-"
        )
    table = np.array([values[name] for name in faces], np.float64)
    whole = np.array(list(values.values()), np.float64)
    kinds = [bool(np.isin(column, (0.0, 1.0)).all()) for column in whole.T]
    return TraitLabels(
        tuple(faces),
        {t: table[:, k] > 0.5 for k, t in enumerate(traits) if kinds[k]},
        {t: table[:, k] for k, t in enumerate(traits) if not kinds[k]},
        tuple(name for name in values if name not in faces),
    )


def _number(cell: str, location: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise UnusableError(
            f"{location}: got {cell!r}, expected 0, 1 or a number; correct it"
        ) from error
    if not math.isfinite(value):
        raise UnusableError(f"{location}: got {cell!r}, expected a finite number; correct it")
    return value
