"""Select the effects of light that images of a face require in every rig."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from capture.rig import Rig, View
from rigsim.arrays import Float64Array, FloatArray
from rigsim.light.interreflection import (
    WAVELENGTH_STEPS,
    channel_approximation_error,
    wavelength_step_error,
)
from rigsim.light.observed_skin import ObservedSkin
from rigsim.needs.effect_sizes import edge_loss, interreflection_over_direct, scattering_over_noise
from rigsim.needs.effects import (
    NEGLIGIBLE_NOISE_RATIO,
    Effect,
    PixelNoise,
    SceneEffects,
    decide_effect,
)
from rigsim.needs.tissue import RULE_WAVELENGTH_STEP, SkinSample, select_tissue_effects
from rigsim.render import Caster
from rigsim.render.depth_of_field import depth_range, tabulate_defocus
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

TEXEL_STEP = 16
"""Every n-th texel's reflectance is evaluated."""

MAX_LAST_BOUNCE = 1e-3
"""Upper limit of the last summed bounce relative to the first."""

MIN_PIGMENT_CONTRAST = 1e-5
MIN_RELIEF_TILT_DEG = 1e-3
"""Relative change of reflectance, and tilt of normals, below every sensor's resolution: full scale
is at most a few thousand times the noise, of which a tenth counts."""

MAX_REMAINING_NOISE_RATIO = 0.05
"""Approximate limit of the remaining bounces, relative to the noise."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewingConditions:
    """Camera, light, mesh and requested effects of one view."""

    view: View
    illuminant: str
    """Spectrum of the lights."""
    caster: Caster
    """Caster of the mesh."""
    exchange_fraction: float
    """`max_exchange_fraction` of the mesh."""
    noise: PixelNoise
    """Noise of the sensor."""
    effects: SceneEffects
    """Requested effects."""
    subpixels: int
    """Rays along each side of a pixel."""

    def observe_skin(self, subject: SimulatedSubject, state: str) -> ObservedSkin:
        """Return a face under this camera and light."""
        return ObservedSkin(subject, state, self.view.spectral_sensitivity, self.illuminant)


def select_face_effects(
    skin: ObservedSkin,
    scenery: ViewingConditions,
    peak_reflectance: Float64Array,
    *,
    level: FloatArray,
    peak: float,
    finer: bool,
    lateral_switch: str = "lateral",
) -> list[Effect]:
    """Return the effects that images of a face build or omit in every rig.

    Parameters
    ----------
    skin, scenery
        The face, and the viewing conditions of its camera.
    peak_reflectance
        Its `max_reflectance_rgb`.
    level
        Signal of its brightest skin, full scales, shape (3,).
    peak
        Signal of its brightest highlight, full scales.
    finer
        Whether the wavelengths of interreflection can be thinned out.
    lateral_switch
        Name of the switch of lateral scattering.
    """
    noise, share, effects = scenery.noise, scenery.exchange_fraction, scenery.effects
    pixel_mm = scenery.view.distance_mm / scenery.view.focal_px
    kernels = skin.lateral_kernels()
    lost = edge_loss(kernels.sigmas_mm, kernels.weights, pixel_mm)
    bounced = np.array([interreflection_over_direct(share, float(r)) for r in peak_reflectance])
    more = np.minimum(level * bounced, 1.0)
    unseen = more / noise.sigma(more)  # where no direct light arrives, the noise is least
    bounces = decide_effect(
        INTERREFLECTION_EFFECT,
        float(unseen.max()),
        effects.interreflections,
        switch="interreflections",
        reason=f"hollows receive {100 * share:.0f} % of what their surroundings send out",
    )
    off = float((unseen * channel_approximation_error(skin)).max()) if bounces.is_built else 0.0
    why = "a channel's mean of squares differs from the square of its mean"
    why = why if bounces.is_built else "interreflection is absent"
    asked = effects.spectral
    spectral = off >= NEGLIGIBLE_NOISE_RATIO if asked is None else asked
    thinned = (
        [_wavelength_step_effect(bounces, spectral, choose_spectral_step(skin, bounces))]
        if finer
        else []
    )
    return [
        *texture_effects(skin),
        *_tissue_effects(
            skin,
            scenery,
            level=level,
            lost=lost if effects.lateral is not False else np.zeros_like(lost),
            gain=1.0 + bounced if bounces.is_built else np.ones_like(bounced),
        ),
        Effect(
            SHADOW_EFFECT,
            "built",
            "a face shades itself",
            noise.change_over_noise(1.0, min(peak, 1.0)),
        ),
        decide_effect(
            LATERAL_EFFECT,
            float(scattering_over_noise(lost, level, noise).max()),
            effects.lateral,
            switch=lateral_switch,
            reason=f"pixels of {pixel_mm:.2f} mm lose {100 * lost.max():.1f} % at a shadow's edge",
        ),
        bounces,
        decide_effect(SPECTRAL_EFFECT, off, asked, switch="spectral", reason=why),
        *thinned,
        further_bounces_effect(bounces, share * float(peak_reflectance.max())),
        lens_effect(scenery, peak),
        relief_shadow_effect(skin.subject, scenery, peak),
    ]


def movement_effect(subject: SimulatedSubject, requested: bool, name: str) -> Effect:
    """Return whether the face moves with its state."""
    if not requested:
        return Effect(name, "asked", "movement=False requests it", switch="movement")
    if subject.pose is None:
        return Effect(name, "absent", "at rest nothing moves", switch="movement")
    return Effect(name, "built", "the state moves the face", switch="movement")


def relief_shadow_effect(
    subject: SimulatedSubject, scenery: ViewingConditions, level: float
) -> Effect:
    """Return whether the relief of a face shadows itself."""
    covered = subject.atlas.covered
    across, along = (mm[covered] for mm in subject.atlas.texel_mm())
    down, right = (
        np.asarray(slope)[covered] for slope in np.gradient(subject.height_um.astype(np.float64))
    )
    steepest = 1e-3 * float(np.hypot(right / across, down / along).max(initial=0.0))
    # Light at the elevation of the steepest slope s has irradiance sin(elevation) =
    # s / sqrt(1 + s^2), and the relief may hide all of it.
    most = min(1.0, steepest / math.hypot(1.0, steepest) * level)
    return decide_effect(
        RELIEF_SHADOW_EFFECT,
        most / float(scenery.noise.sigma(0.0)),
        scenery.effects.relief_shadows,
        switch="relief_shadows",
        reason=f"relief as steep as {math.degrees(math.atan(steepest)):.0f} degrees",
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


def max_reflectance_rgb(skin: ObservedSkin) -> Float64Array:
    """Return the largest white-balanced reflectance of a face's skin in each channel, (3,)."""
    rgb = skin.reflectance()[skin.subject.atlas.covered][::TEXEL_STEP]
    return np.asarray(rgb.max(axis=0), np.float64)


