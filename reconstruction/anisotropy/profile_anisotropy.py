"""Estimate ratio and axis of anisotropy from whole profiles, each compared with the mean one.

If scattering depends on the direction and absorption does not, the profile along direction i is
the mean one times the effect of the different scattering in a model of tissue::

    R_i(r_k) = exp(b_i) m_k T(r_k; sigma_a, sigma_s' exp(d_i)) / T(r_k; sigma_a, sigma_s')

``d_i`` is the log of sigma_s' over the mean, ``b_i`` the log of the head's coupling and
``m_k`` the mean reading of fiber k. T, `model.photon_table`, is used for differences alone: errors
common to all directions, of a fiber (gain, distance, stray light) or of the model, are in m_k. More
scattering is more light near the source and less far away, and so differs from coupling. Readings
are compared without logarithms: those within noise, even negative ones, are used without bias.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model import photon_table
from model.checks import Checks
from reconstruction.anisotropy.estimation import Anisotropy, AnisotropyError, Errors, estimate
from reconstruction.arrays import BoolArray, Float64Array

Table: TypeAlias = Callable[[Float64Array, Float64Array], tuple[Float64Array, Float64Array]]
"""sigma_a (B, 1, 1) and sigma_s' (B, N, 1) to T and dT / d sigma_s', (B, N, F)."""

MIN_COMPARED_FIBERS = 6
"""Fewest fibers compared: a direction has two parameters of its own."""
MIN_FIBER_SIGNAL_SIGMAS = 3.0
"""Standard errors by which a fiber's reading, averaged over directions, must exceed 0. A test of
each single reading would select those that noise made large."""
LOG_RATIO_MODEL_ERROR = 0.05
"""Relative error of logs of ratios of sigma_tr, by a model whose scattering is equal in all
directions: against fits of each direction, and Monte Carlo of directed scattering."""
N_COMPARISON_ROUNDS = 10
MAX_COMPARISON_STEP = 0.3
"""Largest change of b and d per round."""
MIN_ROUND_RATIO = 1e-3
"""Least ratio of a mean reading to that of the round before."""
MIN_READING_ERROR = 1e-4
"""Relative error of readings if none is given and a variance is 0."""


@dataclass(frozen=True, slots=True)
class ProfileComparison:
    """Relative sigma_s' by direction, from N profiles of each of B series.

    Attributes
    ----------
    log_scattering, stderr : ndarray, shape (N, B)
        d, about a mean of 0, and its standard error from the variances; 0 and infinity where not
        valid.
    coupling : ndarray, shape (N, B)
        b, about a mean of 0.
    valid : ndarray of bool, shape (N, B)
    used : ndarray of bool, shape (B, F)
        Fibers that are used.
    """

    log_scattering: Float64Array
    stderr: Float64Array
    coupling: Float64Array
    valid: BoolArray
    used: BoolArray


def compare_profiles(
    readings: Float64Array,
    variance: Float64Array,
    valid: BoolArray,
    sigma_a_per_mm: Float64Array,
    sigma_s_prime_per_mm: Float64Array,
    table: Table,
    *,
    floor: float,
) -> ProfileComparison:
    """Fit relative scattering and coupling to profiles of several directions.

    Parameters
    ----------
    readings, variance, valid : ndarray, shape (N, B, F)
        Readings, 1/mm^2, their variances, and which are used; values of the others are ignored.
    sigma_a_per_mm, sigma_s_prime_per_mm : ndarray, shape (B,)
        Of the mean profile, 1/mm; a series with one not finite and above 0 is not valid.
    table : callable
        Model of tissue at the fibers' distances.
    floor : float
        Relative error of each reading not included in its variance, 0 or more.

    Returns
    -------
    ProfileComparison
    """
    known = np.isfinite(sigma_a_per_mm) & np.isfinite(sigma_s_prime_per_mm)
    known &= (sigma_a_per_mm > 0) & (sigma_s_prime_per_mm > 0)
    a = np.where(known, sigma_a_per_mm, 1.0)[:, None, None]
    s = np.where(known, sigma_s_prime_per_mm, 1.0)[:, None, None]
    good = valid.transpose(1, 0, 2)
    y: Float64Array = np.where(good, readings.transpose(1, 0, 2), 0.0)
    v: Float64Array = np.where(good, variance.transpose(1, 0, 2), 0.0)
    series, n, _ = y.shape
    count = np.maximum(good.sum(axis=1), 1)
    m = y.sum(axis=1) / count
    noise = np.sqrt(v.sum(axis=1) / count)
    used = (2 * good.sum(axis=1) > n) & (m > MIN_FIBER_SIGNAL_SIGMAS * noise)
    used &= table(a, s)[0][:, 0] > 0
    comparable = ((good & used[:, None]).sum(axis=2) >= MIN_COMPARED_FIBERS) & known[:, None]
    keep = good & used[:, None] & comparable[..., None]
    m = np.asarray(np.where(used, m, 1.0)[:, None], np.float64)
    relative = np.where((keep & (v == 0)).any(axis=(1, 2)), max(floor, MIN_READING_ERROR), floor)
    relative = relative[:, None, None]
    at_mean = np.where(used[:, None], table(a, s)[0], 1.0)
    d, b = np.zeros((series, n)), np.zeros((series, n))
    inverse = np.zeros((series, n, 2, 2))
    members = np.maximum(comparable.sum(axis=1), 1)[:, None]
    # alternate: Gauss-Newton for (b, d) of each direction with m fixed, then m in closed form
    for _ in range(N_COMPARISON_ROUNDS):
        scattering = s * np.exp(d)[..., None]
        light, slope = table(a, scattering)
        shape = light / at_mean * np.exp(b)[..., None]
        model = m * shape
        weight = np.where(keep, 1.0 / np.where(keep, v + (relative * model) ** 2, 1.0), 0.0)
        by_d = model * scattering * slope / np.where(light > 0, light, 1.0)
        off = y - model
        entries = [(weight * p * q).sum(axis=2) for p, q in ((model, model), (model, by_d))]
        entries.append((weight * by_d * by_d).sum(axis=2))
        bb, bd, dd = (
            np.where(comparable, e, fill) for e, fill in zip(entries, (1.0, 0.0, 1.0), strict=True)
        )
        normal = np.stack([np.stack([bb, bd], -1), np.stack([bd, dd], -1)], -2)
        inverse = np.linalg.inv(normal)
        right = np.stack(
            [(weight * model * off).sum(axis=2), (weight * by_d * off).sum(axis=2)], -1
        )
        step = np.clip(
            (inverse @ right[..., None])[..., 0], -MAX_COMPARISON_STEP, MAX_COMPARISON_STEP
        )
        b, d = (np.where(comparable, x + step[..., k], 0.0) for k, x in enumerate((b, d)))
        b, d = (
            np.where(comparable, x - x.sum(axis=1, keepdims=True) / members, 0.0) for x in (b, d)
        )
        shape = table(a, s * np.exp(d)[..., None])[0] / at_mean * np.exp(b)[..., None]
        below = (weight * shape**2).sum(axis=1, keepdims=True)
        fresh = (weight * shape * y).sum(axis=1, keepdims=True) / np.where(below > 0, below, 1.0)
        m = np.where(below > 0, np.maximum(fresh, MIN_ROUND_RATIO * m), m)
    stderr = np.where(comparable, np.sqrt(inverse[..., 1, 1]), np.inf)
    return ProfileComparison(
        d.T, stderr.T, b.T, comparable.T, used & comparable.any(axis=1)[:, None]
    )


def estimate_from_profiles(
    angle_rad: ArrayLike,
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    variance: ArrayLike | None = None,
    *,
    sigma_a_per_mm: ArrayLike,
    sigma_s_prime_per_mm: ArrayLike,
    eta: float = 1.4,
    g: float = 0.8,
    valid: ArrayLike | None = None,
    floor: float = 0.01,
    errors: Errors = "relative",
    outliers: bool = True,
) -> Anisotropy:
    """Estimate ratio and axis of anisotropy from profiles.

    Each profile is compared with the mean one (:func:`compare_profiles`), which gives the relative
    scattering along its direction and the head's coupling. Errors of a fiber that are common to
    all directions cancel, and so does coupling: errors are several times smaller than those of
    sigma_tr fitted direction by direction (bench stage "anisotropy").

    Parameters
    ----------
    angle_rad : array_like, shape (N,)
        See `anisotropy.estimate`.
    radius_mm : array_like, shape (F,)
        Distances of the fibers from the source, mm, at least 0.
    reflectance_per_mm2 : array_like, shape (N, ..., F)
        Profiles, 1/mm^2.
    variance : array_like, shape (N, ..., F), optional
        Of the profiles.
    sigma_a_per_mm, sigma_s_prime_per_mm : array_like, shape (...)
        Fitted to the mean profile, or means of fits, 1/mm. Where one is not finite and above 0
        nothing is fitted.
    eta, g
        See `model.photon_table.reflectance`.
    valid : array_like of bool, shape (N, ..., F), optional
        Readings to use; those that are not finite are never used.
    floor : float
        Relative error of each reading not included in its variance, at least 0: coupling
        that differs between fibers.
    errors, outliers
        See `anisotropy.estimate`.

    Returns
    -------
    Anisotropy
        Directions with too few readings are not in `used`. The ratio's standard error includes
        `LOG_RATIO_MODEL_ERROR`.

    Raises
    ------
    AnisotropyError
        See `anisotropy.estimate`; also for distances or a floor out of range.

    Examples
    --------
    >>> angle, r = np.deg2rad(np.arange(16) * 22.5), 0.3 + 0.25 * np.arange(28)
    >>> scattering = 1.5 * (1 - 0.2 * np.cos(2 * (angle - 0.3)))
    >>> profiles = photon_table.reflectance(r, 0.04, scattering[:, None])
    >>> found = estimate_from_profiles(
    ...     angle, r, profiles, sigma_a_per_mm=0.04, sigma_s_prime_per_mm=1.5
    ... )
    >>> round(float(found.ratio), 2), round(float(found.axis_rad), 2)
    (1.22, 0.3)
    """
    angle = np.asarray(angle_rad, np.float64)
    check = Checks(AnisotropyError)
    r = check.numbers("radius_mm", radius_mm, ("F",), interval="[0, inf)")
    profiles = np.asarray(reflectance_per_mm2, np.float64)
    check.shape("reflectance_per_mm2", profiles, (angle.size, *profiles.shape[1:-1], r.size))
    check.within("floor", floor, "[0, inf)")
    if errors == "absolute" and variance is None:
        raise AnisotropyError('variance: got none, expected one; give it or use errors="relative"')
    of_each: Float64Array = np.zeros_like(profiles)
    if variance is not None:
        of_each = np.asarray(variance, np.float64)
    good = np.ones(profiles.shape, bool) if valid is None else np.array(valid, bool)
    check.shape("variance", of_each, profiles.shape)
    check.shape("valid", good, profiles.shape)
    good = good & np.isfinite(profiles) & np.isfinite(of_each)
    check.within("variance", of_each[good], "[0, inf)")
    shape = profiles.shape[1:-1]
    a = check.broadcast("sigma_a_per_mm", np.asarray(sigma_a_per_mm, np.float64), shape).reshape(-1)
    s = np.asarray(sigma_s_prime_per_mm, np.float64)
    s = check.broadcast("sigma_s_prime_per_mm", s, shape).reshape(-1)

    def table(
        absorption: Float64Array, scattering: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        found = photon_table.derivatives(r, absorption, scattering, eta=eta, g=g)
        return found.reflectance_per_mm2, found.by_sigma_s_prime

    rows = (angle.size, -1, r.size)
    found = compare_profiles(
        profiles.reshape(rows), of_each.reshape(rows), good.reshape(rows), a, s, table, floor=floor
    )
    fitted = found.valid
    a, s = np.where(fitted, a, 1.0), np.where(fitted, s, 1.0) * np.exp(found.log_scattering)
    sigma_tr = np.sqrt(3.0 * a * (a + s))
    stderr = sigma_tr * 0.5 * s / (a + s) * np.where(fitted, found.stderr, 1.0)
    back = (angle.size, *shape)
    return estimate(
        angle,
        sigma_tr.reshape(back),
        stderr.reshape(back),
        valid=fitted.reshape(back),
        errors=errors,
        outliers=outliers,
        log_ratio_error=LOG_RATIO_MODEL_ERROR,
    )
