"""Light that goes from the walls of furrows to other walls, by how much of the sky they hide.

A point of a relief sees other skin wherever it does not see the sky. What that skin sends out has
spread inside over more than a furrow's width, so that all of it near by is taken as equally
bright; then the light it sends to a point is that brightness times the share of the point's
hemisphere that is hidden, less what the boundary sends back. On skin's shallow relief what hides
the sky stands low, and light goes from wall to wall nearly along the surface, where the boundary
lets little through.
"""

import math
from typing import Final

import numpy as np
from numba import njit, prange

from rigsim.arrays import Float32Array
from rigsim.light.relief_shadow import horizon_tangent
from rigsim.light.surface_brdf import transmittance

ELEVATION_NODES: Final = 6
"""Elevations at which what passes two boundaries is summed."""

_ELEVATION_QUADRATURE: Final = np.polynomial.legendre.leggauss(ELEVATION_NODES)


def hidden_share(
    height_um: Float32Array,
    normals: Float32Array,
    *,
    margin: int,
    pixel_um: float,
    sectors: int,
    boundaries: bool = False,
) -> Float32Array:
    """Return which share of its sky the relief hides from each point, weighted with the cosine.

    Parameters
    ----------
    height_um
        Heights with ``margin`` more samples on all sides, um, shape (H + 2 m, W + 2 m).
    normals
        Unit normals, shape (H, W, 3); +z is up.
    margin
        See there, >= 0.
    pixel_um
        Distance of samples, um, > 0.
    sectors
        Directions in which horizons are found, >= 1.
    boundaries
        Whether directions are weighed with what passes out of one wall and into the other: the
        square of the transmittance at the point's own angle, which stands for both.

    Returns
    -------
    ndarray of float32
        Shape (H, W), 0 to 1.

    Notes
    -----
    In a direction with the normal's part n_t along it and n_z up, between the point's own tangent
    plane at elevation a and the horizon at b, ``int (n_t cos e + n_z sin e) cos e de`` is
    ``n_t (e / 2 + sin 2e / 4) + n_z sin^2 e / 2`` from a to b; with boundaries it is summed at
    `ELEVATION_NODES` elevations. Level skin around the field closes the sky below the horizontal.

    Examples
    --------
    A wall that leans by 60 degrees hides (1 - cos 60) / 2 of its sky below the horizontal:

    >>> tilt = math.radians(60.0)
    >>> lean = np.zeros((1, 1, 3), np.float32) + np.float32([math.sin(tilt), 0.0, math.cos(tilt)])
    >>> found = hidden_share(np.zeros((1, 1), np.float32), lean, margin=0, pixel_um=1, sectors=64)
    >>> round(float(found[0, 0]), 3)
    0.25
    """
    out = np.zeros(normals.shape[:2], np.float32)
    normals = np.ascontiguousarray(normals, np.float32)
    inner = slice(margin, -margin or None)
    for k in range(sectors):
        angle = 2.0 * math.pi * k / sectors
        tangent = horizon_tangent(height_um, pixel_um=pixel_um, azimuth_rad=angle)
        part = np.ascontiguousarray(tangent[inner, inner])
        if boundaries:
            _add_through(out, normals, part, angle, 2.0 / sectors, *_ELEVATION_QUADRATURE)
        else:
            _add(out, normals, part, angle, 2.0 / sectors)
    return np.clip(out, 0.0, 1.0)


@njit(parallel=True, cache=True)
def _add(out, normals, tangent, angle, share):  # type: ignore[no-untyped-def]
    """Add one sector's hidden part; ``share`` is its width over pi."""
    right, up = math.cos(angle), math.sin(angle)
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            along = normals[i, j, 0] * right + normals[i, j, 1] * up
            upward = normals[i, j, 2]
            low = math.atan2(-along, upward)
            high = math.atan(tangent[i, j])
            if high <= low:
                continue
            ends = (high - low) / 2.0 + (math.sin(2.0 * high) - math.sin(2.0 * low)) / 4.0
            rise = (math.sin(high) ** 2 - math.sin(low) ** 2) / 2.0
            out[i, j] += share * (along * ends + upward * rise)


@njit(parallel=True, cache=True)
def _add_through(out, normals, tangent, angle, share, nodes, weights):  # type: ignore[no-untyped-def]
    """Add one sector's hidden part as it passes two boundaries."""
    right, up = math.cos(angle), math.sin(angle)
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            along = normals[i, j, 0] * right + normals[i, j, 1] * up
            upward = normals[i, j, 2]
            low = math.atan2(-along, upward)
            high = math.atan(tangent[i, j])
            if high <= low:
                continue
            total = 0.0
            for k in range(nodes.shape[0]):
                e = 0.5 * (low + high) + 0.5 * (high - low) * nodes[k]
                cosine = along * math.cos(e) + upward * math.sin(e)
                passed = transmittance(min(cosine, 1.0)) if cosine > 0.0 else 0.0
                total += weights[k] * cosine * math.cos(e) * passed * passed
            out[i, j] += share * 0.5 * (high - low) * total
