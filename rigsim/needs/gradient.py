"""Select the effects of light that the gradient sphere's images of a skin patch require."""

from functools import partial
from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.as_built.sphere import ActualSphere
from rigsim.needs import face
from rigsim.needs.effect_sizes import edge_loss, interreflection_over_direct
from rigsim.needs.effects import (
    Effect,
    EffectSelection,
    PixelNoise,
    SceneEffects,
    decide_effect,
    omitted_effects,
)
from rigsim.needs.sampled_patch import SampledPatch
from rigsim.needs.tissue import RULE_WAVELENGTH_STEP, SkinSample, select_tissue_effects
from rigsim.render.lens_blur import Lens
from rigsim.skin_patch.microrelief import CAMERA_BAND_NM, MicroSkin, lateral_kernel
from rigsim.tissue.skin_layers import MAX_C_HD, MAX_C_M
from rigsim.tissue.skin_table import WAVELENGTH_NM

OPTICS_EFFECT: Final = "diffraction and defocus"

MAX_SLOPE_GAIN: Final = 1.6
"""Largest steepening of the relief by compression: the skin buckles at 0.66 of its length."""

PATCH_MARGINS: Final = {"shadows": 3.0, "lateral": 1.8, "interreflections": 1.7, "optics": 3.0}
"""Factors on the sizes in a window, set on 10 scenes."""

PIGMENT_RANGE: Final = (0.25, 1.0, 4.0)
BLOOD_RANGE: Final = (0.7, 1.0, 3.0)
"""Melanin and blood of a patch's texels over those of its site, from 18 patches of 4 mm."""


def select_gradient_effects(
    rig: Rig,
    subject: MicroSkin | str,
    sphere: ActualSphere,
    lens: Lens,
    noise: PixelNoise,
    white: float,
    is_moving: bool,
    effects: SceneEffects,
) -> EffectSelection:
    """Select the effects that a scene in the gradient sphere builds.

    Parameters
    ----------
    rig, sphere, lens
        The rig, its actual LEDs, and the lens.
    subject
        A patch of skin, or the name of a target.
    noise
        Noise of the sensor. Highlights count as saturated.
    white
        Signal of a white patch under all LEDs in the plan's longest exposure, full scales; inf: the
        brightest skin is at full scale.
    is_moving
        Whether the patch moves.
    effects
        Requested effects.
    """
    view = rig.views[0]
    made = [face.polarization_effect(rig, view), face.band_effect(view)]
    if not isinstance(subject, MicroSkin):
        flat = "a ball bulges" if subject == "ball" else "the target is flat"
        for name, switch in (
            (face.SHADOW_EFFECT, "shadows"),
            (face.INTERREFLECTION_EFFECT, "interreflections"),
        ):
            made.append(decide_effect(name, 0.0, None, switch=switch, reason=flat))
        made.append(_optics(lens, effects.optics, noise.change_over_noise(1.0)))
        made.append(Effect(face.LATERAL_EFFECT, "absent", f"{subject} is glass, gray or absent"))
        return EffectSelection((*made, *omitted_effects("gradient")))
    made += _skin_effects(rig, subject, sphere, lens, noise, white, effects)
    still = Effect("movement of the patch", "absent", "motion=None", switch="motion")
    if not is_moving:
        return EffectSelection((*made, still, *omitted_effects("gradient", "gradient_skin")))
    moved = Effect("movement of the patch", "built", "it drifts and jumps", None, "motion")
    small = f"30 ms move 0.1 um; a pixel: {lens.pixel_on_subject_um:.1f} um"
    blur = Effect("blur by movement within an exposure", "unmodeled", small)
    world, limits = omitted_effects("gradient"), omitted_effects("gradient_skin")
    return EffectSelection((*made, moved, *world, blur, *limits))


def _optics(lens: Lens, requested: bool | None, over_noise: float) -> Effect:
    nyquist_per_mm = 500.0 / lens.pixel_on_subject_um
    kept = float(lens.otf(np.array([nyquist_per_mm]))[0])
    return decide_effect(
        OPTICS_EFFECT,
        over_noise,
        requested,
        switch="optics",
        reason=f"the lens transfers {100 * kept:.0f} % of a pattern at the pixel pitch",
    )


def _skin_effects(
    rig: Rig,
    skin: MicroSkin,
    sphere: ActualSphere,
    lens: Lens,
    noise: PixelNoise,
    white: float,
    effects: SceneEffects,
) -> list[Effect]:
    window = SampledPatch.roughest(skin, sphere, rig.views[0], lens)
    asked = {
        "shadows": effects.relief_shadows,
        "lateral": effects.lateral,
        "interreflections": effects.interreflections,
        "optics": effects.optics,
    }
    built = {name: asked[name] is not False for name in asked}
    found = window.changes_over_noise(white, noise, built)
    size = {name: PATCH_MARGINS[name] * change for name, change in found.items()}
    sigmas, weights = lateral_kernel(skin)
    pixel_mm = 1e-3 * lens.pixel_on_subject_um
    lost = float(edge_loss(sigmas, weights[None], pixel_mm).max())
    # to second order, the hidden part of the sky grows with the square of the slopes
    share = min(MAX_SLOPE_GAIN**2 * window.max_hidden_sky, 0.9)
    brightest = float(skin.albedo.max())
    # light that other walls receive changes with the reflectance, too
    change = partial(
        _sample_patch(skin).change_over_noise,
        skin.skin.tissue,
        level=min(1.0, white * brightest),
        lost=lost if effects.lateral is not False else 0.0,
        gain=1.0 + interreflection_over_direct(share, brightest),
        noise=noise,
    )
    return [
        Effect(face.RELIEF_EFFECT, "built", f"pixels of {1e3 * pixel_mm:.1f} um resolve it"),
        *select_tissue_effects(skin.skin.tissue, change, effects),
        decide_effect(
            face.SHADOW_EFFECT,
            size["shadows"],
            effects.relief_shadows,
            switch="shadows",
            reason="walls of grooves hide LEDs",
        ),
        decide_effect(
            face.LATERAL_EFFECT,
            size["lateral"],
            effects.lateral,
            switch="lateral",
            reason=f"pixels of {1e3 * pixel_mm:.1f} um lose {100 * lost:.0f} % at a shadow's edge",
        ),
        decide_effect(
            face.INTERREFLECTION_EFFECT,
            size["interreflections"],
            effects.interreflections,
            switch="interreflections",
            reason=f"walls of grooves receive up to {100 * share:.1f} % of the light from others",
        ),
        _optics(lens, effects.optics, size["optics"]),
    ]


def _sample_patch(skin: MicroSkin) -> SkinSample:
    """Return the least, mean and largest pigment and blood of a patch, in the camera's band."""
    wavelength = WAVELENGTH_NM[::RULE_WAVELENGTH_STEP]
    band = (wavelength >= CAMERA_BAND_NM[0]) & (wavelength <= CAMERA_BAND_NM[1])
    return SkinSample.from_extremes(
        np.minimum(skin.skin.c_m * np.array(PIGMENT_RANGE), MAX_C_M),
        np.minimum(skin.skin.c_hd * np.array(BLOOD_RANGE), MAX_C_HD),
        (band / band.sum())[:, None],
    )
