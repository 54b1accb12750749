"""Triangulate a camera's rays with the stripes of a projector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.scan.rough_normals import RayCamera
from reconstruction.scan.stripe_decoding import StripeError, StripeMap

NEWTON_STEPS: Final = 6
DERIVATIVE_STEP_MM: Final = 0.05
MAX_NEWTON_MISS_PX: Final = 1e-6
"""Distance of a triangulated point from its stripe, projector pixels, that counts as solved."""
MIN_STRIPES_PER_MM: Final = 0.05
"""Projector pixels per mm along the ray, below which ray and stripe are almost parallel."""
MAX_JUMP_RATIO: Final = 3.0
"""Difference of range between neighbors, in sides of a pixel on the surface, at an edge."""
CELL_SAMPLES: Final = 2.0
"""Side of the cells in which cameras are compared, in distances of neighboring points."""
MAX_CELL_SLOPE: Final = 1.5
"""Difference of two cameras in one cell, relative to its side, that does not contradict."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeMap:
    """Surface points along the rays of a camera."""

    camera: RayCamera
    range_mm: Float64Array
    """Distance from the center of projection, shape (H, W); NaN where masked."""
    stderr_mm: Float64Array
    """Standard error of the range, shape (H, W); NaN where masked."""
    cosine: Float64Array
    """Cosine between the surface's normal and the ray, shape (H, W); NaN where masked."""
    points_mm: Float64Array
    """Shape (H, W, 3); NaN where masked."""

    @property
    def valid(self) -> BoolArray:
        """Pixels with a range, shape (H, W)."""
        return np.isfinite(self.range_mm)

    def keep(self, good: BoolArray) -> RangeMap:
        """Return the map with the other pixels masked."""
        range_mm, stderr_mm, cosine = (
            np.where(good, values, np.nan)
            for values in (self.range_mm, self.stderr_mm, self.cosine)
        )
        points = np.where(good[..., None], self.points_mm, np.nan)
        return replace(
            self, range_mm=range_mm, stderr_mm=stderr_mm, cosine=cosine, points_mm=points
        )


def triangulate_stripes(
    camera: RayCamera,
    projector: RayCamera,
    stripes: StripeMap,
    *,
    limits_mm: tuple[float, float],
    axis: Literal["columns", "rows"] = "columns",
) -> RangeMap:
    """Intersect each pixel's ray with its stripe's surface of light.

    Parameters
    ----------
    camera, projector : RayCamera
        In one frame, mm.
    stripes : StripeMap
        Decoded coordinates of the projector in the camera's pixels.
    limits_mm : (float, float)
        Shortest and longest range, mm; others are masked.
    axis : {"columns", "rows"}
        Axis of the projector that the stripes encode.

    Returns
    -------
    RangeMap
        Standard errors are those of the stripes over the projector pixels per mm of range; the
        geometry's are not included. Pixels at jumps of range are masked.
    """
    near, far = limits_mm
    check = Checks(StripeError)
    check.require(0 <= near < far, "limits_mm", limits_mm, "0 <= shortest < longest")
    check.choice("axis", axis, ("columns", "rows"))
    row, column = np.nonzero(stripes.valid)
    rays = camera.rays(np.stack([column, row], axis=-1).astype(np.float64))
    wanted = stripes.position_px[row, column]
    which = 0 if axis == "columns" else 1

    def seen(range_mm: Float64Array) -> Float64Array:
        points = camera.center_mm + range_mm[:, None] * rays
        return np.asarray(projector.project(points)[:, which])

    ranges = np.full(len(rays), 0.5 * (near + far))
    miss, slope = np.full(len(rays), np.inf), np.ones(len(rays))
    for _ in range(NEWTON_STEPS):
        here = seen(ranges)
        slope = (seen(ranges + DERIVATIVE_STEP_MM) - here) / DERIVATIVE_STEP_MM
        miss = wanted - here
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = np.clip(ranges + miss / slope, 0.2 * near, 2.0 * far)
    solved = (np.abs(miss) < MAX_NEWTON_MISS_PX * 1e3) & (np.abs(slope) > MIN_STRIPES_PER_MM)
    solved &= (ranges >= near) & (ranges <= far)
    size = stripes.valid.shape
    range_mm, stderr_mm = np.full(size, np.nan), np.full(size, np.nan)
    points_mm = np.full((*size, 3), np.nan)
    row, column = row[solved], column[solved]
    range_mm[row, column] = ranges[solved]
    stderr_mm[row, column] = stripes.stderr_px[row, column] / np.abs(slope[solved])
    points_mm[row, column] = camera.center_mm + ranges[solved, None] * rays[solved]
    cosine = _incidence_cosine(points_mm, camera.center_mm)
    found = RangeMap(camera, range_mm, stderr_mm, cosine, points_mm)
    return found.keep(found.valid & np.isfinite(cosine) & _is_smooth(found))


