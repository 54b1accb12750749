"""Grow measured patches of skin to displacement maps of any size by image quilting.

A map is a grid of cells. Each gets a window of a patch: out of some random candidates, the one with
the cheapest cuts to its neighbors (image quilting: Efros and Freeman 2001,
doi:10.1145/383259.383296). So grooves continue across cells and slopes keep their distribution.
Cells are chosen in four groups by the parity of row and column, cuts are made cell by cell, and the
remaining steps of height at cuts are distributed over a neighborhood by a screened Poisson
equation, which keeps the slopes of both sides. All steps are local, and random numbers are hashes
of position and seed: the same seed gives the same bytes for any number of threads and any tiles in
any order.

Sites are blended with weights divided by the root of their sum of squares: so the sum of
uncorrelated reliefs keeps a variance between theirs (Heitz and Neyret 2018, doi:10.1145/3233304,
section 2).

Nagano et al. 2015 (doi:10.1145/2766894) cover faces by the synthesis of Graham et al. 2013
(doi:10.1111/cgf.12053), which is constrained by a coarser scan; this one is not.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from model.checks import Checks
from model.displacement_synthesis import cut_kernels, kernels
from model.displacement_synthesis.layout import CellGrid, Layout, SiteLayout
from model.displacement_synthesis.regions import coarse_weights, interpolate_weights
from model.displacement_synthesis.sources import PatchSources, SynthesisError, gather_sources

Wrap: TypeAlias = Literal["none", "u", "both"]
Patches: TypeAlias = Sequence[ArrayLike] | Mapping[str, Sequence[ArrayLike]]

MAX_SIDE_PX = 65_536
MAX_FILLED_FRACTION = 0.1
"""Largest fraction of a window's pixels without a measured height."""
SCALE_STEP = 1.04
"""Scales of one map are whole powers of this, so that features are at most 2 % off their size."""


def grow(
    patches: Patches,
    size_px: int | tuple[int, int],
    *,
    rng: np.random.Generator,
    regions: ArrayLike | None = None,
    out: Float32Array | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
    **knobs: Any,
) -> Float32Array:
    """Grow patches to a seamless displacement map.

    Parameters
    ----------
    patches : sequence of (H, W), or mapping of sites to such sequences
        Heights about zero, um (see :func:`leveled`); NaN: hole.
    size_px : int or (int, int)
        Rows and columns of the map, up to 65,536.
    rng
        Draws the seed: one number.
    regions : array_like, optional
        For patches by site: site at each position, (h, w) indices into the sites' order, -1: any;
        or weights (R, h, w) >= 0. Row 0 is row 0 of the map; any resolution.
    out : ndarray of float32, optional
        Where the map is written tile by tile, such as ``numpy.lib.format.open_memmap``'s;
        a map of 16,384 x 16,384 has 1 GB.
    progress : callable, optional
        Called with (finished tiles, all tiles).
    threads : int
        Threads to use, 1 to 64; they do not change the result.
    **knobs
        Of :func:`build_layout`: ``pixel_um``, ``patch_pixel_um``, ``wrap``, ``cells_px``,
        ``candidates``, ``range_px``, ``transition_px``.

    Returns
    -------
    ndarray of float32, shape ``size_px``
        Heights, um; ``out`` if it was given.

    Raises
    ------
    SynthesisError
        For patches, sizes, regions or knobs that nothing can be grown from.

    Notes
    -----
    A map ignores the islands of an atlas: where two of them meet on the skin, the map has a
    discontinuity (`model.displacement_synthesis.volume_noise` is not).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> patch = np.sin(np.arange(128.0) / 3.0)[:, None] + 0.1 * rng.standard_normal((128, 128))
    >>> grow([patch], 200, rng=rng).shape
    (200, 200)
    """
    layout = build_layout(patches, size_px, rng=rng, regions=regions, threads=threads, **knobs)
    target = np.empty(layout.shape, np.float32) if out is None else out
    check = Checks(SynthesisError)
    check.choice("out", target.dtype, (np.dtype(np.float32),))
    check.shape("out", target, layout.shape)

    def draw(place: tuple[int, int]) -> None:
        tile = layout.tile(*place)
        top, left = place
        target[top : top + tile.shape[0], left : left + tile.shape[1]] = tile

    places = list(layout.tiles())
    with ThreadPoolExecutor(threads) as pool:
        for done, _ in enumerate(pool.map(draw, places), 1):
            if progress is not None:
                progress(done, len(places))
    return target


