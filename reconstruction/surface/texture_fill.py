"""Interpolate values at surface points to dense texture maps with a confidence per texel.

Texels inside a triangle interpolate the values of its corners; the rest is filled by push-pull. The
pull averages ever coarser pixels, weighted by confidence. The push fills finer levels from coarser
ones where their confidence is low, and relaxes them towards a membrane: a constant stays constant,
and a gap in a ramp becomes a ramp.

References
----------
Gortler, Grzeszczuk, Szeliski, Cohen 1996, The Lumigraph, doi 10.1145/237170.237200 (push-pull).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Int32Array

FILL_SIZE_RANGE_PX: Final = (8, 8192)
N_RELAXATION_SWEEPS: Final = 5
"""Relaxation sweeps on each level, which bend the filled texels into a membrane (no kinks)."""
_OVERRELAXATION_FACTOR: Final = np.float32(1.5)
"""Factor of successive over-relaxation; it converges below 2."""


@dataclass(frozen=True, slots=True, eq=False)
class TexelMap:
    """Triangle under each texel of a square texture, with barycentric coordinates."""

    face: Int32Array
    """Triangle under the texel's center, shape (N, N), row 0 at the top; -1 for none."""
    weight: Float32Array
    """Barycentric weights of the triangle's second and third corner, shape (N, N, 2)."""

    @property
    def covered(self) -> BoolArray:
        """Texels with a surface under their center, shape (N, N)."""
        return self.face >= 0


@dataclass(frozen=True, slots=True, eq=False)
class FilledTexture:
    """A dense texture."""

    values: Float32Array
    """Shape (N, N, C); 0 where `valid` is False."""
    confidence: Float32Array
    """1 for measured texels of full weight, decreasing with the distance to them, shape (N, N)."""
    valid: BoolArray
    """Texels with a value, shape (N, N)."""


def rasterize(corner_uv: ArrayLike, size: int) -> TexelMap:
    """Rasterize triangles in a texture.

    Parameters
    ----------
    corner_uv : array_like, shape (F, 3, 2)
        Texture coordinates of each triangle's corners, (0, 0) bottom left.
    size : int
        Texels along one side, 8 to 8192.

    Returns
    -------
    TexelMap
        Where triangles overlap in the texture, the one of the lowest index is used.
    """
    uv = np.ascontiguousarray(corner_uv, np.float64)
    Checks().numbers("corner_uv", uv.reshape(-1, *uv.shape[-2:]), (len(uv), 3, 2))
    Checks().within("size", size, str(list(FILL_SIZE_RANGE_PX)))
    return TexelMap(*_rasterize(uv, size))


def texels_from_points(
    texels: TexelMap, faces: ArrayLike, values: ArrayLike, weight: ArrayLike | None = None
) -> tuple[Float32Array, Float32Array]:
    """Interpolate values at points over the triangles, without points of weight 0.

    Parameters
    ----------
    texels : TexelMap
    faces : array_like of int, shape (F, 3)
        Points at the corners of the triangles that were rasterized.
    values : array_like, shape (P,) or (P, C)
    weight : array_like, shape (P,), optional
        Confidence of each point, 0 to 1; 1 by default. Non-finite values have confidence 0.

    Returns
    -------
    values : ndarray of float32, shape (N, N, C)
        0 where not known.
    weight : ndarray of float32, shape (N, N)
        Confidence, 0 for none.
    """
    at = np.asarray(values, np.float32)
    at = np.ascontiguousarray(at[:, None] if at.ndim == 1 else at)
    corners = np.ascontiguousarray(faces, np.int32)
    trust = np.ones(len(at), np.float32) if weight is None else np.asarray(weight, np.float32)
    check = Checks()
    check.require(at.ndim == 2, "values", f"shape {at.shape}", "(P, C)")
    check.shape("weight", trust, (len(at),))
    check.shape("faces", corners, (max(len(corners), int(texels.face.max()) + 1), 3))
    check.within("faces", corners, f"[0, {len(at)})")
    trust = _checked_weight(trust, np.asarray(np.isfinite(at).all(axis=1)))
    safe = np.where(trust[:, None] > 0, at, np.float32(0.0))
    return _interpolate(texels.face, texels.weight, corners, safe, trust)