def drop_contradictions(maps: Sequence[RangeMap], projector: RayCamera) -> list[RangeMap]:
    """Mask pixels where cameras place one projector pixel at different distances.

    A projector pixel lights one point. Where two cameras decode it at different distances, one of
    them sees a reflection or a wrong code, and both are masked.

    Parameters
    ----------
    maps : sequence of RangeMap
        Of the cameras that decode one projector.
    projector : RayCamera
    """
    if not all(one.valid.any() for one in maps):
        return list(maps)
    side_mm = CELL_SAMPLES * max(_point_spacing_mm(one) for one in maps)
    middle = np.nanmedian(maps[0].points_mm[maps[0].valid], axis=0)
    to_projector = (projector.center_mm - middle) / np.linalg.norm(projector.center_mm - middle)
    aside = np.cross(to_projector, [0.0, 1.0, 0.0] if abs(to_projector[1]) < 0.9 else [1.0, 0, 0])
    ends = projector.project(middle + np.outer([0.0, 1.0], aside / np.linalg.norm(aside)))
    cell_px = side_mm * float(np.linalg.norm(ends[1] - ends[0]))
    cells = [_projector_cells(one, projector, cell_px) for one in maps]
    keys = np.unique(np.concatenate([key for key, _, _ in cells]))
    sums = np.zeros((len(maps), 3, len(keys)))  # count, distance, squared standard error
    for number, (key, distance, variance) in enumerate(cells):
        at = np.searchsorted(keys, key)
        for k, values in enumerate((np.ones(len(key)), distance, variance)):
            sums[number, k] = np.bincount(at, values, minlength=len(keys))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums[:, 1] / sums[:, 0]
        spread = np.sqrt(sums[:, 2]) / sums[:, 0]
    low = np.nanmin(np.where(sums[:, 0] > 0, mean, np.inf), axis=0)
    high = np.nanmax(np.where(sums[:, 0] > 0, mean, -np.inf), axis=0)
    error = np.nanmax(np.where(sums[:, 0] > 0, spread, 0.0), axis=0)
    wrong = high - low > MAX_CELL_SLOPE * side_mm + 4.0 * error
    kept = []
    for one, (key, _, _) in zip(maps, cells, strict=True):
        good = one.valid.copy()
        good[one.valid] = ~wrong[np.searchsorted(keys, key)]
        kept.append(one.keep(good))
    return kept


def _point_spacing_mm(one: RangeMap) -> float:
    """Return the median distance of neighboring points, the larger of both axes, mm."""
    gaps = [np.linalg.norm(np.diff(one.points_mm, axis=k), axis=-1) for k in (0, 1)]
    return max((float(np.nanmedian(g)) for g in gaps if np.isfinite(g).any()), default=1.0)


def _projector_cells(
    one: RangeMap, projector: RayCamera, cell_px: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the cell of the projector, the distance from it and its variance at each point."""
    points = one.points_mm[one.valid]
    distance = np.linalg.norm(points - projector.center_mm, axis=1)
    pixel = projector.project(points)
    cell = np.floor(pixel / cell_px)
    return cell[:, 0] * 65_536.0 + cell[:, 1], distance, one.stderr_mm[one.valid] ** 2


def _incidence_cosine(points_mm: Float64Array, center_mm: Float64Array) -> Float64Array:
    """Return the cosine between ray and normal from one-sided or central differences."""
    along = [_difference(points_mm, axis) for axis in (0, 1)]
    normal = np.cross(along[0], along[1])
    way = points_mm - center_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        top = np.abs(np.sum(normal * way, axis=-1))
        return np.asarray(
            top / (np.linalg.norm(normal, axis=-1) * np.linalg.norm(way, axis=-1)), np.float64
        )


def _difference(points: Float64Array, axis: int) -> Float64Array:
    """Return the mean of the differences to both neighbors, or the only one; NaN without."""
    ahead = np.full(points.shape, np.nan)
    behind = np.full(points.shape, np.nan)
    first: list[slice] = [slice(None)] * 3
    second: list[slice] = [slice(None)] * 3
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    step = np.diff(points, axis=axis)
    ahead[tuple(first)], behind[tuple(second)] = step, step
    both = np.where(np.isnan(behind), ahead, 0.5 * (ahead + behind))
    return np.where(np.isnan(ahead), behind, both)


def _is_smooth(found: RangeMap) -> BoolArray:
    """Return the pixels without a jump of range to any neighbor."""
    good = np.ones(found.range_mm.shape, np.bool_)
    side = (
        np.nanmedian(np.linalg.norm(np.diff(found.points_mm, axis=1), axis=-1))
        if found.valid.any()
        else 1.0
    )
    for axis in (0, 1):
        first: list[slice] = [slice(None)] * 2
        second: list[slice] = [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        one, two = tuple(first), tuple(second)
        noise = 4.0 * np.hypot(found.stderr_mm[one], found.stderr_mm[two])
        jump = np.abs(np.diff(found.range_mm, axis=axis)) > MAX_JUMP_RATIO * side + noise
        good[one] &= ~jump
        good[two] &= ~jump
    return good
