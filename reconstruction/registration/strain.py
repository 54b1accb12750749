"""Measure stretch, shear and motion of skin between two images of it, with standard errors.

Nagano et al. 2015 (doi 10.1145/2766894) take the stretch ratio from the caliper. Tape creeps and
slips, so here the skin itself is measured: an affine map between two images of its pigment, first
by maximizing the enhanced correlation coefficient (Evangelidis and Psarakis 2008,
doi 10.1109/TPAMI.2008.113) over a pyramid, then by least squares on many small windows tracked
separately, whose correlated scatter gives the standard errors
(`reconstruction.registration.affine_fit`).
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, UInt8Array
from reconstruction.registration.affine_fit import fit_affine
from reconstruction.registration.tracking import (
    RegistrationError,
    normalize_local_contrast,
    select_textured_points,
    track_points,
)

MIN_STRAIN_SIDE_PX = 64
MIN_TOP_SIDE_PX = 48
"""Shortest side of the pyramid's top."""
STRAIN_WINDOW_PX = 25
MAX_WINDOWS = 600
MIN_WINDOWS = 12
"""Fewest windows whose scatter can be estimated: six parameters are fitted to them."""
WINDOW_OUTLIER_SIGMAS = 4.0
"""Robust standard deviations above which a window is an outlier."""
MAX_WINDOW_RESIDUAL_PX = 2.0
"""Residual above which a window was tracked wrongly, px."""
N_STRAIN_ROUNDS = 3

