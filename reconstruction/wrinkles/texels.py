"""Fit the texels of wrinkle maps, read bilinearly, to full-resolution derivatives.

A wrinkle map is interpolated bilinearly and multiplied by each expression's strength. Its texels
solve the normal equations of that interpolation, a matrix of nine neighbors. With complete data and
strengths of 1 the result is the least-squares low-pass of the map at its resolution.
"""

import logging
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import cg

from model import texture_resampling as resampling
from model import wrinkles
from model.checks import Checks
from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome
from model.wrinkles import WrinkleError
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.normal_maps import NormalMaps

_log = logging.getLogger(__name__)

MAX_DERIVATIVE = 4.0
"""Derivatives beyond this, slopes of 76 degrees, are measured in too oblique views to be used."""
MIN_COVERAGE = 0.1
"""Minimum measured fraction of a texel's weight."""
MIN_STRENGTH = 1e-3
"""Sum of squared strengths, relative to the largest, below which a texel is not determined."""
SOLVER_TOL = 1e-12
MAX_CG_STEPS = 500
RELATIVE_DAMPING = 1e-10
MIN_DIAGONAL = 1e-9
"""Diagonal of the normal matrix, relative to the largest, below which a texel stays at 0."""


@dataclass(frozen=True, slots=True)
class Derivatives:
    """Measured partial derivatives of the face in one expression.

    Attributes
    ----------
    values : ndarray, shape (H, W, 2), float32
        n_x/n_z and n_y/n_z; 0 where not valid.
    variance : ndarray, shape (H, W, 2), float32
        Variance of `values`; 0 everywhere without errors.
    valid : ndarray of bool, shape (H, W)
    too_steep_fraction : float
        Fraction of the pixels with valid normals.
    """

    values: Float32Array
    variance: Float32Array
    valid: BoolArray
    too_steep_fraction: float


