"""Fill the gaps of a fused person's colors and translucency from measured texels around them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
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
ASSUMED_DISTANCE_MM: Final[Mapping[str, float]] = {"translucency": 4.0}
"""Maximum distance to a measured texel in maps whose factor is assumed."""
MAX_CANDIDATES: Final = 64 * N_NEIGHBORS
"""Maximum number of nearest texels of which `N_NEIGHBORS` must face the same way."""


def fill_skin(
    maps: Mapping[str, SkinMap], position: SkinMap | None, normals: SkinMap | None = None
) -> dict[str, SkinMap]:
    """Fill gaps of R_d, melanin, blood and translucency whose neighborhood is measured.

    Few images show places such as the sides of the nose or the folds of lips and brows. A filled
    value is the geometric mean of the nearest measured ones. Its relative standard error is that of
    these texels, and their spread times `LOG_SPREAD_FACTORS`.

    Parameters
    ----------
    maps
        Fused maps with standard errors, of H x W texels.
    position
        Surface points of the same texels, mm; None: nothing is filled.
    normals
        Unit normals of the same texels, with values in gaps, too. Texels whose normals differ by
        more than 90 degrees do not fill each other, as those of two lips; None: all do.

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
        found |= _fill_map(name, one, own, position, normals, factor)
    return found


def _fill_map(
    name: str,
    one: SkinMap,
    own: SkinMap | None,
    position: SkinMap,
    normals: SkinMap | None,
    factor: float,
) -> dict[str, SkinMap]:
    """Return a map, its errors of texels alone and its measured texels; nothing without a gap."""
    values = one.values if one.values.ndim == 3 else one.values[..., None]
    known = intersect_valid(one, position) & (values > 0.0).all(axis=-1)
    gap = intersect_valid(position) & ~known
    if one.stderr is None or not gap.any() or np.count_nonzero(known) < N_NEIGHBORS:
        return {}
    tree = cKDTree(position.values[known])
    facing = None if normals is None else (normals.values[gap], normals.values[known])
    distance, near = _find_neighbors(tree, position.values[gap], facing)
    close = distance < ASSUMED_DISTANCE_MM.get(name, MAX_GAP_DISTANCE_MM)
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


def _find_neighbors(
    tree: cKDTree, places_mm: FloatArray, normals: tuple[FloatArray, FloatArray] | None
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the distance to the nearest texel, (G,), and `N_NEIGHBORS` nearest ones, (G, n).

    With normals of the places and of the tree's texels, these are texels that face the same way;
    the distance is infinite where there are too few among `MAX_CANDIDATES`.
    """
    count, most = N_NEIGHBORS, min(MAX_CANDIDATES, len(tree.data))
    distance_mm, near = tree.query(places_mm, k=count, workers=1)
    if normals is None:
        return distance_mm[:, 0], near
    nearest_mm = np.full(len(places_mm), np.inf)
    rows = np.arange(len(places_mm))
    while len(rows):
        distance_mm, found = tree.query(places_mm[rows], k=count, workers=1)
        faces = np.einsum("gk,gnk->gn", normals[0][rows], normals[1][found]) >= 0.0
        first = np.argsort(~faces, axis=1, kind="stable")[:, :N_NEIGHBORS]
        enough = np.count_nonzero(faces, axis=1) >= N_NEIGHBORS
        near[rows[enough]] = np.take_along_axis(found, first, 1)[enough]
        nearest_mm[rows[enough]] = np.take_along_axis(distance_mm, first, 1)[enough, 0]
        rows = rows[~enough & (count < most)]
        count = min(4 * count, most)
    return nearest_mm, near
