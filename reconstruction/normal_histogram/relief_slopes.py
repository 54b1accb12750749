"""Compute slopes of a relief, and of normals, along x to the right and y up.

A normal is ``n = (-dh/dx, -dh/dy, 1) / length``. Slopes are central differences; with only one
neighbor, at a border or a hole, they are one-sided, and a pixel without a
neighbor along an axis has none.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, UInt8Array
from reconstruction.normal_histogram import kernels


class HistogramError(ValueError):
    """Reliefs, normals, fractions or settings that do not give a histogram."""


def slope_stencil(height: ArrayLike, valid: ArrayLike | None = None) -> UInt8Array:
    """Return the neighbors from which each pixel's slopes are computed.

    Parameters
    ----------
    height : array_like, shape (H, W)
        Any unit.
    valid : array_like of bool, shape (H, W), optional
        Heights to use; heights that are not finite are never used.

    Returns
    -------
    ndarray of uint8, shape (H, W)
        Bits 1, 2, 4, 8: the neighbor to the left, right, above (row - 1), below is usable; 0
        where the pixel has no slope: it is not valid, or lacks both neighbors along an axis.

    Raises
    ------
    HistogramError
        For heights that are not a map of real numbers, and a mask of another shape or type.

    Examples
    --------
    >>> slope_stencil([[0.0, 1.0], [2.0, 3.0]])
    array([[10,  9],
           [ 6,  5]], dtype=uint8)
    """
    given = _as_height_map(height)
    good = np.isfinite(given) & _mask(valid, given.shape)
    code = np.zeros(given.shape, np.uint8)
    code[:, 1:] |= good[:, :-1].astype(np.uint8)
    code[:, :-1] |= good[:, 1:].astype(np.uint8) << 1
    code[1:] |= good[:-1].astype(np.uint8) << 2
    code[:-1] |= good[1:].astype(np.uint8) << 3
    code[~(good & ((code & 3) > 0) & ((code & 12) > 0))] = 0
    return code


def _as_height_map(height: ArrayLike) -> FloatArray:
    """Return heights as an array of real numbers (H, W)."""
    try:
        given = np.asarray(height)
    except ValueError as error:  # rows of a list that differ in length
        raise HistogramError(
            f"height: got no array ({error}), expected a map (H, W); give rows of equal length"
        ) from error
    if given.ndim != 2 or given.dtype.kind not in "biuf":
        raise HistogramError(
            f"height: got {given.dtype} of shape {given.shape}, expected real numbers of shape "
            "(H, W); give the maps of a stack one by one"
        )
    return given


def _mask(valid: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    """Return a mask as an array, True everywhere by default."""
    if valid is None:
        return np.ones(shape, bool)
    mask = np.asarray(valid)
    Checks(HistogramError).mask("valid", mask, shape)
    return mask


def pixel_sides(pixel: float | tuple[float, float]) -> tuple[float, float]:
    """Return height and width of a pixel from one number or the pair (height, width).

    Raises
    ------
    HistogramError
        For other than one or two finite numbers above 0.

    Examples
    --------
    >>> pixel_sides(6.0), pixel_sides((6.0, 5.1))
    ((6.0, 6.0), (6.0, 5.1))
    """
    sides = np.broadcast_to(np.asarray(pixel, np.float64), 2) if np.size(pixel) < 3 else np.zeros(2)
    Checks(HistogramError).within("pixel", sides, "(0, inf)")
    return float(sides[0]), float(sides[1])


def slopes(
    height: ArrayLike,
    *,
    pixel: float | tuple[float, float],
    y_up: bool = True,
    valid: ArrayLike | None = None,
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Compute the slopes of a relief, by differences over two pixels or, at edges, one.

    Parameters
    ----------
    height : array_like, shape (H, W)
        Any unit. Row 0 is the top when ``y_up``.
    pixel : float or (float, float)
        Side of a pixel, or its height and width, in the unit of the height.
    y_up : bool
        True: y points to row 0. False: y grows with the row.
    valid : array_like of bool, shape (H, W), optional
        Heights to use, see :func:`slope_stencil`.

    Returns
    -------
    dh_dx, dh_dy : ndarray of float64, shape (H, W)
        Dimensionless; 0 where there is none.
    known : ndarray of bool, shape (H, W)
        Where there are slopes.

    Raises
    ------
    HistogramError
        See :func:`slope_stencil` and :func:`pixel_sides`.

    Examples
    --------
    >>> dh_dx, dh_dy, known = slopes([[0.0, 3.0], [0.0, 3.0]], pixel=6.0)
    >>> dh_dx.tolist(), bool(dh_dy.any()), bool(known.all())
    ([[0.5, 0.5], [0.5, 0.5]], False, True)
    """
    code = slope_stencil(height, valid)
    down, right = pixel_sides(pixel)
    with kernels.limit_threads(100 * code.size):
        a, b = kernels.slopes(np.asarray(height, np.float64), code, right, -down if y_up else down)
    return a, b, code > 0


def slopes_from_normals(
    normals: ArrayLike, *, valid: ArrayLike | None = None
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return the slopes of the surface that has these normals.

    Parameters
    ----------
    normals : array_like, shape (..., 3)
        Unit or not, x to the right, y up, z to the viewer. Those that are not finite or do not
        face z have no slopes.
    valid : array_like of bool, shape (...), optional
        Normals to use.

    Returns
    -------
    dh_dx, dh_dy : ndarray of float64, shape (...)
        Dimensionless; 0 where there is none.
    known : ndarray of bool, shape (...)
        Where there are slopes.

    Raises
    ------
    HistogramError
        For another shape, and a mask of another shape or type.

    Examples
    --------
    >>> dh_dx, dh_dy, known = slopes_from_normals([[-0.5, 0.0, 1.0], [0.0, 0.0, -1.0]])
    >>> dh_dx.tolist(), known.tolist()
    ([0.5, 0.0], [True, False])
    """
    n = np.asarray(normals, np.float64)
    Checks(HistogramError).shape("normals", n, ("...", 3))
    known = np.isfinite(n).all(axis=-1) & (n[..., 2] > 0) & _mask(valid, n.shape[:-1])
    z = np.where(known, n[..., 2], 1.0)
    a, b = (np.where(known, -n[..., i] / z, 0.0) for i in (0, 1))
    return a, b, known


def rotate_components(
    a: FloatArray, b: FloatArray, angle_rad: float
) -> tuple[Float64Array, Float64Array]:
    """Return the components of plane vectors, such as slopes, along rotated axes.

    Parameters
    ----------
    a, b : ndarray, same shape
        Components along x and y, finite.
    angle_rad : float
        Counterclockwise rotation of the axes (y up).

    Returns
    -------
    along, across : ndarray of float64
        Components along the rotated x and y axis.

    Raises
    ------
    HistogramError
        For vectors or an angle that are not finite.

    Examples
    --------
    >>> x, y = rotate_components(np.array([1.0]), np.array([0.0]), math.pi / 2)
    >>> x.round(6).tolist(), y.round(6).tolist()
    ([0.0], [-1.0])
    """
    Checks(HistogramError).require(
        math.isfinite(angle_rad), "angle_rad", angle_rad, "a finite angle"
    )
    for name, part in (("a", a), ("b", b)):
        Checks(HistogramError).within(name, part)
    if angle_rad == 0.0:
        return np.asarray(a, np.float64), np.asarray(b, np.float64)
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.asarray(c * a + s * b), np.asarray(c * b - s * a)
