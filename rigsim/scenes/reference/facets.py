"""Reflection of the skin's surface by Mitsuba's own rough facets: skin and oil film."""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array, Float64Array
from rigsim.light.skin_material import describe_texture
from rigsim.light.surface_brdf import ETA_OIL, OIL_SMOOTHING
from rigsim.mitsuba.scene_radiance import load_description, rough_metal
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.tissue.skin_layers import ETA

FACET_ROUGHNESS: Final = 0.35
FACET_OIL_FRACTION: Final = 0.08
"""Surface of a cheek: Beckmann roughness and fraction below oil."""
MIN_COSINE: Final = 1e-6
VARIANT_KIND: Final = "rgb"
"""That of rays on faces: a change of variant takes 57 ms."""


class SkinFacets:
    """Facets of the skin, part of them below oil, whose GGX facets have half of the roughness.

    Parameters
    ----------
    roughness
        Beckmann roughness of the skin; a number, or a texture of shape (N, N), row 0 at v = 1.
    oil
        Fraction of the surface below oil, 0 to 1; a number or a texture.

    Examples
    --------
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> bool(SkinFacets(0.3, 0.1).evaluate(up, up, up)[0] > 0.0)
    True
    """

    def __init__(self, roughness: float | Float32Array, oil: float | Float32Array) -> None:
        mi = load_mitsuba(choose_variant(VARIANT_KIND))
        self._material = load_description(
            mi,
            {
                "type": "blendbsdf",
                "weight": _describe(oil),
                "skin": rough_metal("beckmann", ETA, _describe(roughness)),
                "oil": rough_metal("ggx", ETA_OIL, _describe(OIL_SMOOTHING * roughness)),
            },
        )

    def evaluate(
        self,
        normal: ArrayLike,
        to_light: ArrayLike,
        to_camera: ArrayLike,
        uv: Float32Array | None = None,
    ) -> Float64Array:
        """Return f_r in 1/sr, shape (n,); 0 where light or camera is behind the surface.

        Parameters
        ----------
        normal, to_light, to_camera
            Unit vectors away from the skin, shape (n, 3) or (3,).
        uv
            Texture coordinates, shape (n, 2), where roughness or oil is a texture.
        """
        import drjit

        mi = load_mitsuba(choose_variant(VARIANT_KIND))
        ways = np.broadcast_arrays(np.atleast_2d(normal), to_light, to_camera)
        up, light, camera = (np.ascontiguousarray(way.T, np.float32) for way in ways)
        frame = mi.Frame3f(mi.Vector3f(*up))
        point = drjit.zeros(mi.SurfaceInteraction3f, up.shape[1])
        point.wi = frame.to_local(mi.Vector3f(*camera))
        if uv is not None:
            point.uv = mi.Point2f(*np.ascontiguousarray(uv.T, np.float32))
        outward = frame.to_local(mi.Vector3f(*light))
        found = self._material.eval(mi.BSDFContext(), point, outward)
        cosine = np.asarray(outward.z, np.float64)
        return np.asarray(
            np.where(
                cosine > MIN_COSINE, np.asarray(found[0]) / np.maximum(cosine, MIN_COSINE), 0.0
            ),
            np.float64,
        )


def _describe(values: float | Float32Array) -> Any:
    """Return a number, or the description of a texture."""
    return describe_texture(values) if isinstance(values, np.ndarray) else float(values)
