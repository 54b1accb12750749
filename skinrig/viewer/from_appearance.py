"""Faces that were captured: moving faces of the flash rig, the dome's maps with their mesh.

What a folder does not hold is simulated on its mesh, and the scene says so.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from model import skin_reflectance, store
from model.skin import SkinAppearance
from rigsim.geometry.mesh import load_mesh
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.viewer import procedural
from skinrig.viewer.assembling import assemble
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.holes import patch_charts
from skinrig.viewer.holes.patch_charts import ClosedMesh
from skinrig.viewer.scene import Kind, SceneError, SceneSource, ViewerScene

MESH_FILE: Final = "mesh.obj"
ALBEDO_MAP: Final = "r_d"


def scene(
    paths: Sequence[Path],
    *,
    mesh: Path | None = None,
    landmarks: Path | None = None,
    calibration: Path | None = None,
    size: int = 2048,
) -> ViewerScene:
    """Return the scene of fitted folders.

    Parameters
    ----------
    paths
        Folders of `skinrig reconstruct` (dome) or `skinrig fit`, one of a kind.
    mesh
        The face they belong to; None: the mesh that a folder holds, else the procedural head.
    landmarks
        Table ``name,x,y`` of the neutral picture that the flash rig's maps are drawn on; None: a
        simulation's own, from its TRUTH/ folder beside.
    calibration
        Folder with the color calibration of the dome's cameras; None: the one that the maps were
        made with, where it lies beside and has color, else what is known of the sensor.
    size
        Texels a side of the large textures.

    Raises
    ------
    SceneError
        A folder of a kind that cannot be shown, two of one kind, or no landmarks.
    model.store.StoreError
        A folder that cannot be read.
    """
    procedural.check_size(size)
    appearances: dict[str, SkinAppearance] = {}
    folders: dict[str, Path] = {}
    for path in paths:
        appearance = store.read(path)
        kind = kind_of(path, appearance)
        if kind in folders:
            raise SceneError(f"{path}: {folders[kind]} is of the same kind ({kind}); show one")
        appearances[kind], folders[kind] = appearance, path
    whole, told = _mesh(appearances, mesh)
    surface = None if whole is None else whole.mesh
    first = next(iter(appearances.values()))
    seed = first.seed if isinstance(first.seed, int) and first.seed >= 0 else 0
    subject = procedural.simulated(surface, preset=procedural.DEFAULT_PRESET, size=size, seed=seed)
    kinds: tuple[Kind, ...] = ("model", "dome", "dynamic")
    kind = next(name for name in kinds if name in appearances)
    source = SceneSource(
        kind,
        procedural.viewer_mesh(subject),
        size,
        seed=seed,
        subject=subject,
        skin=FineSkin(subject, size),
        appearances=appearances,
        paths=folders,
        landmarks=landmarks,
        calibration=calibration,
    )
    movement = (
        "its movement was not captured: the blend shapes are those of the file, or simulated "
        "action units"
    )
    closed = () if whole is None else whole.summary()
    left_out = [*closed, ("expressions of this face", movement)]
    if surface is None:
        left_out.insert(0, ("geometry of this face", f"{told}; --mesh FILE shows another"))
    provenance: dict[str, Any] = {
        "source": " and ".join(sorted({one.source for one in appearances.values()})),
        "kind": source.kind,
        "appearances": [path.name for path in paths],
        "mesh": told,
    }
    if whole is not None and whole.charts:
        provenance["closed_holes"] = len(whole.charts)
    found = assemble(source, provenance=provenance).with_assets({"left_out": tuple(left_out)})
    return found if whole is None else whole.painted(found)


def kind_of(path: Path, appearance: SkinAppearance) -> str:
    """Return "dynamic", "dome" or "model".

    Raises
    ------
    SceneError
        Nothing of it can be drawn on a face.
    """
    if dynamic_appearance.parts_of(appearance):
        return "dynamic"
    if skin_reflectance.BASIS_FILE in appearance.files and "reflectance_model" in (
        appearance.parameters
    ):
        return "model"
    if MESH_FILE in appearance.files and ALBEDO_MAP in appearance.maps:
        return "dome"
    raise SceneError(
        f"{path}: holds {', '.join(sorted(appearance.maps)) or 'no maps'}, expected a moving face "
        "(`skinrig fit facial-color`, `wrinkles` or `microstructure`), or a dome's maps with "
        f"{ALBEDO_MAP} and {MESH_FILE}"
    )


def _mesh(
    appearances: dict[str, SkinAppearance], asked: Path | None
) -> tuple[ClosedMesh | None, str]:
    """Return the mesh to show, None for the procedural head, and words for it.

    Holes of a scan are closed; another mesh may have them for a reason.
    """
    if asked is not None:
        return ClosedMesh(procedural.load_mesh(asked), (), ()), asked.name
    for kind in ("model", "dome"):
        appearance = appearances.get(kind)
        if appearance is not None and MESH_FILE in appearance.files:
            with tempfile.TemporaryDirectory() as folder:
                copy = Path(folder) / MESH_FILE
                copy.write_bytes(appearance.files[MESH_FILE])
                return patch_charts.closed(load_mesh(copy)), f"{MESH_FILE} of the {kind}"
    return None, "the procedural head stands for the face"
