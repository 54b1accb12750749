"""Look up fiber reflectance of homogeneous half spaces in a stored Monte Carlo table.

Lengths are in units of 1 / sigma_s', so that one table over the distance and sigma_a / sigma_s'
serves every medium of g = 0.8 and eta = 1.4 under air: R_f = sigma_s'^2 F(r sigma_s', sigma_a /
sigma_s'). The table is package data made by ``tools/make_white_fiber.py`` from the photons of
`rigsim.fiber.profile`, for a source that is a point of numerical aperture 0.22 and for points of
detection of the same aperture; the fibers' cores are averaged over here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RectBivariateSpline, RegularGridInterpolator

from rigsim.arrays import Float64Array
from rigsim.fiber.profile import FiberGeometry

HENYEY_GREENSTEIN_G: Final = 0.8
ETA: Final = 1.4
NUMERICAL_APERTURE: Final = 0.22
TABLE_FILE: Final = "white_fiber_mc.npz"

MAX_CONTINUED_ABSORPTION: Final = 0.01
"""sigma_a / sigma_s' up to which the table is continued beyond its last distance: there its decay
is that of diffusion to a thousandth."""

DIFFUSION_BLEND_RANGE: Final = (12.0, 20.0)
"""Range of distances over which estimates of each node are blended into the common estimate of
diffused light (`log_diffuse_reflectance`)."""
MEAN_SQUARE_DEPTH: Final = 17.5
"""Mean square depth of that light's source and its image, in 1 / sigma_s'^2: from the photons of
sigma_a / sigma_s' of 0.003 to 0.009, which alone give 17.0 to 17.4, and with less certainty 19.5 of
none."""
NODES_PER_KNOT: Final = 4.0
"""Nodes of distance with a common error: the knots of the smoothing spline."""
DISC_RADII, DISC_TURNS = 2, 6
"""Points in a core: rings, and points on each."""


class FiberTableError(ValueError):
    """Error for a medium or a distance outside the table."""


def decay_rate(absorption: ArrayLike) -> Float64Array:
    """Return the approximate decay of log F per unit of distance, far away.

    Parameters
    ----------
    absorption
        sigma_a / sigma_s', any shape, >= 0.
    """
    a = np.asarray(absorption, np.float64)
    return np.asarray(np.sqrt(3.0 * a * (1.0 + a)) / (1.0 + 0.4 * a))


def distance_axis(distance: ArrayLike) -> Float64Array:
    """Return the coordinate in which F is smooth, of distances in 1 / sigma_s'."""
    return np.asarray(np.log(np.asarray(distance, np.float64) + 0.4))


def absorption_axis(absorption: ArrayLike) -> Float64Array:
    """Return the coordinate in which F is smooth, of sigma_a / sigma_s'."""
    return np.asarray(np.log1p(20.0 * np.sqrt(np.asarray(absorption, np.float64))))


@dataclass(frozen=True, slots=True, eq=False)
class FiberTable:
    """Table of fiber reflectance over distance and absorption."""

    distance: Float64Array
    """Nodes in 1 / sigma_s', increasing, > 0, shape (D,)."""
    absorption: Float64Array
    """Nodes of sigma_a / sigma_s', increasing from 0, shape (A,)."""
    shape: Float64Array
    """log(F distance) + decay(absorption) distance, shape (D, A)."""
    relative_error: Float64Array
    """Relative standard error of F, shape (D, A)."""
    recipe: Mapping[str, Any]
    """Parameters of the table's Monte Carlo."""

    @staticmethod
    @cache
    def load() -> FiberTable:
        """Return the stored table, read-only."""
        path = resources.files("rigsim").joinpath("data", TABLE_FILE)
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {
                name: np.asarray(stored[name], np.float64)
                for name in ("distance", "absorption", "shape", "relative_error")
            }
            recipe = json.loads(str(stored["recipe"]))
        for array in arrays.values():
            array.setflags(write=False)
        return FiberTable(**arrays, recipe=recipe)

    def covers(
        self, sigma_a_per_mm: float, sigma_s_prime_per_mm: float, fibers: FiberGeometry
    ) -> bool:
        """Return whether a medium under some fibers is inside the table."""
        if not sigma_s_prime_per_mm > 0.0:
            return False
        both = 0.5 * (fibers.core_mm + fibers.source_core_mm)
        near, far = min(fibers.radii_mm) - both, max(fibers.radii_mm) + both
        apertures = (fibers.numerical_aperture, fibers.source_numerical_aperture)
        return bool(
            apertures == (NUMERICAL_APERTURE, NUMERICAL_APERTURE)
            and near * sigma_s_prime_per_mm >= self.distance[0]
            and (
                far * sigma_s_prime_per_mm <= self.distance[-1]
                or sigma_a_per_mm / sigma_s_prime_per_mm <= MAX_CONTINUED_ABSORPTION
            )
            and sigma_a_per_mm / sigma_s_prime_per_mm <= self.absorption[-1]
        )

    def profile(
        self, sigma_a_per_mm: float, sigma_s_prime_per_mm: float, fibers: FiberGeometry
    ) -> tuple[Float64Array, Float64Array]:
        """Return the fibers' reflectance on a homogeneous medium.

        Parameters
        ----------
        sigma_a_per_mm, sigma_s_prime_per_mm
            Coefficients, 1/mm.
        fibers
            The fibers; both apertures 0.22.

        Returns
        -------
        reflectance_per_mm2, stderr : ndarray
            R_f in 1/mm^2 and its standard error, shape (F,). Errors of neighbors, and of similar
            media, are correlated.

        Raises
        ------
        FiberTableError
            Outside the table.

        Examples
        --------
        >>> r_f, error = FiberTable.load().profile(0.04, 1.5, FiberGeometry((0.3, 3.3)))
        >>> bool(r_f[0] > 20.0 * r_f[1] > 0.0), bool((error < 0.01 * r_f).all())
        (True, True)
        """
        if not self.covers(sigma_a_per_mm, sigma_s_prime_per_mm, fibers):
            raise FiberTableError(
                f"sigma_a, sigma_s': got {sigma_a_per_mm}, {sigma_s_prime_per_mm} 1/mm, expected "
                "both, and the fibers, inside the table"
            )
        apart, share = core_distances(fibers)
        scaled = apart * sigma_s_prime_per_mm
        a = sigma_a_per_mm / sigma_s_prime_per_mm
        shape, error = _splines()
        held = np.minimum(scaled, self.distance[-1])
        x = distance_axis(held)
        y = np.full_like(x, float(absorption_axis(a)))
        fall = float(decay_rate(a))
        log_f = shape.ev(x, y) - np.log(held) - fall * scaled
        # beyond the table: log_f is extrapolated with the slope of the last distance
        log_f += (log_diffuse_reflectance(scaled, a) + fall * scaled) - (
            log_diffuse_reflectance(held, a) + fall * held
        )
        each = share * np.exp(log_f)
        value = sigma_s_prime_per_mm**2 * each.sum(axis=1)
        relative = error(np.stack([x, y], axis=-1))
        return value, np.asarray((relative * each).sum(axis=1) / each.sum(axis=1) * value)


