"""What the flash rig's pictures of a face or a target must hold, and what they need not."""

from __future__ import annotations

import math

import numpy as np

from capture.rig import Rig, View
from rigsim import shading
from rigsim.arrays import Float64Array, FloatArray
from rigsim.light.interreflection_color import WAVELENGTH_STEPS, color_error, step_error
from rigsim.light.subsurface_radiance import typical_kernels
from rigsim.needs.effect_sizes import (
    bounced,
    edge_loss,
    exchange_share,
    highlight,
    most_irradiance,
    spread_over_noise,
)
from rigsim.needs.effects import (
    NEGLIGIBLE_NOISE_RATIO,
    Effect,
    EffectSelection,
    Noise,
    SceneEffects,
    absent,
    decide,
    unmodeled,
)
from rigsim.render import Caster
from rigsim.render.depth_of_field import facing_depths, lens_spread
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target
from rigsim.tissue.skin_color import skin_color

LATERAL_EFFECT = "light spreading sideways in skin"
INTERREFLECTION_EFFECT = "light from skin to skin"
SPECTRAL_EFFECT = "color of light from skin to skin, wavelength by wavelength"
WAVELENGTH_STEP_EFFECT = "wavelengths between those at which light from skin to skin is summed"
FURTHER_BOUNCES_EFFECT = "bounces after the last that is summed"
POLARIZATION_EFFECT = "polarization"
SHADOW_EFFECT = "shadows"
LENS_EFFECT = "depth of field and lens blur"
BAND_EFFECT = "bands of the camera"
RELIEF_EFFECT = "relief of the skin"
PIGMENT_EFFECT = "pattern of pigment"
WRINKLE_SHADOW_EFFECT = "shadows of wrinkles"

TEXEL_STEP = 16
"""Of the texels whose reflectance is looked at."""

MAX_LAST_BOUNCE = 1e-3
"""The last bounce that is summed is at most this share of the first."""

MIN_PIGMENT_CONTRAST = 1e-5
MIN_RELIEF_TILT_DEG = 1e-3
"""Relative change of reflectance, and tilt of normals, that no sensor tells: full scale is at most
some thousand times its noise, of which a tenth counts."""

MAX_REMAINING_NOISE_RATIO = 0.05
"""Of the noise: what further bounces may add at most, about."""


