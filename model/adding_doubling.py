"""Adding-doubling: the exact diffuse reflectance of a stack of plane layers.

Light is followed in a fixed set of directions. A layer is a pair of matrices (r, t) that turn the
radiance falling on it into the radiance that leaves it; they are known in closed form for a thin
layer, doubled until the layer has its thickness, and layers are added from the bottom up.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from model import fresnel

FloatArray = NDArray[np.float64]

_SERIES_TERMS = 9  # cosh(1) to 1e-16
_CHUNK = 2048  # layers per batch: a few MB
_MAX_DOUBLINGS = 60  # 1e18 starting layers: even without absorption nothing comes through
_TRAPPED = 1e-14
_OPAQUE = 1e-13  # transmittance at which a layer counts as semi-infinite


@dataclass(frozen=True, slots=True)
class Quadrature:
    """Directions inside the medium and the surface's reflectance for them."""

    mu: FloatArray
    """Cosines, shape (n,), increasing; the last is 1, the direction of the collimated beam."""
    weight: FloatArray
    """Weights of the integral over mu from 0 to 1, shape (n,)."""
    surface: FloatArray
    """Fresnel reflectance of the surface from inside, shape (n,)."""
    orders: int
    """Legendre orders that the weights integrate exactly, so that no energy is lost."""


def reflectance(
    sigma_a_per_mm: FloatArray,
    sigma_s_prime_per_mm: FloatArray,
    thickness_mm: FloatArray,
    *,
    eta: float = fresnel.ETA_SKIN,
    anisotropy: float | tuple[float, ...] = 0.0,
    directions: int = 12,
) -> FloatArray:
    """Return the diffuse reflectance of layer stacks for a beam at normal incidence.

    Parameters
    ----------
    sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm
        Shape (n, layers), top first, at least 0; the last thickness may be infinite.
    eta
        Refractive index of all layers relative to the air above (and below a finite stack).
    anisotropy
        Mean cosine g of the Henyey-Greenstein phase function in [0, 1), one for all layers or one
        a layer; the scattering coefficient is sigma_s'/(1 - g). At 0 the scattering is isotropic
        (similarity).
    directions
        Number of directions in half a sphere, even, at least 4.

    Returns
    -------
    ndarray
        Shape (n,): fraction of the incident power that leaves through the top, without the
        reflection of the beam at the first surface.

    Notes
    -----
    The radiance is resolved by Gauss points below the critical angle and Radau points above it.
    The last Radau point carries the collimated beam. Thin layers start from the exact solution of
    the discretised equation, so the doubling adds rounding errors only. For anisotropic scattering
    the forward peak is cut off by delta-M.

    References
    ----------
    van de Hulst 1980, Multiple Light Scattering; Prahl 1995, in Optical-Thermal Response of
    Laser-Irradiated Tissue, doi:10.1007/978-1-4757-6092-7_5; Wiscombe 1977 (delta-M),
    doi:10.1175/1520-0469(1977)034<1408:TDMRYA>2.0.CO;2.

    Examples
    --------
    Giovanelli's semi-infinite medium (published: 0.2600) with the 0.04 of its surface:

    >>> r = reflectance(np.array([[1.0]]), np.array([[9.0]]), np.array([[np.inf]]), eta=1.5)
    >>> round(float(r[0]) + 0.04, 4)
    0.2599
    """
    rule = quadrature(float(eta), int(directions))
    layers = sigma_a_per_mm.shape[1]
    g = np.broadcast_to(np.asarray(anisotropy, dtype=np.float64), (layers,))
    stack = np.stack([sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm], axis=-1)
    stack = stack.reshape(stack.shape[0], 3 * layers)
    below: FloatArray | None = None  # reflection matrices of what lies below, one a unique row
    below_rows = np.zeros(stack.shape[0], dtype=np.intp)
    for layer in range(layers - 1, -1, -1):
        # Stacks that share their lower layers (a table's dermis) are computed once.
        rows, inverse = np.unique(stack[:, 3 * layer :], axis=0, return_inverse=True)
        owner = np.zeros(rows.shape[0], dtype=np.intp)
        owner[inverse.ravel()] = np.arange(stack.shape[0])
        index = _index_of(stack, layer, layers, owner)
        result = np.empty((rows.shape[0], rule.mu.size, rule.mu.size))
        for start in range(0, rows.shape[0], _CHUNK):
            part = slice(start, start + _CHUNK)
            r, t = _layer(rows[part, 0], rows[part, 1], rows[part, 2], rule, float(g[layer]))
            lower = np.diag(rule.surface)[None] if below is None else below[index[part]]
            result[part] = _add(r, t, np.broadcast_to(lower, r.shape))
        below, below_rows = result, inverse.ravel().astype(np.intp)
    return _escape(below, below_rows, rule, eta) if below is not None else np.zeros(len(stack))


