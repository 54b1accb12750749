"""Moments of many pixels, of which most are fitted in whole vectors, against dense fits."""

import numpy as np
import pytest

from reconstruction.gradient_normals import moment_kernels as kernels

GAIN, READ = 0.02, 1e-3
COVARIANCES = ((0, 0), (1, 1), (2, 2), (3, 3), (1, 2), (1, 3), (2, 3))


def design_matrix(dark):
    """Return rows of the patterns: unknowns c_0, c_x, c_y, c_z, and the dark level."""
    rows = np.zeros((8, 5))
    rows[kernels.FULL, 0] = 1.0
    rows[:, 4] = 1.0
    for axis in range(3):
        for row, sign in ((1 + axis, 1.0), (4 + axis, -1.0)):
            rows[row, 0], rows[row, 1 + axis] = 0.5, 0.5 * sign
    return rows if dark else rows[:, :4]


def fit_plain(y, noise, noise_source, dark):
    """Return the rows of one pixel by generalized least squares of all its samples."""
    out = np.full(kernels.MOMENT_ROWS, np.nan)
    there = np.isfinite(y)
    out[kernels.USED] = there.sum()
    if not dark:
        there[kernels.DARK] = False
    rows = design_matrix(dark)
    a, top = rows[there], np.nanmax(y, initial=0.0)
    if np.linalg.matrix_rank(a) < a.shape[1]:
        return out
    fit = None
    for _ in range(2 if noise_source == 2 else 1):
        variance = noise if noise_source == 1 else np.ones(8)
        if noise_source == 2:
            light = [top, 0.0, 0.0, 0.0] if fit is None else [max(fit[0], 0.0), *fit[1:4]]
            signal = rows[:, :4] @ light
            variance = np.maximum(READ + GAIN * signal, 1e-6 * (READ + GAIN * top))
        weight = np.diag(1.0 / variance[there])
        covariance = np.linalg.inv(a.T @ weight @ a)
        fit = covariance @ a.T @ weight @ y[there]
    out[:4] = fit[:4]
    for row, (i, j) in zip(range(kernels.V_0, kernels.V_YZ + 1), COVARIANCES, strict=True):
        out[row] = covariance[i, j]
    residual = y[there] - a @ fit
    out[kernels.CHI] = residual @ weight @ residual
    out[kernels.FREE] = there.sum() - a.shape[1]
    level = fit[4] if dark else 0.0
    squares = [y[kernels.FULL] - level - fit[0], y[kernels.DARK] - level if dark else np.nan]
    pairs = y[1:4] + y[4:7] - 2.0 * level - fit[0]
    out[kernels.MISFIT] = np.nansum(np.square(squares)) + 0.5 * np.nansum(pairs**2)
    return out


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("noise_source", [0, 1, 2])
@pytest.mark.parametrize("pixels", [1, 63, 64, 65, 130])
def test_moments_of_many_pixels_equal_dense_fits(rng, pixels, noise_source, dark):
    """Blocks of 64, with a rest, and pixels among them that have missing samples."""
    light = np.vstack([2.0 + rng.random(pixels), rng.uniform(-0.6, 0.6, (3, pixels))])
    y = design_matrix(False) @ light + 0.02 * rng.standard_normal((8, pixels))
    y[kernels.DARK] += 0.05
    missing = rng.random((8, pixels)) < 0.15
    missing[:, rng.random(pixels) < 0.7] = False
    y[missing] = np.nan
    noise = np.exp(0.5 * rng.standard_normal((8, pixels)))
    out = np.empty((kernels.MOMENT_ROWS, pixels))
    kernels.fit_moments(y, noise, GAIN, READ, noise_source, dark, out)
    for p in range(pixels):
        expected = fit_plain(y[:, p], noise[:, p], noise_source, dark)
        np.testing.assert_allclose(out[:, p], expected, rtol=1e-7, atol=1e-11, err_msg=str(p))
    assert pixels == 1 or missing.any()
