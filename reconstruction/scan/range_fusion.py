"""Fuse range maps of several cameras into one mesh with a standard error at each vertex.

Signed distances are averaged in voxels near the surface (Curless and Levoy 1996, doi
10.1145/237170.237269), weighted by their inverse variance; marching cubes give the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import ndimage

from model.checks import Checks
from reconstruction.arrays import Float64Array
from reconstruction.scan.repair import ScanMeshError, TriangleMesh
from reconstruction.scan.triangulation import RangeMap

BAND_VOXELS: Final = 2.0
"""Distance from the surface within which voxels are used, in sides of a voxel."""
MIN_COSINE: Final = 0.2
"""Smallest cosine of incidence at a camera that is fused: 78 degrees."""
MAX_VOXELS: Final = 60_000_000


def fuse_ranges(maps: Sequence[RangeMap], *, voxel_mm: float) -> tuple[TriangleMesh, Float64Array]:
    """Fuse range maps into a triangle mesh.

    Parameters
    ----------
    maps : sequence of RangeMap
        In one frame.
    voxel_mm : float
        Side of a voxel, mm, > 0.

    Returns
    -------
    mesh : TriangleMesh
        Counter-clockwise from outside; open where no map has a range.
    stderr_mm : ndarray
        Standard error across the surface at each vertex, shape (V,): that of the weighted mean of
        the maps, whose errors are independent.

    Raises
    ------
    ScanMeshError
        When no map has a range, or the voxels are too small for the volume.
    """
    from skimage.measure import marching_cubes

    Checks(ScanMeshError).within("voxel_mm", voxel_mm, "(0, inf)")
    fused = [one.keep(one.valid & (one.cosine > MIN_COSINE)) for one in maps]
    points = np.concatenate([one.points_mm[one.valid] for one in fused] or [np.zeros((0, 3))])
    if not len(points):
        raise ScanMeshError("scan: got no decoded range, expected a face before the scanner")
    margin = BAND_VOXELS + 1.0
    low = points.min(axis=0) - margin * voxel_mm
    size = np.ceil((points.max(axis=0) - low) / voxel_mm + margin).astype(int) + 1
    if np.prod(size.astype(float)) > MAX_VOXELS:
        raise ScanMeshError(
            f"scan: got ranges over {np.ptp(points, axis=0).round().tolist()} mm, expected a "
            f"volume of at most {MAX_VOXELS} voxels of {voxel_mm:g} mm; use larger voxels"
        )
    near = np.zeros(size, np.bool_)
    near[tuple(np.floor((points - low) / voxel_mm).astype(int).T)] = True
    ball = np.linalg.norm(np.indices((7, 7, 7)) - 3, axis=0) <= BAND_VOXELS + 0.9
    cells = np.argwhere(ndimage.binary_dilation(near, ball))
    distance, weight = _mean_distance(fused, low + voxel_mm * cells, BAND_VOXELS * voxel_mm)
    field, precision = np.full(size, np.nan), np.zeros(size)
    field[tuple(cells.T)], precision[tuple(cells.T)] = distance, weight
    known = np.isfinite(field)
    # marching cubes uses a cube where the mask is set at its last corner
    whole = ndimage.binary_erosion(known, np.ones((2, 2, 2)))
    if not whole.any():
        raise ScanMeshError("scan: got ranges too sparse for a surface; use larger voxels")
    try:
        vertices, faces, _, _ = marching_cubes(
            np.where(known, field, 2.0 * BAND_VOXELS * voxel_mm), 0.0, mask=whole
        )
    except (RuntimeError, ValueError) as error:
        raise ScanMeshError(f"scan: {error}, expected a surface in front of the scanner") from error
    at = np.asarray(vertices, np.float64)
    total = ndimage.map_coordinates(precision, at.T, order=1)
    mesh = TriangleMesh(low + voxel_mm * at, np.asarray(faces, np.int64))
    return mesh, 1.0 / np.sqrt(np.maximum(total, 1e-300))


def _mean_distance(
    maps: Sequence[RangeMap], points_mm: Float64Array, band_mm: float
) -> tuple[Float64Array, Float64Array]:
    """Return the signed distance of points, > 0 outside, and its inverse variance."""
    total, weights, precision = np.zeros((3, len(points_mm)))
    for one in maps:
        pixel = one.camera.project(points_mm)
        way = np.linalg.norm(points_mm - one.camera.center_mm, axis=1)
        before, cosine, variance = _sample_ranges(one, pixel)
        across = (before - way) * cosine
        seen = np.isfinite(across) & (np.abs(across) < band_mm)
        inverse = 1.0 / np.maximum(variance[seen] * cosine[seen] ** 2, 1e-12)
        # far from a map's surface, the distance along the ray differs from that to the surface
        near = inverse * (1.0 - np.abs(across[seen]) / band_mm)
        total[seen] += near * across[seen]
        weights[seen] += near
        precision[seen] += inverse
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weights > 0, total / weights, np.nan), precision


def _sample_ranges(
    one: RangeMap, pixel: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return range, cosine and the range's variance between four pixels; NaN unless all have one.

    The interpolated range's variance is that of four independent ranges.
    """
    height, width = one.range_mm.shape
    place = np.nan_to_num(pixel, nan=-9.0)
    corner = np.floor(place).astype(np.int64)
    inside = ((corner >= 0) & (corner < [width - 1, height - 1])).all(axis=1)
    corner[~inside] = 0
    part = place - corner
    sums = np.zeros((3, len(pixel)))
    for dx in (0, 1):
        for dy in (0, 1):
            at = corner[:, 1] + dy, corner[:, 0] + dx
            share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            sums[0] += share * one.range_mm[at]
            sums[1] += share * one.cosine[at]
            sums[2] += (share * one.stderr_mm[at]) ** 2
    sums[:, ~inside] = np.nan
    return sums[0], sums[1], sums[2]
