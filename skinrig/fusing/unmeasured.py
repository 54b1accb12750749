"""Add parts that no rig measures to a fused person, marked as such."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from model.skin import SkinAppearance
from reconstruction.scan.repair import ScanMeshError
from rigsim.geometry.mesh import MeshError
from skinrig.appearances import face_textures
from skinrig.appearances.contents import list_assumptions
from skinrig.rendering.geometry import MESH_FILES, GeometryError
from skinrig.unmeasured.head_fit import HeadFitError
from skinrig.unmeasured.person import HEAD_FILE, UNMEASURED_KEY, fit_unmeasured

UNMEASURED_NAME: Final = "unmeasured"
"""Name that leaves these parts out."""
UNMEASURED_ROW: Final = "unmeasured parts"
"""Beginning of the names of such parts among what an appearance leaves out."""
UNMEASURED_SOURCE: Final = (
    "not measured; for display, the mean of simulated heads, fitted to the scan"
)
"""End of what an appearance with such parts assumes."""


@dataclass(frozen=True, slots=True)
class UnmeasuredParts:
    """Parts that no rig measures, for an appearance with the same mesh.

    Attributes
    ----------
    files
        The fitted head; none if it adds no part.
    described
        Parts, source and errors, as JSON values.
    left_out
        Parts that cannot be added, with reasons.
    """

    files: Mapping[str, bytes]
    described: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...]


def find_unmeasured(
    appearance: SkinAppearance, landmarks_mm: Mapping[str, tuple[float, float, float]] | None = None
) -> UnmeasuredParts:
    """Fit the mean head to the mesh of an appearance; a mesh without a face has no parts.

    Parameters
    ----------
    appearance
        With the mesh of its maps.
    landmarks_mm
        Points of the mesh by name that guide the fit.
    """
    try:
        files, described, missing = fit_unmeasured(appearance, landmarks_mm)
    except (HeadFitError, ScanMeshError, MeshError, GeometryError) as error:
        return UnmeasuredParts({}, {}, ((UNMEASURED_ROW, str(error)),))
    rows = tuple((f"{UNMEASURED_ROW}: {what}", why) for what, why in missing)
    return UnmeasuredParts(files, described, rows)


def drop_unmeasured(appearance: SkinAppearance) -> SkinAppearance:
    """Return an appearance without the parts that `add_unmeasured` added, and their records.

    Parameters
    ----------
    appearance
        Any; one without such parts stays as it is.
    """
    assumed = [one for one in list_assumptions(appearance) if not one.endswith(UNMEASURED_SOURCE)]
    left_out = tuple(row for row in appearance.left_out if not row[0].startswith(UNMEASURED_ROW))
    known = {UNMEASURED_KEY} & appearance.parameters.keys() | {HEAD_FILE} & appearance.files.keys()
    if not known and left_out == appearance.left_out:
        return appearance
    parameters: dict[str, Any] = {
        key: value for key, value in appearance.parameters.items() if key != UNMEASURED_KEY
    }
    if "assumed" in parameters:
        parameters["assumed"] = assumed
    files = {name: data for name, data in appearance.files.items() if name != HEAD_FILE}
    return replace(appearance, files=files, parameters=parameters, left_out=left_out)


def add_unmeasured(
    appearance: SkinAppearance,
    dome: Path,
    landmarks: Path | None,
    *,
    progress: Callable[[str], None],
    found: UnmeasuredParts | None = None,
) -> SkinAppearance:
    """Return an appearance with the mean head fitted to its mesh, in a file of its own.

    No map and no other file changes. An appearance without a mesh stays as it is. Parts that cannot
    be added are left out with the reason.

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
    found
        Parts for this mesh; None: they are fitted here.
    """
    if not any(name in appearance.files for name in MESH_FILES):
        return appearance
    if found is None:
        progress("fit the mean head, for parts that no rig measured")
        points = None if landmarks is None else face_textures.read(dome, landmarks).landmarks
        found = find_unmeasured(appearance, points)
    appearance = replace(appearance, left_out=(*appearance.left_out, *found.left_out))
    if not found.files:
        return appearance
    assumed = f"{', '.join(found.described['parts'])}: {UNMEASURED_SOURCE}"
    return replace(
        appearance,
        files={**appearance.files, **found.files},
        parameters={
            **appearance.parameters,
            "assumed": [*list_assumptions(appearance), assumed],
            UNMEASURED_KEY: found.described,
        },
    )
