"""Photograph strained skin under a point light: shaded per texel, averaged over camera pixels.

The renderer is the project's own. Specular reflection: microfacets below the texels
(`model.brdf.microfacet`) on the relief's normals. Subsurface scattering: the dipole
(`model.dipole`). The relief shadows itself from the light; interreflection is omitted. The camera
is a pinhole with a Gaussian blur, photon noise and a gamma of 2.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from model import fresnel
from model.brdf import microfacet
from model.fresnel import ETA_SKIN
from skinrig.applying.strained_face import surface_normals
from skinrig.applying.subsurface_grid import gather_subsurface
from skinrig.arrays import BoolArray, Float32Array, Float64Array

FACET_ROUGHNESS: Final = 0.25
"""GGX roughness of facets below the texels, 10 um."""
SHADOW_STEPS_PX: Final = (1.0, 2.0, 3.0, 4.5, 6.5, 9.0, 12.0, 16.0, 22.0, 30.0)
"""Distances at which the ray to the light is compared with the relief, texels."""
MIN_COSINE: Final = 0.02


@dataclass(frozen=True, slots=True)
class FlashCamera:
    """A camera and a point light, aimed at the middle of the skin.

    Attributes
    ----------
    camera_tilt_rad, light_tilt_rad
        Angles from the normal towards -x (camera) and towards +x (light).
    camera_mm, light_mm
        Distances from the skin, mm.
    field_mm
        Width of the image on the skin, mm.
    size_px
        Width and height of the image.
    blur_px
        Standard deviation of the lens' blur.
    full_well
        Electrons of a white pixel.
    """

    camera_tilt_rad: float = 0.55
    light_tilt_rad: float = 0.75
    camera_mm: float = 400.0
    light_mm: float = 250.0
    field_mm: float = 12.0
    size_px: int = 600
    blur_px: float = 0.6
    full_well: float = 30_000.0


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """Radiance at the pixels of a photograph; NaN where no skin is visible.

    Attributes
    ----------
    specular : ndarray, shape (H, W)
        Light reflected at the surface.
    subsurface : ndarray, shape (H, W, 3)
        Light scattered below it: red, green, blue.
    """

    specular: Float64Array
    subsurface: Float64Array

    @property
    def total(self) -> Float64Array:
        """Return the whole radiance, (H, W, 3)."""
        return np.asarray(self.subsurface + self.specular[..., None])

    @property
    def specular_contrast(self) -> float:
        """Return the standard deviation of the specular radiance over its mean."""
        return float(np.nanstd(self.specular) / np.nanmean(self.specular))


def photograph(
    surface_mm: Float64Array, height_um: Float32Array, camera: FlashCamera
) -> Photograph:
    """Render displaced skin.

    Parameters
    ----------
    surface_mm
        Smooth surface, (N, N, 3), mm, row 0 at the top.
    height_um
        Displacement along its normals, (N, N), um.
    camera
        Camera and light.

    Returns
    -------
    Photograph
        Of a light whose irradiance at the aimed point is pi.
    """
    base = surface_normals(surface_mm)
    middle = tuple(n // 2 for n in surface_mm.shape[:2])
    aim, out = surface_mm[middle], base[middle]
    side = np.cross([0.0, 1.0, 0.0], out)
    side /= np.linalg.norm(side)
    eye, lamp = (
        aim + distance * (np.cos(tilt) * out + np.sin(tilt) * side)
        for distance, tilt in (
            (camera.camera_mm, -camera.camera_tilt_rad),
            (camera.light_mm, camera.light_tilt_rad),
        )
    )
    points = surface_mm + 1e-3 * height_um.astype(np.float64)[..., None] * base
    normals = surface_normals(points)
    to_light, light_mm = _directions(lamp, points)
    to_view, view_mm = _directions(eye, points)
    cos_light, cos_view = (np.einsum("ijk,ijk->ij", normals, way) for way in (to_light, to_view))
    lit = (cos_light > 0.0) & ~_shadowed(surface_mm, base, height_um, to_light)
    irradiance = np.pi * (camera.light_mm / light_mm) ** 2 * np.where(lit, cos_light, 0.0)
    half = to_light + to_view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    specular = irradiance * microfacet.brdf(
        cos_light,
        cos_view,
        np.clip(np.einsum("ijk,ijk->ij", normals, half), 0.0, 1.0),
        np.einsum("ijk,ijk->ij", half, to_view),
        roughness=FACET_ROUGHNESS,
        eta=ETA_SKIN,
    )
    area = np.linalg.norm(np.cross(*np.gradient(points, axis=(0, 1))), axis=-1)
    held = np.clip(cos_light, 0.0, 1.0)
    entered = irradiance * (1.0 - fresnel.reflectance(held, ETA_SKIN))
    leaves = gather_subsurface(points, area, entered) / np.pi
    leaves *= 1.0 - fresnel.reflectance(np.clip(cos_view, MIN_COSINE, 1.0), ETA_SKIN)[..., None]
    weight = np.clip(cos_view, 0.0, 1.0) * area / view_mm**2
    seen = _project(points, np.dstack([specular, leaves]), weight, eye, aim, camera)
    return Photograph(seen[..., 0], seen[..., 1:])


def develop(
    image: Float64Array, white: float, camera: FlashCamera, rng: np.random.Generator
) -> Float64Array:
    """Return gray or RGB levels, 0 to 1, of a radiance with photon noise."""
    electrons = np.clip(np.nan_to_num(image) / white, 0.0, 1.5) * camera.full_well
    counted = rng.poisson(electrons) / camera.full_well
    return np.asarray(np.clip(counted, 0.0, 1.0) ** (1.0 / 2.2))


def _directions(place: Float64Array, points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return unit vectors from points towards a place, and the distances, mm."""
    way = place - points
    length = np.linalg.norm(way, axis=-1)
    return way / length[..., None], length


