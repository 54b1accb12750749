"""Fill the gaps of a face's normals from measured normals around them, with a stated error."""

from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from model.skin import SkinMap
from model.vectors import unit_vectors
from skinrig.appearances.contents import intersect_valid

MEASURED_SUFFIX: Final = "_measured"
"""Suffix of maps of which normals are measured, not filled."""
N_NEIGHBORS: Final = 12
"""Measured texels around a gap's texel whose normals give its error."""
MAX_GAP_DISTANCE_MM: Final = 12.0
"""Texels farther from the next measured one stay masked: errors were not measured beyond.

See docs/validation/fusion.md; maps without measured errors have a limit of their own."""
SPREAD_FACTOR: Final = 0.46
"""Standard error of a filled normal over the spread of the measured normals around it.

Set on nine simulated faces, see docs/validation/fusion.md."""
BEND_RAD_PER_MM: Final = 0.012
"""Standard error of a filled normal per mm to the next measured one: the surface bends on.

Set on gaps drawn on four simulated heads, see docs/validation/fusion.md."""


def fill_normals(normals: SkinMap, position: SkinMap) -> tuple[SkinMap, SkinMap | None]:
    """Fill the gaps of normals whose neighborhood is measured.

    Masked texels have values that were interpolated over the texture. They become valid. Their
    standard error is the spread of the nearest measured normals times `SPREAD_FACTOR` and the
    distance to the nearest times `BEND_RAD_PER_MM`, at least the median error of these normals.

    Parameters
    ----------
    normals
        Unit normals (H, W, 3), rad as standard errors.
    position
        Surface points of the same texels, mm.

    Returns
    -------
    normals : SkinMap
        The same values with fewer masked texels.
    measured : SkinMap or None
        1 where a normal is measured, 0 where it is filled; None if nothing was filled.
    """
    known, on_face = intersect_valid(normals, position), intersect_valid(position)
    length = np.linalg.norm(normals.values, axis=-1)
    gap = on_face & ~known & (np.abs(length - 1.0) < 1e-3)
    if normals.stderr is None or not gap.any() or np.count_nonzero(known) < N_NEIGHBORS:
        return normals, None
    tree = cKDTree(position.values[known])
    distance, near = tree.query(position.values[gap], k=N_NEIGHBORS, workers=1)
    filled = np.zeros_like(gap)
    filled[gap] = distance[:, 0] < MAX_GAP_DISTANCE_MM
    if not filled.any():
        return normals, None
    around = normals.values[known].astype(np.float64)[near]
    middle = unit_vectors(around.mean(axis=1))
    cosine = np.clip(np.einsum("gnk,gk->gn", around, middle), -1.0, 1.0)
    spread = np.sqrt(np.mean(np.square(np.arccos(cosine)), axis=1))
    errors = normals.stderr[known].reshape(len(tree.data), -1)[near]
    least = np.median(errors.max(axis=-1), axis=1)
    stderr = normals.stderr.copy()
    bent = np.hypot(SPREAD_FACTOR * spread, BEND_RAD_PER_MM * distance[:, 0])
    found = np.maximum(bent, least).astype(stderr.dtype)
    stderr[gap] = found.reshape(-1, *([1] * (stderr.ndim - 2)))
    whole = known | filled
    what = f"{normals.description}, gaps filled from measured neighbors"
    measured = SkinMap(
        known.astype(np.float32), "1", valid=whole, description="1: measured normal; 0: filled"
    )
    return SkinMap(normals.values, normals.unit, stderr, whole, what), measured
