"""Map the flash rig's facial color from its image to the texture of a mesh."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.facial_color.coarse_maps import coarse_grid
from model.facial_color.document import RIG_DOCUMENT, from_maps_and_document
from model.facial_color.state_maps import NEUTRAL
from reconstruction.correspondence import landmark_table
from rigsim.geometry.atlas import unwrap
from skinrig.appearances.dynamic import FACIAL_COLOR, describe_parts
from skinrig.appearances.texel_placement import PlacementError, place_texels
from skinrig.arrays import BoolArray, Float64Array
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import fill_holes
from skinrig.viewer.scene import SceneError, SceneSource

MELANIN_MAP = "melanin"
RIG_PX: Final = 256
"""Side of the scale and bias maps, cells (Jimenez 2010, section 6)."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceColor:
    """Chromophores and hemoglobin rig of a face on its texture.

    Attributes
    ----------
    melanin, hemoglobin : ndarray of float64, shape (N, N)
        Volume fractions of the neutral expression, without gaps.
    states : mapping of str to ndarray of float64, shape (h, w, 2)
        Scale and bias by expression, "neutral" first.
    global_states
        Conditions of the whole body.
    facts
        Record of the mapping, JSON values.
    left_out
        Omissions with reasons.
    """

    melanin: Float64Array
    hemoglobin: Float64Array
    states: Mapping[str, Float64Array]
    global_states: tuple[str, ...]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...] = ()


def place_facial_color(source: SceneSource) -> FaceColor:
    """Map the measured chromophores and rig to the texture of the scene's mesh.

    Parameters
    ----------
    source
        Source with a dynamic appearance that has facial color.

    Raises
    ------
    SceneError
        If landmarks of the image are missing or unusable.
    """
    appearance, subject = source.appearances["dynamic"], source.subject
    rig = from_maps_and_document(appearance.maps, appearance.files[RIG_DOCUMENT])
    marks = read_image_landmarks(source, describe_parts(appearance)[FACIAL_COLOR])
    surface = subject.surface_landmarks()
    points = {
        name: (float(p[0]), float(p[1]), float(p[2]))
        for name, p in zip(surface.names, surface.positions_on(subject.mesh), strict=True)
    }
    size = min(source.size, 1 << (2 * max(rig.neutral.shape) - 1).bit_length())
    atlas = unwrap(subject.mesh, size)
    try:
        where = place_texels(
            atlas.position_mm, atlas.normal, atlas.covered, landmarks_mm=points, landmarks_px=marks
        )
    except PlacementError as error:
        raise SceneError(str(error)) from error
    neutral, known = where.sample(rig.neutral, rig.valid)
    aside = float((atlas.covered & ~known).mean() / atlas.covered.mean())
    left_out = {
        "color outside the image": f"{100 * aside:.0f} % of the skin was not visible; "
        "its color is extrapolated"
    }
    if MELANIN_MAP in appearance.maps:
        found = appearance.maps[MELANIN_MAP]
        valid = rig.valid if found.valid is None else found.valid
        melanin, melanin_known = where.sample(found.values, valid)
        melanin = fill_holes(melanin, melanin_known)
    else:
        left_out["melanin of this face"] = "the folder has no melanin map; it is simulated"
        melanin = FineSkin(subject, size).melanin()
    cells = coarse_grid((size, size), RIG_PX)

    def stored(kept: Float64Array, held: BoolArray) -> Float64Array:
        (fine,) = rig.cells.refine(kept, valid=held)
        texels, seen = where.sample(np.nan_to_num(fine), np.isfinite(fine) & rig.valid)
        return fill_holes(*cells.coarsen(texels, seen))

    states: dict[str, Float64Array] = {}
    for name in (NEUTRAL, *rig.states):
        held = rig.neutral_mean_valid if name == NEUTRAL else rig.states[name].valid
        pair = [stored(maps[name], held) for maps in (rig.scale, rig.bias)]
        states[name] = np.stack(pair, axis=-1)
    return FaceColor(
        melanin=melanin,
        hemoglobin=fill_holes(neutral, known),
        states=states,
        global_states=rig.global_states,
        facts={
            "source": appearance.source,
            "placed_by_landmarks": where.landmarks,
            "leave_one_out_px": where.leave_one_out_px,
        },
        left_out=tuple(left_out.items()),
    )


def read_image_landmarks(
    source: SceneSource, part: dict[str, Any]
) -> dict[str, tuple[float, float]]:
    """Read the landmarks of the flash rig's neutral image, px.

    Raises
    ------
    SceneError
        If there is neither a table nor a simulation's ground truth next to the folder.
    """
    if source.landmarks is not None:
        return landmark_table.read_landmark_table(source.landmarks)
    name = (part.get("truth") or {}).get("neutral")
    if isinstance(name, str):
        folder = source.paths["dynamic"].resolve().parent / Path(name).name
        if (folder / store.DOCUMENT_FILE).is_file():
            points: Any = store.read_document(folder).parameters.get("landmarks_px")
            if isinstance(points, dict):
                return {key: (float(x), float(y)) for key, (x, y) in points.items()}
    raise SceneError(
        f"{source.paths['dynamic']}: got maps of an image without landmarks, expected some to map "
        "them to the mesh; give --landmarks FILE, a table name,x,y of the neutral image"
    )
