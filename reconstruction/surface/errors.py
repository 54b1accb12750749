"""Errors of estimates at surface points that are no noise: what a point's neighbors tell of them.

Scan, registration and cameras together place a sample within a fraction of an image's pixel, and
within a pixel the surface is averaged. What that does to an estimate goes by how much the estimated
quantity itself changes from a point to the next: much for the albedo of freckled or dark skin and
for the normals of a wrinkle, hardly for smooth skin. One number each, common to all faces, says how
much of that change is error.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.scan.mesh import RefinedScan
from reconstruction.surface.estimates import PointValues

POSITION_SIGMA_PX: Final = 0.27
"""Standard deviation of where a sample is on the surface, over the size of a pixel."""
UNRESOLVED_RELIEF_RAD: Final = np.radians(0.27)
"""Standard deviation, in each direction, of relief that is too fine for the points.

This and the one above bring intervals to their nominal coverage on simulated faces of seeds 0 to 2,
seen at 2.1 mm a pixel; see docs/decisions."""
UNRESOLVED_R_D_PX: Final = 1.55
"""Standard error of the albedo over what it changes by in a pixel: misplaced samples, and albedo
that is too fine for the pixels and the more of it, the more there is that is just not."""
SHARED_DETAIL_FRACTION: Final = 0.8
"""Share of the face's typical mean square change in that of a point, the rest is its neighbors'.

A few edges tell little of how much is finer than they are: where neighbors happen to look alike,
the albedo within a pixel goes on changing as elsewhere on the face."""
SHARED_R_D_ERROR: Final = 0.007
"""Relative error of the albedo that all points of a face share, of calibration and of relief within
pixels. Faces of seeds 1 to 3 lay 0.4 to 0.6 % below the truth blurred as by their pixels.

This and the two above were set on these faces (types V, I and II, 2.1 mm a pixel)."""
R_D_ERROR_PER_RAD: Final = 0.5
"""Relative error of the albedo by that of the normal, 1/rad: lights all around leave so much."""
N_NEIGHBOR_RINGS: Final = 2
"""Rings of neighbors that the albedo's change is averaged over: one point's edges are few."""
MIN_SPACING_PX: Final = 0.25
"""Points closer than this count as so far apart: noise is no slope."""


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
    """Return how fast a quantity changes over a surface about each of its points.

    Parameters
    ----------
    values
        (P, C) float64, of any unit; where not valid they are not read.
    points_mm
        (P, 3).
    faces
        (F, 3): triangles of the points.
    valid
        (P,) bool.
    pixel_mm
        Size of an image's pixel on the subject.
    noise
        (P, C): standard error of `values`, the share of the change that is noise.
    rings
        How often the mean square over a point's edges is averaged with its neighbors'.

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
    # noise taken off a mean of few edges can leave less than nothing
    return np.sqrt(np.maximum(mean, 0.0))


def add_normal_errors(normals: PointValues, surface: RefinedScan, pixel_mm: float) -> PointValues:
    """Add to the standard errors of normals what misplaced samples do to them.

    Parameters
    ----------
    normals
        At the surface's points.
    surface
        With its triangles: they say how fast the normals turn.
    pixel_mm
        Size of an image's pixel on the subject: scan, registration and cameras together place a
        sample within about `POSITION_SIGMA_PX` of it, and within it normals are averaged.
    """
    change = change_per_mm(
        normals.values, surface.points_mm, surface.faces, normals.valid, pixel_mm=pixel_mm
    )
    bend = np.linalg.norm(change, axis=1)  # rad/mm
    spread = np.hypot(POSITION_SIGMA_PX * pixel_mm * bend, UNRESOLVED_RELIEF_RAD)
    stderr = np.hypot(normals.stderr, spread[:, None])
    return PointValues(normals.values, np.where(normals.valid[:, None], stderr, 0.0), normals.valid)


def add_albedo_errors(
    r_d: PointValues, normals: PointValues, surface: RefinedScan, pixel_mm: float
) -> PointValues:
    """Add to the standard errors of the albedo what normals, misplaced samples and pixels do to it.

    Parameters
    ----------
    r_d
        At the surface's points, with the error that noise leaves.
    normals
        Of the same points: neighbors' errors are alike, and no noise of the albedo's change.
    surface
        With its triangles: they say how fast the albedo changes.
    pixel_mm
        Size of an image's pixel on the subject.

    Notes
    -----
    A pixel averages what is finer. The albedo of skin goes on to finer scales as it comes down to
    the pixel's, so what is lost is in proportion to what still shows between neighbors: between a
    point's own by a part, and by `SHARED_DETAIL_FRACTION` between those of the whole face (their
    median).
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
    stderr = np.hypot(r_d.stderr, UNRESOLVED_R_D_PX * pixel_mm * change)
    relative = np.hypot(SHARED_R_D_ERROR, R_D_ERROR_PER_RAD * normals.stderr[:, :1])
    stderr = np.hypot(stderr, relative * np.abs(r_d.values))
    return PointValues(r_d.values, np.where(r_d.valid[:, None], stderr, 0.0), r_d.valid)
