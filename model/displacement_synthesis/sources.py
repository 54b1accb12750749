"""Prepare measured patches for synthesis: level them, fill holes and resample to scales.

References
----------
ISO 16610-21:2011, Geometrical product specifications, filtration: linear profile filters, Gaussian
filters (a wave of the cut-off's length keeps half its height).
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, map_coordinates

from model.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int32Array, Int64Array
from model.checks import Checks

MAX_SOURCE_PX = 150_000_000
"""Pixels of all patches at all scales, 12 bytes each with their transposes and tables."""


SPLIT_UM: Final = 1000.0
"""Longest period of relief; longer waves belong to the mesh (Nagano2015, section 4)."""
MAX_HEIGHT_UM = 1e30
"""Larger heights overflow sums in single precision."""


class SynthesisError(ValueError):
    """Error for patches, sizes, regions or knobs that nothing can be grown from."""


def level_patch(
    height_um: ArrayLike,
    *,
    pixel_um: float,
    valid: ArrayLike | None = None,
    cutoff_um: float = SPLIT_UM,
) -> Float32Array:
    """Remove a patch's bulge and tilt: all waves longer than a cut-off.

    Parameters
    ----------
    height_um : array_like, shape (H, W)
        Measured heights, um; NaN where there is none.
    pixel_um : float
        Side of a pixel, um, > 0.
    valid : array_like of bool, shape (H, W), optional
        Heights to use.
    cutoff_um : float
        Waves of this length keep half their height (ISO 16610-21); the paper removes detail
        beyond a millimeter (Nagano2015 section 4).

    Returns
    -------
    ndarray of float32, shape (H, W)
        Heights about zero, um; NaN where the patch has none.

    Raises
    ------
    SynthesisError
        For a patch without heights, heights beyond single precision, or a pixel or cut-off that is
        not positive.

    Notes
    -----
    The low-pass is a Gaussian mean over the valid heights, normalized by the Gaussian's weight on
    them, so that a border or a hole does not count as height 0.

    Examples
    --------
    >>> ramp = np.add.outer(np.arange(50.0), np.arange(50.0))
    >>> bool(abs(level_patch(ramp, pixel_um=10.0, cutoff_um=100.0)[20:30, 20:30]).max() < 1e-3)
    True
    """
    height, known = _checked(height_um, valid, "height_um")
    for name, value in (("pixel_um", pixel_um), ("cutoff_um", cutoff_um)):
        Checks(SynthesisError).within(name, value, "(0, inf)")
    sigma_px = math.sqrt(0.5 * math.log(2.0)) / math.pi * cutoff_um / pixel_um
    mean = height[known].mean()
    about = np.where(known, height - mean, 0.0)
    weight = gaussian_filter(known.astype(np.float64), sigma_px, mode="constant")
    slow = gaussian_filter(about, sigma_px, mode="constant") / np.maximum(weight, 1e-12)
    return np.where(known, about - slow, np.nan).astype(np.float32)


def _checked(
    height: ArrayLike, valid: ArrayLike | None, name: str
) -> tuple[Float64Array, BoolArray]:
    values = np.asarray(height, np.float64)
    Checks(SynthesisError).shape(name, values, ("H", "W"))
    Checks(SynthesisError).within(f"side of {name}", min(values.shape), "[2, inf)")
    known = np.isfinite(values)
    if valid is not None:
        mask = np.asarray(valid)
        Checks(SynthesisError).mask("valid", mask, values.shape)
        known &= mask
    if not known.any():
        raise SynthesisError(f"{name}: got no valid height, expected one at least")
    Checks(SynthesisError).within(
        f"heights of {name}", values[known], f"[-{MAX_HEIGHT_UM}, {MAX_HEIGHT_UM}]"
    )
    return values, known


def fill_holes(height: FloatArray, valid: BoolArray) -> Float32Array:
    """Return heights with each hole filled by means of its surroundings, from its rim inward."""
    values = np.where(valid, height, 0.0).astype(np.float64)
    weight = valid.astype(np.float64)
    sigma = 1.0
    while not (weight > 0).all():
        near = gaussian_filter(weight, sigma, truncate=3.0)
        mean = gaussian_filter(values * weight, sigma, truncate=3.0)
        take = (weight == 0) & (near > 0.05)
        values[take] = mean[take] / near[take]
        weight[take] = 1.0
        sigma *= 2.0
    return values.astype(np.float32)


class PatchSources(NamedTuple):
    """All patches of a site at all scales, in one flat array."""

    table: Int64Array
    """(S, 5): first pixel in ``heights``, height, width, first entry in ``fill_holes``, first
    pixel in ``transposed``."""
    level_first: Int64Array
    """(L + 1,): sources of scale l begin at level_first[l]."""
    heights: Float32Array
    """(N,) heights, um."""
    transposed: Float32Array
    """(N,) the same with each source transposed."""
    filled: Int32Array
    """(M,) summed-area tables, (height + 1, width + 1) each, of pixels without a measured height of
    their own."""


def gather_sources(
    patches: Sequence[ArrayLike], zooms: Sequence[float], *, window: int, name: str
) -> PatchSources:
    """Resample patches to all scales and put them into one array.

    Parameters
    ----------
    patches : sequence of array_like, each (H, W)
        Heights, um; NaN: hole.
    zooms : sequence of float
        Pixels of the result per pixel of a patch, one per scale.
    window : int
        Patches that are smaller at some scale are not used there.
    name : str
        Of the argument, for messages.

    Raises
    ------
    SynthesisError
        When a scale has no patch that is large enough, or all are too large together.
    """
    if not len(patches):
        raise SynthesisError(f"{name}: got no patch, expected one at least")
    checked = [_checked(patch, None, f"{name}[{n}]") for n, patch in enumerate(patches)]
    whole = [(fill_holes(height, known), known) for height, known in checked]
    if sum(h.size * z * z for h, _ in whole for z in zooms) > MAX_SOURCE_PX:
        raise SynthesisError(
            f"{name}: got more than {MAX_SOURCE_PX} pixels at {len(zooms)} scales, expected fewer "
            "or smaller patches, or a narrower range of pixel_um"
        )
    rows, firsts = [], [0]
    used: list[tuple[int, float]] = []
    pixel = entry = 0
    for zoom in zooms:
        for number, (height, _) in enumerate(whole):
            high, wide = _scaled_shape(height.shape, zoom)
            if min(high, wide) >= window:
                rows.append((pixel, high, wide, entry, pixel))
                used.append((number, zoom))
                pixel += high * wide
                entry += (high + 1) * (wide + 1)
        if len(rows) == firsts[-1]:
            largest = max(min(_scaled_shape(h.shape, zoom)) for h, _ in whole)
            raise SynthesisError(
                f"{name}: got at most {largest} px per side at the result's scale, "
                f"expected at least {window}: give larger patches or smaller cells_px"
            )
        firsts.append(len(rows))
    heights, turned = np.empty(pixel, np.float32), np.empty(pixel, np.float32)
    sums = np.zeros(entry, np.int32)
    for (begin, high, wide, entry, _), (number, zoom) in zip(rows, used, strict=True):
        scaled, missing = _resample(*whole[number], zoom)
        heights[begin : begin + scaled.size] = scaled.reshape(-1)
        turned[begin : begin + scaled.size] = scaled.T.reshape(-1)
        table = sums[entry : entry + (high + 1) * (wide + 1)].reshape(high + 1, wide + 1)
        table[1:, 1:] = missing.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    return PatchSources(
        table=np.array(rows, np.int64),
        level_first=np.array(firsts, np.int64),
        heights=heights,
        transposed=turned,
        filled=sums,
    )


def _scaled_shape(shape: tuple[int, ...], zoom: float) -> tuple[int, int]:
    return max(1, int(shape[0] * zoom + 1e-9)), max(1, int(shape[1] * zoom + 1e-9))


def _resample(
    height: Float32Array, valid: BoolArray, zoom: float
) -> tuple[Float32Array, BoolArray]:
    """Return heights with ``zoom`` times the pixels per side, and a mask of the filled ones."""
    if abs(zoom - 1.0) < 1e-9:
        return height, ~valid
    places = [(np.arange(n) + 0.5) / zoom - 0.5 for n in _scaled_shape(height.shape, zoom)]
    grid = np.meshgrid(*places, indexing="ij")
    smooth = height
    if zoom < 1.0:
        smooth = gaussian_filter(height, 0.5 * math.sqrt(zoom**-2 - 1.0), mode="nearest")
    values = map_coordinates(smooth, grid, order=3, mode="nearest")
    share = map_coordinates((~valid).astype(np.float32), grid, order=1, mode="nearest")
    return values.astype(np.float32), share > 0.25
