"""Inner loops of displacement synthesis: choosing windows, cutting between them, laying them down.

Kernels are serial and release the lock, so that threads may run them side by side; each writes
only what its caller gave it. Chance is a hash of place and seed, never a state, so that results do
not depend on the order of calls.

Windows are told by the index of their first pixel in one flat array of all sources. There is a
second array with every source transposed, so that a cut that runs along a row is found like one
that runs along a column.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

MAX_DRAWS = 24
"""Places drawn before a window with too many filled pixels is given up for another candidate."""
_INFINITE_COST = np.float32(3.0e38)


@njit(cache=True, nogil=True)
def mixed(key: Any) -> Any:
    """Return 64 bits that depend on every bit of ``key`` (the finalizer of splitmix64)."""
    z = np.uint64(key) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True)
def _uniform(key: Any) -> Any:
    return float(mixed(key) >> np.uint64(11)) * 2.0**-53


@njit(cache=True, nogil=True)
def _drawn(key: Any, sources: Any, filled: Any, window: Any, most_filled: Any) -> Any:
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
def _misfit_row(
    a: Any, b: Any, a0: Any, a1: Any, b0: Any, b1: Any, per_step: Any, out: Any
) -> None:
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
def cut_cost(
    heights: Any,
    a: Any,
    a_step: Any,
    b: Any,
    b_step: Any,
    length: Any,
    overlap: Any,
    per_step: Any,
    bound: Any,
) -> Any:
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
def _cheapest_path(misfit: Any, first: Any, last: Any, path: Any) -> Any:
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
def choose_windows(
    row: Any,
    first_column: Any,
    cells: Any,
    lines_y: Any,
    lines_x: Any,
    neighbours_x: Any,
    neighbours_y: Any,
    wrap_x: Any,
    wrap_y: Any,
    window: Any,
    overlap: Any,
    levels: Any,
    level_first: Any,
    sources: Any,
    heights: Any,
    turned: Any,
    filled: Any,
    most_filled: Any,
    candidates: Any,
    seed: Any,
    per_step: Any,
) -> Any:
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


@njit(cache=True, nogil=True, error_model="numpy")
def cut_columns(
    row: Any,
    cells: Any,
    lines_x: Any,
    wrap_x: Any,
    window: Any,
    overlap: Any,
    sources: Any,
    heights: Any,
    per_step: Any,
    paths: Any,
) -> None:
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
def _cell_of(line: Any, lines: Any) -> Any:
    """Return which cell a pixel within the map lies in."""
    count = lines.size - 1
    cell = min(int(line * count / lines[count]), count - 1)
    while line < lines[cell]:
        cell -= 1
    while line >= lines[cell + 1]:
        cell += 1
    return cell


@njit(cache=True, nogil=True)
def _place_in_row(
    row: Any,
    y: Any,
    x: Any,
    cells: Any,
    lines_x: Any,
    wrap_x: Any,
    overlap: Any,
    sources: Any,
    across: Any,
) -> Any:
    """Return (cell's column, pixel in the sources or -1) that a row of cells shows at (y, x).

    ``y`` is the row within the windows, ``x`` within the map.
    """
    nx = cells.shape[1]
    half = overlap // 2
    column = _cell_of(x, lines_x)
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
    line: Any,
    first: Any,
    last: Any,
    cells: Any,
    lines_y: Any,
    lines_x: Any,
    wrap_x: Any,
    overlap: Any,
    sources: Any,
    heights: Any,
    across: Any,
    upper: Any,
    lower: Any,
    known: Any,
) -> None:
    """Write both rows of cells at a line between them, turned: (column of the map, place)."""
    ny = cells.shape[0]
    above = (line - 1) % ny
    width = lines_x[lines_x.size - 1]
    start = lines_y[above + 1] - lines_y[above]
    for i in range(first, last):
        x = i % width if wrap_x else min(max(i, 0), width - 1)
        good = True
        for place in range(overlap):
            _, p = _place_in_row(
                above, start + place, x, cells, lines_x, wrap_x, overlap, sources, across
            )
            _, q = _place_in_row(line, place, x, cells, lines_x, wrap_x, overlap, sources, across)
            upper[i - first, place] = heights[p] if p >= 0 else 0.0
            lower[i - first, place] = heights[q] if q >= 0 else 0.0
            good = good and p >= 0 and q >= 0
        known[i - first] = good


@njit(cache=True, nogil=True, error_model="numpy")
def cut_rows(
    line: Any,
    cells: Any,
    lines_y: Any,
    lines_x: Any,
    wrap_x: Any,
    overlap: Any,
    sources: Any,
    heights: Any,
    per_step: Any,
    across: Any,
    down: Any,
) -> None:
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


@njit(cache=True, nogil=True)
def lay_down(
    top: Any,
    left: Any,
    cells: Any,
    lines_y: Any,
    lines_x: Any,
    wrap_x: Any,
    wrap_y: Any,
    overlap: Any,
    sources: Any,
    heights: Any,
    across: Any,
    down: Any,
    out: Any,
    labels: Any,
    pixels: Any,
) -> None:
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
            row = _cell_of(y, lines_y)
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
            column, p = _place_in_row(
                row, local, x, cells, lines_x, wrap_x, overlap, sources, across
            )
            if p >= 0:
                out[i, j] = heights[p]
                labels[i, j] = row * nx + column
                pixels[i, j] = p


@njit(cache=True, nogil=True)
def steps_at_cuts(
    out: Any, labels: Any, pixels: Any, cells: Any, sources: Any, heights: Any, divergence: Any
) -> None:
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
