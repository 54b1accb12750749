"""How much effects of light can change a pixel, told before anything is rendered.

Each is a bound or a worst case, since what it decides is whether a scene must hold the effect: it
may be too large, which costs time, but not too small, which would cost truth.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.mesh import Mesh
from rigsim.render import Caster

EXCHANGE_PATCHES = 32
"""Texels along one side of the coarse texture on which exchange between skin is estimated."""


def edge_loss(sigmas_mm: ArrayLike, weights: ArrayLike, pixel_mm: float) -> float:
    """Return how much of a lit pixel's light spreads out of it across the edge of a shadow.

    Parameters
    ----------
    sigmas_mm, weights
        Gaussians that stand for the lateral profile: standard deviations along an axis in mm,
        shape (K,), and their weights, shape (C, K), rows summing to 1.
    pixel_mm
        Side of a pixel on the subject, mm, > 0. The edge lies along one side of the pixel.

    Returns
    -------
    float
        Part of the pixel's light, of the channel that loses most, 0 to 0.5.

    Notes
    -----
    For one Gaussian the mean of ``Q(x / sigma)`` over ``0 < x < p``; for ``p`` far above ``sigma``
    this is ``sigma / (p sqrt(2 pi))``: it falls with the pixel's size and no faster, so that a
    pixel has to be hundreds of mean free paths wide before it forgets them.

    Examples
    --------
    >>> round(edge_loss([1.0], [[1.0]], 100.0), 5)
    0.00399
    >>> round(edge_loss([1.0], [[1.0]], 1e-4), 3)
    0.5
    """
    sigma = np.asarray(sigmas_mm, np.float64)
    weight = np.atleast_2d(np.asarray(weights, np.float64))
    if not pixel_mm > 0.0:
        raise ValueError(f"pixel_mm: got {pixel_mm}, expected > 0")
    if sigma.size == 0:
        return 0.0
    q = pixel_mm / sigma
    # int_0^q Q(t) dt / q with Q the upper tail of the normal distribution
    tail = np.array([0.5 * math.erfc(t / math.sqrt(2.0)) for t in q])
    density = np.exp(-0.5 * q * q) / math.sqrt(2.0 * math.pi)
    mean = tail + (1.0 / math.sqrt(2.0 * math.pi) - density) / q
    return float((weight @ mean).max())


def exchange_share(caster: Caster) -> float:
    """Return which part of the light that leaves a surface falls back onto its hollows at most.

    Parameters
    ----------
    caster
        The mesh; its texture coordinates must not overlap.

    Returns
    -------
    float
        The largest sum over patches of the exchange with one patch for a reflectance of 1, 0 to 1;
        0 for what is flat or bulges outwards.
    """
    if is_flat(caster.mesh):
        return 0.0
    from rigsim.skin_bounce import SkinBounce

    exchange = SkinBounce(caster, patches=EXCHANGE_PATCHES).exchange
    return float(np.asarray(exchange.sum(axis=1)).max(initial=0.0))


def is_flat(mesh: Mesh) -> bool:
    """Return whether all of a mesh lies in one plane: then it neither shades nor lights itself."""
    points = np.asarray(mesh.vertices_mm, np.float64)
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[-1] <= 1e-6 * max(spread[0], 1e-300))


def bounced(share: float, reflectance: float) -> float:
    """Return the light that comes by way of other skin over the brightest direct light.

    Parameters
    ----------
    share
        See `exchange_share`, 0 to below 1.
    reflectance
        The largest diffuse reflectance, 0 to 1.

    Examples
    --------
    >>> round(bounced(0.2, 0.5), 4)
    0.1111
    """
    once = share * reflectance
    if not 0.0 <= once < 1.0:
        raise ValueError(f"share, reflectance: got {share}, {reflectance}, expected 0 to 1")
    return once / (1.0 - once)


def steepest_slope(slope_x: NDArray[np.floating], slope_y: NDArray[np.floating]) -> float:
    """Return the steepest slope of a relief: a light above that elevation shines everywhere.

    Examples
    --------
    >>> steepest_slope(np.array([3.0, 0.0]), np.array([4.0, 0.0]))
    5.0
    """
    return float(np.hypot(slope_x, slope_y).max(initial=0.0))


def defocus_px(
    depth_mm: float, *, f_number: float, focal_mm: float, distance_mm: float, pixel_um: float
) -> float:
    """Return the diameter of the circle of confusion of a thin lens, pixels.

    Parameters
    ----------
    depth_mm
        Distance from the plane in focus towards the camera, mm, below ``distance_mm``.
    f_number
        Of the lens focused at infinity.
    focal_mm, distance_mm
        Image distance (the focal length of a pinhole model) and distance of the plane in focus, mm.
    pixel_um
        Side of a pixel, um.

    Examples
    --------
    >>> round(defocus_px(60, f_number=11, focal_mm=87, distance_mm=1000, pixel_um=7.5), 1)
    5.4
    """
    if not depth_mm < distance_mm:
        raise ValueError(f"depth_mm: got {depth_mm}, expected below {distance_mm}")
    magnification = focal_mm / distance_mm
    aperture_mm = focal_mm / (1.0 + magnification) / f_number
    blur_mm = aperture_mm * magnification * abs(depth_mm) / (distance_mm - depth_mm)
    return blur_mm * 1e3 / pixel_um
