"""Errors of a face's chromophores by optics that are unknown but common to its pixels.

Thickness, scattering and oxygenation vary little within one face and much between people. They move
all pixels of a face together, so that they change neither its contrasts nor the weights of pixels
against each other. Pixels are therefore estimated as if the optics were exact. The standard errors
and the test of belonging to the table then include the covariance of `ColorTable.log_covariance`.
"""

from dataclasses import replace

import numpy as np

from model.color_table import ColorTable
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.chromophores.inversion import invert
from reconstruction.chromophores.pixel_checks import is_usable_color
from reconstruction.chromophores.posterior import ChromophorePosterior
from reconstruction.chromophores.start import MIN_AXIS_FRACTION, evaluate_table

AXIS_SD = 0.3
"""Standard deviation of both axes' fractions without a color: that of a uniform distribution."""
MIN_COLOR_ERROR = 2e-3
"""Relative error that keeps weights finite."""
_BAND_PIXELS = 1 << 16


def add_optics_errors(
    found: ChromophorePosterior,
    rgb: FloatArray,
    table: ColorTable,
    *,
    variance: FloatArray,
    model_error: FloatArray,
    log_light_sd: float,
) -> ChromophorePosterior:
    """Add the errors by common optics to estimates made with exact optics.

    Parameters
    ----------
    found
        Estimates by `model.color_table.with_exact_optics` of the table.
    rgb, variance, model_error
        As given to `reconstruction.chromophores.posterior.estimate`; variance of the colors' shape.
    table
        Table with its covariance by unknown optics; without one, `found` is returned.
    log_light_sd
        Standard deviation of the prior of log shading.

    Returns
    -------
    ChromophorePosterior
        Standard errors with the optics' part, by linear propagation; `outside` and `valid` for
        colors of skin with any of the optics.
    """
    if table.optics_covariance is None:
        return found
    colors = np.asarray(rgb, dtype=np.float32)
    usable = is_usable_color(colors) & np.isfinite(found.melanin)
    errors = np.asarray(model_error, dtype=np.float64)
    usual = errors
    if errors.ndim > 2:
        usual = errors[usable].mean(axis=0) if usable.any() else np.zeros((3, 3))
    fitted = invert(colors, table, variance=variance, model_error=usual)
    relative = np.full((2, *found.melanin.shape), np.nan, dtype=np.float32)
    places = np.flatnonzero(usable)
    noise = np.broadcast_to(np.asarray(variance), colors.shape).reshape(-1, 3)
    flat = colors.reshape(-1, 3)
    for start in range(0, places.size, _BAND_PIXELS):
        at = places[start : start + _BAND_PIXELS]
        own = errors.reshape(-1, 3, 3)[at] if errors.ndim > 2 else errors
        known = noise[at] / np.square(flat[at].astype(np.float64)) + MIN_COLOR_ERROR**2
        covariance = known[:, :, None] * np.eye(3) + own + log_light_sd**2
        fractions = found.melanin.reshape(-1)[at], found.hemoglobin.reshape(-1)[at]
        relative.reshape(2, -1)[:, at] = _relative_errors(table, *fractions, covariance)
    melanin, hemoglobin = relative[0] * found.melanin, relative[1] * found.hemoglobin
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


def _relative_errors(
    table: ColorTable, melanin: FloatArray, hemoglobin: FloatArray, covariance: Float64Array
) -> Float64Array:
    """Return the optics' relative errors of melanin and hemoglobin, (2, n)."""
    a = np.clip(np.cbrt(melanin / table.c_m_max, dtype=np.float64), MIN_AXIS_FRACTION, 1.0)
    b = np.clip(np.cbrt(hemoglobin / table.c_hd_max, dtype=np.float64), MIN_AXIS_FRACTION, 1.0)
    color, by_a, by_b = evaluate_table(table, a, b)
    slopes = np.stack([by_a / color, by_b / color], axis=-1)
    weighted = np.swapaxes(slopes, 1, 2) @ np.linalg.inv(covariance)
    gain = np.linalg.solve(weighted @ slopes + np.eye(2) / AXIS_SD**2, weighted)
    optics = table.log_covariance(table.c_m_max * a**3, table.c_hd_max * b**3)
    moved = np.einsum("nic,ncd,nid->in", gain, optics, gain)
    # c = c_max a^3, hence dc / c = 3 da / a
    return np.asarray(3.0 * np.sqrt(np.maximum(moved, 0.0)) / np.stack([a, b]))
