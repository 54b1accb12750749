"""A neutral relief as fits of kernels take it: its axis of strain along rows, convolved, counted.

What is fixed, here and in `model.microstructure`:

- G is the continuous Gaussian at whole pixels within 4 sigmas, divided by its sum. Well below a
  pixel it is the delta function: then alpha means nothing, and all such kernels are tied.
- At the map's border the relief is mirrored about the edges of the outermost pixels.
- Holes are filled linearly along the axis before the convolution; a pixel of a hole is no sample.
- Stretching divides slopes along the axis by r, and those across it by ``stretch_across``.
- Normals come from central differences, one-sided where one neighbour is missing
  (`relief_slopes.slopes`), in single precision: of 10,000 samples fewer than one comes into
  another bucket than in double precision.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction import kernel_fit_kernels as kernels
from reconstruction.kernel_search import Buckets, Relief
from reconstruction.normal_histogram import check_buckets
from reconstruction.relief_slopes import pixel_sides, stencil

Floats = NDArray[np.float64]
Axis = Literal["x", "y", 0, 1]


class KernelFitError(ValueError):
    """A relief, target or setting that no kernel can be fitted to."""


def relief_of(
    neutral_height_um: NDArray[np.floating],
    *,
    stretch: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    stretch_across: float = 1.0,
    valid: ArrayLike | None = None,
    y_up: bool = True,
) -> Relief:
    """Return a neutral relief, its axis of strain turned into rows, with its samples.

    Parameters
    ----------
    neutral_height_um, stretch, axis, pixel_um, stretch_across, valid, y_up
        As of `kernel_fit.fit_kernel`.

    Raises
    ------
    KernelFitError
        Without a single slope, for a stretch that is not finite and positive, or another axis.
    """
    for name, r in (("stretch", stretch), ("stretch_across", stretch_across)):
        if not (math.isfinite(r) and r > 0):
            raise KernelFitError(f"{name}: got {r}, expected a finite ratio above 0")
    if axis not in ("x", "y", 0, 1):
        raise KernelFitError(f'axis: got {axis!r}, expected "x", "y", 1 or 0')
    along_y = axis in ("y", 0)
    height = np.asarray(neutral_height_um, np.float64)
    code = stencil(height, valid)
    if not code.any():
        raise KernelFitError("neutral_height_um: got no pixel with a slope, expected at least one")
    good = np.isfinite(height)
    if valid is not None:
        good &= np.asarray(valid, bool)
    down, right = pixel_sides(pixel_um)
    if along_y:
        height, good = height.T, good.T
        code = stencil(np.ascontiguousarray(height), good)
    filled = _filled(height, good).astype(np.float32)
    to_top = -1.0 if y_up else 1.0
    if along_y:
        return Relief(filled, code, to_top * down * stretch, right * stretch_across, down)
    return Relief(filled, code, right * stretch, to_top * down * stretch_across, right)


def _filled(height: Floats, good: NDArray[np.bool_]) -> Floats:
    """Return heights about their mean, with holes filled linearly along the rows."""
    filled = np.where(good, height - height[good].mean(), 0.0)
    columns = np.arange(height.shape[1])
    for y in np.flatnonzero(~good.all(axis=1) & good.any(axis=1)):
        filled[y] = np.interp(columns, columns[good[y]], filled[y, good[y]])
    return filled


def convolved(
    height_um: NDArray[np.floating],
    alpha: float,
    sigma_um: float,
    *,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    valid: ArrayLike | None = None,
) -> NDArray[np.floating]:
    """Return a map convolved along one axis with eq. (6)'s kernel, as the search does it.

    Not-valid and not finite heights come back as they were.
    """
    relief = relief_of(height_um, stretch=1.0, axis=axis, pixel_um=pixel_um, valid=valid)
    moved = np.empty_like(relief.height_um)
    kernels.blurred_less_itself(relief.height_um, relief.weights(sigma_um), moved)
    if axis in ("y", 0):
        moved = moved.T
    good = np.isfinite(height_um)
    if valid is not None:
        good &= np.asarray(valid, bool)
    height = np.asarray(height_um, np.float64)
    return np.where(good, height + alpha * moved.astype(np.float64), height)


def convolved_histogram(
    neutral_height_um: NDArray[np.floating],
    alpha: float,
    sigma_um: float,
    *,
    stretch: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    stretch_across: float = 1.0,
    valid: ArrayLike | None = None,
    y_up: bool = True,
) -> Floats:
    """Return the histogram that `kernel_fit.fit_kernel` compares with its target, (bins, bins).

    Axes (n_y, n_x); the shares of all samples, so that what is beyond the limit is missing from
    the sum. Parameters as of `kernel_fit.fit_kernel`.
    """
    relief = relief_of(
        neutral_height_um, stretch=stretch, axis=axis, pixel_um=pixel_um,
        stretch_across=stretch_across, valid=valid, y_up=y_up,
    )  # fmt: skip
    check_buckets(bins, limit)
    buckets = Buckets(np.zeros(bins * bins + 1), bins, limit)
    change = relief.change(sigma_um)
    counts = buckets.count((relief.along, relief.across), change, np.array([alpha])).sum(axis=0)[0]
    shares = counts[:-1].reshape(bins, bins) / relief.places.size
    return shares.T if axis in ("y", 0) else shares
