"""Ratio and axis of anisotropy from whole profiles, each compared with the mean one.

What is wrong with a fibre in all directions cancels, and so does coupling
(`reconstruction.anisotropy.profile_comparison`).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from model import photon_table
from reconstruction.anisotropy import profile_comparison
from reconstruction.anisotropy.estimation import Anisotropy, AnisotropyError, Errors, estimate
from reconstruction.arrays import Float64Array


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
    collection: Literal["all", "fibre"] = "all",
    core_mm: float = 0.0,
    source_core_mm: float = 0.0,
    valid: ArrayLike | None = None,
    floor: float = 0.01,
    errors: Errors = "relative",
    outliers: bool = True,
) -> Anisotropy:
    """Tell ratio and axis of anisotropy from the profiles themselves.

    Each profile is compared with the mean one (`profile_comparison`) and asked how much more
    tissue scatters along its direction, and how well the head coupled. What is wrong with a fibre
    in all directions cancels, and so does coupling: errors are several times smaller than those of
    sigma_tr fitted direction by direction (bench stage "anisotropy").

    Parameters
    ----------
    angle_rad : array_like, shape (N,)
        As of `anisotropy.estimate`.
    radius_mm : array_like, shape (F,)
        Distances of the fibres from the source, mm, at least 0.
    reflectance_per_mm2 : array_like, shape (N, ..., F)
        Profiles, 1/mm^2.
    variance : array_like, shape (N, ..., F), optional
        Of the profiles.
    sigma_a_per_mm, sigma_s_prime_per_mm : array_like, shape (...)
        Fitted to the mean profile, or means of fits, 1/mm. Where one is not finite and above 0
        nothing is told.
    eta, g, collection, core_mm, source_core_mm
        As of `model.photon_table.reflectance`.
    valid : array_like of bool, shape (N, ..., F), optional
        Readings that count; those that are not finite never do.
    floor : float
        Relative error of each reading that its variance does not know of, at least 0: coupling
        that differs from fibre to fibre.
    errors, outliers
        As of `anisotropy.estimate`.

    Returns
    -------
    Anisotropy
        Directions with too few readings are not in `used`. The ratio's standard error holds
        `profile_comparison.LOG_RATIO_MODEL_ERROR`.

    Raises
    ------
    AnisotropyError
        As of `anisotropy.estimate`, and for distances or a floor out of range.

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
    r = np.asarray(radius_mm, np.float64)
    profiles = np.asarray(reflectance_per_mm2, np.float64)
    if r.ndim != 1 or not (np.isfinite(r).all() and (r >= 0).all()):
        raise AnisotropyError(f"radius_mm: got shape {r.shape}, expected (F,), finite, 0 or above")
    if profiles.ndim < 2 or (profiles.shape[0], profiles.shape[-1]) != (angle.size, r.size):
        raise AnisotropyError(
            f"reflectance_per_mm2: got shape {profiles.shape}, expected ({angle.size}, ..., "
            f"{r.size})"
        )
    if not (math.isfinite(floor) and floor >= 0):
        raise AnisotropyError(f"floor: got {floor}, expected 0 or above, finite")
    if errors == "absolute" and variance is None:
        raise AnisotropyError('variance: got none, expected one for "absolute" errors')
    of_each: Float64Array = np.zeros_like(profiles)
    if variance is not None:
        of_each = np.asarray(variance, np.float64)
    good = np.ones(profiles.shape, bool) if valid is None else np.array(valid, bool)
    for name, array in (("variance", of_each), ("valid", good)):
        if array.shape != profiles.shape:
            raise AnisotropyError(f"{name}: got shape {array.shape}, expected {profiles.shape}")
    good = good & np.isfinite(profiles) & np.isfinite(of_each)
    if (of_each[good] < 0).any():
        raise AnisotropyError(f"variance: got {of_each[good].min()}, expected 0 or above")
    shape = profiles.shape[1:-1]
    try:
        a, s = (
            np.broadcast_to(np.asarray(x, np.float64), shape).reshape(-1)
            for x in (sigma_a_per_mm, sigma_s_prime_per_mm)
        )
    except ValueError as error:
        raise AnisotropyError(
            f"sigma_a_per_mm, sigma_s_prime_per_mm: got shapes {np.shape(sigma_a_per_mm)}, "
            f"{np.shape(sigma_s_prime_per_mm)}, expected {shape}"
        ) from error

    def table(
        absorption: Float64Array, scattering: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        found = photon_table.derivatives(
            r,
            absorption,
            scattering,
            eta=eta,
            g=g,
            collection=collection,
            core_mm=core_mm,
            source_core_mm=source_core_mm,
        )
        return found.reflectance_per_mm2, found.by_sigma_s_prime

    rows = (angle.size, -1, r.size)
    found = profile_comparison.compare(
        profiles.reshape(rows), of_each.reshape(rows), good.reshape(rows), a, s, table, floor=floor
    )
    told = found.valid
    a, s = np.where(told, a, 1.0), np.where(told, s, 1.0) * np.exp(found.log_scattering)
    sigma_tr = np.sqrt(3.0 * a * (a + s))
    stderr = sigma_tr * 0.5 * s / (a + s) * np.where(told, found.stderr, 1.0)
    back = (angle.size, *shape)
    return estimate(
        angle,
        sigma_tr.reshape(back),
        stderr.reshape(back),
        valid=told.reshape(back),
        errors=errors,
        outliers=outliers,
        log_ratio_error=profile_comparison.LOG_RATIO_MODEL_ERROR,
    )
