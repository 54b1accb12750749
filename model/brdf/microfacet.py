"""Reflection at rough dielectric surfaces: distributions of facets, shadowing, Fresnel.

Everything is written on cosines, so that tables and estimators can evaluate it on grids of
half/difference angles without vectors. A BRDF here is D F G / (4 cos cos) in 1/sr; its Fresnel
factor is inside, and counted once.

References
----------
Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206 (GGX, Beckmann, shadowing).
Heitz 2014, http://jcgt.org/published/0003/02/03/ (height-correlated shadowing).
Blinn 1977, doi:10.1145/563858.563893 (cosine power).
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from model import fresnel
from model.arrays import Float64Array
from model.checks import Checks

Distribution = Literal["ggx", "beckmann", "blinn"]

MIN_COSINE = 1e-3
"""Smallest cosine of light or view; smaller ones are clamped to keep the BRDF finite."""

ROUGHNESS_RANGE = (1e-6, 1e6)
"""Below it a surface is a mirror, which has no density; squares of values far outside overflow."""


def facet_density(cos_h: ArrayLike, roughness: float, kind: Distribution = "ggx") -> Float64Array:
    """Return the density D of facet normals, 1/sr; the integral of D cos is 1.

    Parameters
    ----------
    cos_h
        Cosine between facet and surface normal, in [0, 1], any shape.
    roughness
        GGX's alpha or Beckmann's m, within :data:`ROUGHNESS_RANGE`; the cosine power is matched to
        it as 2/m^2 - 2.
    kind
        Distribution of facets. The cosine power is for m up to 0.5: Smith's shadowing is not its
        own, and wider lobes reflect up to 13 % too much near grazing.

    Raises
    ------
    ValueError
        For a roughness out of range.

    Examples
    --------
    >>> float(facet_density(1.0, 0.5).round(6))
    1.27324
    """
    least, most = ROUGHNESS_RANGE
    Checks().within("roughness", roughness, f"[{least}, {most}]")
    c = np.clip(np.asarray(cos_h, dtype=np.float64), 0.0, 1.0)
    a2 = roughness**2
    if kind == "ggx":
        return np.asarray(a2 / (np.pi * (c**2 * (a2 - 1.0) + 1.0) ** 2))
    if kind == "beckmann":
        c2 = np.maximum(c**2, 1e-4)
        return np.asarray(np.exp((c2 - 1.0) / (c2 * a2)) / (np.pi * a2 * c2**2))
    power = max(2.0 / a2 - 2.0, 0.0)
    return np.asarray((power + 2.0) / (2.0 * np.pi) * c**power)


def visibility(
    cos_light: ArrayLike, cos_view: ArrayLike, roughness: float, kind: Distribution = "ggx"
) -> Float64Array:
    """Return G / (4 cos cos), height-correlated Smith shadowing and masking.

    Cosines below :data:`MIN_COSINE`, negative ones too, are clamped to it.
    """
    mu_l, mu_v = (
        np.clip(np.asarray(mu, dtype=np.float64), MIN_COSINE, 1.0) for mu in (cos_light, cos_view)
    )
    hidden = _lambda(mu_l, roughness, kind) + _lambda(mu_v, roughness, kind)
    return np.asarray(1.0 / ((1.0 + hidden) * 4.0 * mu_l * mu_v))


def brdf(
    cos_light: ArrayLike,
    cos_view: ArrayLike,
    cos_h: ArrayLike,
    cos_d: ArrayLike,
    *,
    roughness: float,
    eta: float,
    kind: Distribution = "ggx",
) -> Float64Array:
    """Return the specular BRDF of a rough dielectric surface, 1/sr, without subsurface scattering.

    Parameters
    ----------
    cos_light, cos_view, cos_h, cos_d
        Cosines of light, view and half vector to the normal, and of half the angle between light
        and view; broadcast together.
    roughness, kind
        See :func:`facet_density`.
    eta
        Relative refractive index.

    Examples
    --------
    >>> float(brdf(1.0, 1.0, 1.0, 1.0, roughness=0.3, eta=1.4).round(5))
    0.02456
    """
    return np.asarray(
        facet_density(cos_h, roughness, kind)
        * visibility(cos_light, cos_view, roughness, kind)
        * fresnel.reflectance(np.clip(cos_d, 0.0, 1.0), eta)
    )


def _lambda(mu: Float64Array, roughness: float, kind: Distribution) -> Float64Array:
    """Return Smith's Lambda; Beckmann's rational fit (Walter et al.) serves the cosine power."""
    slope = roughness * np.sqrt(1.0 - mu**2) / mu
    if kind == "ggx":
        return np.asarray(0.5 * (np.sqrt(1.0 + slope**2) - 1.0))
    a = 1.0 / np.maximum(slope, 1e-9)
    rational = (1.0 - 1.259 * a + 0.396 * a**2) / (3.535 * a + 2.181 * a**2)
    return np.asarray(np.where(a < 1.6, rational, 0.0))
