"""Estimate normals as half vectors of the brightest light and the view.

The estimate of Weyrich et al. 2005, section 6, for comparison with photometric stereo.
doi 10.1145/1141911.1141987
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from model.checks import Checks
from reconstruction.arrays import BoolArray, FloatArray, Int32Array
from reconstruction.tiles import map_on_threads

TILE_POINTS = 2048
N_BRIGHTEST = 4
"""Number of samples of one view whose directions are interpolated, as in the paper."""
OUTLIER_SIGMAS = 3.0
MIN_ANGLE_SD_RAD = math.radians(1.0)
"""Distance from the others' middle up to which a view is never an outlier."""


class HalfVectorError(ValueError):
    """Samples of inconsistent shapes or types."""


@dataclass(frozen=True, slots=True)
class HalfVectorNormals:
    """Normals from the brightest samples; where not `valid`, (0, 0, 0) with an error of pi.

    Attributes
    ----------
    normals : ndarray, shape (P, 3)
        Unit vectors.
    valid : ndarray of bool, shape (P,)
        At least two views agree.
    stderr_rad : ndarray, shape (P,)
        Scatter of the views' estimates over the root of their number, rad. Without errors common
        to all views, such as those by the spacing of the lights.
    views : ndarray of int, shape (P,)
        Views that agree.
    """

    normals: FloatArray
    valid: BoolArray
    stderr_rad: FloatArray
    views: Int32Array


def estimate(
    values: FloatArray,
    light_dir: FloatArray,
    view_dir: FloatArray,
    view: NDArray[np.integer],
    *,
    valid: BoolArray | None = None,
    executor: Executor | None = None,
) -> HalfVectorNormals:
    """Estimate normals by the half vectors of each view's four brightest samples.

    Parameters
    ----------
    values : ndarray, shape (P, M)
        Reflectance samples of one channel (f_r), as the paper takes them; any unit.
    light_dir, view_dir : ndarray, shape (P, M, 3)
        Unit vectors from the points to lights and cameras.
    view : ndarray of int, shape (M,)
        Index of each sample's camera, 0 or more.
    valid : ndarray of bool, shape (P, M), optional
        Samples to use.
    executor : Executor, optional
        Threads to map tiles over; default one thread per core, at most 8.

    Returns
    -------
    HalfVectorNormals

    Raises
    ------
    HalfVectorError
        For shapes that do not fit.

    Notes
    -----
    The direction of greatest reflectance is the mean of the four directions weighted by their
    values, our reading of the paper's "interpolation between" them. Views whose half vectors are
    farther from the most central one than three times the median distance are omitted.

    Examples
    --------
    >>> light = np.array([[0.1, 0, 1], [-0.1, 0, 1], [0, 0.1, 1], [0, -0.1, 1], [1, 0, 0.2]] * 2)
    >>> light = light / np.linalg.norm(light, axis=1, keepdims=True)
    >>> out = np.broadcast_to([0.0, 0.0, 1.0], light.shape)
    >>> found = estimate(np.array([[9.0, 9, 9, 9, 1] * 2]), light[None], out[None],
    ...                  np.array([0] * 5 + [1] * 5))
    >>> found.normals.round(6).tolist(), found.views.tolist()
    ([[0.0, 0.0, 1.0]], [2])
    """
    samples = np.asarray(values)
    check = Checks(HalfVectorError)
    check.choice("values", samples.dtype.kind, "f")
    check.within("axes of values (P, M)", samples.ndim, "[2, 2]")
    kind: Any = np.float64 if samples.dtype == np.float64 else np.float32  # of the machine's order
    samples = samples.astype(kind, copy=False)
    points, count = samples.shape
    cameras = np.asarray(view)
    mask = np.broadcast_to(np.True_, samples.shape) if valid is None else np.asarray(valid)
    check.shape("light_dir", light_dir, (points, count, 3))
    check.shape("view_dir", view_dir, (points, count, 3))
    check.shape("view", cameras, (count,))
    check.shape("valid", mask, (points, count))
    check.choice("view (whole numbers)", cameras.dtype.kind, "iu")
    check.within("view", cameras, "[0, inf)")
    cameras = cameras.astype(np.int64)
    normals = np.zeros((points, 3), samples.dtype)
    stderr = np.full(points, np.pi, samples.dtype)
    views = np.zeros(points, np.int32)

    def solve(span: slice) -> None:
        to_lights, to_cameras = (np.asarray(each[span], kind) for each in (light_dir, view_dir))
        _estimate(
            samples[span],
            to_lights,
            to_cameras,
            cameras,
            mask[span],
            int(cameras.max(initial=-1)) + 1,
            normals[span],
            stderr[span],
            views[span],
        )

    spans = [slice(a, min(a + TILE_POINTS, points)) for a in range(0, points, TILE_POINTS)]
    map_on_threads(solve, spans, executor)
    return HalfVectorNormals(normals, views >= 2, stderr, views)