def choose_min_bounce_fraction(over_noise: float) -> float:
    """Return the fraction of the first bounce at which the sum ends, from the bounces' size.

    Examples
    --------
    >>> choose_min_bounce_fraction(0.5), choose_min_bounce_fraction(500.0)
    (0.001, 0.0001)
    """
    return min(MAX_LAST_BOUNCE, MAX_REMAINING_NOISE_RATIO / max(over_noise, 1e-9))


def choose_spectral_step(skin: ObservedSkin, bounces: Effect) -> tuple[int, float]:
    """Return the largest wavelength step of interreflection that changes no pixel.

    Returns
    -------
    step, over_noise
        The step, as every n-th of the table's wavelengths, with its largest change of a pixel over
        the noise; 1 and the change of the smallest larger step, where every larger step changes a
        pixel.
    """
    size = float(bounces.over_noise or 0.0)
    change = math.inf
    for step in WAVELENGTH_STEPS:
        change = size * float(wavelength_step_error(skin, step).max())
        if change < NEGLIGIBLE_NOISE_RATIO:
            return step, change
    return 1, change


def _wavelength_step_effect(bounces: Effect, spectral: bool, found: tuple[int, float]) -> Effect:
    """Return whether interreflection requires all of the table's wavelengths."""
    step, over_noise = found
    if not (bounces.is_built and spectral):
        why = "interreflection is absent" if not bounces.is_built else "channels are taken whole"
        return Effect(WAVELENGTH_STEP_EFFECT, "negligible", why, 0.0, "spectral_step")
    nm = f"each {10 * step} nm are enough" if step > 1 else "each 20 nm would not be enough"
    return decide_effect(
        WAVELENGTH_STEP_EFFECT, over_noise, None, switch="spectral_step", reason=nm
    )


def further_bounces_effect(bounces: Effect, bounce_fraction: float) -> Effect:
    """Return the effect of bounces after the last summed one.

    ``bounce_fraction`` is the fraction of light per further bounce.
    """
    if not bounces.is_built:
        return Effect(
            FURTHER_BOUNCES_EFFECT, "negligible", "interreflection is absent", 0.0, "last_bounce"
        )
    over_noise = float(bounces.over_noise or 0.0)
    last = choose_min_bounce_fraction(over_noise)
    because = f"the sum ends at {last:.1g} of the first"
    left = over_noise * last / (1.0 - bounce_fraction)
    return decide_effect(FURTHER_BOUNCES_EFFECT, left, None, switch="last_bounce", reason=because)


def target_interreflection_size(scenery: ViewingConditions) -> tuple[float, str]:
    """Return the size of interreflection within a target over noise, with its reason."""
    if scenery.exchange_fraction == 0.0:
        return 0.0, "the target is flat"
    return math.inf, "the target has hollows"
