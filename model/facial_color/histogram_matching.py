"""Match local histograms without the Gaussian assumption (Jimenez 2010, section 4).

Each value of the neutral map is mapped to the target's value at the same percentile, in discs about
the nodes of a grid; the mappings are blended bilinearly. `model.facial_color` uses two numbers per
disc instead.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array
from model.checks import Checks
from model.facial_color.disc_statistics import DiscStatisticsError, half_widths


@dataclass(frozen=True, slots=True, eq=False)
class HistogramMatch:
    """A neutral map with the local histograms of another."""

    hemoglobin: Float64Array
    """(H, W), in the unit of the maps; NaN outside ``valid``."""
    valid: BoolArray
    """Where the neutral map is valid and the target has a valid pixel in a window."""


def match(
    neutral: ArrayLike,
    target: ArrayLike,
    radius_px: float,
    *,
    valid: BoolArray | None = None,
    valid_target: BoolArray | None = None,
    spacing_px: int | None = None,
) -> HistogramMatch:
    """Match the histograms in discs about the nodes of a grid, blended bilinearly between them.

    Parameters
    ----------
    neutral, target
        (H, W) each, in one unit, aligned; values that are not finite are not valid.
    radius_px
        Radius of the disc, px, at least 1.5.
    valid, valid_target
        (H, W) bool: pixels that count.
    spacing_px
        Distance of the nodes, 1 to r/sqrt(2), so that a pixel lies in the windows of all four
        nodes about it and is never extrapolated; None: half the radius.

    Returns
    -------
    HistogramMatch

    Raises
    ------
    model.facial_color.disc_statistics.DiscStatisticsError
        For maps, masks, a radius or a spacing of a wrong shape or range.

    Notes
    -----
    Equal values get their mean rank. An increasing affine target is reproduced exactly.

    Examples
    --------
    >>> ramp = np.arange(48.0).reshape(6, 8)
    >>> float(np.abs(match(ramp, 2 * ramp + 1, 3.0).hemoglobin - (2 * ramp + 1)).max())
    0.0
    """
    a, b, va, vb = _checked(neutral, target, valid, valid_target)
    Checks(DiscStatisticsError).within("radius_px", radius_px, "[1.5, inf)")
    largest = int(radius_px / math.sqrt(2.0))
    spacing = max(int(radius_px / 2.0), 1) if spacing_px is None else int(spacing_px)
    Checks(DiscStatisticsError).within("spacing_px", spacing, f"[1, {largest}]")
    # the last nodes may lie outside the map
    half = half_widths(radius_px, a.shape[0] + spacing, a.shape[1] + spacing)
    total, weight = np.zeros(a.shape), np.zeros(a.shape)
    for parity in (
        0,
        1,
    ):  # windows of every other row of nodes do not overlap, so threads write disjoint pixels
        _match_windows(a, b, va, vb, half, spacing, parity, total, weight)
    found = va & (weight > 0.0)
    return HistogramMatch(np.where(found, total / np.where(found, weight, 1.0), np.nan), found)


def _checked(
    neutral: ArrayLike, target: ArrayLike, valid: BoolArray | None, valid_target: BoolArray | None
) -> tuple[Float64Array, Float64Array, BoolArray, BoolArray]:
    # copies: the compiled signatures require writable arrays
    a, b = (np.array(x, np.float64, order="C") for x in (neutral, target))
    check = Checks(DiscStatisticsError)
    check.shape("neutral", a, ("H", "W"))
    check.shape("target", b, a.shape)
    masks = []
    for name, image, mask in (("valid", a, valid), ("valid_target", b, valid_target)):
        found = np.isfinite(image)
        if mask is not None:
            mask = np.asarray(mask)
            check.mask(name, mask, a.shape)
            found &= mask
        masks.append(found)
    return a, b, masks[0], masks[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(h: Any, valid: Any, half: Any, y: Any, x: Any) -> Any:
    """Return the valid values in the disc about (y, x)."""
    rows, columns = h.shape
    reach = half.size - 1
    n = 0
    for k in range(max(0, y - reach), min(rows, y + reach + 1)):
        w = half[abs(k - y)]
        for c in range(max(0, x - w), min(columns, x + w + 1)):
            n += valid[k, c]
    found = np.empty(n)
    n = 0
    for k in range(max(0, y - reach), min(rows, y + reach + 1)):
        w = half[abs(k - y)]
        for c in range(max(0, x - w), min(columns, x + w + 1)):
            if valid[k, c]:
                found[n] = h[k, c]
                n += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _quantile(ordered: Any, fraction: Any) -> Any:
    """Return the quantile of ordered values at a fraction."""
    n = ordered.size
    at = min(max(fraction * n - 0.5, 0.0), n - 1.0)
    low = min(int(at), n - 1)
    part = at - low
    if part < 1e-9 or low == n - 1:
        return ordered[low]
    if part > 1.0 - 1e-9:
        return ordered[low + 1]
    return ordered[low] + part * (ordered[low + 1] - ordered[low])


@njit(
    "void(float64[:, ::1], float64[:, ::1], boolean[:, ::1], boolean[:, ::1], int64[::1], int64, "
    "int64, float64[:, ::1], float64[:, ::1])",
    cache=True,
    parallel=True,
    error_model="numpy",
)
def _match_windows(
    a: Any, b: Any, va: Any, vb: Any, half: Any, spacing: Any, parity: Any, total: Any, weight: Any
) -> None:
    """Add the mappings of every other row of windows, weighted by hats about their nodes.

    Parameters
    ----------
    a, b : (H, W) float64
    va, vb : (H, W) bool
    half : (R + 1,) int64
    spacing, parity : int
        Pixels between nodes; 0 or 1: even or odd rows of nodes.
    total, weight : (H, W) float64, added to
    """
    rows, columns = a.shape
    down = (rows - 1 + spacing - 1) // spacing + 1
    across = (columns - 1 + spacing - 1) // spacing + 1
    for half_row in prange((down - parity + 1) // 2):
        y = (2 * half_row + parity) * spacing
        for node in range(across):
            x = node * spacing
            source = np.sort(_gather(a, va, half, y, x))
            wanted = np.sort(_gather(b, vb, half, y, x))
            if source.size == 0 or wanted.size == 0:
                continue
            for k in range(max(0, y - spacing + 1), min(rows, y + spacing)):
                for c in range(max(0, x - spacing + 1), min(columns, x + spacing)):
                    if not va[k, c]:
                        continue
                    hat = (1.0 - abs(k - y) / spacing) * (1.0 - abs(c - x) / spacing)
                    below = np.searchsorted(source, a[k, c])
                    upto = np.searchsorted(source, a[k, c], side="right")
                    share = 0.5 * (below + upto) / source.size
                    total[k, c] += hat * _quantile(wanted, share)
                    weight[k, c] += hat
