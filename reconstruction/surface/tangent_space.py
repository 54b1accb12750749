"""Transform normals of a face's texture to the tangent frame of the smoothed face.

Dome and photometric stereo give normals in the rig's frame, on the texture of a mesh. Wrinkles are
deviations from the shape without them: the position map, smoothed until wrinkles vanish, defines
the tangent frame at each texel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array

SMOOTHING_MM = 6.0
"""Standard deviation of the smoothing: wrinkles of a face are 2 to 10 mm apart."""


class TangentSpaceError(ValueError):
    """Maps that define no tangent frames."""


@dataclass(frozen=True, slots=True)
class TangentNormals:
    """Normals in the tangent frame of the smooth shape.

    Attributes
    ----------
    normals : ndarray of float32, shape (H, W, 3)
        Unit vectors: +X along u (to the right), +Y across it on the side of growing v (up), +Z
        the smooth shape's normal; (0, 0, 1) where not `valid`.
    stderr : ndarray of float32, shape (H, W, 3) or None
        Standard error of the components, rotated from the input's as if those were independent.
    valid : ndarray of bool, shape (H, W)
    """

    normals: Float32Array
    stderr: Float32Array | None
    valid: BoolArray


def tangent_frames(
    position_mm: ArrayLike, valid: ArrayLike, *, smoothing_mm: float = SMOOTHING_MM
) -> tuple[Float64Array, BoolArray]:
    """Return the tangent frame of the texture on the smoothed shape.

    Parameters
    ----------
    position_mm : array_like, shape (H, W, 3)
        Points of the surface under the texels; row 0 is the top (v = 1).
    valid : array_like of bool, shape (H, W)
        Texels with a surface.
    smoothing_mm : float
        Standard deviation of the Gaussian, mm on the surface, >= 0, converted by the median texel.

    Returns
    -------
    axes : ndarray, shape (H, W, 3, 3)
        ``axes[..., k, :]`` is the unit vector of axis k (X, Y, Z) in the frame of the positions.
    known : ndarray of bool, shape (H, W)
        Where neighbors along both directions have a surface.

    Raises
    ------
    TangentSpaceError
        For mismatched shapes, or a texture without surface.
    """
    points = np.asarray(position_mm, np.float64)
    good = np.asarray(valid, bool)
    check = Checks(TangentSpaceError)
    check.shape("position_mm", points, (*good.shape[:2], 3))
    check.require(good.any(), "valid", "no texel with a surface", "some; check the mask")
    check.within("smoothing_mm", smoothing_mm, "[0, inf)")
    along_u, known_u = _slope(points, good, 1)
    along_v, known_v = _slope(points, good, 0)
    known = known_u & known_v
    if smoothing_mm > 0.0:
        texel = np.median(np.linalg.norm(along_u[known], axis=1)) if known.any() else 0.0
        got = "neighboring texels on the same point"
        check.require(texel > 0.0, "position_mm", got, "a surface; check the map")
        sigma_px = smoothing_mm / float(texel)
        # smooth slopes, not points: smoothed points would move inwards at the rim
        along_u, along_v = (_smoothed(s, known, sigma_px) for s in (along_u, along_v))
    up = np.cross(along_u, -along_v)  # rows grow downwards, v grows upwards
    x, z = _unit(along_u), _unit(up)
    y = np.cross(z, x)
    known &= (np.linalg.norm(along_u, axis=2) > 0) & (np.linalg.norm(up, axis=2) > 0)
    return np.stack([x, y, z], axis=2), known


def tangent_normals(
    normals: ArrayLike,
    position_mm: ArrayLike,
    valid: ArrayLike,
    *,
    stderr: ArrayLike | None = None,
    smoothing_mm: float = SMOOTHING_MM,
) -> TangentNormals:
    """Rotate normals to the tangent frame of the texture on the smooth shape.

    Parameters
    ----------
    normals : array_like, shape (H, W, 3)
        Unit normals in the frame of the positions.
    position_mm, valid, smoothing_mm
        See :func:`tangent_frames`.
    stderr : array_like, shape (H, W, 3), optional
        Standard errors of the normals' components.

    Returns
    -------
    TangentNormals

    Raises
    ------
    TangentSpaceError
        For mismatched shapes.

    Examples
    --------
    >>> rows, columns = np.mgrid[0:32, 0:32] * 1.0
    >>> flat = np.stack([columns, -rows, 0 * rows], axis=2)  # 1 mm per texel, seen from +z
    >>> found = tangent_normals(np.full((32, 32, 3), [0.6, 0, 0.8]), flat, np.ones((32, 32), bool))
    >>> found.normals[16, 16].round(3).tolist()
    [0.6000000238418579, 0.0, 0.800000011920929]
    """
    given = np.asarray(normals, np.float64)
    axes, known = tangent_frames(position_mm, valid, smoothing_mm=smoothing_mm)
    Checks(TangentSpaceError).shape("normals", given, (*known.shape, 3))
    good = np.asarray(valid, bool) & known & np.isfinite(given).all(axis=2)
    turned = _unit(np.einsum("hwij,hwj->hwi", axes, np.where(good[..., None], given, 0.0)))
    turned[~good] = (0.0, 0.0, 1.0)
    error = None
    if stderr is not None:
        own = np.asarray(stderr, np.float64)
        Checks(TangentSpaceError).shape("stderr", own, given.shape)
        variance = np.einsum("hwij,hwj->hwi", axes**2, np.where(good[..., None], own**2, 0.0))
        error = np.sqrt(variance).astype(np.float32)
    return TangentNormals(turned.astype(np.float32), error, good)


def _slope(points: Float64Array, good: BoolArray, axis: int) -> tuple[Float64Array, BoolArray]:
    """Return the difference to the next texel along an axis, central where both sides exist."""
    sides = [(slice(None),) * axis + (part,) for part in (slice(-1), slice(1, None))]
    pair = good[sides[0]] & good[sides[1]]
    step = np.where(pair[..., None], points[sides[1]] - points[sides[0]], 0.0)
    total, count = np.zeros(points.shape), np.zeros(good.shape)
    for side in sides:
        total[side] += step
        count[side] += pair
    return total / np.maximum(count, 1.0)[..., None], count > 0


def _smoothed(values: Float64Array, known: BoolArray, sigma_px: float) -> Float64Array:
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma_px, truncate=3.0)
    safe = np.where(known[..., None], values, 0.0)
    out = ndimage.gaussian_filter(safe, sigma_px, truncate=3.0, axes=(0, 1))
    return np.asarray(out / np.maximum(weight, 1e-12)[..., None])


def _unit(vectors: Float64Array) -> Float64Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
