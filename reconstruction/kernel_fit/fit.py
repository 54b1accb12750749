"""The convolution kernel that makes a neutral relief's normals distributed as a strained one's.

Eq. (7) of Nagano et al. 2015: over alpha in [-2, 1] by 0.01 and sigma in [1, 100] um by 0.5, the
neutral map is convolved along one axis with ``(1 - alpha) delta + alpha G(sigma)``, stretched, its
normals sorted into buckets, and the sum over buckets of the differences to a target minimised.
`neutral_relief` says what is fixed of Gaussian, border, holes and slopes.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.microstructure import ALPHA_LIMITS
from reconstruction import normal_histogram
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.kernel_fit import search as kernel_search
from reconstruction.kernel_fit.neutral_relief import Axis, KernelFitError, Relief, relief_of
from reconstruction.kernel_fit.outcome import KernelFit, summarize_search
from reconstruction.kernel_fit.search import Buckets, KernelGrid
from reconstruction.normal_histogram import blocks as normal_blocks
from reconstruction.normal_histogram import kernels

ALPHA_GRID = np.round(np.linspace(*ALPHA_LIMITS, 301), 2)
"""The paper's grid of strengths, by 0.01."""
SIGMAS_UM = np.linspace(1.0, 100.0, 199)
"""The paper's grid of standard deviations, by 0.5 um."""


def fit_kernel(
    neutral_height_um: ArrayLike,
    target_histogram: FloatArray,
    *,
    stretch: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    search: Literal["hierarchical", "exhaustive"] = "hierarchical",
    stretch_across: float = 1.0,
    valid: ArrayLike | None = None,
    y_up: bool = True,
    target_samples: float | None = None,
    target_blocks: NDArray[np.integer] | None = None,
    alphas: ArrayLike | None = None,
    sigmas_um: ArrayLike | None = None,
    first_sample: int = kernel_search.FIRST_SAMPLE,
    seed: int = 0,
) -> KernelFit:
    """Fit the kernel of one axis and stretch ratio: eq. (7).

    Parameters
    ----------
    neutral_height_um : array_like, shape (H, W)
        Displacement map of the neutral skin, um; row 0 is the top when ``y_up``. Heights that are
        not finite count as not valid.
    target_histogram : ndarray, shape (bins, bins)
        Of the strained skin's normals, axes (n_y, n_x), as of `normal_histogram.histogram`; sums
        to 1, or to less where normals beyond the limit are counted in the whole.
    stretch : float
        The skin's ratio r of lengths along the axis, > 0.
    axis : {"x", "y", 1, 0}
        Of the jaws: columns (x, 1) or rows (y, 0).
    pixel_um : float or (float, float)
        Side of a neutral pixel, or its height and width, um.
    bins, limit
        As of `normal_histogram.histogram`.
    search : {"hierarchical", "exhaustive"}
        The first returns what the second does, but for a chance of 1e-6 (`kernel_search`), in a
        fraction of the time.
    stretch_across : float
        Ratio of lengths across the axis; 1 as in the paper.
    valid : ndarray of bool, shape (H, W), optional
    y_up : bool
        True: y points to row 0, as in the target.
    target_samples : float, optional
        Effective number of samples behind the target (`NormalStatistics.effective_samples`); as
        many as behind the neutral relief by default. For `noise` and standard errors only.
    target_blocks : ndarray of int, shape (rows, columns, bins, bins), optional
        Where the target is of the same piece of skin: its counts in the skin of each block of the
        neutral map (`normal_blocks.grid_of`, `normal_blocks.block_counts`), for standard errors
        only.
    alphas, sigmas_um : array_like, optional
        Another grid than the paper's, increasing; alphas within [-2, 1], sigmas > 0.
    first_sample : int
        Pixels that the hierarchical search begins with.
    seed : int
        Of its samples, and of the draws for the standard errors.

    Returns
    -------
    KernelFit
        Equal distances go to the gentlest kernel: least |alpha|, then least sigma, then blurring.

    Raises
    ------
    KernelFitError
        For shapes, ranges or sums that do not fit, or a relief without slopes.
    HistogramError
        For numbers of buckets and limits that make no histogram.
    """
    normal_histogram.check_buckets(bins, limit)
    target = _target(target_histogram, bins, transposed=axis in ("y", 0))
    relief = relief_of(
        neutral_height_um,
        stretch=stretch,
        axis=axis,
        pixel_um=pixel_um,
        stretch_across=stretch_across,
        valid=valid,
        y_up=y_up,
    )
    grid = KernelGrid(
        relief,
        Buckets(target, bins, float(limit)),
        _grid("alphas", ALPHA_GRID if alphas is None else alphas, *ALPHA_LIMITS),
        _grid("sigmas_um", SIGMAS_UM if sigmas_um is None else sigmas_um, 1e-9, math.inf),
    )
    if search not in ("hierarchical", "exhaustive"):
        raise KernelFitError(f'search: got {search!r}, expected "hierarchical" or "exhaustive"')
    if first_sample < 2:
        raise KernelFitError(f"first_sample: got {first_sample}, expected at least 2")
    if not (target_samples is None or target_samples > 0):
        raise KernelFitError(f"target_samples: got {target_samples}, expected above 0")
    blocks = _blocks(target_blocks, relief, bins, transposed=axis in ("y", 0))
    rng = np.random.default_rng(seed)
    if search == "exhaustive":
        found = kernel_search.exhaustive(grid)
    else:
        found = kernel_search.hierarchical(grid, first_sample=first_sample, rng=rng)
    with kernels.threads_for(500 * relief.places.size):
        return summarize_search(
            grid, found, search=search, target_samples=target_samples, target_blocks=blocks, rng=rng
        )


