"""Estimate rough normals of a scan's surface in one view by photometric stereo."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from model.fresnel import ETA_SKIN, reflectance
from reconstruction.arrays import Float32Array, Float64Array, FloatArray
from reconstruction.lumitexels import CameraProjection, LightSources
from reconstruction.lumitexels.ray_casting import RayCaster

COS_HIGHLIGHT: Final = float(np.cos(np.radians(45.0)))
"""Cosine between half vector and normal above which a sample may be in a highlight: 45 degrees."""
MIN_SCAN_LIGHTS: Final = 9
"""Fewest lights used at a pixel, even if some are nearer to the highlight."""
N_SHADOW_ROUNDS: Final = 4
"""Rounds of least squares, each omitting more shadows."""
MIN_COS_LIGHT: Final = 0.3
MIN_COS_VIEW: Final = 0.2


class ScanRegistrationError(ValueError):
    """Photographs that do not determine the scan's pose."""


class RayCamera(CameraProjection, Protocol):
    """A camera that also gives the rays of its pixels."""

    def rays(self, pixels: ArrayLike) -> Float64Array:
        """Return unit vectors from the camera through pixels, shape (..., 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class NormalEvidence:
    """Normals of one view, from the shading of its pixels."""

    camera: RayCamera
    normals: Float32Array
    """Unit, rig frame, shape (H, W, 3); zeros where unknown."""
    weight: Float32Array
    """Trust, 0 to 1, shape (H, W)."""
    binning: int = 1
    """Camera pixels along each side of a pixel here."""


def estimate_rough_normals(
    stack: FloatArray,
    camera: RayCamera,
    lights: LightSources,
    caster: RayCaster,
    *,
    surface_normals: FloatArray,
    binning: int = 1,
) -> NormalEvidence:
    """Estimate normals from one view's images under single lights.

    Parameters
    ----------
    stack : ndarray, shape (L, H, W)
        Signal under each light, one channel or the mean of several; NaN where not valid.
    camera : RayCamera
    lights : LightSources
        As many as there are images.
    caster : RayCaster
        The scan about where it is; gives the distance of each pixel's surface from the lights.
    surface_normals : ndarray, shape (F, 3)
        Unit normals of the scan's triangles in its present pose; they locate highlights within
        some degrees.
    binning : int
        Camera pixels along each side of an image pixel.

    Notes
    -----
    ``signal / irradiance = albedo T(l) T(v) n . l`` by least squares, with T the fraction of light
    transmitted by the skin's boundary (Fresnel, eta 1.4). Omitted are samples whose half vector is
    within 45 degrees of the scan's normal, where the boundary reflects, and grazing ones, where T
    falls steeply. Shadows and outliers (Cauchy weights) lose weight from round to round.
    """
    count, height, width = stack.shape
    if count != len(lights.position_mm):
        raise ScanRegistrationError(
            f"stack: got {count} images, expected {len(lights.position_mm)}, one per light; "
            "select the lights of the images"
        )
    row, column = np.mgrid[0:height, 0:width]
    pixels = np.stack([column, row], axis=-1).reshape(-1, 2) * binning + 0.5 * (binning - 1)
    ways = camera.rays(pixels)
    center = np.broadcast_to(camera.center_mm, ways.shape)
    hit, distance = caster.first_hit(center, ways)
    met = np.flatnonzero(hit >= 0)
    normals = np.zeros((height * width, 3), np.float32)
    weight = np.zeros(height * width, np.float32)
    for part in np.array_split(met, max(len(met) // 20_000, 1)):
        points = center[part] + distance[part, None] * ways[part]
        direction, white = lights.irradiance(points)
        values = stack.reshape(count, -1)[:, part] / np.maximum(white.mean(axis=-1), 1e-30)
        rough = surface_normals[hit[part]]
        cos_view = -np.einsum("pk,pk->p", ways[part], rough)
        cos_light = np.einsum("lpk,pk->lp", direction, rough)
        half = direction - ways[part]
        cos_half = np.einsum("lpk,pk->lp", half, rough) / np.linalg.norm(half, axis=-1)
        facing_light = cos_light > MIN_COS_LIGHT
        # with few lights, keep those farthest from the highlight
        ordered = np.sort(np.where(facing_light, cos_half, np.inf), axis=0)
        edge = np.maximum(ordered[min(MIN_SCAN_LIGHTS, count) - 1], COS_HIGHLIGHT)
        diffuse = facing_light & (cos_half <= edge) & (cos_view > MIN_COS_VIEW)
        passed = _boundary_transmittance(cos_light) * _boundary_transmittance(cos_view)
        found, share = _robust_normals(direction, np.where(diffuse, values / passed, np.nan))
        facing = np.einsum("pk,pk->p", found, ways[part]) < 0
        normals[part] = np.where(facing[:, None], found, 0.0)
        weight[part] = np.where(facing, share, 0.0)
    return NormalEvidence(
        camera, normals.reshape(height, width, 3), weight.reshape(height, width), binning
    )


def _boundary_transmittance(cosine: Float64Array) -> Float64Array:
    """Return the fraction of light transmitted by the skin's boundary, at least 0.05."""
    at = np.linspace(0.0, 1.0, 513)
    share = 1.0 - reflectance(at, ETA_SKIN)
    return np.maximum(np.interp(cosine, at, share), 0.05)


def _robust_normals(
    direction: Float64Array, values: FloatArray
) -> tuple[Float64Array, Float64Array]:
    """Return unit normals, shape (P, 3), and the fraction of the lights that fit them."""
    good = np.isfinite(values)
    y = np.where(good, values, 0.0).astype(np.float64)
    top = np.max(y, axis=0)
    w = (good & (y > 0.1 * top)).astype(np.float64)
    n = np.zeros((y.shape[1], 3))
    for _ in range(N_SHADOW_ROUNDS):
        a = np.einsum("lp,lpi,lpj->pij", w, direction, direction)
        b = np.einsum("lp,lp,lpi->pi", w, y, direction)
        a += 1e-6 * np.trace(a, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        n = np.linalg.solve(a, b[..., None])[..., 0]
        shading = np.einsum("lpi,pi->lp", direction, n)
        off = np.where(good, y - shading, np.nan)
        lit = good & (shading > 0.1 * np.linalg.norm(n, axis=1))
        with np.errstate(invalid="ignore"):
            size = np.where(lit, np.abs(off), np.nan)
        scale = 1.4826 * _median(size) + 1e-3 * np.linalg.norm(n, axis=1) + 1e-30
        w = np.where(lit, 1.0 / (1.0 + (np.nan_to_num(off) / (2.0 * scale)) ** 2), 0.0)
    length = np.linalg.norm(n, axis=1)
    enough = (np.count_nonzero(w > 0.2, axis=0) >= 5) & (length > 0)
    unit = np.where(enough[:, None], n / np.maximum(length, 1e-30)[:, None], 0.0)
    return unit, np.where(enough, w.mean(axis=0), 0.0)


def _median(values: FloatArray) -> Float64Array:
    """Return the median of each column without NaN; 0 for an empty column."""
    ordered = np.sort(values, axis=0)  # NaN come last
    count = np.count_nonzero(np.isfinite(values), axis=0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, 0.0)
