"""Compute the exact diffuse reflectance of a stack of plane layers by adding-doubling.

Radiance is discretized in a fixed set of directions. A layer is a pair of matrices (r, t) from
incident to reflected and transmitted radiance. They are known in closed form for a thin layer,
which is doubled up to the full thickness; layers are then added from the bottom up.
"""

import numpy as np
from numpy.typing import NDArray

from model import fresnel
from model.arrays import Float64Array
from model.checks import Checks
from model.tissue_optics import discrete_ordinates
from model.tissue_optics.discrete_ordinates import Quadrature

_SERIES_TERMS = 9  # cosh(1) to 1e-16
_CHUNK_LAYERS = 2048  # layers per batch: a few MB
_MAX_DOUBLINGS = 60  # 1e18 starting layers: opaque even without absorption
_MIN_TRANSMITTANCE = 1e-13  # transmittance at which a layer counts as semi-infinite


def reflectance(
    sigma_a_per_mm: Float64Array,
    sigma_s_prime_per_mm: Float64Array,
    thickness_mm: Float64Array,
    *,
    eta: float = fresnel.ETA_SKIN,
    anisotropy: float | tuple[float, ...] = 0.0,
    directions: int | None = None,
) -> Float64Array:
    """Return the diffuse reflectance of layer stacks for a beam at normal incidence.

    Parameters
    ----------
    sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm
        Shape (n, layers), top first, at least 0; the last thickness may be infinite.
    eta
        Refractive index of all layers relative to the air above (and below a finite stack).
    anisotropy
        Mean cosine g of the Henyey-Greenstein phase function, 0 to 0.999, one for all layers or one
        per layer; the scattering coefficient is sigma_s'/(1 - g). At 0 the scattering is isotropic
        (similarity).
    directions
        Number of directions in half a sphere, even, at least 4. None: those of
        `discrete_ordinates.default_directions` for the largest g.

    Returns
    -------
    ndarray
        Shape (n,): fraction of the incident power that leaves through the top, without the
        reflection of the beam at the first surface. The beam's reflection at the back surface of a
        finite stack is included, scattered or not: a clear slab has a reflectance above 0. The
        photon Monte Carlo of `rigsim.tissue.tissue_mc` counts that part as specular.

    Raises
    ------
    ValueError
        For coefficients or thicknesses that are negative or NaN, or of different shapes; for `eta`
        outside 1 to 100, an `anisotropy` outside 0 to 0.999, an odd number of directions;
        for an `anisotropy` above 0.99 without `directions`, or above 0.8 with too few of them.

    Notes
    -----
    The radiance is resolved by Gauss points below the critical angle and Radau points above it.
    The last Radau point carries the collimated beam. Thin layers start from the exact solution of
    the discretised equation, so the doubling adds rounding errors only. A forward peak narrower
    than the directions is projected on them, see `discrete_ordinates.phase_matrices`.

    The default directions keep the relative error of the reflectance below 1e-4 for eta from 1 to
    1.6, sigma_a up to 100 sigma_s', and layers from 0.001/sigma_s' to infinite thickness. The
    largest, 1.03e-4, is that of finite layers of g = 0.8 at eta 1.4.

    References
    ----------
    van de Hulst 1980, Multiple Light Scattering; Prahl 1995, in Optical-Thermal Response of
    Laser-Irradiated Tissue, doi:10.1007/978-1-4757-6092-7_5.

    Examples
    --------
    Giovanelli's semi-infinite medium (published: 0.2600) with the 0.04 of its surface:

    >>> r = reflectance(np.array([[1.0]]), np.array([[9.0]]), np.array([[np.inf]]), eta=1.5)
    >>> round(float(r[0]) + 0.04, 4)
    0.2599
    """
    shapes = [np.shape(x) for x in (sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm)]
    if len(set(shapes)) > 1 or len(shapes[0]) != 2:
        raise ValueError(
            "sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm: got shapes "
            f"{', '.join(map(str, shapes))}, expected one (n, layers)"
        )
    Checks().within("sigma_a_per_mm", sigma_a_per_mm, "[0, inf)")
    Checks().within("thickness_mm", thickness_mm, "[0, inf]")
    Checks().within("sigma_s_prime_per_mm", sigma_s_prime_per_mm, "[0, inf)")
    layers = sigma_a_per_mm.shape[1]
    g = np.broadcast_to(np.asarray(anisotropy, dtype=np.float64), (layers,))
    Checks().within("anisotropy", g, f"[0, {discrete_ordinates.MAX_ANISOTROPY}]")
    eta, widest = float(eta), float(g.max(initial=0.0))
    count = discrete_ordinates.choose_directions(eta, widest, directions)
    rule = discrete_ordinates.quadrature(eta, count)
    stack = np.stack([sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm], axis=-1)
    stack = stack.reshape(stack.shape[0], 3 * layers)
    below: Float64Array | None = None  # reflection matrices of the layers below, one per unique row
    below_rows = np.zeros(stack.shape[0], dtype=np.intp)
    for layer in range(layers - 1, -1, -1):
        # Lower layers common to several stacks (a table's dermis) are computed once.
        rows, inverse = np.unique(stack[:, 3 * layer :], axis=0, return_inverse=True)
        owner = np.zeros(rows.shape[0], dtype=np.intp)
        owner[inverse.ravel()] = np.arange(stack.shape[0])
        index = _index_of(stack, layer, layers, owner)
        result = np.empty((rows.shape[0], rule.mu.size, rule.mu.size))
        phase = discrete_ordinates.phase_matrices(eta, count, float(g[layer]))
        for start in range(0, rows.shape[0], _CHUNK_LAYERS):
            part = slice(start, start + _CHUNK_LAYERS)
            r, t = _layer(rows[part, :3], rule, float(g[layer]), phase)
            lower = np.diag(rule.surface)[None] if below is None else below[index[part]]
            result[part] = _add(r, t, np.broadcast_to(lower, r.shape))
        below, below_rows = result, inverse.ravel().astype(np.intp)
    return _escape(below, below_rows, rule, eta) if below is not None else np.zeros(len(stack))


