"""Stage of imported photographs: keep the light of the face's skin."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from model.skin import SkinMap
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.inputs import Inputs
from reconstruction.skin_region import find_face_skin


def skin_stage(stage: Callable[..., stages.PipelineStage], inputs: Inputs) -> stages.PipelineStage:
    """Return the stage that makes ``diffuse`` of ``light``.

    Parameters
    ----------
    stage
        Factory of stages, see `graph.make_stage_factory`.
    inputs
        Session and state. Where its import found no face, all pixels are kept.
    """
    listed = inputs.session.manifest.extra.get("photographs", ())
    faces = {one["step"]: one.get("face", ()) for one in listed}
    shots = inputs.session.frames("subject", state=inputs.state)
    face = tuple(map(float, faces.get(shots[0].step_id, ()))) if shots else ()
    return stage("skin region", "light", "diffuse", partial(_keep_skin, face), face=list(face))


def _keep_skin(face: tuple[float, ...], light: SkinMap) -> SkinMap:
    if not face:
        return light
    return replace(light, valid=find_face_skin(light.values, light.mask, face))
