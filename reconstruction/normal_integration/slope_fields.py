"""Compute slopes from normals, their variances, and differences between pixels.

A normal n observed along the ray with direction -w gives the slopes -n_x / (n . w) and
-n_y / (n . w), in pixels of height per pixel; w = (0, 0, 1) for parallel rays. With perspective the
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

MIN_RAY_COSINE = 0.002
"""Default of the least cosine between normal and ray of a usable pixel: 89.9 degrees.

Steps of depth lie in the few pixels that are more grazing. Chosen on nine objects with and without
noise, docs/validation/real-sets.md."""
MAX_STDERR_RATIO = 1e3
"""Standard errors are clipped to their median times this and over this."""
_MAX_VARIANCE_RATIO = 10.0
"""Variance over that of an edge's own pixels above which pixels beyond it are not used."""


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
        """Refuse a focal length or principal point out of range."""
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
        Of the slopes, relative where `scale` is 0; (1, 1): all equal.
    facing : ndarray, shape (H, W), float32
        n . w: cosine between normal and ray where the ray is the view's axis.
    valid : ndarray of bool, shape (H, W)
    scale : float
        Factor of the variances: variance of angles, rad^2; 0 where unknown.
    """

    gx: Float64Array
    gy: Float64Array
    variance_x: Float32Array
    variance_y: Float32Array
    facing: Float32Array
    valid: BoolArray
    scale: float


@njit(cache=True, parallel=True, error_model="numpy")
def _slopes(n, relative, cx, cy, per_focal, up, least, gx, gy, vx, vy, facing, valid):  # type: ignore[no-untyped-def]
    """Write slopes and variances of valid pixels; make those without a slope invalid.

    ``least``: least cosine between normal and ray.
    ``relative``: variance of angles, (H, W) or (1, 1), read where vx is (H, W). A turn of n by an
    angle of variance s^2 in a random direction changes g = -n_x / m, m = n . w, by a vector with
    variance s^2 |n|^2 |m e_x - n_x w|^2 / (2 m^4).
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
            good = good and m > 0.0 and m * m > least * least * length2 * w2
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
    min_ray_cosine: float = MIN_RAY_COSINE,
) -> SlopeField:
    """Compute slopes of normals; see `normal_integration.integrate` for the parameters.

    `min_ray_cosine` is that of the settings of an integration.

    Raises
    ------
    IntegrationError
        For shapes that do not fit, negative standard errors, or no usable pixel.
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
        float(min_ray_cosine),
        gx,
        gy,
        vx,
        vy,
        facing,
        good,
    )
    if not good.any():
        raise IntegrationError(
            f"valid: got no pixel with a normal that faces the camera among {shape[0]} x "
            f"{shape[1]}, expected some; check the mask and y_up"
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
    if positive.size == 0:  # equal weights
        return None, 0.0
    middle = float(np.median(positive))
    if sigma.ndim == 0:
        return np.ones((1, 1), np.float32), middle**2
    with np.errstate(invalid="ignore"):
        within = np.clip(sigma / middle, 1.0 / MAX_STDERR_RATIO, MAX_STDERR_RATIO)
    return (within * within).astype(np.float32), middle**2


@njit(cache=True, inline="always")
def _difference(before, a, b, after, has_before, has_after):  # type: ignore[no-untyped-def]
    """Return the integral of slope from a to b, by the polynomial through the valid pixels.

    Cubic through four: (-1, 13, 13, -1) / 24; parabola through three: (-1, 8, 5) / 12.
    """
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
    """Return weights and target differences of the edges between pixels.

    Parameters
    ----------
    field : SlopeField
    order : int
        4: by the cubic through four pixels in a row (three or two at borders); a wave of theta
        radians per pixel keeps the fraction 1 - 11 theta^4 / 720. 2: by the mean of two pixels,
        which keeps 1 - theta^2 / 12.

    Returns
    -------
    tuple of ndarray, shape (H + 2, W + 2)
        (ax, ay) float32, (dx, dy) float64, for `weighted_poisson.solve_poisson`.
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
