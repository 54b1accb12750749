"""Compute the strain of a deforming mesh: principal stretch ratios and axes in the texture.

Eqs. (10)-(13) of Nagano et al. 2015. Q maps a triangle's plane to the texture, R is the rotation
closest to it, T the plane deformation on R's axes; its singular values are the stretch ratios r_s
>= r_t, and S = Q R^T V has the principal axes in texture coordinates, with the length that a
millimeter of neutral skin along them has there.

Conventions:

- T is taken as the right stretch tensor sqrt(F^T F): the paper's up to the rotation of the deformed
  triangle's frame, on which neither ratios nor axes depend, and which could only make averages
  smaller. A triangle that is turned over in space, or mirrored in the texture, is strained by its
  edges alone.
- T is averaged at vertices with weights of the neutral triangles' areas. Each triangle's tensor is
  first turned by the shortest way from its plane into the vertex's, so that bent surfaces that do
  not stretch have ratios of exactly 1.
- Vertices at one place before and after (split at a seam of the texture) share one tensor, and each
  has Q of its own island. Lips that touch and then part do not.
- Where triangles around a vertex have their texture on opposite sides, the side with more area
  counts for Q.
- Triangles without area in space are left out; those without area in the texture do not contribute
  to Q.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array, Int64Array
from model.checks import Checks
from model.microstructure import strain_kernels as kernels


class StrainError(ValueError):
    """Error for meshes that cannot be compared."""


@dataclass(frozen=True, slots=True)
class MeshStrain:
    """Strain at the vertices of a mesh.

    Attributes
    ----------
    r_s, r_t : ndarray of float64, shape (V,)
        Stretch ratios, r_s >= r_t >= 0; 1 where not `valid`.
    axis_s, axis_t : ndarray of float64, shape (V, 2)
        Unit vectors (u, v) of the principal axes in the texture; the sign is irrelevant; 0 where
        not `valid`. They are perpendicular on the skin, and in a texture that keeps angles.
    uv_per_mm_s, uv_per_mm_t : ndarray of float64, shape (V,)
        Texture units that one unit of length (mm) of neutral skin has along them.
    isotropic : ndarray of bool, shape (V,)
        The ratios are equal (to 1e-6): no axis is preferred, and s is the tangent frame's first
        one, which lies along u where the texture keeps angles.
    valid : ndarray of bool, shape (V,)
        A triangle with an area, and one with an area in the texture too, is at the vertex.
    tensor : ndarray of float64, shape (V, 3)
        T - 1 on R's axes: entries 11, 12, 22.
    uv_metric : ndarray of float64, shape (V, 3)
        Q R^T, symmetric: entries 11, 12, 22; texture units per mm.
    point_index : ndarray of int64, shape (V,)
        Vertices of the same number are one point of the skin.
    degenerate_share : float
        Fraction of the triangles without area in space.
    uv_degenerate_share : float
        Fraction of the triangles with an area in space, but none in the texture.
    uv_turned_share : float
        Fraction of the triangles on the texture's other side than most around one of their
        vertices.
    """

    r_s: Float64Array
    r_t: Float64Array
    axis_s: Float64Array
    axis_t: Float64Array
    uv_per_mm_s: Float64Array
    uv_per_mm_t: Float64Array
    isotropic: BoolArray
    valid: BoolArray
    tensor: Float64Array
    uv_metric: Float64Array
    point_index: Int64Array
    degenerate_share: float
    uv_degenerate_share: float
    uv_turned_share: float


def _numbers(name: str, values: ArrayLike, columns: int) -> Float64Array:
    given = np.ascontiguousarray(values, np.float64)
    return Checks(StrainError).numbers(name, given, (None, columns))


def index_points(*positions: Float64Array) -> Int64Array:
    """Give vertices at the same positions, in every array, the same number.

    Parameters
    ----------
    *positions : ndarray, shape (V, N)
        Compared bit by bit, except for the sign of zero.

    Examples
    --------
    >>> index_points(np.array([[1.0, 2.0], [0.0, 0.0], [1.0, 2.0]])).tolist()
    [1, 0, 1]
    """
    keys = np.concatenate(positions, axis=1).T + 0.0
    order = np.lexsort(keys[::-1])
    place = np.zeros(keys.shape[1], np.int64)
    if order.size > 1:
        new = (keys[:, order[1:]] != keys[:, order[:-1]]).any(axis=0)
        place[order[1:]] = np.cumsum(new)
    return place


def strain(
    rest_vertices: ArrayLike, deformed_vertices: ArrayLike, faces: ArrayLike, uv: ArrayLike
) -> MeshStrain:
    """Return the principal stretch ratios and axes at every vertex of a deformed mesh.

    Parameters
    ----------
    rest_vertices, deformed_vertices : array_like, shape (V, 3)
        Positions, mm, of the neutral and the deformed mesh.
    faces : array_like of int, shape (F, 3)
        Vertex indices.
    uv : array_like, shape (V, 2)
        Texture coordinates; vertices on a seam are split, one for each island.

    Returns
    -------
    MeshStrain

    Raises
    ------
    StrainError
        For shapes that do not fit, indices beyond the vertices, or numbers that are not finite.

    Examples
    --------
    >>> rest = [[0, 0, 0], [10, 0, 0], [0, 10, 0]]
    >>> longer = [[0, 0, 5], [12, 0, 5], [0, 9, 5]]
    >>> found = strain(rest, longer, [[0, 1, 2]], [[0, 0], [0.1, 0], [0, 0.1]])
    >>> found.r_s.round(6).tolist(), found.r_t.round(6).tolist()
    ([1.2, 1.2, 1.2], [0.9, 0.9, 0.9])
    >>> found.axis_s[0].round(6).tolist(), found.uv_per_mm_s[0].round(6).item()
    ([1.0, 0.0], 0.01)
    """
    rest = _numbers("rest_vertices", rest_vertices, 3)
    moved = _numbers("deformed_vertices", deformed_vertices, 3)
    texture = _numbers("uv", uv, 2)
    if not len(rest) == len(moved) == len(texture):
        raise StrainError(
            f"deformed_vertices, uv: got {len(moved)} and {len(texture)}, expected {len(rest)}"
        )
    given = np.asarray(faces)
    if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "iu":
        raise StrainError(f"faces: got {given.dtype} {given.shape}, expected integers (F, 3)")
    triangles = np.ascontiguousarray(given, np.int64)
    Checks(StrainError).within("faces", triangles, f"[0, {len(rest)})")
    place = index_points(rest, moved)
    triangle = kernels.triangle_strain(rest, moved, triangles, texture)
    places = int(place.max(initial=-1)) + 1
    stretch, column_s, column_t, tensor, metric, even, valid = kernels.vertex_strain(
        triangles, place, places, *triangle
    )
    lengths = [np.hypot(column[:, 0], column[:, 1]) for column in (column_s, column_t)]
    axes = [
        np.divide(column, length[:, None], out=np.zeros_like(column), where=length[:, None] > 0)
        for column, length in zip((column_s, column_t), lengths, strict=True)
    ]
    share = np.bincount(triangle[0], minlength=4) / max(len(triangles), 1)
    return MeshStrain(
        r_s=stretch[:, 0],
        r_t=stretch[:, 1],
        axis_s=axes[0],
        axis_t=axes[1],
        uv_per_mm_s=lengths[0],
        uv_per_mm_t=lengths[1],
        isotropic=even,
        valid=valid,
        tensor=tensor,
        uv_metric=metric,
        point_index=place,
        degenerate_share=float(share[kernels.DEGENERATE]),
        uv_degenerate_share=float(share[kernels.NO_TEXTURE]),
        uv_turned_share=float(share[kernels.TURNED]),
    )
