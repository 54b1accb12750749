"""The diffusion dipole: reflectance profile, total reflectance (eq. 5) and its inverse.

The reduced albedo alpha' comes near 1 in weakly absorbing media, where the total reflectance has
an infinite slope. The functions on the `deficit`, 1 - alpha', keep all digits there.

References
----------
Jensen et al. 2001, doi:10.1145/383259.383319 (dipole).
Weyrich et al. 2006, doi:10.1145/1141911.1141987, eq. (5) and section 9 (the dome of 2005).
"""

import numpy as np
from numpy.typing import ArrayLike

from model import fresnel
from model.arrays import BoolArray, Float64Array
from model.checks import Checks

MAX_COEFFICIENT = 1e100
"""Upper limit of a coefficient, 1/mm, or a distance, mm, of a profile: its cube is still finite."""
_MAX_STEPS = 80  # bisection alone needs 60 for all digits; Newton steps are usually 5


class ReflectanceOutlierError(ValueError):
    """Error for a total reflectance that no reduced albedo has."""


def reflectance(
    radius_mm: ArrayLike, sigma_a_per_mm: ArrayLike, sigma_s_prime_per_mm: ArrayLike, eta: float
) -> Float64Array:
    """Return the dipole's radial profile of diffuse reflectance around a narrow beam.

    Parameters
    ----------
    radius_mm
        Distance from the beam, mm, 0 to 1e100; broadcast with the coefficients.
    sigma_a_per_mm, sigma_s_prime_per_mm
        Absorption and reduced scattering, 1/mm, 0 to 1e100.
    eta
        Refractive index of the medium over that of its surroundings, at least 1.

    Returns
    -------
    ndarray
        Reflectance per area, 1/mm^2; 0 without scattering. Its integral over the plane
        is :func:`total_reflectance` of the reduced albedo.

    Raises
    ------
    ValueError
        For arguments that are negative, not finite or above 1e100, or whose shapes do not
        broadcast.

    Examples
    --------
    >>> float(reflectance(1.0, 0.032, 0.74, 1.3).round(5))
    0.02202
    """
    r, sigma_a, sigma_s = Checks().broadcast_together(
        f"[0, {MAX_COEFFICIENT}]",
        radius_mm=radius_mm,
        sigma_a_per_mm=sigma_a_per_mm,
        sigma_s_prime_per_mm=sigma_s_prime_per_mm,
    )
    A = fresnel.boundary_factor(eta)
    scatters = sigma_s > 0.0
    sigma_t = np.where(scatters, sigma_a + sigma_s, 1.0)
    # in transport lengths, so that no size of the medium overflows
    decay = np.sqrt(3.0 * (sigma_a / sigma_t))
    far = np.minimum(r * sigma_t, MAX_COEFFICIENT)
    profile = np.zeros(r.shape)
    for z in (1.0, 1.0 + 4.0 / 3.0 * A):
        d = np.hypot(far, z)
        profile = profile + z * (1.0 + decay * d) * np.exp(-decay * d) / d**3
    per_area = sigma_s * sigma_t * profile / (4.0 * np.pi)
    return np.asarray(np.where(scatters, per_area, 0.0))


def total_reflectance(albedo_prime: ArrayLike, eta: float) -> Float64Array:
    """Return the total diffuse reflectance R_d of a semi-infinite medium, eq. (5).

    Parameters
    ----------
    albedo_prime
        Reduced albedo alpha' = sigma_s' / (sigma_a + sigma_s'), in [0, 1], any shape.
    eta
        Refractive index of the medium over that of its surroundings, at least 1.

    Returns
    -------
    ndarray
        R_d in [0, 1], shaped like `albedo_prime`, 1 at alpha' = 1 for every `eta`.

    Examples
    --------
    >>> float(total_reflectance(0.74 / (0.74 + 0.032), 1.3).round(4))
    0.436
    """
    alpha = Checks().numbers("albedo_prime", albedo_prime, interval="[0, 1]")
    return np.asarray(alpha * _survival(np.sqrt(3.0 * (1.0 - alpha)), eta))


