"""Inner loops of displacement synthesis: choosing windows, cutting between them, laying them down.

Kernels are serial and release the lock, so that threads may run them side by side; each writes
only what its caller gave it. Chance is a hash of place and seed, never a state, so that results do
not depend on the order of calls.

Windows are told by the index of their first pixel in one flat array of all sources. There is a
second array with every source transposed, so that a cut that runs along a row is found like one
that runs along a column.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

from model.displacement_synthesis.cut_kernels import cell_of, cut_cost, place_in_row

MAX_DRAWS = 24
"""Places drawn before a window with too many filled pixels is given up for another candidate."""


@njit(cache=True, nogil=True)
def mixed(key):
    """Return 64 bits that depend on every bit of ``key`` (the finalizer of splitmix64)."""
    z = np.uint64(key) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True)
def _uniform(key):
    return float(mixed(key) >> np.uint64(11)) * 2.0**-53


@njit(cache=True, nogil=True)
def _drawn(key, sources, filled, window, most_filled):
    """Return (source, row, column) of a window with few filled pixels; source -1: none found.

    Places are drawn as if windows might stand out of the source by half their size, and are then
    moved inside: pixels near its border are so used almost as often as those of the middle.
    """
    for attempt in range(MAX_DRAWS):
        at = mixed(key + np.uint64(attempt))
        total = 0
        for k in range(sources.shape[0]):
            total += sources[k, 1] * sources[k, 2]
        share = _uniform(at) * total
        chosen = sources.shape[0] - 1
        for k in range(sources.shape[0]):
            share -= sources[k, 1] * sources[k, 2]
            if share < 0.0:
                chosen = k
                break
        high, wide = sources[chosen, 1], sources[chosen, 2]
        y = int(_uniform(at + np.uint64(1)) * high) - window // 2
        x = int(_uniform(at + np.uint64(2)) * wide) - window // 2
        y = min(max(y, 0), high - window)
        x = min(max(x, 0), wide - window)
        first = sources[chosen, 3] + y * (wide + 1) + x
        down = window * (wide + 1)
        count = filled[first + down + window] - filled[first + down]
        count -= filled[first + window] - filled[first]
        if count <= most_filled:
            return chosen, y, x
    return -1, 0, 0


@njit(cache=True, nogil=True, error_model="numpy")
def choose_windows(
    row,
    first_column,
    cells,
    lines_y,
    lines_x,
    neighbours_x,
    neighbours_y,
    wrap_x,
    wrap_y,
    window,
    overlap,
    levels,
    level_first,
    sources,
    heights,
    turned,
    filled,
    most_filled,
    candidates,
    seed,
    per_step,
):
    """Choose windows for every other cell of a row, by the cheapest cuts to neighbours there.

    Parameters
    ----------
    row, first_column : int
        Cells (row, first_column), (row, first_column + 2), ...
    cells : (ny, nx, 4) int64, written
        Source, row and column of the window in it, filled pixels; source -1: not chosen yet or,
        after the call, no window was to be had; -2: no cell is needed here.
    lines_y, lines_x : (ny + 1,), (nx + 1,) int64
        Where cells begin on the map.
    neighbours_x, neighbours_y : bool
        Whether windows beside, and above and below, are chosen already.
    wrap_x, wrap_y : bool
    window, overlap : int
    levels : (ny, nx) int64
        Scale of each cell.
    level_first : (L + 1,) int64
        Sources of scale l are those from level_first[l] to before level_first[l + 1].
    sources : (S, 5) int64
        First pixel in ``heights``, height, width, first entry in ``filled``, first pixel in
        ``turned`` (where height and width are exchanged).
    heights, turned : (N,) float32
    filled : (M,) int32
        Summed-area tables of the pixels that were filled.
    most_filled : int
        Filled pixels of a window.
    candidates : int
    seed : uint64
    per_step : float32

    Returns
    -------
    float
        Sum of the costs of cuts.
    """
    ny, nx = levels.shape
    total = 0.0
    for column in range(first_column, nx, 2):
        if cells[row, column, 0] == -2:
            continue
        level = levels[row, column]
        own = sources[level_first[level] : level_first[level + 1]]
        key = mixed(seed ^ mixed(np.uint64(row) * np.uint64(1 << 24) + np.uint64(column)))
        best = np.inf
        for number in range(candidates):
            k, y, x = _drawn(
                key + np.uint64(number) * np.uint64(1 << 16), own, filled, window, most_filled
            )
            if k < 0:
                continue
            cost = 0.0
            wide, high = own[k, 2], own[k, 1]
            here = own[k, 0] + y * wide + x
            here_turned = own[k, 4] + x * high + y
            if neighbours_x:
                for side in range(2):
                    other = column - 1 + 2 * side
                    if wrap_x:
                        other %= nx
                    if other < 0 or other >= nx or cells[row, other, 0] < 0 or cost >= best:
                        continue
                    o = cells[row, other]
                    there = sources[o[0], 0] + o[1] * sources[o[0], 2] + o[2]
                    if side == 0:
                        to = lines_x[other + 1] - lines_x[other]
                        cost += cut_cost(
                            heights,
                            there + to,
                            sources[o[0], 2],
                            here,
                            wide,
                            window,
                            overlap,
                            per_step,
                            best - cost,
                        )
                    else:
                        to = lines_x[column + 1] - lines_x[column]
                        cost += cut_cost(
                            heights,
                            here + to,
                            wide,
                            there,
                            sources[o[0], 2],
                            window,
                            overlap,
                            per_step,
                            best - cost,
                        )
            if neighbours_y:
                for side in range(2):
                    other = row - 1 + 2 * side
                    if wrap_y:
                        other %= ny
                    if other < 0 or other >= ny or cells[other, column, 0] < 0 or cost >= best:
                        continue
                    o = cells[other, column]
                    there = sources[o[0], 4] + o[2] * sources[o[0], 1] + o[1]
                    if side == 0:
                        to = lines_y[other + 1] - lines_y[other]
                        cost += cut_cost(
                            turned,
                            there + to,
                            sources[o[0], 1],
                            here_turned,
                            high,
                            window,
                            overlap,
                            per_step,
                            best - cost,
                        )
                    else:
                        to = lines_y[row + 1] - lines_y[row]
                        cost += cut_cost(
                            turned,
                            here_turned + to,
                            high,
                            there,
                            sources[o[0], 1],
                            window,
                            overlap,
                            per_step,
                            best - cost,
                        )
            if cost < best:
                best = cost
                first = own[k, 3] + y * (wide + 1) + x
                down = window * (wide + 1)
                count = filled[first + down + window] - filled[first + down]
                cells[row, column, 0] = level_first[level] + k
                cells[row, column, 1] = y
                cells[row, column, 2] = x
                cells[row, column, 3] = count - filled[first + window] + filled[first]
                if not (neighbours_x or neighbours_y):
                    break
        if best < np.inf:
            total += best
    return total


@njit(cache=True, nogil=True)
def lay_down(
    top,
    left,
    cells,
    lines_y,
    lines_x,
    wrap_x,
    wrap_y,
    overlap,
    sources,
    heights,
    across,
    down,
    out,
    labels,
    pixels,
):
    """Write the windows' pixels of one tile.

    Parameters
    ----------
    top, left : int
        First row and column of the tile on the map; it may stand out where the map wraps, and
        is left at label -1 where it stands out of a map that does not.
    out : (h, w) float32, written
    labels : (h, w) int64, written
        Number of the cell, -1 without.
    pixels : (h, w) int64, written
        Pixel in ``heights``.
    """
    ny, nx = cells.shape[:2]
    height, width = lines_y[ny], lines_x[nx]
    half = overlap // 2
    for i in range(out.shape[0]):
        y = top + i
        if wrap_y:
            y %= height
        for j in range(out.shape[1]):
            x = left + j
            if wrap_x:
                x %= width
            out[i, j] = 0.0
            labels[i, j] = -1
            pixels[i, j] = -1
            if y < 0 or y >= height or x < 0 or x >= width:
                continue
            row = cell_of(y, lines_y)
            local = y - lines_y[row] + half
            if local < overlap and (wrap_y or row > 0):
                if local < down[row, x]:
                    row = (row - 1) % ny
                    local += lines_y[row + 1] - lines_y[row]
            elif y >= lines_y[row + 1] - half and (wrap_y or row < ny - 1):
                following = (row + 1) % ny
                place = y - lines_y[row + 1] + half
                if place >= down[following, x]:
                    row = following
                    local = place
            column, p = place_in_row(
                row, local, x, cells, lines_x, wrap_x, overlap, sources, across
            )
            if p >= 0:
                out[i, j] = heights[p]
                labels[i, j] = row * nx + column
                pixels[i, j] = p


@njit(cache=True, nogil=True)
def steps_at_cuts(out, labels, pixels, cells, sources, heights, divergence):
    """Write the divergence of what differences across cuts have too much.

    Across a cut the difference ought to be the mean of those that both windows have there.
    """
    nx = cells.shape[1]
    rows, columns = out.shape
    divergence[:] = 0.0
    for i in range(rows):
        for j in range(columns):
            here = labels[i, j]
            if here < 0:
                continue
            if j + 1 < columns and labels[i, j + 1] != here and labels[i, j + 1] >= 0:
                p, q = pixels[i, j], pixels[i, j + 1]
                ought = 0.5 * (heights[p + 1] - heights[p] + heights[q] - heights[q - 1])
                step = out[i, j + 1] - out[i, j] - ought
                divergence[i, j] += step
                divergence[i, j + 1] -= step
            if i + 1 < rows and labels[i + 1, j] != here and labels[i + 1, j] >= 0:
                there = labels[i + 1, j]
                p, q = pixels[i, j], pixels[i + 1, j]
                wide_p = sources[cells[here // nx, here % nx, 0], 2]
                wide_q = sources[cells[there // nx, there % nx, 0], 2]
                ought = 0.5 * (heights[p + wide_p] - heights[p] + heights[q] - heights[q - wide_q])
                step = out[i + 1, j] - out[i, j] - ought
                divergence[i, j] += step
                divergence[i + 1, j] -= step