def flash_needs(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    *,
    view: View,
    caster: Caster,
    noise: Noise,
    white_rgb: FloatArray,
    weights_mm2: FloatArray,
    movement: bool,
    effects: SceneEffects,
    subpixels: int,
    share: float | None = None,
) -> EffectSelection:
    """Decide what a scene before the flash rig builds.

    Parameters
    ----------
    rig
        The rig.
    subject, state
        Who stands there, in which state.
    view
        Which of its cameras looks; of several see `rigsim.needs.effects.merge_selections`.
    caster
        The mesh.
    noise
        Of the sensor.
    white_rgb
        What a white plate in the origin gives at the plan's highest power, full scales, shape (3,).
    weights_mm2
        Each light's energy over the sum that such a plate gets, mm^2, shape (L,).
    movement
        Whether the face moves with its state.
    effects
        What is asked for.
    subpixels
        Rays along each side of a pixel.
    share
        `exchange_share` of the mesh, where it is known already.
    """
    made = [polarization(rig, view), bands(view)]
    dark = [("ambient light", "the room is dark and the flash is short")]
    illuminant = rig.lights[0].illuminant
    if isinstance(subject, Target):
        made += _of_target(subject, caster)
        if subject.kind not in ("source", "cap"):
            made.append(
                lens(
                    view,
                    illuminant,
                    caster,
                    noise,
                    float(white_rgb.max()),
                    subpixels,
                    effects.optics,
                )
            )
            made += unmodeled(UNMODELED_GLARE)
        else:
            made.append(
                Effect(LENS_EFFECT, "negligible", "all of the picture is alike", 0.0, "optics")
            )
        made.append(Effect(WRINKLE_SHADOW_EFFECT, "absent", f"{subject.name} has none"))
        return EffectSelection((*made, *absent(dark)))
    brightest = brightest_rgb(subject, state, view, illuminant)
    places = [light.position_mm for light in rig.lights]
    most = most_irradiance(caster.mesh, places, weights_mm2)
    # not cut at full scale: light of pixels that are full goes on to others all the same
    level = most * white_rgb * brightest
    rough = max(float(subject.roughness[subject.atlas.covered].min()), shading.ALPHA_RANGE[0])
    shine = highlight(caster.mesh, places, weights_mm2, view.position_mm, rough)
    peak = float((level + white_rgb * shine).max())
    pixel_mm = view.distance_mm / view.focal_px
    kernels = typical_kernels(subject, state, view.spectral_sensitivity, illuminant)
    lost = edge_loss(kernels.sigmas_mm, kernels.weights, pixel_mm)
    share = exchange_share(caster) if share is None else share
    more = level * [bounced(share, float(reflectance)) for reflectance in brightest]
    more = np.minimum(more, 1.0)
    unseen = more / noise.sigma(more)  # where nothing else shines
    bounces = decide(
        INTERREFLECTION_EFFECT,
        float(unseen.max()),
        effects.interreflections,
        switch="interreflections",
        because=f"hollows get {100 * share:.0f} % of what their surroundings send out",
    )
    off = unseen * color_error(subject, state, view, illuminant) if bounces.built else np.zeros(1)
    made += [
        *textures(subject, view, illuminant),
        Effect(SHADOW_EFFECT, "built", "a face shades itself", noise.share(1.0, min(peak, 1.0))),
        decide(
            LATERAL_EFFECT,
            float(spread_over_noise(lost, level, noise).max()),
            effects.lateral,
            switch="lateral",
            because=f"pixels of {pixel_mm:.2f} mm lose {100 * lost.max():.1f} % at a shadow's edge",
        ),
        bounces,
        decide(
            SPECTRAL_EFFECT,
            float(off.max()),
            effects.spectral,
            switch="spectral",
            because="a channel's mean of squares is not the square of its mean"
            if bounces.built
            else "there is no such light",
        ),
        _finer(
            bounces,
            bool(off.max() >= NEGLIGIBLE_NOISE_RATIO)
            if effects.spectral is None
            else effects.spectral,
            spectral_step(subject, state, view, illuminant, bounces),
        ),
        further_bounces(bounces, share * float(brightest.max())),
        lens(view, illuminant, caster, noise, peak, subpixels, effects.optics),
        wrinkles(subject, noise, peak, effects.relief_shadows),
    ]
    return EffectSelection((*made, *_movement(subject, movement), *absent(dark), *_limits()))


def wrinkles(subject: SimulatedSubject, noise: Noise, level: float, asked: bool | None) -> Effect:
    """Return whether the relief of a face that has moved hides lights from itself.

    Pores of a face at rest tilt less than 4 degrees and are not built: under a light that grazes
    the skin they would take up to a tenth of its cosine away, see docs/leaving-out.md.
    """
    if subject.pose is None:
        return Effect(
            WRINKLE_SHADOW_EFFECT, "unmodeled", "pores of a face at rest tilt the surface only"
        )
    covered = subject.atlas.covered
    across, along = (mm[covered] for mm in subject.atlas.texel_mm())
    down, right = (
        np.asarray(slope)[covered] for slope in np.gradient(subject.height_um.astype(np.float64))
    )
    steepest = 1e-3 * float(np.hypot(right / across, down / along).max(initial=0.0))
    # a light as low as the relief is steep shines with that sine, and may be hidden
    most = min(1.0, steepest / math.hypot(1.0, steepest) * level)
    return decide(
        WRINKLE_SHADOW_EFFECT,
        most / float(noise.sigma(0.0)),
        asked,
        switch="relief_shadows",
        because=f"wrinkles as steep as {math.degrees(math.atan(steepest)):.0f} degrees",
    )


