"""Textures sampled back at the points that they were made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Float32Array


def points_from_texels(
    texture: ArrayLike, corner_uv: ArrayLike, faces: ArrayLike, points: int
) -> Float32Array:
    """Sample a dense texture at points, bilinearly; a point at a seam takes the mean of its sides.

    Parameters
    ----------
    texture : array_like, shape (N, N) or (N, N, C)
    corner_uv : array_like, shape (F, 3, 2)
    faces : array_like of int, shape (F, 3)
    points : int
        Number of points.

    Returns
    -------
    ndarray of float32, shape (points,) or (points, C)
        0 for points of no triangle.
    """
    image = np.asarray(texture, np.float32)
    layers = np.ascontiguousarray(image if image.ndim == 3 else image[..., None])
    size = len(layers)
    uv = np.asarray(corner_uv, np.float64).reshape(-1, 2)
    x = np.clip(uv[:, 0] * size - 0.5, 0, size - 1)
    y = np.clip((1.0 - uv[:, 1]) * size - 0.5, 0, size - 1)
    j, i = np.minimum(x.astype(int), size - 2), np.minimum(y.astype(int), size - 2)
    a, b = (x - j)[:, None], (y - i)[:, None]
    seen = (1 - b) * ((1 - a) * layers[i, j] + a * layers[i, j + 1]) + b * (
        (1 - a) * layers[i + 1, j] + a * layers[i + 1, j + 1]
    )
    corner = np.asarray(faces).reshape(-1)
    count = np.maximum(np.bincount(corner, minlength=points), 1)
    out = np.stack(
        [np.bincount(corner, seen[:, c], minlength=points) / count for c in range(seen.shape[1])],
        axis=-1,
    ).astype(np.float32)
    return out if image.ndim == 3 else out[:, 0]
