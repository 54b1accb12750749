"""Crossed light of skin with grooves and even pigment, as voxels and by the gradient rig's scene.

Both have the same heights, LEDs that are points without polarizers, and no lens. The fast
renderer's interior is Lambertian, with one lateral profile that does not depend on the relief.
"""

import dataclasses
from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.arrays import Float64Array
from rigsim.as_built.sphere import diffuser_radiance
from rigsim.mitsuba.scene_radiance import point_light_rig
from rigsim.mitsuba.variant import choose_renderer
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.gradient.patch import SHADOW_MARGIN_PX
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP, NO_POLARIZERS
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.reference.gradient_skin import NO_EXTINCTION
from rigsim.scenes.reference.patch import RELIEF_TEXEL_UM, SkinPatch, draw_patch
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject.person_skin import PersonSkin

RELIEF_VOXEL_MM: Final = 1e-3 * RELIEF_TEXEL_UM
"""Side of a voxel: that of the relief's texels, so that both renderers have the same heights."""

RELIEF_ROUGHNESS: Final = 0.3
"""Beckmann roughness of the boundary. Connections through a smoother relief are rare and bright:
images at 0.05 have 20 times the noise. Light that facets reflect onto each other is lost, 10 %."""


def draw_grooves(person: PersonSkin, site: str, field_mm: float) -> SkinPatch:
    """Return skin with the relief of a site and even pigment.

    Parameters
    ----------
    person, site
        As for `rigsim.subject.person_skin.skin_maps`.
    field_mm
        Side of the camera's field, mm.

    Examples
    --------
    >>> skin = draw_grooves(PersonSkin.of_preset("III"), "forehead", 0.1)
    >>> skin.height_mm.shape == skin.melanin.shape, float(skin.melanin.std()) < 1e-6
    (True, True)
    """
    drawn = draw_patch(
        person,
        site,
        field_mm=field_mm,
        voxel_mm=RELIEF_VOXEL_MM,
        alpha=RELIEF_ROUGHNESS,
        relief=True,
    )
    flat = person.at(site)
    even = np.ones_like(drawn.melanin)
    return dataclasses.replace(
        drawn, melanin=np.float32(flat.c_m) * even, blood=np.float32(flat.c_hd) * even
    )


def predict_relief(
    person: PersonSkin, patch: SkinPatch, rig: Rig, site: str, *, lateral: bool = True
) -> Float64Array:
    """Return the four moments of the patch's crossed light by the fast renderer, (4, H, W).

    Parameters
    ----------
    person, site
        As for `draw_grooves`.
    patch
        Its result.
    rig
        The gradient rig, cropped to the field.
    lateral
        Whether light scatters laterally.

    Returns
    -------
    ndarray
        Over the light of a white diffuser under all LEDs.
    """
    skin = make_micro_skin(
        site,
        seed=person.seed,
        size_mm=len(patch.x_mm) * patch.voxel_mm,
        texel_um=RELIEF_TEXEL_UM,
        person=person,
    )
    even = np.full_like(skin.albedo, float(np.mean(skin.albedo)))
    scene = GradientScene(
        point_light_rig(rig),
        dataclasses.replace(skin, albedo=even),
        films=NO_POLARIZERS,
        effects=SceneEffects(optics=False, lateral=lateral),
        choice=choose_renderer("fast"),
    )
    wide = scene.surface(NEUTRAL_GRIP, border_px=SHADOW_MARGIN_PX)
    lighting, pitch_um = scene.lighting(), scene.lens.pixel_on_subject_um
    total = lighting.stokes(wide, margin=SHADOW_MARGIN_PX, pitch_um=pitch_um)
    facets = lighting.direct.packed(wide, margin=SHADOW_MARGIN_PX, pitch_um=pitch_um)[:12]
    white = diffuser_radiance(scene.sphere, np.zeros(1), np.zeros(1), extinction=NO_EXTINCTION)
    return np.asarray((total - facets)[::3].astype(np.float64) / float(white[0, 0]))
