"""Summarize the search for a kernel: the kernel with its noise, its valley and a finer minimum."""

import math
from dataclasses import dataclass

import numpy as np

from reconstruction import normal_histogram
from reconstruction.arrays import Float64Array
from reconstruction.kernel_fit import errors as kernel_errors
from reconstruction.kernel_fit import search as kernel_search
from reconstruction.kernel_fit.search import KernelGrid, KernelSearchResult
from reconstruction.normal_histogram.statistics import SAMPLES_PER_BUCKET

FINER_ALPHA, FINER_SIGMA = 10, 5
"""Steps of the refinement per grid step, within one step to either side."""


@dataclass(frozen=True, slots=True)
class KernelFit:
    """A kernel of eq. (6) for one axis and stretch, with its errors.

    Attributes
    ----------
    alpha : float
        Strength, the grid's best; 0 where not `valid`.
    sigma_um : float
        Standard deviation, um, the grid's best.
    distance : float
        Eq. (7)'s sum over buckets at the best kernel, 0...2.
    near_best : ndarray of float64, shape (K, 3)
        alpha, sigma_um and distance of the kernels whose distance is within `noise` of the best,
        the best first, then by distance: the flat valley around the minimum. Distances of kernels
        that a hierarchical search excluded are estimates from a sample.
    valid : bool
        There is a minimum: distances over the grid differ by more than `noise`.
    noise : float
        Standard error of the distance, from the effective numbers of samples of both histograms.
    floor : float
        Mean distance of two histograms of one surface with these numbers of samples.
    distance_before : float
        Eq. (7)'s sum for the neutral relief, stretched but not convolved.
    alpha_refined, sigma_refined_um, distance_refined : float
        The best on a grid finer by ten in alpha and five in sigma, a step to either side.
    alpha_stderr, sigma_stderr_um : float
        Move of the best kernel that 68 % of draws stay within. Histograms are drawn with the
        scatter between blocks of the map, with their correlation: the deviation of another patch
        of the same skin and size; at least a grid step over sqrt(12). Infinite where not `valid`.
        With `target_blocks` both are drawn together, as of one piece of skin; otherwise as if the
        target were of other skin. alpha and sigma compensate each other, so that their errors
        are not Gaussian.
    alpha_95, sigma_95_um : float
        Half widths of 95 % intervals, of the same draws; at least 1.96 standard errors, more where
        a long valley leads some draws far away.
    alpha_interval, sigma_interval_um : tuple of float
        Least and largest of `near_best`.
    at_edge : bool
        The best kernel is at an end of the grid in alpha or sigma.
    aliased : bool
        Too few samples for the buckets (`normal_statistics.SAMPLES_PER_BUCKET`).
    samples : int
        Slopes of the neutral relief.
    effective_samples : float
        Number of independent samples with the same noise.
    search : str
        "exhaustive" or "hierarchical".
    miss_probability : float
        Upper bound of the probability that the exhaustive search's result differs.
    passes : float
        Kernels evaluated, in units of all pixels; 59,899 for an exhaustive search.
    reason : str
        Why not `valid`; empty otherwise.
    """

    alpha: float
    sigma_um: float
    distance: float
    near_best: Float64Array
    valid: bool
    noise: float
    floor: float
    distance_before: float
    alpha_refined: float
    sigma_refined_um: float
    distance_refined: float
    alpha_stderr: float
    sigma_stderr_um: float
    alpha_95: float
    sigma_95_um: float
    alpha_interval: tuple[float, float]
    sigma_interval_um: tuple[float, float]
    at_edge: bool
    aliased: bool
    samples: int
    effective_samples: float
    search: str
    miss_probability: float
    passes: float
    reason: str = ""


