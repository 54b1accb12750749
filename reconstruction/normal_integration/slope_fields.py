"""Slopes of a surface from its normals, with their variances, and differences between pixels.

A normal n seen along the ray with direction -w gives the slopes -n_x / (n . w) and -n_y / (n . w),
in pixels of height a pixel; w = (0, 0, 1) for parallel rays. Under perspective the same slopes
are those of -f log(depth), with f in pixels (Quéau, Durou and Aujol 2018,
doi 10.1007/s10851-017-0773-x, section 2).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.normal_integration.weighted_poisson import IntegrationError
from reconstruction.normal_maps import NormalMaps

MIN_RAY_COSINE = 0.02
"""Least cosine between normal and ray of a pixel that is used: 88.9 degrees."""
MAX_STDERR_RATIO = 1e3
"""Standard errors count as at most so many times, and at least one over that of, their median."""
_MAX_VARIANCE_RATIO = 10.0
"""Variance over that of an edge's own pixels from which pixels beyond them are not asked."""


@dataclass(frozen=True, slots=True)
class Perspective:
    """A pinhole camera that looks along -z, rows of pixels along x.

    Attributes
    ----------
    focal_px : float
        Distance of the sensor over the size of its pixels, > 0.
    center_px : tuple of float
        (column, row) of the principal point; the middle of pixel (0, 0) is (0, 0).
    """

    focal_px: float
    center_px: tuple[float, float]

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        Checks(IntegrationError).settings(self, focal_px="(0, inf)")
        Checks(IntegrationError).numbers("Perspective.center_px", self.center_px, (2,))


@dataclass(frozen=True, slots=True)
class SlopeField:
    """Slopes at pixels; where `valid` is False they are 0.

    Attributes
    ----------
    gx, gy : ndarray, shape (H, W), float64
        Change of height, in pixels, to the next column and to the next row (downwards).
    variance_x, variance_y : ndarray, shape (H, W) or (1, 1), float32
        Of the slopes, relative to one another where `scale` is 0; (1, 1): all the same.
    facing : ndarray, shape (H, W), float32
        Cosine between normal and ray, as far as the ray is the view's axis: n . w.
    valid : ndarray of bool, shape (H, W)
    scale : float
        Variance of angles that variances are to be multiplied by, rad^2; 0 where none is known.
    """

    gx: Float64Array
    gy: Float64Array
    variance_x: Float32Array
    variance_y: Float32Array
    facing: Float32Array
    valid: BoolArray
    scale: float


@njit(cache=True, parallel=True, error_model="numpy")
def _slopes(n, relative, cx, cy, per_focal, up, gx, gy, vx, vy, facing, valid):  # type: ignore[no-untyped-def]
    """Write slopes and variances of the pixels that are valid, and drop those that have none.

    ``relative``: variance of angles, (H, W) or (1, 1), read where vx is (H, W).
    """
    rows, columns = gx.shape
    weighted = vx.shape[0] == rows and vx.shape[1] == columns
    mapped = relative.size > 1
    for i in prange(rows):
        for j in range(columns):
            good = valid[i, j]
            x = np.float64(n[i, j, 0])
            y = up * np.float64(n[i, j, 1])
            z = np.float64(n[i, j, 2])
            wx, wy = (cx - j) * per_focal, (i - cy) * per_focal
            length2 = x * x + y * y + z * z
            m = z + x * wx + y * wy
            w2 = 1.0 + wx * wx + wy * wy
            good = good and length2 > 0.0 and length2 < np.inf
            good = good and m > 0.0 and m * m > MIN_RAY_COSINE * MIN_RAY_COSINE * length2 * w2
            valid[i, j] = good
            if not good:
                gx[i, j], gy[i, j], facing[i, j] = 0.0, 0.0, 0.0
                if weighted:
                    vx[i, j], vy[i, j] = 1.0, 1.0
                continue
            gx[i, j], gy[i, j] = -x / m, y / m
            facing[i, j] = m / np.sqrt(length2)
            if weighted:
                given = relative[i, j] if mapped else relative[0, 0]
                a = 0.5 * given * length2 / (m * m * m * m)
                vx[i, j] = a * (m * m - 2.0 * m * x * wx + x * x * w2)
                vy[i, j] = a * (m * m - 2.0 * m * y * wy + y * y * w2)


def from_normals(
    normals: FloatArray | NormalMaps,
    *,
    valid: BoolArray | None = None,
    stderr_rad: ArrayLike | None = None,
    y_up: bool = True,
    camera: Perspective | None = None,
) -> SlopeField:
    """Return the slopes of normals, see `normal_integration.integrate` for the parameters.

    Raises
    ------
    IntegrationError
        For shapes that do not fit, negative standard errors, or no usable pixel at all.
    """
    if isinstance(normals, NormalMaps):
        n = np.asarray(normals.normals)
        if n.shape[:-1] == np.shape(normals.valid):
            valid = normals.valid if valid is None else valid & normals.valid
        if stderr_rad is None:
            stderr_rad = normals.stderr_rad
    else:
        n = np.asarray(normals)
    Checks(IntegrationError).shape("normals", n, ("H", "W", 3))
    if n.dtype not in (np.float32, np.float64):
        n = n.astype(np.float64)
    shape = n.shape[:2]
    Checks(IntegrationError).shape("valid", valid, shape)
    good = np.ones(shape, bool) if valid is None else np.array(valid, bool)
    relative, scale = _relative_variance(stderr_rad, good)
    small = (1, 1) if relative is None else shape
    gx, gy = np.empty(shape), np.empty(shape)
    facing = np.empty(shape, np.float32)
    vx, vy = np.ones(small, np.float32), np.ones(small, np.float32)
    cx, cy = camera.center_px if camera else (0.0, 0.0)
    _slopes(
        n,
        np.ones((1, 1), np.float32) if relative is None else relative,
        float(cx),
        float(cy),
        1.0 / camera.focal_px if camera else 0.0,
        1.0 if y_up else -1.0,
        gx,
        gy,
        vx,
        vy,
        facing,
        good,
    )
    if not good.any():
        raise IntegrationError(
            f"valid: got no pixel with a normal that faces the camera among {shape[0]} x {shape[1]}"
        )
    return SlopeField(gx, gy, vx, vy, facing, good, scale)