UNMODELED_GLARE = [("glare and far rings of the lens", "light goes as far as the nearest rings")]


def lens(
    view: View,
    illuminant: str,
    caster: Caster,
    noise: Noise,
    level: float,
    subpixels: int,
    asked: bool | None,
) -> Effect:
    """Return whether a camera's lens blurs: what a pixel loses to its neighbors where it is worst.

    Parameters
    ----------
    view, illuminant
        The camera, and the light's spectrum.
    caster
        The mesh; where it faces the camera decides how far it is out of focus.
    noise
        Of the sensor.
    level
        The brightest pixel, full scales; it may be over-full.
    subpixels
        Rays along each side of a pixel.
    asked
        What is asked for; None lets the size decide.
    """
    depths = facing_depths(view, caster.mesh)
    spread = lens_spread(view, illuminant, subpixels=subpixels, depths_mm=depths)
    spilled = spread.spilled(depths)
    far = max(abs(depth) for depth in depths)
    gained = min(1.0, level * spilled)  # by a black pixel amid bright ones, where noise is least
    return decide(
        LENS_EFFECT,
        gained / float(noise.sigma(gained)),
        asked,
        switch="optics",
        because=f"at f/{view.f_number:g}, up to {far:.0f} mm off focus, "
        f"{100 * spilled:.0f} % of a pixel's light falls on others",
    )


def polarization(rig: Rig, view: View) -> Effect:
    """Return whether light is kept as Stokes vectors: films alone tell polarized light apart."""
    films = [light.name for light in rig.lights if light.polarizer_axis_deg is not None]
    if films or view.analyser_axis_deg is not None:
        reason = (
            f"films before {len(films)} of {len(rig.lights)} lights, an analyser before {view.name}"
        )
        return Effect(POLARIZATION_EFFECT, "built", reason)
    return Effect(
        POLARIZATION_EFFECT, "absent", "the rig has no polarizing film, and sensors see none"
    )


def bands(view: View) -> Effect:
    """Return how many colors are kept."""
    if view.cfa == "MONO":
        return Effect(BAND_EFFECT, "built", "one: the sensor has no filters")
    return Effect(BAND_EFFECT, "built", "three: those of the sensor's filters")


def textures(subject: SimulatedSubject, view: View, illuminant: str) -> list[Effect]:
    """Return whether a face needs its relief and its map of pigment.

    Parameters
    ----------
    subject
        The face.
    view, illuminant
        Whose colors.
    """
    covered = subject.atlas.covered
    cosine = np.einsum("ij,ij->i", subject.normal[covered], subject.atlas.normal[covered])
    tilt = math.degrees(math.acos(min(max(float(cosine.min()), -1.0), 1.0)))
    melanin = subject.melanin[covered]
    ends = np.array([melanin.min(), np.median(melanin), melanin.max()], np.float32)
    blood = np.full_like(ends, np.median(subject.hemoglobin("neutral")[covered]))
    rgb = skin_color(view.spectral_sensitivity, illuminant).rgb(ends, blood)
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


def brightest_rgb(
    subject: SimulatedSubject, state: str, view: View, illuminant: str
) -> Float64Array:
    """Return the largest white-balanced reflectance of a face's skin in each channel, (3,)."""
    covered = subject.atlas.covered
    melanin, blood = (
        subject.melanin[covered][::TEXEL_STEP],
        subject.hemoglobin(state)[covered][::TEXEL_STEP],
    )
    rgb = skin_color(view.spectral_sensitivity, illuminant).rgb(melanin, blood)
    return np.asarray(rgb.reshape(-1, 3).max(axis=0), np.float64)


