"""Find the position of every pixel of one image in another by dense optical flow.

The flow refines an initial guess on local contrast, forth and back. Its error has several parts:
noise, by the images' remaining difference over their texture (Lucas and Kanade's normal equations);
the gap between the ways forth and back; the last round's step; and strain and bending of the skin
within a window, which the flow's patches lack. Where the gap is large, the
guess is kept, moved like its neighbors.

References
----------
Kroeger et al. 2016, Fast Optical Flow using Dense Inverse Search,
doi:10.1007/978-3-319-46493-0_29
Lucas and Kanade 1981, An iterative image registration technique, IJCAI 7, 674-679
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import BoolArray, Float32Array, FloatArray, UInt8Array
from reconstruction.registration.tracking import is_inside_image

N_WARP_ROUNDS = 2
"""Number of rounds in which the second image is warped and the remaining flow estimated."""
MAX_GAP_PX = 1.0
"""Largest distance to the starting point after the way back of a correctly tracked pixel."""
TEXTURE_WINDOW_PX = 5.0
"""Gaussian window in place of the flow's patches for texture, px."""
GAP_WINDOW_PX = 8.0
"""Gaussian window over which gaps are averaged, and unknown flow is filled."""
DERIVATIVE_WINDOW_PX = 3.0
"""Gaussian window for derivatives of the displacement, px."""
_CUBIC_SLOPE = -0.75
"""Slope of OpenCV's cubic kernel at a pixel's distance."""
ERROR_FACTORS = (1.2, 0.3, 1.1, 12.0, 0.04)
"""Factors of the squared error along an axis: of the variance by noise, the squares of gap and last
step (px^2), of the Laplacian (1/px^2 times px^4) and of the gradient of the displacement (times
px^2). Least squares on simulated faces of another seed, moved by smooth fields of 3 to 12 px that
bend over 15 to 60 px, with other blood volume fractions."""
MIN_FLOW_ERROR_PX = 0.01
"""Error of interpolation and rounding to 8 bits, px."""


@dataclass(frozen=True, slots=True, eq=False)
class DenseFlow:
    """Positions of the first image's pixels in the second, with errors.

    Attributes
    ----------
    source_px : ndarray of float32, shape (H, W, 2)
        Column and row in the second image.
    stderr_px : ndarray of float32, shape (H, W)
        Estimated standard error along each axis.
    gap_px : ndarray of float32, shape (H, W)
        Distance of a pixel from its start after the way back.
    followed : ndarray of bool, shape (H, W)
        The flow was accepted; elsewhere the guess is kept, moved like its neighbors.
    """

    source_px: Float32Array
    stderr_px: Float32Array
    gap_px: Float32Array
    followed: BoolArray


def refine_flow(
    first: UInt8Array,
    second: UInt8Array,
    source_px: FloatArray,
    stderr_px: FloatArray,
    *,
    valid: BoolArray,
    valid_second: BoolArray,
    rounds: int = N_WARP_ROUNDS,
) -> DenseFlow:
    """Refine a guess of the positions of one image's pixels in another.

    Parameters
    ----------
    first, second : ndarray of uint8, shapes (H, W) and (h, w)
        Local contrast, see `reconstruction.registration.normalize_local_contrast`.
    source_px : ndarray, shape (H, W, 2)
        The guess: column and row in the second image.
    stderr_px : ndarray, shape (H, W)
        Its standard error along each axis.
    valid, valid_second : ndarray of bool
        Pixels of the subject in each image.
    rounds : int
        Number of refinements; 0 returns the guess.

    Returns
    -------
    DenseFlow
    """
    at = source_px.astype(np.float32)
    error = np.maximum(stderr_px.astype(np.float32), np.float32(MIN_FLOW_ERROR_PX))
    here = pixel_grid(valid.shape)
    gap = np.zeros(valid.shape, np.float32)
    known = np.zeros(valid.shape, bool)
    stderr = error
    for _ in range(rounds):
        both = valid & (sample_image(valid_second.astype(np.float32), at) > 0.999)
        one = np.where(both, first, 128).astype(np.uint8)
        two = np.where(both, sample_image(second, at), 128).astype(np.uint8)
        there = _follow(one, two)
        back = _follow(two, one)
        gap = np.linalg.norm(there + sample_image(back, here + there), axis=-1)
        moved = here + there
        known = both & (gap <= MAX_GAP_PX) & is_inside_image(moved, valid.shape)
        known &= sample_image(both.astype(np.float32), moved) > 0.999
        noise = _noise_variance(one, sample_image(two, moved))
        weight = known.astype(np.float32)
        share = np.maximum(_blurred(weight), 1e-6)
        wide = _blurred(np.where(known, gap, 0.0).astype(np.float32) ** 2) / share
        # other pixels move like their neighbors, less so with distance from them
        filled = _blurred(there * weight[..., None]) / (share[..., None] + 1e-2)
        went = _blurred(weight * (there**2).sum(axis=-1)) / share
        bent, strained = _deformation(moved)
        parts: tuple[Any, ...] = (noise, wide, went, bent, strained)
        variance = np.full(valid.shape, MIN_FLOW_ERROR_PX**2, np.float32)
        for factor, part in zip(ERROR_FACTORS, parts, strict=True):
            variance += np.float32(factor) * part
        trust = np.where(known, error**2 / (error**2 + variance), 0.0).astype(np.float32)
        step = filled + trust[..., None] * (there - filled)
        at = sample_image(at, (here + step).astype(np.float32))
        stderr = np.where(known, np.sqrt(trust * variance), error).astype(np.float32)
    return DenseFlow(at, stderr, gap.astype(np.float32), known)


