"""Select the effects of light that images of a face require in every rig."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from capture.rig import Rig, View
from rigsim.arrays import FloatArray
from rigsim.light.interreflection import WAVELENGTH_STEPS, Interreflection
from rigsim.light.observed_skin import ObservedSkin, observe_skin
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.needs.effect_sizes import edge_loss, interreflection_over_direct, max_exchange_fraction
from rigsim.needs.effects import (
    NEGLIGIBLE_NOISE_RATIO,
    Effect,
    PixelNoise,
    SceneEffects,
    decide_effect,
)
from rigsim.needs.sampled_bounces import SampledBounces
from rigsim.needs.sampled_light import LitFace, blur_over_noise, scattering_over_noise
from rigsim.needs.sampled_relief import relief_shadows_over_noise
from rigsim.needs.tissue import RULE_WAVELENGTH_STEP, SkinSample, select_tissue_effects
from rigsim.render import Caster
from rigsim.render.depth_of_field import depth_before_focus, depth_range, tabulate_defocus
from rigsim.subject import SimulatedSubject

LATERAL_EFFECT = "lateral scattering in skin"
INTERREFLECTION_EFFECT = "interreflection"
SPECTRAL_EFFECT = "spectral interreflection"
WAVELENGTH_STEP_EFFECT = "wavelength step of interreflection"
FURTHER_BOUNCES_EFFECT = "bounces beyond the sum"
POLARIZATION_EFFECT = "polarization"
SHADOW_EFFECT = "shadows"
LENS_EFFECT = "depth of field and lens blur"
BAND_EFFECT = "bands of the camera"
RELIEF_EFFECT = "relief of the skin"
PIGMENT_EFFECT = "pattern of pigment"
RELIEF_SHADOW_EFFECT = "shadows of relief"

MIN_PIGMENT_CONTRAST = 1e-5
MIN_RELIEF_TILT_DEG = 1e-3
"""Relative change of reflectance, and tilt of normals, below every sensor's resolution: full scale
is at most a few thousand times the noise, of which a tenth counts."""

MAX_REMAINING_NOISE_RATIO = 0.05
"""Limit of the remaining bounces, relative to the noise."""

BOUNCE_MARGIN = 1.4
SPECTRAL_MARGIN = 1.65
STEP_MARGIN = 1.5
"""Factors on the first bounce, its color and its wavelengths, for parts of patches; set on 4 scenes
of the flash rig, under grazing light, and on the darkest face in the dome."""

LATERAL_MARGIN = 0.6
LENS_MARGIN = 0.6
"""Factors on steps of sampled light, set on 8 scenes of the flash rig and 6 of the dome."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewingConditions:
    """Camera, light, mesh and requested effects of one view."""

    view: View
    illuminant: str
    """Spectrum of the lights."""
    caster: Caster
    """Caster of the mesh."""
    exchange: Interreflection | None
    """Exchange between the patches of the mesh; None: it is flat, or omitted on request."""
    relief: ReliefShadow | None
    """Shadows of a face's relief; None: a target, or omitted on request."""
    noise: PixelNoise
    """Noise of the sensor."""
    effects: SceneEffects
    """Requested effects."""
    subpixels: int
    """Rays along each side of a pixel."""

    def observe_skin(self, subject: SimulatedSubject, state: str) -> ObservedSkin:
        """Return a face under this camera and light."""
        return observe_skin(subject, state, self.view.spectral_sensitivity, self.illuminant)


def select_face_effects(
    face: LitFace,
    scenery: ViewingConditions,
    *,
    level: FloatArray,
    finer: bool,
    lateral_switch: str = "lateral",
) -> list[Effect]:
    """Return the effects that images of a face build or omit in every rig.

    Parameters
    ----------
    face, scenery
        The face, and the viewing conditions of its camera.
    level
        Signal of its brightest skin, full scales, shape (3,).
    finer
        Whether the wavelengths of interreflection can be thinned out.
    lateral_switch
        Name of the switch of lateral scattering.
    """
    noise, effects, skin = scenery.noise, scenery.effects, face.skin
    pixel_mm = scenery.view.distance_mm / scenery.view.focal_px
    kernels = skin.lateral_kernels()
    lost = edge_loss(kernels.sigmas_mm, kernels.weights, pixel_mm)
    bounced = interreflection_effects(face, scenery, finer=finer)
    share = max_exchange_fraction(scenery.exchange)
    gain = np.array([interreflection_over_direct(share, float(r)) for r in face.brightest])
    images = range(len(face.white))
    scattered = LATERAL_MARGIN * max(
        scattering_over_noise(face.diffuse(k), face.light, lost, noise) for k in images
    )
    return [
        *texture_effects(skin),
        *_tissue_effects(
            skin,
            scenery,
            level=level,
            lost=lost if effects.lateral is not False else np.zeros_like(lost),
            gain=1.0 + gain if bounced[0].is_built else np.ones_like(gain),
        ),
        Effect(
            SHADOW_EFFECT,
            "built",
            "a face shades itself",
            noise.change_over_noise(1.0, min(face.peak, 1.0)),
        ),
        decide_effect(
            LATERAL_EFFECT,
            scattered,
            effects.lateral,
            switch=lateral_switch,
            reason=f"pixels of {pixel_mm:.2f} mm lose {100 * lost.max():.1f} % at a shadow's edge",
        ),
        *bounced,
        face_lens_effect(face, scenery),
        relief_shadow_effect(face, scenery),
    ]


