"""The flash rig's facial color, drawn on a picture, brought to the texture of a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from model.facial_color.coarse_maps import fitting
from model.facial_color.document import RIG_DOCUMENT, from_maps_and_document
from model.facial_color.state_maps import NEUTRAL
from rigsim.geometry.atlas import unwrap
from skinrig.appearances.dynamic import FACIAL_COLOR, parts_of
from skinrig.arrays import Float64Array
from skinrig.viewer.assets import placing
from skinrig.viewer.assets.face_color import RIG_PX, FaceColor
from skinrig.viewer.assets.image_landmarks import picture_landmarks
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import filled

if TYPE_CHECKING:
    from rigsim.subject import SimulatedSubject
    from skinrig.viewer.scene import SceneSource

MELANIN_MAP = "melanin"


def placed(source: SceneSource, subject: SimulatedSubject) -> FaceColor:
    """Return the measured chromophores and rig on the texture of the scene's mesh.

    Parameters
    ----------
    source
        With a dynamic appearance that holds facial color.
    subject
        Who wears the mesh; gives landmarks, and melanin where none was measured.

    Raises
    ------
    skinrig.viewer.scene.SceneError
        Nothing says where the picture lies on the mesh.
    skinrig.viewer.assets.placing.PlacingError
        The landmarks do not.
    """
    appearance = source.appearances["dynamic"]
    rig = from_maps_and_document(appearance.maps, appearance.files[RIG_DOCUMENT])
    marks = picture_landmarks(source, parts_of(appearance)[FACIAL_COLOR])
    surface = subject.surface_landmarks()
    points = {
        name: (float(p[0]), float(p[1]), float(p[2]))
        for name, p in zip(surface.names, surface.on(subject.mesh), strict=True)
    }
    size = min(source.size, 1 << (2 * max(rig.neutral.shape) - 1).bit_length())
    atlas = unwrap(subject.mesh, size)
    where = placing.place(
        atlas.position_mm, atlas.normal, atlas.covered, landmarks_mm=points, landmarks_px=marks
    )
    neutral, known = where.sampled(rig.neutral, rig.valid)
    left_out = [
        (
            "color aside of the picture",
            f"{100 * float((atlas.covered & ~known).mean() / atlas.covered.mean()):.0f} % of the "
            "skin did not face the camera; it continues what is beside it",
        )
    ]
    if MELANIN_MAP in appearance.maps:
        found = appearance.maps[MELANIN_MAP]
        valid = rig.valid if found.valid is None else found.valid
        melanin, melanin_known = where.sampled(found.values, valid)
        melanin = filled(melanin, melanin_known)
    else:
        left_out.append(("melanin of this face", "no map of it is in the folder; simulated"))
        melanin = FineSkin(subject, size).melanin()
    cells = fitting((size, size), RIG_PX)
    states: dict[str, Float64Array] = {}
    for name in (NEUTRAL, *rig.states):
        held = rig.neutral_mean_valid if name == NEUTRAL else rig.states[name].valid
        pair = []
        for kept in (rig.scale[name], rig.bias[name]):
            (fine,) = rig.cells.refine(kept, valid=held)
            texels, seen = where.sampled(np.nan_to_num(fine), np.isfinite(fine) & rig.valid)
            coarse, inside = cells.coarsen(texels, seen)
            pair.append(filled(coarse, inside))
        states[name] = np.stack(pair, axis=-1)
    return FaceColor(
        melanin=melanin,
        hemoglobin=filled(neutral, known),
        states=states,
        global_states=rig.global_states,
        facts={
            "source": appearance.source,
            "placed_by_landmarks": where.landmarks,
            "leave_one_out_px": where.leave_one_out_px,
        },
        left_out=tuple(left_out),
    )
