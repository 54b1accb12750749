"""Color of a face in the viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from skinrig.arrays import Float64Array

RIG_PX: Final = 256
"""Cells a side of the scale and bias maps (Jimenez 2010, section 6)."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceColor:
    """Chromophores of a face on its texture, and its hemoglobin rig.

    Attributes
    ----------
    melanin, hemoglobin : ndarray of float64, shape (N, N)
        Volume fractions in the neutral state, known everywhere.
    states : mapping of str to ndarray of float64, shape (h, w, 2)
        Scale and bias by state, "neutral" first.
    global_states
        Those of the whole body.
    facts
        How they came to lie on the texture; JSON values.
    left_out
        What could not be placed.
    """

    melanin: Float64Array
    hemoglobin: Float64Array
    states: Mapping[str, Float64Array]
    global_states: tuple[str, ...]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...] = ()
