"""Fill the gaps of a fused person's colors and translucency from measured texels around them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from model.skin import SkinMap
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import FloatArray
from skinrig.fusing.filled_normals import MAX_GAP_DISTANCE_MM, MEASURED_SUFFIX, N_NEIGHBORS
from skinrig.fusing.maps import OWN_SUFFIX

LOG_SPREAD_FACTORS: Final[Mapping[str, float]] = {
    "r_d": 1.9,
    "melanin": 2.5,
    "melanin_optical_depth": 2.5,
    "hemoglobin": 2.5,
    "translucency": 2.5,
}
"""Standard error of the logarithm of a filled value over the spread of its neighbors' logarithms.

Set on three simulated faces, of types I, IV and VI, see docs/validation/fusion.md; that of the
translucency, which has no ground truth per texel, is assumed."""


def fill_skin(maps: Mapping[str, SkinMap], position: SkinMap | None) -> dict[str, SkinMap]:
    """Fill gaps of R_d, melanin and blood whose neighborhood is measured.

    Few images show places such as the sides of the nose or the folds of lips and brows. A filled
    value is the geometric mean of the nearest measured ones. Its relative standard error is that of
    these texels, and their spread times `LOG_SPREAD_FACTORS`.

    Parameters
    ----------
    maps
        Fused maps with standard errors, of H x W texels.
    position
        Surface points of the same texels, mm; None: nothing is filled.

    Returns
    -------
    dict of str to SkinMap
        The same maps; those with filled texels also have a map of `MEASURED_SUFFIX`: 1 where a
        value is measured, 0 where it is filled.
    """
    found = dict(maps)
    for name, factor in LOG_SPREAD_FACTORS.items():
        one = maps.get(name)
        if one is None or position is None:
            continue
        own = maps.get(f"{name}{OWN_SUFFIX}")
        found |= _fill_map(name, one, own, position, factor)
    return found


def _fill_map(
    name: str, one: SkinMap, own: SkinMap | None, position: SkinMap, factor: float
) -> dict[str, SkinMap]:
    """Return a map, its errors of texels alone and its measured texels; nothing without a gap."""
    values = one.values if one.values.ndim == 3 else one.values[..., None]
    known = intersect_valid(one, position) & (values > 0.0).all(axis=-1)
    gap = intersect_valid(position) & ~known
    if one.stderr is None or not gap.any() or np.count_nonzero(known) < N_NEIGHBORS:
        return {}
    tree = cKDTree(position.values[known])
    distance, near = tree.query(position.values[gap], k=N_NEIGHBORS, workers=1)
    close = distance[:, 0] < MAX_GAP_DISTANCE_MM
    if not close.any():
        return {}
    gap[gap], near = close, near[close]
    around = np.log(values[known].astype(np.float64))[near]
    filled, spread = np.exp(around.mean(axis=1)), factor * around.std(axis=1)

    def widen(errors: FloatArray) -> FloatArray:
        """Return standard errors with those of the gaps."""
        image = errors.copy().reshape(values.shape)
        relative = np.median((image[known] / values[known])[near], axis=1)
        image[gap] = filled * np.hypot(relative, spread)
        return image.reshape(errors.shape)

    shown = values.copy()
    shown[gap] = filled
    whole, note = known | gap, f"{one.description}, gaps filled from measured neighbors"
    measured = SkinMap(
        known.astype(np.float32), "1", valid=whole, description="1: measured; 0: filled"
    )
    found = {
        name: SkinMap(shown.reshape(one.values.shape), one.unit, widen(one.stderr), whole, note),
        f"{name}{MEASURED_SUFFIX}": measured,
    }
    if own is not None:
        found[f"{name}{OWN_SUFFIX}"] = replace(own, values=widen(own.values), valid=whole)
    return found
