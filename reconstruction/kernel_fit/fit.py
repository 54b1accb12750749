"""Fit the kernel that maps the normal distribution of a neutral relief to that of a strained one.

Eq. (7) of Nagano et al. 2015: over alpha in [-2, 1] by 0.01 and sigma in [1, 100] um by 0.5, the
neutral map is convolved along one axis with ``(1 - alpha) delta + alpha G(sigma)``, stretched, its
normals sorted into buckets, and the sum over buckets of the differences to a target minimized.
`neutral_relief` defines Gaussian, border, holes and slopes.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.microstructure import ALPHA_LIMITS
from reconstruction import normal_histogram
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.kernel_fit import search as kernel_search
from reconstruction.kernel_fit.neutral_relief import (
    Axis,
    KernelFitError,
    NeutralRelief,
    prepare_relief,
)
from reconstruction.kernel_fit.outcome import KernelFit, summarize_search
from reconstruction.kernel_fit.search import KernelGrid, TargetBuckets
from reconstruction.normal_histogram import blocks as normal_blocks
from reconstruction.normal_histogram import kernels

ALPHA_GRID = np.round(np.linspace(*ALPHA_LIMITS, 301), 2)
"""The paper's grid of strengths, by 0.01."""
SIGMAS_UM = np.linspace(1.0, 100.0, 199)
"""The paper's grid of standard deviations, by 0.5 um."""
BUCKET_LIMIT = 1.0
"""Buckets span all components of normals."""


@dataclass(frozen=True, slots=True)
class KernelSearch:
    """Settings of the search over the grid.

    Attributes
    ----------
    method : {"hierarchical", "exhaustive"}
        "hierarchical" returns the result of "exhaustive", except with a probability of 1e-6
        (`kernel_fit.search`), in a fraction of the time.
    first_sample : int
        Pixels in the first sample of the hierarchical search.
    seed : int
        Seed of its samples, and of the draws for the standard errors.
    """

    method: Literal["hierarchical", "exhaustive"] = "hierarchical"
    first_sample: int = kernel_search.FIRST_SAMPLE_PIXELS
    seed: int = 0


def fit_kernel(
    neutral_height_um: ArrayLike,
    target_histogram: FloatArray,
    *,
    stretch: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    bins: int = 64,
    search: KernelSearch = KernelSearch(),
    stretch_across: float = 1.0,
    valid: ArrayLike | None = None,
    target_samples: float | None = None,
    target_blocks: NDArray[np.integer] | None = None,
    grid: tuple[ArrayLike, ArrayLike] = (ALPHA_GRID, SIGMAS_UM),
) -> KernelFit:
    """Fit the kernel of one axis and stretch ratio: eq. (7).

    Parameters
    ----------
    neutral_height_um : array_like, shape (H, W)
        Displacement map of the neutral skin, um; row 0 is the top. Heights that are not finite
        count as not valid.
    target_histogram : ndarray, shape (bins, bins)
        Fractions of the strained skin's normals, axes (n_y, n_x), of `normal_histogram.histogram`;
        they sum to 1, or to less where normals beyond the limit are counted in the whole.
    stretch : float
        The skin's ratio r of lengths along the axis, > 0.
    axis : {"x", "y", 1, 0}
        Axis of the jaws: columns (x, 1) or rows (y, 0).
    pixel_um : float or (float, float)
        Side of a neutral pixel, or its height and width, um.
    bins : int
        See `normal_histogram.histogram`.
    search : KernelSearch
        Settings of the search.
    stretch_across : float
        Ratio of lengths across the axis; 1 as in the paper.
    valid : ndarray of bool, shape (H, W), optional
    target_samples : float, optional
        Effective number of samples of the target (`NormalStatistics.effective_samples`); by default
        that of the neutral relief. It affects `noise` and standard errors only.
    target_blocks : ndarray of int, shape (rows, columns, bins, bins), optional
        For a target of the same piece of skin: its counts in the skin of each block of the neutral
        map (`normal_blocks.grid_of`, `normal_blocks.block_counts`). It affects standard errors
        only.
    grid : (array_like, array_like)
        Strengths alpha, increasing, within [-2, 1], and standard deviations, um, increasing, > 0;
        the paper's by default.

    Returns
    -------
    KernelFit
        Equal distances go to the gentlest kernel: least |alpha|, then least sigma, then blurring.

    Raises
    ------
    KernelFitError
        For shapes, ranges or sums that do not fit, or a relief without slopes.
    HistogramError
        For bins that make no histogram.
    """
    check = Checks(KernelFitError)
    normal_histogram.check_buckets(bins, BUCKET_LIMIT)
    target = _target(target_histogram, bins, transposed=axis in ("y", 0))
    relief = prepare_relief(
        neutral_height_um,
        stretch=stretch,
        axis=axis,
        pixel_um=pixel_um,
        stretch_across=stretch_across,
        valid=valid,
    )
    tried = KernelGrid(
        relief,
        TargetBuckets(target, bins, BUCKET_LIMIT),
        _grid("alphas", grid[0], str(list(ALPHA_LIMITS))),
        _grid("sigmas_um", grid[1], "[1e-9, inf)"),
    )
    check.choice("search", search.method, ("hierarchical", "exhaustive"))
    check.within("first_sample", search.first_sample, "[2, inf)")
    check.within("target_samples", 1 if target_samples is None else target_samples, "(0, inf]")
    blocks = _blocks(target_blocks, relief, bins, transposed=axis in ("y", 0))
    rng = np.random.default_rng(search.seed)
    if search.method == "exhaustive":
        found = kernel_search.search_exhaustively(tried)
    else:
        found = kernel_search.search_hierarchically(
            tried, first_sample=search.first_sample, rng=rng
        )
    behind: dict[str, Any] = {"target_samples": target_samples, "target_blocks": blocks}
    with kernels.limit_threads(500 * relief.places.size):
        return summarize_search(tried, found, search=search.method, **behind, rng=rng)


def _grid(name: str, values: ArrayLike, interval: str) -> Float64Array:
    grid = np.array(values, np.float64).reshape(-1)
    check = Checks(KernelFitError)
    check.within(name, grid, interval)
    check.require(grid.size and (np.diff(grid) > 0).all(), name, grid, "increasing values")
    return grid


def _target(histogram: FloatArray, bins: int, *, transposed: bool) -> Float64Array:
    check = Checks(KernelFitError)
    shares = check.numbers("target_histogram", histogram, (bins, bins), interval="[0, inf)")
    total = float(shares.sum())
    check.within("sum of target_histogram", total, "(1e-6, 1.000001)")
    shares = shares.T if transposed else shares
    return np.append(shares.reshape(-1), max(1.0 - total, 0.0) if total < 1 - 1e-6 else 0.0)


def _blocks(
    counts: NDArray[np.integer] | None, relief: NeutralRelief, bins: int, *, transposed: bool
) -> Float64Array | None:
    """Return counts of the target by blocks of the relief, (blocks, bins ** 2 + 1)."""
    if counts is None:
        return None
    parts = np.asarray(counts, np.float64)
    grid = normal_blocks.block_grid_shape(relief.code.shape)
    if transposed and parts.ndim == 4:
        parts = parts.transpose(1, 0, 3, 2)
    check = Checks(KernelFitError)
    flat = check.numbers("target_blocks", parts, (*grid, bins, bins), interval="[0, inf)")
    flat = flat.reshape(grid[0] * grid[1], bins * bins)
    # the target's normals beyond the limit are not in its blocks: their counts are 0
    return np.append(flat, np.zeros((len(flat), 1)), axis=1)
