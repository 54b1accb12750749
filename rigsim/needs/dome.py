"""What the dome's pictures of a face or a target must hold, and what they need not."""

import math

import numpy as np

from capture.rig import Rig, Vector, View
from model import spectra
from rigsim.arrays import FloatArray
from rigsim.needs import face
from rigsim.needs.effect_sizes import most_irradiance
from rigsim.needs.effects import Effect, EffectSelection, Noise, decide, left_out_of
from rigsim.render import Caster
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target


def dome_needs(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    scenery: face.Scenery,
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
    if isinstance(subject, Target):
        size, because = face.hollows(scenery)
        made += [
            decide(
                face.INTERREFLECTION_EFFECT, size, None, switch="interreflections", because=because
            ),
            face.lens(scenery, 1.0),
        ]
        made.append(Effect(face.LATERAL_EFFECT, "absent", f"{subject.name} is opaque"))
        return EffectSelection((*made, *left_out_of("dome", "glare")))
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
    made += left_out_of("dome", "dome_face")
    built = {effect.name for effect in made if effect.built}
    if face.INTERREFLECTION_EFFECT in built:
        made += left_out_of("dome_bounces")
    if face.LATERAL_EFFECT in built:
        made += left_out_of("dome_lateral")
    return EffectSelection(tuple(made))


def _movement(
    subject: SimulatedSubject, movement: bool, motion: HeadMotion | None, view: View
) -> list[Effect]:
    made = face.movement(subject, movement, "movement of the face with the state")
    head = "movement of the head"
    if motion is None:
        return [made, Effect(head, "absent", "motion=None: the head is held", switch="motion")]
    moved = Effect(head, "built", "the head drifts and twitches", switch="motion")
    small = f"0.06 s move 0.05 mm, a pixel {view.distance_mm / view.focal_px:.2f} mm"
    blur = Effect("blur by movement within an exposure", "unmodeled", small)
    return [made, moved, *left_out_of("dome_motion"), blur]


def _nearness(caster: Caster, place_mm: Vector) -> float:
    """Return how much brighter a light shines on a mesh than in the origin at most, >= 1."""
    squared = math.hypot(*place_mm) ** 2
    return max(most_irradiance(caster.mesh, [place_mm], [squared]), 1.0)


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
