"""Specular or diffuse reflection of the patterns, separated by polarization."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import BoolArray
from reconstruction.gradient_normals.moments import Reflection, prepare, with_shared_dark
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.gradient_normals.patterns import Key, collect
from reconstruction.gradient_normals.sphere_lights import SphereLights

_log = logging.getLogger(__name__)

Variance = float | SensorNoise | Mapping[Key, ArrayLike] | None
Valid = BoolArray | Mapping[Key, BoolArray] | None

MAX_MEDIAN_LEAKAGE = 0.02
"""Median leakage from which polarizers do not cross well: 8 degrees off."""


def separate_reflection(
    patterns: Mapping[Key, ArrayLike],
    component: Literal["specular", "diffuse"],
    variance: Variance,
    valid: Valid,
    saturation: float | None,
    lights: SphereLights | None,
    smooth_px: float,
    smooth_crossed_px: float | None,
) -> Reflection:
    """Return the moments of one component's reflection, corrected for leaking polarizers."""
    noise = variance if isinstance(variance, SensorNoise) else None
    stacks = collect(
        patterns,
        variance=None if isinstance(variance, SensorNoise) else variance,
        valid=valid,
        saturation=saturation,
    )
    leakage = 0.0
    if lights is not None:
        # lights near Brewster's angle reflect next to nothing, most of it crossed: not a mean
        leakage = float(np.median(lights.leakage[lights.intensities > 0]))
        if leakage > MAX_MEDIAN_LEAKAGE:
            _warn_of_leakage(round(leakage, 4))
    return prepare(
        with_shared_dark(stacks),
        component,
        noise=noise,
        leakage=leakage,
        smooth_px=smooth_px,
        smooth_crossed_px=smooth_crossed_px,
    )


@lru_cache(maxsize=64)
def _warn_of_leakage(leakage: float) -> None:
    """Say once for all pictures of one sphere how much passes crossed polarizers."""
    _log.warning(
        "polarizers leak: crossed pictures hold %.1f %% of the specular reflection, as if the"
        " analyser were %.0f degrees off; corrected, at the price of signal",
        100.0 * leakage,
        np.degrees(np.arctan(np.sqrt(leakage))),
    )
