"""Fresnel reflection at a smooth dielectric surface, and its exact averages over directions."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks

ETA_SKIN = 1.4
"""Refractive index of skin relative to air, used where a paper does not give its own.

Jimenez 2010 gives none (Donner 2008 has 1.4); Weyrich 2005 writes "about 1.3".
"""

MAX_INDEX = 100.0
"""Largest relative index of averages over directions: beyond it 1 - F_dr vanishes in rounding."""
_GAUSS_POINTS = 96  # the external average is smooth: 96 Gauss points are exact to rounding


def reflectance(cos_incident: ArrayLike, eta: float) -> Float64Array:
    """Return the unpolarized Fresnel reflectance of a smooth surface.

    Parameters
    ----------
    cos_incident
        Cosine of the angle of incidence, in [0, 1], any shape.
    eta
        Refractive index behind the surface over that before it. Below 1 (light leaving a denser
        medium) the reflectance is 1 beyond the critical angle.

    Returns
    -------
    ndarray
        Reflectance in [0, 1], shaped like `cos_incident`; NaN where the cosine is.

    Raises
    ------
    ValueError
        For an `eta` that is not finite and above 0.

    Examples
    --------
    >>> round(float(reflectance(1.0, 1.5)), 6)
    0.04
    """
    Checks().within("eta", eta, "(0, inf)")
    mu_i = np.asarray(cos_incident, dtype=np.float64)
    with np.errstate(over="ignore"):  # an overflow to infinity is beyond the critical angle, too
        sin2_t = (1.0 - mu_i**2) / eta / eta  # the square of a huge index overflows
    mu_t = np.sqrt(np.maximum(0.0, 1.0 - sin2_t))
    # At grazing incidence on an index-matched surface both terms are 0/0; the limit is 0.
    sum_s = mu_i + eta * mu_t
    sum_p = eta * mu_i + mu_t
    safe_s = np.where(sum_s > 0.0, sum_s, 1.0)
    safe_p = np.where(sum_p > 0.0, sum_p, 1.0)
    r_s = (mu_i - eta * mu_t) / safe_s
    r_p = (eta * mu_i - mu_t) / safe_p
    return np.asarray(np.where(sin2_t >= 1.0, float(eta != 1.0), 0.5 * (r_s**2 + r_p**2)))


def normal_reflectance(eta: float) -> float:
    """Return the reflectance at normal incidence, ((eta - 1)/(eta + 1))^2; eta as above.

    Examples
    --------
    >>> round(normal_reflectance(1.4), 6)
    0.027778
    """
    Checks().within("eta", eta, "(0, inf)")
    return float(((eta - 1.0) / (eta + 1.0)) ** 2)


@lru_cache(maxsize=64)
def diffuse_external(eta: float) -> float:
    """Return the exact reflectance for diffuse light from air, 2 int F(mu) mu dmu, eta >= 1.

    Examples
    --------
    >>> round(diffuse_external(1.4), 6)
    0.076812
    """
    mu, weight = _gauss_unit()
    return float(2.0 * np.sum(weight * mu * reflectance(mu, _denser(eta))))


@lru_cache(maxsize=64)
def diffuse_internal(eta: float) -> float:
    """Return the exact reflectance F_dr for diffuse light from inside, eta >= 1.

    Notes
    -----
    1 - F_dr = (1 - F_external)/eta^2, by reciprocity: both integrals are over the same rays.

    Examples
    --------
    >>> round(diffuse_internal(1.4), 6)
    0.528985
    """
    return 1.0 - (1.0 - diffuse_external(eta)) / eta / eta


@lru_cache(maxsize=64)
def diffuse_internal_flux_moment(eta: float) -> float:
    """Return 3 int F(mu) mu^2 dmu for light from inside, the second moment of Haskell et al.

    References
    ----------
    Haskell et al. 1994, doi:10.1364/JOSAA.11.002727.

    Examples
    --------
    >>> round(diffuse_internal_flux_moment(1.4), 6)
    0.388783
    """
    # With mu' the cosine outside, mu dmu = mu' dmu' / eta^2 inside the critical cone.
    mu_out, weight = _gauss_unit()
    mu_in = np.sqrt(1.0 - (1.0 - mu_out**2) / _denser(eta) ** 2)
    transmitted = 3.0 * np.sum(weight * mu_out * mu_in * (1.0 - reflectance(mu_out, eta))) / eta**2
    return float(1.0 - transmitted)


def boundary_factor(eta: float) -> float:
    """Return A = (1 + F_dr)/(1 - F_dr) of the extrapolated boundary, from the exact average.

    Examples
    --------
    >>> round(boundary_factor(1.4), 5)
    3.24615
    """
    f_dr = diffuse_internal(eta)
    return (1.0 + f_dr) / (1.0 - f_dr)


def _denser(eta: float) -> float:
    Checks().within("eta", eta, f"[1, {MAX_INDEX}]")
    return float(eta)


@lru_cache(maxsize=1)
def _gauss_unit() -> tuple[Float64Array, Float64Array]:
    node, weight = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
    return 0.5 * (node + 1.0), 0.5 * weight
