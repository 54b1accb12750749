"""Standard errors of heights that were integrated from normals with known ones.

White noise of slopes becomes noise of heights whose spectrum falls with the square of frequency:
most of it is long waves, which `height_filters.high_pass` removes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_integration import slope_fields
from reconstruction.normal_integration.height_filters import SIGMA_OF_CUTOFF, high_pass
from reconstruction.normal_integration.integration import parts, to_height
from reconstruction.normal_integration.slope_fields import Perspective
from reconstruction.normal_integration.weighted_poisson import Hierarchy, IntegrationError, solve
from reconstruction.normal_maps import NormalMaps

_DIFFERENCE_STEP = 1e-3  # of the difference quotient, in standard errors
_SOLVER_TOL = 1e-3


def sampled_stderr(
    normals: FloatArray | NormalMaps,
    *,
    rng: np.random.Generator,
    stderr_rad: ArrayLike | None = None,
    pixel: float = 1.0,
    valid: BoolArray | None = None,
    y_up: bool = True,
    camera: Perspective | None = None,
    cutoff: float | None = None,
    samples: int = 16,
    smooth_px: float = 6.0,
) -> Float64Array:
    """Return the standard error of the height that `normal_integration.integrate` gives.

    Parameters
    ----------
    normals, stderr_rad, pixel, valid, y_up, camera
        As of `integrate`; standard errors are needed, here or in `NormalMaps`.
    rng
        Draws the noise.
    cutoff : float, optional
        Of `high_pass`, where the height goes through it.
    samples : int
        Fields of noise to integrate, at least 2.
    smooth_px : float
        Standard deviation of the Gaussian that variances are averaged with, px.

    Returns
    -------
    ndarray, shape (H, W), float64
        In the unit of `pixel`; 0 where not valid. Noise of the normals is taken to be isotropic
        and independent between pixels, and to act to first order. Smoothing of slopes
        (`denoise`) is not counted: it changes the longest waves, which make most of the error,
        least, so that with it this is an upper bound.

    Raises
    ------
    IntegrationError
        Without standard errors, or for samples below 2.

    Notes
    -----
    The share of the error due to the number of samples is 1 / sqrt(2 (samples - 1)) without
    smoothing, 18 % with 16.
    """
    if isinstance(normals, NormalMaps):
        if stderr_rad is None:
            stderr_rad = normals.stderr_rad
        valid = normals.valid if valid is None else valid & normals.valid
        normals = normals.normals
    if stderr_rad is None:
        raise IntegrationError("stderr_rad: got none, expected the noise of the normals")
    if samples < 2:
        raise IntegrationError(f"samples: got {samples}, expected at least 2")
    n = np.asarray(normals, np.float64)
    base = slope_fields.from_normals(
        n, valid=valid, stderr_rad=stderr_rad, y_up=y_up, camera=camera
    )
    length = np.linalg.norm(np.where(base.valid[..., None], n, 0.0), axis=-1)
    spread = (
        _DIFFERENCE_STEP
        / np.sqrt(2.0)
        * np.broadcast_to(np.asarray(stderr_rad, float), length.shape)
    )
    spread = np.where(base.valid, spread, 0.0) * length
    ax, ay, dx, dy = slope_fields.edges(base)
    hierarchy = Hierarchy(ax, ay)
    part = parts(base.valid)
    total = np.zeros(length.shape)
    flat = to_height(np.zeros(length.shape), part, pixel=pixel, camera=camera)
    for _ in range(samples):
        noisy = n + spread[..., None] * rng.standard_normal(n.shape)
        moved = slope_fields.from_normals(
            noisy, valid=base.valid, stderr_rad=stderr_rad, y_up=y_up, camera=camera
        )
        _, _, ex, ey = slope_fields.edges(moved)
        x = np.zeros(ex.shape)
        solve(
            hierarchy,
            (ex - dx) / _DIFFERENCE_STEP,
            (ey - dy) / _DIFFERENCE_STEP,
            x,
            tolerance=_SOLVER_TOL,
        )
        error: FloatArray = to_height(x[1:-1, 1:-1], part, pixel=pixel, camera=camera) - flat
        if cutoff is not None:
            error = high_pass(error, pixel=pixel, cutoff=cutoff, valid=base.valid)
        total += error**2
    variance = _smoothed(total / samples, base.valid, smooth_px)
    return np.where(base.valid, np.sqrt(variance), 0.0)


def _smoothed(values: Float64Array, valid: BoolArray, sigma: float) -> Float64Array:
    if sigma <= 0.0:
        return values
    weight = ndimage.gaussian_filter(valid.astype(float), sigma, mode="constant")
    mean = ndimage.gaussian_filter(np.where(valid, values, 0.0), sigma, mode="constant")
    return np.asarray(np.where(valid, mean / np.maximum(weight, 1e-300), 0.0))


def expected_rms(
    shape: tuple[int, int],
    slope_stderr: float,
    *,
    pixel: float = 1.0,
    cutoff: float | None = None,
    order: int = 4,
) -> float:
    """Return the height's RMS error over a rectangle whose slopes have white noise.

    Parameters
    ----------
    shape : tuple of int
        (H, W) of the rectangle; all pixels valid, all weights alike.
    slope_stderr : float
        Standard deviation of each of both slopes, dimensionless.
    pixel : float
    cutoff : float, optional
        Of `high_pass`, same unit as `pixel`.
    order : int
        Of the quadrature, see `normal_integration.Settings`.

    Returns
    -------
    float
        In the unit of `pixel`; borders are treated as if the picture were mirrored.

    Examples
    --------
    Noise of 1.5 degrees' tilt on 2048 x 2048 pixels of 6 um, without what is longer than 1 mm:

    >>> round(expected_rms((2048, 2048), 0.026, pixel=6.0, cutoff=1000.0), 2)
    0.12
    """
    waves = [np.pi * np.arange(n) / n for n in shape]
    laplacian, power = np.zeros(shape), np.zeros(shape)
    squared = np.zeros(shape)
    for axis, theta in enumerate(waves):
        half = 0.5 * theta
        mean = np.cos(half) if order == 2 else (13 * np.cos(half) - np.cos(3 * half)) / 12
        along = (-1, 1) if axis == 0 else (1, -1)
        laplacian += (4 * np.sin(half) ** 2).reshape(along)
        power += ((2 * np.sin(half) * mean) ** 2).reshape(along)
        squared += (theta**2).reshape(along)
    laplacian[0, 0] = np.inf
    density = power / laplacian**2
    if cutoff is not None:
        sigma = SIGMA_OF_CUTOFF * cutoff / pixel
        density *= (1.0 - np.exp(-0.5 * sigma**2 * squared)) ** 2
    return float(slope_stderr * pixel * np.sqrt(density.sum() / (shape[0] * shape[1])))
