"""Fit diffusion profiles by sums of Gaussians, for blurs in the page.

A dipole's radial reflectance, normalized to 1, is fitted by a few Gaussians. Their variances are
common to red, green and blue, so that one blur serves all three. The weights of each channel sum to
1, so that uniform light is preserved.

References
----------
d'Eon et al. 2007, doi:10.2312/EGWR/EGSR07/147-157, section 4 (sums of Gaussians).
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 9 (albedo and translucency to a dipole).
"""

import logging
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize, nnls
from scipy.special import erf

from model import dipole, fresnel
from model.solver_outcome import outcome_from_scipy
from skinrig.arrays import Float64Array
from skinrig.viewer.scene import SceneError

_log = logging.getLogger(__name__)

N_GAUSSIANS: Final = 4
"""Number of Gaussians, two passes each; edge error 0.1 % (three: 0.4 %; six: 0.01 %)."""
_RADIUS_NODES: Final = 240
_MAX_RELATIVE_RADIUS: Final = 12.0  # largest radius times sigma_tr, where e^-12 remains


@dataclass(frozen=True, slots=True, eq=False)
class GaussianProfile:
    """A normalized diffusion profile as a sum of Gaussians.

    Attributes
    ----------
    variances_mm2 : ndarray of float64, shape (G,)
        Variance along one axis, increasing.
    weights : ndarray of float64, shape (G, 3)
        Weights, at least 0; those of a channel sum to 1.
    edge_error : ndarray of float64, shape (3,)
        Maximum difference of the edge responses of profile and sum, fraction of the light.
    radial_error : ndarray of float64, shape (3,)
        Relative RMS difference of the radial profiles, weighted by ring.
    """

    variances_mm2: Float64Array
    weights: Float64Array
    edge_error: Float64Array
    radial_error: Float64Array

    def facts(self, origin: str) -> dict[str, Any]:
        """Return variances, weights, errors and source for the page, as JSON values."""
        names = ("variances_mm2", "weights", "edge_error", "radial_error")
        return {**{name: getattr(self, name).tolist() for name in names}, "origin": origin}


def fit_gaussians(
    r_d: ArrayLike, sigma_tr_per_mm: ArrayLike, count: int = N_GAUSSIANS
) -> GaussianProfile:
    """Fit Gaussians to the dipoles of three channels.

    Parameters
    ----------
    r_d
        Total diffuse reflectance, (3,), above 0 and below 1.
    sigma_tr_per_mm
        Effective transport coefficient, (3,), 1/mm, above 0.
    count
        Number of Gaussians, at least 1.

    Returns
    -------
    GaussianProfile
        Variances and weights that minimize the squared error of the dipoles' edge response.

    Raises
    ------
    SceneError
        If values are out of range.

    Examples
    --------
    >>> found = fit_gaussians([0.45, 0.3, 0.2], [0.5, 0.9, 1.1])
    >>> bool((found.edge_error < 0.01).all()), found.weights.sum(axis=0).round(9).tolist()
    (True, [1.0, 1.0, 1.0])
    """
    albedo = np.asarray(r_d, np.float64)
    transport = np.asarray(sigma_tr_per_mm, np.float64)
    if albedo.shape != (3,) or not np.all((albedo > 0.0) & (albedo < 1.0)):
        raise SceneError(f"r_d: got {albedo.tolist()}, expected three values above 0, below 1")
    if transport.shape != (3,) or not np.all((transport > 0.0) & np.isfinite(transport)):
        raise SceneError(f"sigma_tr_per_mm: got {transport.tolist()}, expected three above 0")
    if count < 1:
        raise SceneError(f"count: got {count}, expected at least 1")
    radii, profiles = _dipoles(albedo, transport)
    at = np.concatenate([[0.0], np.geomspace(0.02, 8.0, 80)]) / float(np.median(transport))
    lines = np.stack([_edge_of(radii, one, at) for one in profiles.T], axis=-1)
    middle = 1.0 / float(np.median(transport))

    def variances(place: Float64Array) -> Float64Array:
        narrow, step = place
        return np.asarray(np.exp(2.0 * (narrow + np.arange(count) * abs(step))))

    def off(place: Float64Array) -> float:
        bases = _edges(variances(place), at)
        return float(np.sum((bases @ _weights(bases, lines) - lines) ** 2))

    starts = [(np.log(share * middle), 0.5) for share in (0.03, 0.1, 0.3)]
    best = min(
        (minimize(off, s, method="Nelder-Mead", options={"xatol": 1e-3}) for s in starts),
        key=lambda one: float(one.fun),
    )
    outcome_from_scipy(best, float(best.fun)).warn_unless_converged("profile's Gaussians", _log)
    found = variances(best.x)
    weights = _weights(_edges(found, at), lines)
    used = weights.max(axis=1) > 1e-6
    found, weights = found[used], weights[used] / weights[used].sum(axis=0)
    shapes = np.exp(-(radii[:, None] ** 2) / (2.0 * found)) / (2.0 * np.pi * found)
    sums = shapes @ weights
    ring = radii[:, None] * np.gradient(radii)[:, None]
    radial = np.sqrt(np.sum(ring * (sums - profiles) ** 2, 0) / np.sum(ring * profiles**2, 0))
    miss = np.abs(_edges(found, at) @ weights - lines).max(axis=0)
    return GaussianProfile(found, weights, miss, radial)


def _dipoles(albedo: Float64Array, transport: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return radii, mm, and the normalized profiles at them, (n, 3), 1/mm^2."""
    sigma_a, sigma_s = dipole.coefficients(
        dipole.invert_to_deficit(albedo, fresnel.ETA_SKIN), transport
    )
    radii = np.geomspace(
        1e-4 / transport.max(), _MAX_RELATIVE_RADIUS / transport.min(), _RADIUS_NODES
    )
    values = dipole.reflectance(radii[:, None], sigma_a, sigma_s, fresnel.ETA_SKIN)
    return radii, values / albedo


def _edge_of(radii: Float64Array, profile: Float64Array, positions: Float64Array) -> Float64Array:
    """Return the edge response of a radial profile: its fraction beyond lines at distances.

    The fraction of a ring of radius r beyond a line at distance x < r is arccos(x / r) / pi.
    """
    fine = np.geomspace(radii[0], radii[-1], 8 * len(radii))
    values = np.exp(np.interp(np.log(fine), np.log(radii), np.log(np.maximum(profile, 1e-300))))
    mass = 2.0 * np.pi * fine**2 * values * np.gradient(np.log(fine))
    mass /= mass.sum()  # compensates the truncation at the last radius
    dark = np.arccos(np.minimum(positions[:, None] / fine, 1.0)) / np.pi
    return np.asarray(1.0 - dark @ mass)


def _edges(variances: Float64Array, positions: Float64Array) -> Float64Array:
    return np.asarray(0.5 + 0.5 * erf(positions[:, None] / np.sqrt(2.0 * variances)))


def _weights(bases: Float64Array, target: Float64Array) -> Float64Array:
    """Fit non-negative weights that sum to 1, (G, 3)."""
    firm = 1e3  # weight of the additional equation: sum = 1
    rows = np.vstack([bases, np.full((1, bases.shape[1]), firm)])
    found = np.stack([nnls(rows, np.append(one, firm))[0] for one in target.T], axis=-1)
    return np.asarray(found / found.sum(axis=0))
