"""Mean and standard deviation of a map in a disc about every pixel (Jimenez 2010, eq. 1).

Only valid pixels within the map count, so that border and holes cause no bias. The variance is the
mean of squared differences from a value of the neighborhood: it keeps its digits on a map that is
nearly constant or drifts.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from model.checks import Checks
from model.facial_color import disc_kernels
from model.threads import run_in_blocks

MAX_VARIANCE_ERROR: Final = {np.dtype(np.float32): 2.0e-4, np.dtype(np.float64): 2.0e-7}
"""Relative error of a variance by running sums, by the type of the map, above which a disc is
summed by itself; half of it is that of the deviation."""

_TILE_COLUMNS: Final = 512
"""Columns that share a value to sum about; the sums of a tile fit a core's cache."""
_MIN_SUM_RADIUS_PX: Final = 6.0
"""A disc of smaller radius has too few digits left in float32 sums of its whole tile."""


class DiscStatisticsError(ValueError):
    """Error for a map or a disc that has no statistics."""


@dataclass(frozen=True, slots=True, eq=False)
class DiscStatistics:
    """Statistics of a disc about each pixel, arrays of shape (..., H, W)."""

    mean: Float64Array
    """Mean of the valid pixels; NaN where the disc contains none."""
    deviation: Float64Array
    """Standard deviation of the valid pixels, with 1/n; NaN where the disc contains none."""
    count: Int32Array
    """Valid pixels in the disc."""

    @property
    def valid(self) -> BoolArray:
        """Return the pixels whose disc contains a valid pixel."""
        return np.asarray(self.count > 0)


def half_widths(radius_px: float, rows: int, columns: int) -> Int64Array:
    """Return the half-width of the disc at each distance of a row from its center, px.

    A pixel belongs to the disc when its center does: ``||u|| <= r``.

    Parameters
    ----------
    radius_px
        Radius r, px, finite, >= 0; need not be whole.
    rows, columns
        Largest extent to each side, >= 0.

    Examples
    --------
    >>> half_widths(2.3, 100, 100).tolist()
    [2, 2, 1]
    """
    Checks(DiscStatisticsError).within("radius_px", radius_px, "[0, inf)")
    # a disc that contains the whole map needs no larger radius, whose square could overflow
    square = math.floor(min(float(radius_px), math.hypot(rows, columns) + 1.0) ** 2)
    return np.array(
        [
            min(math.isqrt(square - dy * dy), columns)
            for dy in range(min(math.isqrt(square), rows) + 1)
        ],
        np.int64,
    )


def _read_only_view(values: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view: numba compiles a second kernel for writable arrays."""
    view = values.view()
    view.flags.writeable = False
    return view


def measure(h: ArrayLike, radius_px: float, *, valid: BoolArray | None = None) -> DiscStatistics:
    """Measure mean, deviation and number of valid pixels in a disc about each pixel.

    Parameters
    ----------
    h
        Shape (..., H, W), any unit: each map separately. float32 is summed in float32 about a value
        of its neighborhood, with a relative error of the deviation below 1e-4; anything else, or in
        a disc of less than 6 px, in float64, with 1e-7. Values that are not finite count as
        missing.
    radius_px
        Radius of the disc, px; 0 is the pixel alone, and a disc may be larger than the map.
    valid
        Shape of the map, or one that broadcasts to it, bool: pixels that count; None: all that
        are finite.

    Returns
    -------
    DiscStatistics
        float64. Invalid pixels get the statistics of their disc, too.

    Raises
    ------
    DiscStatisticsError
        When the map is not (..., H, W), the mask does not fit, or the radius is negative or not
        finite.

    Examples
    --------
    >>> found = measure(np.eye(3), 1.0)
    >>> found.count.tolist()[0], found.mean[0].round(3).tolist()
    ([3, 4, 3], [0.333, 0.5, 0.0])
    """
    h = np.asarray(h)
    Checks(DiscStatisticsError).shape("h", h, ("...", "H", "W"))
    if h.dtype != np.float32 or radius_px < _MIN_SUM_RADIUS_PX:
        h = np.asarray(h, np.float64)
    if valid is not None:
        valid = np.asarray(valid)
        try:
            fits = valid.shape[-2:] == h.shape[-2:]
            fits = fits and np.broadcast_shapes(valid.shape, h.shape) == h.shape
        except ValueError:
            fits = False
        if valid.dtype != np.bool_ or not fits:
            raise DiscStatisticsError(
                f"valid: got {valid.dtype} {valid.shape}, expected bool {h.shape}"
            )
        valid = np.broadcast_to(valid, h.shape)
    rows, columns = h.shape[-2:]
    half = half_widths(radius_px, rows - 1, columns - 1)
    high = half_widths(radius_px, columns - 1, rows - 1)
    reach = min(float(radius_px), math.hypot(rows, columns))
    inner = min(math.isqrt(math.floor(reach**2 / 2.0)), int(high[0]), int(half[0]))
    mean, deviation = np.empty(h.shape), np.empty(h.shape)
    count = np.empty(h.shape, np.int32)
    nothing = np.zeros((1, 1), np.bool_)
    tall = 64 if radius_px <= 32.0 else 128
    for at in np.ndindex(h.shape[:-2]):
        mask = nothing if valid is None else np.ascontiguousarray(valid[at])
        run_in_blocks(
            disc_kernels.disc_moments,
            disc_kernels.count_tiles(rows, columns, tall, _TILE_COLUMNS),
            1,
            _read_only_view(np.ascontiguousarray(h[at])),
            _read_only_view(mask.view(np.uint8)),
            valid is not None,
            half,
            high,
            inner,
            tall,
            _TILE_COLUMNS,
            MAX_VARIANCE_ERROR[h.dtype],
            mean[at],
            deviation[at],
            count[at],
        )
    return DiscStatistics(mean, deviation, count)
