"""Lumitexels: all that was seen of one surface point, over views and lights.

The samples of a point are BRDF values with their variances, their directions to light and camera,
and a mask of those that count: the point faces both, nothing stands between, the pixel is good.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int32Array
from reconstruction.lumitexels.ray_casting import RayCaster

MIN_VISIBLE_COSINE: Final = 0.1
"""A point seen or lit at a flatter angle gives no sample: 84 degrees."""
SHADOW_RAY_OFFSET_MM: Final = 0.1
"""Shadow rays start so far above the surface."""


class CameraProjection(Protocol):
    """What is needed of a calibrated camera."""

    @property
    def center_mm(self) -> Float64Array:
        """Centre of projection, shape (3,), mm."""

    def project(self, points_mm: ArrayLike) -> Float64Array:
        """Return columns and rows, shape (N, 2), px; NaN behind the camera."""


class LightSources(Protocol):
    """What is needed of calibrated lights."""

    @property
    def position_mm(self) -> Float64Array:
        """Positions, shape (L, 3), mm."""

    def irradiance(self, points_mm: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Return unit directions to the lights and the signal of a white that faces them.

        Both of shape (L, P, 3); the second is the irradiance across the direction over pi, in the
        unit of the images.
        """


@dataclass(frozen=True, slots=True, eq=False)
class SampledSurface:
    """Points that samples are gathered for."""

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
    """Of `f`, shape (P, M, 3), 1/sr^2; infinite where not valid."""
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
    """Samples that count, shape (P, M)."""

    @property
    def counts(self) -> NDArray[np.intp]:
        """Valid samples of each point, shape (P,)."""
        return np.count_nonzero(self.valid, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Which points face, and are not hidden from, each light and each camera."""

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
    """Find by rays which points see which cameras and lights.

    Parameters
    ----------
    surface : Surface
    caster : RayCaster
        What may stand in between, as a rule the whole mesh.
    cameras_mm, lights_mm : array_like, shape (V, 3), (L, 3)
    light_radius_mm : float
        With a radius > 0, four points of a light's rim must be seen: samples in half shadow do
        not count.
    offset_mm : float
        Height above the surface at which rays start.
    min_cosine : float
        Least cosine to the normal.
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
    """Return four points of the rim of a disc that faces the origin."""
    axis = center / np.linalg.norm(center)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    return [np.asarray(center + radius * way, np.float32) for way in (side, other, -side, -other)]
