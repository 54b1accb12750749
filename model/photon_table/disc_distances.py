"""Average radial profiles over two fiber cores by the distribution of point distances.

A detector measures the reflectance profile averaged over all pairs of a point of the source's core
and one of the detector's. This average over four coordinates depends only on the distribution of
the pairs' distance; a few Gauss nodes of that distribution serve a whole family of profiles.
"""

from functools import lru_cache

import numpy as np

from model.arrays import Float64Array, Int64Array
from model.checks import Checks

_MIN_CORE_RATIO = 1e-6  # cores below this fraction of the largest length are points
# center distances over the sum of core radii from which fewer nodes suffice
_NEAR_RATIO, _FAR_RATIO = 3.0, 10.0
_NODE_COUNTS = (8, 5, 3)  # relative error below 1e-5 for the profiles of tissue: see the tests
_RINGS, _ANGLES = 48, 96


@lru_cache(maxsize=4096)
def distance_rule(
    radius_mm: float, core_mm: float, source_core_mm: float
) -> tuple[Float64Array, Float64Array]:
    """Return distances and weights that average a radial profile over two cores.

    Parameters
    ----------
    radius_mm
        Distance of the cores' centers in mm, >= 0.
    core_mm, source_core_mm
        Diameters of the two cores in mm, >= 0; 0 is a point.

    Returns
    -------
    distances_mm, weights : ndarray
        At most 8 nodes in mm and their weights, of sum 1. Exact for polynomials of the distance
        divided by the distance, so that profiles like 1/r near 0 are averaged accurately.

    Examples
    --------
    >>> distance, weight = distance_rule(0.3, 0.2, 0.2)
    >>> round(float(weight @ distance**2), 6)  # r^2 + (a^2 + b^2)/2
    0.1
    >>> [values.tolist() for values in distance_rule(1.0, 0.0, 0.0)]  # two points
    [[1.0], [1.0]]
    """
    Checks().broadcast_together(
        "[0, inf)", radius_mm=radius_mm, core_mm=core_mm, source_core_mm=source_core_mm
    )
    # scaled to the largest length, squares neither underflow nor overflow; a power of two is exact
    exponent = int(np.frexp(max(radius_mm, core_mm, source_core_mm))[1])
    radius, core, source = (
        float(np.ldexp(length, -exponent)) for length in (radius_mm, core_mm, source_core_mm)
    )
    a, b = 0.5 * core, 0.5 * source
    # its part of a squared distance, 1e-12, is lost in the recurrence of the Gauss rule
    least = _MIN_CORE_RATIO * max(radius, a, b)
    a, b = (0.0 if half < least else half for half in (a, b))
    reach = a + b
    if reach == 0.0:
        return np.array([radius_mm]), np.array([1.0])
    count = _NODE_COUNTS[int(radius > _NEAR_RATIO * reach) + int(radius > _FAR_RATIO * reach)]
    offset, offset_weight = _offsets(a, b)
    angle = np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    across = radius + offset[:, None] * np.cos(angle)
    distance = np.hypot(across, offset[:, None] * np.sin(angle)).ravel()
    weight = np.repeat(offset_weight / _ANGLES, _ANGLES)
    node, node_weight = _gauss(distance, weight / distance, count)
    return np.ldexp(node, exponent), node_weight * node


def distance_rules(
    radii_mm: Float64Array, core_mm: float, source_core_mm: float
) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Return the rules of several radii concatenated, for compiled loops.

    Parameters
    ----------
    radii_mm
        Distances of the cores' centers in mm, shape (n,), > 0 where both cores are points.
    core_mm, source_core_mm
        Diameters of the two cores in mm, >= 0.

    Returns
    -------
    starts, log_distances, weights : ndarray
        Radius k has the nodes starts[k] to starts[k + 1], shape (n + 1,); natural logarithms of mm.

    Raises
    ------
    ValueError
        For a radius of 0 between points, where profiles are infinite.

    Examples
    --------
    >>> distance_rules(np.array([0.0, 2.5]), 0.2, 0.0)[0].tolist()
    [0, 8, 11]
    """
    if core_mm == 0.0 and source_core_mm == 0.0:
        if np.any(radii_mm == 0.0):
            raise ValueError("radius_mm: got 0 between points, where R is infinite; expected > 0")
        return np.arange(radii_mm.size + 1), np.log(radii_mm), np.ones(radii_mm.size)
    rules = [distance_rule(float(r), core_mm, source_core_mm) for r in radii_mm]
    starts = np.cumsum([0, *(node.size for node, _ in rules)]).astype(np.int64)
    if not rules:
        return starts, np.empty(0), np.empty(0)
    node, weight = (np.concatenate(parts) for parts in zip(*rules, strict=True))
    return starts, np.log(node), weight


def _offsets(a: float, b: float) -> tuple[Float64Array, Float64Array]:
    """Return the distribution of the length of the difference of points in concentric discs."""
    small, large = min(a, b), max(a, b)
    node, weight = np.polynomial.legendre.leggauss(_RINGS)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    if small == 0.0:
        s = large * node
        return s, 2.0 * s / large * weight
    inner, outer = large - small, large + small
    # The lens of two discs has square-root ends at inner and outer: a cosine substitution for s
    # makes it smooth.
    bend = 0.5 * (1.0 - np.cos(np.pi * node))
    s = np.concatenate([inner * node, inner + (outer - inner) * bend])
    ds = np.concatenate(
        [inner * weight, (outer - inner) * 0.5 * np.pi * np.sin(np.pi * node) * weight]
    )
    density = 2.0 * np.pi * s * _shared_area(s, small, large) / (np.pi * small * large) ** 2
    keep = ds > 0.0
    return s[keep], (density * ds)[keep]


def _shared_area(s: Float64Array, small: float, large: float) -> Float64Array:
    """Return the area of overlap of two discs whose centers are `s` apart."""
    square = (small + large - s) * (s + small - large) * (s - small + large) * (s + small + large)
    kite = np.sqrt(np.maximum(square, 0.0))
    first = np.arctan2(kite, s**2 + small**2 - large**2)
    second = np.arctan2(kite, s**2 + large**2 - small**2)
    # the large disc's segment in small terms: sector less triangle would cancel all digits
    sine = np.sin(second)
    return np.asarray(
        small**2 * (first - np.sin(first) * np.cos(first))
        + large**2 * (second - sine * np.cos(second))
    )


def _gauss(x: Float64Array, weight: Float64Array, count: int) -> tuple[Float64Array, Float64Array]:
    """Return the Gauss rule of a discrete measure by Stieltjes' recurrence (Golub, Welsch)."""
    total = weight.sum()
    diagonal, off = np.empty(count), np.empty(count)
    before, p = np.zeros_like(x), np.full_like(x, 1.0 / np.sqrt(total))
    for k in range(count):
        diagonal[k] = weight @ (x * p * p)
        q = (x - diagonal[k]) * p - (off[k - 1] * before if k else 0.0)
        off[k] = np.sqrt(weight @ (q * q))
        before, p = p, q / off[k]
    matrix = np.diag(diagonal) + np.diag(off[:-1], 1) + np.diag(off[:-1], -1)
    node, vector = np.linalg.eigh(matrix)
    return node, total * vector[0] ** 2