def absorbed_fraction(deficit: ArrayLike, eta: float) -> Float64Array:
    """Return 1 - R_d for the deficit 1 - alpha', without cancellation near alpha' = 1.

    Examples
    --------
    >>> float(absorbed_fraction(0.0, 1.4))
    0.0
    >>> 1e-10 < float(absorbed_fraction(1e-20, 1.4)) < 1e-9
    True
    """
    delta = Checks().numbers("deficit", deficit, interval="[0, 1]")
    lost, _ = _lost(np.sqrt(3.0 * delta), eta)
    return np.asarray(lost)


def is_outlier(r_d: ArrayLike) -> BoolArray:
    """Return where a total reflectance lies outside [0, 1] or is not a number.

    Examples
    --------
    >>> is_outlier([0.5, 1.02, -0.01]).tolist()
    [False, True, True]
    """
    value = np.asarray(r_d, dtype=np.float64)
    return np.asarray(~((value >= 0.0) & (value <= 1.0)))


def invert_total_reflectance(r_d: ArrayLike, eta: float) -> Float64Array:
    """Return the reduced albedo alpha' of a total reflectance, the inverse of eq. (5).

    Parameters
    ----------
    r_d
        Total diffuse reflectance in [0, 1], any shape.
    eta
        Refractive index of the medium over that of its surroundings, at least 1.

    Returns
    -------
    ndarray
        alpha' in [0, 1], monotone in `r_d`; NaN exactly where :func:`is_outlier`. Near R_d = 1 it
        rounds to 1: use :func:`invert_to_deficit` where 1 - alpha' matters.

    Raises
    ------
    ReflectanceOutlierError
        For a single number outside [0, 1]; arrays carry NaN instead.

    Examples
    --------
    >>> float(invert_total_reflectance(0.4360, 1.3).round(3))
    0.959
    >>> invert_total_reflectance([0.0, 1.0, 1.1], 1.3).tolist()
    [0.0, 1.0, nan]
    """
    target = np.asarray(r_d, dtype=np.float64)
    q = _solve(target, eta)
    alpha = 1.0 - q**2 / 3.0
    # alpha' = R_d / (R_d / alpha') keeps the digits of a small alpha', which 1 - deficit loses.
    dark = np.asarray(target < 0.5)
    return np.asarray(np.where(dark, np.minimum(target / _survival(q, eta), 1.0), alpha))


def invert_to_deficit(r_d: ArrayLike, eta: float) -> Float64Array:
    """Return 1 - alpha' of a total reflectance, with all its digits near R_d = 1.

    Parameters, shapes and outliers as :func:`invert_total_reflectance`.

    Examples
    --------
    >>> deficit = invert_to_deficit(1.0 - 1e-9, 1.3)
    >>> bool(0.0 < deficit < 1e-18)
    True
    """
    return np.asarray(_solve(np.asarray(r_d, dtype=np.float64), eta) ** 2 / 3.0)


def coefficients(
    deficit: ArrayLike, sigma_tr_per_mm: ArrayLike
) -> tuple[Float64Array, Float64Array]:
    """Return absorption and reduced scattering from albedo and translucency (section 9).

    Parameters
    ----------
    deficit
        1 - alpha', in (0, 1], broadcast with `sigma_tr_per_mm`.
    sigma_tr_per_mm
        Effective transport coefficient, 1/mm, at least 0; 1/sigma_tr is the translucency.

    Returns
    -------
    sigma_a_per_mm, sigma_s_prime_per_mm : ndarray
        1/mm.

    Raises
    ------
    ValueError
        For a deficit of 0 (a medium that absorbs nothing has sigma_tr = 0 for any scattering).

    Examples
    --------
    >>> a, s = coefficients(0.032 / 0.772, effective_transport(0.032, 0.74))
    >>> float(a.round(6)), float(s.round(6))
    (0.032, 0.74)
    """
    delta = Checks().numbers("deficit", deficit, interval="[0, 1]")
    if np.any(delta == 0.0):
        raise ValueError("deficit: got 0, expected above 0 (sigma_t' is undefined); mask R_d = 1")
    sigma_tr = Checks().numbers("sigma_tr_per_mm", sigma_tr_per_mm, interval="[0, inf)")
    sigma_t = sigma_tr / np.sqrt(3.0 * delta)
    return np.asarray(delta * sigma_t), np.asarray((1.0 - delta) * sigma_t)


