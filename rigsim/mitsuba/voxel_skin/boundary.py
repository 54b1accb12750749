"""Read the boundary above voxel skin from a Mitsuba scene."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rigsim.arrays import Float64Array
from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.voxel_skin.medium import FAR_MM

SLOPE_WIDTH: Final = 1.2
"""Width of the normals drawn for a relief over that of its normals and facets together."""
RELIEF_TOL: Final = 1e-6
"""Height range over the width of a shape that counts as flat."""


@dataclass(frozen=True, slots=True)
class Boundary:
    """The surface above the voxels."""

    shape: Any
    """Mitsuba's shape, with an interior medium."""
    height: float
    """Mean height, mm."""
    lowest: float
    """Lowest point, mm."""
    eta: float
    """Refractive index of the inside over that of the outside; 1 for a ``null`` BSDF."""
    is_rough: bool
    """Whether light is scattered by the boundary itself."""
    facets: Any
    """Distribution of the normals through which connections are refracted; None if not rough."""


def read_boundary(mi: Any, shape: Any) -> Boundary:
    """Read the place, index and roughness of a boundary.

    Parameters
    ----------
    mi
        Mitsuba with the active variant.
    shape
        Shape with an interior medium, its mean plane normal to z.

    Raises
    ------
    RenderError
        The BSDF is not supported, or not on a relief.
    """
    bsdf, box = shape.bsdf(), shape.bbox()
    kind = bsdf.class_name()
    low, high = np.ravel(box.min).astype(np.float64), np.ravel(box.max).astype(np.float64)
    flat = high[2] - low[2] <= RELIEF_TOL * (high - low).max()
    eta, is_rough = 1.0, kind == "RoughDielectric"
    parameters = mi.traverse(bsdf)
    if kind not in ("RoughDielectric", "SmoothDielectric", "NullBSDF", "Null"):
        raise RenderError(
            f"tissue: bsdf: got {kind}, expected one of dielectric, roughdielectric, null"
        )
    if not flat and not is_rough:
        raise RenderError(
            f"tissue: bsdf: got {kind} on a relief of {high[2] - low[2]:.3g} mm, expected "
            "roughdielectric; set its alpha"
        )
    if kind != "NullBSDF" and "eta" in parameters:
        eta = float(np.ravel(parameters["eta"])[0])
    height, spread2 = float(high[2]), 0.0
    if not flat:
        height, spread2 = _mean_plane(mi, shape)
    facets = None
    if is_rough:
        alpha = float(np.ravel(parameters["alpha.value"]).max())
        beckmann = flat and "beckmann" in str(bsdf)
        width = alpha if flat else SLOPE_WIDTH * float(np.sqrt(alpha**2 + spread2))
        name = mi.MicrofacetType.Beckmann if beckmann else mi.MicrofacetType.GGX
        facets = mi.MicrofacetDistribution(name, width, False)
    return Boundary(shape, height, float(low[2]), eta, is_rough, facets)


def _mean_plane(mi: Any, shape: Any) -> tuple[float, float]:
    """Return a mesh's mean height and the squared roughness (twice the slopes' variance)."""
    parameters = mi.traverse(shape)
    corners = np.array(parameters["vertex_positions"].numpy(), np.float64).reshape(-1, 3)
    faces = np.array(parameters["faces"].numpy()).reshape(-1, 3)
    triangle = corners[faces]
    across = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    area = np.abs(across[:, 2])
    slope2 = (across[:, :2] ** 2).sum(axis=1) / np.maximum(area, 1e-12) ** 2
    height = float(np.average(triangle[..., 2].mean(axis=1), weights=area))
    return height, float(np.average(slope2, weights=area))


def find_safe_box(mi: Any, scene: Any, boundary: Boundary) -> tuple[list[float], list[float]]:
    """Return the corners of a box below the boundary that no surface enters.

    Parameters
    ----------
    mi
        Mitsuba with the active variant.
    scene
        The scene.
    boundary
        Its boundary.

    Returns
    -------
    low, high : list of float
        Corners, mm; both at the origin if no box is free of surfaces.
    """
    least, most = _corners(mi, boundary.shape)
    low, high = least.min(axis=0), most.max(axis=0)
    middle = 0.5 * (low + high)
    margin = 1e-6 * float((high - low).max())
    middle[2] = low[2] - 2.0 * margin
    low[2], high[2] = -FAR_MM, low[2]
    for shape in scene.shapes():
        least, most = _corners(mi, shape)
        gaps = np.concatenate([least - middle, middle - most], axis=1)
        gaps[~np.isfinite(gaps)] = -1.0
        if not (gaps.max(axis=1) > 0.0).all():
            return [0.0] * 3, [0.0] * 3
        side = gaps.argmax(axis=1)
        for axis in range(3):
            high[axis] = least[side == axis, axis].min(initial=high[axis])
            low[axis] = most[side == axis + 3, axis].max(initial=low[axis])
    return (low + margin).tolist(), (high - margin).tolist()


def _corners(mi: Any, shape: Any) -> tuple[Float64Array, Float64Array]:
    """Return the corners of the boxes of a shape's triangles, or of the shape, shape (n, 3).

    Mitsuba merges shapes of one BSDF into a mesh without a valid box.
    """
    parameters = mi.traverse(shape)
    if "vertex_positions" in parameters and "faces" in parameters:
        corners = np.array(parameters["vertex_positions"].numpy(), np.float64).reshape(-1, 3)
        triangles = corners[np.array(parameters["faces"].numpy()).reshape(-1, 3)]
        return triangles.min(axis=1), triangles.max(axis=1)
    box = shape.bbox()
    least, most = (np.ravel(part).astype(np.float64)[None] for part in (box.min, box.max))
    return least, most
