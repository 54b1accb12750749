"""Compute the subsurface light of a face under one lamp: lateral scattering and interreflection.

The light that enters is accumulated in the face's texture. It scatters laterally as in the flash
rig (`rigsim.light.subsurface_radiance.scatter_patterned_light` states the accuracy); light from
other skin follows `rigsim.light.interreflection`.
"""

from typing import Final

import numpy as np

from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import dilate_texture
from rigsim.light.interreflection import InterreflectionColor, InterreflectionSettings
from rigsim.light.lateral import HeatFlow
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.olat import Lamp
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.light.subsurface_radiance import pigment_transmittance
from rigsim.light.surface_brdf import HAIR_REFLECTANCE, SkinSurface
from rigsim.render import Caster, texture_visibility, visibility
from rigsim.tissue.skin_layers import ETA

LED_SHADOW_SAMPLES: Final = 4
"""Points on the lamp for the shadows on each texel."""


class LateralScattering:
    """Subsurface light transport of one face.

    Parameters
    ----------
    skin
        The face, with the blood of its neutral state.
    surface
        Its reflection.
    caster
        Its mesh.
    subsurface
        Whether light scatters laterally.
    bounces
        Settings of interreflection; None omits it.
    relief
        Shadows of the texture's relief; None: none.
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
            kernels = skin.lateral_kernels()
            self._flow = HeatFlow(skin.subject.atlas, kernels.sigmas_mm, kernels.weights)
            self._pigment = pigment_transmittance(surface.reflectance, clear, skin.subject.atlas)
            self._inside = self._pigment * clear

    def glow(self, lamp: Lamp) -> Float32Array:
        """Return the light that leaves the interior, before the boundary.

        Parameters
        ----------
        lamp
            The light, in the frame of the mesh, of intensity 1 mm^2 on its axis.

        Returns
        -------
        ndarray of float32
            pi times radiance, shape (N, N, 3): with lateral scattering all subsurface light,
            without it only the interreflected part; its product with the boundary's transmittance
            reaches the camera.
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
        scale = np.float32(shading.interior_scale(ETA))
        skin = self._flow.scatter(spreading)
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
        Points, their normals with relief, and those of the mesh, shape (N, N, 3), or (1, n, 3)
        without neighborhood.

    Returns
    -------
    ndarray of float32
        Shape (...).
    """
    seen = (texture_visibility if position_mm.shape[0] > 1 else visibility)(
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
