"""Landmarks of an image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from model import store
from reconstruction.correspondence import landmark_table
from skinrig.viewer.scene import SceneError, SceneSource


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