def effective_transport(sigma_a_per_mm: ArrayLike, sigma_s_prime_per_mm: ArrayLike) -> Float64Array:
    """Return sigma_tr = sqrt(3 sigma_a (sigma_a + sigma_s')), 1/mm, eq. (9).

    Examples
    --------
    >>> float(effective_transport(0.032, 0.74).round(4))
    0.2722
    """
    sigma_a = Checks().numbers("sigma_a_per_mm", sigma_a_per_mm, interval="[0, inf)")
    sigma_s = Checks().numbers("sigma_s_prime_per_mm", sigma_s_prime_per_mm, interval="[0, inf)")
    return np.asarray(np.sqrt(3.0 * sigma_a) * np.sqrt(sigma_a + sigma_s))


def _survival(q: Float64Array, eta: float) -> Float64Array:
    """Return R_d / alpha' at q = sqrt(3 (1 - alpha'))."""
    A = fresnel.boundary_factor(eta)
    return np.asarray(0.5 * (1.0 + np.exp(-4.0 / 3.0 * A * q)) * np.exp(-q))  # eq. (5)


def _lost(q: Float64Array, eta: float) -> tuple[Float64Array, Float64Array]:
    """Return 1 - R_d and its derivative by q; a sum of terms that are all at least 0."""
    # R_d = (1 - q^2 / 3) S with S = (exp(-q) + exp(-b q)) / 2, so 1 - R_d = (1 - S) + q^2 / 3 S;
    # expm1 keeps the digits of 1 - S near q = 0.
    b = 1.0 + 4.0 / 3.0 * fresnel.boundary_factor(eta)
    decayed = -0.5 * (np.expm1(-q) + np.expm1(-b * q))
    survived = 1.0 - decayed
    slope = 0.5 * (np.exp(-q) + b * np.exp(-b * q)) * (1.0 - q**2 / 3.0) + 2.0 / 3.0 * q * survived
    return np.asarray(decayed + q**2 / 3.0 * survived), np.asarray(slope)


def _solve(r_d: Float64Array, eta: float) -> Float64Array:
    """Return q = sqrt(3 (1 - alpha')) by Newton steps kept inside a shrinking bracket."""
    outlier = is_outlier(r_d)
    if r_d.ndim == 0 and outlier:
        raise ReflectanceOutlierError(f"r_d: got {float(r_d):g}, expected a value in [0, 1]")
    wanted = np.where(outlier, 0.5, 1.0 - r_d)  # exact subtraction for r_d >= 0.5 (Sterbenz)
    low, high = np.zeros(r_d.shape), np.full(r_d.shape, np.sqrt(3.0))
    # start: 1 - R_d is about q (1 + b) / 2 = q (1 + 2 A / 3) near q = 0
    q = np.minimum(wanted / (1.0 + 2.0 / 3.0 * fresnel.boundary_factor(eta)), high)
    for _ in range(_MAX_STEPS):
        lost, slope = _lost(q, eta)
        below = lost < wanted
        low, high = np.where(below, q, low), np.where(below, high, q)
        step = q - (lost - wanted) / slope
        # bisect where Newton's step leaves the bracket
        step = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        done = np.abs(step - q) <= 4e-16 * q
        q = step
        if np.all(done):
            break
    q = np.where(r_d >= 1.0, 0.0, np.where(r_d <= 0.0, np.sqrt(3.0), q))
    return np.asarray(np.where(outlier, np.nan, q))