_FLIP_Y = np.diag([1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Strain:
    """Affine deformation of the skin from one image to another.

    A point at x (mm or px from the image's middle, +x right, +y up) moves to ``gradient @ x +
    shift``.

    Attributes
    ----------
    gradient : ndarray of float64, shape (2, 2)
        Deformation gradient F.
    shift_px : ndarray of float64, shape (2,)
        Of the image's middle, px, +y up.
    covariance : ndarray of float64, shape (6, 6)
        Covariance of F row by row, then of the shift.
    residual_px : float
        Root mean square distance of windows from the affine map, px: noise and other deformation.
    windows : int
        Windows that the map was fitted to.
    valid : bool
        False if too few windows could be tracked; the values are then undefined.
    """

    gradient: Float64Array
    shift_px: Float64Array
    covariance: Float64Array
    residual_px: float
    windows: int
    valid: bool

    def stretch_along(self, angle_rad: float) -> tuple[float, float]:
        """Return the stretch ratio of a line at an angle (+x towards +y), and its standard error.

        Examples
        --------
        >>> made = Strain(np.diag([1.1, 0.95]), np.zeros(2), np.zeros((6, 6)), 0.0, 20, True)
        >>> made.stretch_along(0.0)
        (1.1, 0.0)
        """
        axis = np.array([math.cos(angle_rad), math.sin(angle_rad)])
        moved = self.gradient @ axis
        length = float(np.linalg.norm(moved))
        slope = np.concatenate([np.outer(moved / length, axis).ravel(), np.zeros(2)])
        return length, _stderr(slope, self.covariance)

    def shear(self, angle_rad: float) -> tuple[float, float]:
        """Return the decrease from a right angle between two lines, rad, and its standard error.

        The lines were at ``angle_rad`` and across it.
        """

        def closed(gradient: Float64Array) -> float:
            c, s = math.cos(angle_rad), math.sin(angle_rad)
            one, two = gradient @ [c, s], gradient @ [-s, c]
            return math.asin(float(one @ two) / float(np.linalg.norm(one) * np.linalg.norm(two)))

        return closed(self.gradient), self._error_of(closed)

    @property
    def rotation(self) -> tuple[float, float]:
        """Rotation of the rigid part (polar decomposition), rad, +x towards +y, and its error."""

        def turned(gradient: Float64Array) -> float:
            return math.atan2(gradient[1, 0] - gradient[0, 1], gradient[0, 0] + gradient[1, 1])

        return turned(self.gradient), self._error_of(turned)

    def _error_of(self, value: Any) -> float:
        slope = np.zeros(6)
        for k in range(4):
            step = np.zeros(4)
            step[k] = 1e-6
            apart = step.reshape(2, 2)
            slope[k] = (value(self.gradient + apart) - value(self.gradient - apart)) / 2e-6
        return _stderr(slope, self.covariance)

    def affine_px(self, shape: tuple[int, int]) -> Float64Array:
        """Return the map of pixels (column, row), first image to second, shape (2, 3)."""
        return _to_pixels(self.gradient, self.shift_px, shape)


STRAIN_GUESSES = tuple(
    np.diag([across, up])
    for across in (1.0, 0.88, 1.14, 0.76, 1.28)
    for up in (1.0, 0.88, 1.14, 0.76, 1.28)
    if across != 1.0 or up != 1.0
)
"""Stretches along x and y at which a search without a guess starts."""


def measure_strain(
    first: FloatArray,
    second: FloatArray,
    *,
    start: Float64Array | None = None,
    valid: BoolArray | None = None,
    valid_second: BoolArray | None = None,
) -> Strain:
    """Measure the affine deformation of the skin from one image to another.

    Parameters
    ----------
    first, second : ndarray, shape (H, W)
        Linear images in which the same skin can be recognized: subsurface scattered light (crossed
        polarizers), whose texture is pigment and moves with the skin. Row 0 is the top.
    start : ndarray, shape (2, 2), optional
        Initial deformation gradient, as from the strain step before or from the caliper's reading;
        by default the identity, and if that fails a grid of stretches. It is the start of the
        search and does not affect the result.
    valid, valid_second : ndarray of bool, shape (H, W), optional
        Skin in each image.

    Returns
    -------
    Strain

    Raises
    ------
    RegistrationError
        If images differ in shape or are too small.
    """
    Checks(RegistrationError).shape("first", first, ("H", "W"))
    Checks(RegistrationError).shape("second", second, np.shape(first))
    height, width = np.shape(first)
    least = f"[{MIN_STRAIN_SIDE_PX}, inf)"
    Checks(RegistrationError).within("sides of first, px", (height, width), least)
    shape = (height, width)
    one = normalize_local_contrast(_filled(first, valid))
    two = normalize_local_contrast(_filled(second, valid_second))
    mask = np.ones(shape, bool) if valid is None else valid
    other = np.ones(shape, bool) if valid_second is None else valid_second
    guesses = [np.eye(2), *STRAIN_GUESSES] if start is None else [np.asarray(start, np.float64)]
    for gradient in guesses:
        affine = _to_pixels(gradient, np.zeros(2), shape)
        affine[:, 2] += _phase_shift(one, two, affine, mask)
        affine = _pyramid(one, two, affine, mask)
        found = _by_windows(one, two, affine, mask, other)
        if found.valid:
            break
    return found


def _filled(image: FloatArray, valid: BoolArray | None) -> FloatArray:
    """Fill pixels other than skin with the median: a hard edge would be tracked instead of skin."""
    if valid is None or valid.all():
        return image
    inside = np.asarray(image)[valid & np.isfinite(image)]
    middle = float(np.median(inside)) if inside.size else 0.0
    return np.where(valid, image, middle)


def _to_pixels(
    gradient: Float64Array, shift_px: Float64Array, shape: tuple[int, int]
) -> Float64Array:
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    turned = _FLIP_Y @ gradient @ _FLIP_Y
    return np.column_stack([turned, middle + _FLIP_Y @ shift_px - turned @ middle])


def _from_pixels(affine: Float64Array, shape: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    shift = affine[:, :2] @ middle + affine[:, 2] - middle
    return _FLIP_Y @ affine[:, :2] @ _FLIP_Y, _FLIP_Y @ shift


def _warped_back(
    image: UInt8Array, affine: Float64Array, interpolation: int, border: int = 128
) -> Any:
    """Warp an image back by an affine map, in its own size."""
    size, flags = (image.shape[1], image.shape[0]), interpolation | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, affine, size, flags=flags, borderValue=border)


def _phase_shift(
    one: UInt8Array, two: UInt8Array, affine: Float64Array, mask: BoolArray
) -> Float64Array:
    """Return the shift of the second image, warped back, from the first, px."""
    size = one.shape[1], one.shape[0]
    back = _warped_back(two, affine, cv2.INTER_LINEAR)
    window = cv2.createHanningWindow(size, cv2.CV_32F)
    weighted = [
        (np.where(mask, picture, 128).astype(np.float32) - 128.0) * window
        for picture in (one, back)
    ]
    (dx, dy), _ = cv2.phaseCorrelate(weighted[0], weighted[1])
    return affine[:, :2] @ np.array([dx, dy])


def _pyramid(
    one: UInt8Array, two: UInt8Array, affine: Float64Array, mask: BoolArray
) -> Float64Array:
    """Improve an affine map from coarse to fine; a level that does not converge is skipped."""
    levels = [(one.astype(np.float32), two.astype(np.float32), mask.astype(np.uint8))]
    while min(levels[-1][0].shape) >= 2 * MIN_TOP_SIDE_PX and len(levels) < 6:
        a, b, m = levels[-1]
        levels.append(
            (
                cv2.pyrDown(a),
                cv2.pyrDown(b),
                cv2.resize(m, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST),
            )
        )
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-6)
    # the finest level is left to the windows, which also give the error
    last = 1 if len(levels) > 2 else 0
    for level in range(len(levels) - 1, last - 1, -1):
        a, b, m = levels[level]
        scale = 2.0**level
        warp = affine.astype(np.float32)
        warp[:, 2] = affine[:, 2] / scale
        if m.shape != a.shape:
            m = cv2.resize(m, (a.shape[1], a.shape[0]), interpolation=cv2.INTER_NEAREST)
        try:
            _, found = cv2.findTransformECC(a, b, warp, cv2.MOTION_AFFINE, criteria, m, 5)
        except cv2.error:  # no overlap, or no texture, at this level
            continue
        affine = np.asarray(found, np.float64)
        affine[:, 2] *= scale
    return affine


def _by_windows(
    one: UInt8Array, two: UInt8Array, affine: Float64Array, mask: BoolArray, other: BoolArray
) -> Strain:
    """Track windows of the first image into the second, warped back, and fit all of them."""
    shape = one.shape[0], one.shape[1]
    grid = np.stack(np.meshgrid(np.arange(0, shape[1], 3), np.arange(0, shape[0], 3)), axis=-1)
    candidates = grid.reshape(-1, 2).astype(np.float64)
    window = np.ones((STRAIN_WINDOW_PX, STRAIN_WINDOW_PX), np.uint8)
    eroded = cv2.erode(mask.astype(np.uint8), window)
    candidates = candidates[eroded[candidates[:, 1].astype(int), candidates[:, 0].astype(int)] > 0]
    cell, margin = STRAIN_WINDOW_PX, STRAIN_WINDOW_PX // 2 + 1
    chosen = select_textured_points(
        one, candidates, count=MAX_WINDOWS, cell_px=cell, margin_px=margin
    )
    start = candidates[chosen]
    for number in range(N_STRAIN_ROUNDS):
        back = _warped_back(two, affine, cv2.INTER_CUBIC)
        seen = _warped_back(other.astype(np.uint8), affine, cv2.INTER_NEAREST, border=0)
        seen = cv2.erode(seen, window, borderValue=0)
        tracks = track_points(
            one, back, start, window_px=STRAIN_WINDOW_PX, levels=2 if number == 0 else 0
        )
        inside = seen[start[:, 1].astype(int), start[:, 0].astype(int)] > 0
        good = tracks.valid & inside
        fit = _fit(start[good], tracks.points_px[good], shape, last=number == N_STRAIN_ROUNDS - 1)
        if fit is None:
            gradient, shift = _from_pixels(affine, shape)
            return Strain(
                gradient, shift, np.full((6, 6), np.inf), math.inf, int(good.sum()), False
            )
        small, covariance, residual, used = fit
        # back(x) = two(affine x): a window at small x in `back` is at affine (small x) in `two`
        affine = np.column_stack(
            [affine[:, :2] @ small[:, :2], affine[:, :2] @ small[:, 2] + affine[:, 2]]
        )
    gradient, shift = _from_pixels(affine, shape)
    carried = _carry(covariance, affine[:, :2])
    return Strain(gradient, shift, carried, residual, used, True)


def _fit(
    start: Float64Array, found: Float64Array, shape: tuple[int, int], *, last: bool
) -> tuple[Float64Array, Float64Array, float, int] | None:
    """Fit an affine map to all but outliers: by least squares, or with its errors when `last`.

    Returns
    -------
    tuple or None
        The map (2, 3) of pixels; the covariance (6, 6) of its linear part row by row and of the
        shift of the image's middle; the residual's root mean square; how many were used.
    """
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    keep = np.ones(len(start), bool)
    for _ in range(5):
        if keep.sum() < MIN_WINDOWS:
            return None
        design = np.column_stack([start[keep] - middle, np.ones(keep.sum())])
        solution, _, rank, _ = np.linalg.lstsq(design, found[keep] - middle)
        if rank < 3:
            return None
        everywhere = np.column_stack([start - middle, np.ones(len(start))]) @ solution
        distance = np.linalg.norm(found - middle - everywhere, axis=1)
        spread = 1.4826 * float(np.median(distance[keep])) / 1.177  # of one coordinate
        now = distance <= min(max(WINDOW_OUTLIER_SIGMAS * spread, 0.02), MAX_WINDOW_RESIDUAL_PX)
        if (now == keep).all():
            break
        keep = now
    if keep.sum() < MIN_WINDOWS:
        return None
    design = np.column_stack([start[keep] - middle, np.ones(keep.sum())])
    covariance = np.full((6, 6), np.inf)
    if last:
        solution, covariance = fit_affine(
            start[keep] - middle, found[keep] - middle, window_px=STRAIN_WINDOW_PX
        )
    linear, offset = solution[:2].T, solution[2]
    rest = found[keep] - middle - design @ solution
    affine = np.column_stack([linear, middle + offset - linear @ middle])
    residual = float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))
    return affine, covariance, residual, int(keep.sum())


def _carry(covariance: Float64Array, linear: Float64Array) -> Float64Array:
    """Propagate the covariance of a small map through the preceding one, to axes with y up."""
    jacobian = np.zeros((6, 6))
    outer = _FLIP_Y @ linear
    for i in range(2):
        for j in range(2):
            # F = flip (linear small) flip: entry (i, j) of F from row k, column j of small
            for k in range(2):
                jacobian[2 * i + j, 2 * k + j] = outer[i, k] * _FLIP_Y[j, j]
        jacobian[4 + i, 4:6] = outer[i]
    return jacobian @ covariance @ jacobian.T


def _stderr(slope: Float64Array, covariance: Float64Array) -> float:
    if not np.isfinite(covariance).all():
        return math.inf
    return math.sqrt(max(float(slope @ covariance @ slope), 0.0))
