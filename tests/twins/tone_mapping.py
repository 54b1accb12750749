"""From linear light to what a display is sent: the sRGB curve, and a filmic one before it.

References
----------
IEC 61966-2-1:1999 (sRGB).
Hable 2010, Uncharted 2: HDR lighting, Game Developers Conference (the filmic operator that
Jimenez et al. 2011 use, "which yields really crisp blacks").
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array

SHOULDER_STRENGTH: Final = 0.15
LINEAR_STRENGTH: Final = 0.50
LINEAR_ANGLE: Final = 0.10
TOE_STRENGTH: Final = 0.20
TOE_NUMERATOR: Final = 0.02
TOE_DENOMINATOR: Final = 0.30
LINEAR_WHITE: Final = 11.2
"""Light, after the bias, that is shown as white."""
EXPOSURE_BIAS: Final = 2.0
MAX_LIGHT: Final = 1e20
"""More is shown as this much: the curve is level there, and its squares overflow far beyond."""


def srgb_encoded(linear: ArrayLike) -> Float64Array:
    """Return linear sRGB as a display is sent it, any shape, in [0, 1].

    Parameters
    ----------
    linear
        Linear light; what lies outside [0, 1] is clipped. NaN stays NaN.

    Examples
    --------
    >>> srgb_encoded([0.0, 0.18, 1.0, 3.0]).round(4).tolist()
    [0.0, 0.4614, 1.0, 1.0]
    """
    c = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1.0 / 2.4) - 0.055)


def filmic(linear: ArrayLike) -> Float64Array:
    """Return Hable's filmic operator, still linear: 0 stays 0, 5.6 becomes 1.

    Parameters
    ----------
    linear
        Linear light, any shape, infinite too; what is below 0 counts as 0. NaN stays NaN.

    Examples
    --------
    >>> filmic([0.0, 0.18, 5.6]).round(4).tolist()
    [0.0, 0.1283, 1.0]
    """
    x = EXPOSURE_BIAS * np.clip(np.asarray(linear, np.float64), 0.0, MAX_LIGHT)
    return np.asarray(_curve(x) / _curve(np.float64(LINEAR_WHITE)))


def _curve(x: Float64Array | np.float64) -> Float64Array:
    A, B, C = SHOULDER_STRENGTH, LINEAR_STRENGTH, LINEAR_ANGLE
    D, E, F = TOE_STRENGTH, TOE_NUMERATOR, TOE_DENOMINATOR
    return np.asarray((x * (A * x + C * B) + D * E) / (x * (A * x + B) + D * F) - E / F)
