"""What the errors of a relief hold beside noise: light and lens that the estimator does not model.

Light goes from one wall of a furrow to the other, facets hide one another, and the lens averages
light where the estimator takes it to average slopes. On simulated patches of forehead, cheek and
chin (seeds 0 to 5, at rest, with the sensor's noise) what is left of the errors without noise is
about the same share of the relief itself on each. The shares are those with which 68 % of truths
lie in 68 % regions; ``skinrig bench --stage intervals`` judges them on other seeds.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from reconstruction.arrays import BoolArray, Float32Array, FloatArray

RELATIVE_HEIGHT_ERROR: Final = 0.07
"""Error of a height over the standard deviation of the relief."""
RELATIVE_SLOPE_ERROR: Final = 0.055
"""Error of a normal, rad in one direction, over the standard deviation of slopes."""


def of_height(height: FloatArray, stderr: Float32Array, valid: BoolArray) -> Float32Array:
    """Return standard errors of a relief's heights by noise and model together.

    Parameters
    ----------
    height
        (H, W), finite where valid; without what is longer than the relief.
    stderr
        (H, W), by noise alone, in the height's unit.
    valid
        (H, W).

    Returns
    -------
    ndarray of float32, shape (H, W)
        At least `stderr`; the same where not valid.

    Examples
    --------
    >>> known = np.ones((1, 2), bool)
    >>> found = of_height(np.array([[-1.0, 1.0]]), np.zeros((1, 2), np.float32), known)
    >>> found.astype(float).round(3).tolist()
    [[0.07, 0.07]]
    """
    if not valid.any():
        return stderr
    model = RELATIVE_HEIGHT_ERROR * float(np.std(height[valid], dtype=np.float64))
    return np.where(valid, np.hypot(stderr, np.float32(model)), stderr)


def of_normals(normals: FloatArray, stderr: Float32Array, valid: BoolArray) -> Float32Array:
    """Return standard errors of a relief's normals by noise and model together.

    Parameters
    ----------
    normals
        (H, W, 3), unit vectors where valid, z towards the camera.
    stderr
        (H, W), rad in each of two directions, by noise alone.
    valid
        (H, W).

    Returns
    -------
    ndarray of float32, shape (H, W)
        At least `stderr`; the same where not valid.
    """
    if not valid.any():
        return stderr
    across = np.var(normals[valid][:, :2], axis=0, dtype=np.float64)
    model = RELATIVE_SLOPE_ERROR * float(np.sqrt(across.mean()))
    return np.where(valid, np.hypot(stderr, np.float32(model)), stderr)
