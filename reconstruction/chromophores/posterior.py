"""Posterior of melanin and hemoglobin per pixel, with shading known only in distribution.

Skin of more than a few percent melanin has the color of lighter skin in less light. A fit must
choose one of these solutions, and its standard error excludes the other. Here the posterior covers
all pairs of chromophores: the likelihood of the color, with noise and model error; the prior of the
shading that they imply; and, where known, the distribution of melanin and blood over the face. The
estimate is the posterior median. Its 68 % credible half-width covers both solutions where both are
possible.

Unknown optics move the colors of all pixels of a face together.
`reconstruction.chromophores.common_optics` estimates this common error; pixels without it are
estimated as if the optics were exact, and `add_optics_errors` adds what remains unknown.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from model.color_table import ColorTable
from model.threads import run_in_blocks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.chromophores import posterior_kernels as ridge
from reconstruction.chromophores.common_optics import CommonOptics
from reconstruction.chromophores.face_distribution import FaceDistribution
from reconstruction.chromophores.inversion import ChromophoreMaps, invert
from reconstruction.chromophores.model_error import (
    DEFAULT_RELATIVE_NOISE,
    add_brightness_variance,
    model_covariance,
)
from reconstruction.chromophores.pixel_checks import ChromophoreError, is_usable_color
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.chromophores.start import MELANIN_AXIS, MIN_AXIS_FRACTION, equal_melanin_lines
from reconstruction.chromophores.table_fit.fitting import POPULATION_LOG_SD, POPULATION_MELANIN
from reconstruction.chromophores.table_fit.kernels import OUTSIDE_DISTANCE, OUTSIDE_SIGMAS

MIN_RELATIVE_NOISE = 2e-4
"""Minimum relative error of a color; smaller noise is raised to it. It corresponds to some 0.3
percent of melanin."""
_TASK_PIXELS = 1024
_BAND_PIXELS = 1 << 16


@dataclass(frozen=True, slots=True)
class ChromophorePosterior:
    """Medians and 68 % credible half-widths; every map has the pixels' shape."""

    melanin: Float32Array
    """Volume fraction of melanin in the epidermis: the median; NaN where the input is unusable."""
    hemoglobin: Float32Array
    """Volume fraction of blood in the dermis: the median; NaN where the input is unusable."""
    shading: Float32Array
    """Light on the pixel over that on a white reference: exponential of the mean logarithm."""
    log_shading_sd: Float32Array
    """Standard deviation of the logarithm of `shading`, by noise and by the chromophores that the
    color leaves open; without unknown optics."""
    stderr_melanin: Float32Array
    """68 % credible half-width: distance from `melanin` that contains 68.3 % of the probability;
    the standard deviation for a normal distribution."""
    stderr_hemoglobin: Float32Array
    """68 % credible half-width of `hemoglobin`."""
    optics_stderr_melanin: Float32Array
    """Part of `stderr_melanin` by optics that are unknown but common to a face's pixels; 0 where
    each pixel has its own optics, or they are exact."""
    optics_stderr_hemoglobin: Float32Array
    """The same for `hemoglobin`."""
    residual: Float32Array
    """Root of the weighted square sum of the best color's residuals, in standard errors."""
    gamut_distance: Float32Array
    """Distance to the table's nearest color: root mean square relative difference."""
    outside: BoolArray
    """The color does not belong to the table, see `reconstruction.chromophores`, by the mean model
    error or by the pixel's own."""
    valid: BoolArray
    """Usable input, and not `outside`."""