@lru_cache(maxsize=32)
def quadrature(eta: float, directions: int) -> Quadrature:
    """Return the directions for an index of refraction: half of them beyond the critical angle."""
    if directions < 4 or directions % 2:
        raise ValueError(f"directions: expected an even number of at least 4, got {directions}")
    if not 1.0 <= eta < np.inf:
        raise ValueError(f"eta: expected a relative refractive index of at least 1, got {eta}")
    mu_c = np.sqrt(1.0 - 1.0 / eta**2)
    if mu_c < 1e-3:  # matched: a single range
        mu, weight = _radau(directions)
        orders = 2 * directions - 2
    else:
        half = directions // 2
        node, node_weight = legendre.leggauss(half)
        # The surface's transmittance starts like a square root at the critical angle: with
        # mu = mu_c + (1 - mu_c) s^2 it is smooth in s, and the rule converges quickly.
        s, s_weight = _radau(half)
        mu = np.concatenate([0.5 * mu_c * (node + 1.0), mu_c + (1.0 - mu_c) * s**2])
        weight = np.concatenate([0.5 * mu_c * node_weight, 2.0 * (1.0 - mu_c) * s * s_weight])
        orders = half - 1
    # Total reflection loses 1e-14, else light trapped in a clear slab makes a singular matrix.
    surface = np.minimum(fresnel.reflectance(mu, 1.0 / eta), 1.0 - _TRAPPED)
    return Quadrature(mu, weight, surface, orders)


