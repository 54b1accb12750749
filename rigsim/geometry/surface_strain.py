"""Measure how a deformed mesh stretches and shears its surface."""

from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.mesh import Mesh

ROUNDING_STEPS: Final = 4.0
"""Strains below this number of float32 steps of a position, over the triangle's height, are 0."""

_FLOAT32_EPS: Final = float(np.finfo(np.float32).eps)


def principal_log_strains(rest: Mesh, moved_mm: Float32Array) -> Float64Array:
    """Return the principal logarithmic strains of each triangle in its plane.

    They are the logarithms of the principal stretches: positive where the skin is longer than at
    rest. Their sum is the logarithm of the ratio of areas, their difference measures shear.

    Parameters
    ----------
    rest
        Mesh at rest.
    moved_mm
        Its vertices after the movement, shape (V, 3).

    Returns
    -------
    ndarray of float64
        Shape (F, 2), larger strain first. Exactly 0 where the triangle moved rigidly, up to the
        rounding of single precision, and for triangles without area at rest or afterwards.

    Examples
    --------
    >>> from rigsim.geometry.mesh import build_mesh
    >>> flat = build_mesh([[0, 0, 0], [8, 0, 0], [0, 8, 0]], [[0, 1, 2]], [[0, 0], [1, 0], [0, 1]])
    >>> wider = flat.vertices_mm * np.array([1.25, 1, 1], np.float32)
    >>> np.exp(principal_log_strains(flat, wider)).round(4).tolist()
    [[1.25, 1.0]]
    """
    (xx, xy, yy), height = _edge_products(rest.vertices_mm, rest.faces)
    (moved_xx, moved_xy, moved_yy), moved_height = _edge_products(moved_mm, rest.faces)
    squared_area = xx * yy - xy * xy
    squared_moved_area = moved_xx * moved_yy - moved_xy * moved_xy
    known = (height > 0.0) & (moved_height > 0.0)
    squared_area = np.where(known, squared_area, 1.0)
    # eigenvalues of the right Cauchy-Green tensor in the plane: the squared principal stretches
    half_trace = 0.5 * (yy * moved_xx - 2.0 * xy * moved_xy + xx * moved_yy) / squared_area
    determinant = squared_moved_area / squared_area
    spread = np.sqrt(np.maximum(half_trace**2 - determinant, 0.0))
    larger = np.where(known, half_trace + spread, 1.0)
    # the product is accurate where the difference would cancel
    smaller = np.where(known, determinant / np.where(larger > 0.0, larger, 1.0), 1.0)
    strains = 0.5 * np.log(np.stack([larger, smaller], axis=-1))
    reach = np.maximum(
        np.abs(rest.vertices_mm[rest.faces]).max(axis=(1, 2)),
        np.abs(moved_mm[rest.faces]).max(axis=(1, 2)),
    )
    least = np.minimum(height, moved_height)
    rounding = ROUNDING_STEPS * _FLOAT32_EPS * reach / np.where(known, least, 1.0)
    return np.where(np.abs(strains) > rounding[:, None], strains, 0.0)


def average_at_vertices(mesh: Mesh, values: Float64Array) -> Float64Array:
    """Average values of triangles at the vertices, weighted by area.

    Vertices at the same position, such as those on both sides of a seam of the texture, get the
    same value.

    Parameters
    ----------
    mesh
        The mesh at rest.
    values
        One value per triangle, shape (F,).

    Returns
    -------
    ndarray of float64
        Shape (V,); 0 at vertices without a triangle that has an area.
    """
    _, place = np.unique(mesh.vertices_mm, axis=0, return_inverse=True)
    corners = place.reshape(-1)[mesh.faces]
    edge, other = _edges(mesh.vertices_mm, mesh.faces)
    area = np.linalg.norm(np.cross(edge, other), axis=-1)
    weight = np.repeat(area, 3)
    count = len(mesh.vertices_mm)
    total = np.bincount(corners.reshape(-1), weight * np.repeat(values, 3), minlength=count)
    norm = np.bincount(corners.reshape(-1), weight, minlength=count)
    mean = np.divide(total, norm, out=np.zeros(count), where=norm > 0.0)
    return np.asarray(mean[place.reshape(-1)])


def _edges(vertices_mm: Float32Array, faces: np.ndarray) -> tuple[Float64Array, Float64Array]:
    corners = vertices_mm.astype(np.float64)[faces]
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def _edge_products(
    vertices_mm: Float32Array, faces: np.ndarray
) -> tuple[tuple[Float64Array, Float64Array, Float64Array], Float64Array]:
    """Return the scalar products of two edges, and the smallest height of each triangle, mm."""
    edge, other = _edges(vertices_mm, faces)
    third = other - edge
    products = tuple(
        np.sum(a * b, axis=-1) for a, b in ((edge, edge), (edge, other), (other, other))
    )
    longest = np.sqrt(np.maximum(np.maximum(products[0], products[2]), np.sum(third**2, axis=-1)))
    double_area = np.linalg.norm(np.cross(edge, other), axis=-1)
    height = np.divide(double_area, longest, out=np.zeros_like(longest), where=longest > 0.0)
    return (products[0], products[1], products[2]), height
