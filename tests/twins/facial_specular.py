"""The real-time specular reflection of skin: Kelemen and Szirmay-Kalos with Beckmann facets.

References
----------
Kelemen and Szirmay-Kalos 2001, A microfacet based coupled specular-matte BRDF model with importance
sampling, Eurographics short presentations (shadowing and masking as 1 over 4 (l.h)^2).
d'Eon and Luebke 2007, GPU Gems 3, chapter 14 (with Beckmann's density, for skin).
Jimenez et al. 2010, doi:10.1145/1866158.1866167, section 6 (roughness and intensity from maps).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.brdf.microfacet import facet_density

F0: Final = 0.028
"""Reflectance at normal incidence, of an index of 1.4."""


def schlick(cosine: ArrayLike, f0: float = F0) -> Float64Array:
    """Return Schlick's approximation of Fresnel's reflectance.

    Parameters
    ----------
    cosine
        Of the angle to the facet's normal, any shape; what lies outside [0, 1] is clipped.
    f0
        Reflectance at normal incidence, in [0, 1].

    Examples
    --------
    >>> schlick([0.0, 1.0]).tolist()
    [1.0, 0.028]
    """
    base = 1.0 - np.clip(np.asarray(cosine, np.float64), 0.0, 1.0)
    return np.asarray(f0 + (1.0 - f0) * base**5)


def kelemen(
    normal: ArrayLike, to_light: ArrayLike, to_eye: ArrayLike, roughness: float, *, f0: float = F0
) -> Float64Array:
    """Return the BRDF, 1/sr; 0 where the light is behind the surface.

    Parameters
    ----------
    normal, to_light, to_eye
        Unit vectors, (..., 3), that point away from the surface.
    roughness
        Beckmann's m; see `model.brdf.microfacet.facet_density` for its range.
    f0
        Reflectance of a facet at normal incidence.

    Notes
    -----
    D F / (4 (l.h)^2): the geometric term 1/((l.h)^2) in place of G / (n.l n.v) is bounded but for
    grazing light against the view, and reciprocal.

    Examples
    --------
    >>> z = [0.0, 0.0, 1.0]
    >>> round(float(kelemen(z, z, z, 0.3)), 6)  # 0.028 / (4 pi 0.09)
    0.024757
    """
    n, light, v = (np.asarray(one, np.float64) for one in (normal, to_light, to_eye))
    whole = light + v
    square = np.sum(whole * whole, axis=-1)
    h = whole / np.sqrt(np.maximum(square, 1e-12))[..., None]
    density = facet_density(np.sum(n * h, axis=-1), roughness, "beckmann")
    fresnel = schlick(np.sum(v * h, axis=-1), f0)
    lit = np.sum(n * light, axis=-1) > 0.0
    return np.asarray(np.where(lit, density * fresnel / np.maximum(square, 1e-12), 0.0))