def log_diffuse_reflectance(distance: Float64Array, absorption: float) -> Float64Array:
    """Return the logarithm of diffuse light far from its source, up to a constant.

    That of a dipole in the depth: (1 + k d) exp(-k d) / d^3 with d^2 = distance^2 +
    `MEAN_SQUARE_DEPTH`, and k of transport theory to the second order of the phase function.

    Parameters
    ----------
    distance
        In 1 / sigma_s', any shape.
    absorption
        sigma_a / sigma_s'.
    """
    a = absorption
    k = np.sqrt(3.0 * a * (1.0 + a)) / (1.0 + 0.4 * a / (1.0 + HENYEY_GREENSTEIN_G))
    d = np.sqrt(distance**2 + MEAN_SQUARE_DEPTH)
    return np.asarray(np.log1p(k * d) - k * d - 3.0 * np.log(d))


def _pool_far_nodes(table: FiberTable) -> tuple[Float64Array, Float64Array]:
    """Return shape and error with far nodes of weak absorption estimated jointly."""
    shape, error = table.shape.copy(), table.relative_error.copy()
    near, far = DIFFUSION_BLEND_RANGE
    rows = table.distance > near
    x = table.distance[rows]
    share = np.clip(np.log(x / near) / np.log(far / near), 0.0, 1.0)
    for column in np.flatnonzero(table.absorption <= MAX_CONTINUED_ABSORPTION):
        a = float(table.absorption[column])
        curve = log_diffuse_reflectance(x, a) + np.log(x) + float(decay_rate(a)) * x
        weight = 1.0 / error[rows, column] ** 2
        level = (weight * (shape[rows, column] - curve)).sum() / weight.sum()
        shape[rows, column] += share * (curve + level - shape[rows, column])
        together = np.sqrt(NODES_PER_KNOT / weight.sum())
        error[rows, column] += share * (together - error[rows, column])
    return shape, error


@cache
def _splines() -> tuple[RectBivariateSpline, RegularGridInterpolator]:
    table = FiberTable.load()
    axes = distance_axis(table.distance), absorption_axis(table.absorption)
    shape, error = _pool_far_nodes(table)
    return RectBivariateSpline(*axes, shape, s=0.0), RegularGridInterpolator(axes, error)


@lru_cache(maxsize=8)
def core_distances(fibers: FiberGeometry) -> tuple[Float64Array, Float64Array]:
    """Return distances of pairs of points, one in each core, and their weights.

    Parameters
    ----------
    fibers
        The fibers.

    Returns
    -------
    distance_mm, share : ndarray
        Shape (F, pairs), mm, and weights that sum to 1 in each row.

    Examples
    --------
    >>> apart, share = core_distances(FiberGeometry((0.3,), 0.2, 0.2))
    >>> round(float(apart.min()), 2) >= 0.1, round(float((share * apart**2).sum()), 6)
    (True, 0.1)
    """
    one, weight = disc_quadrature(DISC_RADII, DISC_TURNS)
    target = 0.5 * fibers.core_mm * one
    source = 0.5 * fibers.source_core_mm * one
    offset = (target[:, None, :] - source[None, :, :]).reshape(-1, 2)
    share = np.outer(weight, weight).reshape(-1)
    radii = np.array(fibers.radii_mm)[:, None]
    apart = np.hypot(radii + offset[:, 0], offset[:, 1])
    return apart, np.broadcast_to(share, apart.shape)


def disc_quadrature(rings: int, points_per_ring: int) -> tuple[Float64Array, Float64Array]:
    """Return points in the unit disc, shape (rings turns, 2), and their fractions of its area.

    Examples
    --------
    >>> points, share = disc_quadrature(2, 6)
    >>> round(float(share @ (points**2).sum(axis=1)), 12)  # the mean of r^2
    0.5
    """
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt(0.5 * (nodes + 1.0))
    turn = 2.0 * math.pi * (np.arange(points_per_ring) + 0.25) / points_per_ring
    points = radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return points.reshape(-1, 2), np.repeat(0.5 * weights / points_per_ring, points_per_ring)
