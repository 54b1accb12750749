"""Select the effects of light that the flash rig's images of a face or a target require."""

from capture.rig import Rig
from rigsim import shading
from rigsim.arrays import FloatArray
from rigsim.needs import face
from rigsim.needs.effect_sizes import max_highlight, max_irradiance
from rigsim.needs.effects import Effect, EffectSelection, decide_effect, omitted_effects
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target


def select_flash_effects(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    scenery: face.ViewingConditions,
    white_rgb: FloatArray,
    weights_mm2: FloatArray,
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
    weights_mm2
        Each light's energy over the total of such a plate, mm^2, shape (L,).
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
    skin = scenery.observe_skin(subject, state)
    brightest = face.max_reflectance_rgb(skin)
    places = [light.position_mm for light in rig.lights]
    # not clipped at full scale: the light of saturated pixels reaches others unclipped
    level = max_irradiance(mesh, places, weights_mm2) * white_rgb * brightest
    rough = max(float(subject.roughness[subject.atlas.covered].min()), shading.ALPHA_RANGE[0])
    shine = max_highlight(mesh, places, weights_mm2, view.position_mm, rough)
    peak = float((level + white_rgb * shine).max())
    made += face.select_face_effects(skin, scenery, brightest, level=level, peak=peak, finer=True)
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
