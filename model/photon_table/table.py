"""Reflectance around a beam from a white Monte Carlo table of semi-infinite media.

Unlike diffusion, the table is also valid within a few transport lengths of the source and under
strong absorption. With lengths in units of 1/sigma_s' the profile depends on sigma_a/sigma_s', the
asymmetry g of the Henyey-Greenstein phase function and the index of refraction only::

    R(r) = sigma_s'^2 Rhat(r sigma_s', sigma_a/sigma_s'; eta, g)

Stored is ln of Rhat over (1 + kappa d)/d^3 exp(-kappa d) with d^2 = (r sigma_s')^2 + 1 and the
exact asymptotic decay kappa, as a bicubic spline over ln(r sigma_s') and ln(1 + 10
sqrt(sigma_a/sigma_s')): smooth, positive, with exact derivatives for least squares and the right
asymptotic decay. tools/make_photon_table.py makes model/data/photon_table.npz and describes the
method.
"""

from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RectBivariateSpline

from model.arrays import BoolArray, Float64Array
from model.checks import Checks
from model.dipole.kienle_patterson import ProfileDerivatives
from model.photon_table import kernels
from model.photon_table.disc_distances import distance_rules
from model.photon_table.medium import Collection, prepare_medium

NUMERICAL_APERTURE = 0.22
"""Numerical aperture of the source and of the detectors in the collection "fiber", in air."""
MAX_QUANTITY = 1e50
"""Largest length, mm, and coefficient, 1/mm: their squares and cubes are still finite numbers."""
MIN_SCATTERING_PER_MM = 1e-100
"""Smallest sigma_s' that scatters: below it the reciprocal's powers overflow in the spline, and the
reflectance, at most sigma_s'/r, is below 1e-50 per mm^2 at every admitted radius."""
MAX_ABSORPTION_RATIO = 10.0
"""Largest sigma_a/sigma_s' in the domain."""
MIN_REDUCED_RADIUS, MAX_REDUCED_RADIUS = 0.02, 50.0
"""Range of r sigma_s' in the domain."""
MAX_RELATIVE_ERROR = 0.03
"""Largest relative standard error of the table itself in the domain."""


class PhotonTableOptics(TypedDict, total=False):
    """Optical properties of skin and fibers in `reflectance` and `derivatives`."""

    eta: float
    g: float
    collection: Collection
    core_mm: float
    source_core_mm: float


def reflectance(
    radius_mm: ArrayLike,
    sigma_a_per_mm: ArrayLike,
    sigma_s_prime_per_mm: ArrayLike,
    **optics: Unpack[PhotonTableOptics],
) -> Float64Array:
    """Return the reflectance per area at a distance from the source.

    Parameters
    ----------
    radius_mm
        Distance from the beam, or between the centers of the fibers, mm, 0 to 1e50; at least 1e-50
        when both cores are points. Broadcast with the coefficients; fastest with the radii on the
        last axis and coefficients of length 1 there.
    sigma_a_per_mm, sigma_s_prime_per_mm
        Absorption, any finite number from 0 on, and reduced scattering, 0 to 1e50; 1/mm.
    eta
        Refractive index of the medium over that of its surroundings, 1 to 1.6.
    g
        Mean cosine of the Henyey-Greenstein phase function, see `stored_asymmetries`.
    collection
        "all": a pencil beam at normal incidence and the light that leaves at any angle, 1/mm^2.
        "fiber": source and detector of numerical aperture 0.22, the source's cone evenly filled;
        power within the detector's cone over incident power, area and NA^2, which is the same
        quantity where the light leaves like from a Lambertian surface.
    core_mm, source_core_mm
        Diameters of the detector's and the source's core, over which the profile is averaged.

    Returns
    -------
    ndarray
        R in 1/mm^2; 0 without scattering. Outside `is_in_domain` it is an extrapolation.

    Raises
    ------
    TableDomainError
        For an eta, g or collection that is not in the table.
    ValueError
        For arguments that are negative, not finite or too large, or a radius below 1e-50 between
        points (R is infinite at 0).

    Examples
    --------
    >>> radius = np.array([0.3, 1.0, 3.0])
    >>> reflectance(radius, 0.05, 1.5, collection="fiber", core_mm=0.2, source_core_mm=0.2).shape
    (3,)
    """
    slopes = derivatives(radius_mm, sigma_a_per_mm, sigma_s_prime_per_mm, **optics)
    return slopes.reflectance_per_mm2


