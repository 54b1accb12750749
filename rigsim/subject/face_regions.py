"""Soft regions of a face, drawn around the landmarks of the mean head."""

from collections.abc import Mapping
from typing import Final, TypeAlias

import numpy as np

from rigsim.arrays import Float32Array, Float64Array, FloatArray
from rigsim.geometry.mesh import Mesh
from rigsim.package_data import package_table
from rigsim.subject.head import LANDMARKS_MM, lip_outline

REGION_NAMES: Final = (
    "forehead",
    "cheeks",
    "nose",
    "lips",
    "lids",
    "temples",
    "chin",
    "jaw",
    "neck",
    "crow",
    "brows",
    "mouth corners",
    "nose sides",
)
"""Regions that `region_masks` draws."""

_RegionBall: TypeAlias = tuple[str, tuple[float, float, float]]
"""A landmark, and radii along x, y, z in mm of a soft ball around it."""
_REGION_BALLS: Final[Mapping[str, tuple[_RegionBall, ...]]] = package_table("face")["region_balls"]

_BALL_CENTERS_MM: Final = dict(LANDMARKS_MM) | {
    "crow left": (-52.0, 24.0, -22.0),
    "crow right": (52.0, 24.0, -22.0),
    "fold left": (-22.0, -20.0, 2.0),
    "fold right": (22.0, -20.0, 2.0),
}


def to_mean_head(points_mm: Float32Array, mesh: Mesh) -> Float32Array:
    """Map points of a face mesh to the mean head.

    Parameters
    ----------
    points_mm
        Positions on the mesh, shape (..., 3), rig frame.
    mesh
        A face that looks toward +z.

    Returns
    -------
    ndarray of float32
        Shape (..., 3): scaled to equal width of the face, translated so that the tips of the noses
        coincide.
    """
    tip, scale = _tip_and_scale(mesh)
    mean_tip = np.array(LANDMARKS_MM["nose tip"])
    return np.asarray((points_mm - tip) * scale + mean_tip, np.float32)


def from_mean_head(points_mm: FloatArray, mesh: Mesh) -> Float64Array:
    """Map points of the mean head to a face mesh, the inverse of `to_mean_head`.

    Parameters
    ----------
    points_mm
        Positions on the mean head, shape (..., 3).
    mesh
        A face that looks toward +z.

    Returns
    -------
    ndarray of float64
        Shape (..., 3), rig frame.
    """
    tip, scale = _tip_and_scale(mesh)
    mean_tip = np.array(LANDMARKS_MM["nose tip"])
    return np.asarray((points_mm - mean_tip) / scale + tip, np.float64)


def mean_head_scale(mesh: Mesh) -> float:
    """Return the mm on the mean head per mm on a face mesh."""
    return _tip_and_scale(mesh)[1]


def _tip_and_scale(mesh: Mesh) -> tuple[Float64Array, float]:
    vertices = mesh.vertices_mm.astype(np.float64)
    tip = vertices[np.argmax(vertices[:, 2])]
    level = np.abs(vertices[:, 1] - tip[1]) < 25.0
    width = np.ptp(vertices[level, 0]) if level.any() else np.ptp(vertices[:, 0])
    return tip, MEAN_WIDTH_MM / max(float(width), 1e-6)


MEAN_WIDTH_MM: Final = 158.0
"""Width of the mean head within 25 mm of the height of the nose's tip, ears included."""


def region_masks(points_mm: Float32Array) -> dict[str, Float32Array]:
    """Draw the regions of a face.

    Parameters
    ----------
    points_mm
        Points on the mean head, shape (..., 3).

    Returns
    -------
    dict
        `REGION_NAMES` to masks in [0, 1], shape (...); soft, and they may overlap.
    """
    masks = {name: _balls(points_mm, balls) for name, balls in _REGION_BALLS.items()}
    masks["lips"] = _lips(points_mm)
    return masks


def _balls(
    points: Float32Array, balls: tuple[tuple[str, tuple[float, float, float]], ...]
) -> Float32Array:
    total = np.zeros(points.shape[:-1], np.float32)
    axes = [np.ascontiguousarray(points[..., k]) for k in range(3)]
    for name, radii in balls:
        # explicit sums of three terms are faster than a sum over an axis of three elements
        x, y, z = (
            (axis - np.float32(middle)) / np.float32(radius)
            for axis, middle, radius in zip(axes, _BALL_CENTERS_MM[name], radii, strict=True)
        )
        total = np.maximum(total, np.exp(-(x * x + y * y + z * z)))
    return total


def _lips(points: Float32Array) -> Float32Array:
    near = np.abs(points[..., 0]) < 26.0  # elsewhere it is 0
    masked = np.zeros(points.shape[:-1], np.float32)
    masked[near] = _lips_within(points[near])
    return masked


def _lips_within(points: Float32Array) -> Float32Array:
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    top, bottom = lip_outline(x)
    border_mm = 0.7  # the vermilion border is crisp
    inside = soft_step((top - y) / border_mm) * soft_step((y - bottom) / border_mm)
    return np.asarray(inside * soft_step((z + 22.0) / 4.0), np.float32)


def soft_step(t: FloatArray) -> FloatArray:
    """Return the soft membership of a border: 0 far below 0, 1 far above, smooth between.

    Parameters
    ----------
    t
        Distance from the border over its half width, any shape.
    """
    return 0.5 * (1.0 + np.tanh(t))
