"""Error of a map on the neutral image due to errors of position, written plainly."""

from __future__ import annotations

import numpy as np

from reconstruction.correspondence.expression_alignment import _slope_variance


def place_stderr(alignment, values):
    """Return the slope of values (H, W), smoothed over 2 px, times the error of the place."""
    image = np.asarray(values, np.float32)
    finite = np.isfinite(image)
    good = alignment.valid & finite
    steep = np.sqrt(_slope_variance(np.where(finite, image, 0.0).astype(np.float32), good))
    return np.asarray(steep * alignment.error_px / np.sqrt(2.0), np.float32)