def pixel_grid(shape: tuple[int, ...]) -> Float32Array:
    """Return column and row of every pixel, (H, W, 2)."""
    x, y = np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))
    return np.stack([x, y], axis=-1)


def sample_image(image: Any, at_px: Float32Array, *, interpolation: int = cv2.INTER_LINEAR) -> Any:
    """Return an image's values at (column, row); beyond its border those of the border."""
    flat = at_px.reshape(*at_px.shape[:2], 2)
    return cv2.remap(
        image, flat[..., 0], flat[..., 1], interpolation, borderMode=cv2.BORDER_REPLICATE
    )


def interpolated_noise_variance(at_px: Float32Array) -> Float32Array:
    """Return the factor of noise variance of single pixels by cubic interpolation, (H, W).

    It is the sum of the squared weights of the four pixels along each axis.
    """
    left = np.ones(at_px.shape[:2], np.float32)
    for axis in (0, 1):
        along = at_px[..., axis] - np.floor(at_px[..., axis])
        t = np.stack([along + 1.0, along, 1.0 - along, 2.0 - along])
        near = ((_CUBIC_SLOPE + 2.0) * t - (_CUBIC_SLOPE + 3.0)) * t * t + 1.0
        far = ((t - 5.0) * t + 8.0) * t * _CUBIC_SLOPE - 4.0 * _CUBIC_SLOPE
        left *= np.square(np.where(t <= 1.0, near, far)).sum(axis=0)
    return left


def _follow(one: UInt8Array, two: UInt8Array) -> Float32Array:
    search: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    return np.asarray(search.calc(one, two, None), np.float32)


def _noise_variance(one: UInt8Array, two: UInt8Array) -> Float32Array:
    """Return the variance of the flow along its worse known axis, by texture and difference."""
    a, b = one.astype(np.float32), two.astype(np.float32)
    mean = 0.5 * (a + b)
    dx, dy = (cv2.Scharr(mean, cv2.CV_32F, *order) / 32.0 for order in ((1, 0), (0, 1)))
    xx, xy, yy = (_windowed(part) for part in (dx * dx, dx * dy, dy * dy))
    rest = _windowed((a - b) ** 2) + 1.0 / 6.0  # two roundings to integers
    area = 4.0 * np.pi * TEXTURE_WINDOW_PX**2
    determinant = np.maximum(xx * yy - xy * xy, 1e-6)
    return np.asarray(rest / area * 0.5 * (xx + yy) / determinant, np.float32)


def _deformation(at_px: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the squares of the Laplacian and of the gradient of a map's displacement."""
    away = at_px - pixel_grid(at_px.shape)
    displacement = np.asarray(cv2.GaussianBlur(away, (0, 0), DERIVATIVE_WINDOW_PX))
    parts = [np.ascontiguousarray(displacement[..., k]) for k in (0, 1)]
    bent = np.sum([cv2.Laplacian(part, cv2.CV_32F) ** 2 for part in parts], axis=0)
    strained = np.sum([slope**2 for part in parts for slope in np.gradient(part)], axis=0)
    return np.asarray(bent, np.float32), np.asarray(strained, np.float32)


def _windowed(image: Float32Array) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), TEXTURE_WINDOW_PX))


def _blurred(image: Float32Array) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), GAP_WINDOW_PX))