def _index_of(
    stack: Float64Array, layer: int, layers: int, owner: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return, for each owner's row, the index of the unique row of layers below it."""
    if layer == layers - 1:
        return np.zeros(owner.size, dtype=np.intp)
    _, inverse = np.unique(stack[:, 3 * (layer + 1) :], axis=0, return_inverse=True)
    return np.asarray(inverse.ravel()[owner])


def _layer(
    properties: Float64Array,
    rule: Quadrature,
    anisotropy: float,
    phase: tuple[Float64Array, Float64Array],
) -> tuple[Float64Array, Float64Array]:
    """Return the matrices (r, t) of homogeneous layers without surfaces, shape (n, m, m).

    `properties` holds sigma_a, sigma_s' and the thickness, shape (n, 3).
    """
    sigma_a, sigma_s_prime, thickness = properties.T
    sigma_s = sigma_s_prime / (1.0 - anisotropy)
    sigma_t = sigma_a + sigma_s
    empty = sigma_t <= 0.0
    albedo = np.where(empty, 0.0, sigma_s / np.where(empty, 1.0, sigma_t))
    infinite = np.isinf(thickness)
    # An infinite layer without scattering and absorption returns no light: treat it as black.
    sigma_t = np.where(empty & infinite, 1.0, sigma_t)
    start = rule.mu[0]  # optical thickness up to which the series below is exact
    tau = np.where(infinite, 2.0 * start, sigma_t * np.where(infinite, 1.0, thickness))
    doublings = np.ceil(np.log2(np.maximum(tau / (2.0 * start), 1.0))).astype(np.intp)
    doublings = np.minimum(doublings, _MAX_DOUBLINGS)
    doublings = np.where(infinite, _MAX_DOUBLINGS, doublings)
    first = np.where(infinite, tau, tau / np.exp2(doublings))
    r, t = _thin_layer(albedo, first, rule, phase)
    identity = np.eye(rule.mu.size)
    for step in range(int(doublings.max(initial=0))):
        active = np.flatnonzero((doublings > step) & (np.max(t, axis=(1, 2)) > _MIN_TRANSMITTANCE))
        if active.size == 0:
            break
        r_a, t_a = r[active], t[active]
        through = np.linalg.solve(identity - r_a @ r_a, t_a)
        r[active] = r_a + t_a @ r_a @ through
        t[active] = t_a @ through
    t[infinite] = 0.0
    return r, t


def _thin_layer(
    albedo: Float64Array,
    tau: Float64Array,
    rule: Quadrature,
    phase: tuple[Float64Array, Float64Array],
) -> tuple[Float64Array, Float64Array]:
    """Solve the discrete transport equation exactly for layers of tau <= 2 mu_min.

    With S and D the sum and difference of downward and upward radiance, S' = -X D and D' = -Y S,
    where X and Y are extinction less the scattering of odd and of even Legendre order. About the
    middle of the layer S = cosh(z sqrt(XY)) s, D = -Y z sinhc(z sqrt(XY)) s, and likewise with X
    and Y exchanged; both are power series in X Y.
    """
    mu, weight = rule.mu, rule.weight
    half = 0.5 * tau[:, None, None]
    even, odd = phase
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


def _hyperbolic_series(z: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return cosh(sqrt(z)) and sinh(sqrt(z))/sqrt(z) of matrices of norm about 1, by Horner."""
    identity = np.eye(z.shape[-1])
    cosh = np.broadcast_to(identity, z.shape)
    sinh = cosh
    for k in range(_SERIES_TERMS, 0, -1):
        cosh = identity + z @ cosh / ((2 * k) * (2 * k - 1))
        sinh = identity + z @ sinh / ((2 * k) * (2 * k + 1))
    return cosh, sinh


def _right_divide(numerator: Float64Array, denominator: Float64Array) -> Float64Array:
    solved = np.linalg.solve(np.swapaxes(denominator, -1, -2), np.swapaxes(numerator, -1, -2))
    return np.swapaxes(solved, -1, -2)


def _add(r: Float64Array, t: Float64Array, below: Float64Array) -> Float64Array:
    """Return the reflection matrix of layers (r, t) on top of `below`."""
    identity = np.eye(r.shape[-1])
    return np.asarray(r + t @ np.linalg.solve(identity - below @ r, below @ t))


def _escape(
    below: Float64Array, rows: NDArray[np.intp], rule: Quadrature, eta: float
) -> Float64Array:
    """Return the fraction of a unit beam that exits through the surface again, per stack."""
    identity = np.eye(rule.mu.size)
    beam = below[
        :, :, -1:
    ]  # upward radiance at the surface, internal reflection included by (1 - R F)^-1
    upward = np.linalg.solve(identity - below * rule.surface, beam)[:, :, 0]
    flux = rule.mu * rule.weight
    out = upward @ (flux * (1.0 - rule.surface)) / flux[-1]
    return np.asarray(out[rows] * (1.0 - fresnel.normal_reflectance(eta)))
