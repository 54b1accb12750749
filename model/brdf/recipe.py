"""The 59 dielectric materials of the built-in basis, as functions.

They span oily, dry, made-up and powdered skin: sharp to wide specular reflection of three facet
distributions at three refractive indices, sheen, retroreflection, and a residual diffuse lobe.
"""

from collections.abc import Callable, Iterator

import numpy as np

from model.arrays import Float64Array
from model.brdf import microfacet

Brdf = Callable[[Float64Array, Float64Array], Float64Array]
"""Takes light and view, unit vectors (..., 3) where +z is the normal; gives 1/sr, NaN: unknown."""

GGX_ROUGHNESS = (0.05, 0.07, 0.1, 0.14, 0.18, 0.22, 0.27, 0.33, 0.4, 0.48, 0.58, 0.7)
GGX_ETA = (1.3, 1.4, 1.55)
BECKMANN_ROUGHNESS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6)
BLINN_ROUGHNESS = (0.08, 0.13, 0.2, 0.28, 0.36, 0.45)
SHEEN_WIDTH = (0.25, 0.4, 0.6)
RETRO_WIDTH = (0.15, 0.3, 0.5)
FACET_ETA = 1.4  # of the Beckmann and cosine-power lobes, skin's


def materials() -> Iterator[tuple[str, Brdf]]:
    """Yield the names and functions of all materials, 59 of them.

    Examples
    --------
    >>> len(list(materials()))
    59
    """
    for eta in GGX_ETA:
        for roughness in GGX_ROUGHNESS:
            yield f"ggx {roughness:g} eta {eta:g}", _facets(roughness, eta, "ggx")
    for roughness in BECKMANN_ROUGHNESS:
        yield f"beckmann {roughness:g}", _facets(roughness, FACET_ETA, "beckmann")
    for roughness in BLINN_ROUGHNESS:
        yield f"blinn {roughness:g}", _facets(roughness, FACET_ETA, "blinn")
    for width in SHEEN_WIDTH:
        yield f"sheen {width:g}", _sheen(width)
    for width in RETRO_WIDTH:
        yield f"retro {width:g}", _retro(width)
    yield "diffuse", _diffuse
    yield "rough diffuse", _rough_diffuse


def _cosines(light: Float64Array, view: Float64Array) -> tuple[Float64Array, ...]:
    """Return cosines of light, view and half vector to +z, and of the difference angle."""
    mu_l, mu_v = light[..., 2], view[..., 2]
    cos_d = np.sqrt(np.clip(0.5 * (1.0 + np.sum(light * view, axis=-1)), 0.0, 1.0))
    cos_h = np.clip((mu_l + mu_v) / np.maximum(2.0 * cos_d, 1e-9), 0.0, 1.0)
    return mu_l, mu_v, cos_h, cos_d


def _facets(roughness: float, eta: float, kind: microfacet.Distribution) -> Brdf:
    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        return microfacet.brdf(*_cosines(light, view), roughness=roughness, eta=eta, kind=kind)

    return brdf


def _sheen(width: float) -> Brdf:
    """Return the sheen of fine upright hairs: facet density sin^(1/width) of the half angle.

    Estevez and Kulla 2017 (sheen), with the shadowing of Neubelt and Pettineo 2013.
    """

    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        mu_l, mu_v, cos_h, _ = _cosines(light, view)
        mu_l, mu_v = np.maximum(mu_l, 0.0), np.maximum(mu_v, 0.0)
        density = (2.0 + 1.0 / width) * (1.0 - cos_h**2) ** (0.5 / width) / (2.0 * np.pi)
        return np.asarray(density / (4.0 * np.maximum(mu_l + mu_v - mu_l * mu_v, 1e-2)))

    return brdf


def _retro(width: float) -> Brdf:
    """Return retroreflection: a Gaussian of the difference angle."""

    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        _, _, _, cos_d = _cosines(light, view)
        return np.asarray(np.exp((cos_d**2 - 1.0) / width**2) / np.pi)

    return brdf


def _diffuse(light: Float64Array, view: Float64Array) -> Float64Array:
    return np.full(light.shape[:-1], 1.0 / np.pi)


def _rough_diffuse(light: Float64Array, view: Float64Array) -> Float64Array:
    """Return the rough diffuse lobe of Oren and Nayar 1994 with slopes of 0.5 rad."""
    mu_l, mu_v, _, _ = _cosines(light, view)
    mu_l, mu_v = np.maximum(mu_l, 0.0), np.maximum(mu_v, 0.0)
    s2 = 0.5**2
    a, b = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    cos_azimuth = np.sum(light * view, axis=-1) - mu_l * mu_v
    sines = np.where(cos_azimuth > 0.0, np.maximum(np.maximum(mu_l, mu_v), 1e-2), 1.0)
    return np.asarray(np.maximum(a + b * cos_azimuth / sines, 0.0) / np.pi)
