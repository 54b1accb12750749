"""Check arrays of pixels, and detect where an estimate exceeds its standard error.

Testing each pixel alone would keep the pixels that noise made large and drop the others: the kept
values would be biased high, with errors that look small. The test therefore uses local means.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray

NEIGHBORHOOD_PX = 15
MAX_RELATIVE_STDERR = 0.5


class ChromophoreError(ValueError):
    """Arguments of the chromophore fit with mismatched shapes or values."""


def is_usable_color(colors: FloatArray) -> BoolArray:
    """Return where colors (..., 3) are finite and above 0, (...)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(colors).all(axis=-1) & (colors > 0.0).all(axis=-1))


def check_mask(valid: ArrayLike, shape: tuple[int, ...]) -> BoolArray:
    """Return a mask of bool of a shape, or raise `ChromophoreError`."""
    given = np.asarray(valid)
    Checks(ChromophoreError).mask("valid", given, shape)
    return given


def broadcast_to_pixels(name: str, array: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Broadcast an array to the pixels' shape, or raise `ChromophoreError`."""
    values = np.asarray(array)
    try:
        return np.broadcast_to(values, shape)
    except ValueError as error:
        expected = f"a number or a shape that broadcasts to {shape}"
        hint = "give one value per pixel or one for all"
        raise ChromophoreError(
            f"{name}: got {values.shape}, expected {expected}; {hint}"
        ) from error


def check_colors(rgb: ArrayLike, *leading: str) -> Float32Array:
    """Return colors as float32, or raise `ChromophoreError` for a shape other than (..., 3).

    Parameters
    ----------
    rgb
        Colors of pixels.
    leading
        Names of the axes before the channels; any by default.
    """
    colors = np.asarray(rgb, dtype=np.float32)
    Checks(ChromophoreError).shape("rgb", colors, (*(leading or ("...",)), 3))
    return colors


def is_detectable(
    estimate: FloatArray, stderr: FloatArray, valid: BoolArray, *, size_px: int = NEIGHBORHOOD_PX
) -> BoolArray:
    """Return where the local mean standard error is small against the local mean estimate.

    Its ratio is at most `MAX_RELATIVE_STDERR`.

    Parameters
    ----------
    estimate, stderr
        (H, W).
    valid
        (H, W); other pixels are ignored and not detectable.
    size_px
        Side of the square neighborhood, odd.

    Returns
    -------
    ndarray of bool
        (H, W).

    Examples
    --------
    >>> one = np.ones((3, 3))
    >>> bool(is_detectable(one, 0.2 * one, one > 0).all())
    True
    """
    Checks().require(size_px >= 1 and size_px % 2, "size_px", size_px, "an odd number, at least 1")
    good = valid & np.isfinite(estimate) & np.isfinite(stderr)

    def total(values: FloatArray) -> Float64Array:
        kept = np.where(good, values, 0.0).astype(np.float64)
        return np.asarray(ndimage.uniform_filter(kept, size_px, mode="constant"))

    return np.asarray(good & (total(stderr) <= MAX_RELATIVE_STDERR * total(estimate)))
