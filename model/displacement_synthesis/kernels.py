"""Inner loops of displacement synthesis: choose windows, cut between them, write them to tiles.

Kernels are serial and release the GIL, so that threads can run them in parallel; each writes only
to its caller's arrays. Random numbers are hashes of position and seed, never a state, so that
results do not depend on the order of calls.

A window is identified by the index of its first pixel in one flat array of all sources. There is
another array with every source transposed, so that cuts along rows use the code for cuts along
columns.
"""

# mypy: allow-untyped-defs

import numpy as np
from numba import njit

from model.displacement_synthesis.cut_kernels import cut_cost, locate_in_cells, locate_in_row

MAX_DRAWS = 24
"""Positions drawn per candidate before it is dropped for too many filled pixels."""


@njit(cache=True, nogil=True)
def mix_bits(key):
    """Return 64 bits that depend on every bit of ``key`` (the finalizer of splitmix64)."""
    z = np.uint64(key) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True)
def _uniform(key):
    return float(mix_bits(key) >> np.uint64(11)) * 2.0**-53


@njit(cache=True, nogil=True)
def _count_filled(filled, source, y, x, window):
    """Return how many pixels of a source's window were filled, by the summed-area table."""
    wide = source[2]
    first = source[3] + y * (wide + 1) + x
    down = window * (wide + 1)
    count = filled[first + down + window] - filled[first + down]
    return count - (filled[first + window] - filled[first])


@njit(cache=True, nogil=True)
def _draw_window(key, sources, filled, window, max_filled):
    """Return (source, row, column) of a window with few filled pixels; source -1: none found.

    Positions are drawn as if windows could exceed the source by half their size, and are then
    clamped to it: so pixels near its border are used almost as often as those in the middle.
    """
    for attempt in range(MAX_DRAWS):
        at = mix_bits(key + np.uint64(attempt))
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
        if _count_filled(filled, sources[chosen], y, x, window) <= max_filled:
            return chosen, y, x
    return -1, 0, 0


@njit(cache=True, nogil=True)
def _neighbor(row, column, axis, side, grid, cells):
    """Return the neighbor cell along a row (axis 1) or column (axis 0), or -1: none is chosen."""
    cell = column if axis else row
    other, count = cell - 1 + 2 * side, cells.shape[axis]
    if grid.wrap[axis]:
        other %= count
    if other < 0 or other >= count:
        return -1
    there = cells[row, other, 0] if axis else cells[other, column, 0]
    return other if there >= 0 else -1


@njit(cache=True, nogil=True, error_model="numpy")
def choose_windows(row, first_column, sides, above, grid, levels, site, max_filled, knobs):
    """Choose windows for every other cell of a row by the cheapest cuts to existing neighbors.

    Parameters
    ----------
    row, first_column : int
        Cells (row, first_column), (row, first_column + 2), ...
    sides, above : bool
        Whether windows to the left and right, and above and below, are chosen already.
    grid : CellGrid
    levels : (ny, nx) int64
        Scale of each cell.
    site : SiteLayout
        ``cells`` are written. Their source before the call: -1 not chosen yet, -2 no cell needed;
        after the call, -1: no window found.
    max_filled : int
        Filled pixels of a window.
    knobs : (int, float32, uint64)
        Candidates, squared slope per squared step, seed.
    """
    candidates, per_step, seed = knobs
    cells, sources = site.cells, site.sources
    for column in range(first_column, levels.shape[1], 2):
        if cells[row, column, 0] == -2:
            continue
        first = sources.level_first[levels[row, column]]
        own = sources.table[first : sources.level_first[levels[row, column] + 1]]
        key = mix_bits(seed ^ mix_bits(np.uint64(row) * np.uint64(1 << 24) + np.uint64(column)))
        best = np.inf
        for number in range(candidates):
            drawn = key + np.uint64(number) * np.uint64(1 << 16)
            k, y, x = _draw_window(drawn, own, sources.filled, grid.window, max_filled)
            if k < 0:
                continue
            cost = 0.0
            for axis in (1, 0):
                if not (sides if axis else above):
                    continue
                heights = sources.heights if axis else sources.transposed
                lines = grid.lines_x if axis else grid.lines_y
                here, step = own[k, 0] + y * own[k, 2] + x, own[k, 2]
                if axis == 0:
                    here, step = own[k, 4] + x * own[k, 1] + y, own[k, 1]
                for side in range(2):
                    other = _neighbor(row, column, axis, side, grid, cells)
                    if other < 0 or cost >= best:
                        continue
                    o = cells[row, other] if axis else cells[other, column]
                    source = sources.table[o[0]]
                    there, stride = source[0] + o[1] * source[2] + o[2], source[2]
                    if axis == 0:
                        there, stride = source[4] + o[2] * source[1] + o[1], source[1]
                    a, a_step, b, b_step, cell = there, stride, here, step, other
                    if side == 1:
                        a, a_step, b, b_step = here, step, there, stride
                        cell = column if axis else row
                    a += lines[cell + 1] - lines[cell]
                    cost += cut_cost(heights, a, a_step, b, b_step, grid, per_step, best - cost)
            if cost < best:
                best = cost
                count = _count_filled(sources.filled, own[k], y, x, grid.window)
                cells[row, column, 0], cells[row, column, 1] = first + k, y
                cells[row, column, 2], cells[row, column, 3] = x, count
                if not (sides or above):
                    break


@njit(cache=True, nogil=True)
def write_windows(top, left, grid, site, out, labels, pixels):
    """Write the windows' pixels of one tile.

    Parameters
    ----------
    top, left : int
        First row and column of the tile on the map; it may exceed a map that wraps; pixels outside
        a map that does not keep label -1.
    grid : CellGrid
    site : SiteLayout
    out : (h, w) float32, written
    labels : (h, w) int64, written
        Number of the cell, -1 without.
    pixels : (h, w) int64, written
        Pixel in the sources' heights.
    """
    nx = site.cells.shape[1]
    wrap_y, wrap_x = grid.wrap
    height, width = grid.lines_y[-1], grid.lines_x[-1]
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
            row, local = locate_in_cells(y, grid.lines_y, wrap_y, grid.overlap, site.down[:, x])
            column, p = locate_in_row(row, local, x, grid, site)
            if p >= 0:
                out[i, j] = site.sources.heights[p]
                labels[i, j] = row * nx + column
                pixels[i, j] = p


@njit(cache=True, nogil=True)
def cut_divergence(out, labels, pixels, site, divergence):
    """Write the divergence of the excess of height differences across cuts.

    The target difference across a cut is the mean of those of both windows there.
    """
    cells, sources, heights = site.cells, site.sources.table, site.sources.heights
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