@njit(cache=True, nogil=True, error_model="numpy")
def _half_vectors(values, light_dir, view_dir, view, valid, best, which, half):  # type: ignore[no-untyped-def]
    """Write one point's half vectors to ``half`` (V, 3) and return their number."""
    best[:] = -math.inf
    which[:] = -1
    for k in range(values.size):
        value = float(values[k])
        if not (valid[k] and value > 0.0 and value < math.inf):
            continue
        row = view[k]
        place = N_BRIGHTEST - 1
        if value <= best[row, place]:
            continue
        while place > 0 and best[row, place - 1] < value:
            best[row, place] = best[row, place - 1]
            which[row, place] = which[row, place - 1]
            place -= 1
        best[row, place] = value
        which[row, place] = k
    found = 0
    for row in range(best.shape[0]):
        if which[row, N_BRIGHTEST - 1] < 0:
            continue
        x = y = z = 0.0
        for place in range(N_BRIGHTEST):
            k = which[row, place]
            x += best[row, place] * light_dir[k, 0]
            y += best[row, place] * light_dir[k, 1]
            z += best[row, place] * light_dir[k, 2]
        length = math.sqrt(x * x + y * y + z * z)
        k = which[row, 0]
        x = x / length + view_dir[k, 0]
        y = y / length + view_dir[k, 1]
        z = z / length + view_dir[k, 2]
        length = math.sqrt(x * x + y * y + z * z)
        if length > 1e-6 and length < 4.0:  # no light behind the camera's back, no NaN
            half[found, 0], half[found, 1], half[found, 2] = x / length, y / length, z / length
            found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _angle(a, b):  # type: ignore[no-untyped-def]
    square = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    return 2.0 * math.asin(min(0.5 * math.sqrt(square), 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _estimate(values, light_dir, view_dir, view, valid, views, normals, stderr, used):  # type: ignore[no-untyped-def]
    best = np.empty((views, N_BRIGHTEST), np.float64)
    which = np.empty((views, N_BRIGHTEST), np.int64)
    half = np.empty((views, 3), np.float64)
    angles = np.empty(views, np.float64)
    for p in range(values.shape[0]):
        found = _half_vectors(
            values[p], light_dir[p], view_dir[p], view, valid[p], best, which, half
        )
        if found < 2:
            continue
        middle, least = 0, math.inf
        for i in range(found):
            total = 0.0
            for j in range(found):
                total += _angle(half[i], half[j])
            if total < least:
                middle, least = i, total
        for i in range(found):
            angles[i] = _angle(half[i], half[middle])
        # the median of the others' distances; 1.18 makes it a standard deviation in two dimensions
        ordered = np.sort(angles[:found])
        spread = max(ordered[(found + 1) // 2] / 1.1774, MIN_ANGLE_SD_RAD)
        x = y = z = 0.0
        kept = 0
        for i in range(found):
            if angles[i] <= OUTLIER_SIGMAS * spread:
                x, y, z = x + half[i, 0], y + half[i, 1], z + half[i, 2]
                kept += 1
        length = math.sqrt(x * x + y * y + z * z)
        if kept < 2 or not length > 0.0:
            continue
        mean = np.array([x / length, y / length, z / length])
        squares = 0.0
        for i in range(found):
            if angles[i] <= OUTLIER_SIGMAS * spread:
                squares += _angle(half[i], mean) ** 2
        normals[p, 0], normals[p, 1], normals[p, 2] = mean[0], mean[1], mean[2]
        stderr[p] = math.sqrt(squares / (kept - 1) / kept)
        used[p] = kept
