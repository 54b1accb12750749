"""Named points of a face, bound to its surface, so that they move with the skin."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import View
from rigsim.arrays import BoolArray, Float64Array, Int32Array
from rigsim.geometry.mesh import Mesh
from rigsim.package_data import package_table
from rigsim.render import Caster
from rigsim.subject.face_regions import from_mean_head
from rigsim.subject.head import LANDMARKS_MM

_PAIRED_POINTS_MM: Final[Mapping[str, tuple[float, float]]] = package_table("face")[
    "paired_points_mm"
]
_MIDLINE_POINTS_MM: Final[Mapping[str, tuple[float, float]]] = {
    "forehead low": (0.0, 52.0),
    "glabella": (0.0, 38.0),
    "nose base": (0.0, -22.0),
    "mouth": (0.0, -42.5),
}
_UNPAIRED_POINTS: Final = ("neck",)

POINTS_MM: Final[Mapping[str, tuple[float, float]]] = {
    **{name: (p[0], p[1]) for name, p in LANDMARKS_MM.items() if name not in _UNPAIRED_POINTS},
    **{f"{name} right": p for name, p in _PAIRED_POINTS_MM.items()},
    **{f"{name} left": (-p[0], p[1]) for name, p in _PAIRED_POINTS_MM.items()},
    **_MIDLINE_POINTS_MM,
}
"""Positions of the points in the front view of the mean head, (x, y) in mm; left and right as in
the image. On the skin they are where a ray along -z meets it."""

OCCLUSION_TOLERANCE_MM: Final = 0.5
"""A surface nearer than this to a point does not occlude it."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Points on a mesh that follow its vertices."""

    names: tuple[str, ...]
    corners: Int32Array
    """Vertices of each point's triangle, shape (n, 3)."""
    weights: Float64Array
    """Barycentric weights, shape (n, 3)."""

    def positions_on(self, mesh: Mesh) -> Float64Array:
        """Return the points' positions on a mesh of the same triangles, shape (n, 3), mm."""
        corners = mesh.vertices_mm[self.corners].astype(np.float64)
        return np.einsum("nk,nkc->nc", self.weights, corners)

    def uv(self, mesh: Mesh) -> Float64Array:
        """Return the points' texture coordinates, shape (n, 2)."""
        return np.einsum("nk,nkc->nc", self.weights, mesh.uv[self.corners].astype(np.float64))


def find_landmarks(mesh: Mesh) -> SurfacePoints:
    """Locate the named points on a face at rest.

    Parameters
    ----------
    mesh
        A face that looks toward +z.

    Returns
    -------
    SurfacePoints
        Those of `POINTS_MM` with skin below.
    """
    targets = np.array([(*xy, 0.0) for xy in POINTS_MM.values()])
    at = from_mean_head(targets, mesh)[:, :2]
    corners = mesh.vertices_mm.astype(np.float64)[mesh.faces]  # (F, 3, 3)
    flat = corners[..., :2]
    low, high = flat.min(axis=1), flat.max(axis=1)
    names, chosen, weights = [], [], []
    for name, point in zip(POINTS_MM, at, strict=True):
        near = np.flatnonzero(((low <= point) & (high >= point)).all(axis=1))
        share = _barycentric(flat[near], point)
        inside = (share > -1e-9).all(axis=1)
        if not inside.any():
            continue
        depth = np.einsum("nk,nk->n", share, corners[near, :, 2])
        first = np.argmax(np.where(inside, depth, -np.inf))
        names.append(name)
        chosen.append(mesh.faces[near[first]])
        weights.append(share[first])
    return SurfacePoints(
        tuple(names),
        np.array(chosen, np.int32).reshape(-1, 3),
        np.array(weights, np.float64).reshape(-1, 3),
    )


def project_points(points_mm: Float64Array, view: View) -> Float64Array:
    """Return the image positions of points, px.

    Parameters
    ----------
    points_mm
        Shape (n, 3), rig frame.
    view
        The camera, a pinhole.

    Returns
    -------
    ndarray
        Shape (n, 2): x to the right, y down; the center of pixel (0, 0) is (0, 0).
    """
    right, up, back = (np.asarray(axis) for axis in view.axes)
    way = points_mm - np.asarray(view.position_mm)
    scale = view.focal_px / -(way @ back)
    x = scale * (way @ right) + 0.5 * (view.width_px - 1)
    y = -scale * (way @ up) + 0.5 * (view.height_px - 1)
    return np.stack([x, y], axis=-1)


def is_visible(points_mm: Float64Array, view: View, caster: Caster) -> BoolArray:
    """Return which points are visible to a camera, shape (n,).

    Parameters
    ----------
    points_mm
        Points on the caster's mesh, shape (n, 3), rig frame.
    view
        The camera.
    caster
        Mesh that may occlude them.
    """
    pixels = project_points(points_mm, view)
    inside = (pixels > -0.5) & (pixels < np.array([view.width_px, view.height_px]) - 0.5)
    origin = np.asarray(view.position_mm)
    way = points_mm - origin
    distance = np.linalg.norm(way, axis=-1)
    way /= distance[:, None]
    before = caster.is_blocked(
        np.broadcast_to(origin, way.shape), way, distance - OCCLUSION_TOLERANCE_MM
    )
    return np.asarray(inside.all(axis=1) & ~before)


def _barycentric(triangles: Float64Array, point: Float64Array) -> Float64Array:
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, ac, ap = b - a, c - a, point - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    safe = np.where(area == 0.0, 1.0, area)
    w1 = np.where(area == 0.0, -1.0, (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / safe)
    w2 = np.where(area == 0.0, -1.0, (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / safe)
    return np.stack([1.0 - w1 - w2, w1, w2], axis=-1)
