"""Detect pixels that may not be usual skin of the face: moles and shade, lips and eyelids.

Within one person's skin, whose pigment changes slowly, the face distribution separates pigment from
shade (`reconstruction.chromophores.face`). A mole does not follow that distribution. Shade is far
more frequent, so the distribution explains a mole as usual skin in little light, with a small
standard error. Illumination also changes slowly, except at shadow edges. Pixels that are darker
than their surroundings are therefore mole or shade with equal probability: their estimate is
halfway between the face and the single-pixel estimate, and their interval contains both.

Lips and eyelids have less melanin than the rest of a face. The face distribution explains them as
usual skin with less blood. Shade makes a single pixel look like darker skin, never lighter. Pixels
whose single-pixel melanin is below their face estimate by more than the standard error are
therefore treated in the same way.
"""

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array
from reconstruction.chromophores.pixel_checks import (
    ChromophoreError,
    broadcast_to_pixels,
    check_mask,
    is_usable_color,
)
from reconstruction.chromophores.posterior import ChromophorePosterior

MIN_LOG_CONTRAST: Final = 0.1
"""Minimum contrast in log light: 12 % more melanin on skin of 5 %, 31 % more on skin of 1 %, which
is close to the standard deviation within a face."""
CONTRAST_SIGMAS: Final = 3.0
"""Minimum contrast in standard deviations of a pixel's noise."""
WINDOW_DIVISOR: Final = 20
"""The surroundings are a square whose side is the skin's, as a square, over this: 9 mm of
skin 180 mm across; larger ones contain more skin that is dark only by its slope."""
MIN_WINDOW_PX: Final = 7
"""Minimum side of the surroundings in pixels; a mole would shift the median of a smaller one."""
_MAX_WINDOW_BLOCKS: Final = 11
"""Odd; finer squares are replaced by medians of pixel blocks, which keeps large images fast."""
_WINDOWS_PER_PASS: Final = 1 << 14
_BAND_ROWS: Final = 128


def is_locally_dark(
    colors: ArrayLike, *, variance: ArrayLike | None = None, valid: ArrayLike | None = None
) -> BoolArray:
    """Return where skin is darker than the median of its surroundings.

    Parameters
    ----------
    colors
        Shape (rows, columns, channels): light of the pixels, linear, in any unit. Not modified.
    variance
        Noise variance of `colors`, broadcast to its shape. None: none.
    valid
        Shape (rows, columns): False where a pixel is not skin. None: all pixels with light are.

    Returns
    -------
    ndarray of bool
        (rows, columns); False where a pixel is masked or has no light above 0.

    Raises
    ------
    reconstruction.chromophores.ChromophoreError
        When shapes do not fit.

    Examples
    --------
    >>> skin = np.ones((20, 20, 3))
    >>> skin[9:11, 9:11] = 0.5
    >>> np.argwhere(is_locally_dark(skin)).tolist()
    [[9, 9], [9, 10], [10, 9], [10, 10]]
    """
    light = np.asarray(colors)
    got = f"shape {light.shape}"
    check = Checks(ChromophoreError)
    check.require(light.ndim == 3 and light.shape[-1], "colors", got, "(rows, columns, 3)")
    good = is_usable_color(light)
    if valid is not None:
        good &= check_mask(valid, good.shape)
    whole = None if variance is None else broadcast_to_pixels("variance", variance, light.shape)
    log_light = np.full(good.shape, np.nan, dtype=np.float32)
    least = np.full(good.shape, MIN_LOG_CONTRAST, dtype=np.float32)
    for start in range(0, len(good), _BAND_ROWS):  # copies of a whole image need gigabytes
        band = slice(start, start + _BAND_ROWS)
        kept = light[band][good[band]].astype(np.float64)
        log_light[band][good[band]] = np.log(kept).mean(axis=-1)
        if whole is not None:
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                noise = np.sqrt((whole[band][good[band]] / np.square(kept)).sum(axis=-1))
            # undefined noise gives no evidence of contrast, so its threshold is infinite
            noise = np.where(noise >= 0.0, noise, np.inf) / light.shape[-1]
            least[band][good[band]] = np.maximum(MIN_LOG_CONTRAST, CONTRAST_SIGMAS * noise)
    with np.errstate(invalid="ignore"):
        return np.asarray(_median_around(log_light, good) - log_light > least)