def interreflection_effects(
    face: LitFace, scenery: ViewingConditions, *, finer: bool
) -> list[Effect]:
    """Return interreflection, its color, its wavelengths if these are ``finer``, and its end."""
    effects, none = scenery.effects, 0.0
    name, switch = INTERREFLECTION_EFFECT, "interreflections"
    found = None
    if effects.interreflections is False:
        bounces = Effect(name, "asked", f"{switch}=False requests it", switch=switch)
    elif scenery.exchange is None:
        bounces = decide_effect(name, none, None, switch=switch, reason="the surface is flat")
    else:
        found = SampledBounces(
            face.skin, scenery.exchange, face.light, face.white, scenery.noise, face.reflectance
        )
        size = BOUNCE_MARGIN * found.over_noise(found.by_channel)
        share = 100.0 * max_exchange_fraction(scenery.exchange)
        why = f"hollows receive {share:.0f} % of what their surroundings send out"
        asked = effects.interreflections
        bounces = decide_effect(name, size, asked, switch=switch, reason=why)
    if found is None or not bounces.is_built:
        why = "interreflection is absent"
        steps = [Effect(WAVELENGTH_STEP_EFFECT, "negligible", why, none, "spectral_step")]
        return [
            bounces,
            decide_effect(SPECTRAL_EFFECT, none, effects.spectral, switch="spectral", reason=why),
            *(steps if finer else []),
            Effect(FURTHER_BOUNCES_EFFECT, "negligible", why, none, "last_bounce"),
        ]
    exact = found.by_wavelength()
    spectral = decide_effect(
        SPECTRAL_EFFECT,
        SPECTRAL_MARGIN * found.over_noise(exact, found.by_channel),
        effects.spectral,
        switch="spectral",
        reason="a channel's mean of squares differs from the square of its mean",
    )
    return [
        bounces,
        spectral,
        *([_wavelength_step_effect(found, exact, spectral)] if finer else []),
        _further_bounces_effect(found),
    ]


def movement_effect(subject: SimulatedSubject, requested: bool, name: str) -> Effect:
    """Return whether the face moves with its state."""
    if not requested:
        return Effect(name, "asked", "movement=False requests it", switch="movement")
    if subject.pose is None:
        return Effect(name, "absent", "at rest nothing moves", switch="movement")
    return Effect(name, "built", "the state moves the face", switch="movement")


def relief_shadow_effect(face: LitFace, scenery: ViewingConditions) -> Effect:
    """Return whether the relief of a face shadows itself."""
    name, switch = RELIEF_SHADOW_EFFECT, "relief_shadows"
    if scenery.relief is None:
        return Effect(name, "asked", f"{switch}=False requests it", switch=switch)
    pixel_mm = scenery.view.distance_mm / scenery.view.focal_px
    size = relief_shadows_over_noise(face, scenery.caster, scenery.relief, scenery.noise, pixel_mm)
    asked = scenery.effects.relief_shadows
    return decide_effect(name, size, asked, switch=switch, reason="pores and wrinkles hide lights")


def face_lens_effect(face: LitFace, scenery: ViewingConditions) -> Effect:
    """Return whether the lens blurs a face: at the edges of its light, and at its outline."""
    view = scenery.view
    depths = depth_range(view, scenery.caster.mesh)
    spread = tabulate_defocus(
        view, scenery.illuminant, subpixels=scenery.subpixels, depths_mm=depths
    )
    toward = depth_before_focus(view, face.light.position_mm)
    spilled = spread.spilled_fraction(toward)
    size = LENS_MARGIN * max(
        blur_over_noise(face.diffuse(k) + face.highlight(k), face.light, spilled, scenery.noise)
        for k in range(len(face.white))
    )
    most = 100.0 * float(spilled[face.light.visible].max(initial=0.0))
    return decide_effect(
        LENS_EFFECT,
        size,
        scenery.effects.optics,
        switch="optics",
        reason=f"at f/{view.f_number:g}, {most:.0f} % of a pixel's light falls on others",
    )


def lens_effect(scenery: ViewingConditions, level: float) -> Effect:
    """Return whether the lens blurs: the largest light loss of a pixel to its neighbors.

    Parameters
    ----------
    scenery
        Viewing conditions; the depth range of the mesh sets its distance from the plane in focus.
    level
        The brightest pixel, full scales; it may exceed 1.
    """
    view, noise, subpixels = scenery.view, scenery.noise, scenery.subpixels
    depths = depth_range(view, scenery.caster.mesh)
    spread = tabulate_defocus(view, scenery.illuminant, subpixels=subpixels, depths_mm=depths)
    spilled = spread.max_spilled_fraction(depths)
    far = max(abs(depth) for depth in depths)
    gained = min(1.0, level * spilled)  # by a black pixel among bright ones, where noise is least
    return decide_effect(
        LENS_EFFECT,
        gained / float(noise.sigma(gained)),
        scenery.effects.optics,
        switch="optics",
        reason=f"at f/{view.f_number:g}, up to {far:.0f} mm off focus, "
        f"{100 * spilled:.0f} % of a pixel's light falls on others",
    )


