"""Map the flash rig's chromophores and facial color from its image to the texture of a mesh."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.facial_color.coarse_maps import coarse_grid
from model.facial_color.document import RIG_DOCUMENT, from_maps_and_document
from model.facial_color.state_maps import NEUTRAL
from reconstruction.correspondence import landmark_table
from rigsim.geometry.atlas import Atlas, unwrap
from skinrig.appearances.dynamic import FACIAL_COLOR, describe_parts
from skinrig.appearances.texel_placement import PlacementError, TexelPlacement, place_texels
from skinrig.arrays import BoolArray, Float64Array
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import fill_holes
from skinrig.viewer.scene import Kind, SceneError, SceneSource

MELANIN_MAP = "melanin"
HEMOGLOBIN_MAP: Final = "hemoglobin"
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
    truth = describe_parts(appearance)[FACIAL_COLOR].get("truth") or {}
    where, atlas = _place(source, "dynamic", truth.get("neutral"), rig.neutral.shape)
    size = atlas.covered.shape[0]
    neutral, known = where.sample(rig.neutral, rig.valid)
    left_out = _describe_unseen(atlas, known)
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
        facts=_describe_placement(source, "dynamic", where),
        left_out=tuple(left_out.items()),
    )


def place_chromophores(source: SceneSource, simulated: FaceColor) -> FaceColor:
    """Map the chromophores of a neutral face, without a rig, to the texture of the scene's mesh.

    Parameters
    ----------
    source
        Source with the flash rig's maps, kind "flash".
    simulated
        Color of a simulated face: its rig, and what the maps lack.

    Raises
    ------
    SceneError
        If landmarks of the image are missing or unusable.
    """
    maps = source.appearances["flash"].maps
    name = source.appearances["flash"].parameters.get("truth")
    where, atlas = _place(source, "flash", name, maps[MELANIN_MAP].values.shape)
    melanin, known = where.sample(maps[MELANIN_MAP].values, maps[MELANIN_MAP].mask)
    if not known.any():
        raise SceneError(
            f"{source.paths['flash']}: no texel of the face has a valid melanin; "
            "expected landmarks of this image, and skin in it; check both"
        )
    left_out = _describe_unseen(atlas, known)
    blood, seen = where.sample(maps[HEMOGLOBIN_MAP].values, maps[HEMOGLOBIN_MAP].mask)
    if seen.any():
        hemoglobin = fill_holes(blood, seen)
        left_out["blood of expressions"] = "captured at rest; expressions scale it as simulated"
    else:
        hemoglobin = simulated.hemoglobin
        left_out["blood of this face"] = "color does not determine it; it is simulated"
    return replace(
        simulated,
        melanin=fill_holes(melanin, known),
        hemoglobin=hemoglobin,
        facts=_describe_placement(source, "flash", where),
        left_out=tuple(left_out.items()),
    )


def _place(
    source: SceneSource, kind: Kind, truth: object, shape: tuple[int, ...]
) -> tuple[TexelPlacement, Atlas]:
    """Place the texels of the scene's mesh in an image of `shape` by landmarks of both."""
    subject = source.subject
    marks = read_image_landmarks(source.paths[kind], truth, source.landmarks)
    surface = subject.surface_landmarks()
    points = {
        name: (float(p[0]), float(p[1]), float(p[2]))
        for name, p in zip(surface.names, surface.positions_on(subject.mesh), strict=True)
    }
    size = min(source.size, 1 << (2 * max(shape) - 1).bit_length())
    atlas = unwrap(subject.mesh, size)
    try:
        where = place_texels(
            atlas.position_mm, atlas.normal, atlas.covered, landmarks_mm=points, landmarks_px=marks
        )
    except PlacementError as error:
        raise SceneError(str(error)) from error
    return where, atlas


def _describe_unseen(atlas: Atlas, known: BoolArray) -> dict[str, str]:
    """Return the omission of skin that the image does not show."""
    aside = float((atlas.covered & ~known).mean() / atlas.covered.mean())
    return {
        "color outside the image": f"{100 * aside:.0f} % of the skin was not visible; "
        "its color is extrapolated"
    }


def _describe_placement(source: SceneSource, kind: Kind, where: TexelPlacement) -> dict[str, Any]:
    """Return the record of a mapping, JSON values."""
    return {
        "source": source.appearances[kind].source,
        "placed_by_landmarks": where.landmarks,
        "leave_one_out_px": where.leave_one_out_px,
    }


def read_image_landmarks(
    path: Path, truth: object, table: Path | None
) -> dict[str, tuple[float, float]]:
    """Read the landmarks of the flash rig's neutral image, px.

    Parameters
    ----------
    path
        Folder with maps of that image.
    truth
        Name of the ground truth next to that folder; no text: there is none.
    table
        Table ``name,x,y``; None: the landmarks of the ground truth.

    Raises
    ------
    SceneError
        If there is neither a table nor a simulation's ground truth next to the folder.
    """
    if table is not None:
        return landmark_table.read_landmark_table(table)
    if isinstance(truth, str):
        folder = path.resolve().parent / Path(truth).name
        if (folder / store.DOCUMENT_FILE).is_file():
            points: Any = store.read_document(folder).parameters.get("landmarks_px")
            if isinstance(points, dict):
                return {key: (float(x), float(y)) for key, (x, y) in points.items()}
    raise SceneError(
        f"{path}: got maps of an image without landmarks, expected some to map them to the mesh; "
        "show them by `skinrig report`, or give --landmarks FILE, a table name,x,y of the neutral "
        "image"
    )