def summarize_search(
    grid: KernelGrid,
    search_result: KernelSearchResult,
    *,
    search: str,
    target_samples: float | None,
    target_blocks: Float64Array | None,
    rng: np.random.Generator,
) -> KernelFit:
    """Summarize a search: the best kernel with its noise, its valley and a finer minimum.

    Parameters
    ----------
    grid, search_result
        The search's grid and result.
    search : str
        Its name.
    target_samples : float or None
        Effective number of samples of the target; None: that of the relief.
    target_blocks : ndarray, shape (blocks, bins ** 2 + 1), or None
        Counts of the target in the skin of each block of the relief, if it is of the same piece of
        skin.
    rng
        Draws histograms for the standard errors.
    """
    relief, target = grid.relief, grid.buckets.target
    alphas, sigmas_um = grid.alphas, grid.sigmas_um
    samples = relief.places.size
    before = float(grid.distances(sigmas_um[0], np.zeros(1))[0])
    i, j = search_result.best
    alpha, sigma, distance = (
        float(alphas[j]),
        float(sigmas_um[i]),
        float(search_result.distance[i, j]),
    )
    blocks = kernel_errors.count_blocks(grid, alpha, sigma)
    effective, occupied = blocks.effective_samples, blocks.occupied
    theirs = effective if target_samples is None else float(target_samples)
    noise = blocks.distance_stderr(target, theirs)
    floor = normal_histogram.noise_floor(target, effective, theirs)
    rows, columns = kernel_errors.near_best_kernels(grid, search_result, noise).T
    near = np.stack(
        [alphas[columns], sigmas_um[rows], search_result.distance[rows, columns]], axis=1
    )
    reason = ""
    if np.ptp(relief.along) == 0.0 and np.ptp(relief.across) == 0.0:
        reason = "the neutral relief is flat: no kernel changes it"
    elif occupied == 1 and np.count_nonzero(target) == 1 and distance in (0.0, 2.0):
        reason = "all normals are in one bucket"
    elif float(search_result.distance.max()) - distance <= noise:
        reason = "the distance does not depend on the kernel beyond its noise"
    if reason:
        alpha, distance = 0.0, before
        refined = (alpha, sigma, distance)
        widths = kernel_errors.HalfWidths((math.inf, math.inf), (math.inf, math.inf))
    else:
        refined = _refined(grid, (i, j), distance)
        draws = kernel_errors.HistogramResampling(grid, search_result, noise, rng)
        pair = target_blocks is not None and draws.paired_widths(
            target_blocks, blocks.variance_inflation
        )
        widths = pair or draws.best_kernel_widths(blocks.block_contributions(theirs))
        widths = kernel_errors.add_grid_error(widths, grid)
    return KernelFit(
        alpha=alpha,
        sigma_um=sigma,
        distance=distance,
        near_best=near,
        valid=not reason,
        noise=noise,
        floor=floor,
        distance_before=before,
        alpha_refined=refined[0],
        sigma_refined_um=refined[1],
        distance_refined=refined[2],
        alpha_stderr=widths.alpha[0],
        sigma_stderr_um=widths.sigma_um[0],
        alpha_95=widths.alpha[1],
        sigma_95_um=widths.sigma_um[1],
        alpha_interval=(float(near[:, 0].min()), float(near[:, 0].max())),
        sigma_interval_um=(float(near[:, 1].min()), float(near[:, 1].max())),
        at_edge=i in (0, sigmas_um.size - 1) or j in (0, alphas.size - 1),
        aliased=samples / occupied < SAMPLES_PER_BUCKET,
        samples=samples,
        effective_samples=effective,
        search=search,
        miss_probability=0.0 if search_result.exact.all() else kernel_search.MAX_MISS_PROBABILITY,
        passes=search_result.passes,
        reason=reason,
    )


def _refined(
    grid: KernelGrid, best: tuple[int, int], distance: float
) -> tuple[float, float, float]:
    """Return the best of a finer grid that spans one step to either side, within the grid."""
    i, j = best
    result = (float(grid.alphas[j]), float(grid.sigmas_um[i]), distance)
    fine_alpha = _finer(grid.alphas, j, FINER_ALPHA)
    for sigma in _finer(grid.sigmas_um, i, FINER_SIGMA):
        found = grid.distances(sigma, fine_alpha)
        k = int(np.argmin(found))
        if found[k] < result[2] - kernel_search.TIE_TOL:
            result = (float(fine_alpha[k]), float(sigma), float(found[k]))
    return result


def _finer(grid: Float64Array, i: int, finer: int) -> Float64Array:
    low, high = grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)]
    steps = finer * (int(i > 0) + int(i < grid.size - 1))
    return np.linspace(low, high, steps + 1)