def estimate(
    rgb: ArrayLike,
    table: ColorTable,
    *,
    prior: ShadingPrior,
    face: FaceDistribution | None = None,
    variance: ArrayLike | None = None,
    model_error: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> ChromophorePosterior:
    """Estimate the posterior of melanin and hemoglobin of every pixel over all solutions.

    Parameters
    ----------
    rgb
        Shape (..., 3): light of the pixel over that of a white reference, linear camera RGB.
    table
        Color table of the camera and the illumination of the image. Its covariance by unknown
        optics is added to each pixel's; `reconstruction.chromophores.posterior` treats optics
        that are common to a face.
    prior
        Distribution of the pixels' shading.
    face
        Distribution of melanin and blood over the face, see `reconstruction.chromophores.face`.
        None: the priors of the notes.
    variance
        Noise variance of `rgb`, broadcast to its shape. None: 1 percent of each channel.
    model_error
        Relative error of the table's colors, see `reconstruction.chromophores.invert`; or a
        covariance for each pixel, shape (..., 3, 3).
    valid
        Shape (...): False where a pixel is masked otherwise. None: all may be used.

    Returns
    -------
    ChromophorePosterior
        Medians, 68 % credible half-widths and masks of the pixels' shape.

    Raises
    ------
    ChromophoreError
        When shapes do not match, or the model error is not a covariance.

    Notes
    -----
    The prior of melanin is log-uniform, and that of blood uniform in its cube root, unless `face`
    replaces them. The prior of the shading must be wide against noise and model error: it is taken
    as constant over the shadings that one pair of chromophores leaves open. The coverage of 68 %
    holds on average over skin drawn from the prior, not for each skin or shade; near the ends of
    the table the intervals cover more. The integration follows the best blood along melanin:
    without a `face` it can miss other blood with the same melanin and color (at 12 % melanin a
    half-width can be a quarter too small).

    Examples
    --------
    >>> from model import color_table
    >>> from reconstruction.chromophores.shading_prior import lognormal_prior
    >>> table = color_table.build("Nikon 5100 (NPL)", "D65", exact_optics=True)
    >>> color = 0.8 * table.lookup([[0.01, 0.02]], [[0.02, 0.02]])
    >>> prior = lognormal_prior(0.7, 0.6)
    >>> found = estimate(color, table, prior=prior, variance=(1e-3 * color) ** 2)
    >>> [f"{value:.3f}" for value in found.melanin[0]]
    ['0.010', '0.020']
    >>> [f"{value:.2f}" for value in found.shading[0]]
    ['0.80', '0.80']
    """
    colors = np.asarray(rgb, dtype=np.float32)
    seen = is_usable_color(colors)
    usual, covariances = _covariances(model_error, seen, variance is None)
    fitted = invert(colors, table, variance=variance, model_error=usual, valid=valid)
    shape = fitted.melanin.shape
    pixels = fitted.melanin.size
    usable = np.isfinite(fitted.melanin) & np.isfinite(fitted.hemoglobin)
    ends = np.array([table.c_m_max, table.c_hd_max])
    fractions = np.stack([fitted.melanin, fitted.hemoglobin], axis=-1) / ends
    begin = np.clip(np.cbrt(np.where(usable[..., None], fractions, 0.1)), MIN_AXIS_FRACTION, 1.0)
    if table.optics_covariance is not None:
        # the free fit is on the light side of the fold; usual light finds the probable side
        likely = invert(
            colors,
            table,
            shading=float(np.exp(prior.mean)),
            variance=variance,
            model_error=model_covariance(usual, default_noise=False) + prior.sd**2,
            valid=valid,
        )
        covariances = covariances + _optics_at(table, likely)
    noise = np.zeros(3) if variance is None else np.asarray(variance, dtype=np.float32)
    lines = equal_melanin_lines(table)
    maps = np.empty((len(ridge.POSTERIOR_MAPS), pixels), dtype=np.float32)
    run_in_blocks(
        ridge.integrate_posteriors,
        pixels,
        _TASK_PIXELS,
        np.ascontiguousarray(colors).reshape(-1, 3),
        np.ascontiguousarray(np.broadcast_to(noise, colors.shape), np.float32).reshape(-1, 3),
        usable.reshape(-1),
        np.ascontiguousarray(begin, dtype=np.float32).reshape(-1, 2),
        np.ascontiguousarray(covariances),
        lines.log_rgb,
        lines.by_a,
        lines.by_b,
        ends,
        -2.0 * np.log(prior.density),
        prior.low,
        prior.step,
        *_face_prior_costs(face, table),
        maps,
    )
    named = dict(zip(ridge.POSTERIOR_MAPS, maps.reshape(len(maps), *shape), strict=True))
    # the start fit used the mean model error, which is far too large in an image with much
    # background, so the residual is tested again with each pixel's own error
    outside = fitted.outside | (
        (named["residual"] > OUTSIDE_SIGMAS) & (fitted.gamut_distance > OUTSIDE_DISTANCE)
    )
    none = np.zeros(shape, dtype=np.float32)
    return ChromophorePosterior(
        **named,
        optics_stderr_melanin=none,
        optics_stderr_hemoglobin=none,
        gamut_distance=fitted.gamut_distance,
        outside=outside,
        valid=usable & np.isfinite(named["melanin"]) & ~outside,
    )


def _face_prior_costs(
    face: FaceDistribution | None, table: ColorTable
) -> tuple[Float64Array, Float64Array]:
    """Return the kernel's -2 log prior of melanin, and its four parameters of blood."""
    if face is None:
        costs = np.zeros(MELANIN_AXIS.size)
        if table.optics_covariance is not None:
            away = np.log(table.c_m_max * MELANIN_AXIS**3 / POPULATION_MELANIN)
            costs = np.square(away / POPULATION_LOG_SD[0])
        return costs, np.array([0.5, 1.0, 0.0, 1.0])
    density = face.melanin.relative_density(np.log(table.c_m_max * MELANIN_AXIS**3))
    blood = face.blood
    return (
        -2.0 * np.log(density / density.max()),
        np.array([blood.mean, blood.total_sd, blood.peak_density, blood.contamination]),
    )


_UPPER_TRIANGLE = np.triu_indices(3)


def _covariances(
    model_error: ArrayLike | None, seen: BoolArray, default_noise: bool
) -> tuple[ArrayLike | None, Float64Array]:
    """Return the mean model error, and the upper triangles of the pixels' covariances, (m, 6).

    The mean error serves only the fit that finds the starting point, over the pixels `seen`.
    """
    each = np.asarray(0.0 if model_error is None else model_error, dtype=np.float64)
    if each.ndim < 3:
        usual = model_covariance(model_error, default_noise)
        covariances = add_brightness_variance(usual + MIN_RELATIVE_NOISE**2 * np.eye(3))[None]
        return model_error, covariances[(..., *_UPPER_TRIANGLE)]
    check = Checks(ChromophoreError)
    check.shape("model_error", each, (*seen.shape, 3, 3))
    each = each.reshape(-1, 3, 3)
    floor = (DEFAULT_RELATIVE_NOISE**2 if default_noise else 1e-12) + MIN_RELATIVE_NOISE**2
    triangles = np.empty((len(each), 6))
    for start in range(0, len(each), _BAND_PIXELS):  # copies of a whole image need gigabytes
        band = each[start : start + _BAND_PIXELS]
        diagonal = np.einsum("nii->ni", band)
        check.within("model_error", band)
        check.within("diagonal of model_error", diagonal, "[0, inf)")
        brightness = diagonal.mean(axis=1) + floor + 1e-6
        part = band[(slice(None), *_UPPER_TRIANGLE)] + brightness[:, None]
        part[:, [0, 3, 5]] += floor
        triangles[start : start + _BAND_PIXELS] = part
    known = each[seen.reshape(-1)]
    return known.mean(axis=0) if len(known) else None, triangles


def _optics_at(table: ColorTable, likely: ChromophoreMaps) -> Float64Array:
    """Return upper triangles of the covariance by unknown optics at a fit, (n, 6)."""
    melanin, blood = likely.melanin.reshape(-1), likely.hemoglobin.reshape(-1)
    found = np.empty((len(melanin), 6))
    for start in range(0, len(melanin), _BAND_PIXELS):
        band = slice(start, start + _BAND_PIXELS)
        c_m = np.clip(np.nan_to_num(melanin[band]), 0.0, table.c_m_max)
        c_hd = np.clip(np.nan_to_num(blood[band]), 0.0, table.c_hd_max)
        found[band] = table.log_covariance(c_m, c_hd)[(slice(None), *_UPPER_TRIANGLE)]
    return found


def add_optics_errors(
    found: ChromophorePosterior,
    rgb: FloatArray,
    table: ColorTable,
    common: CommonOptics,
    *,
    variance: FloatArray,
    model_error: FloatArray,
) -> ChromophorePosterior:
    """Add the errors by common optics to estimates made with exact optics.

    Parameters
    ----------
    found
        Estimates by `model.color_table.with_exact_optics` of the table, from colors without the
        most probable common error.
    rgb, variance, model_error
        As given to `reconstruction.chromophores.posterior.estimate`; variance of the colors' shape.
    table
        Table with its covariance by unknown optics.
    common
        Common error of the face's colors.

    Returns
    -------
    ChromophorePosterior
        Standard errors with the optics' part, which is a common factor of the face's melanin, and
        one of its blood; `outside` and `valid` for colors of skin with any of the optics.
    """
    colors = np.asarray(rgb, dtype=np.float32)
    usable = is_usable_color(colors) & np.isfinite(found.melanin)
    errors = np.asarray(model_error, dtype=np.float64)
    usual = errors
    if errors.ndim > 2:
        usual = errors[usable].mean(axis=0) if usable.any() else np.zeros((3, 3))
    fitted = invert(colors, table, variance=variance, model_error=usual)
    melanin = np.float32(common.melanin_half_width) * found.melanin
    hemoglobin = np.float32(common.blood_half_width) * found.hemoglobin
    return replace(
        found,
        stderr_melanin=np.hypot(found.stderr_melanin, melanin),
        stderr_hemoglobin=np.hypot(found.stderr_hemoglobin, hemoglobin),
        optics_stderr_melanin=melanin,
        optics_stderr_hemoglobin=hemoglobin,
        gamut_distance=fitted.gamut_distance,
        outside=fitted.outside,
        valid=usable & np.isfinite(found.hemoglobin) & ~fitted.outside,
    )


def errors_within_face(stderr: FloatArray, optics_stderr: FloatArray) -> FloatArray:
    """Return standard errors without the part by optics that are common to the face.

    Examples
    --------
    >>> float(errors_within_face(np.array(0.5), np.array(0.4)).round(6))
    0.3
    """
    return np.asarray(np.sqrt(np.maximum(np.square(stderr) - np.square(optics_stderr), 0.0)))
