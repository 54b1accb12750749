"""The convolution kernel that makes a neutral relief's normals distributed as a strained one's.

Eq. (7) of Nagano et al. 2015: over alpha in [-2, 1] by 0.01 and sigma in [1, 100] um by 0.5, the
neutral map is convolved along one axis with ``(1 - alpha) delta + alpha G(sigma)``, stretched, its
normals sorted into buckets, and the sum over buckets of the differences to a target minimised.

What is fixed, here and in `model.microstructure`:

- G is the continuous Gaussian at whole pixels within 4 sigmas, divided by its sum. Well below a
  pixel it is the delta function: then alpha means nothing, and all such kernels are tied.
- At the map's border the relief is mirrored about the edges of the outermost pixels.
- Holes are filled linearly along the axis before the convolution; a pixel of a hole is no sample.
- Stretching divides slopes along the axis by r, and those across it by ``stretch_across``.
- Normals come from central differences, one-sided where one neighbour is missing
  (`normal_histogram.slopes`), in single precision: of 10,000 samples fewer than one comes into
  another bucket than in double precision.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.microstructure import ALPHA_LIMITS
from reconstruction import kernel_errors, kernel_search, normal_histogram
from reconstruction import kernel_fit_kernels as kernels
from reconstruction.kernel_search import Buckets, Found, Relief

Floats = NDArray[np.float64]
Axis = Literal["x", "y", 0, 1]

ALPHAS = np.round(np.linspace(*ALPHA_LIMITS, 301), 2)
"""The paper's grid of strengths, by 0.01."""
SIGMAS_UM = np.linspace(1.0, 100.0, 199)
"""The paper's grid of standard deviations, by 0.5 um."""
FINER_ALPHA, FINER_SIGMA = 10, 5
"""The refinement's steps are so much smaller than the grid's, within one step to either side."""
STARTS = ((0.0, 1.0), (0.6, 15.0), (-0.6, 15.0), (1.0, 30.0), (-1.5, 8.0))
"""alpha and sigma_um across the jaws that fits of both axes begin with."""


class KernelFitError(ValueError):
    """A relief, target or setting that no kernel can be fitted to."""


@dataclass(frozen=True, slots=True)
class KernelFit:
    """A kernel of eq. (6) for one axis and stretch, and how well it is told.

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
        that a hierarchical search dropped are estimates from a sample.
    valid : bool
        There is a minimum: distances over the grid differ by more than `noise`.
    noise : float
        Standard error of the distance, from the effective numbers of samples of both histograms.
    floor : float
        Mean distance of two histograms of one surface with such numbers of samples.
    distance_before : float
        Eq. (7)'s sum for the neutral relief, only stretched.
    alpha_refined, sigma_refined_um, distance_refined : float
        The best on a grid finer by ten in alpha and five in sigma, a step to either side.
    alpha_stderr, sigma_stderr_um : float
        How far the best moves in 68 % of cases when both histograms are drawn anew, with the
        scatter that blocks of the map show, neighbors together: what another patch of the same
        skin and size would change; at least a grid step over sqrt(12). Infinite where not `valid`.
        With `target_blocks` both are drawn together, as of one piece of skin; else as if the
        target were of other skin. alpha and sigma make up for one another, so that their errors
        are not Gaussian.
    alpha_95, sigma_95_um : float
        Half widths of 95 % intervals, of the same draws; at least 1.96 standard errors. More where
        a long valley leads some draws far away.
    alpha_interval, sigma_interval_um : tuple of float
        Least and largest of `near_best`.
    at_edge : bool
        The best kernel is at an end of the grid in alpha or sigma.
    aliased : bool
        Too few samples for the buckets (`normal_histogram.SAMPLES_PER_BUCKET`).
    samples : int
        Slopes of the neutral relief.
    effective_samples : float
        Independent samples that would be as noisy.
    search : str
        "exhaustive" or "hierarchical".
    miss_probability : float
        Chance at most that the exhaustive search's result is another one.
    passes : float
        Kernels evaluated, in units of all pixels; 59,899 for an exhaustive search.
    reason : str
        Why not `valid`; empty otherwise.
    """

    alpha: float
    sigma_um: float
    distance: float
    near_best: Floats
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
        As of :func:`fit_kernel`.

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
    code = normal_histogram.stencil(height, valid)
    if not code.any():
        raise KernelFitError("neutral_height_um: got no pixel with a slope, expected at least one")
    good = np.isfinite(height)
    if valid is not None:
        good &= np.asarray(valid, bool)
    down, right = normal_histogram.pixel_sides(pixel_um)
    if along_y:
        height, good = height.T, good.T
        code = normal_histogram.stencil(np.ascontiguousarray(height), good)
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
    """Return the histogram that :func:`fit_kernel` compares with its target, (bins, bins).

    Axes (n_y, n_x); the shares of all samples, so that what is beyond the limit is missing from
    the sum. Parameters as of :func:`fit_kernel`.
    """
    relief = relief_of(
        neutral_height_um, stretch=stretch, axis=axis, pixel_um=pixel_um,
        stretch_across=stretch_across, valid=valid, y_up=y_up,
    )  # fmt: skip
    normal_histogram.check_buckets(bins, limit)
    buckets = Buckets(np.zeros(bins * bins + 1), bins, limit)
    change = relief.change(sigma_um)
    counts = buckets.count((relief.along, relief.across), change, np.array([alpha])).sum(axis=0)[0]
    shares = counts[:-1].reshape(bins, bins) / relief.places.size
    return shares.T if axis in ("y", 0) else shares


