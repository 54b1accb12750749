"""Lumitexels: samples of one surface point over views and lights.

The samples of a point are BRDF values with their variances and their directions to light and
camera. A mask selects the usable ones: the point faces both, is not occluded, and the pixel is
valid.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int32Array
from reconstruction.lumitexels.ray_casting import RayCaster

MIN_VISIBLE_COSINE: Final = 0.1
"""Minimum cosine of view and light of a sample: 84 degrees."""
SHADOW_RAY_OFFSET_MM: Final = 0.1
"""Height above the surface at which shadow rays start."""


class CameraProjection(Protocol):
    """Interface of a calibrated camera."""

    @property
    def center_mm(self) -> Float64Array:
        """Center of projection, shape (3,), mm."""

    def project(self, points_mm: ArrayLike) -> Float64Array:
        """Return columns and rows, shape (N, 2), px; NaN behind the camera."""


class LightSources(Protocol):
    """Interface of calibrated lights."""

    @property
    def position_mm(self) -> Float64Array:
        """Positions, shape (L, 3), mm."""

    def irradiance(self, points_mm: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Return unit directions to the lights, and the signal of a white surface facing them.

        Both of shape (L, P, 3); the second is the irradiance normal to the direction over pi, in
        the unit of the images.
        """


@dataclass(frozen=True, slots=True, eq=False)
class SampledSurface:
    """Points at which samples are collected."""

    points_mm: Float32Array
    """Shape (P, 3), rig frame, mm."""
    normals: Float32Array
    """Unit, outward, shape (P, 3)."""

    def __post_init__(self) -> None:
        for name in ("points_mm", "normals"):
            array = np.ascontiguousarray(getattr(self, name), np.float32)
            Checks().numbers(name, array, (None, 3))
            object.__setattr__(self, name, array)
        Checks().shape("normals", self.normals, self.points_mm.shape)
        length = np.linalg.norm(self.normals, axis=1)
        Checks().within("lengths of normals", length, "[0.999, 1.001]")

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Lumitexels:
    """Samples of P points; M = views x lights, the lights of a view together."""

    f: Float32Array
    """BRDF samples, shape (P, M, 3), 1/sr: radiance / (normal irradiance cos theta); 0 where not
    valid."""
    variance: Float32Array
    """Variance of `f`, shape (P, M, 3), 1/sr^2; infinite where not valid."""
    light_dir: Float32Array
    """Unit vectors from point to light, shape (P, M, 3), in the frame of the points."""
    view_dir: Float32Array
    """Unit vectors from point to camera, shape (P, M, 3)."""
    cos_light: Float32Array
    """Cosine between the surface's normal and `light_dir`, shape (P, M)."""
    cos_view: Float32Array
    """Cosine between the surface's normal and `view_dir`, shape (P, M)."""
    light: Int32Array
    """Index of the light of each sample, shape (M,)."""
    view: Int32Array
    """Index of the view of each sample, shape (M,)."""
    valid: BoolArray
    """Usable samples, shape (P, M)."""

    @property
    def counts(self) -> NDArray[np.intp]:
        """Number of valid samples of each point, shape (P,)."""
        return np.count_nonzero(self.valid, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Visibility of points from each light and each camera."""

    light: BoolArray
    """Shape (L, P)."""
    view: BoolArray
    """Shape (V, P)."""


def compute_visibility(
    surface: SampledSurface,
    caster: RayCaster,
    *,
    cameras_mm: ArrayLike,
    lights_mm: ArrayLike,
    light_radius_mm: float = 0.0,
    offset_mm: float = SHADOW_RAY_OFFSET_MM,
    min_cosine: float = MIN_VISIBLE_COSINE,
) -> Visibility:
    """Trace rays to find the points visible from each camera and light.

    Parameters
    ----------
    surface : SampledSurface
    caster : RayCaster
        Occluding geometry, usually the whole mesh.
    cameras_mm, lights_mm : array_like, shape (V, 3), (L, 3)
    light_radius_mm : float
        With a radius > 0, four points of a light's rim must be visible: samples in penumbra are
        invalid.
    offset_mm : float
        Height above the surface at which rays start.
    min_cosine : float
        Minimum cosine to the normal.
    """

    def seen(target: FloatArray) -> BoolArray:
        way = target - surface.points_mm
        length = np.linalg.norm(way, axis=1, keepdims=True)
        way /= length
        facing = np.flatnonzero(np.einsum("pk,pk->p", way, surface.normals) > min_cosine)
        start = surface.points_mm[facing] + np.float32(offset_mm) * surface.normals[facing]
        out = np.zeros(len(surface), np.bool_)
        out[facing] = ~caster.is_blocked(start, way[facing], length[facing, 0])
        return out

    lights = np.asarray(lights_mm, np.float32).reshape(-1, 3)
    view = [seen(c) for c in np.asarray(cameras_mm, np.float32).reshape(-1, 3)]
    light = []
    for target in lights:
        ends = _rim(target, light_radius_mm) if light_radius_mm > 0 else [target]
        light.append(np.logical_and.reduce([seen(end) for end in ends]))
    none = np.zeros((0, len(surface)), np.bool_)
    return Visibility(np.array(light) if light else none, np.array(view) if view else none)


def _rim(center: FloatArray, radius: float) -> list[FloatArray]:
    """Return four points on the rim of a disc that faces the origin."""
    axis = center / np.linalg.norm(center)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    return [np.asarray(center + radius * way, np.float32) for way in (side, other, -side, -other)]