def push_pull(
    values: ArrayLike, weight: ArrayLike, *, mask: ArrayLike | None = None
) -> FilledTexture:
    """Fill the gaps of a texture.

    Parameters
    ----------
    values : array_like, shape (H, W) or (H, W, C)
        Arbitrary numbers where `weight` is 0.
    weight : array_like, shape (H, W)
        Confidence, 0 to 1; texels of weight 1 keep their values. Non-finite values have 0.
    mask : array_like of bool, shape (H, W), optional
        Texels to fill; all by default. Values outside are ignored.

    Returns
    -------
    FilledTexture
        Without any measured texel, all texels are invalid.
    """
    image = np.asarray(values, np.float32)
    layers = image if image.ndim == 3 else image[..., None]
    trust = np.asarray(weight, np.float32)
    Checks().require(layers.ndim == 3, "values", f"shape {image.shape}", "(H, W) or (H, W, C)")
    Checks().shape("weight", trust, layers.shape[:2])
    wanted = np.ones(trust.shape, np.bool_) if mask is None else np.asarray(mask, np.bool_)
    Checks().shape("mask", wanted, trust.shape)
    trust = _checked_weight(trust, np.isfinite(layers).all(axis=2) & wanted)
    safe = np.ascontiguousarray(np.where(trust[..., None] > 0, layers, np.float32(0.0)))
    levels = [(safe, trust)]
    while max(levels[-1][1].shape) > 1:
        levels.append(_pull(*levels[-1]))
    filled, known = levels[-1]
    for fine, fine_weight in reversed(levels[:-1]):
        filled, known = _push(fine, fine_weight, filled, known)
        _relax(filled, fine, fine_weight, known, N_RELAXATION_SWEEPS)
    valid = wanted & (known > 0)
    return FilledTexture(
        np.where(valid[..., None], filled, np.float32(0.0)),
        np.where(valid, known, np.float32(0.0)),
        np.asarray(valid, np.bool_),
    )


def densify(
    texels: TexelMap, faces: ArrayLike, values: ArrayLike, weight: ArrayLike | None = None
) -> FilledTexture:
    """Interpolate values at points to a dense texture: `texels_from_points`, then `push_pull`.

    Texels outside the charts are filled too, so that bilinear sampling at seams finds values.
    """
    return push_pull(*texels_from_points(texels, faces, values, weight))


def _checked_weight(weight: Float32Array, usable: BoolArray) -> Float32Array:
    good = np.isfinite(weight) & usable
    # in row-major order, whatever the input's: the kernels are compiled for one layout
    known = np.where(good, weight, np.float32(0.0)).astype(np.float32, order="C")
    Checks().within("weight", known, "[0, 1]")
    return known


@njit(cache=True)
def _rasterize(uv, size):  # type: ignore[no-untyped-def]
    """Write the triangle that contains each texel's center; serial, because triangles overlap."""
    face = np.full((size, size), -1, np.int32)
    weight = np.zeros((size, size, 2), np.float32)
    for f in range(len(uv)):
        # in texels: column to the right, row down, centers at whole numbers
        x0, y0 = uv[f, 0, 0] * size - 0.5, (1.0 - uv[f, 0, 1]) * size - 0.5
        x1, y1 = uv[f, 1, 0] * size - 0.5, (1.0 - uv[f, 1, 1]) * size - 0.5
        x2, y2 = uv[f, 2, 0] * size - 0.5, (1.0 - uv[f, 2, 1]) * size - 0.5
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        top = max(int(np.ceil(min(y0, y1, y2) - 1e-9)), 0)
        bottom = min(int(np.floor(max(y0, y1, y2) + 1e-9)), size - 1)
        left = max(int(np.ceil(min(x0, x1, x2) - 1e-9)), 0)
        right = min(int(np.floor(max(x0, x1, x2) + 1e-9)), size - 1)
        for i in range(top, bottom + 1):
            for j in range(left, right + 1):
                b = ((j - x0) * (y2 - y0) - (x2 - x0) * (i - y0)) / area
                c = ((x1 - x0) * (i - y0) - (j - x0) * (y1 - y0)) / area
                # a center on an edge belongs to both sides
                if b >= -1e-9 and c >= -1e-9 and b + c <= 1.0 + 1e-9 and face[i, j] < 0:
                    face[i, j] = f
                    weight[i, j, 0] = b
                    weight[i, j, 1] = c
    return face, weight


@njit(cache=True, parallel=True)
def _interpolate(face, weight, corners, values, trust):  # type: ignore[no-untyped-def]
    size, channels = face.shape[0], values.shape[1]
    out = np.zeros((size, size, channels), np.float32)
    known = np.zeros((size, size), np.float32)
    for i in prange(size):
        for j in range(size):
            f = face[i, j]
            if f < 0:
                continue
            second, third = weight[i, j, 0], weight[i, j, 1]
            share = np.float32(1.0) - second - third, second, third
            total = np.float32(0.0)
            for k in range(3):
                w = max(share[k], np.float32(0.0)) * trust[corners[f, k]]
                total += w
                for c in range(channels):
                    out[i, j, c] += w * values[corners[f, k], c]
            known[i, j] = min(total, np.float32(1.0))
            for c in range(channels):
                out[i, j, c] = out[i, j, c] / total if total > 0.0 else np.float32(0.0)
    return out, known