def last_bounce(over_noise: float) -> float:
    """Return the share of the first bounce at which summing ends, by what bounces change at most.

    Examples
    --------
    >>> last_bounce(0.5), last_bounce(500.0)
    (0.001, 0.0001)
    """
    return min(MAX_LAST_BOUNCE, MAX_REMAINING_NOISE_RATIO / max(over_noise, 1e-9))


def spectral_step(
    subject: SimulatedSubject, state: str, view: View, illuminant: str, bounces: Effect
) -> tuple[int, float]:
    """Return at which of the table's wavelengths light from skin to skin is summed: every n-th.

    Returns
    -------
    step, over_noise
        The largest that changes no pixel, and how much it changes one at most over its noise; 1
        and what the least larger one would change, where each does.
    """
    size = float(bounces.over_noise or 0.0)
    told = math.inf
    for step in WAVELENGTH_STEPS:
        error = step_error(subject, state, view.spectral_sensitivity, illuminant, step)
        told = size * float(error.max())
        if told < NEGLIGIBLE_NOISE_RATIO:
            return step, told
    return 1, told


def _finer(bounces: Effect, spectral: bool, found: tuple[int, float]) -> Effect:
    """Return whether all of the table's wavelengths are needed for light from skin to skin."""
    step, over_noise = found
    if not (bounces.built and spectral):
        why = "there is no such light" if not bounces.built else "channels are taken whole"
        return Effect(WAVELENGTH_STEP_EFFECT, "negligible", why, 0.0, "spectral_step")
    nm = f"each {10 * step} nm are enough" if step > 1 else "each 20 nm would not be enough"
    return decide(WAVELENGTH_STEP_EFFECT, over_noise, None, switch="spectral_step", because=nm)


def further_bounces(bounces: Effect, once: float) -> Effect:
    """Return what is left of light from skin to skin; ``once`` is the share that bounces on."""
    if not bounces.built:
        return Effect(
            FURTHER_BOUNCES_EFFECT, "negligible", "there is no such light", 0.0, "last_bounce"
        )
    over_noise = float(bounces.over_noise or 0.0)
    last = last_bounce(over_noise)
    because = f"summing ends at {last:.1g} of the first"
    left = over_noise * last / (1.0 - once)
    return decide(FURTHER_BOUNCES_EFFECT, left, None, switch="last_bounce", because=because)


def _of_target(target: Target, caster: Caster) -> list[Effect]:
    """Return what flat targets need: no effect of depth."""
    share = exchange_share(caster)
    because = "the target is flat" if share == 0.0 else "the target has hollows"
    size = 0.0 if share == 0.0 else float("inf")
    return [
        decide(SHADOW_EFFECT, size, None, switch="", because=because),
        decide(INTERREFLECTION_EFFECT, size, None, switch="interreflections", because=because),
        Effect(LATERAL_EFFECT, "absent", f"{target.name} is opaque"),
    ]


def _movement(subject: SimulatedSubject, movement: bool) -> list[Effect]:
    name = "movement of the face with the states"
    if not movement:
        return [Effect(name, "asked", "movement=False asks for it", switch="movement")]
    if subject.pose is None:
        return [Effect(name, "absent", "at rest nothing moves", switch="movement")]
    out = [Effect(name, "built", "the state moves the face", switch="movement")]
    out += unmodeled([("parted lips and open eyes", "a mesh without an opening stretches instead")])
    if subject.pose.wrinkles.left_out:
        zones = ", ".join(subject.pose.wrinkles.left_out)
        out += unmodeled([(f"fine wrinkles ({zones})", "the texture's texels are too coarse")])
    return out


def _limits() -> list[Effect]:
    return [
        *absent(
            [("open eyes, teeth and hair on the head", "the subject has none; brows are matt")]
        ),
        *unmodeled(
            [
                *UNMODELED_GLARE,
                ("highlights of skin on skin", "only light from inside goes on to other skin"),
                ("lateral kernels that vary over the face", "one profile, of its median skin"),
                ("polarized single scattering", "light from inside is taken as depolarized"),
            ]
        ),
    ]
