"""Weights of the skin sites over a map: coarse grids, and smooth interpolation at pixels."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt

from model.arrays import Float64Array
from model.checks import Checks
from model.displacement_synthesis.sources import SynthesisError


def coarse_weights(
    regions: ArrayLike, count: int, shape: tuple[int, int], *, transition_px: float
) -> Float64Array:
    """Return the weight of each site on a grid no finer than a transition.

    Parameters
    ----------
    regions : array_like
        Integers (h, w), -1 to count - 1, -1: of no site; or weights (count, h, w), >= 0.
    count : int
        Sites.
    shape : (int, int)
        Rows and columns of the map.
    transition_px : float
        Width of the transition between sites, px of the map.

    Returns
    -------
    ndarray of float64, shape (count, rows, columns)
        Sums to 1 over sites. Cells without a site take the nearest one's, so that skin continues
        beyond an island's edge.

    Raises
    ------
    SynthesisError
        For regions of another shape, of unknown sites, or of no site at all.
    """
    given = np.asarray(regions)
    if given.ndim == 2 and np.issubdtype(given.dtype, np.integer):
        Checks(SynthesisError).within("regions", given, f"[-1, {count})")
        weights = np.stack([given == n for n in range(count)]).astype(np.float64)
    elif given.ndim == 3 and given.shape[0] == count and np.issubdtype(given.dtype, np.floating):
        weights = given.astype(np.float64)
        Checks(SynthesisError).within("regions", weights, "[0, inf)")
    else:
        raise SynthesisError(
            f"regions: got {given.dtype} {given.shape}, expected integers (h, w) or "
            f"weights ({count}, h, w)"
        )
    total = weights.sum(axis=0)
    if not total.any():
        raise SynthesisError("regions: got no site, expected one at least")
    nearest = distance_transform_edt(total == 0, return_distances=False, return_indices=True)
    weights = (weights / np.where(total == 0, 1.0, total))[(slice(None), *nearest)]
    for axis, size in enumerate(shape, 1):
        knots = max(1, math.ceil(size / transition_px))
        if knots < weights.shape[axis]:
            firsts = np.arange(knots) * weights.shape[axis] // knots
            sums = np.add.reduceat(weights, firsts, axis=axis)
            widths = np.diff(np.append(firsts, weights.shape[axis]))
            weights = sums / widths.reshape([-1 if a == axis else 1 for a in range(3)])
    return weights


def interpolate_weights(
    weights: Float64Array,
    shape: tuple[int, int],
    rows: tuple[int, int],
    columns: tuple[int, int],
    *,
    wrap: tuple[bool, bool],
) -> Float64Array:
    """Return one site's weight over a part of a map, by cubic B-splines (two derivatives).

    Parameters
    ----------
    weights : ndarray, shape (h, w)
        One site's weights of :func:`coarse_weights`.
    shape : (int, int)
        Rows and columns of the map.
    rows, columns : (int, int)
        First and last + 1 of the part.
    wrap : (bool, bool)
        Whether the map is periodic, vertically and horizontally.
    """
    down = _splines(weights.shape[0], shape[0], rows, wrap[0])
    right = _splines(weights.shape[1], shape[1], columns, wrap[1])
    return np.asarray(down @ weights @ right.T)


def _splines(knots: int, size: int, part: tuple[int, int], wrap: bool) -> Float64Array:
    """Return the weight of each knot (columns) at each pixel (rows); rows sum to 1."""
    place = (np.arange(*part) + 0.5) * knots / size - 0.5
    whole = np.floor(place).astype(np.int64)
    t = place - whole
    found = np.zeros((place.size, knots))
    pieces = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    for offset, piece in enumerate(pieces, -1):
        knot = whole + offset
        knot = knot % knots if wrap else np.clip(knot, 0, knots - 1)
        np.add.at(found, (np.arange(place.size), knot), piece / 6.0)
    return found
