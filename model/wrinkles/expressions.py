"""Weights of wrinkle zones by expression, and their sums over blend shapes.

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1 (table 1.1, section 1.2). ISBN 978-1-56881-718-7
"""

import csv
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks

Clamp: TypeAlias = Literal["unit", "signed"]

ZONE_SUM_LIMITS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"unit": (0.0, 1.0), "signed": (-1.0, 1.0)}
)
"""Range of a zone's sum over blend shapes: "unit" is the paper's [0, 1], in which an expression
that only flattens (anger's forehead) has no effect; "signed" keeps the sign."""

ROW_OF_STATE: Mapping[str, str | None] = MappingProxyType(
    {
        "neutral": None,
        "anger": "anger",
        "disgust": "disgust",
        "fear": "fear",
        "happiness": "joy",
        "sadness": "sad",
        "surprise": "surprise",
        "smile": "joy",
        "exercise": None,
        "alcohol": None,
    }
)
"""Row of table 1.1 for each state of facial color; None: no wrinkles. The table has no smile: joy
is nearest, but wrinkles the forehead more than a posed smile."""


class WrinkleError(ValueError):
    """Error for maps, masks, tables or weights of wrinkles that do not fit together."""


@dataclass(frozen=True, slots=True)
class ExpressionTable:
    """Weights of zones, one row per expression.

    Attributes
    ----------
    zones : tuple of str
        Names of the zones in the order of the masks.
    rows : mapping of str to tuple of float
        One finite number per zone; a weight of 1 adds the wrinkle map unscaled.
    source : str
        Source of the numbers.

    Examples
    --------
    >>> JIMENEZ2011_TABLE.rows["anger"][:4]
    (-0.6, -0.6, -0.8, -0.8)
    """

    zones: tuple[str, ...]
    rows: Mapping[str, tuple[float, ...]]
    source: str = ""

    def __post_init__(self) -> None:
        """Raise for repeated zones and rows of another length or without numbers."""
        zones = tuple(str(zone) for zone in self.zones)
        if not zones or len(set(zones)) != len(zones):
            raise WrinkleError(f"zones: got {zones}, expected names that differ")
        rows = {}
        for name, row in self.rows.items():
            values = tuple(float(value) for value in row)
            if len(values) != len(zones) or not all(math.isfinite(value) for value in values):
                raise WrinkleError(
                    f"rows[{name!r}]: got {values}, expected {len(zones)} finite weights"
                )
            rows[str(name)] = values
        object.__setattr__(self, "zones", zones)
        object.__setattr__(self, "rows", MappingProxyType(rows))

    def row(self, expression: str) -> Float64Array:
        """Return the weights of one expression, (Z,)."""
        if expression not in self.rows:
            near = difflib.get_close_matches(expression, self.rows, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise WrinkleError(
                f"expression: got {expression!r}, expected one of {', '.join(self.rows)}{hint}"
            )
        return np.array(self.rows[expression])


def read_table(text: str) -> ExpressionTable:
    r"""Read a table of weights: a header ``expression,<zone>,...``, then one row per expression.

    Parameters
    ----------
    text : str
        CSV; lines that begin with # are comments and become the source.

    Raises
    ------
    WrinkleError
        For text of another form.

    Examples
    --------
    >>> read_table("expression,left,right\nwink,1,0\n").rows["wink"]
    (1.0, 0.0)
    """
    lines = text.splitlines()
    source = "\n".join(line[1:].strip() for line in lines if line.startswith("#"))
    rows = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    if not rows or len(rows[0]) < 2 or rows[0][0].strip() != "expression":
        raise WrinkleError(
            f"table: got head {rows[:1]}, expected expression and the names of zones"
        )
    names = [row[0].strip() for row in rows[1:]]
    if len(set(names)) != len(names):
        raise WrinkleError(f"table: got expressions {names}, expected each once")
    try:
        weights = {row[0].strip(): tuple(float(cell) for cell in row[1:]) for row in rows[1:]}
    except ValueError as error:
        raise WrinkleError(f"table: got a weight that is not a number: {error}") from error
    return ExpressionTable(tuple(cell.strip() for cell in rows[0][1:]), weights, source)


JIMENEZ2011_TABLE = read_table(
    resources.files("model").joinpath("data/jimenez2011_table1_1.csv").read_text("utf-8")
)
"""Table 1.1: joy, surprise, fear, anger, disgust and sad over eight zones."""

Table: TypeAlias = ExpressionTable | Mapping[str, Sequence[float]]
Weights: TypeAlias = Mapping[str, float] | ArrayLike


def as_table(table: Table) -> ExpressionTable:
    """Return a table; a plain mapping of rows is one of the eight zones of the paper."""
    if isinstance(table, ExpressionTable):
        return table
    return ExpressionTable(JIMENEZ2011_TABLE.zones, {n: tuple(row) for n, row in table.items()})


def zone_sums(weights: Weights, table: Table = JIMENEZ2011_TABLE) -> Float64Array:
    """Return each zone's sum over blend shapes, before any clamp.

    Parameters
    ----------
    weights : mapping of str to float, or array_like, shape (Z,)
        Weight of each blend shape that is a row of the table, any number of them; or the sums.
    table : ExpressionTable or mapping of str to Z floats

    Returns
    -------
    ndarray, shape (Z,), float64

    Examples
    --------
    >>> zone_sums({"surprise": 1, "anger": 1})[:4].round(9).tolist()
    [0.2, 0.2, 0.0, 0.0]
    """
    if isinstance(weights, Mapping):
        rows = as_table(table)
        total = np.zeros(len(rows.zones))
        for name, weight in weights.items():
            Checks(WrinkleError).within(f"weights[{name!r}]", weight)
            total += float(weight) * rows.row(name)
        return total
    sums = np.array(weights, np.float64)
    return Checks(WrinkleError).numbers("weights (blend shapes by name, or by zone)", sums, ("Z",))


def clamp_sums(sums: ArrayLike, clamp: Clamp = "unit") -> Float64Array:
    """Return sums clamped to the range of `ZONE_SUM_LIMITS`; callers report changed sums.

    Examples
    --------
    >>> clamp_sums([-0.6, 0.2, 1.7]).tolist(), clamp_sums([-0.6, 0.2, 1.7], "signed").tolist()
    ([0.0, 0.2, 1.0], [-0.6, 0.2, 1.0])
    """
    Checks(WrinkleError).choice("clamp", clamp, ZONE_SUM_LIMITS)
    return np.clip(np.asarray(sums, np.float64), *ZONE_SUM_LIMITS[clamp])
