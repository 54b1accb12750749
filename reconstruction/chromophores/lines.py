"""Lines of equal melanin over a color table, along which posteriors are integrated.

Both axes run evenly in the cube root of the volume fraction over its largest, from
`MIN_AXIS_FRACTION` to 1.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.color_table import ColorTable
from reconstruction.arrays import Float64Array
from reconstruction.chromophores.start import MIN_AXIS_FRACTION, evaluate_table

N_LINES = 49
"""Number of lines, each at one melanin value."""
N_LINE_NODES = 65
"""Blood values at which each line's colors are stored."""
NODES_PER_LINE = 32
"""Nodes of melanin's probability per line interval."""
MELANIN_AXIS = np.linspace(float(MIN_AXIS_FRACTION), 1.0, (N_LINES - 1) * NODES_PER_LINE + 1)
"""Fractions of the melanin axis, its cube root, at these nodes."""


@dataclass(frozen=True, slots=True, eq=False)
class EqualMelaninLines:
    """Log colors of skin along lines of equal melanin, each array (LINES, NODES, 3)."""

    log_rgb: Float64Array
    """Natural logarithm of the color over that of a white reference."""
    by_a: Float64Array
    """Derivative by the fraction of the melanin axis."""
    by_b: Float64Array
    """Derivative by the fraction of the blood axis."""


@lru_cache(maxsize=16)
def equal_melanin_lines(table: ColorTable) -> EqualMelaninLines:
    """Return the lines of a table, cached for the tables used last."""
    low = float(MIN_AXIS_FRACTION)
    a, b = np.meshgrid(
        np.linspace(low, 1.0, N_LINES), np.linspace(low, 1.0, N_LINE_NODES), indexing="ij"
    )
    color, by_a, by_b = evaluate_table(table, a, b)
    return EqualMelaninLines(np.log(color), by_a / color, by_b / color)
