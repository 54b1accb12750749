"""Noise of traced profiles lowered by what is known of them: they are smooth in the distance."""

import numpy as np
from scipy.interpolate import BSpline

from rigsim.arrays import Float64Array

SPLINE_PIECES = 6
"""Pieces of the cubic spline through the logarithm of a profile."""
MAX_RELATIVE_ERROR = 0.3
"""Relative error of a fibre that the spline is still fitted to."""
MIN_SPLINE_FIBERS = 14
"""Fibres that a spline is fitted to at least."""


def smooth_profile(
    radii_mm: Float64Array, batches: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return profiles with the noise between neighbours taken out.

    Parameters
    ----------
    radii_mm
        Distances of the fibres, mm, increasing, shape (F,).
    batches
        Reflectance of independent batches of photons, >= 0, shape (B, F, bands).

    Returns
    -------
    reflectance, stderr : ndarray
        Shape (F, bands): exp of a cubic spline fitted to log reflectance; its errors by leaving
        out one batch at a time. Fibres with more than `MAX_RELATIVE_ERROR` of relative error, and
        all where fewer than `MIN_SPLINE_FIBERS` have less, stay as they were.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radii = 0.3 + 0.25 * np.arange(28)
    >>> true = np.exp(-0.6 * radii) / radii**2
    >>> noisy = true[:, None] * rng.normal(1.0, 0.1, (20, 28, 1))
    >>> smooth, error = smooth_profile(radii, noisy)
    >>> bool(np.abs(smooth[:, 0] / true - 1.0).max() < 0.06), bool((error < 0.03 * smooth).all())
    (True, True)
    """
    count = len(batches)
    mean = batches.mean(axis=0)
    error = batches.std(axis=0, ddof=1) / np.sqrt(count)
    value, spread = mean.copy(), error.copy()
    for band in range(mean.shape[1]):
        use = (mean[:, band] > 0.0) & (error[:, band] < MAX_RELATIVE_ERROR * mean[:, band])
        if int(use.sum()) < MIN_SPLINE_FIBERS:
            continue
        axis = np.log(radii_mm[use] + 0.3)
        inner = np.linspace(axis[0], axis[-1], SPLINE_PIECES + 1)[1:-1]
        knots = np.concatenate([[axis[0]] * 4, inner, [axis[-1]] * 4])
        basis = BSpline.design_matrix(axis, knots, 3).toarray()
        relative = error[use, band] / mean[use, band]
        # single errors are themselves uncertain: their trend weighs
        trend = np.exp(np.polyval(np.polyfit(axis, np.log(relative), 2), axis))
        one = batches[:, use, band]
        beta = _fit(basis, one.mean(axis=0), trend)
        value[use, band] = np.exp(basis @ beta)
        rest = (one.sum(axis=0) - one) / (count - 1)
        left = np.array([basis @ _fit(basis, r, trend) for r in rest])
        scatter = ((left - left.mean(axis=0)) ** 2).sum(axis=0)
        spread[use, band] = value[use, band] * np.sqrt((count - 1.0) / count * scatter)
    return value, spread


def _fit(basis: Float64Array, mean: Float64Array, relative: Float64Array) -> Float64Array:
    """Return coefficients of the logarithm by Gauss-Newton on relative residuals."""
    beta = np.linalg.lstsq(basis / relative[:, None], np.log(mean) / relative, rcond=None)[0]
    for _ in range(4):
        residual = mean / np.exp(basis @ beta) - 1.0
        step = np.linalg.lstsq(basis / relative[:, None], residual / relative, rcond=None)[0]
        beta = beta + step
    return np.asarray(beta)
