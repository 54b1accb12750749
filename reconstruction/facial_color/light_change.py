"""How the light on a face changes from picture to picture, told by the colors of many pixels."""

import math

import numpy as np
from scipy.ndimage import gaussian_filter

from reconstruction.arrays import BoolArray, Float32Array, Float64Array

MIN_LIGHT_CHANGE = 0.002
"""Least relative change of light from state to state that is allowed for in each pixel: what a
flash's energy differs by from pop to pop."""
OUTLIER_SIGMAS = 3.0
"""Standard errors from which on a pixel's light is said not to follow its neighbors'."""
MAX_LIGHT_CHANGE = 1.0
"""Most that matters: with more, the brightness tells nothing."""


def smooth_light_changes(
    log_shading: Float32Array,
    shading_variance: Float32Array,
    good: BoolArray,
    shape: tuple[int, ...],
    window_px: float,
) -> tuple[Float32Array, Float32Array]:
    """Return how the light of each state differs, smoothed, and one over the variance of the rest.

    Parameters
    ----------
    log_shading, shading_variance
        (S, n): log light on the pixels of each state by their colors alone, and its variance.
    good
        (S, n): where that means something.
    shape
        Rows and columns, H W = n.
    window_px
        Of the Gaussian that changes are averaged by, px.

    Returns
    -------
    change, stiffness
        (S, n): of log light from the mean of the states, and one over the variance that pixels
        are off it by.
    """
    known = good & np.isfinite(shading_variance) & (shading_variance > 0.0)
    light = np.where(known, log_shading, 0.0).astype(np.float64)
    variance = np.where(known, shading_variance, 1.0).astype(np.float64)
    share = np.where(known, 1.0 / variance, 0.0)
    share /= np.maximum(share.sum(axis=0), 1e-300)
    change = light - (share * light).sum(axis=0)
    scatter = (1.0 - 2.0 * share) * variance + (share**2 * variance).sum(axis=0)
    # a pixel seen in one state alone tells nothing of changes
    weight = np.where(known & (share < 1.0 - 1e-9), 1.0 / np.maximum(scatter, 1e-12), 0.0)

    def around(values: Float64Array, reach_px: float) -> Float64Array:
        stack = values.reshape(-1, *shape)
        smoothed = gaussian_filter(stack, reach_px, mode="constant", axes=(1, 2))
        return np.asarray(smoothed.reshape(values.shape))

    total = np.maximum(around(weight, window_px), 1e-9)
    smooth = around(weight * change, window_px) / total
    area = 4.0 * math.pi * window_px**2
    smooth_variance = around(weight, window_px / math.sqrt(2.0)) / (area * total**2)
    rest = weight * (np.square(change - smooth) - scatter)
    wide = 3.0 * window_px
    squares = np.maximum(around(weight**2, wide), 1e-9)
    excess = around(weight * rest, wide) / squares
    # by chance alone it is 0 within this
    chance = np.sqrt(2.0 * around(weight**2, wide / math.sqrt(2.0)) / (4.0 * math.pi))
    chance /= wide * squares
    # a wrinkle's shadow is narrower than that: a pixel that is clearly off is off by so much
    apart = np.square(change - smooth)
    alone = np.where(apart > OUTLIER_SIGMAS**2 * scatter, apart, 0.0)
    loose = np.maximum(np.maximum(excess, alone), 0.0) + chance + smooth_variance
    stiffness = 1.0 / np.minimum(loose + MIN_LIGHT_CHANGE**2, MAX_LIGHT_CHANGE**2)
    return smooth.astype(np.float32), stiffness.astype(np.float32)
