"""Seeded random fields over points in space: smooth noise, line networks, scattered spots.

Fields are functions of the position in mm, so patterns keep their size on every mesh and in every
texture; the seed is hashed with the lattice, so no state is kept and threads cannot change them.
"""

import math

import numpy as np
from numba import njit, prange

from rigsim.arrays import Float32Array, FloatArray

_GRADIENT_RMS = 0.191
"""Root mean square of the gradient noise with unit gradients; measured over 400,000 points."""


def _fibonacci_sphere(count: int) -> FloatArray:
    z = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    phi = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


_GRADIENT_VECTORS = _fibonacci_sphere(256)


def smooth_noise(points_mm: FloatArray, cells_mm: tuple[float, ...], *, seed: int) -> Float32Array:
    """Return smooth noise with structure of the given sizes, each contributing equally.

    Parameters
    ----------
    points_mm
        Positions, shape (..., 3), mm.
    cells_mm
        Lattice cells in mm, > 0.
    seed
        Any integer.

    Returns
    -------
    ndarray of float32
        Shape (...), zero mean and about unit variance over large areas; bounded by a few units.
    """
    flat = _flat(points_mm)
    total = np.zeros(len(flat), np.float32)
    for index, cell in enumerate(cells_mm):
        total += _gradient_noise(flat, float(cell), _salt(seed, index))
    scale = np.float32(1.0 / (_GRADIENT_RMS * math.sqrt(len(cells_mm))))
    return (total * scale).reshape(points_mm.shape[:-1])


def vessel_network(
    points_mm: FloatArray, cell_mm: float, width_mm: float, *, seed: int
) -> Float32Array:
    """Return a network of branching lines, such as small vessels make.

    Parameters
    ----------
    points_mm
        Positions, shape (..., 3), mm.
    cell_mm
        Typical distance between lines, mm.
    width_mm
        Width of a line, mm.
    seed
        Any integer.

    Returns
    -------
    ndarray of float32
        Shape (...), 1 on a line's center, falling to 0 on both sides.
    """
    flat = _flat(points_mm)
    # Lines are the zero crossings of smooth noise; its slope is about 1.6 units per cell.
    height = _gradient_noise(flat, cell_mm, _salt(seed, 0)) / np.float32(_GRADIENT_RMS)
    bend = _gradient_noise(flat, 2.7 * cell_mm, _salt(seed, 1)) / np.float32(_GRADIENT_RMS)
    across = (height + np.float32(0.6) * bend) * np.float32(cell_mm / (1.6 * width_mm))
    return np.exp(-across * across).reshape(points_mm.shape[:-1]).astype(np.float32)


def random_spots(
    points_mm: FloatArray,
    density: FloatArray,
    *,
    cell_mm: float,
    radius_mm: tuple[float, float],
    seed: int,
    softness: float = 6.0,
    min_radius_mm: float | FloatArray = 0.0,
) -> Float32Array:
    """Return round spots at random places.

    Parameters
    ----------
    points_mm
        Positions, shape (..., 3), mm.
    density
        Chance of a spot per cell, shape (...), 0 to 1.
    cell_mm
        Side of the cubic cell that holds at most one spot, mm.
    radius_mm
        Smallest and largest radius, mm; at most half a cell.
    seed
        Any integer.
    softness
        Exponent of the edge: 2 is soft, 8 is crisp.
    smallest_mm
        Spots are not drawn smaller than this, shape (...) or a number; their strength is reduced by
        the gain in area.

    Returns
    -------
    ndarray of float32
        Shape (...), 0 to 1.
    """
    flat = _flat(points_mm)
    chance = np.ascontiguousarray(np.broadcast_to(density, points_mm.shape[:-1]), np.float32)
    floor = np.ascontiguousarray(np.broadcast_to(min_radius_mm, points_mm.shape[:-1]), np.float32)
    sizes = (float(size) for size in (cell_mm, *radius_mm, softness))
    spots = _spots(flat, chance.reshape(-1), floor.reshape(-1), *sizes, _salt(seed, 0))
    return spots.reshape(points_mm.shape[:-1])


def _flat(points_mm: FloatArray) -> Float32Array:
    return np.ascontiguousarray(points_mm.reshape(-1, 3), np.float32)


def _salt(seed: int, index: int) -> np.uint32:
    sequence = np.random.SeedSequence([seed & 0xFFFFFFFF, index])
    return np.uint32(sequence.generate_state(1)[0])


@njit(cache=True, inline="always")
def _hash(i, j, k, salt):  # type: ignore[no-untyped-def]
    h = (
        np.uint32(i) * np.uint32(0x9E3779B1)
        ^ np.uint32(j) * np.uint32(0x85EBCA77)
        ^ np.uint32(k) * np.uint32(0xC2B2AE3D)
        ^ np.uint32(salt)
    )
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(h ^ (h >> np.uint32(16)))


@njit(cache=True, inline="always")
def _unit_float(h):  # type: ignore[no-untyped-def]
    return np.float32(h) * np.float32(2.3283064e-10)


@njit(parallel=True, cache=True)
def _gradient_noise(points, cell, salt):  # type: ignore[no-untyped-def]
    out = np.empty(points.shape[0], np.float32)
    for n in prange(points.shape[0]):
        x, y, z = points[n, 0] / cell, points[n, 1] / cell, points[n, 2] / cell
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        x, y, z = x - i, y - j, z - k
        # Quintic fade: second derivatives are continuous across cells.
        fx = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
        fy = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
        fz = z * z * z * (z * (z * 6.0 - 15.0) + 10.0)
        total = 0.0
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            h = _hash(i + a, j + b, k + c, salt)
            slope = _GRADIENT_VECTORS[h >> np.uint32(24)]
            dot = (x - a) * slope[0] + (y - b) * slope[1] + (z - c) * slope[2]
            weight = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)
            total += weight * dot
        out[n] = total
    return out


@njit(parallel=True, cache=True)
def _spots(points, density, floor, cell, r_low, r_high, softness, salt):  # type: ignore[no-untyped-def]
    out = np.zeros(points.shape[0], np.float32)
    for n in prange(points.shape[0]):
        if density[n] <= 0.0:
            continue
        x, y, z = points[n, 0] / cell, points[n, 1] / cell, points[n, 2] / cell
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        best = 0.0
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    h = _hash(i + a, j + b, k + c, salt)
                    if _unit_float(h) >= density[n]:
                        continue
                    h1 = _hash(i + a, j + b, k + c, salt ^ np.uint32(0x68E31DA4))
                    h2 = _hash(i + a, j + b, k + c, salt ^ np.uint32(0xB5297A4D))
                    h3 = _hash(i + a, j + b, k + c, salt ^ np.uint32(0x1B56C4E9))
                    h4 = _hash(i + a, j + b, k + c, salt ^ np.uint32(0x3C6EF372))
                    dx = (i + a + _unit_float(h1) - x) * cell
                    dy = (j + b + _unit_float(h2) - y) * cell
                    dz = (k + c + _unit_float(h3) - z) * cell
                    radius = r_low + (r_high - r_low) * _unit_float(h4)
                    drawn = max(radius, floor[n])
                    d2 = (dx * dx + dy * dy + dz * dz) / (drawn * drawn)
                    spot = (radius / drawn) ** 2 / (1.0 + d2 ** (0.5 * softness))
                    best = max(best, spot)
        # The tail of a spot ends where its cell's neighbors end.
        out[n] = best if best > 0.01 else 0.0
    return out