def is_lighter_than_face_prior(
    by_face: ChromophorePosterior, alone: ChromophorePosterior
) -> BoolArray:
    """Return where single-pixel melanin is below the face estimate, outside its 68 % interval.

    Parameters
    ----------
    by_face, alone
        Estimates of the same pixels, with and without the face distribution.

    Returns
    -------
    ndarray of bool
        Of the pixels' shape; False where one of the two is unknown.

    Raises
    ------
    reconstruction.chromophores.ChromophoreError
        When shapes differ.
    """
    Checks(ChromophoreError).shape("alone", alone.melanin, by_face.melanin.shape)
    with np.errstate(invalid="ignore"):
        return np.asarray(by_face.melanin - alone.melanin > alone.stderr_melanin)


def average_hypotheses(
    by_face: ChromophorePosterior, alone: ChromophorePosterior, equally_likely: ArrayLike
) -> ChromophorePosterior:
    """Average two hypotheses where they are equally probable; their intervals contain both.

    Parameters
    ----------
    by_face, alone
        Estimates of the same pixels, with and without the face distribution.
    equally_likely
        Of the pixels' shape: where the hypotheses are equally probable; elsewhere `by_face` stays.

    Returns
    -------
    ChromophorePosterior
        Means of both, with the standard deviation of their mixture in equal parts; `valid` where
        both are. The residual is that of `by_face`.

    Raises
    ------
    reconstruction.chromophores.ChromophoreError
        When shapes differ.
    """
    doubtful = np.asarray(equally_likely, dtype=np.bool_)
    for estimate in (by_face, alone):
        Checks(ChromophoreError).shape("equally_likely", doubtful, estimate.melanin.shape)
    mixed = {}
    for name in ("melanin", "hemoglobin"):
        first, second = getattr(by_face, name), getattr(alone, name)
        errors = getattr(by_face, f"stderr_{name}"), getattr(alone, f"stderr_{name}")
        half = 0.5 * (first - second)
        spread = np.sqrt(0.5 * (np.square(errors[0]) + np.square(errors[1])) + np.square(half))
        mixed[name] = np.where(doubtful, first - half, first)
        mixed[f"stderr_{name}"] = np.where(doubtful, spread, errors[0])
    return replace(
        by_face,
        **mixed,
        shading=np.where(doubtful, np.sqrt(by_face.shading * alone.shading), by_face.shading),
        valid=by_face.valid & (alone.valid | ~doubtful),
    )


def _median_around(values: Float32Array, good: BoolArray) -> Float32Array:
    """Return the median of the good pixels in the square around each pixel, NaN without any."""
    if not good.any():
        return np.full(values.shape, np.nan, dtype=np.float32)
    side = max(MIN_WINDOW_PX, round(math.sqrt(int(good.sum())) / WINDOW_DIVISOR))
    block = -(-side // _MAX_WINDOW_BLOCKS)
    coarse = _by_blocks(values, block)
    reach = max(1, round(side / block) // 2)
    padded = np.pad(coarse, reach, constant_values=np.nan)
    width = 2 * reach + 1
    windows = np.lib.stride_tricks.sliding_window_view(padded, (width, width))
    around = np.full(coarse.shape, np.nan, dtype=np.float32)
    wanted = np.argwhere(np.isfinite(coarse))
    for start in range(0, len(wanted), _WINDOWS_PER_PASS):
        rows, columns = wanted[start : start + _WINDOWS_PER_PASS].T
        around[rows, columns] = _medians(windows[rows, columns].reshape(len(rows), -1))
    whole = around.repeat(block, axis=0).repeat(block, axis=1)
    return whole[: values.shape[0], : values.shape[1]]


def _by_blocks(values: Float32Array, block: int) -> Float32Array:
    """Return the median of each block's numbers, NaN where it has none."""
    if block == 1:
        return values
    rows, columns = (-(-size // block) for size in values.shape)
    margins = [(0, rows * block - values.shape[0]), (0, columns * block - values.shape[1])]
    cut = np.pad(values, margins, constant_values=np.nan)
    cut = cut.reshape(rows, block, columns, block).swapaxes(1, 2)
    return _medians(cut.reshape(rows * columns, -1)).reshape(rows, columns)


def _medians(values: Float32Array) -> Float32Array:
    """Return medians along the last axis (n, m) without NaN, faster than `nanmedian`."""
    ordered = np.sort(values, axis=-1)  # NaN last
    count = np.isfinite(ordered).sum(axis=-1)
    row = np.arange(len(values))
    middle = 0.5 * (ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, count // 2])
    return np.asarray(middle)
