"""Prepare a neutral relief for fits of kernels: axis of strain along the rows, and convolution.

Conventions, here and in `model.microstructure`:

- G is the continuous Gaussian at whole pixels within 4 sigmas, divided by its sum. Well below a
  pixel it is the delta function: then alpha has no effect, and all such kernels are tied.
- At the map's border the relief is mirrored about the edges of the outermost pixels.
- Holes are filled linearly along the axis before the convolution; their pixels are not samples.
- Stretching divides slopes along the axis by r, and those across it by ``stretch_across``.
- Normals come from central differences, one-sided where one neighbor is missing
  (`relief_slopes.slopes`), in single precision: of 10,000 samples fewer than one moves to another
  bucket than in double precision.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from model.microstructure import gaussian_weights
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from reconstruction.normal_histogram import kernels
from reconstruction.normal_histogram.relief_slopes import HistogramError, pixel_sides, slope_stencil

Axis = Literal["x", "y", 0, 1]


class KernelFitError(ValueError):
    """Reliefs, targets or settings that no kernel can be fitted to."""


@dataclass(frozen=True, slots=True)
class NeutralRelief:
    """A neutral relief with its axis of strain along the rows, and the samples of its slopes.

    Attributes
    ----------
    height_um : ndarray of float32, shape (H, W)
        Less its mean; holes filled along the rows.
    code : ndarray of uint8, shape (H, W)
        Stencil of the slopes, of `relief_slopes.slope_stencil`.
    right_um, down_um : float
        Deformed distance to the next column and row along the histogram's axes, signed.
    pixel_um : float
        Neutral side of a pixel along the rows, for sigma.
    """

    height_um: Float32Array
    code: UInt8Array
    right_um: float
    down_um: float
    pixel_um: float
    places: Int64Array = field(init=False)
    """(N,) pixels with slopes, y * W + x."""
    starts: Int64Array = field(init=False)
    """(H,) number of samples in the rows before."""
    along: Float32Array = field(init=False)
    """(N,) minus the neutral relief's slopes after stretching."""
    across: Float32Array = field(init=False)

    def __post_init__(self) -> None:
        """List the samples and their slopes."""
        known = self.code > 0
        in_row = known.sum(axis=1)
        object.__setattr__(self, "places", np.flatnonzero(known))
        object.__setattr__(self, "starts", (np.cumsum(in_row) - in_row).astype(np.int64))
        for name, leans in zip(
            ("along", "across"), self._negative_slopes(self.height_um), strict=True
        ):
            object.__setattr__(self, name, leans)

    def _negative_slopes(self, height: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return the negative slopes of heights at the samples, along and across: (N,), (N,)."""
        a, b = np.empty(self.places.size, np.float32), np.empty(self.places.size, np.float32)
        right, down = np.float32(self.right_um), np.float32(self.down_um)
        kernels.negative_slopes(height, self.code, self.starts, right, down, a, b)
        return a, b

    def weights(self, sigma_um: float) -> Float32Array:
        """Return the discrete Gaussian's right half from the middle on; mirrored it sums to 1."""
        return gaussian_weights(sigma_um / self.pixel_um).astype(np.float32)

    def slope_change(self, sigma_um: float) -> tuple[Float32Array, Float32Array]:
        """Return the change of the samples' slopes by a Gaussian of sigma: (N,), (N,)."""
        moved = np.empty_like(self.height_um)
        kernels.blur_difference(self.height_um, self.weights(sigma_um), moved)
        return self._negative_slopes(moved)


def prepare_relief(
    neutral_height_um: ArrayLike,
    *,
    stretch: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    stretch_across: float = 1.0,
    valid: ArrayLike | None = None,
) -> NeutralRelief:
    """Prepare a neutral relief: turn its axis of strain into rows and sample its slopes.

    Parameters
    ----------
    neutral_height_um, stretch, axis, pixel_um, stretch_across, valid
        See `kernel_fit.fit_kernel`.

    Raises
    ------
    KernelFitError
        Without a single slope, for a map, mask or pixel that is none, a stretch that is not finite
        and positive, or another axis.
    """
    check = Checks(KernelFitError)
    check.within("stretch", stretch, "(0, inf)")
    check.within("stretch_across", stretch_across, "(0, inf)")
    check.choice("axis", axis, ("x", "y", 1, 0))
    along_y = axis in ("y", 0)
    try:
        code = slope_stencil(neutral_height_um, valid)
        down, right = pixel_sides(pixel_um)
    except HistogramError as error:
        raise KernelFitError(f"neutral relief: {error}") from error
    check.require(code.any(), "neutral_height_um", "no pixel with a slope", "at least one")
    height = np.asarray(neutral_height_um, np.float64)
    good = _usable(height, valid)
    if along_y:
        height, good = height.T, good.T
        code = slope_stencil(np.ascontiguousarray(height), good)
    filled = _fill_holes(height, good).astype(np.float32)
    if along_y:
        return NeutralRelief(filled, code, -down * stretch, right * stretch_across, down)
    return NeutralRelief(filled, code, right * stretch, -down * stretch_across, right)


def _usable(height: Float64Array, valid: ArrayLike | None) -> BoolArray:
    """Return which heights are finite and not masked; shapes have been checked."""
    good = np.isfinite(height)
    return good if valid is None else good & np.asarray(valid, bool)


def _fill_holes(height: Float64Array, good: BoolArray) -> Float64Array:
    """Return heights less their mean, with holes filled linearly along the rows."""
    filled = np.where(good, height - height[good].mean(), 0.0)
    columns = np.arange(height.shape[1])
    for y in np.flatnonzero(~good.all(axis=1) & good.any(axis=1)):
        filled[y] = np.interp(columns, columns[good[y]], filled[y, good[y]])
    return filled


def convolve_relief(
    height_um: ArrayLike,
    alpha: float,
    sigma_um: float,
    *,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    valid: ArrayLike | None = None,
) -> Float64Array:
    """Convolve a map along one axis with eq. (6)'s kernel, with the conventions of the fit.

    Parameters
    ----------
    height_um : array_like, shape (H, W)
        um; values that are not finite count as not valid.
    alpha, sigma_um : float
        Strength, and standard deviation in um, above 0.
    axis, pixel_um, valid
        See `kernel_fit.fit_kernel`.

    Returns
    -------
    ndarray of float64, shape (H, W)
        um; heights that are not valid are unchanged.

    Raises
    ------
    KernelFitError
        See :func:`prepare_relief`.

    Examples
    --------
    >>> furrow = np.tile([0.0, 0.0, -4.0, 0.0, 0.0], (3, 1))
    >>> convolve_relief(furrow, 1.0, 8.0, axis="x", pixel_um=10.0)[0].round(2)
    array([-0.09, -0.91, -1.99, -0.91, -0.09])
    """
    relief = prepare_relief(height_um, stretch=1.0, axis=axis, pixel_um=pixel_um, valid=valid)
    moved = np.empty_like(relief.height_um)
    kernels.blur_difference(relief.height_um, relief.weights(sigma_um), moved)
    if axis in ("y", 0):
        moved = moved.T
    height = np.asarray(height_um, np.float64)
    return np.where(_usable(height, valid), height + alpha * moved.astype(np.float64), height)
