"""Find the cheapest cuts between overlapping windows by dynamic programming, compiled."""

# mypy: allow-untyped-defs

import numpy as np
from numba import njit

_INFINITE_COST = np.float32(3.0e38)


@njit(cache=True, nogil=True, error_model="numpy")
def _misfit_row(a, a0, a_step, b, b0, b_step, per_step, out):
    """Write the cost of a cut at each pixel of a row: the squared slope left by closing its step.

    Parameters
    ----------
    a, b : (N,) float32
        Heights, flat.
    a0, b0 : int
        First pixel of this row in ``a`` and in ``b``.
    a_step, b_step : int
        Pixels from there to the next row.
    per_step : float32
        Squared slope per squared step of height, px^-2.
    out : (O,) float32, written
        The last pixel has no neighbor and cannot be cut.
    """
    count = out.size
    a1, b1 = a0 + a_step, b0 + b_step
    for x in range(count - 1):
        d = a[a0 + x] - b[b0 + x]
        right = a[a0 + x + 1] - b[b0 + x + 1] - d
        down = a[a1 + x] - b[b1 + x] - d
        out[x] = per_step * d * d + right * right + down * down
    out[count - 1] = _INFINITE_COST


@njit(cache=True, nogil=True, error_model="numpy")
def cut_cost(heights, a, a_step, b, b_step, grid, per_step, bound):
    """Return the cost of the cheapest cut through an overlap, or `bound` once it must exceed it.

    Parameters
    ----------
    heights : (N,) float32
    a, b : int
        First pixel of the overlap in each of two windows.
    a_step, b_step : int
        Pixels from one row of the overlap to the next.
    grid : CellGrid
    per_step : float32
    bound : float
    """
    overlap = grid.overlap
    cost = np.zeros(overlap, np.float32)
    before = np.zeros(overlap, np.float32)
    row = np.empty(overlap, np.float32)
    for y in range(grid.window - 1):
        from_a, from_b = a + y * a_step, b + y * b_step
        _misfit_row(heights, from_a, a_step, heights, from_b, b_step, per_step, row)
        for x in range(overlap):
            before[x] = cost[x]
        for x in range(1, overlap - 1):
            cost[x] = row[x] + min(before[x], min(before[x - 1], before[x + 1]))
        cost[0] = _INFINITE_COST
        cost[overlap - 1] = _INFINITE_COST
        if (y & 15) == 15:
            least = _INFINITE_COST
            for x in range(1, overlap - 1):
                least = min(least, cost[x])
            if least >= bound:
                return bound
    least = _INFINITE_COST
    for x in range(1, overlap - 1):
        least = min(least, cost[x])
    return min(float(least), bound)


@njit(cache=True, nogil=True, error_model="numpy")
def _cheapest_path(misfit, first, last, path):
    """Write the cheapest path down the rows of ``misfit`` and return its cost.

    Parameters
    ----------
    misfit : (length, overlap) float32
    first : int
        Column in row 0, or -1: any.
    last : int
        Column in the row after the last one that the path must reach in one step, or -1: any.
    path : (length,) int16, written
    """
    length, overlap = misfit.shape
    cost = np.empty((length, overlap), np.float32)
    for x in range(overlap):
        inside = 0 < x < overlap - 1
        cost[0, x] = misfit[0, x] if inside and (first < 0 or x == first) else _INFINITE_COST
    for y in range(1, length):
        cost[y, 0] = _INFINITE_COST
        cost[y, overlap - 1] = _INFINITE_COST
        for x in range(1, overlap - 1):
            least = min(cost[y - 1, x], min(cost[y - 1, x - 1], cost[y - 1, x + 1]))
            cost[y, x] = least + misfit[y, x] if least < _INFINITE_COST else _INFINITE_COST
    low = 1 if last < 0 else max(last - 1, 1)
    high = overlap - 2 if last < 0 else min(last + 1, overlap - 2)
    x = low
    for place in range(low + 1, high + 1):
        if cost[length - 1, place] < cost[length - 1, x]:
            x = place
    total = float(cost[length - 1, x])
    path[length - 1] = x
    for y in range(length - 2, -1, -1):
        x = path[y + 1]
        for place in (x - 1, x + 1):
            if 0 < place < overlap - 1 and cost[y, place] < cost[y, x]:
                x = place
        path[y] = x
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def cut_columns(row, grid, site, per_step):
    """Cut between the windows of a row of cells.

    Parameters
    ----------
    row : int
    grid : CellGrid
    site : SiteLayout
        ``across`` is written at [row].
    per_step : float32
    """
    cells, sources, heights = site.cells, site.sources.table, site.sources.heights
    nx = cells.shape[1]
    misfit = np.empty((grid.window, grid.overlap), np.float32)
    for column in range(0 if grid.wrap[1] else 1, nx):
        left = (column - 1) % nx
        a, b = cells[row, left], cells[row, column]
        if a[0] < 0 or b[0] < 0:
            site.across[row, column] = grid.overlap // 2
            continue
        wide_a, wide_b = sources[a[0], 2], sources[b[0], 2]
        from_a = sources[a[0], 0] + a[1] * wide_a + a[2]
        from_a += grid.lines_x[left + 1] - grid.lines_x[left]
        from_b = sources[b[0], 0] + b[1] * wide_b + b[2]
        for y in range(grid.window):
            down = 1 if y < grid.window - 1 else 0
            a0, b0 = from_a + y * wide_a, from_b + y * wide_b
            _misfit_row(heights, a0, down * wide_a, heights, b0, down * wide_b, per_step, misfit[y])
        _cheapest_path(misfit, -1, -1, site.across[row, column])


