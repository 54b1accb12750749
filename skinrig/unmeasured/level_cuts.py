"""Cut triangles where a function of the vertices is zero, without moving any vertex."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skinrig.arrays import BoolArray, Float64Array, Int64Array

MIN_LEVEL: Final = 1e-3
"""Least magnitude of the function at a vertex, so that no new vertex coincides with an old one."""


@dataclass(frozen=True, slots=True, eq=False)
class LevelCut:
    """Triangles on both sides of a zero level.

    Attributes
    ----------
    edges : ndarray of int, shape (n, 2)
        Ends of the edges that have a new vertex; the new vertices follow the old ones.
    fraction : ndarray of float64, shape (n,)
        Place of each new vertex from the first end (0) to the second (1).
    above, below : ndarray of int, shape (f, 3)
        Triangles where the function is positive or zero, and where it is negative.
    """

    edges: Int64Array
    fraction: Float64Array
    above: Int64Array
    below: Int64Array

    def extend(self, values: Float64Array) -> Float64Array:
        """Append the values at the new vertices to those of the old ones, shape (V + n, ...)."""
        first, second = values[self.edges[:, 0]], values[self.edges[:, 1]]
        share = self.fraction.reshape(-1, *[1] * (values.ndim - 1))
        return np.concatenate([values, first + share * (second - first)])


def cut_at_zero(
    faces: Int64Array, level: Float64Array, place: Int64Array, *, chosen: BoolArray | None = None
) -> LevelCut:
    """Cut triangles at the zero level of a function that is linear in each.

    Parameters
    ----------
    faces
        Shape (F, 3).
    level
        Function at each vertex, shape (V,), such as a distance in mm; values within `MIN_LEVEL`
        of zero count as that.
    place
        Number of each vertex' position, shape (V,): vertices of a seam of the texture share it, and
        so the new vertices of both sides are at one position.
    chosen
        Which triangles are cut, shape (F,); all by default. Others count to the side of their
        first corner. Triangles that share a cut edge with a chosen one must be chosen, too.

    Returns
    -------
    LevelCut
        Triangles keep their orientation.

    Examples
    --------
    >>> found = cut_at_zero(np.array([[0, 1, 2]]), np.array([-1.0, 1.0, 3.0]), np.arange(3))
    >>> found.edges.tolist(), found.fraction.tolist()
    ([[0, 1], [0, 2]], [0.5, 0.25])
    >>> found.above.tolist(), found.below.tolist()
    ([[3, 1, 2], [3, 2, 4]], [[0, 3, 4]])
    """
    level = keep_from_zero(level)
    up = level > 0.0
    corners = up[faces]
    mixed = corners.any(axis=1) & ~corners.all(axis=1)
    if chosen is not None:
        mixed &= chosen
    above, below = faces[~mixed & corners[:, 0]], faces[~mixed & ~corners[:, 0]]
    # the corner that is alone on its side comes first
    alone = corners == (corners.sum(axis=1) == 1)[:, None]
    first = np.argmax(alone, axis=1)[mixed]
    rows = faces[mixed]
    a, b, c = (rows[np.arange(len(rows)), (first + k) % 3] for k in range(3))
    pairs = np.sort(np.concatenate([np.stack([a, b], -1), np.stack([a, c], -1)]), axis=1)
    edges, number = np.unique(pairs, axis=0, return_inverse=True)
    ab, ac = (len(level) + number.reshape(-1)).reshape(2, -1)
    turned = place[edges[:, 0]] > place[edges[:, 1]]
    edges = np.where(turned[:, None], edges[:, ::-1], edges)
    one, two = level[edges[:, 0]], level[edges[:, 1]]
    tips = np.stack([a, ab, ac], axis=-1)
    rests = np.stack([np.stack([ab, b, c], -1), np.stack([ab, c, ac], -1)], axis=1)
    high = up[a]
    return LevelCut(
        edges,
        one / (one - two),
        np.concatenate([above, tips[high], rests[~high].reshape(-1, 3)]),
        np.concatenate([below, tips[~high], rests[high].reshape(-1, 3)]),
    )


def keep_from_zero(level: Float64Array) -> Float64Array:
    """Return a function of the vertices with values within `MIN_LEVEL` of zero set to that.

    Examples
    --------
    >>> keep_from_zero(np.array([-1.0, -1e-4, 0.0, 2.0])).tolist()
    [-1.0, 0.001, 0.001, 2.0]
    """
    return np.where(np.abs(level) < MIN_LEVEL, MIN_LEVEL, level)
