"""Where an estimate stands out of its own standard error, judged by its neighborhood.

Asking each pixel alone whether its estimate exceeds its error keeps the pixels that noise made
large and drops the others: what is kept is then far too high, with errors that look small.
"""

import numpy as np
from scipy import ndimage

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray

NEIGHBORHOOD_PX = 15
MAX_RELATIVE_STDERR = 0.5


def detectable(
    estimate: FloatArray, stderr: FloatArray, valid: BoolArray, *, size_px: int = NEIGHBORHOOD_PX
) -> BoolArray:
    """Return where the mean standard error around is small against the mean estimate around.

    It is up to `MAX_RELATIVE_STDERR` of it.

    Parameters
    ----------
    estimate, stderr
        (H, W).
    valid
        (H, W); other pixels do not count and are not detectable.
    size_px
        Side of the square neighborhood, odd.

    Returns
    -------
    ndarray of bool
        (H, W).

    Examples
    --------
    >>> one = np.ones((3, 3))
    >>> bool(detectable(one, 0.2 * one, one > 0).all())
    True
    """
    Checks().require(size_px >= 1 and size_px % 2, "size_px", size_px, "an odd number, at least 1")
    good = valid & np.isfinite(estimate) & np.isfinite(stderr)

    def total(values: FloatArray) -> Float64Array:
        kept = np.where(good, values, 0.0).astype(np.float64)
        return np.asarray(ndimage.uniform_filter(kept, size_px, mode="constant"))

    return np.asarray(good & (total(stderr) <= MAX_RELATIVE_STDERR * total(estimate)))
