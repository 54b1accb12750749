"""Estimate changes of the light on a face between images from the colors of many pixels."""

import math

import numpy as np
from scipy.ndimage import gaussian_filter

from reconstruction.arrays import BoolArray, Float32Array, Float64Array

MIN_LIGHT_CHANGE = 0.002
"""Minimum relative change of light between states that is allowed in each pixel: the variation of a
flash's energy."""
OUTLIER_SIGMAS = 3.0
"""Residual, in standard errors, above which a pixel's light counts as an outlier."""
MAX_LIGHT_CHANGE = 1.0
"""Maximum change; beyond it, brightness contains no information."""


def smooth_light_changes(
    log_shading: Float32Array,
    shading_variance: Float32Array,
    good: BoolArray,
    shape: tuple[int, ...],
    window_px: float,
) -> tuple[Float32Array, Float32Array]:
    """Estimate each state's light change, smoothed, and the stiffness of the residual.

    Parameters
    ----------
    log_shading, shading_variance
        (S, n): log light on the pixels of each state from their colors alone, and its variance.
    good
        (S, n): where both are valid.
    shape
        Rows and columns, H W = n.
    window_px
        Standard deviation of the Gaussian that averages changes, px.

    Returns
    -------
    change, stiffness
        (S, n): change of log light from the mean of the states, and one over the variance of
        single pixels about it.
    """
    known = good & np.isfinite(shading_variance) & (shading_variance > 0.0)
    light = np.where(known, log_shading, 0.0).astype(np.float64)
    variance = np.where(known, shading_variance, 1.0).astype(np.float64)
    share = np.where(known, 1.0 / variance, 0.0)
    share /= np.maximum(share.sum(axis=0), 1e-300)
    change = light - (share * light).sum(axis=0)
    # change_s = l_s - sum_k p_k l_k with inverse-variance weights p has the variance
    # (1 - 2 p_s) v_s + sum_k p_k^2 v_k
    scatter = (1.0 - 2.0 * share) * variance + (share**2 * variance).sum(axis=0)
    # a pixel observed in one state alone contains no change
    weight = np.where(known & (share < 1.0 - 1e-9), 1.0 / np.maximum(scatter, 1e-12), 0.0)

    def around(values: Float64Array, reach_px: float) -> Float64Array:
        stack = values.reshape(-1, *shape)
        smoothed = gaussian_filter(stack, reach_px, mode="constant", axes=(1, 2))
        return np.asarray(smoothed.reshape(values.shape))

    total = np.maximum(around(weight, window_px), 1e-9)
    smooth = around(weight * change, window_px) / total
    # squared Gaussian weights are a Gaussian of sigma / sqrt(2) over 4 pi sigma^2: the variance of
    # the weighted mean
    area = 4.0 * math.pi * window_px**2
    smooth_variance = around(weight, window_px / math.sqrt(2.0)) / (area * total**2)
    rest = weight * (np.square(change - smooth) - scatter)
    wide = 3.0 * window_px
    squares = np.maximum(around(weight**2, wide), 1e-9)
    excess = around(weight * rest, wide) / squares
    # standard deviation of the excess by chance: a weighted square has the variance 2
    chance = np.sqrt(2.0 * around(weight**2, wide / math.sqrt(2.0)) / (4.0 * math.pi))
    chance /= wide * squares
    # a wrinkle's shadow is narrower than the window: an outlier has its own deviation as error
    apart = np.square(change - smooth)
    alone = np.where(apart > OUTLIER_SIGMAS**2 * scatter, apart, 0.0)
    loose = np.maximum(np.maximum(excess, alone), 0.0) + chance + smooth_variance
    stiffness = 1.0 / np.minimum(loose + MIN_LIGHT_CHANGE**2, MAX_LIGHT_CHANGE**2)
    return smooth.astype(np.float32), stiffness.astype(np.float32)
