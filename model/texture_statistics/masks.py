"""Prepare masked textures for a pyramid: fill outside the mask, and weight the responses."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import convolve1d

from model.arrays import BoolArray, FloatArray
from model.texture_statistics.steerable_pyramid import level_sizes

_BINOMIAL_FILTER = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0


def fill_smoothly(image: FloatArray, valid: BoolArray) -> FloatArray:
    """Fill invalid texels smoothly from valid ones, periodically.

    Means of 2 x 2 texels are taken level by level until none is missing, then interpolated back
    linearly, so that a filled texel has the color of its surroundings without detail.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        Finite where valid; anything elsewhere.
    valid : ndarray of bool, shape (H, W)
        At least one True.

    Returns
    -------
    ndarray, shape (H, W, C)
        Valid texels are unchanged.

    Raises
    ------
    ValueError
        Where no texel is valid, or one that is valid is not finite.
    """
    if not valid.any():
        raise ValueError(f"valid: got no texel of {valid.shape}, expected one at least")
    if not np.isfinite(image[valid]).all():
        raise ValueError("image: got NaN or infinity at a valid texel, expected finite values")
    if valid.all():
        return image
    known = np.where(valid[..., None], image, 0)
    share = valid.astype(image.dtype)[..., None]
    steps = [(known, share)]
    while not (share > 0.0).all():
        sums, share = _halved(known * share), _halved(share)
        known = sums / np.maximum(share, np.finfo(image.dtype).tiny)
        share = np.minimum(share, 1.0)
        steps.append((known, share))
    filled = known
    for known, share in reversed(steps[:-1]):
        filled = share * known + (1.0 - share) * _doubled(filled, known.shape[:2])
    return np.where(valid[..., None], image, filled).astype(image.dtype)


def _halved(a: FloatArray) -> FloatArray:
    """Add up 2 x 2 texels; a last odd row or column is summed alone."""
    padded = np.pad(a, ((0, a.shape[0] % 2), (0, a.shape[1] % 2), (0, 0)))
    return np.asarray(padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2])


def _doubled(a: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Interpolate linearly between the centers of 2 x 2 texels, periodically."""
    for axis in (0, 1):
        before = 0.75 * a + 0.25 * np.roll(a, 1, axis)
        after = 0.75 * a + 0.25 * np.roll(a, -1, axis)
        both = np.stack([before, after], axis=axis + 1)
        size = list(a.shape)
        size[axis] *= 2
        a = both.reshape(size)
    return a[: shape[0], : shape[1]]


def response_weights(
    valid: BoolArray, region: ArrayLike | None, levels: int
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return the weight of every texel, and of every sample of every level and the low-pass.

    Parameters
    ----------
    valid : ndarray of bool, shape (H, W)
    region : array_like, shape (H, W), or None
        Bool, or weights 0...1; None: everywhere.
    levels : int

    Returns
    -------
    texels : ndarray of float32, shape (H, W)
        The region where valid.
    samples : tuple of ndarray of float32
        A sample's weight is the region's mean over its own cell, times the valid fraction of its
        surroundings (binomial weights over 5 x 5 cells, the reach of the filters). The first array
        serves the high-pass and the first level.
    """
    texels = valid.astype(np.float32)
    inside = texels if region is None else texels * np.asarray(region, np.float32)
    samples = []
    for size in level_sizes((valid.shape[0], valid.shape[1]), levels):
        support = _cell_means(texels, size)
        for axis in (0, 1):
            support = convolve1d(support, _BINOMIAL_FILTER, axis=axis, mode="wrap")
        samples.append(_cell_means(inside, size) * support)
    return inside, tuple(samples)


def _cell_means(texels: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Average texels over the cells about the samples of a coarser, periodic grid."""
    found = texels
    for axis in (0, 1):
        fine, coarse = found.shape[axis], size[axis]
        if fine == coarse:
            continue
        cell = np.rint(np.arange(fine) * (coarse / fine)).astype(np.int64)
        begins = np.searchsorted(cell, np.arange(cell[-1] + 1))
        sums = np.add.reduceat(found, begins, axis=axis)
        count = np.bincount(cell).astype(np.float32)
        if len(count) > coarse:  # periodic: the last texels are nearest to the first sample
            sums, rest = np.split(sums, [coarse], axis=axis)
            first = [slice(None)] * 2
            first[axis] = slice(0, 1)
            sums[tuple(first)] += rest
            count[0] += count[-1]
            count = count[:-1]
        found = sums / (count[:, None] if axis == 0 else count)
    return found