def measure_derivatives(
    normals: ArrayLike | NormalMaps | Derivatives,
    *,
    stderr_rad: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> Derivatives:
    """Compute derivatives of measured normals with their variance.

    Parameters
    ----------
    normals : array_like (H, W, 3), or NormalMaps
        Tangent-space normals, +X right, +Y up; NormalMaps contain errors and mask.
    stderr_rad : array_like, shape (H, W), optional
        Root mean square angle to the truth, rad, as `NormalMaps.stderr_rad`; half its square
        is the variance along each direction.
    valid : array_like of bool, shape (H, W), optional

    Returns
    -------
    Derivatives
    """
    if isinstance(normals, Derivatives):
        return normals
    if isinstance(normals, NormalMaps):
        stderr_rad = normals.stderr_rad if stderr_rad is None else stderr_rad
        mask = np.asarray(normals.valid)
        valid = mask if valid is None else mask & np.asarray(valid, bool)
        normals = normals.normals
    n = np.asarray(normals, np.float64)
    Checks(WrinkleError).shape("normals", n, ("H", "W", 3))
    report = wrinkles.encode_with_report(n, limit=None)
    good = report.valid.copy()
    shape = n.shape[:2]
    Checks(WrinkleError).shape("valid", valid, shape)
    Checks(WrinkleError).shape("stderr_rad", stderr_rad, shape)
    if valid is not None:
        good &= np.asarray(valid, bool)
    steep = good & (np.abs(report.derivatives) > MAX_DERIVATIVE).any(axis=2)
    count = int(np.count_nonzero(good))
    share = float(np.count_nonzero(steep)) / count if count else 0.0
    good &= ~steep
    variance = np.zeros(report.derivatives.shape, np.float32)
    if stderr_rad is not None:
        s = np.asarray(stderr_rad, np.float64)
        good &= np.isfinite(s) & (s >= 0)
        # the gradient of n_x/n_z on the sphere has squared length (1 + d_x^2)(1 + |d|^2), and each
        # tangential direction has half of the squared angle error
        d2 = report.derivatives**2
        scale = 0.5 * (1.0 + d2) * (1.0 + d2.sum(axis=2, keepdims=True))
        variance[good] = (s[good] ** 2)[:, None] * scale[good]
    values = np.where(good[..., None], report.derivatives, 0.0).astype(np.float32)
    return Derivatives(values, variance, good, share)


@dataclass(frozen=True, slots=True)
class Texels:
    """Texels fitted to derivatives.

    Attributes
    ----------
    values : ndarray, shape (h, w, 2)
        0 where not valid.
    stderr : ndarray, shape (h, w, 2)
        From the variances of the derivatives, assumed independent between pixels and uniform over
        a texel; infinite where not valid, 0 when no variance was given.
    valid : ndarray of bool, shape (h, w)
        Enough of the texel's weight was measured, by expressions with its wrinkles.
    """

    values: Float64Array
    stderr: Float64Array
    valid: BoolArray


def fit_texels(
    weight: FloatArray,
    product: FloatArray,
    noise: FloatArray,
    covered: FloatArray,
    shape: tuple[int, int],
    *,
    tolerance: float = SOLVER_TOL,
) -> Texels:
    """Return texels t that minimize sum_x weight (B t)^2 - 2 product B t; B is bilinear reading.

    Parameters
    ----------
    weight : ndarray, shape (H, W)
        Sum over expressions of the squared strength (times a pixel's weight).
    product : ndarray, shape (H, W, C)
        Sum over expressions of strength times value (times the same weight).
    noise : ndarray, shape (H, W, C)
        Variance of `product`.
    covered : ndarray, shape (H, W)
        Measured fraction of the pixel, 0 or 1.
    shape : (int, int)
        Rows and columns of texels, at most those of the pixels.
    tolerance : float
        Relative error at which conjugate gradients stop.
    """
    height, width = weight.shape
    if shape[0] > height or shape[1] > width or min(shape) < 1:
        hint = "choose another size"
        raise WrinkleError(f"size: got {shape}, expected 1 to {(height, width)} texels; {hint}")
    by, bx = (resampling.reading_matrix(t, p) for t, p in zip(shape, (height, width), strict=True))
    A = normal_matrix(by, bx, np.asarray(weight, np.float64), shape)
    summed = gather_texels(by, bx, weight)
    full = gather_texels(by, bx, np.ones((1, 1)))
    coverage = gather_texels(by, bx, covered) / full
    relative = summed / (full * max(float(np.max(weight, initial=0.0)), 1e-300))
    valid = (coverage >= MIN_COVERAGE) & (relative >= MIN_STRENGTH)
    channels = product.shape[2]
    values = np.zeros((*shape, channels))
    stderr = np.full((*shape, channels), np.inf)
    if not valid.any():
        return Texels(values, stderr, valid)
    diagonal = A.diagonal()
    some = np.flatnonzero(diagonal > MIN_DIAGONAL * diagonal.max())
    root = 1.0 / np.sqrt(diagonal[some])
    scaling = sparse.diags_array(root)
    matrix = scaling @ A[some][:, some] @ scaling
    matrix = (matrix + RELATIVE_DAMPING * sparse.eye_array(some.size)).tocsr()
    spread = _inverse_diagonal(by) * _inverse_diagonal(bx)
    size = float(np.abs(matrix).sum(axis=1).max())
    unfinished = SolverOutcome(0, 0.0, UNKNOWN_CONDITION, "tolerance")
    for c in range(channels):
        b = gather_texels(by, bx, product[..., c]).ravel()[some]
        first = b / summed.ravel()[some] / root
        solved, steps = cg(matrix, root * b, x0=first, rtol=tolerance, maxiter=MAX_CG_STEPS)
        # the backward error, relative to the data and the texels
        scale = float(np.linalg.norm(root * b)) + size * float(np.linalg.norm(solved))
        residual = float(np.linalg.norm(root * b - matrix @ solved)) / max(scale, 1e-300)
        if steps > 0 and residual > max(100.0 * tolerance, unfinished.residual):
            unfinished = SolverOutcome(steps, residual, UNKNOWN_CONDITION, "limit")
        plane = np.zeros(summed.size)
        plane[some] = root * solved
        values[..., c] = np.where(valid, plane.reshape(shape), 0.0)
        scatter = gather_texels(by, bx, noise[..., c])
        variance = np.divide(scatter, summed**2, out=np.zeros_like(scatter), where=valid)
        stderr[..., c] = np.where(valid, np.sqrt(spread * variance), np.inf)
    unfinished.warn_unless_converged("texels of a map", _log)
    return Texels(values, stderr, valid)


def gather_texels(by: Any, bx: Any, image: FloatArray) -> Float64Array:
    """Return B^T image: the sum of an image over each texel's bilinear weights.

    Parameters
    ----------
    by, bx : sparse (H, h) and (W, w)
        Matrices of `texture_resampling.reading_matrix`.
    image : ndarray, shape (H, W)

    Returns
    -------
    ndarray, shape (h, w), float64
    """
    whole = np.broadcast_to(np.asarray(image, np.float64), (by.shape[0], bx.shape[0]))
    return np.asarray((by.T @ whole) @ bx)


def normal_matrix(by: Any, bx: Any, weight: Float64Array, shape: tuple[int, int]) -> Any:
    """Return the sparse (h w, h w) matrix B^T diag(weight) B: texels overlap neighbors only."""
    h, w = shape
    total = sparse.csr_array((h * w, h * w))
    index = np.arange(h * w).reshape(h, w)
    for dy in (0, 1):
        rows = _overlap(by, dy)
        if rows.shape[1] == 0:
            continue
        partly = rows.T @ weight
        for dx in (0, 1) if dy == 0 else (-1, 0, 1):
            columns = _overlap(bx, abs(dx))
            if columns.shape[1] == 0:
                continue
            values = np.asarray(partly @ columns)
            here = index[: h - dy, : w - abs(dx)]
            there = index[dy:, abs(dx) :]
            if dx < 0:
                here, there = index[: h - dy, -dx:], index[dy:, : w + dx]
            one = sparse.csr_array(
                (values.ravel(), (here.ravel(), there.ravel())), shape=(h * w, h * w)
            )
            total = total + (one if (dy, dx) == (0, 0) else one + one.T)
    return total.tocsr()


def _overlap(b: Any, step: int) -> Any:
    """Return products of each texel's weights with those of the texel `step` further on."""
    c = b.tocsc()
    return c.multiply(c) if step == 0 else c[:, :-1].multiply(c[:, 1:])


def _inverse_diagonal(b: Any) -> float:
    """Return a texel's variance over that of the mean of its weights, away from borders.

    B^T B is tridiagonal with a on its diagonal and b next to it. The inverse of the infinite matrix
    has (1 / 2 pi) integral dk / (a + 2 b cos k) = 1 / sqrt(a^2 - 4 b^2) on its diagonal.
    """
    middle = slice(b.shape[1] // 4, max(3 * b.shape[1] // 4, 1))
    a = float(np.mean(_overlap(b, 0).sum(axis=0)[middle]))
    next_to = float(np.mean(_overlap(b, 1).sum(axis=0))) if b.shape[1] > 1 else 0.0
    summed = float(np.mean(b.sum(axis=0)[middle]))
    return summed / math.sqrt(max(a * a - 4.0 * next_to * next_to, 1e-30))
