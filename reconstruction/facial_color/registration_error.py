"""Color error of an image that its registration to another image causes.

An image of an expression is warped to the neutral one with a position error
(`reconstruction.correspondence.expression_alignment`), so that a pixel shows the color of
neighboring skin. This error belongs to one image; images of a still face share their errors.

A uniform slope of illumination makes a misregistered image uniformly brighter or darker.
`reconstruction.facial_color.light_change` removes such changes: the slopes that remain are finer
than its window.
"""

from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.chromophores import model_error
from reconstruction.correspondence.expression_alignment import Alignment

SLOPE_WINDOW_PX: Final = 1.0
"""Standard deviation of the window that averages squared slopes, px; single pixels would count
noise as slope."""
MOTION_VARIANCE_SCALE: Final = 3.3
"""Ratio of the color variance between moved and still faces to the one that position error and
slope predict. With it and noise, the 68 % ellipse contains 68 %. Sites of the color filter array
sample other positions of the skin's texture, and pixels are interpolated. For each of 13 moved
subjects of seeds 0 to 16, maps 192 px across, the coverage is 64 to 72 %."""
BRIGHTNESS_REMOVAL: Final = np.eye(3) - 1.0 / 3.0
"""Projection that removes the mean of the channels."""


def registration_covariance(
    rgb: FloatArray,
    variance: FloatArray,
    valid: BoolArray,
    alignment: Alignment,
    *,
    light_window_px: float | None = None,
) -> Float64Array:
    """Return the covariance of each pixel's relative error by registration, (H, W, 3, 3).

    Parameters
    ----------
    rgb, variance
        (H, W, 3): the warped image, linear camera RGB, and its noise variance, which is subtracted
        from the slopes.
    valid
        (H, W): where the image is valid; the result is 0 elsewhere.
    alignment
        Warp to the neutral image.
    light_window_px
        Standard deviation of the window, px, above 0, in which changes of light are removed. None:
        they are not removed.

    Returns
    -------
    ndarray of float64
        Includes the brightness of neighboring skin and its shading, without changes slower than
        the window.

    Notes
    -----
    A position error d, of variance `error_px`^2 / 2 along each axis, gives an error of the slope of
    log color times d; `MOTION_VARIANCE_SCALE` corrects its variance.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> skin = 0.3 + 0.1 * gaussian_filter(rng.random((40, 40)), 1.5)[..., None] * [1.0, 2.0, 3.0]
    >>> rows, columns = np.indices((40, 40))
    >>> still = Alignment(
    ...     np.stack([columns, rows], axis=-1).astype(np.float32), np.ones((40, 40), bool),
    ...     np.zeros((40, 40), np.float32), np.zeros((40, 40), np.float32),
    ...     np.ones((40, 40), bool), 0.0, {}, 0.0, "landmarks", (40, 40),
    ... )
    >>> float(registration_covariance(skin, 0.0 * skin, np.ones((40, 40), bool), still).max())
    0.0
    """
    if light_window_px is not None:
        Checks().within("light_window_px", light_window_px, "(0, inf)")
    good = model_error.usable_pixels(rgb, valid, variance)
    safe = np.where(good[..., None], rgb, 1.0).astype(np.float64)
    noise = np.where(good[..., None], variance / safe**2, 0.0)
    place = np.square(alignment.error_px.astype(np.float64))
    covariance = 0.5 * place[..., None, None] * _slopes(np.log(safe), noise, good, light_window_px)
    covariance += (MOTION_VARIANCE_SCALE - 1.0) * (
        BRIGHTNESS_REMOVAL @ covariance @ BRIGHTNESS_REMOVAL
    )
    return np.where(good[..., None, None], covariance, 0.0)


def _slopes(
    log_rgb: Float64Array, noise: Float64Array, good: BoolArray, window_px: float | None
) -> Float64Array:
    """Return the sum over both axes of the slopes' outer products, per px^2, (H, W, 3, 3)."""
    outer = np.zeros((*good.shape, 3, 3))
    count = np.zeros(good.shape)
    for axis in (0, 1):
        # differences of direct neighbors: central differences over two pixels miss fine detail
        here, after = (
            tuple(part if a == axis else slice(None) for a in (0, 1))
            for part in (slice(None, -1), slice(1, None))
        )
        whole = good[here] & good[after]
        slope = np.where(whole[..., None], log_rgb[after] - log_rgb[here], 0.0)
        if window_px is not None:
            slope = np.where(
                whole[..., None], slope - _average_brightness_slope(slope, whole, window_px), 0.0
            )
        products = slope[..., :, None] * slope[..., None, :]
        by_noise = np.where(whole[..., None], noise[after] + noise[here], 0.0)
        products -= by_noise[..., :, None] * np.eye(3)
        for side in (here, after):
            outer[side] += products
            count[side] += whole
    known = np.maximum(gaussian_filter(count, SLOPE_WINDOW_PX, mode="constant"), 1e-6)
    for i in range(3):
        for j in range(i, 3):
            smooth = gaussian_filter(outer[..., i, j], SLOPE_WINDOW_PX, mode="constant")
            outer[..., i, j] = outer[..., j, i] = 2.0 * smooth / known
    # slopes below the noise are set to 0, in each principal direction of color
    values, vectors = np.linalg.eigh(outer)
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.swapaxes(-1, -2))


def _average_brightness_slope(
    slope: Float64Array, known: BoolArray, window_px: float
) -> Float64Array:
    """Return the brightness slope averaged over a window, (..., 1), the same for all channels."""
    weight = gaussian_filter(known.astype(np.float64), window_px, mode="constant")
    total = gaussian_filter(slope.mean(axis=-1), window_px, mode="constant")
    return np.asarray(total / np.maximum(weight, 1e-6))[..., None]