def derivatives(
    radius_mm: ArrayLike,
    sigma_a_per_mm: ArrayLike,
    sigma_s_prime_per_mm: ArrayLike,
    *,
    eta: float = 1.4,
    g: float = 0.8,
    collection: Collection = "all",
    core_mm: float = 0.0,
    source_core_mm: float = 0.0,
) -> ProfileDerivatives:
    """Return the reflectance and its derivatives by both coefficients.

    Parameters and errors as :func:`reflectance`. The derivatives are those of the spline;
    without scattering both are 0.

    Examples
    --------
    >>> slopes = derivatives(2.0, [0.0, 0.01], 1.0)
    >>> bool(np.all(slopes.by_sigma_a < 0.0))
    True
    """
    medium = prepare_medium(eta, g, collection)
    radius, sigma_a, sigma_s = _not_negative(radius_mm, sigma_a_per_mm, sigma_s_prime_per_mm)
    for name, length in (("core_mm", core_mm), ("source_core_mm", source_core_mm)):
        Checks().within(name, length, f"[0, {MAX_QUANTITY}]")
    if not (core_mm or source_core_mm) and np.any(radius < 1.0 / MAX_QUANTITY):
        raise ValueError(
            f"radius_mm: got {radius.min():g} between points, where R is infinite; "
            f"expected {1.0 / MAX_QUANTITY:g} and more"
        )
    shape = np.broadcast_shapes(radius.shape, sigma_a.shape, sigma_s.shape)
    columns = shape[-1] if shape else 1
    one_radius_list = radius.ndim <= 1 or all(n == 1 for n in radius.shape[:-1])
    by_rows = one_radius_list and all(x.ndim == 0 or x.shape[-1] == 1 for x in (sigma_a, sigma_s))
    if by_rows:
        leading = shape[:-1]
        unique, index = np.unique(radius, return_inverse=True)
        group = np.broadcast_to(index.reshape(1, -1), (1, columns))
        sigma_a, sigma_s = (
            np.broadcast_to(x if x.ndim == 0 else x[..., 0], leading).ravel()
            for x in (sigma_a, sigma_s)
        )
    else:
        radius, sigma_a, sigma_s = (np.broadcast_to(x, shape) for x in (radius, sigma_a, sigma_s))
        unique, index = np.unique(radius, return_inverse=True)
        group = index.reshape(-1, 1)
        sigma_a, sigma_s = sigma_a.ravel(), sigma_s.ravel()
    starts, log_distance, weight = distance_rules(unique, core_mm, source_core_mm)
    scatters = sigma_s >= MIN_SCATTERING_PER_MM
    out = np.empty((3, sigma_a.size, group.shape[1]))
    kernels.evaluate(
        np.ascontiguousarray(sigma_a),
        np.where(scatters, sigma_s, 1.0),
        medium.coefficients,
        medium.decay,
        np.ascontiguousarray(group, dtype=np.int64),
        starts,
        log_distance,
        weight,
        out,
    )
    out[:, ~scatters] = 0.0
    return ProfileDerivatives(*(part.reshape(shape) for part in out))


def relative_error(
    radius_mm: ArrayLike,
    sigma_a_per_mm: ArrayLike,
    sigma_s_prime_per_mm: ArrayLike,
    *,
    eta: float = 1.4,
    g: float = 0.8,
    collection: Collection = "all",
) -> Float64Array:
    """Return the standard error of the table itself over its value, broadcast.

    Estimated from independent batches of photons; infinite outside the table and where no photons
    were detected. The errors of neighboring radii and absorptions are correlated.

    Examples
    --------
    >>> bool(relative_error(2.0, 0.05, 1.0) < 0.01)
    True
    """
    medium = prepare_medium(eta, g, collection)
    given = (radius_mm, sigma_a_per_mm, sigma_s_prime_per_mm)
    radius, sigma_a, sigma_s = np.broadcast_arrays(*_not_negative(*given))
    scatters = (sigma_s >= MIN_SCATTERING_PER_MM) & (radius > 0.0)
    s = np.where(scatters, sigma_s, 1.0)
    rho = np.where(scatters, radius * s, 1.0)
    u = np.sqrt(sigma_a / s)
    x = (np.log(rho) - kernels.RADIUS_START) / (2.0 * kernels.RADIUS_STEP)
    y = np.log1p(u / kernels.ROOT_SCALE) / (2.0 * kernels.ROOT_STEP)
    rows, columns = medium.log_error.shape
    held = scatters & (x >= 0.0) & (x <= rows - 1) & (y <= columns - 1)
    spline = RectBivariateSpline(np.arange(rows), np.arange(columns), medium.log_error, kx=1, ky=1)
    value = np.exp(spline.ev(np.where(held, x, 0.0), np.where(held, y, 0.0)))
    return np.asarray(np.where(held & (value < 0.5), value, np.inf))


def is_in_domain(
    radius_mm: ArrayLike,
    sigma_a_per_mm: ArrayLike,
    sigma_s_prime_per_mm: ArrayLike,
    *,
    eta: float = 1.4,
    g: float = 0.8,
    collection: Collection = "all",
) -> BoolArray:
    """Return the mask of valid points: r sigma_s', sigma_a/sigma_s' in range and error <= 3 %.

    Examples
    --------
    >>> is_in_domain([0.001, 2.0, 2.0, 200.0], [0.1, 0.1, 20.0, 0.1], 1.0).tolist()
    [False, True, False, False]
    """
    radius, sigma_a, sigma_s = (
        np.asarray(x, dtype=np.float64) for x in (radius_mm, sigma_a_per_mm, sigma_s_prime_per_mm)
    )
    error = relative_error(radius, sigma_a, sigma_s, eta=eta, g=g, collection=collection)
    rho = radius * sigma_s
    return np.asarray(
        (error <= MAX_RELATIVE_ERROR)
        & (sigma_a <= MAX_ABSORPTION_RATIO * sigma_s)
        & (rho >= MIN_REDUCED_RADIUS)
        & (rho <= MAX_REDUCED_RADIUS)
    )


def _not_negative(
    radius_mm: ArrayLike, sigma_a_per_mm: ArrayLike, sigma_s_prime_per_mm: ArrayLike
) -> tuple[Float64Array, Float64Array, Float64Array]:
    some = f"[0, {MAX_QUANTITY}]"
    return (
        Checks().numbers("radius_mm", radius_mm, interval=some),
        Checks().numbers("sigma_a_per_mm", sigma_a_per_mm, interval="[0, inf)"),
        Checks().numbers("sigma_s_prime_per_mm", sigma_s_prime_per_mm, interval=some),
    )
