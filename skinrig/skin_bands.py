"""Skin color in bands: the individual typology angle of white-balanced reflectance."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model import metrics

BANDS: Final = ("very light", "light", "intermediate", "tan", "brown", "dark")
EDGES_DEG: Final = (55.0, 41.0, 28.0, 10.0, -30.0)
"""Angles above which each but the last begins (Chardon et al. 1991, see `model.metrics`)."""

SRGB_TO_XYZ: Final = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
"""IEC 61966-2-1, D65."""


def typology_angle_deg(reflectance: ArrayLike) -> NDArray[np.float64]:
    """Return the individual typology angle of reflectances.

    Parameters
    ----------
    reflectance
        (..., 3), camera RGB over that of a perfect white, taken for linear sRGB.

    Returns
    -------
    ndarray
        (...), degrees; high is light.

    Examples
    --------
    >>> typology_angle_deg([[0.6, 0.45, 0.36], [0.05, 0.03, 0.02]]).round(0).tolist()
    [64.0, -73.0]
    """
    rgb = np.maximum(np.asarray(reflectance, np.float64), 0.0)
    matrix = np.array(SRGB_TO_XYZ)
    xyz = rgb @ matrix.T / matrix.sum(axis=1)
    edge = 6.0 / 29.0
    root = np.where(xyz > edge**3, np.cbrt(xyz), xyz / (3.0 * edge**2) + 4.0 / 29.0)
    lightness = 116.0 * root[..., 1] - 16.0
    b_star = 200.0 * (root[..., 1] - root[..., 2])
    return np.asarray(metrics.individual_typology_angle_deg(lightness, b_star))


def bands_of(angle_deg: ArrayLike) -> NDArray[np.str_]:
    """Return the names of the bands that angles lie in.

    Examples
    --------
    >>> bands_of([60.0, 30.0, -31.0]).tolist()
    ['very light', 'intermediate', 'dark']
    """
    angle = np.asarray(angle_deg, np.float64)
    return np.array(BANDS)[np.searchsorted(-np.array(EDGES_DEG), -angle)]
