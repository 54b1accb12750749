"""Light on each pixel of a face, which turns diffuse light into the reflectance of skin.

Color determines how the light varies over a face, but its level only as well as the tissue's optics
are known. Brightness determines the level: skin that faces the lamps gets as much light as a white
reference in its place. Both are averaged by their uncertainties.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter

from model.color_table import ColorTable
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.chromophores import shading_prior
from reconstruction.chromophores.face import MIN_FACE_PIXELS, FaceEstimate
from reconstruction.chromophores.posterior import propagate_optics_to_shading

WINDOW_RADIUS_PX: Final = 1
"""Radius of the window over which the light is averaged along the brightness."""
MIN_BRIGHTNESS_VARIANCE: Final = 1e-5
"""Variance of log brightness in a window below which the light is averaged as if it were even."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceLight:
    """Light of a face's pixels over that of a white reference; arrays of the pixels' shape."""

    log_light: Float32Array
    """Natural logarithm; 0 where not valid."""
    log_variance: Float32Array
    """Its variance, with the part that is common to the face."""
    valid: BoolArray
    common_log_sd: float
    """Standard deviation of the part that is common to the face."""


def estimate_face_light(
    whole: FaceEstimate, rgb: FloatArray, table: ColorTable, *, log_light_sd: float
) -> FaceLight:
    """Estimate the light on each pixel of a face.

    Parameters
    ----------
    whole
        Chromophores and shading of the image.
    rgb
        (H, W, 3): the colors that they were estimated from.
    table
        Table with its covariance by unknown optics.
    log_light_sd
        Standard deviation of the prior of log shading.

    Notes
    -----
    Melanin and light of a pixel are correlated, so the shading of the face's distribution is used
    and not that of averaged hypotheses: only its variance grows where a pixel may be a mole. The
    shading is averaged in windows of 3 x 3 pixels as a linear function of log brightness (He, Sun,
    Tang 2013, doi:10.1109/TPAMI.2012.213), which keeps the edges of shadows and of pigment.

    The level by brightness is that of the measured distribution of shading. It is the mean of two
    fits, to the light's pattern by color and to that of skin of one color.

    The position of the face limits how well brightness determines the level:
    `reconstruction.chromophores.shading_prior.LOG_SHADING_SOFTNESS`.
    """
    shading, alone = whole.by_face.shading, whole.alone_shading
    valid = whole.found.valid & (shading > 0.0) & (alone > 0.0)
    log_light, of_alone, brightness = (
        np.where(valid, np.log(np.where(valid, values, 1.0)), 0.0)
        for values in (shading, alone, np.cbrt(np.prod(np.maximum(rgb, 0.0), axis=-1)))
    )
    doubt = np.where(whole.spots, np.square(log_light - of_alone), 0.0)
    variance = np.square(np.nan_to_num(whole.by_face.log_shading_sd)) + doubt
    log_light = _average_along(brightness, log_light, valid)
    common = 0.0
    if valid.any():
        by_color = propagate_optics_to_shading(
            table,
            float(np.exp(np.log(whole.found.melanin[valid]).mean())),
            float(np.exp(np.log(whole.found.hemoglobin[valid]).mean())),
            log_light_sd=log_light_sd,
        )
        common = by_color
        if whole.face is not None and np.count_nonzero(valid) >= MIN_FACE_PIXELS:
            usual = shading_prior.face_prior(softness=shading_prior.MIN_SOFTNESS)
            by_brightness = shading_prior.LOG_SHADING_SOFTNESS
            weight = by_color**2 / (by_color**2 + by_brightness**2)
            # where color misses pigment, its pattern is too flat and that of brightness too wide
            even_skin = brightness + np.median((log_light - brightness)[valid])
            offsets = [usual.find_offset(pattern[valid]) for pattern in (log_light, even_skin)]
            log_light -= weight * float(np.mean(offsets))
            common = float(np.sqrt(weight)) * by_brightness
    return FaceLight(
        np.where(valid, log_light, 0.0).astype(np.float32),
        (variance + common**2).astype(np.float32),
        valid,
        common,
    )


def _average_along(guide: Float64Array, values: Float64Array, valid: BoolArray) -> Float64Array:
    """Average values in windows as local linear functions of the guide, over valid pixels."""
    side = 2 * WINDOW_RADIUS_PX + 1
    weight = valid.astype(np.float64)

    def total(image: Float64Array) -> Float64Array:
        return np.asarray(uniform_filter(image * weight, side, mode="constant"))

    count = np.maximum(total(weight), 1e-9)
    mean_guide, mean = total(guide) / count, total(values) / count
    covariance = total(guide * values) / count - mean_guide * mean
    variance = total(guide * guide) / count - mean_guide**2
    slope = covariance / (np.maximum(variance, 0.0) + MIN_BRIGHTNESS_VARIANCE)
    offset = mean - slope * mean_guide
    return np.asarray(total(slope) / count * guide + total(offset) / count)