def build_layout(
    patches: Patches,
    size_px: int | tuple[int, int],
    *,
    rng: np.random.Generator,
    regions: ArrayLike | None = None,
    pixel_um: float | ArrayLike = 10.0,
    patch_pixel_um: float = 10.0,
    wrap: Wrap = "none",
    cells_px: tuple[int, int] | None = None,
    candidates: int = 16,
    range_px: float | None = None,
    transition_px: float = 256.0,
    threads: int = 1,
) -> Layout:
    """Choose the windows and cuts of a map without drawing it.

    Parameters
    ----------
    patches, size_px, rng, regions, threads
        As of :func:`grow`.
    pixel_um : float or array_like, shape (h, w)
        Side of the map's pixels on the skin, um: one number, or a map of any resolution where it
        varies, as over an atlas; features then keep their size on the skin to 2 %, and heights
        stay as they are.
    patch_pixel_um : float
        Side of the patches' pixels, um.
    wrap : {"none", "u", "both"}
        Periodic directions of the map: none, left to right, or also top to bottom.
    cells_px : (int, int), optional
        Distance of cells, and overlap of neighbors (even, at most the distance), px of the map. By
        default a quarter and a twelfth of the smallest patch, at most 192 and 64.
    candidates : int
        Windows tried per cell, >= 1. More give better cuts but fewer distinct windows.
    range_px : float, optional
        Distance over which steps at cuts are closed; three eighths of the overlap by default.
    transition_px : float
        Width of the transition between sites, px; coarser regions blend over one of their pixels.

    Returns
    -------
    Layout

    Raises
    ------
    SynthesisError
        As of :func:`grow`.
    """
    shape = _shape(size_px)
    check = Checks(SynthesisError)
    check.choice("wrap", wrap, ("none", "u", "both"))
    check.within("candidates", candidates, "[1, inf)")
    check.within("threads", threads, "[1, 64]")
    for name, value in (("patch_pixel_um", patch_pixel_um), ("transition_px", transition_px)):
        check.within(name, value, "(0, inf)")
    by_site = dict(patches) if isinstance(patches, Mapping) else {"patches": patches}
    if not by_site:
        raise SynthesisError("patches: got no site, expected one at least")
    scales = check.numbers("pixel_um", pixel_um, (), ("h", "w"), interval="(0, inf)")
    sides = [min(np.shape(p), default=0) for each in by_site.values() for p in each]
    smallest = int(min(sides, default=0) * patch_pixel_um / scales.max())
    grid = _grid(shape, smallest, cells_px, wrap)
    levels, zooms = _levels(scales, patch_pixel_um, grid)
    range_px = 0.375 * grid.overlap if range_px is None else float(range_px)
    check.within("range_px", range_px, "[0.5, 512]")
    if regions is None and len(by_site) > 1:
        raise SynthesisError(f"regions: got None, expected where each of {len(by_site)} sites is")
    weights = None
    if regions is not None:
        weights = coarse_weights(regions, len(by_site), shape, transition_px=transition_px)
    seed = int(rng.integers(2**62))
    sites = []
    for number, (name, each) in enumerate(by_site.items()):
        sources = gather_sources(each, zooms, window=grid.window, name=f"patches of {name}")
        needed = None if weights is None else _find_needed_cells(weights[number], grid)
        knobs = (candidates, np.float32(0.25 / range_px**2), np.uint64(seed + 7919 * number))
        sites.append(_choose(sources, grid, levels, needed, knobs, threads))
    return Layout(grid=grid, sites=tuple(sites), weights=weights, range_px=range_px)


def _shape(size_px: int | tuple[int, int]) -> tuple[int, int]:
    size = (size_px, size_px) if isinstance(size_px, (int, np.integer)) else tuple(size_px)
    if len(size) != 2 or not all(1 <= n <= MAX_SIDE_PX for n in size):
        raise SynthesisError(f"size_px: got {size_px}, expected one or two of 1...{MAX_SIDE_PX}")
    return int(size[0]), int(size[1])


