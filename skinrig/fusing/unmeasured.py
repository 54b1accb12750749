"""Add parts that no rig measures to a fused person, marked as such."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from model.skin import SkinAppearance
from reconstruction.scan.repair import ScanMeshError
from skinrig.appearances import face_textures
from skinrig.appearances.contents import list_assumptions
from skinrig.rendering.geometry import MESH_FILES
from skinrig.unmeasured.head_fit import HeadFitError
from skinrig.unmeasured.person import UNMEASURED_KEY, UNMEASURED_PARTS, fit_unmeasured

UNMEASURED_NAME: Final = "unmeasured"
"""Name that leaves these parts out."""


def add_unmeasured(
    appearance: SkinAppearance,
    dome: Path,
    landmarks: Path | None,
    *,
    progress: Callable[[str], None],
) -> SkinAppearance:
    """Return an appearance with the mean head fitted to its mesh, in a file of its own.

    No map and no other file changes. An appearance without a mesh stays as it is.

    Parameters
    ----------
    appearance
        Fused maps.
    dome
        Folder of the dome's maps.
    landmarks
        Table of the face's points, see `skinrig.appearances.face_textures.read`; None: none. Ground
        truth is not used.
    progress
        Receives a line of progress.
    """
    if not any(name in appearance.files for name in MESH_FILES):
        return appearance
    progress("fit the mean head, for parts that no rig measured")
    points = None if landmarks is None else face_textures.read(dome, landmarks).landmarks
    try:
        files, described = fit_unmeasured(appearance, points)
    except (HeadFitError, ScanMeshError) as error:
        return replace(
            appearance, left_out=(*appearance.left_out, ("unmeasured parts", str(error)))
        )
    names = ", ".join(UNMEASURED_PARTS)
    assumed = f"{names}: not measured; for display, the mean of simulated heads, fitted to the scan"
    return replace(
        appearance,
        files={**appearance.files, **files},
        parameters={
            **appearance.parameters,
            "assumed": [*list_assumptions(appearance), assumed],
            UNMEASURED_KEY: described,
        },
    )