def _grid(name: str, values: ArrayLike, low: float, high: float) -> Float64Array:
    grid = np.array(values, np.float64).reshape(-1)
    if grid.size == 0 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
        raise KernelFitError(f"{name}: got {grid}, expected finite increasing values")
    if grid[0] < low or grid[-1] > high:
        raise KernelFitError(f"{name}: got {grid[0]}...{grid[-1]}, expected {low}...{high}")
    return grid


def _target(histogram: FloatArray, bins: int, *, transposed: bool) -> Float64Array:
    shares = np.asarray(histogram, np.float64)
    if shares.shape != (bins, bins):
        raise KernelFitError(f"target_histogram: got shape {shares.shape}, expected {(bins, bins)}")
    total = float(shares.sum())
    if not np.isfinite(shares).all() or (shares < 0).any() or not 1e-6 < total < 1 + 1e-6:
        raise KernelFitError(f"target_histogram: got a sum of {total:g}, expected shares up to 1")
    shares = shares.T if transposed else shares
    return np.append(shares.reshape(-1), max(1.0 - total, 0.0) if total < 1 - 1e-6 else 0.0)


def _blocks(
    counts: NDArray[np.integer] | None, relief: Relief, bins: int, *, transposed: bool
) -> Float64Array | None:
    """Return counts of the target by blocks of the relief, (blocks, bins ** 2 + 1)."""
    if counts is None:
        return None
    parts = np.asarray(counts, np.float64)
    shape = (relief.code.shape[0], relief.code.shape[1])
    expected = (*normal_blocks.grid_of(shape, normal_blocks.BLOCKS_PER_SIDE), bins, bins)
    if transposed and parts.ndim == 4:
        parts = parts.transpose(1, 0, 3, 2)
    if parts.shape != expected:
        raise KernelFitError(f"target_blocks: got shape {np.shape(counts)}, expected {expected}")
    if not np.isfinite(parts).all() or (parts < 0).any():
        raise KernelFitError("target_blocks: got counts that are not finite or below 0")
    flat = parts.reshape(expected[0] * expected[1], bins * bins)
    # beyond the limit nothing is in the target, either
    return np.append(flat, np.zeros((len(flat), 1)), axis=1)
