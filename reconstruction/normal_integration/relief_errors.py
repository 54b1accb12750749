"""Estimate errors of integrated heights: of slopes with white noise, and of unmodeled effects.

Interreflection in grooves, occlusion between facets and averaging by the lens are not modeled by
the estimator. On simulated patches of forehead, cheek and chin (seeds 0 to 5, at rest, with the
sensor's noise) the errors of normals beyond noise are about the same fraction of the relief on
each. Errors of heights grow with the slopes, and near holes. On judged patches of forehead and
cheek, 68 % intervals of heights cover 57 to 73 % (docs/validation/gradient-rig.md). Heights of the
chin were not judged.
"""

from typing import Final

import numpy as np
from scipy.ndimage import distance_transform_edt

from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.normal_integration.height_filters import SIGMA_PER_CUTOFF

HEIGHT_ERROR_UM: Final = 0.42
"""Error of the height of a flat relief, um, set with the gradient rig's pixels of 6 um alone. The
same error is assumed for other pixels, as are the other constants of heights; none was judged."""
HEIGHT_ERROR_PER_SLOPE_UM: Final = 7.5
"""Error of a height over the variance of one slope, um: steep walls shadow and light each other."""
HOLE_HEIGHT_ERROR: Final = 0.19
"""Error of a height at a pixel without a normal, over the standard deviation of the relief."""
HOLE_REACH_UM: Final = 84.0
"""Distance from such a pixel at which this error is 1/e of that, um."""
MAX_SLOPE_VARIANCE: Final = 1.0
"""Larger variances count as this: such walls are hidden, not measured."""
RELATIVE_SLOPE_ERROR: Final = 0.08
"""Error of a normal, rad in one direction, over the standard deviation of slopes."""
DIFFUSE_SCALE_MM: Final = 0.15
"""Standard deviation of the Gaussian that smooths the surface whose normals diffuse normals are."""
RELATIVE_DIFFUSE_ERROR: Final = 0.63
"""Error of a diffuse normal, rad in one direction, over the standard deviation of such normals.
Set with `DIFFUSE_SCALE_MM` on grooves of six voxel patches (docs/validation/voxel-skin.md)."""


def height_stderr(
    height: FloatArray, stderr: Float32Array, valid: BoolArray, *, pixel_um: float
) -> Float32Array:
    """Return standard errors of a relief's heights, of noise and unmodeled effects together.

    Parameters
    ----------
    height
        (H, W), um, finite where valid; without form longer than the relief.
    stderr
        (H, W), of noise alone, um.
    valid
        (H, W); near pixels that are not valid, in grooves that no light or view reaches, errors are
        larger.
    pixel_um
        Side of a pixel, um.

    Returns
    -------
    ndarray of float32, shape (H, W)
        At least `stderr`; the same where not valid.

    Notes
    -----
    Set on 15 strain steps of three patches (forehead, seeds 0 and 31, cheek, seed 32), so that 68 %
    intervals cover 60 to 76 % of each; other patches judge it (docs/validation/gradient-rig.md).

    Examples
    --------
    >>> known = np.ones((1, 2), bool)
    >>> flat = np.zeros((1, 2), np.float32)
    >>> height_stderr(flat, flat, known, pixel_um=6.0).astype(float).round(3).tolist()
    [[0.42, 0.42]]
    """
    if not valid.any():
        return stderr
    known = np.where(valid, height, np.nan).astype(np.float64)
    steps = [np.diff(known, axis=axis).ravel() / pixel_um for axis in (0, 1)]
    variances = [np.var(step[np.isfinite(step)]) for step in steps if np.isfinite(step).any()]
    slope_variance = min(float(np.mean(variances)) if variances else 0.0, MAX_SLOPE_VARIANCE)
    model = np.full(valid.shape, HEIGHT_ERROR_UM + HEIGHT_ERROR_PER_SLOPE_UM * slope_variance)
    if not valid.all():
        away_um = pixel_um * distance_transform_edt(valid)
        rms = float(np.std(height[valid], dtype=np.float64))
        model += HOLE_HEIGHT_ERROR * rms * np.exp(-away_um / HOLE_REACH_UM)
    return np.where(valid, np.hypot(stderr, model.astype(np.float32)), stderr)