def _grid(
    shape: tuple[int, int], smallest: int, cells_px: tuple[int, int] | None, wrap: Wrap
) -> CellGrid:
    cell = max(8, min(192, smallest // 4))
    cell, overlap = cells_px or (cell, max(4, min(64, cell // 3 // 2 * 2)))
    if not (4 <= overlap <= cell and overlap % 2 == 0):
        raise SynthesisError(
            f"cells_px: got an overlap of {overlap}, expected an even number from 4 to {cell}"
        )
    wraps = (wrap == "both", wrap != "none")
    lines = []
    for size, around in zip(shape, wraps, strict=True):
        count = max(1, size // cell)
        if around:
            count -= count % 2  # neighbors differ in parity, also across a periodic edge
            if count < 2:
                raise SynthesisError(
                    f"size_px: got {size}, expected at least two cells of {cell} px where it wraps"
                )
        lines.append(np.asarray(np.arange(count + 1) * size // count, np.int64))
    longest = max(int(np.diff(line).max()) for line in lines)
    return CellGrid(lines[0], lines[1], overlap, longest + overlap, wraps)


def _levels(
    scales: Float64Array, patch_pixel_um: float, grid: CellGrid
) -> tuple[Int64Array, list[float]]:
    """Return the scale of each cell, and pixels of the map per pixel of a patch of each scale."""
    counts = (grid.lines_y.size - 1, grid.lines_x.size - 1)
    if scales.ndim == 0:
        return np.zeros(counts, np.int64), [patch_pixel_um / float(scales)]
    middles = [0.5 * (line[1:] + line[:-1]) / line[-1] for line in (grid.lines_y, grid.lines_x)]
    at = [
        np.minimum((m * n).astype(int), n - 1) for m, n in zip(middles, scales.shape, strict=True)
    ]
    powers = np.rint(np.log(scales[np.ix_(*at)]) / math.log(SCALE_STEP)).astype(np.int64)
    used, levels = np.unique(powers, return_inverse=True)
    zooms = [patch_pixel_um / SCALE_STEP ** float(power) for power in used]
    return levels.reshape(counts).astype(np.int64), zooms


def _find_needed_cells(weights: Float64Array, grid: CellGrid) -> BoolArray:
    """Return the cells in which a site is visible, with a margin of a cell."""
    shape = (int(grid.lines_y[-1]), int(grid.lines_x[-1]))
    found = np.empty((grid.lines_y.size - 1, grid.lines_x.size - 1), bool)
    for row in range(found.shape[0]):
        part = (int(grid.lines_y[row]), int(grid.lines_y[row + 1]))
        share = interpolate_weights(weights, shape, part, (0, shape[1]), wrap=grid.wrap)
        found[row] = np.maximum.reduceat(share.max(axis=0), grid.lines_x[:-1]) > 0
    for axis in (0, 1):
        found = found | np.roll(found, 1, axis) | np.roll(found, -1, axis)
    return found


def _choose(
    sources: PatchSources,
    grid: CellGrid,
    levels: Int64Array,
    needed: BoolArray | None,
    knobs: tuple[int, np.float32, np.uint64],
    threads: int,
) -> SiteLayout:
    """Choose windows in four groups and cut between them."""
    candidates, per_step, _ = knobs
    ny, nx = levels.shape
    site = SiteLayout(
        sources,
        cells=np.full((ny, nx, 4), -1, np.int64),
        across=np.full((ny, nx, grid.window), grid.overlap // 2, np.int16),
        down=np.full((ny, int(grid.lines_x[-1])), grid.overlap // 2, np.int16),
    )
    if needed is not None:
        site.cells[~needed, 0] = -2
    allowed = _max_filled_pixels(sources, grid.window)

    def choose(row: int, first: int, sides: bool, above: bool) -> None:
        kernels.choose_windows(row, first, sides, above, grid, levels, site, allowed, knobs)

    def cut_columns(row: int) -> None:
        cut_kernels.cut_columns(row, grid, site, per_step)

    def cut_rows(line: int) -> None:
        cut_kernels.cut_rows(line, grid, site, per_step)

    with ThreadPoolExecutor(threads) as pool:
        for parity, first, sides, above in (
            (0, 0, False, False),
            (0, 1, True, False),
            (1, 0, False, True),
            (1, 1, True, True),
        ):
            rows = range(parity, ny, 2)
            list(pool.map(choose, rows, *([v] * len(rows) for v in (first, sides, above))))
        if (site.cells[..., 0] == -1).any():
            raise SynthesisError(
                f"patches: got no window with at most {allowed} filled pixels in "
                f"{candidates * kernels.MAX_DRAWS} draws, expected fewer holes or more candidates"
            )
        list(pool.map(cut_columns, range(ny)))
        list(pool.map(cut_rows, range(0 if grid.wrap[0] else 1, ny)))
    return site


def _max_filled_pixels(sources: PatchSources, window: int) -> int:
    """Return the limit of filled pixels per window: their 5 % quantile over all windows.

    Raises
    ------
    SynthesisError
        When that is more than `MAX_FILLED_FRACTION` of a window.
    """
    most = 0
    for level in range(sources.level_first.size - 1):
        counts = []
        for _, high, wide, first, _ in sources.table[
            sources.level_first[level] : sources.level_first[level + 1]
        ]:
            sums = sources.filled[first : first + (high + 1) * (wide + 1)]
            s = sums.reshape(high + 1, wide + 1)
            inside = s[window:, window:] - s[:-window, window:] - s[window:, :-window]
            counts.append((inside + s[:-window, :-window]).reshape(-1))
        most = max(most, int(np.quantile(np.concatenate(counts), 0.05)))
    if most > MAX_FILLED_FRACTION * window**2:
        raise SynthesisError(
            f"patches: got holes of {100 * most / window**2:.0f} % of a window of {window} px even "
            f"in its best positions, expected at most {100 * MAX_FILLED_FRACTION:.0f} %: give "
            "patches with larger whole parts, or smaller cells_px"
        )
    return most
