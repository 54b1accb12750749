"""Build a tree over weighted points, split along the longest side, with moments of the nodes."""

# mypy: allow-untyped-defs

import math

import numpy as np
from numba import njit

LEAF_SIZE = 8
"""Largest number of sources in a leaf."""

# columns of a node's summary
CENTER, RADIUS, REACH, AREA, SPREAD = 0, 3, 4, 5, 6
"""Centroid (3), distance of its farthest source, largest distance plus reach of a source, area,
and area's second moment about it."""
NODE_COLUMNS = 8


@njit(cache=True, nogil=True)
def split_sources(position, leaf):
    """Return the sources' order and the nodes' first and last sources, parents before children.

    ``position`` is (S, 3). A node ``i`` with ``skip[i] == i + 1`` is a leaf; any other's halves are
    node ``i + 1`` and what follows it.
    """
    count = len(position)
    order = np.arange(count)
    most = 4 * max(count // leaf, 1) + 4
    low, high = np.empty(most, np.int32), np.empty(most, np.int32)
    stack = np.empty((128, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, count
    top, nodes = 1, 0
    while top > 0:
        top -= 1
        lo, hi = stack[top, 0], stack[top, 1]
        low[nodes], high[nodes] = lo, hi
        nodes += 1
        if hi - lo <= leaf:
            continue
        axis, longest = 0, -1.0
        for k in range(3):
            least = most_ = position[order[lo], k]
            for i in range(lo, hi):
                value = position[order[i], k]
                least, most_ = min(least, value), max(most_, value)
            if most_ - least > longest:
                axis, longest = k, most_ - least
        middle = (lo + hi) // 2
        _select(position, order, axis, lo, hi - 1, middle)
        stack[top, 0], stack[top, 1] = middle, hi
        stack[top + 1, 0], stack[top + 1, 1] = lo, middle
        top += 2
    skip = np.empty(nodes, np.int32)
    for i in range(nodes - 1, -1, -1):
        j = i + 1
        while j < nodes and low[j] < high[i]:
            j = skip[j]
        skip[i] = j
    return order, low[:nodes].copy(), high[:nodes].copy(), skip


@njit(cache=True, nogil=True)
def _select(position, order, axis, lo, hi, middle):
    """Reorder so that keys before ``middle`` do not exceed those after it (Hoare's select)."""
    while lo < hi:
        pivot = position[order[(lo + hi) // 2], axis]
        i, j = lo, hi
        while i <= j:
            while position[order[i], axis] < pivot:
                i += 1
            while position[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            hi = j
        elif middle >= i:
            lo = i
        else:
            return


@njit(cache=True, nogil=True)
def summarize_nodes(position, area, reach, low, high):
    """Return the summary of each node, (N, 8), from sources in the tree's order."""
    nodes = len(low)
    found = np.zeros((nodes, NODE_COLUMNS), np.float32)
    for node in range(nodes):
        total = x = y = z = 0.0
        for i in range(low[node], high[node]):
            a = area[i]
            total += a
            x += a * position[i, 0]
            y += a * position[i, 1]
            z += a * position[i, 2]
        # rounded first: distances refer to the stored float32 centroid
        found[node, 0], found[node, 1], found[node, 2] = x / total, y / total, z / total
        x, y, z = np.float64(found[node, 0]), np.float64(found[node, 1]), np.float64(found[node, 2])
        farthest = moment = widest = 0.0
        for i in range(low[node], high[node]):
            away = (position[i, 0] - x) ** 2 + (position[i, 1] - y) ** 2 + (position[i, 2] - z) ** 2
            moment += area[i] * away
            farthest = max(farthest, away)
            widest = max(widest, math.sqrt(away) + reach[i])
        found[node, RADIUS] = math.sqrt(farthest)
        found[node, REACH] = widest
        found[node, AREA] = total
        found[node, SPREAD] = moment
    return found


@njit(cache=True, nogil=True)
def light_moments(position, area, entered, low, high, node_summary):
    """Return light (3) and its first moments about the centroid (3 x 3) of each node, (N, 12)."""
    nodes = len(low)
    found = np.zeros((nodes, 12), np.float32)
    moment = np.empty(12)
    for node in range(nodes):
        moment[:] = 0.0
        for i in range(low[node], high[node]):
            for c in range(3):
                power = area[i] * entered[i, c]
                moment[c] += power
                for k in range(3):
                    moment[3 + 3 * c + k] += power * (position[i, k] - node_summary[node, k])
        for k in range(12):
            found[node, k] = moment[k]
    return found
