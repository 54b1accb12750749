"""Generate BRDFs like those of measured tables, for judging fits that have formulas of their own.

f = diffuse with grazing retroreflection + sum of lobes, D(h) F(h.l) / (4 max(n.l, n.v))

A diffuse color (Burley 2012), one or two lobes with tails from those of GGX to shorter and longer
ones (generalized Trowbridge-Reitz, exponent 1.2 to 3), Schlick's Fresnel reflection of dielectrics
and of metals, and the masking term of Neumann and Neumann 1999. None is one of the fitted formulas.

References
----------
Burley 2012, "Physically-based shading at Disney", appendix B (distribution and diffuse term).
Neumann, Neumann and Szirmay-Kalos 1999, doi:10.1111/1467-8659.00359 (masking).
"""

from collections.abc import Callable

import numpy as np

from rigsim.arrays import Float64Array

METAL_FRACTION = 0.2
SECOND_LOBE_FRACTION = 0.4
LOBE_ROUGHNESS = (0.06, 0.6)
"""Roughness alpha of the lobes; drawn evenly in its logarithm."""
TAIL_EXPONENT = (1.2, 3.0)


def generate_brdf(
    number: int, *, seed: int = 0
) -> Callable[[Float64Array, Float64Array], Float64Array]:
    """Return one BRDF of an unlimited set.

    Parameters
    ----------
    number
        Of the BRDF in the set, from 0.
    seed
        Of the set.

    Returns
    -------
    callable
        Takes light and view, unit vectors (..., 3) where +z is the normal; gives red, green and
        blue, (..., 3), 1/sr, finite; meaningless below the horizon.

    Examples
    --------
    >>> up = np.array([0.0, 0.0, 1.0])
    >>> generate_brdf(0)(up, up).shape
    (3,)
    """
    rng = np.random.default_rng([seed, number])
    metal = rng.random() < METAL_FRACTION
    color = rng.uniform(0.02, 0.7, 3) * (0.05 if metal else 1.0)
    normal_reflectance = rng.uniform(0.3, 0.9, 3) if metal else np.full(3, rng.uniform(0.02, 0.08))
    count = 2 if rng.random() < SECOND_LOBE_FRACTION else 1
    shares = rng.dirichlet(np.full(count, 2.0))
    least, most = np.log(LOBE_ROUGHNESS)
    alphas = np.exp(rng.uniform(float(least), float(most), count))
    exponents = rng.uniform(*TAIL_EXPONENT, count)

    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        mu_l, mu_v = np.maximum(light[..., 2], 0.0), np.maximum(view[..., 2], 0.0)
        half = light + view
        square = np.maximum(np.sum(half**2, axis=-1), 1e-12)  # 4 cos^2 of the difference angle
        cos_h2 = np.clip(half[..., 2] ** 2 / square, 0.0, 1.0)
        cos_d2 = 0.25 * square
        density = sum(
            share * _facet_density(cos_h2, alpha, gamma)
            for share, alpha, gamma in zip(shares, alphas, exponents, strict=True)
        )
        lobe = density / (4.0 * np.maximum(np.maximum(mu_l, mu_v), 1e-3))
        grazing = (1.0 - np.sqrt(np.minimum(cos_d2, 1.0))) ** 5
        rise = 2.0 * alphas[0] * cos_d2 - 0.5
        retro = (1.0 + rise * (1.0 - mu_l) ** 5) * (1.0 + rise * (1.0 - mu_v) ** 5) / np.pi
        fresnel = normal_reflectance + (1.0 - normal_reflectance) * grazing[..., None]
        return np.asarray(color * retro[..., None] + fresnel * lobe[..., None])

    return brdf


def _facet_density(cos_h2: Float64Array, alpha: float, gamma: float) -> Float64Array:
    """Return the generalized Trowbridge-Reitz density, 1/sr; the integral of D cos is 1."""
    a2 = alpha**2
    scale = (gamma - 1.0) * (a2 - 1.0) / (np.pi * (1.0 - a2 ** (1.0 - gamma)))
    return np.asarray(scale / (1.0 + (a2 - 1.0) * cos_h2) ** gamma)
