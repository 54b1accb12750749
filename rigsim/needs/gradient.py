"""Select the effects of light that the gradient sphere's images of a skin patch require."""

import math
from functools import partial
from typing import Final

import numpy as np
import scipy.fft

from capture.rig import Rig
from rigsim import shading
from rigsim.arrays import Float64Array, FloatArray
from rigsim.as_built.sphere import ActualSphere
from rigsim.light.relief_shadow import hidden_sky_fraction
from rigsim.needs import face
from rigsim.needs.effect_sizes import edge_loss, interreflection_over_direct, max_slope
from rigsim.needs.effects import (
    Effect,
    EffectSelection,
    PixelNoise,
    SceneEffects,
    decide_effect,
    omitted_effects,
)
from rigsim.needs.tissue import RULE_WAVELENGTH_STEP, SkinSample, select_tissue_effects
from rigsim.render.lens_blur import Lens
from rigsim.skin_patch.microrelief import CAMERA_BAND_NM, MicroSkin, lateral_kernel
from rigsim.tissue.skin_layers import ETA, MAX_C_HD, MAX_C_M
from rigsim.tissue.skin_table import WAVELENGTH_NM

OPTICS_EFFECT: Final = "diffraction and defocus"

MAX_SLOPE_GAIN: Final = 1.6
"""Largest steepening of the relief by compression: the skin buckles at 0.66 of its length."""

ANALYZED_TEXELS: Final = 384
"""Texels along each side of the evaluated part of the patch."""

HORIZON_SECTORS: Final = 8

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
    made = [
        face.polarization_effect(rig, view),
        face.band_effect(view),
        _optics(lens, effects.optics, noise),
    ]
    if not isinstance(subject, MicroSkin):
        flat = "a ball bulges" if subject == "ball" else "the target is flat"
        for name, switch in (
            (face.SHADOW_EFFECT, "shadows"),
            (face.INTERREFLECTION_EFFECT, "interreflections"),
        ):
            made.append(decide_effect(name, 0.0, None, switch=switch, reason=flat))
        made.append(Effect(face.LATERAL_EFFECT, "absent", f"{subject} is glass, gray or absent"))
        return EffectSelection((*made, *omitted_effects("gradient")))
    made += _skin_effects(subject, sphere, lens, noise, white, effects)
    still = Effect("movement of the patch", "absent", "motion=None", switch="motion")
    if not is_moving:
        return EffectSelection((*made, still, *omitted_effects("gradient", "gradient_skin")))
    moved = Effect("movement of the patch", "built", "it drifts and jumps", None, "motion")
    small = f"30 ms move 0.1 um; a pixel: {lens.pixel_on_subject_um:.1f} um"
    blur = Effect("blur by movement within an exposure", "unmodeled", small)
    world, limits = omitted_effects("gradient"), omitted_effects("gradient_skin")
    return EffectSelection((*made, moved, *world, blur, *limits))


def _optics(lens: Lens, asked: bool | None, noise: PixelNoise) -> Effect:
    nyquist_per_mm = 500.0 / lens.pixel_on_subject_um
    kept = float(lens.otf(np.array([nyquist_per_mm]))[0])
    return decide_effect(
        OPTICS_EFFECT,
        noise.change_over_noise(1.0 - kept),
        asked,
        switch="optics",
        reason=f"the lens transfers {100 * kept:.0f} % of a pattern at the pixel pitch",
    )


def _skin_effects(
    skin: MicroSkin,
    sphere: ActualSphere,
    lens: Lens,
    noise: PixelNoise,
    white: float,
    effects: SceneEffects,
) -> list[Effect]:
    middle = skin.height_um.shape[0] // 2
    half = min(middle, ANALYZED_TEXELS // 2)
    part = np.ascontiguousarray(
        skin.height_um[middle - half : middle + half, middle - half : middle + half]
    )
    down, right = (np.asarray(slope) for slope in np.gradient(part, skin.texel_um))
    steepest = MAX_SLOPE_GAIN * max_slope(right, down)
    place = sphere.position_mm[sphere.position_mm[:, 2] > 0.0]
    lowest = float((place[:, 2] / np.hypot(place[:, 0], place[:, 1])).min())
    length = np.sqrt(1.0 + right**2 + down**2)
    normals = np.stack([-right / length, down / length, 1.0 / length], axis=-1)
    hidden = shading.interior_scale(ETA) * hidden_sky_fraction(
        part,
        normals.astype(np.float32),
        margin=0,
        pixel_um=skin.texel_um,
        sectors=HORIZON_SECTORS,
        boundaries=True,
    )
    sigmas, weights = lateral_kernel(skin)
    if effects.lateral is not False:  # light from other walls scatters laterally, as all light does
        hidden = _scatter_hidden_light(hidden, sigmas, weights, 1e-3 * skin.texel_um)
    # to second order, the hidden part of the sky grows with the square of the slopes
    share = min(MAX_SLOPE_GAIN**2 * float(np.quantile(hidden, 0.999)), 0.9)
    brightest = float(skin.albedo.max())
    more = interreflection_over_direct(share, brightest)
    pixel_mm = 1e-3 * lens.pixel_on_subject_um
    lost = float(edge_loss(sigmas, weights[None], pixel_mm).max())
    level = min(1.0, white * brightest)
    # light that other walls receive changes with the reflectance, too
    change = partial(
        _sample_patch(skin).change_over_noise,
        skin.skin.tissue,
        level=level,
        lost=lost if effects.lateral is not False else 0.0,
        gain=1.0 + more,
        noise=noise,
    )
    deg = (math.degrees(math.atan(steepest)), math.degrees(math.atan(lowest)))
    return [
        Effect(face.RELIEF_EFFECT, "built", f"pixels of {1e3 * pixel_mm:.1f} um resolve it"),
        *select_tissue_effects(skin.skin.tissue, change, effects),
        decide_effect(
            face.SHADOW_EFFECT,
            noise.change_over_noise(1.0) if steepest > lowest else 0.0,
            effects.relief_shadows,
            switch="shadows",
            reason=f"slopes up to {deg[0]:.0f} degrees, LEDs down to {deg[1]:.0f}",
        ),
        decide_effect(
            face.LATERAL_EFFECT,
            noise.change_over_noise(lost, level),
            effects.lateral,
            switch="lateral",
            reason=f"pixels of {1e3 * pixel_mm:.1f} um lose {100 * lost:.0f} % at a shadow's edge",
        ),
        decide_effect(
            face.INTERREFLECTION_EFFECT,
            noise.change_over_noise(more, level),
            effects.interreflections,
            switch="interreflections",
            reason=f"walls of grooves receive up to {100 * share:.1f} % of the light from others",
        ),
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


def _scatter_hidden_light(
    hidden: FloatArray, sigmas_mm: Float64Array, weights: Float64Array, texel_mm: float
) -> Float64Array:
    """Return the light of a part of the patch after lateral scattering, mirrored at its border."""
    axis = np.arange(len(hidden)) / (2.0 * len(hidden) * texel_mm)
    square = 2.0 * np.pi**2 * (axis[:, None] ** 2 + axis[None, :] ** 2)
    kernel = np.tensordot(weights, np.exp(-(sigmas_mm**2)[:, None, None] * square), axes=1)
    return np.asarray(scipy.fft.idctn(scipy.fft.dctn(hidden) * kernel), np.float64)
