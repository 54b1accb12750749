"""Smooth fields over an image: vignetting and uneven light, as a polynomial of low degree."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from capture.arrays import Float64Array


@cache
def _terms(degree: int) -> tuple[tuple[int, int], ...]:
    """Return exponent pairs (row, column) of all Legendre products up to a total degree."""
    return tuple((i, j) for i in range(degree + 1) for j in range(degree + 1 - i))


def _count(terms: int) -> int:
    degree = round((float(np.sqrt(8 * terms + 1)) - 3) / 2)
    if len(_terms(degree)) != terms:
        raise ValueError(f"coefficients: got {terms}, expected 1, 3, 6, 10, 15, 21, ...")
    return degree


def _basis(
    rows: Float64Array, columns: Float64Array, shape: tuple[int, int], degree: int
) -> tuple[Float64Array, Float64Array]:
    """Return Legendre polynomials of coordinates scaled to [-1, 1], each (n, degree + 1)."""
    v = 2.0 * rows / max(shape[0] - 1, 1) - 1.0
    u = 2.0 * columns / max(shape[1] - 1, 1) - 1.0
    legendre = np.polynomial.legendre.legvander
    p, q = legendre(v, degree), legendre(u, degree)
    return p.astype(np.float64), q.astype(np.float64)


@dataclass(frozen=True, slots=True)
class SmoothField:
    """Smooth field, 1 at the image's center.

    Attributes
    ----------
    coefficients : ndarray of float64, shape (T,)
        Coefficients of products of Legendre polynomials in row and column, each scaled to [-1, 1]
        over the image, total degree up to 4 for T = 15.
    covariance : ndarray of float64, shape (T, T)
        Covariance of the coefficients.
    residual : float
        Root mean square residual of the polynomial, relative.
    level : float
        Value of the samples at the image's center, in their unit.
    """

    coefficients: Float64Array
    covariance: Float64Array
    residual: float
    level: float = 1.0

    @property
    def stderr(self) -> Float64Array:
        """Standard errors of the coefficients, shape (T,)."""
        return np.sqrt(np.diag(self.covariance)).astype(np.float64)

    def evaluate_stderr(self, height: int, width: int) -> Float64Array:
        """Return the standard error of the field on every pixel of an image, shape (H, W)."""
        scales, vectors = np.linalg.eigh(self.covariance)
        total = np.zeros((height, width))
        for scale, vector in zip(np.maximum(scales, 0.0), vectors.T, strict=True):
            total += scale * SmoothField(vector, self.covariance, 0.0).evaluate(height, width) ** 2
        return np.sqrt(total)

    def evaluate(self, height: int, width: int) -> Float64Array:
        """Return the field on every pixel of an image, shape (H, W)."""
        degree = _count(self.coefficients.size)
        rows, columns = np.arange(height, dtype=np.float64), np.arange(width, dtype=np.float64)
        p, q = _basis(rows, columns, (height, width), degree)
        grid = np.zeros((degree + 1, degree + 1))
        for (i, j), c in zip(_terms(degree), self.coefficients, strict=True):
            grid[i, j] = c
        return p @ grid @ q.T


def fit_smooth_field(
    values: Float64Array,
    rows: Float64Array,
    columns: Float64Array,
    *,
    shape: tuple[int, int],
    degree: int = 4,
    weight: Float64Array | None = None,
) -> SmoothField:
    """Fit a polynomial field to scattered samples and scale it to 1 at the image's center.

    Parameters
    ----------
    values, rows, columns : ndarray of float64, shape (N,)
        Samples, in any unit, and their positions, in pixels of the image.
    shape : (int, int)
        Height and width of the image.
    degree : int
        Total degree.
    weight : ndarray of float64, shape (N,), optional
        Relative weights.

    Returns
    -------
    SmoothField

    Raises
    ------
    ValueError
        If there are fewer samples than coefficients or the center comes out dark.

    Examples
    --------
    >>> r, c = (g.ravel().astype(float) for g in np.mgrid[:20:2, :30:2])
    >>> field = fit_smooth_field(5.0 + 0.1 * c, r, c, shape=(20, 30))
    >>> round(float(field.evaluate(20, 30)[0, 0] * (5.0 + 0.1 * 14.5)), 6)
    5.0
    """
    terms = _terms(degree)
    if values.size <= len(terms):
        raise ValueError(
            f"smooth field: got {values.size} samples for {len(terms)} coefficients; use a lower"
            " degree or smaller blocks"
        )
    p, q = _basis(rows, columns, shape, degree)
    design = np.stack([p[:, i] * q[:, j] for i, j in terms], axis=1)
    root = np.ones(values.size) if weight is None else np.sqrt(weight / weight.mean())
    coefficients, _, rank, _ = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)
    if rank < len(terms):
        raise ValueError(
            f"smooth field: the samples lie on too few rows or columns for degree {degree}; use a"
            " lower degree or smaller blocks"
        )
    p0, q0 = _basis(
        np.zeros(1) + (shape[0] - 1) / 2, np.zeros(1) + (shape[1] - 1) / 2, shape, degree
    )
    center = float(np.array([p0[0, i] * q0[0, j] for i, j in terms]) @ coefficients)
    if not center > 0:
        raise ValueError(f"smooth field: {center:.3g} at the image's center, expected > 0")
    misfit = (values - design @ coefficients) * root
    variance = float(misfit @ misfit) / (values.size - len(terms))
    covariance = np.linalg.inv((design * root[:, None]).T @ (design * root[:, None])) * variance
    return SmoothField(
        (coefficients / center).astype(np.float64),
        (covariance / center**2).astype(np.float64),
        float(np.sqrt(variance)) / center,
        center,
    )


def pixel_response(first: Float64Array, second: Float64Array, *, block: int) -> tuple[float, float]:
    """Return the relative pixel-to-pixel standard deviation of sensitivity and its standard error.

    The covariance of two independent averages of flats, after a quadratic surface is subtracted
    from each block: temporal noise is independent in the two and cancels, and the surface removes
    the smooth shading.

    Parameters
    ----------
    first, second : ndarray of float64, shape (h, w)
        Signals above black of one CFA position; NaN marks unused pixels.
    block : int
        Block side, > 2.

    Returns
    -------
    spread, stderr : float
        Dimensionless.
    """
    rows, columns = first.shape[0] // block, first.shape[1] // block
    v, u = (g.ravel() / block for g in np.mgrid[:block, :block])
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    orthonormal, _ = np.linalg.qr(design)
    residuals = []
    for image in (first, second):
        tiles = (
            image[: rows * block, : columns * block]
            .reshape(rows, block, columns, block)
            .swapaxes(1, 2)
            .reshape(-1, block * block)
        )
        bad = np.logical_not(np.isfinite(tiles))
        mean = np.nanmean(
            np.where(bad.all(axis=1, keepdims=True), 0.0, tiles), axis=1, keepdims=True
        )
        tiles = np.where(bad, mean, tiles) / np.where(mean > 0, mean, np.inf) - 1.0
        tiles -= (tiles @ orthonormal) @ orthonormal.T
        residuals.append(np.where(bad, 0.0, tiles))
    a, b = residuals
    count = float(np.count_nonzero(a)) * (1.0 - design.shape[1] / block**2)
    if count < 10:
        raise ValueError(f"pixel response: got {count:.0f} usable pixels, expected more than 10")
    covariance = float((a * b).sum()) / count
    spread_a, spread_b = float((a * a).sum()) / count, float((b * b).sum()) / count
    error = float(np.sqrt((spread_a * spread_b + covariance**2) / count))
    if covariance <= 0:
        return 0.0, float(np.sqrt(error))
    spread = float(np.sqrt(covariance))
    return spread, min(error / (2.0 * spread), float(np.sqrt(error)))
