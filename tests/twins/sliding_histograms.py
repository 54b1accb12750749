"""Local histogram matching about every single pixel: what windows on a grid approximate."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from model.arrays import BoolArray
from model.facial_color.disc_statistics import half_widths
from model.facial_color.histogram_matching import HistogramMatch, _checked, _gather, _quantile


def match_sliding(
    neutral: ArrayLike,
    target: ArrayLike,
    radius_px: float,
    *,
    valid: BoolArray | None = None,
    valid_target: BoolArray | None = None,
) -> HistogramMatch:
    """Match the histograms in the disc about every single pixel: exact, and O(r^2) a pixel.

    Parameters and errors as of `match`.

    Examples
    --------
    >>> ramp = np.arange(20.0).reshape(4, 5)
    >>> match_sliding(ramp, ramp**2, 2.0).hemoglobin[0].round(2).tolist()
    [0.0, 1.0, 4.0, 9.0, 16.0]
    """
    a, b, va, vb = _checked(neutral, target, valid, valid_target)
    half = half_widths(radius_px, a.shape[0] - 1, a.shape[1] - 1)
    out = np.empty(a.shape)
    _match_pixels(a, b, va, vb, half, out)
    return HistogramMatch(out, np.isfinite(out))


@njit(cache=True, parallel=True, error_model="numpy")
def _match_pixels(a: Any, b: Any, va: Any, vb: Any, half: Any, out: Any) -> None:
    """Write what each pixel's own window makes of it, NaN where it is not valid or empty.

    Parameters
    ----------
    a, b : (H, W) float64
    va, vb : (H, W) bool
    half : (R + 1,) int64
    out : (H, W) float64, written
    """
    rows, columns = a.shape
    for y in prange(rows):
        for x in range(columns):
            out[y, x] = np.nan
            if not va[y, x]:
                continue
            wanted = np.sort(_gather(b, vb, half, y, x))
            if wanted.size == 0:
                continue
            source = _gather(a, va, half, y, x)
            below, same = 0, 0
            for value in source:
                below += value < a[y, x]
                same += value == a[y, x]
            out[y, x] = _quantile(wanted, (below + 0.5 * same) / source.size)
