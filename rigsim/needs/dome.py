"""What the dome's pictures of a face or a target must hold, and what they need not."""

import math

import numpy as np

from capture.rig import Rig, Vector, View
from model import spectra
from rigsim.arrays import FloatArray
from rigsim.needs import face
from rigsim.needs.effect_sizes import most_irradiance
from rigsim.needs.effects import Effect, EffectSelection, Noise, absent, decide, unmodeled
from rigsim.render import Caster
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target


def dome_needs(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    scenery: face.Scenery,
    *,
    white_rgb: FloatArray | None,
    movement: bool,
    motion: HeadMotion | None,
) -> EffectSelection:
    """Decide what a scene in the dome builds.

    Parameters
    ----------
    rig
        The dome; of its cameras the first decides.
    subject, state
        Who stands there, in which state.
    scenery
        What the first camera looks at and with; the noise is that of the least noisy one.
    white_rgb
        What a white plate in the origin gets in the plan's longest exposure from the brightest
        light, full scales, shape (3,); None: the brightest skin is taken as full.
    movement, motion
        Whether the face moves with its state, and how the head does.
    """
    view = scenery.view
    made = [face.polarization(rig, view), face.bands(view)]
    world = [
        ("ambient light", "the room is dark"),
        ("light from the dome's frame and from other LEDs' lenses", "they are black"),
    ]
    if isinstance(subject, Target):
        size, because = face.hollows(scenery)
        made += [
            decide(
                face.INTERREFLECTION_EFFECT, size, None, switch="interreflections", because=because
            ),
            face.lens(scenery, 1.0),
        ]
        opaque = [(face.LATERAL_EFFECT, f"{subject.name} is opaque")]
        return EffectSelection(
            (*made, *absent([*opaque, *world]), *unmodeled(face.UNMODELED_GLARE))
        )
    skin = scenery.skin(subject, state)
    brightest = face.brightest_rgb(skin)
    if white_rgb is None:
        white = spectra.camera_white(view.spectral_sensitivity, scenery.illuminant)
        level = white * brightest / (white * brightest).max()
    else:
        near = max(_nearness(scenery.caster, light.position_mm) for light in rig.lights)
        level = near * white_rgb * brightest
    made += face.face_effects(
        skin, scenery, brightest, level=level, peak=1.0, finer=False, lateral_switch="subsurface"
    )
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
        *face.UNMODELED_GLARE,
        ("dependence of the boundary on its roughness", "light enters a smooth boundary"),
    ]
    built = {effect.name for effect in made if effect.built}
    if face.INTERREFLECTION_EFFECT in built:
        out.append(("highlights of skin on skin", "only light from inside goes on"))
    if face.LATERAL_EFFECT in built:
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
