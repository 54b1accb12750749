"""Unit vectors."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray


def unit_vectors(
    vectors: FloatArray, *, min_length: float | np.floating[Any] = 0.0
) -> NDArray[Any]:
    """Divide vectors by their lengths, of at least ``min_length`` each.

    Parameters
    ----------
    vectors
        (..., 3), of any length.
    min_length
        Shorter vectors are divided by this: they stay shorter than 1.

    Examples
    --------
    >>> unit_vectors(np.array([[0.0, 3.0, 4.0], [2.0, 0.0, 0.0]])).tolist()
    [[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]]
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, min_length))
