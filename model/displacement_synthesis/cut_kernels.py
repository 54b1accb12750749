"""Cheapest cuts between overlapping windows, compiled."""

# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

_INFINITE_COST = np.float32(3.0e38)


@njit(cache=True, nogil=True, error_model="numpy")
def _misfit_row(a, b, a0, a1, b0, b1, per_step, out):
    """Write what a cut costs at each place of a row: squared slope that closing a step leaves.

    Parameters
    ----------
    a, b : (N,) float32
        Heights, flat.
    a0, a1, b0, b1 : int
        First pixel of this row and of the next one in ``a`` and in ``b``.
    per_step : float32
        Squared slope per squared step of height, px^-2.
    out : (O,) float32, written
        The last place has no neighbour and cannot be cut.
    """
    count = out.size
    for x in range(count - 1):
        d = a[a0 + x] - b[b0 + x]
        right = a[a0 + x + 1] - b[b0 + x + 1] - d
        down = a[a1 + x] - b[b1 + x] - d
        out[x] = per_step * d * d + right * right + down * down
    out[count - 1] = _INFINITE_COST


@njit(cache=True, nogil=True, error_model="numpy")
def cut_cost(heights, a, a_step, b, b_step, length, overlap, per_step, bound):
    """Return the cost of the cheapest cut through an overlap, or `bound` once it must exceed it.

    Parameters
    ----------
    heights : (N,) float32
    a, b : int
        First pixel of the overlap in each of two windows.
    a_step, b_step : int
        Pixels from one row of the overlap to the next.
    length, overlap : int
        Rows, and places of a row.
    per_step : float32
    bound : float
    """
    cost = np.zeros(overlap, np.float32)
    before = np.zeros(overlap, np.float32)
    row = np.empty(overlap, np.float32)
    for y in range(length - 1):
        _misfit_row(
            heights,
            heights,
            a + y * a_step,
            a + (y + 1) * a_step,
            b + y * b_step,
            b + (y + 1) * b_step,
            per_step,
            row,
        )
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
        Place in row 0, or -1: any.
    last : int
        Place in the row after the last one, which a path must be able to step to, or -1: any.
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
def cut_columns(row, cells, lines_x, wrap_x, window, overlap, sources, heights, per_step, paths):
    """Cut between the windows of a row of cells.

    Parameters
    ----------
    paths : (ny, nx, window) int16, written at [row]
        paths[row, c, y]: first place of the overlap that belongs to cell c, of those it shares
        with cell c - 1, in row y of the windows.
    """
    nx = cells.shape[1]
    misfit = np.empty((window, overlap), np.float32)
    for column in range(0 if wrap_x else 1, nx):
        left = (column - 1) % nx
        a, b = cells[row, left], cells[row, column]
        if a[0] < 0 or b[0] < 0:
            paths[row, column] = overlap // 2
            continue
        wide_a, wide_b = sources[a[0], 2], sources[b[0], 2]
        from_a = sources[a[0], 0] + a[1] * wide_a + a[2] + lines_x[left + 1] - lines_x[left]
        from_b = sources[b[0], 0] + b[1] * wide_b + b[2]
        for y in range(window):
            down = 1 if y < window - 1 else 0
            _misfit_row(
                heights,
                heights,
                from_a + y * wide_a,
                from_a + (y + down) * wide_a,
                from_b + y * wide_b,
                from_b + (y + down) * wide_b,
                per_step,
                misfit[y],
            )
        _cheapest_path(misfit, -1, -1, paths[row, column])


@njit(cache=True, nogil=True)
def cell_of(line, lines):
    """Return which cell a pixel within the map lies in."""
    count = lines.size - 1
    cell = min(int(line * count / lines[count]), count - 1)
    while line < lines[cell]:
        cell -= 1
    while line >= lines[cell + 1]:
        cell += 1
    return cell


