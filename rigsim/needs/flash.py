"""Select the effects of light that the flash rig's images of a face or a target require."""

import numpy as np

from capture.rig import Rig
from rigsim.arrays import FloatArray
from rigsim.needs import face
from rigsim.needs.effect_sizes import max_irradiance
from rigsim.needs.effects import Effect, EffectSelection, NeedsError, decide_effect, omitted_effects
from rigsim.needs.sampled_light import LitFace, SampledLight
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target


def select_flash_effects(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    scenery: face.ViewingConditions,
    white_rgb: FloatArray,
    light: SampledLight | None,
    movement: bool,
) -> EffectSelection:
    """Select the effects that a scene in the flash rig builds.

    Parameters
    ----------
    rig
        The rig.
    subject, state
        The subject or target, and its state.
    scenery
        Viewing conditions of a camera; for several see `rigsim.needs.effects.merge_selections`.
    white_rgb
        Signal of a white plate at the origin at the plan's highest power, full scales, shape (3,).
    light
        Direct light on a face, relative to that on such a plate, in one image; None for a target.
    movement
        Whether the face moves with its state.
    """
    view, mesh = scenery.view, scenery.caster.mesh
    made = [face.polarization_effect(rig, view), face.band_effect(view)]
    if isinstance(subject, Target):
        made += _target_effects(subject, scenery)
        if subject.kind not in ("source", "cap"):
            made += [face.lens_effect(scenery, float(white_rgb.max())), *omitted_effects("glare")]
        else:
            made.append(
                Effect(face.LENS_EFFECT, "negligible", "the image is uniform", 0.0, "optics")
            )
        made.append(Effect(face.RELIEF_SHADOW_EFFECT, "absent", f"{subject.name} has none"))
        return EffectSelection((*made, *omitted_effects("flash")))
    if light is None:
        raise NeedsError("light: got none, expected that on a face; sample it")
    skin = scenery.observe_skin(subject, state)
    white = np.asarray(white_rgb, np.float64)
    lit = LitFace.expose(skin, light, white)
    places = np.array([lamp.position_mm for lamp in light.images[0]])
    weights = [lamp.weight_mm2 for lamp in light.images[0]]
    # not clipped at full scale: the light of saturated pixels reaches others unclipped
    level = max_irradiance(mesh, places, weights) * white * lit.brightest
    made += face.select_face_effects(lit, scenery, level=level, finer=True)
    made += _movement(subject, movement)
    return EffectSelection((*made, *omitted_effects("flash", "flash_face")))


def _target_effects(target: Target, scenery: face.ViewingConditions) -> list[Effect]:
    """Return the effects of flat targets, which have none of depth."""
    size, because = face.target_interreflection_size(scenery)
    return [
        decide_effect(face.SHADOW_EFFECT, size, None, switch="", reason=because),
        decide_effect(
            face.INTERREFLECTION_EFFECT, size, None, switch="interreflections", reason=because
        ),
        Effect(face.LATERAL_EFFECT, "absent", f"{target.name} is opaque"),
    ]


def _movement(subject: SimulatedSubject, movement: bool) -> list[Effect]:
    made = face.movement_effect(subject, movement, "movement of the face with the states")
    if subject.pose is None or not made.is_built:
        return [made]
    zones = ", ".join(subject.pose.wrinkles.omitted)
    coarse = Effect(f"fine wrinkles ({zones})", "unmodeled", "the texture's texels are too coarse")
    return [made, *omitted_effects("moving_face"), *([coarse] if zones else [])]
