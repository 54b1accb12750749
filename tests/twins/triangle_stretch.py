"""Stretch of a surface's triangles, from the eigenvalues of their metrics."""

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import BoolArray, Float64Array, Int32Array


def principal_stretches(
    rest_mm: ArrayLike, posed_mm: ArrayLike, faces: Int32Array
) -> tuple[Float64Array, BoolArray]:
    """Return how the triangles of a surface are stretched.

    Parameters
    ----------
    rest_mm, posed_mm
        Vertices before and after, shape (V, 3).
    faces
        Vertex indices, shape (F, 3).

    Returns
    -------
    stretches : ndarray
        Least and greatest ratio of lengths after to before, shape (F, 2); 1 for triangles that had
        no area.
    folded : ndarray of bool
        Triangles whose normal has turned by more than a right angle, shape (F,).
    """
    before = _edges(np.asarray(rest_mm, np.float64), faces)
    after = _edges(np.asarray(posed_mm, np.float64), faces)
    a, b = np.cross(before[:, 0], before[:, 1]), np.cross(after[:, 0], after[:, 1])
    whole = np.sum(a * a, axis=-1) > 1e-12
    gram = before @ before.swapaxes(1, 2)
    gram[~whole] = np.eye(2)
    target = after @ after.swapaxes(1, 2)
    target[~whole] = np.eye(2)
    # squared stretches are the eigenvalues of G^-1 G'; both are 2 x 2
    product = np.linalg.solve(gram, target)
    half = 0.5 * np.trace(product, axis1=1, axis2=2)
    spread = np.sqrt(np.maximum(half**2 - np.linalg.det(product), 0.0))
    squares = np.maximum(np.stack([half - spread, half + spread], axis=-1), 0.0)
    return np.sqrt(squares), whole & (np.sum(a * b, axis=-1) <= 0.0)


def _edges(points: Float64Array, faces: Int32Array) -> Float64Array:
    corners = points[faces]
    return np.asarray(corners[:, 1:] - corners[:, :1])