def normal_stderr(normals: FloatArray, stderr: Float32Array, valid: BoolArray) -> Float32Array:
    """Return standard errors of a relief's normals, of noise and unmodeled effects together.

    Parameters
    ----------
    normals
        (H, W, 3), unit vectors where valid, z towards the camera.
    stderr
        (H, W), rad in each of two directions, of noise alone.
    valid
        (H, W).

    Returns
    -------
    ndarray of float32, shape (H, W)
        At least `stderr`; the same where not valid.
    """
    if not valid.any():
        return stderr
    model = RELATIVE_SLOPE_ERROR * float(np.sqrt(_slope_variance(normals, valid)))
    return np.where(valid, np.hypot(stderr, np.float32(model)), stderr)


def diffuse_normal_stderr(
    normals: FloatArray, stderr: Float32Array, valid: BoolArray
) -> Float32Array:
    """Return standard errors of diffuse normals, of noise and of a relief's grooves together.

    Grooves scatter light sideways, and shadow it, by other amounts than a smoothed surface does.
    Parameters and result are those of `normal_stderr`. Noise of `stderr` does not count as relief.

    Examples
    --------
    >>> normals = np.array([[[0.1, 0.0, 1.0], [-0.1, 0.0, 1.0]]])
    >>> known = np.ones((1, 2), bool)
    >>> even = diffuse_normal_stderr(normals, np.zeros((1, 2), np.float32), known)
    >>> noisy = diffuse_normal_stderr(normals, np.full((1, 2), 0.08, np.float32), known)
    >>> even.astype(float).round(4).tolist(), noisy.astype(float).round(4).tolist()
    ([[0.0445, 0.0445]], [[0.08, 0.08]])
    """
    if not valid.any():
        return stderr
    noise = float(np.square(stderr[valid], dtype=np.float64).mean())
    relief = max(_slope_variance(normals, valid) - noise, 0.0)
    model = RELATIVE_DIFFUSE_ERROR * float(np.sqrt(relief))
    return np.where(valid, np.hypot(stderr, np.float32(model)), stderr)


def _slope_variance(normals: FloatArray, valid: BoolArray) -> float:
    """Return the variance of normals in one direction, mean of both, rad^2."""
    across: Float64Array = np.var(normals[valid][:, :2], axis=0, dtype=np.float64)
    return float(across.mean())


def expected_height_rms(
    shape: tuple[int, int], slope_stderr: float, *, pixel: float = 1.0, cutoff: float | None = None
) -> float:
    """Return the height's RMS error over a rectangle whose slopes have white noise.

    White noise of slopes becomes noise of heights whose spectrum falls with the square of
    frequency: most of it is long waves, which `height_filters.high_pass` removes.

    Parameters
    ----------
    shape : tuple of int
        (H, W) of the rectangle; all pixels valid, of equal weights.
    slope_stderr : float
        Standard deviation of each slope, dimensionless.
    pixel : float
    cutoff : float, optional
        Cutoff of `high_pass`, same unit as `pixel`.

    Returns
    -------
    float
        In the unit of `pixel`; borders are mirrored.

    Examples
    --------
    Noise of 1.5 degrees of tilt on 2048 x 2048 pixels of 6 um, without wavelengths above 1 mm:

    >>> round(expected_height_rms((2048, 2048), 0.026, pixel=6.0, cutoff=1000.0), 2)
    0.12
    """
    # least squares in the cosine basis: height = D' A slope / (D' D), where A averages slopes over
    # an edge (edges' quadrature of order 4) and D' D is the Laplacian
    waves = [np.pi * np.arange(n) / n for n in shape]
    laplacian, power = np.zeros(shape), np.zeros(shape)
    squared = np.zeros(shape)
    for axis, theta in enumerate(waves):
        half = 0.5 * theta
        mean = (13 * np.cos(half) - np.cos(3 * half)) / 12
        along = (-1, 1) if axis == 0 else (1, -1)
        laplacian += (4 * np.sin(half) ** 2).reshape(along)
        power += ((2 * np.sin(half) * mean) ** 2).reshape(along)
        squared += (theta**2).reshape(along)
    laplacian[0, 0] = np.inf
    density = power / laplacian**2
    if cutoff is not None:
        sigma = SIGMA_PER_CUTOFF * cutoff / pixel
        density *= (1.0 - np.exp(-0.5 * sigma**2 * squared)) ** 2
    return float(slope_stderr * pixel * np.sqrt(density.sum() / (shape[0] * shape[1])))