def polarization_effect(rig: Rig, view: View) -> Effect:
    """Return whether light is kept as Stokes vectors: only polarizers make polarization visible."""
    films = [light.name for light in rig.lights if light.polarizer_axis_deg is not None]
    if films or view.analyzer_axis_deg is not None:
        reason = f"polarized: {len(films)} of {len(rig.lights)} lights, analyzer before {view.name}"
        return Effect(POLARIZATION_EFFECT, "built", reason)
    return Effect(
        POLARIZATION_EFFECT,
        "absent",
        "the rig has no polarizer, and sensors do not detect polarization",
    )


def band_effect(view: View) -> Effect:
    """Return the number of color bands."""
    if view.cfa == "MONO":
        return Effect(BAND_EFFECT, "built", "one: the sensor has no filters")
    return Effect(BAND_EFFECT, "built", "three: those of the sensor's filters")


def texture_effects(skin: ObservedSkin) -> list[Effect]:
    """Return whether a face requires its relief and its pigment map."""
    subject = skin.subject
    covered = subject.atlas.covered
    cosine = np.einsum("ij,ij->i", subject.normal[covered], subject.atlas.normal[covered])
    tilt = math.degrees(math.acos(min(max(float(cosine.min()), -1.0), 1.0)))
    melanin = subject.melanin[covered]
    ends = np.array([melanin.min(), np.median(melanin), melanin.max()], np.float32)
    blood = np.full_like(ends, np.median(subject.hemoglobin("neutral")[covered]))
    rgb = skin.color.rgb(ends, blood)
    least, most = float((rgb[2] / rgb[1]).min()), float((rgb[0] / rgb[1]).max())
    flat, even = tilt < MIN_RELIEF_TILT_DEG, max(most - 1.0, 1.0 - least) < MIN_PIGMENT_CONTRAST
    return [
        Effect(
            RELIEF_EFFECT, "negligible" if flat else "built", f"it tilts up to {tilt:.0f} degrees"
        ),
        Effect(
            PIGMENT_EFFECT,
            "negligible" if even else "built",
            f"reflectance is {least:.2g} to {most:.2g} times its median's",
        ),
    ]


def _tissue_effects(
    skin: ObservedSkin,
    scenery: ViewingConditions,
    *,
    level: FloatArray,
    lost: FloatArray,
    gain: FloatArray,
) -> list[Effect]:
    """Return whether a face requires each property of its tissue."""
    sample = SkinSample.from_extremes(
        *skin.covered_chromophores(), skin.band_weights(RULE_WAVELENGTH_STEP)
    )
    change = partial(
        sample.change_over_noise,
        skin.subject.tissue,
        level=level,
        lost=lost,
        gain=gain,
        noise=scenery.noise,
    )
    return select_tissue_effects(skin.subject.tissue, change, scenery.effects)


def _wavelength_step_effect(found: SampledBounces, exact: FloatArray, spectral: Effect) -> Effect:
    """Return whether interreflection requires all of the table's wavelengths."""
    if not spectral.is_built:
        return Effect(
            WAVELENGTH_STEP_EFFECT, "negligible", "channels are taken whole", 0.0, "spectral_step"
        )
    change, chosen = math.inf, 1
    for step in WAVELENGTH_STEPS:
        change = STEP_MARGIN * found.over_noise(exact, found.by_wavelength(step))
        if change < NEGLIGIBLE_NOISE_RATIO:
            chosen = step
            break
    nm = f"each {10 * chosen} nm are enough" if chosen > 1 else "each 20 nm would not be enough"
    return decide_effect(
        WAVELENGTH_STEP_EFFECT, change, None, switch="spectral_step", reason=nm, choice=chosen
    )


def _further_bounces_effect(found: SampledBounces) -> Effect:
    """Return the effect of bounces after the last summed one, and where the sum ends."""
    last, left = next(
        (last, BOUNCE_MARGIN * change)
        for last, change in found.further_bounces()
        if BOUNCE_MARGIN * change < MAX_REMAINING_NOISE_RATIO
    )
    return decide_effect(
        FURTHER_BOUNCES_EFFECT,
        left,
        None,
        switch="last_bounce",
        reason=f"the sum ends at {last:.1g} of the first",
        choice=last,
    )


def target_interreflection_size(scenery: ViewingConditions) -> tuple[float, str]:
    """Return the size of interreflection within a target over noise, with its reason."""
    if scenery.exchange is None:
        return 0.0, "the target is flat"
    return math.inf, "the target has hollows"
