"""Errors of a surface's normals and reflectance by skin color."""

from __future__ import annotations

import numpy as np

from model.skin import SkinAppearance
from skinrig.evaluating import skin_bands
from skinrig.evaluating import surface as evaluation

Banded = tuple[str, str, str, int, float, float, float]
"""Map, unit, band, points, masked %, median and 95th percentile of the absolute error."""
MIN_POINTS = 20
"""Of a band that is told."""


def errors_by_band(appearance: SkinAppearance, truth: SkinAppearance) -> list[Banded]:
    """Return errors of normals and R_d by skin color, from light to dark; R_d, mean of channels.

    Parameters
    ----------
    appearance, truth
        As for `section`; a truth without "r_d" has no color to tell bands by.
    """
    if "r_d" not in truth.maps:
        return []
    pairs = evaluation.match(appearance, truth)
    true_color = truth.maps["r_d"].values.reshape(-1, 3)[pairs.truth].astype(np.float64)
    bands = skin_bands.bands_of(skin_bands.typology_angle_deg(true_color))
    rows: list[Banded] = []
    for key in ("r_d", *evaluation.NORMAL_MAPS):
        if key not in appearance.maps or (key != "r_d" and "normals" not in truth.maps):
            continue
        error = np.abs(evaluation.errors_at(key, appearance, truth, pairs))
        for band in skin_bands.TYPOLOGY_NAMES:
            own = error[bands == band]
            told = own[np.isfinite(own)]
            if len(own) < MIN_POINTS or not len(told):
                continue
            unit = "%" if key == "r_d" else "°"
            masked = 100.0 * (1.0 - len(told) / len(own))
            middle, high = np.percentile(told, [50, 95])
            rows.append((key, unit, band, len(own), masked, float(middle), float(high)))
    return rows
