"""Estimate errors other than noise at surface points from the change between neighboring points.

Scan, registration and cameras together position a sample within a fraction of an image's pixel, and
a pixel averages the surface within it. The resulting error is proportional to the local change of
the estimated quantity: large for the albedo of freckled or dark skin and for the normals of a
wrinkle, small for smooth skin. The factors of proportionality are common to all faces.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.scan.mesh import RefinedScan
from reconstruction.surface.estimates import PointValues

POSITION_SIGMA_PX: Final = 0.27
"""Standard deviation of a sample's position on the surface, over the size of a pixel."""
UNRESOLVED_RELIEF_RAD: Final = np.radians(0.27)
"""Standard deviation, in each direction, of surface topography too fine for the points.

This value and the one above give intervals their nominal coverage on simulated faces of seeds 0 to
2 at 2.1 mm per pixel; see docs/decisions."""
UNRESOLVED_R_D_PX: Final = 1.55
"""Standard error of the albedo over its change per pixel: from misregistered samples, and from
albedo detail below the pixel size, whose amount is proportional to the detail just above it."""
SHARED_DETAIL_FRACTION: Final = 0.8
"""Fraction of the face's median mean square change in that of a point; the rest is local.

The few edges at a point estimate its fine detail badly: where neighbors have the same albedo by
chance, the albedo within a pixel still varies as elsewhere on the face."""
SHARED_R_D_ERROR: Final = 0.007
"""Relative error of the albedo common to all points of a face, from calibration and from surface
topography within pixels. On faces of seeds 1 to 3 the albedo was 0.4 to 0.6 % below the ground
truth blurred by their pixels.

This value and the two above were fitted on these faces (types V, I and II, 2.1 mm per pixel)."""
R_D_ERROR_PER_RAD: Final = 0.5
"""Relative error of the albedo by that of the normal, 1/rad, with lights in all directions."""
INTERIOR_R_D_ERROR: Final = 0.007
"""Error of the albedo, over its mean over channels, by light that a Lambertian interior lacks.

Light that entered obliquely leaves forward. The fitted lobes take a part of it, relatively more on
dark skin. Set on voxel skin of 12 people, types I to VI; see docs/validation/voxel-skin.md."""
N_NEIGHBOR_RINGS: Final = 2
"""Rings of neighbors over which the albedo's change is averaged, as one point has few edges."""
MIN_SPACING_PX: Final = 0.25
"""Minimum distance of points in the slope; at smaller distances noise would count as slope."""


def change_per_mm(
    values: Float64Array,
    points_mm: FloatArray,
    faces: NDArray[np.integer],
    valid: BoolArray,
    *,
    pixel_mm: float,
    noise: Float64Array | None = None,
    rings: int = 0,
) -> Float64Array:
    """Return the root mean square change per mm of a quantity at each point of a surface.

    Parameters
    ----------
    values
        (P, C) float64, of any unit; ignored where not valid.
    points_mm
        (P, 3).
    faces
        (F, 3): triangles of the points.
    valid
        (P,) bool.
    pixel_mm
        Size of an image's pixel on the subject.
    noise
        (P, C): standard error of `values`, whose part of the change is subtracted.
    rings
        Number of times that the mean square is averaged over a point's neighbors.

    Returns
    -------
    ndarray
        (P, C): root of the mean square over the edges at a point, unit / mm; 0 at a point without
        a valid neighbor.

    Examples
    --------
    A ramp of 0.2 / mm:

    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    >>> ramp = change_per_mm(0.2 * points[:, :1], points, np.array([[0, 1, 2]]),
    ...                      np.ones(3, bool), pixel_mm=1.0)
    >>> ramp.round(2).tolist()
    [[0.14], [0.17], [0.1]]
    """
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges = np.unique(edges[valid[edges].all(axis=1)], axis=0)
    a, b = edges.T
    square = np.square(values[a] - values[b])
    if noise is not None:
        # independent noise adds var(a) + var(b) to the squared difference of two points
        square = square - np.square(noise[a]) - np.square(noise[b])
    apart = np.linalg.norm(points_mm[a] - points_mm[b], axis=1).astype(np.float64)
    square /= np.square(np.maximum(apart, MIN_SPACING_PX * pixel_mm))[:, None]
    count = np.zeros(len(valid))
    mean = np.zeros(values.shape)
    for side in (a, b):
        np.add.at(count, side, 1.0)
        np.add.at(mean, side, square)
    mean /= np.maximum(count, 1.0)[:, None]
    for _ in range(rings):
        total = mean.copy()
        for here, there in ((a, b), (b, a)):
            np.add.at(total, here, mean[there])
        mean = total / (1.0 + count)[:, None]
    # subtracting noise from a mean of few edges can give a negative value
    return np.sqrt(np.maximum(mean, 0.0))


