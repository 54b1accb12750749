"""Generate the fine geometry of the skin's surface: pores, wrinkles, roughness and oil."""

from collections.abc import Mapping

import numpy as np

from rigsim.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from rigsim.geometry.atlas import Atlas
from rigsim.geometry.surface_noise import random_spots, smooth_noise, vessel_network
from rigsim.subject.face_regions import soft_step


def height_um(
    points_mm: Float32Array, regions: Mapping[str, Float32Array], *, texel_mm: float, seed: int
) -> Float32Array:
    """Draw pores, folds and fine wrinkles.

    Parameters
    ----------
    points_mm
        Points on the mean head, shape (..., 3).
    regions
        Masks of `rigsim.subject.face_regions.region_masks`.
    texel_mm
        Size of a texel; details finer than two texels are omitted or widened at less depth.
    seed
        Any integer.

    Returns
    -------
    ndarray of float32
        Height in um, shape (...); pits are negative.
    """
    height = np.zeros(points_mm.shape[:-1], np.float32)
    porous = 0.25 + 0.6 * regions["nose"] + 0.5 * regions["cheeks"] + 0.2 * regions["forehead"]
    porous = np.clip(porous * (1.0 - regions["lips"]) * (1.0 - 0.8 * regions["lids"]), 0.0, 1.0)
    pores = random_spots(
        points_mm,
        porous,
        cell_mm=1.1,
        radius_mm=(0.10, 0.24),
        seed=seed + 71,
        softness=4.0,
        min_radius_mm=0.8 * texel_mm,
    )
    height -= 60.0 * pores * (0.5 + 0.5 * porous)
    # Lines of expression: horizontal on the forehead, fans next to the eyes, upright on the lips.
    stretched = points_mm * np.array([0.12, 1.0, 0.4], np.float32)
    height -= _grooves(stretched, 9.0, 0.9, texel_mm, 45.0, seed + 72) * regions["forehead"]
    fans = points_mm * np.array([0.25, 1.0, 0.25], np.float32)
    height -= _grooves(fans, 4.0, 0.6, texel_mm, 45.0, seed + 73) * regions["crow"]
    upright = points_mm * np.array([1.0, 0.15, 0.3], np.float32)
    height -= _grooves(upright, 2.4, 0.45, texel_mm, 60.0, seed + 74) * regions["lips"]
    # The net of primary lines, a quarter of a millimeter apart, where texels resolve it.
    if texel_mm < 0.2:
        net = vessel_network(points_mm, 0.6, max(0.1, texel_mm), seed=seed + 75)
        height -= 18.0 * net
    if texel_mm < 0.8:
        height += 6.0 * smooth_noise(points_mm, (max(1.0, 2.5 * texel_mm),), seed=seed + 76)
    return height


def hair_map(points_mm: Float32Array, *, seed: int) -> Float32Array:
    """Draw brows and lashes.

    Parameters
    ----------
    points_mm
        Points on the mean head, shape (..., 3).
    seed
        Any integer.

    Returns
    -------
    ndarray of float32
        Fraction covered by hair, shape (...), 0 to 1; zero on bare skin.
    """
    rng = np.random.default_rng([seed, 4])
    x, y = np.abs(points_mm[..., 0]), points_mm[..., 1]
    front = points_mm[..., 2] > -40.0
    # The brow: an arch, thick near the nose and thin at the temple.
    along = np.clip((x - 11.0) / 36.0, 0.0, 1.0)
    arch = 38.5 + float(rng.uniform(2.5, 4.5)) * np.sin(2.4 * along) - 3.0 * along**3
    thick = (1.0 - 0.65 * along) * float(rng.uniform(3.0, 4.2))
    brow = np.exp(-(((y - arch) / thick) ** 4))
    brow *= soft_step((x - 10.5) / 2.5) * soft_step((49.0 - x) / 2.5)
    # Strands point outwards and slightly up.
    strands = np.stack(
        [0.16 * x, y - 0.35 * x, 0.3 * points_mm[..., 2] + 40.0 * np.sign(points_mm[..., 0])],
        axis=-1,
    )
    brow *= np.clip(0.68 + 0.3 * smooth_noise(strands, (0.9, 0.45), seed=seed + 91), 0.25, 1.0)
    # The lashes of closed eyes follow the line between the lids.
    line = 16.6 + 0.011 * (x - 31.0) ** 2
    lash = 0.85 * np.exp(-(((y - line) / 0.9) ** 2)) * soft_step((x - 17.0) / 1.5)
    lash *= soft_step((46.0 - x) / 1.5)
    cover = np.maximum(brow, lash) * front
    return np.where(cover > 0.02, cover, 0.0).astype(np.float32)


def roughness_map(
    points_mm: Float32Array, regions: Mapping[str, Float32Array], *, seed: int
) -> Float32Array:
    """Draw the roughness of the surface; oil on forehead, nose and chin smooths it.

    Parameters
    ----------
    points_mm
        Points on the mean head, shape (..., 3).
    regions
        Masks of `rigsim.subject.face_regions.region_masks`.
    seed
        Any integer.

    Returns
    -------
    ndarray of float32
        GGX alpha, shape (...), 0.15 to 0.5.

    Notes
    -----
    Around the Beckmann roughness of 0.3 to 0.35 that fits measured facial skin
    (Weyrich et al. 2006, doi:10.1145/1141911.1141987).
    """
    rng = np.random.default_rng([seed, 3])
    oil = float(rng.uniform(0.6, 1.2)) * np.maximum(
        np.maximum(0.7 * regions["forehead"], regions["nose"]), 0.6 * regions["chin"]
    )
    alpha = 0.36 - 0.11 * oil - 0.08 * regions["lips"] - 0.03 * regions["lids"]
    alpha *= 1.0 + 0.07 * smooth_noise(points_mm, (22.0, 8.0), seed=seed + 81)
    return np.asarray(np.clip(alpha, 0.15, 0.5), np.float32)