def fit_kernel(
    neutral_height_um: NDArray[np.floating],
    target_histogram: NDArray[np.floating],
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
    neutral_height_um : ndarray, shape (H, W)
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
        neutral map (`normal_histogram.grid_of`, `normal_histogram.block_counts`), for standard
        errors only.
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
    """
    normal_histogram.check_buckets(bins, limit)
    target = _target(target_histogram, bins, transposed=axis in ("y", 0))
    relief = relief_of(
        neutral_height_um, stretch=stretch, axis=axis, pixel_um=pixel_um,
        stretch_across=stretch_across, valid=valid, y_up=y_up,
    )  # fmt: skip
    return fit_relief(
        relief, Buckets(target, bins, float(limit)), ALPHAS if alphas is None else alphas,
        SIGMAS_UM if sigmas_um is None else sigmas_um, search=search,
        target_samples=target_samples, first_sample=first_sample, seed=seed,
        target_blocks=_blocks(target_blocks, relief, bins, transposed=axis in ("y", 0)),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class TwoAxisFit:
    """Kernels along and across the jaws, which the paper fits one at a time.

    Attributes
    ----------
    along, across : KernelFit
        Each is the best with the other as it is; their `distance` is that of both together,
        `distance_before` that of the other alone.
    distance : float
        Eq. (7)'s sum with both kernels.
    rounds : int
        Pairs of fits that were made.
    settled : bool
        Neither kernel changed in the last round: each is the best beside the other. A pair far
        away that no start leads to may be better.
    """

    along: KernelFit
    across: KernelFit
    distance: float
    rounds: int
    settled: bool


def fit_two_axes(
    neutral_height_um: NDArray[np.floating],
    target_histogram: NDArray[np.floating],
    *,
    stretch: float,
    stretch_across: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    valid: ArrayLike | None = None,
    most_rounds: int = 6,
    starts: Sequence[tuple[float, float]] = STARTS,
    **settings: Any,
) -> TwoAxisFit:
    """Fit (alpha, sigma) along the jaws and across them, in turn until neither changes.

    Parameters
    ----------
    neutral_height_um, target_histogram, stretch, stretch_across, axis, pixel_um, valid
        As of :func:`fit_kernel`; the axis is that of the jaws.
    most_rounds : int
        Rounds of one fit along and one across, at least 1, from each start.
    starts : sequence of (float, float)
        alpha and sigma_um across the jaws to begin with; the least distance is taken.
    settings
        Others of :func:`fit_kernel`.
    """
    if most_rounds < 1 or not starts:
        raise KernelFitError(f"most_rounds: got {most_rounds}, expected at least 1, and a start")
    other: Axis = "x" if axis in ("y", 0) else "y"
    best: TwoAxisFit | None = None
    for start in starts:
        pair = [(0.0, 1.0), (float(start[0]), float(start[1]))]
        before: list[tuple[float, float]] = []
        fits: list[KernelFit] = []
        rounds = 0
        while rounds < most_rounds and pair != before:
            before, fits = list(pair), []
            rounds += 1
            for turn, (own, across) in enumerate(((axis, other), (other, axis))):
                ratios = (stretch, stretch_across) if turn == 0 else (stretch_across, stretch)
                relief = convolved(
                    neutral_height_um, *pair[1 - turn], axis=across, pixel_um=pixel_um, valid=valid
                )
                fit = fit_kernel(
                    relief, target_histogram, stretch=ratios[0], stretch_across=ratios[1],
                    axis=own, pixel_um=pixel_um, valid=valid, **settings,
                )  # fmt: skip
                pair[turn] = fit.alpha, fit.sigma_um
                fits.append(fit)
        found = TwoAxisFit(fits[0], fits[1], fits[1].distance, rounds, pair == before)
        if best is None or found.distance < best.distance:
            best = found
    assert best is not None  # noqa: S101
    return best


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


def _grid(name: str, values: ArrayLike, low: float, high: float) -> Floats:
    grid = np.array(values, np.float64).reshape(-1)
    if grid.size == 0 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
        raise KernelFitError(f"{name}: got {grid}, expected finite increasing values")
    if grid[0] < low or grid[-1] > high:
        raise KernelFitError(f"{name}: got {grid[0]}...{grid[-1]}, expected {low}...{high}")
    return grid


def _target(histogram: NDArray[np.floating], bins: int, *, transposed: bool) -> Floats:
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
) -> Floats | None:
    """Return counts of the target by blocks of the relief, (blocks, bins ** 2 + 1)."""
    if counts is None:
        return None
    parts = np.asarray(counts, np.float64)
    shape = (relief.code.shape[0], relief.code.shape[1])
    expected = (*normal_histogram.grid_of(shape, normal_histogram.BLOCKS), bins, bins)
    if transposed and parts.ndim == 4:
        parts = parts.transpose(1, 0, 3, 2)
    if parts.shape != expected:
        raise KernelFitError(f"target_blocks: got shape {np.shape(counts)}, expected {expected}")
    if not np.isfinite(parts).all() or (parts < 0).any():
        raise KernelFitError("target_blocks: got counts that are not finite or below 0")
    flat = parts.reshape(expected[0] * expected[1], bins * bins)
    # beyond the limit nothing is in the target, either
    return np.append(flat, np.zeros((len(flat), 1)), axis=1)


def fit_relief(
    relief: Relief,
    buckets: Buckets,
    alphas: ArrayLike,
    sigmas_um: ArrayLike,
    *,
    search: Literal["hierarchical", "exhaustive"],
    target_samples: float | None,
    first_sample: int,
    seed: int,
    target_blocks: Floats | None = None,
) -> KernelFit:
    """Fit the kernel of a prepared relief; parameters and errors as of :func:`fit_kernel`.

    The counts of `target_blocks` have the shape (blocks, bins ** 2 + 1), axes as of the relief.
    """
    strengths = _grid("alphas", alphas, *ALPHA_LIMITS)
    widths = _grid("sigmas_um", sigmas_um, 1e-9, math.inf)
    if search not in ("hierarchical", "exhaustive"):
        raise KernelFitError(f'search: got {search!r}, expected "hierarchical" or "exhaustive"')
    if first_sample < 2:
        raise KernelFitError(f"first_sample: got {first_sample}, expected at least 2")
    if not (target_samples is None or target_samples > 0):
        raise KernelFitError(f"target_samples: got {target_samples}, expected above 0")
    rng = np.random.default_rng(seed)
    if search == "exhaustive":
        found = kernel_search.exhaustive(relief, buckets, strengths, widths)
    else:
        found = kernel_search.hierarchical(
            relief, buckets, strengths, widths, first_sample=first_sample, rng=rng
        )
    with kernels.threads_for(500 * relief.places.size):
        return _described(
            relief, buckets, strengths, widths, found, search, target_samples, target_blocks, rng
        )


def _described(
    relief: Relief, buckets: Buckets, alphas: Floats, sigmas_um: Floats, found: Found, search: str,
    target_samples: float | None, target_blocks: Floats | None, rng: np.random.Generator,
) -> KernelFit:  # fmt: skip
    """Return what a search found, with its noise, its valley and a finer minimum."""
    start = relief.along, relief.across
    samples = relief.places.size
    still = np.zeros(samples, np.float32)
    before = float(buckets.distances(start, (still, still), np.zeros(1))[0])
    i, j = found.best
    alpha, sigma, distance = float(alphas[j]), float(sigmas_um[i]), float(found.distance[i, j])
    blocks = kernel_errors.of_kernel(relief, buckets, alpha, sigma)
    effective, occupied = blocks.effective_samples, blocks.occupied
    theirs = effective if target_samples is None else float(target_samples)
    noise = blocks.noise(buckets.target, theirs)
    floor = normal_histogram.noise_floor(buckets.target, effective, theirs)
    rows, columns = kernel_errors.nearly_as_good(found, alphas, sigmas_um, noise).T
    near = np.stack([alphas[columns], sigmas_um[rows], found.distance[rows, columns]], axis=1)
    reason = ""
    if np.ptp(relief.along) == 0.0 and np.ptp(relief.across) == 0.0:
        reason = "the neutral relief is flat: every kernel leaves it so"
    elif occupied == 1 and np.count_nonzero(buckets.target) == 1 and distance in (0.0, 2.0):
        reason = "one bucket holds everything"
    elif float(found.distance.max()) - distance <= noise:
        reason = "the distance does not depend on the kernel beyond its noise"
    refined = (alpha, sigma, distance)
    told = kernel_errors.HalfWidths((math.inf, math.inf), (math.inf, math.inf))
    if not reason:
        refined = _refined(relief, buckets, alphas, sigmas_um, (i, j), distance)
        pair = None
        if target_blocks is not None:
            pair = kernel_errors.widths_of_pair(
                relief, buckets, found, alphas, sigmas_um,
                noise=noise, target_blocks=target_blocks, growth=blocks.growth, rng=rng,
            )  # fmt: skip
        told = pair or kernel_errors.widths_of_best(
            relief, buckets, found, alphas, sigmas_um,
            noise=noise, scatter=blocks.scatter(theirs), rng=rng,
        )  # fmt: skip
        told = kernel_errors.of_grid(told, alphas, sigmas_um)
    return KernelFit(
        alpha=alpha if not reason else 0.0,
        sigma_um=sigma,
        distance=distance if not reason else before,
        near_best=near,
        valid=not reason,
        noise=noise,
        floor=floor,
        distance_before=before,
        alpha_refined=refined[0] if not reason else 0.0,
        sigma_refined_um=refined[1],
        distance_refined=refined[2] if not reason else before,
        alpha_stderr=told.alpha[0],
        sigma_stderr_um=told.sigma_um[0],
        alpha_95=told.alpha[1],
        sigma_95_um=told.sigma_um[1],
        alpha_interval=(float(near[:, 0].min()), float(near[:, 0].max())),
        sigma_interval_um=(float(near[:, 1].min()), float(near[:, 1].max())),
        at_edge=i in (0, sigmas_um.size - 1) or j in (0, alphas.size - 1),
        aliased=samples / occupied < normal_histogram.SAMPLES_PER_BUCKET,
        samples=samples,
        effective_samples=effective,
        search=search,
        miss_probability=0.0 if found.exact.all() else kernel_search.MISS,
        passes=found.passes,
        reason=reason,
    )


def _refined(
    relief: Relief, buckets: Buckets, alphas: Floats, sigmas: Floats, best: tuple[int, int],
    distance: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the best of a finer grid that spans one step to either side, within the grid."""
    i, j = best
    result = (float(alphas[j]), float(sigmas[i]), distance)
    fine_alpha = _finer(alphas, j, FINER_ALPHA)
    for sigma in _finer(sigmas, i, FINER_SIGMA):
        change = relief.change(float(sigma))
        found = buckets.distances((relief.along, relief.across), change, fine_alpha)
        k = int(np.argmin(found))
        if found[k] < result[2] - kernel_search.TIE:
            result = (float(fine_alpha[k]), float(sigma), float(found[k]))
    return result


def _finer(grid: Floats, i: int, finer: int) -> Floats:
    low, high = grid[max(i - 1, 0)], grid[min(i + 1, grid.size - 1)]
    steps = finer * (int(i > 0) + int(i < grid.size - 1))
    return np.linspace(low, high, steps + 1)