def _relative_variance(
    stderr_rad: ArrayLike | None, good: BoolArray
) -> tuple[Float32Array | None, float]:
    """Return the variance of angles over their median, within bounds, and that median."""
    if stderr_rad is None:
        return None, 0.0
    sigma = np.asarray(stderr_rad, np.float64)
    Checks(IntegrationError).shape("stderr_rad", sigma, (), good.shape)
    some = sigma[good] if sigma.ndim else sigma.reshape(1)
    Checks(IntegrationError).within("stderr_rad at valid pixels", some, "[0, inf]")
    positive = some[(some > 0.0) & (some < np.inf)]
    if positive.size == 0:  # nothing told apart
        return None, 0.0
    middle = float(np.median(positive))
    if sigma.ndim == 0:
        return np.ones((1, 1), np.float32), middle**2
    with np.errstate(invalid="ignore"):
        within = np.clip(sigma / middle, 1.0 / MAX_STDERR_RATIO, MAX_STDERR_RATIO)
    return (within * within).astype(np.float32), middle**2


@njit(cache=True, inline="always")
def _difference(before, a, b, after, has_before, has_after):  # type: ignore[no-untyped-def]
    """Return the integral of slope from a to b, by the polynomial through the pixels there are."""
    if has_before and has_after:
        return (13.0 * (a + b) - (before + after)) / 24.0
    if has_before:
        return (5.0 * b + 8.0 * a - before) / 12.0
    if has_after:
        return (5.0 * a + 8.0 * b - after) / 12.0
    return 0.5 * (a + b)


@njit(cache=True, inline="always")
def _edge(g, v, valid, i, j, down, right, smooth, weighted, a, d):  # type: ignore[no-untyped-def]
    """Write weight and difference of the edge from a pixel to the next along one axis."""
    rows, columns = g.shape
    y, x = i + down, j + right
    if not (y < rows and x < columns and valid[y, x]):
        return
    both = v[i, j] + v[y, x] if weighted else np.float32(2.0)
    before = smooth and i >= down and j >= right and valid[i - down, j - right]
    after = smooth and y + down < rows and x + right < columns and valid[y + down, x + right]
    if weighted:
        before = before and v[i - down, j - right] < _MAX_VARIANCE_RATIO * both
        after = after and v[y + down, x + right] < _MAX_VARIANCE_RATIO * both
    a[i + 1, j + 1] = np.float32(2.0) / both
    d[i + 1, j + 1] = _difference(
        g[i - down, j - right] if before else 0.0,
        g[i, j],
        g[y, x],
        g[y + down, x + right] if after else 0.0,
        before,
        after,
    )


@njit(cache=True, parallel=True, error_model="numpy")
def _edges(gx, gy, vx, vy, valid, smooth, ax, ay, dx, dy):  # type: ignore[no-untyped-def]
    """Write weights and differences of the edges; the arrays have an empty border of one."""
    rows, columns = gx.shape
    weighted = vx.shape[0] == rows and vx.shape[1] == columns
    for i in prange(rows):
        for j in range(columns):
            if valid[i, j]:
                _edge(gx, vx, valid, i, j, 0, 1, smooth, weighted, ax, dx)
                _edge(gy, vy, valid, i, j, 1, 0, smooth, weighted, ay, dy)


def edges(
    field: SlopeField, *, order: int = 4
) -> tuple[Float32Array, Float32Array, Float64Array, Float64Array]:
    """Return weights and wanted differences of the edges between pixels.

    Parameters
    ----------
    field : SlopeField
    order : int
        4: by the cubic through four pixels in a row (three or two at borders); what is left of a
        wave of theta radians a pixel is 1 - 11 theta^4 / 720. 2: the mean of two pixels, which
        leaves 1 - theta^2 / 12.

    Returns
    -------
    tuple of ndarray, shape (H + 2, W + 2)
        (ax, ay) float32, (dx, dy) float64, as `weighted_poisson.solve` takes them.
    """
    shape = (field.gx.shape[0] + 2, field.gx.shape[1] + 2)
    ax, ay = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    dx, dy = np.zeros(shape), np.zeros(shape)
    _edges(
        field.gx,
        field.gy,
        field.variance_x,
        field.variance_y,
        field.valid,
        order == 4,
        ax,
        ay,
        dx,
        dy,
    )
    return ax, ay, dx, dy