def add_normal_errors(normals: PointValues, surface: RefinedScan, pixel_mm: float) -> PointValues:
    """Add the error of misregistered samples to the standard errors of normals.

    Parameters
    ----------
    normals
        At the surface's points.
    surface
        Its triangles define the edges over which the normals' change is measured.
    pixel_mm
        Size of an image's pixel on the subject: scan, registration and cameras together position a
        sample within about `POSITION_SIGMA_PX` of it, and within it normals are averaged. In closed
        holes, the error of the surface adds to this.
    """
    change = change_per_mm(
        normals.values, surface.points_mm, surface.faces, normals.valid, pixel_mm=pixel_mm
    )
    bend = np.linalg.norm(change, axis=1)  # rad/mm
    shift_mm = np.hypot(POSITION_SIGMA_PX * pixel_mm, surface.patch_stderr_mm)
    spread = np.hypot(shift_mm * bend, UNRESOLVED_RELIEF_RAD)
    stderr = np.hypot(normals.stderr, spread[:, None])
    return PointValues(normals.values, np.where(normals.valid[:, None], stderr, 0.0), normals.valid)


def add_albedo_errors(
    r_d: PointValues, normals: PointValues, surface: RefinedScan, pixel_mm: float
) -> PointValues:
    """Add errors by normals, misregistered samples and pixel size to those of the albedo.

    Parameters
    ----------
    r_d
        At the surface's points, with the standard error by noise.
    normals
        Of the same points; their errors are correlated between neighbors.
    surface
        Its triangles define the edges over which the albedo's change is measured.
    pixel_mm
        Size of an image's pixel on the subject.

    Notes
    -----
    A pixel averages finer detail. The spectrum of skin albedo continues below the pixel size, so
    the lost variation is proportional to the change between neighboring points: a mixture of the
    point's own change and, by `SHARED_DETAIL_FRACTION`, the face's median change.
    """
    change = change_per_mm(
        r_d.values,
        surface.points_mm,
        surface.faces,
        r_d.valid,
        pixel_mm=pixel_mm,
        noise=r_d.stderr,
        rings=N_NEIGHBOR_RINGS,
    )
    known = change[r_d.valid]
    typical = np.median(known, axis=0) if len(known) else np.zeros(change.shape[1])
    change = np.hypot(
        np.sqrt(1.0 - SHARED_DETAIL_FRACTION) * change, np.sqrt(SHARED_DETAIL_FRACTION) * typical
    )
    blur_mm = np.hypot(UNRESOLVED_R_D_PX * pixel_mm, surface.patch_stderr_mm)
    stderr = np.hypot(r_d.stderr, blur_mm[:, None] * change)
    relative = np.hypot(SHARED_R_D_ERROR, R_D_ERROR_PER_RAD * normals.stderr[:, :1])
    stderr = np.hypot(stderr, relative * np.abs(r_d.values))
    return PointValues(r_d.values, np.where(r_d.valid[:, None], stderr, 0.0), r_d.valid)


def interior_error(r_d: FloatArray) -> Float64Array:
    """Return the standard error of the albedo by directions of light from below the surface.

    Parameters
    ----------
    r_d
        (..., C): albedo.

    Returns
    -------
    ndarray
        (..., C): proportional to a channel's part of the albedo; at most the albedo's size.

    Examples
    --------
    >>> interior_error(np.array([0.4, 0.3, 0.2])).round(4).tolist()
    [0.0093, 0.007, 0.0047]
    """
    size = np.abs(np.asarray(r_d, np.float64))
    mean = np.maximum(size.mean(axis=-1, keepdims=True), INTERIOR_R_D_ERROR)
    return np.asarray(size * (INTERIOR_R_D_ERROR / mean), np.float64)


def add_interior_errors(r_d: PointValues) -> PointValues:
    """Add `interior_error` to the standard errors of the albedo."""
    stderr = np.hypot(r_d.stderr, interior_error(r_d.values))
    return PointValues(r_d.values, np.where(r_d.valid[:, None], stderr, 0.0), r_d.valid)