@njit(cache=True, nogil=True)
def place_in_row(row, y, x, cells, lines_x, wrap_x, overlap, sources, across):
    """Return (cell's column, pixel in the sources or -1) that a row of cells shows at (y, x).

    ``y`` is the row within the windows, ``x`` within the map.
    """
    nx = cells.shape[1]
    half = overlap // 2
    column = cell_of(x, lines_x)
    local = x - lines_x[column] + half
    if local < overlap and (wrap_x or column > 0):
        if local < across[row, column, y]:
            column = (column - 1) % nx
            local += lines_x[column + 1] - lines_x[column]
    elif x >= lines_x[column + 1] - half and (wrap_x or column < nx - 1):
        following = (column + 1) % nx
        place = x - lines_x[column + 1] + half
        if place >= across[row, following, y]:
            column = following
            local = place
    cell = cells[row, column]
    if cell[0] < 0:
        return column, -1
    return column, sources[cell[0], 0] + (cell[1] + y) * sources[cell[0], 2] + cell[2] + local


@njit(cache=True, nogil=True)
def _band(
    line,
    first,
    last,
    cells,
    lines_y,
    lines_x,
    wrap_x,
    overlap,
    sources,
    heights,
    across,
    upper,
    lower,
    known,
):
    """Write both rows of cells at a line between them, turned: (column of the map, place)."""
    ny = cells.shape[0]
    above = (line - 1) % ny
    width = lines_x[lines_x.size - 1]
    start = lines_y[above + 1] - lines_y[above]
    for i in range(first, last):
        x = i % width if wrap_x else min(max(i, 0), width - 1)
        good = True
        for place in range(overlap):
            _, p = place_in_row(
                above, start + place, x, cells, lines_x, wrap_x, overlap, sources, across
            )
            _, q = place_in_row(line, place, x, cells, lines_x, wrap_x, overlap, sources, across)
            upper[i - first, place] = heights[p] if p >= 0 else 0.0
            lower[i - first, place] = heights[q] if q >= 0 else 0.0
            good = good and p >= 0 and q >= 0
        known[i - first] = good


@njit(cache=True, nogil=True, error_model="numpy")
def cut_rows(
    line, cells, lines_y, lines_x, wrap_x, overlap, sources, heights, per_step, across, down
):
    """Cut between the row of cells ``line`` and the one above it, cell by cell.

    Where two cells of a row meet, the cut passes through the cheapest place of that column, so
    that it can be found for each cell alone.

    Parameters
    ----------
    across : (ny, nx, window) int16, of `cut_columns`
    down : (ny, width) int16, written at [line]
        First place of the overlap that belongs to the row ``line``.
    """
    nx = cells.shape[1]
    longest = 0
    for c in range(nx):
        longest = max(longest, lines_x[c + 1] - lines_x[c])
    upper = np.empty((longest + 1, overlap), np.float32)
    lower = np.empty_like(upper)
    known = np.empty(longest + 1, np.bool_)
    misfit = np.empty((longest + 1, overlap), np.float32)
    gates = np.empty(nx + 1, np.int64)
    for c in range(nx + 1):
        # the cheapest place over a few columns
        reach = 3
        begin = lines_x[c] - reach
        _band(
            line,
            begin,
            begin + 2 * reach + 2,
            cells,
            lines_y,
            lines_x,
            wrap_x,
            overlap,
            sources,
            heights,
            across,
            upper,
            lower,
            known,
        )
        sums = np.zeros(overlap, np.float64)
        for i in range(2 * reach + 1):
            _misfit_row(
                upper.reshape(-1),
                lower.reshape(-1),
                i * overlap,
                (i + 1) * overlap,
                i * overlap,
                (i + 1) * overlap,
                per_step,
                misfit[i],
            )
            for place in range(overlap):
                sums[place] += misfit[i, place]
        gate = overlap // 2
        for place in range(1, overlap - 1):
            if sums[place] < sums[gate]:
                gate = place
        gates[c] = gate
    if wrap_x:
        gates[nx] = gates[0]
    for c in range(nx):
        begin, end = lines_x[c], lines_x[c + 1]
        length = end - begin
        _band(
            line,
            begin,
            end + 1,
            cells,
            lines_y,
            lines_x,
            wrap_x,
            overlap,
            sources,
            heights,
            across,
            upper,
            lower,
            known,
        )
        for i in range(length):
            _misfit_row(
                upper.reshape(-1),
                lower.reshape(-1),
                i * overlap,
                (i + 1) * overlap,
                i * overlap,
                (i + 1) * overlap,
                per_step,
                misfit[i],
            )
        _cheapest_path(misfit[:length], gates[c], gates[c + 1], down[line, begin:end])
