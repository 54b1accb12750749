"""The flash rig's facial color, drawn on a picture, brought to the texture of a mesh."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.facial_color.coarse_maps import fitting
from model.facial_color.document import RIG_DOCUMENT, from_maps_and_document
from model.facial_color.state_maps import NEUTRAL
from reconstruction.correspondence import landmark_table
from rigsim.geometry.atlas import unwrap
from rigsim.subject import SimulatedSubject
from skinrig.appearances.dynamic import FACIAL_COLOR, parts_of
from skinrig.arrays import Float64Array
from skinrig.viewer.assets import placing
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import filled
from skinrig.viewer.scene import SceneError, SceneSource

MELANIN_MAP = "melanin"
RIG_PX: Final = 256
"""Cells a side of the scale and bias maps (Jimenez 2010, section 6)."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceColor:
    """Chromophores of a face on its texture, and its hemoglobin rig.

    Attributes
    ----------
    melanin, hemoglobin : ndarray of float64, shape (N, N)
        Volume fractions in the neutral state, known everywhere.
    states : mapping of str to ndarray of float64, shape (h, w, 2)
        Scale and bias by state, "neutral" first.
    global_states
        Those of the whole body.
    facts
        How they came to lie on the texture; JSON values.
    left_out
        What could not be placed.
    """

    melanin: Float64Array
    hemoglobin: Float64Array
    states: Mapping[str, Float64Array]
    global_states: tuple[str, ...]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...] = ()


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
    aside = float((atlas.covered & ~known).mean() / atlas.covered.mean())
    left_out = {
        "color aside of the picture": f"{100 * aside:.0f} % of the skin did not face the camera; "
        "it continues what is beside it"
    }
    if MELANIN_MAP in appearance.maps:
        found = appearance.maps[MELANIN_MAP]
        valid = rig.valid if found.valid is None else found.valid
        melanin, melanin_known = where.sampled(found.values, valid)
        melanin = filled(melanin, melanin_known)
    else:
        left_out["melanin of this face"] = "no map of it is in the folder; simulated"
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
        left_out=tuple(left_out.items()),
    )


def picture_landmarks(source: SceneSource, part: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Return named points of the neutral picture that the flash rig's maps are drawn on, px.

    Raises
    ------
    SceneError
        There is no table, and no simulation's truth beside the folder.
    """
    if source.landmarks is not None:
        return landmark_table.read(source.landmarks)
    name = (part.get("truth") or {}).get("neutral")
    if isinstance(name, str):
        folder = source.paths["dynamic"].resolve().parent / Path(name).name
        if (folder / store.DOCUMENT_FILE).is_file():
            points: Any = store.read_document(folder).parameters.get("landmarks_px")
            if isinstance(points, dict):
                return {key: (float(x), float(y)) for key, (x, y) in points.items()}
    raise SceneError(
        f"{source.paths['dynamic']}: its maps are drawn on a picture, and nothing says where that "
        "lies on the mesh; give --landmarks FILE, a table name,x,y of the neutral picture"
    )
