"""Count the values of one response in bins and move them to other ranks, compiled."""

# mypy: allow-untyped-defs

import numpy as np
from numba import njit

TABLE_CELLS = 16384
"""Uniform cells over the edges; a table bounds the bins of each cell."""
FRACTION_TOL = 1e-12
"""Fractions that differ by less are equal up to rounding: far below the weight of one texel."""


@njit(cache=True, nogil=True, error_model="numpy")
def bound_bins(edges, count, scale, min_bin, max_bin):
    """Compute the range of bins of the values in each cell.

    Parameters
    ----------
    edges : (n,) float64
        Non-decreasing; the first ``count`` are used.
    scale : float
        Cells per unit from the first edge on.
    min_bin, max_bin : (TABLE_CELLS,) int, written
        Cells of values and of edges are computed by the same arithmetic, which preserves their
        order: edges in earlier cells are certainly below the value, edges in later cells above it.
    """
    passed = 0
    for cell in range(TABLE_CELLS):
        min_bin[cell] = max(passed - 1, 0)
        while passed < count and (edges[passed] - edges[0]) * scale < cell + 1:
            passed += 1
        max_bin[cell] = max(passed - 1, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def find_edge(x, edges, scale, min_bin, max_bin):
    """Return the index of the last edge at or below ``x``; 0 if there is none.

    Parameters as of `bound_bins`.
    """
    cell = int(min(max((x - edges[0]) * scale, 0.0), TABLE_CELLS - 1.0))
    low, high = int(min_bin[cell]), int(max_bin[cell])
    while high - low > 8:
        middle = (low + high + 1) // 2
        if edges[middle] <= x:
            low = middle
        else:
            high = middle - 1
    while low < high and edges[low + 1] <= x:
        low += 1
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def count(values, edges, scale, min_bin, max_bin, sums):
    """Count values in bins; the end bins include values beyond the edges.

    Parameters
    ----------
    values : (n,) float
    edges : (B + 1,) float64, rising
    scale, least, most
        Of the first B edges (`bound_bins`).
    sums : (B,) float64, added to

    Returns
    -------
    tuple
        Values below and above the edges, least and largest value.
    """
    bottom, top = edges[0], edges[-1]
    below, above, lowest, highest = 0, 0, np.inf, -np.inf
    for k in range(values.size):
        x = float(values[k])
        sums[find_edge(x, edges, scale, min_bin, max_bin)] += 1.0
        lowest, highest = min(lowest, x), max(highest, x)
        below += x < bottom
        above += x > top
    return float(below), float(above), lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def count_weighted(values, weights, edges, scale, min_bin, max_bin, sums):
    """Add the weights of values to their bins; values of weight 0 are ignored.

    Parameters as of `count`; ``weights`` is (n,) float. Returns weights below and above, least
    and largest value, sum of squared weights.
    """
    bottom, top = edges[0], edges[-1]
    below, above, lowest, highest, squares = 0.0, 0.0, np.inf, -np.inf, 0.0
    for k in range(values.size):
        x, weight = float(values[k]), float(weights[k])
        if weight <= 0.0:
            continue
        sums[find_edge(x, edges, scale, min_bin, max_bin)] += weight
        squares += weight * weight
        lowest, highest = min(lowest, x), max(highest, x)
        if x < bottom:
            below += weight
        if x > top:
            above += weight
    return below, above, lowest, highest, squares


@njit(cache=True, nogil=True, error_model="numpy")
def plan_transport(source, target, edges, begin, end, to, slope):
    """Build the increasing, piecewise linear map from one distribution to another.

    Parameters
    ----------
    source, target : (B + 1,) float64
        Cumulative fractions at the edges, from 0 to 1, linear in between.
    edges : (B + 1,) float64
    begin, end, to, slope : (2 B + 2,) float64, written
        Pieces: values from ``begin`` to ``end`` map to ``to`` plus ``slope`` times the distance.

    Returns
    -------
    int
        Number of pieces.
    """
    B = edges.size - 1
    i, j, pieces, rank = 0, 0, 0, 0.0
    while i < B and j < B:
        if source[i + 1] <= rank:
            i += 1
            continue
        if target[j + 1] <= rank + FRACTION_TOL:
            j += 1
            continue
        # ends that differ by rounding are merged, or mass would be moved across empty bins
        until = source[i + 1]
        if target[j + 1] < until - FRACTION_TOL:
            until = target[j + 1]
        share, width = source[i + 1] - source[i], edges[i + 1] - edges[i]
        begin[pieces] = edges[i] + width * ((rank - source[i]) / share)
        end[pieces] = edges[i] + width * ((until - source[i]) / share)
        share, width = target[j + 1] - target[j], edges[j + 1] - edges[j]
        first = min(max((rank - target[j]) / share, 0.0), 1.0)
        last = min(max((until - target[j]) / share, 0.0), 1.0)
        to[pieces] = edges[j] + width * first
        reach = end[pieces] - begin[pieces]
        gain = edges[j] + width * last - to[pieces]
        slope[pieces] = gain / reach if reach > 0.0 else 0.0
        pieces += 1
        rank = until
    return pieces


@njit(cache=True, nogil=True, error_model="numpy")
def move_values(values, source, target, edges, out):
    """Write each value's counterpart of the same rank under the target's distribution.

    Parameters
    ----------
    values : (n,) float
    source, target, edges
        As of `plan_transport`; the edges include all values.
    out : (n,) float, written
    """
    size = 2 * edges.size
    begin, end, to, slope = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    pieces = plan_transport(source, target, edges, begin, end, to, slope)
    reach = end[pieces - 1] - begin[0]
    scale = TABLE_CELLS / reach if reach > 0.0 else 0.0
    least, most = np.empty(TABLE_CELLS, np.int16), np.empty(TABLE_CELLS, np.int16)
    bound_bins(begin, pieces, scale, least, most)
    for k in range(values.size):
        x = float(values[k])
        p = find_edge(x, begin, scale, least, most)
        out[k] = to[p] + slope[p] * (min(max(x, begin[p]), end[p]) - begin[p])
