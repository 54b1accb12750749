"""What the flash rig's pictures of a face or a target must hold, and what they need not."""

from capture.rig import Rig
from rigsim import shading
from rigsim.arrays import FloatArray
from rigsim.needs import face
from rigsim.needs.effect_sizes import highlight, most_irradiance
from rigsim.needs.effects import Effect, EffectSelection, absent, decide, unmodeled
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target


def flash_needs(
    rig: Rig,
    subject: SimulatedSubject | Target,
    state: str,
    scenery: face.Scenery,
    *,
    white_rgb: FloatArray,
    weights_mm2: FloatArray,
    movement: bool,
) -> EffectSelection:
    """Decide what a scene before the flash rig builds.

    Parameters
    ----------
    rig
        The rig.
    subject, state
        Who stands there, in which state.
    scenery
        What a camera looks at and with; of several see `rigsim.needs.effects.merge_selections`.
    white_rgb
        What a white plate in the origin gives at the plan's highest power, full scales, shape (3,).
    weights_mm2
        Each light's energy over the sum that such a plate gets, mm^2, shape (L,).
    movement
        Whether the face moves with its state.
    """
    view, mesh = scenery.view, scenery.caster.mesh
    made = [face.polarization(rig, view), face.bands(view)]
    dark = [("ambient light", "the room is dark and the flash is short")]
    if isinstance(subject, Target):
        made += _of_target(subject, scenery)
        if subject.kind not in ("source", "cap"):
            made += [face.lens(scenery, float(white_rgb.max())), *unmodeled(face.UNMODELED_GLARE)]
        else:
            made.append(
                Effect(face.LENS_EFFECT, "negligible", "all of the picture is alike", 0.0, "optics")
            )
        made.append(Effect(face.WRINKLE_SHADOW_EFFECT, "absent", f"{subject.name} has none"))
        return EffectSelection((*made, *absent(dark)))
    skin = scenery.skin(subject, state)
    brightest = face.brightest_rgb(skin)
    places = [light.position_mm for light in rig.lights]
    # not cut at full scale: light of pixels that are full goes on to others all the same
    level = most_irradiance(mesh, places, weights_mm2) * white_rgb * brightest
    rough = max(float(subject.roughness[subject.atlas.covered].min()), shading.ALPHA_RANGE[0])
    shine = highlight(mesh, places, weights_mm2, view.position_mm, rough)
    peak = float((level + white_rgb * shine).max())
    made += face.face_effects(skin, scenery, brightest, level=level, peak=peak, finer=True)
    return EffectSelection((*made, *_movement(subject, movement), *absent(dark), *_limits()))


def _of_target(target: Target, scenery: face.Scenery) -> list[Effect]:
    """Return what flat targets need: no effect of depth."""
    size, because = face.hollows(scenery)
    return [
        decide(face.SHADOW_EFFECT, size, None, switch="", because=because),
        decide(face.INTERREFLECTION_EFFECT, size, None, switch="interreflections", because=because),
        Effect(face.LATERAL_EFFECT, "absent", f"{target.name} is opaque"),
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
                *face.UNMODELED_GLARE,
                ("highlights of skin on skin", "only light from inside goes on to other skin"),
                ("lateral kernels that vary over the face", "one profile, of its median skin"),
                ("polarized single scattering", "light from inside is taken as depolarized"),
            ]
        ),
    ]