def _radau(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights on (0, 1] with a node at 1."""
    # Roots of (P_{n-1} + P_n)/(1 + x) on [-1, 1], which has its fixed node at -1, mirrored.
    p_before = np.zeros(count + 1)
    p_before[count - 1 : count + 1] = 1.0
    free = legendre.legroots(p_before)
    free = np.sort(free.real)[1:]
    x = np.concatenate([[-1.0], free])
    p = legendre.legval(x, np.eye(count)[count - 1])
    weight = (1.0 - x) / (count**2 * p**2)
    return 0.5 * (1.0 - x[::-1]), 0.5 * weight[::-1]


def _index_of(
    stack: FloatArray, layer: int, layers: int, owner: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return, for the owners' rows, which unique row of the layers below each one stands on."""
    if layer == layers - 1:
        return np.zeros(owner.size, dtype=np.intp)
    _, inverse = np.unique(stack[:, 3 * (layer + 1) :], axis=0, return_inverse=True)
    return np.asarray(inverse.ravel()[owner])


def _layer(
    sigma_a: FloatArray,
    sigma_s_prime: FloatArray,
    thickness: FloatArray,
    rule: Quadrature,
    anisotropy: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the matrices (r, t) of homogeneous layers without surfaces, shape (n, m, m)."""
    sigma_s = sigma_s_prime / (1.0 - anisotropy)
    cut = anisotropy**rule.orders if anisotropy else 0.0  # delta-M
    sigma_s = sigma_s * (1.0 - cut)
    sigma_t = sigma_a + sigma_s
    empty = sigma_t <= 0.0
    albedo = np.where(empty, 0.0, sigma_s / np.where(empty, 1.0, sigma_t))
    infinite = np.isinf(thickness)
    # An infinite empty layer returns nothing: it is a black one.
    sigma_t = np.where(empty & infinite, 1.0, sigma_t)
    start = rule.mu[0]  # optical thickness up to which the series below is exact
    tau = np.where(infinite, 2.0 * start, sigma_t * np.where(infinite, 1.0, thickness))
    doublings = np.ceil(np.log2(np.maximum(tau / (2.0 * start), 1.0))).astype(np.intp)
    doublings = np.minimum(doublings, _MAX_DOUBLINGS)
    doublings = np.where(infinite, _MAX_DOUBLINGS, doublings)
    first = np.where(infinite, tau, tau / np.exp2(doublings))
    r, t = _thin_layer(albedo, first, rule, anisotropy, cut)
    identity = np.eye(rule.mu.size)
    for step in range(int(doublings.max(initial=0))):
        active = np.flatnonzero((doublings > step) & (np.max(t, axis=(1, 2)) > _OPAQUE))
        if active.size == 0:
            break
        r_a, t_a = r[active], t[active]
        through = np.linalg.solve(identity - r_a @ r_a, t_a)
        r[active] = r_a + t_a @ r_a @ through
        t[active] = t_a @ through
    t[infinite] = 0.0
    return r, t


def _thin_layer(
    albedo: FloatArray, tau: FloatArray, rule: Quadrature, anisotropy: float, cut: float
) -> tuple[FloatArray, FloatArray]:
    """Solve the discrete transport equation exactly for layers of tau <= 2 mu_min.

    With S and D the sum and difference of downward and upward radiance, S' = -X D and D' = -Y S,
    where X and Y hold extinction less the scattering of odd and of even Legendre order. About the
    middle of the layer S = cosh(z sqrt(XY)) s, D = -Y z sinhc(z sqrt(XY)) s, and likewise with X
    and Y exchanged; both are power series in X Y.
    """
    mu, weight = rule.mu, rule.weight
    half = 0.5 * tau[:, None, None]
    even, odd = _phase_matrices(rule, anisotropy, cut)
    scatter = albedo[:, None, None] / mu[:, None]
    inverse_mu = np.diag(1.0 / mu)
    y = half * (inverse_mu - scatter * (even * weight))
    x = half * (inverse_mu - scatter * (odd * weight))
    cosh_s, sinh_s = _hyperbolic_series(x @ y)
    cosh_d, sinh_d = _hyperbolic_series(y @ x)
    ys, xd = y @ sinh_s, x @ sinh_d
    plus = _right_divide(cosh_s - ys, cosh_s + ys)  # r + t
    minus = _right_divide(xd - cosh_d, xd + cosh_d)  # r - t
    return 0.5 * (plus + minus), 0.5 * (plus - minus)


def _phase_matrices(
    rule: Quadrature, anisotropy: float, cut: float
) -> tuple[FloatArray, FloatArray]:
    """Return the even and the odd part of the azimuthally averaged phase function, (m, m)."""
    orders = np.arange(rule.orders if anisotropy else 1)
    moment = (float(anisotropy) ** orders - cut) / (1.0 - cut)  # 0**0 = 1
    basis = legendre.legvander(rule.mu, orders[-1]) * np.sqrt((2.0 * orders + 1.0) * moment)
    even = basis[:, orders % 2 == 0]
    odd = basis[:, orders % 2 == 1]
    return even @ even.T, odd @ odd.T


def _hyperbolic_series(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return cosh(sqrt(z)) and sinh(sqrt(z))/sqrt(z) of matrices of norm about 1, by Horner."""
    identity = np.eye(z.shape[-1])
    cosh = np.broadcast_to(identity, z.shape)
    sinh = cosh
    for k in range(_SERIES_TERMS, 0, -1):
        cosh = identity + z @ cosh / ((2 * k) * (2 * k - 1))
        sinh = identity + z @ sinh / ((2 * k) * (2 * k + 1))
    return cosh, sinh


def _right_divide(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    solved = np.linalg.solve(np.swapaxes(denominator, -1, -2), np.swapaxes(numerator, -1, -2))
    return np.swapaxes(solved, -1, -2)


def _add(r: FloatArray, t: FloatArray, below: FloatArray) -> FloatArray:
    """Return the reflection matrix of layers (r, t) that lie on `below`."""
    identity = np.eye(r.shape[-1])
    return np.asarray(r + t @ np.linalg.solve(identity - below @ r, below @ t))


def _escape(below: FloatArray, rows: NDArray[np.intp], rule: Quadrature, eta: float) -> FloatArray:
    """Let a unit beam in through the surface and return what comes out again, per stack."""
    identity = np.eye(rule.mu.size)
    beam = below[:, :, -1:]  # upward radiance before the surface reflects any of it back
    upward = np.linalg.solve(identity - below * rule.surface, beam)[:, :, 0]
    flux = rule.mu * rule.weight
    out = upward @ (flux * (1.0 - rule.surface)) / flux[-1]
    return np.asarray(out[rows] * (1.0 - fresnel.normal_reflectance(eta)))