def relief_normals(atlas: Atlas, height: FloatArray) -> Float32Array:
    """Tilt the normals of a surface by a height map.

    Parameters
    ----------
    atlas
        Surface under each texel.
    height
        Height in um, shape (N, N).

    Returns
    -------
    ndarray of float32
        Unit normals, shape (N, N, 3), rig frame; unchanged where the texture has no surface.
    """
    h = np.where(atlas.covered, height, 0.0).astype(np.float64) * 1e-3
    valid = atlas.covered
    # Row 0 is the top: v grows against the rows.
    along_u = atlas.size * _slope(h, valid)
    along_v = -atlas.size * _slope(h.T, valid.T).T
    du, dv = atlas.dp_du_mm.astype(np.float64), atlas.dp_dv_mm.astype(np.float64)
    e, f = np.sum(du * du, axis=-1), np.sum(du * dv, axis=-1)
    g = np.sum(dv * dv, axis=-1)
    determinant = e * g - f * f
    safe = determinant > 1e-9 * np.maximum(e, g) ** 2
    inverse = np.where(safe, 1.0 / np.where(safe, determinant, 1.0), 0.0)
    a = (g * along_u - f * along_v) * inverse
    b = (e * along_v - f * along_u) * inverse
    tilted = atlas.normal - (a[..., None] * du + b[..., None] * dv)
    length = np.linalg.norm(tilted, axis=-1, keepdims=True)
    return np.where(length > 0.0, tilted / np.maximum(length, 1e-12), 0.0).astype(np.float32)


def _slope(h: Float64Array, valid: BoolArray) -> Float64Array:
    """Return the change per column: central, one-sided at borders of valid texels, else 0."""
    step = np.where(valid[:, 1:] & valid[:, :-1], h[:, 1:] - h[:, :-1], 0.0)
    total, count = np.zeros_like(h), np.zeros(h.shape)
    has = (valid[:, 1:] & valid[:, :-1]).astype(np.float64)
    total[:, :-1] += step
    total[:, 1:] += step
    count[:, :-1] += has
    count[:, 1:] += has
    return total / np.maximum(count, 1.0)


def tangent_normals(atlas: Atlas, normal: Float32Array) -> Float32Array:
    """Rotate normals into the frame of the texture.

    Parameters
    ----------
    atlas
        Surface under each texel.
    normal
        Unit normals, shape (N, N, 3), rig frame.

    Returns
    -------
    ndarray of float32
        Unit normals, shape (N, N, 3): +x points along u on the surface, +z is the surface's own
        shading normal, +y is perpendicular to both on the side of growing v; (0, 0, 1) where the
        texture has no surface.
    """
    up = atlas.normal.astype(np.float64)
    along = atlas.dp_du_mm.astype(np.float64)
    along = along - np.sum(along * up, axis=-1, keepdims=True) * up
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    along /= np.maximum(length, 1e-12)
    across = np.cross(up, along)
    side = np.sign(np.sum(across * atlas.dp_dv_mm, axis=-1, keepdims=True))
    across *= np.where(side == 0.0, 1.0, side)  # a mirrored texture
    turned = np.stack([np.sum(axis * normal, axis=-1) for axis in (along, across, up)], axis=-1)
    known = atlas.covered & (length[..., 0] > 1e-9)
    turned[~known] = (0.0, 0.0, 1.0)
    turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-12)
    return turned.astype(np.float32)


def _grooves(
    points: Float32Array,
    cell_mm: float,
    width_mm: float,
    texel_mm: float,
    depth_um: float,
    seed: int,
) -> Float32Array:
    drawn = max(width_mm, 1.2 * texel_mm)
    lines = vessel_network(points, cell_mm, drawn, seed=seed)
    return np.asarray(depth_um * width_mm / drawn * lines, np.float32)


def stubble_map(
    points: Float32Array,
    regions: Mapping[str, Float32Array],
    amount: float,
    texel_mm: float,
    *,
    seed: int,
) -> Float32Array | None:
    """Draw the stubble below the surface: follicles on chin, jaw and upper lip."""
    if amount == 0.0:
        return None
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    # The border extends from the ears down the cheeks to the corners of the mouth.
    reach = np.clip((np.abs(x) - 24.0) / 34.0, 0.0, 1.0)
    upper = -34.0 + 22.0 * reach**1.5 - y
    moustache = np.exp(-((x / 26.0) ** 4) - ((y + 29.0) / 7.0) ** 4)
    area = np.maximum(1.0 / (1.0 + np.exp(-upper / 3.0)), 0.9 * moustache)
    area *= 1.0 / (1.0 + np.exp(-(z + 62.0) / 6.0))
    area *= 1.0 / (1.0 + np.exp(-(y + 92.0) / 5.0))  # it ends on the neck
    area *= (1.0 - regions["lips"]) * (1.0 - 0.8 * regions["nose"])
    area *= np.clip(1.0 + 0.25 * smooth_noise(points, (12.0, 5.0), seed=seed + 511), 0.3, 1.5)
    dense = np.asarray(np.clip(amount * area, 0.0, 1.0), np.float32)
    dots = random_spots(
        points,
        dense,
        cell_mm=0.9,
        radius_mm=(0.12, 0.22),
        seed=seed + 512,
        softness=4.0,
        min_radius_mm=0.7 * texel_mm,
    )
    # Half of the shadow is blurred: lateral scattering in skin exceeds the distance of follicles.
    return np.asarray(np.clip(0.45 * dense + 0.55 * dots, 0.0, 1.0), np.float32)
