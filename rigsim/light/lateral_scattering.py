"""What leaves the inside of a face under one lamp: light that spread sideways, or came from skin.

The light that enters is gathered in the face's texture; it spreads by the same lateral transport as
in the flash rig (`rigsim.light.subsurface_radiance.scatter_patterned_light` says how well that
holds), and comes from other skin by `rigsim.light.interreflection`.
"""

from typing import Final

import numpy as np

from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import dilate_texture
from rigsim.light import lateral
from rigsim.light.interreflection import InterreflectionColor, InterreflectionSettings
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.olat import Lamp
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.light.subsurface_radiance import pigment_transmittance
from rigsim.light.surface_brdf import HAIR_REFLECTANCE, SkinSurface
from rigsim.render import Caster, visibility
from rigsim.tissue.skin_layers import ETA

LED_SHADOW_SAMPLES: Final = 4
"""Points on the lamp that cast shadows on each texel."""


class LateralScattering:
    """One face, ready to be lit from within.

    Parameters
    ----------
    skin
        The face; its blood is that of a neutral face.
    surface
        Its reflection.
    caster
        Its mesh.
    subsurface
        Whether light spreads sideways.
    bounces
        How light goes from skin to skin; None leaves that out.
    relief
        What of the texture's relief hides lights; None: nothing.
    """

    def __init__(
        self,
        skin: ObservedSkin,
        surface: SkinSurface,
        caster: Caster,
        subsurface: bool,
        bounces: InterreflectionSettings | None,
        relief: ReliefShadow | None,
    ) -> None:
        self._subject, self._surface, self._caster = skin.subject, surface, caster
        self._relief, self.subsurface, self._bounces = relief, subsurface, bounces
        if bounces is not None:
            self._color = InterreflectionColor(bounces, skin, surface.r_d, surface.reflectance)
        if subsurface:
            clear = skin.reflectance_without_melanin()
            self._kernels = skin.lateral_kernels()
            self._pigment = pigment_transmittance(surface.reflectance, clear, skin.subject.atlas)
            self._inside = self._pigment * clear

    def glow(self, lamp: Lamp) -> Float32Array:
        """Return what leaves the interior before the boundary.

        Parameters
        ----------
        lamp
            The light, in the frame of the mesh, of intensity 1 mm^2 on its axis.

        Returns
        -------
        ndarray of float32
            pi times radiance, shape (N, N, 3): with lateral transport all light from inside,
            without it only that which came from other skin; multiplied by the boundary's
            transmittance it is what a camera sees.
        """
        subject, surface = self._subject, self._surface
        atlas = subject.atlas
        covered = atlas.covered[..., None]
        came: Float32Array | None = None
        if self._bounces is not None:
            point, normal = self._bounces.exchange.surface()
            direct = entering_irradiance(self._caster, lamp, point, normal, normal)[0]
            came = self._color.on_texture(direct, atlas.size)
        if not self.subsurface:
            if came is None:
                raise ValueError("glow: got neither subsurface nor bounce, expected one")
            return dilate_texture(surface.r_d * came, atlas.covered)
        entered = entering_irradiance(
            self._caster, lamp, atlas.position_mm, surface.normal, atlas.normal
        )
        if self._relief is not None:
            entered *= self._relief.on_texture(
                atlas.position_mm, lamp.position_mm, radius_mm=lamp.radius_mm
            )
        light = entered[..., None] if came is None else entered[..., None] + came
        light = np.where(covered, light, np.float32(0.0))
        spreading = np.ascontiguousarray(self._inside * light, np.float32)
        weights = self._kernels.weights
        scale = np.float32(shading.interior_scale(ETA))
        skin = lateral.scatter_laterally(spreading, atlas, self._kernels.sigmas_mm, weights)
        hair = subject.hair[..., None]
        over = hair * np.asarray(HAIR_REFLECTANCE, np.float32) * light
        return dilate_texture(scale * ((1.0 - hair) * self._pigment * skin + over), atlas.covered)


def entering_irradiance(
    caster: Caster,
    lamp: Lamp,
    position_mm: Float32Array,
    normal: Float32Array,
    mesh_normal: Float32Array,
) -> Float32Array:
    """Return the light of a lamp that enters, for an intensity of 1 mm^2 on its axis.

    Parameters
    ----------
    caster
        The mesh that casts shadows.
    lamp
        The light.
    position_mm, normal, mesh_normal
        Points, their normals with relief, and those of the mesh, shape (..., 3).

    Returns
    -------
    ndarray of float32
        Shape (...).
    """
    seen = visibility(
        caster,
        position_mm,
        mesh_normal,
        lamp.position_mm,
        radius_mm=lamp.radius_mm,
        samples=LED_SHADOW_SAMPLES,
    )
    way = np.asarray(lamp.position_mm, np.float32) - position_mm
    squared = np.sum(way * way, axis=-1)
    way /= np.sqrt(squared)[..., None]
    cosine = np.clip(np.sum(way * normal, axis=-1), 0.0, 1.0)
    off = np.maximum(-(way @ np.asarray(lamp.axis, np.float32)), 0.0)
    rs, rp = shading.fresnel_amplitudes(cosine, ETA)
    passed = 1.0 - 0.5 * (rs * rs + rp * rp)
    return np.asarray(seen * cosine * off**lamp.exponent * passed / squared, np.float32)
