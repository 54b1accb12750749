"""Normalize vectors and project weights to the simplex."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Float64Array, FloatArray


def project_to_simplex(rows: Float64Array) -> Float64Array:
    """Return the nearest weights of at least 0 that sum to 1, row by row (n, d)."""
    falling = -np.sort(-rows, axis=1)
    excess = (np.cumsum(falling, axis=1) - 1.0) / np.arange(1, rows.shape[1] + 1)
    kept = np.count_nonzero(falling > excess, axis=1)
    return np.maximum(rows - excess[np.arange(len(rows)), kept - 1, None], 0.0)


def unit_vectors(
    vectors: FloatArray, *, min_length: float | np.floating[Any] = 0.0
) -> NDArray[Any]:
    """Divide vectors by their lengths, of at least ``min_length`` each.

    Parameters
    ----------
    vectors
        (..., 3), of any length.
    min_length
        Shorter vectors are divided by this and stay shorter than 1.

    Examples
    --------
    >>> unit_vectors(np.array([[0.0, 3.0, 4.0], [2.0, 0.0, 0.0]])).tolist()
    [[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]]
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, min_length))
