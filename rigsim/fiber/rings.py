"""Densities with which fibers collect light by distance: overlap of two discs on a ring.

Source and detection fiber are discs whose centers are a given distance apart. The densities here
are those of the displacement between a point in the one and a point in the other.
"""

from math import pi
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array, Int64Array

KERNEL_NODES: Final = 400
"""Nodes of a fiber's density over distance."""


def ring_kernels(
    radii_mm: Float64Array, detector_mm: float, source_mm: float
) -> tuple[Float64Array, Int64Array, Int64Array]:
    """Return the densities with which fibers collect light by its distance from the entry."""
    both = detector_mm + source_mm
    radii = radii_mm
    farthest = radii[-1] + both
    bins_per_mm = 2000.0 / farthest
    rows = np.zeros((len(radii), 3 + KERNEL_NODES + 1))
    for row, radius in zip(rows, radii, strict=True):
        low = max(0.0, radius - both)
        rho = np.linspace(low, radius + both, KERNEL_NODES)
        row[:3] = low, (KERNEL_NODES - 1) / (rho[-1] - rho[0]), bins_per_mm
        density = _ring_density(rho, radius, detector_mm, source_mm)
        # The walk interpolates linearly: normalize the integral of the interpolant to 1.
        a, b = rho[:-1], rho[1:]
        da, db = density[:-1], density[1:]
        held = 2.0 * pi * np.sum((b - a) / 6.0 * (da * (2.0 * a + b) + db * (a + 2.0 * b)))
        row[3:-1] = density / held
    edges = np.arange(2001) / bins_per_mm
    starts = np.searchsorted(radii + both, edges[:-1], side="right")
    stops = np.searchsorted(radii - both, edges[1:], side="left")
    return rows, starts.astype(np.int64), np.maximum(stops - starts, 0).astype(np.int64)


def _ring_density(
    rho_mm: Float64Array, radius_mm: float, detector_mm: float, source_mm: float
) -> Float64Array:
    """Return the mean over directions of the density of (point in one core - point in the other).

    That density, in 1/mm^2, is the overlap of the two discs at that displacement over the product
    of their areas; for a point source it is 1 / area within the detector's disc.
    """
    if source_mm == 0.0:
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = (rho_mm**2 + radius_mm**2 - detector_mm**2) / (2.0 * rho_mm * radius_mm)
        inside = rho_mm + radius_mm <= detector_mm
        cosine = np.where(inside, -1.0, np.nan_to_num(np.clip(cosine, -1.0, 1.0), nan=1.0))
        return np.asarray(np.arccos(cosine) / pi / (pi * detector_mm**2))
    # Dense directions over the overlap: the integrand is continuous and zero at its ends.
    both = detector_mm + source_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (rho_mm**2 + radius_mm**2 - both**2) / (2.0 * rho_mm * radius_mm)
    half = np.arccos(np.clip(np.nan_to_num(cosine, nan=-1.0, neginf=-1.0, posinf=1.0), -1.0, 1.0))
    half = np.where(rho_mm + radius_mm <= both, pi, half)
    nodes, weights = np.polynomial.legendre.leggauss(96)
    angle = 0.5 * half[:, None] * (nodes + 1.0)
    apart = np.sqrt(
        np.maximum(
            rho_mm[:, None] ** 2 + radius_mm**2 - 2.0 * rho_mm[:, None] * radius_mm * np.cos(angle),
            0.0,
        )
    )
    area = disc_overlap_area(apart, detector_mm, source_mm)
    mean = (area * weights).sum(axis=1) * 0.5 * half / pi
    return np.asarray(mean / (pi * detector_mm**2 * pi * source_mm**2))


def disc_overlap_area(distance: Float64Array, a: float, b: float) -> Float64Array:
    """Return the overlap of two discs of radii a and b at a distance of their centers."""
    small = min(a, b)
    d = np.clip(distance, abs(a - b) + 1e-12, a + b)
    first = np.arccos(np.clip((d * d + a * a - b * b) / (2.0 * d * a), -1.0, 1.0))
    second = np.arccos(np.clip((d * d + b * b - a * a) / (2.0 * d * b), -1.0, 1.0))
    product = (a + b - d) * (d + a - b) * (d - a + b) * (d + a + b)
    kite = 0.5 * np.sqrt(np.maximum(product, 0.0))
    lens = a * a * first + b * b * second - kite
    return np.where(distance <= abs(a - b), pi * small * small, lens)