@njit(cache=True, parallel=True)
def _pull(fine, weight):  # type: ignore[no-untyped-def]
    """Return the level of half the size: weighted means of 4 x 4 texels, 1 3 3 1 each way."""
    height, width, channels = fine.shape
    rows, columns = (height + 1) // 2, (width + 1) // 2
    out = np.zeros((rows, columns, channels), np.float32)
    known = np.zeros((rows, columns), np.float32)
    taps = np.array([0.125, 0.375, 0.375, 0.125], np.float32)
    for i in prange(rows):
        for j in range(columns):
            total = np.float32(0.0)
            for di in range(4):
                y = 2 * i + di - 1
                if y < 0 or y >= height:
                    continue
                for dj in range(4):
                    x = 2 * j + dj - 1
                    if x < 0 or x >= width or weight[y, x] == 0.0:
                        continue
                    w = taps[di] * taps[dj] * weight[y, x]
                    total += w
                    for c in range(channels):
                        out[i, j, c] += w * fine[y, x, c]
            if total > 0.0:
                for c in range(channels):
                    out[i, j, c] /= total
                # a pixel with a quarter of its texels known has their full confidence
                known[i, j] = min(np.float32(4.0) * total, np.float32(1.0))
    return out, known


@njit(cache=True, parallel=True)
def _push(fine, weight, coarse, coarse_weight):  # type: ignore[no-untyped-def]
    """Return the finer level, its missing part filled bilinearly from the coarser one."""
    # bilinear weights for centers at quarter positions: 3/4 for the nearer coarse pixel, 1/4 else
    height, width, channels = fine.shape
    rows, columns = coarse_weight.shape
    out = np.empty_like(fine)
    known = np.empty_like(weight)
    for i in prange(height):
        upper = min(max((i - 1) // 2, 0), rows - 1)
        lower = min((i + 1) // 2, rows - 1)
        near_i = np.float32(0.75) if i % 2 else np.float32(0.25)
        for j in range(width):
            w = weight[i, j]
            if w >= 1.0:
                known[i, j] = w
                out[i, j] = fine[i, j]
                continue
            left = min(max((j - 1) // 2, 0), columns - 1)
            right = min((j + 1) // 2, columns - 1)
            near_j = np.float32(0.75) if j % 2 else np.float32(0.25)
            total = np.float32(0.0)
            trust = np.float32(0.0)
            for c in range(channels):
                out[i, j, c] = 0.0
            for y, a in ((upper, near_i), (lower, np.float32(1.0) - near_i)):
                for x, b in ((left, near_j), (right, np.float32(1.0) - near_j)):
                    if coarse_weight[y, x] == 0.0:
                        continue
                    total += a * b
                    trust += a * b * coarse_weight[y, x]
                    for c in range(channels):
                        out[i, j, c] += a * b * coarse[y, x, c]
            # values from each coarser level have half its confidence
            from_coarse = np.float32(0.5) * trust * (np.float32(1.0) - w)
            for c in range(channels):
                blurred = out[i, j, c] / total if total > 0.0 else np.float32(0.0)
                out[i, j, c] = w * fine[i, j, c] + (np.float32(1.0) - w) * blurred
                if total == 0.0:
                    out[i, j, c] = fine[i, j, c]
            known[i, j] = w + from_coarse
    return out, known


@njit(cache=True, parallel=True)
def _relax(filled, fine, weight, known, sweeps):  # type: ignore[no-untyped-def]
    """Move unmeasured texels towards the mean of their neighbors, in checkerboard order."""
    height, width, channels = filled.shape
    for sweep in range(2 * sweeps):
        for i in prange(height):
            for j in range((i + sweep) % 2, width, 2):
                w = weight[i, j]
                if w >= 1.0 or known[i, j] == 0.0:
                    continue
                for c in range(channels):
                    total = np.float32(0.0)
                    count = np.float32(0.0)
                    if i > 0:
                        total += filled[i - 1, j, c]
                        count += np.float32(1.0)
                    if i < height - 1:
                        total += filled[i + 1, j, c]
                        count += np.float32(1.0)
                    if j > 0:
                        total += filled[i, j - 1, c]
                        count += np.float32(1.0)
                    if j < width - 1:
                        total += filled[i, j + 1, c]
                        count += np.float32(1.0)
                    if count > 0.0:
                        mean = total / count
                        goal = w * fine[i, j, c] + (np.float32(1.0) - w) * mean
                        filled[i, j, c] += _OVERRELAXATION_FACTOR * (goal - filled[i, j, c])
