"""What the dome's pictures of a face or a target must hold, and what they need not."""

from __future__ import annotations

import math

import numpy as np

from capture.rig import Rig, Vector, View
from model import spectra
from rigsim.arrays import FloatArray
from rigsim.light.interreflection_color import color_error
from rigsim.light.subsurface_radiance import typical_kernels
from rigsim.needs.effect_sizes import (
    bounced,
    edge_loss,
    exchange_share,
    most_irradiance,
    spread_over_noise,
)
from rigsim.needs.effects import (
    Effect,
    EffectSelection,
    Noise,
    SceneEffects,
    absent,
    decide,
    unmodeled,
)
from rigsim.needs.flash import (
    INTERREFLECTION_EFFECT,
    LATERAL_EFFECT,
    SHADOW_EFFECT,
    SPECTRAL_EFFECT,
    UNMODELED_GLARE,
    bands,
    brightest_rgb,
    further_bounces,
    lens,
    polarization,
    textures,
    wrinkles,
)
from rigsim.render import Caster
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target


def dome_needs(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    *,
    caster: Caster,
    noise: Noise,
    white_rgb: FloatArray | None,
    movement: bool,
    motion: HeadMotion | None,
    effects: SceneEffects,
    subpixels: int,
) -> EffectSelection:
    """Decide what a scene in the dome builds.

    Parameters
    ----------
    rig
        The dome; of its cameras the first decides.
    subject, state
        Who stands there, in which state.
    caster
        The mesh.
    noise
        Of the sensors.
    white_rgb
        What a white plate in the origin gets in the plan's longest exposure from the brightest
        light, full scales, shape (3,); None: the brightest skin is taken as full.
    movement, motion
        Whether the face moves with its state, and how the head does.
    effects
        What is asked for.
    subpixels
        Rays along each side of a pixel.
    """
    view = rig.views[0]
    made = [polarization(rig, view), bands(view)]
    world = [
        ("ambient light", "the room is dark"),
        ("light from the dome's frame and from other LEDs' lenses", "they are black"),
    ]
    illuminant = rig.lights[0].illuminant
    focus = lens(view, illuminant, caster, noise, 1.0, subpixels, effects.optics)
    if isinstance(subject, Target):
        size = 0.0 if exchange_share(caster) == 0.0 else float("inf")
        because = "the target is flat" if size == 0.0 else "the target has hollows"
        flat = decide(
            INTERREFLECTION_EFFECT, size, None, switch="interreflections", because=because
        )
        opaque = [(LATERAL_EFFECT, f"{subject.name} is opaque")]
        return EffectSelection(
            (*made, flat, focus, *absent([*opaque, *world]), *unmodeled(UNMODELED_GLARE))
        )
    brightest = brightest_rgb(subject, state, view, illuminant)
    if white_rgb is None:
        white = spectra.camera_white(view.spectral_sensitivity, illuminant)
        level = white * brightest / (white * brightest).max()
    else:
        near = max(_nearness(caster, light.position_mm) for light in rig.lights)
        level = near * white_rgb * brightest
    pixel_mm = view.distance_mm / view.focal_px
    kernels = typical_kernels(subject, state, view.spectral_sensitivity, illuminant)
    lost = edge_loss(kernels.sigmas_mm, kernels.weights, pixel_mm)
    share = exchange_share(caster)
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
        Effect(SHADOW_EFFECT, "built", "a face shades itself", noise.share(1.0)),
        decide(
            LATERAL_EFFECT,
            float(spread_over_noise(lost, level, noise).max()),
            effects.lateral,
            switch="subsurface",
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
        further_bounces(bounces, share * float(brightest.max())),
        focus,
        wrinkles(subject, noise, 1.0, effects.relief_shadows),
    ]
    made += _movement(subject, movement, motion, view)
    made += absent(
        [*world, ("open eyes, teeth and hair on the head", "the subject has brows alone")]
    )
    return EffectSelection((*made, *_limits(made)))


def _movement(
    subject: SimulatedSubject, movement: bool, motion: HeadMotion | None, view: View
) -> list[Effect]:
    name = "movement of the face with the state"
    made = []
    if not movement:
        made.append(Effect(name, "asked", "movement=False asks for it", switch="movement"))
    elif subject.pose is None:
        made.append(Effect(name, "absent", "at rest nothing moves", switch="movement"))
    else:
        made.append(Effect(name, "built", "the state moves the face", switch="movement"))
    head = "movement of the head"
    if motion is None:
        return [*made, Effect(head, "absent", "motion=None: the head is held", switch="motion")]
    pixel_mm = view.distance_mm / view.focal_px
    blur = (
        "blur by movement within an exposure",
        f"0.06 s move 0.05 mm, a pixel {pixel_mm:.2f} mm",
    )
    made.append(Effect(head, "built", "the head drifts and twitches", switch="motion"))
    return [
        *made,
        *unmodeled([("the twitch in light from inside", "it stays that of the still mouth"), blur]),
    ]


def _nearness(caster: Caster, place_mm: Vector) -> float:
    """Return how much brighter a light shines on a mesh than in the origin at most, >= 1."""
    squared = math.hypot(*place_mm) ** 2
    return max(most_irradiance(caster.mesh, [place_mm], [squared]), 1.0)


def _limits(made: list[Effect]) -> list[Effect]:
    out = [
        *UNMODELED_GLARE,
        ("dependence of the boundary on its roughness", "light enters a smooth boundary"),
    ]
    built = {effect.name for effect in made if effect.built}
    if INTERREFLECTION_EFFECT in built:
        out.append(("highlights of skin on skin", "only light from inside goes on"))
    if LATERAL_EFFECT in built:
        out.append(("lateral kernels that vary over the face", "one, of its median skin"))
    return unmodeled(out)


def least_noise(sensors: list[Noise]) -> Noise:
    """Return the least noise of some sensors.

    Examples
    --------
    >>> least_noise([Noise(1e-4, 2e-7), Noise(2e-4, 1e-7)])
    Noise(scale=0.0001, offset=1e-07)
    """
    return Noise(
        float(np.min([noise.scale for noise in sensors])),
        float(np.min([noise.offset for noise in sensors])),
    )
