"""Average repeated images, with the variance of the mean by noise or by their scatter.

A scatter of repeats above their noise measures how well skin and pose repeat. Only their color
counts: the energy of flashes varies by some thousandths, which scales a whole image, and the
chromophore fit leaves a pixel's brightness free (`reconstruction.facial_color.shared_melanin`).
"""

import numpy as np
from scipy.stats import chi2

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, FloatArray

_MAX_MEDIAN_PIXELS = 200_000
"""Pixels that determine a median to a quarter of a percent."""


def average_repeats(
    rgb: FloatArray, variance: FloatArray, valid: BoolArray
) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Average repeats where any is valid, and return the variance of the mean.

    Parameters
    ----------
    rgb
        (R, H, W, 3): linear camera RGB of R repeats, aligned; finite, and positive where valid.
    variance
        (R, H, W, 3): variance of its noise.
    valid
        (R, H, W).

    Returns
    -------
    mean : ndarray of float32, shape (H, W, 3)
        0 where no repeat is valid.
    variance : ndarray of float32, shape (H, W, 3)
        Variance by noise, multiplied by `overdispersion` where repeats scatter more.
    valid : ndarray of bool, shape (H, W)
        Where any repeat is valid.

    Raises
    ------
    ValueError
        When shapes do not match.

    Examples
    --------
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal((4, 50, 50, 3))
    >>> mean, variance, _ = average_repeats(
    ...     0.5 + noise, np.full_like(noise, 1e-4), np.ones((4, 50, 50), bool))
    >>> bool(abs(mean.mean() - 0.5) < 1e-3), bool(abs(variance.mean() / 2.5e-5 - 1.0) < 0.1)
    (True, True)
    """
    check = Checks()
    good = rgb.ndim == 4 and rgb.shape[-1] == 3
    check.require(good, "rgb", f"shape {rgb.shape}", "(R, H, W, 3)")
    check.shape("variance", variance, rgb.shape)
    check.mask("valid", valid, rgb.shape[:-1])
    kept = valid[..., None]
    count = valid.sum(axis=0)
    many = np.maximum(count, 1)[..., None]
    mean = np.where(kept, rgb, 0.0).sum(axis=0, dtype=np.float64) / many
    noise = np.where(kept, variance, 0.0).sum(axis=0, dtype=np.float64) / np.square(many)
    noise *= overdispersion(rgb, variance, valid)
    return mean.astype(np.float32), noise.astype(np.float32), np.asarray(count > 0)


def overdispersion(rgb: FloatArray, variance: FloatArray, valid: BoolArray) -> float:
    """Return the variance of repeats' colors over that of noise, at least 1.

    One factor for the whole image, because the scatter of one pixel's few repeats is imprecise. It
    is that of the median pixel, so that a few misregistered pixels, which have an error of their
    own (`reconstruction.facial_color.registration_error`), do not affect all.

    Parameters
    ----------
    rgb, variance, valid
        See `average_repeats`.

    Examples
    --------
    >>> noise = 0.01 * np.random.default_rng(0).standard_normal((3, 40, 40, 3))
    >>> everywhere = np.ones((3, 40, 40), bool)
    >>> flashes = np.array([1.0, 1.02, 0.98])[:, None, None, None]
    >>> [round(overdispersion(flashes * (0.5 + k * noise), np.full_like(noise, 1e-4), everywhere))
    ...  for k in (1.0, 3.0)]
    [1, 9]
    """
    repeats = len(rgb)
    whole = valid.all(axis=0)
    whole &= ((rgb > 0.0) & (variance > 0.0)).all(axis=(0, -1))
    some = np.flatnonzero(whole)
    if repeats < 2 or not some.size:
        return 1.0
    some = some[:: -(-some.size // _MAX_MEDIAN_PIXELS)]
    seen = rgb.reshape(repeats, -1, 3)[:, some].astype(np.float64)  # (R, n, 3)
    off = seen / seen.mean(axis=0) - 1.0
    weight = np.square(seen) / variance.reshape(repeats, -1, 3)[:, some]
    # subtract least-squares offsets of each repeat and each channel; exact where the noise is a
    # factor per repeat times one per channel
    off -= ((weight * off).sum(axis=-1) / weight.sum(axis=-1))[..., None]
    off -= (weight * off).sum(axis=0) / weight.sum(axis=0)
    squares = (weight * np.square(off)).sum(axis=(0, -1))
    free = 2 * (repeats - 1)  # three channels minus brightness, R repeats minus their mean
    return max(1.0, float(np.median(squares) / chi2.median(free)))