@njit(cache=True, nogil=True)
def locate_in_cells(at, lines, wrap, overlap, cuts):
    """Return the cell of a row that shows a pixel of the map, and the pixel in its window.

    Parameters
    ----------
    at : int
        Pixel within the map, along the row of cells.
    lines : (n + 1,) int64
        Where cells begin.
    wrap : bool
    overlap : int
    cuts : (n,) int16
        Where each cell begins within its overlap with the one before.
    """
    count = lines.size - 1
    cell = min(int(at * count / lines[count]), count - 1)
    while at < lines[cell]:
        cell -= 1
    while at >= lines[cell + 1]:
        cell += 1
    half = overlap // 2
    place = at - lines[cell] + half
    if place < overlap and (wrap or cell > 0):
        if place < cuts[cell]:
            cell = (cell - 1) % count
            place += lines[cell + 1] - lines[cell]
    elif at >= lines[cell + 1] - half and (wrap or cell < count - 1):
        following = (cell + 1) % count
        after = at - lines[cell + 1] + half
        if after >= cuts[following]:
            return following, after
    return cell, place


@njit(cache=True, nogil=True)
def locate_in_row(row, y, x, grid, site):
    """Return (cell's column, pixel in the sources or -1) that a row of cells shows at (y, x).

    ``y`` is the row within the windows, ``x`` within the map.
    """
    cuts = site.across[row, :, y]
    column, local = locate_in_cells(x, grid.lines_x, grid.wrap[1], grid.overlap, cuts)
    cell, sources = site.cells[row, column], site.sources.table
    if cell[0] < 0:
        return column, -1
    return column, sources[cell[0], 0] + (cell[1] + y) * sources[cell[0], 2] + cell[2] + local


@njit(cache=True, nogil=True, error_model="numpy")
def _band_misfit(line, first, last, grid, site, per_step, band, misfit):
    """Write the cost of a cut between the rows of cells at a line, by the map's columns.

    Parameters
    ----------
    first, last : int
        Columns of the map; the last one is not cut itself.
    band : (2, n, overlap) float32, written
        Heights of the row above and of the row ``line``, transposed.
    misfit : (n, overlap) float32, written at the first ``last - first - 1``
    """
    heights, overlap = site.sources.heights, grid.overlap
    above = (line - 1) % site.cells.shape[0]
    width = grid.lines_x[grid.lines_x.size - 1]
    start = grid.lines_y[above + 1] - grid.lines_y[above]
    for i in range(first, last):
        x = i % width if grid.wrap[1] else min(max(i, 0), width - 1)
        for place in range(overlap):
            _, p = locate_in_row(above, start + place, x, grid, site)
            _, q = locate_in_row(line, place, x, grid, site)
            band[0, i - first, place] = heights[p] if p >= 0 else 0.0
            band[1, i - first, place] = heights[q] if q >= 0 else 0.0
    upper, lower = band[0].reshape(-1), band[1].reshape(-1)
    for i in range(last - first - 1):
        at = i * overlap
        _misfit_row(upper, at, overlap, lower, at, overlap, per_step, misfit[i])


@njit(cache=True, nogil=True, error_model="numpy")
def cut_rows(line, grid, site, per_step):
    """Cut between the row of cells ``line`` and the one above it, cell by cell.

    Where two cells of a row meet, the cut passes through the cheapest pixel of that column, so that
    the cuts of cells are independent of each other.

    Parameters
    ----------
    line : int
    grid : CellGrid
    site : SiteLayout
        ``across`` of `cut_columns`; ``down`` is written at [line].
    per_step : float32
    """
    lines_x, overlap = grid.lines_x, grid.overlap
    nx = lines_x.size - 1
    longest = 0
    for c in range(nx):
        longest = max(longest, lines_x[c + 1] - lines_x[c])
    band = np.empty((2, longest + 1, overlap), np.float32)
    misfit = np.empty((longest + 1, overlap), np.float32)
    gates = np.empty(nx + 1, np.int64)
    for c in range(nx + 1):
        # the cheapest pixel over a few columns
        reach = 3
        begin = lines_x[c] - reach
        _band_misfit(line, begin, begin + 2 * reach + 2, grid, site, per_step, band, misfit)
        sums = np.zeros(overlap, np.float64)
        for i in range(2 * reach + 1):
            for place in range(overlap):
                sums[place] += misfit[i, place]
        gate = overlap // 2
        for place in range(1, overlap - 1):
            if sums[place] < sums[gate]:
                gate = place
        gates[c] = gate
    if grid.wrap[1]:
        gates[nx] = gates[0]
    for c in range(nx):
        begin, end = lines_x[c], lines_x[c + 1]
        _band_misfit(line, begin, end + 1, grid, site, per_step, band, misfit)
        path = site.down[line, begin:end]
        _cheapest_path(misfit[: end - begin], gates[c], gates[c + 1], path)
