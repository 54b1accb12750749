"""Light on each pixel of a face, which turns diffuse light into the reflectance of skin.

Color determines how the light varies over a face, but its level only as well as the tissue's optics
are known. Brightness determines the level: skin that faces the lamps gets as much light as a white
reference in its place.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter

from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.chromophores import shading_prior
from reconstruction.chromophores.face import FaceEstimate

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


def estimate_face_light(whole: FaceEstimate, rgb: FloatArray) -> FaceLight:
    """Estimate the light on each pixel of a face.

    Parameters
    ----------
    whole
        Chromophores and shading of the image.
    rgb
        (H, W, 3): the colors that they were estimated from.

    Notes
    -----
    Melanin and light of a pixel are correlated, so the shading of the face's distribution is used
    and not that of averaged hypotheses: only its variance grows where a pixel may be a mole. The
    shading is averaged in windows of 3 x 3 pixels as a linear function of log brightness (He, Sun,
    Tang 2013, doi:10.1109/TPAMI.2012.213), which keeps the edges of shadows and of pigment.

    With a white reference, half of a face gets more light than the median of the measured
    distribution of shading. That level is used, because by color it depends on the tissue's optics.
    Its error is that of the face's position:
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
    level_sd = 0.0
    if whole.common is not None and valid.any():
        level_sd = whole.common.log_light_sd
        if whole.face is not None:
            level_sd = shading_prior.LOG_SHADING_SOFTNESS
            usual = shading_prior.face_prior(softness=shading_prior.MIN_SOFTNESS).median
            log_light += usual - float(np.median(log_light[valid]))
    return FaceLight(
        np.where(valid, log_light, 0.0).astype(np.float32),
        (variance + level_sd**2).astype(np.float32),
        valid,
        level_sd,
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
