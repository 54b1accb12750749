"""Select the effects of light that the dome's images of a face or a target require."""

import math

import numpy as np

from capture.rig import Rig, Vector, View
from model import spectra
from rigsim.arrays import FloatArray
from rigsim.light.led_light import white_intensity
from rigsim.needs import face
from rigsim.needs.effect_sizes import max_irradiance
from rigsim.needs.effects import (
    Effect,
    EffectSelection,
    NeedsError,
    PixelNoise,
    decide_effect,
    omitted_effects,
)
from rigsim.needs.sampled_light import LitFace, SampledLamp, SampledLight, sample_light
from rigsim.render import Caster
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target


def select_dome_effects(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    scenery: face.ViewingConditions,
    white_rgb: FloatArray | None,
    light: SampledLight | None,
    movement: bool,
    motion: HeadMotion | None,
) -> EffectSelection:
    """Select the effects that a scene in the dome builds.

    Parameters
    ----------
    rig
        The dome; its first camera decides.
    subject, state
        The subject or target, and its state.
    scenery
        Viewing conditions of the first camera; the noise is that of the least noisy camera.
    white_rgb
        Signal of a white plate at the origin in the plan's longest exposure from the brightest
        light, full scales, shape (3,); None: the brightest skin is at full scale.
    light
        Direct light of each lamp on a face, relative to that of the brightest on a plate at the
        origin; None for a target.
    movement, motion
        Whether the face moves with its state, and the movement of the head.
    """
    view = scenery.view
    made = [face.polarization_effect(rig, view), face.band_effect(view)]
    if isinstance(subject, Target):
        size, because = face.target_interreflection_size(scenery)
        made += [
            decide_effect(
                face.INTERREFLECTION_EFFECT, size, None, switch="interreflections", reason=because
            ),
            face.lens_effect(scenery, 1.0),
        ]
        made.append(Effect(face.LATERAL_EFFECT, "absent", f"{subject.name} is opaque"))
        return EffectSelection((*made, *omitted_effects("dome", "glare")))
    if light is None:
        raise NeedsError("light: got none, expected that on a face; sample it")
    skin = scenery.observe_skin(subject, state)
    if white_rgb is None:
        white = spectra.camera_white(view.spectral_sensitivity, scenery.illuminant)
        lit = LitFace.expose(skin, light, white, to_full_scale=True)
        level = white * lit.brightest / (white * lit.brightest).max()
    else:
        lit = LitFace.expose(skin, light, np.asarray(white_rgb, np.float64))
        near = max(_max_brightness_gain(scenery.caster, one.position_mm) for one in rig.lights)
        level = near * white_rgb * lit.brightest
    made += face.select_face_effects(
        lit, scenery, level=level, finer=False, lateral_switch="subsurface"
    )
    made += _movement(subject, movement, motion, view)
    made += omitted_effects("dome", "dome_face")
    built = {effect.name for effect in made if effect.is_built}
    if face.INTERREFLECTION_EFFECT in built:
        made += omitted_effects("dome_bounces")
    if face.LATERAL_EFFECT in built:
        made += omitted_effects("dome_lateral")
    return EffectSelection(tuple(made))


def sample_led_light(
    rig: Rig, subject: SimulatedSubject | Target, caster: Caster
) -> SampledLight | None:
    """Return the light of each LED on a face, over that of the brightest on a plate at the origin.

    None for a target.
    """
    if not isinstance(subject, SimulatedSubject):
        return None
    view = rig.views[0]
    strength = np.array([float(white_intensity(light, view).max()) for light in rig.lights])
    squared = np.array([float(np.square(light.position_mm).sum()) for light in rig.lights])
    weights = strength / (strength / squared).max()
    lamps = [
        [SampledLamp(light.position_mm, light.radius_mm, float(weight))]
        for light, weight in zip(rig.lights, weights, strict=True)
    ]
    cameras = np.array([view.position_mm for view in rig.views])
    return sample_light(subject, caster, lamps, cameras)


def _movement(
    subject: SimulatedSubject, movement: bool, motion: HeadMotion | None, view: View
) -> list[Effect]:
    made = face.movement_effect(subject, movement, "movement of the face with the state")
    head = "movement of the head"
    if motion is None:
        return [made, Effect(head, "absent", "motion=None: the head is fixed", switch="motion")]
    moved = Effect(head, "built", "the head drifts and twitches", switch="motion")
    small = f"0.06 s move 0.05 mm, a pixel {view.distance_mm / view.focal_px:.2f} mm"
    blur = Effect("blur by movement within an exposure", "unmodeled", small)
    return [made, moved, *omitted_effects("dome_motion"), blur]


def _max_brightness_gain(caster: Caster, position_mm: Vector) -> float:
    """Return the largest gain of a light's irradiance on a mesh over that at the origin, >= 1."""
    squared = math.hypot(*position_mm) ** 2
    return max(max_irradiance(caster.mesh, [position_mm], [squared]), 1.0)


def min_noise(sensors: list[PixelNoise]) -> PixelNoise:
    """Return the least noise of several sensors.

    Examples
    --------
    >>> min_noise([PixelNoise(1e-4, 2e-7), PixelNoise(2e-4, 1e-7)])
    PixelNoise(scale=0.0001, offset=1e-07)
    """
    return PixelNoise(
        float(np.min([noise.scale for noise in sensors])),
        float(np.min([noise.offset for noise in sensors])),
    )
