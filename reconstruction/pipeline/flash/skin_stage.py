"""Stage of imported photographs: keep the light of the face's skin."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from model.skin import SkinMap
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.inputs import Inputs, InputsError
from reconstruction.skin_region import find_face_skin

MIN_SKIN_FRACTION: Final = 0.02
"""Least fraction of a crop around a face that is skin."""


def find_imported_face(inputs: Inputs) -> tuple[float, ...]:
    """Return the face's square over the image's sides; empty if the import looked for none."""
    listed = inputs.session.manifest.extra.get("photographs", ())
    faces = {one["step"]: one.get("face", ()) for one in listed}
    shots = inputs.session.frames("subject", state=inputs.state)
    return tuple(map(float, faces.get(shots[0].step_id, ()))) if shots else ()


def skin_stage(
    stage: Callable[..., stages.PipelineStage], inputs: Inputs, face: tuple[float, ...]
) -> stages.PipelineStage:
    """Return the stage that makes ``diffuse`` of ``light``.

    Parameters
    ----------
    stage
        Factory of stages, see `graph.make_stage_factory`.
    inputs
        Session and state.
    face
        See `find_imported_face`.
    """
    keep = partial(_keep_skin, f"{inputs.session.path}: {inputs.state}", face)
    return stage("skin region", "light", "diffuse", keep, face=list(face))


def _keep_skin(what: str, face: tuple[float, ...], light: SkinMap) -> SkinMap:
    skin = find_face_skin(light.values, light.mask, face)
    if np.mean(skin) < MIN_SKIN_FRACTION:
        raise InputsError(
            f"{what}: got {int(skin.sum())} pixels of skin around the face, expected at least "
            f"{MIN_SKIN_FRACTION:.0%}; cheeks and nose may be clipped: import the photograph with "
            "--crop X,Y,WIDTH,HEIGHT, which keeps all pixels, or another one"
        )
    return replace(light, valid=skin)
