"""Seeded nets of polygons in the plane: distance to the nearest edge, and a number per polygon.

The net is a Voronoi diagram of one jittered point per lattice cell, hashed from the seed: a
function of the position alone, so a larger patch of the same seed contains the smaller one.
"""

import math

import numpy as np
from numba import njit, prange

from rigsim.arrays import Float32Array, Float64Array


def polygon_edge_distance(
    x: Float64Array, y: Float64Array, *, jitter: float, seed: int
) -> tuple[Float32Array, Float32Array]:
    """Return the distance of points from the edges of a polygon net.

    Parameters
    ----------
    x, y
        Positions in units of the mean distance between polygon centers, same shape.
    jitter
        How irregular the polygons are: 0 is a square lattice, 1 moves centers over whole cells.
    seed
        Any integer.

    Returns
    -------
    distance : ndarray of float32
        Distance to the nearest edge, same unit and shape, 0 on an edge.
    number : ndarray of float32
        A random number in [0, 1) that all points of a polygon share.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0.0, 5.0, 50), np.linspace(0.0, 5.0, 50))
    >>> distance, number = polygon_edge_distance(x, y, jitter=0.8, seed=1)
    >>> bool(distance.min() >= 0.0), bool(distance.max() < 1.2)
    (True, True)
    """
    salt = np.uint32(np.random.SeedSequence([seed & 0xFFFFFFFF, 77]).generate_state(1)[0])
    flat_x = np.ascontiguousarray(x, np.float64).reshape(-1)
    flat_y = np.ascontiguousarray(y, np.float64).reshape(-1)
    distance, number = _net(flat_x, flat_y, float(jitter), salt)
    return distance.reshape(x.shape), number.reshape(x.shape)


@njit(cache=True, inline="always")
def _hash(i, j, salt):  # type: ignore[no-untyped-def]
    h = np.uint32(i) * np.uint32(0x9E3779B1) ^ np.uint32(j) * np.uint32(0x85EBCA77) ^ salt
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(h ^ (h >> np.uint32(16)))


@njit(cache=True, inline="always")
def _site(i, j, jitter, salt):  # type: ignore[no-untyped-def]
    h = _hash(i, j, salt)
    u = (h & np.uint32(0xFFFF)) / 65536.0
    v = (h >> np.uint32(16)) / 65536.0
    return i + 0.5 + jitter * (u - 0.5), j + 0.5 + jitter * (v - 0.5)


@njit(parallel=True, cache=True)
def _net(x, y, jitter, salt):  # type: ignore[no-untyped-def]
    distance = np.empty(x.size, np.float32)
    number = np.empty(x.size, np.float32)
    for n in prange(x.size):
        px, py = x[n], y[n]
        ci, cj = math.floor(px), math.floor(py)
        nearest, ni, nj, nx, ny = 1e30, 0, 0, 0.0, 0.0
        for i in range(ci - 1, ci + 2):
            for j in range(cj - 1, cj + 2):
                sx, sy = _site(i, j, jitter, salt)
                d = (sx - px) ** 2 + (sy - py) ** 2
                if d < nearest:
                    nearest, ni, nj, nx, ny = d, i, j, sx, sy
        edge = 1e30
        for i in range(ni - 2, ni + 3):
            for j in range(nj - 2, nj + 3):
                if i == ni and j == nj:
                    continue
                sx, sy = _site(i, j, jitter, salt)
                ax, ay = sx - nx, sy - ny
                length = math.sqrt(ax * ax + ay * ay)
                if length < 1e-9:
                    continue
                d = ((0.5 * (sx + nx) - px) * ax + (0.5 * (sy + ny) - py) * ay) / length
                edge = min(edge, d)
        distance[n] = max(edge, 0.0)
        number[n] = _hash(ni, nj, salt ^ np.uint32(0xA511E9B3)) * 2.3283064e-10
    return distance, number