def _shadowed(
    surface_mm: Float64Array, normals: Float64Array, height_um: Float32Array, to_light: Float64Array
) -> BoolArray:
    """Return the texels whose ray to the light passes below the relief."""
    down, right = np.gradient(surface_mm, axis=(0, 1))
    # ray in texels of the smooth surface: least squares on its tangents
    a, b, c = (
        np.einsum("ijk,ijk->ij", *pair) for pair in ((right, right), (right, down), (down, down))
    )
    p, q = (np.einsum("ijk,ijk->ij", to_light, way) for way in (right, down))
    det = a * c - b * b
    x, y = (c * p - b * q) / det, (a * q - b * p) / det
    length = np.maximum(np.hypot(x, y), 1e-9)
    rise_um = 1e3 * np.einsum("ijk,ijk->ij", to_light, normals) / length
    rows, columns = np.indices(height_um.shape, np.float32)
    x, y = ((part / length).astype(np.float32) for part in (x, y))
    hidden = np.zeros(height_um.shape, bool)
    for step in SHADOW_STEPS_PX:
        at = [rows + np.float32(step) * y, columns + np.float32(step) * x]
        there = ndimage.map_coordinates(height_um, at, order=1, mode="nearest")
        hidden |= there > height_um + step * rise_um
    return hidden


def _project(
    points: Float64Array,
    values: Float64Array,
    weight: Float64Array,
    eye: Float64Array,
    aim: Float64Array,
    camera: FlashCamera,
) -> Float64Array:
    """Average values over camera pixels by projected area, (H, W, C); NaN without texels."""
    forward = (aim - eye) / np.linalg.norm(aim - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    way = (points - eye).reshape(-1, 3)
    depth = way @ forward
    scale = camera.camera_mm * camera.size_px / camera.field_mm
    column = np.floor(scale * (way @ right) / depth + 0.5 * camera.size_px)
    row = np.floor(0.5 * camera.size_px - scale * (way @ up) / depth)
    inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < camera.size_px)
    inside &= weight.reshape(-1) > 0.0
    pixel = (row[inside] * camera.size_px + column[inside]).astype(np.int64)
    shares = weight.reshape(-1)[inside]
    count = camera.size_px**2
    total = np.asarray(np.bincount(pixel, shares, count), np.float64)
    planes = []
    for k in range(values.shape[-1]):
        summed = np.bincount(pixel, shares * values[..., k].reshape(-1)[inside], count)
        planes.append(_blur(np.asarray(summed, np.float64), total, camera))
    return np.stack(planes, axis=-1)


def _blur(summed: Float64Array, total: Float64Array, camera: FlashCamera) -> Float64Array:
    """Return the lens' blur of weighted sums over that of the weights, (H, W)."""
    shape = (camera.size_px, camera.size_px)
    over, under = (
        ndimage.gaussian_filter(part.reshape(shape), camera.blur_px) for part in (summed, total)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total.reshape(shape) > 0.0, over / under, np.nan)
