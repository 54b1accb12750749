"""Interpolate one medium of the photon table over eta and g, with its asymptotic decay.

See `model.photon_table` for the stored quantities.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal

from model.arrays import Float64Array
from model.checks import Checks
from model.photon_table import kernels

Collection = Literal["all", "fiber"]

_LEGENDRE_ORDERS = 600  # Legendre orders for kappa: exact to rounding up to g = 0.95 and beyond


class TableDomainError(ValueError):
    """Error for a medium or a collection that is not in the table."""


@dataclass(frozen=True, slots=True)
class Medium:
    """One (eta, g, collection) of the table, for `model.photon_table.kernels.evaluate`."""

    coefficients: Float64Array
    """B-spline coefficients of ln of the reduced reflectance, shape (radii, roots)."""
    decay: Float64Array
    """B-spline coefficients of kappa/sqrt(sigma_a/sigma_s'), shape (roots,)."""
    log_error: Float64Array
    """ln of the relative standard error at every other knot, shape (radii/2, roots/2)."""


def stored_asymmetries() -> tuple[float, ...]:
    """Return the stored values of g, increasing; values between them are interpolated.

    Examples
    --------
    >>> 0.8 in stored_asymmetries()
    True
    """
    return tuple(float(x) for x in _stored()["g"])


@lru_cache(maxsize=64)
def prepare_medium(eta: float, g: float, collection: Collection) -> Medium:
    """Return one medium of the table, interpolated over eta and g.

    Raises
    ------
    TableDomainError
        For an eta, g or collection that is not in the table.
    """
    stored = _stored()
    Checks(TableDomainError).choice("collection", collection, ("all", "fiber"))
    weight_g = _lagrange("g", stored["g"], float(g))
    weight_eta = _lagrange("eta", stored["eta"], float(eta))
    which = ("all", "fiber").index(collection)
    weight = weight_g[:, None] * weight_eta
    coefficients = np.einsum(
        "ge,gexy->xy", weight, stored["coefficients"][:, which].astype(np.float64)
    )
    error = np.exp(stored["log_error"][:, which].astype(np.float64))
    log_error = 0.5 * np.log(np.einsum("ge,gexy->xy", weight**2, error**2))
    medium = Medium(np.ascontiguousarray(coefficients), decay_coefficients(float(g)), log_error)
    for array in (medium.coefficients, medium.decay, medium.log_error):
        array.flags.writeable = False
    return medium


def decay_coefficients(g: float) -> Float64Array:
    """Return the B-spline coefficients of kappa/sqrt(sigma_a/sigma_s'), shape (ROOT_COUNT,)."""
    root = kernels.ROOT_SCALE * np.expm1(kernels.ROOT_STEP * np.arange(kernels.ROOT_COUNT - 2))
    ratio = np.array([np.sqrt(3.0), *(asymptotic_decay(u * u, g) / u for u in root[1:])])
    return np.linalg.solve(root_spline_matrix(), np.append(ratio, (0.0, 0.0)))


def asymptotic_decay(absorption_ratio: float, g: float) -> float:
    """Return kappa/sigma_s' of the light far from any source, for sigma_a/sigma_s' > 0.

    1/kappa is the largest eigenvalue of the equations of the radiance's Legendre moments; for weak
    absorption kappa tends to the diffusion's sqrt(3 sigma_a (sigma_a + sigma_s')).

    References
    ----------
    Case and Zweifel 1967, Linear Transport Theory, chapter 8.

    Examples
    --------
    >>> round(float(asymptotic_decay(1e-6, 0.8) / np.sqrt(3e-6)), 5)
    1.0
    >>> k = asymptotic_decay(1.0, 0.0)  # isotropic: (c/2 k) ln((1 + k)/(1 - k)) = 1, c = 1/2
    >>> round(float(0.25 / (k / 2) * np.log((1 + k / 2) / (1 - k / 2))), 9)
    1.0

    Raises
    ------
    ValueError
        For a ratio outside 1e-100 to 1e100, or a g outside [0, 1).
    """
    Checks().within("absorption_ratio", absorption_ratio, "[1e-100, 1e+100]")
    Checks().within("g", g, "[0, 1)")
    order = np.arange(_LEGENDRE_ORDERS)
    removed = absorption_ratio + (1.0 - g**order) / (1.0 - g)
    ell = order[1:]
    off = ell / np.sqrt((2.0 * ell - 1.0) * (2.0 * ell + 1.0) * removed[:-1] * removed[1:])
    largest = eigh_tridiagonal(
        np.zeros(_LEGENDRE_ORDERS),
        off,
        eigvals_only=True,
        select="i",
        select_range=(_LEGENDRE_ORDERS - 1, _LEGENDRE_ORDERS - 1),
    )
    return float(1.0 / largest[0])


def root_spline_matrix() -> Float64Array:
    """Return the matrix from values at the knots and two 0s to B-spline coefficients.

    Its last two conditions: slope 0 at sigma_a = 0 (reflectance is even in the root up to its
    cube), and one cubic over the last two intervals (not-a-knot).
    """
    count = kernels.ROOT_COUNT
    matrix = np.zeros((count, count))
    for k in range(count - 2):
        matrix[k, k : k + 3] = (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0)
    matrix[-2, :3] = (-0.5, 0.0, 0.5)
    matrix[-1, -5:] = (1.0, -4.0, 6.0, -4.0, 1.0)
    return matrix


@lru_cache(maxsize=1)
def _stored() -> dict[str, NDArray[np.generic]]:
    with (files("model") / "data" / "photon_table.npz").open("rb") as stream:
        with np.load(stream, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def _lagrange(name: str, nodes: NDArray[np.generic], value: float) -> Float64Array:
    """Return the weights of the (up to) four nearest nodes for cubic interpolation."""
    x = nodes.astype(np.float64)
    if not x[0] - 1e-9 <= value <= x[-1] + 1e-9:
        raise TableDomainError(
            f"{name}: got {value}, expected {x[0]:g} to {x[-1]:g}, the range of the photon table"
        )
    weight = np.zeros(x.size)
    count = min(4, x.size)
    first = min(max(int(np.searchsorted(x, value)) - count // 2, 0), x.size - count)
    for k in range(first, first + count):
        others = np.delete(x[first : first + count], k - first)
        weight[k] = np.prod((value - others) / (x[k] - others))
    return weight
