"""Bound the sizes of effects of light on a pixel before anything is rendered.

Each size is a bound or a worst case, since it decides whether a scene must build the effect: a size
that is too large costs time; one that is too small would bias the ground truth.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float64Array
from rigsim.geometry.mesh import Mesh
from rigsim.light.interreflection import Interreflection, interreflection_for
from rigsim.render import Caster


def edge_loss(sigmas_mm: ArrayLike, weights: ArrayLike, pixel_mm: float) -> Float64Array:
    """Return the fraction of a lit pixel's light that scatters across the edge of a shadow.

    Parameters
    ----------
    sigmas_mm, weights
        Gaussians that approximate the lateral profile: standard deviations along an axis in mm,
        shape (K,), and their weights, shape (C, K), rows summing to 1.
    pixel_mm
        Side of a pixel on the subject, mm, > 0. The edge lies along one side of the pixel.

    Returns
    -------
    ndarray
        Fraction of the pixel's light in each channel, shape (C,), 0 to 0.5.

    Notes
    -----
    For one Gaussian the mean of ``Q(x / sigma)`` over ``0 < x < p``; for ``p`` far above ``sigma``
    this is ``sigma / (p sqrt(2 pi))``. The loss is only inversely proportional to the pixel's
    size, so that it vanishes only for pixels hundreds of mean free paths wide.

    Examples
    --------
    >>> edge_loss([1.0], [[1.0]], 100.0).round(5).tolist()
    [0.00399]
    >>> edge_loss([1.0], [[1.0]], 1e-4).round(3).tolist()
    [0.5]
    """
    sigma = np.asarray(sigmas_mm, np.float64)
    weight = np.atleast_2d(np.asarray(weights, np.float64))
    if not pixel_mm > 0.0:
        raise ValueError(f"pixel_mm: got {pixel_mm}, expected > 0")
    if sigma.size == 0:
        return np.zeros(len(weight))
    q = pixel_mm / sigma
    # With q = p / sigma, integrate by parts, where phi is the normal density (Q' = -phi):
    # int_0^q Q(t) dt / q = Q(q) + (1 / sqrt(2 pi) - phi(q)) / q.
    tail = np.array([0.5 * math.erfc(t / math.sqrt(2.0)) for t in q])
    density = np.exp(-0.5 * q * q) / math.sqrt(2.0 * math.pi)
    mean = tail + (1.0 / math.sqrt(2.0 * math.pi) - density) / q
    return np.asarray(weight @ mean, np.float64)


def exchange_unless_flat(caster: Caster) -> Interreflection | None:
    """Return the exchange of light between the patches of a surface; None: it is flat.

    Parameters
    ----------
    caster
        The mesh; its texture coordinates must not overlap.
    """
    return None if is_flat(caster.mesh) else interreflection_for(caster)


def max_exchange_fraction(exchange: Interreflection | None) -> float:
    """Bound the fraction of the light leaving a surface that falls back onto its hollows.

    Parameters
    ----------
    exchange
        Exchange between its patches, see `exchange_unless_flat`.

    Returns
    -------
    float
        The largest sum over patches of the exchange with one patch for a reflectance of 1, 0 to 1;
        0 for a flat or convex surface.
    """
    if exchange is None:
        return 0.0
    return float(np.asarray(exchange.exchange.sum(axis=1)).max(initial=0.0))


def is_flat(mesh: Mesh) -> bool:
    """Return whether a mesh is planar: a planar mesh neither shades nor lights itself."""
    points = np.asarray(mesh.vertices_mm, np.float64)
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[-1] <= 1e-6 * max(spread[0], 1e-300))


def interreflection_over_direct(exchange_fraction: float, reflectance: float) -> float:
    """Return interreflected light over the brightest direct light.

    Parameters
    ----------
    exchange_fraction
        See `max_exchange_fraction`, 0 to below 1.
    reflectance
        The largest diffuse reflectance, 0 to 1.

    Examples
    --------
    >>> round(interreflection_over_direct(0.2, 0.5), 4)
    0.1111
    """
    once = exchange_fraction * reflectance
    if not 0.0 <= once < 1.0:
        raise ValueError(
            f"exchange_fraction, reflectance: got {exchange_fraction}, {reflectance}, "
            "expected 0 to 1"
        )
    return once / (1.0 - once)


def max_irradiance(mesh: Mesh, positions_mm: ArrayLike, weights_mm2: ArrayLike) -> float:
    """Bound the irradiance at any point of a mesh under all lights together.

    Parameters
    ----------
    mesh
        The mesh.
    positions_mm
        The lights, shape (L, 3).
    weights_mm2
        Energy of each light over that of a plate at the origin in all lights that face the camera,
        mm^2, shape (L,): a surface facing light k at distance d receives ``weight / d^2`` of it.

    Returns
    -------
    float
        Relative to the plate's irradiance: the sum over lights as if each point faced each light at
        the distance of its nearest point. Lights that graze the plate irradiate facing surfaces
        many times more.

    Examples
    --------
    >>> from rigsim.geometry.mesh import build_mesh
    >>> plate = build_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], [[0, 0], [1, 0], [0, 1]])
    >>> round(max_irradiance(plate, [[0, 0, 100]], [100.0**2]), 3)
    1.0
    """
    points = np.asarray(mesh.vertices_mm, np.float64)
    total = 0.0
    for place, weight in zip(
        np.asarray(positions_mm, np.float64), np.asarray(weights_mm2, np.float64), strict=True
    ):
        squared = float(np.min(np.sum((place - points) ** 2, axis=1)))
        total += float(weight) / max(squared, 1e-12)
    return total
