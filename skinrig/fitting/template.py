"""Wrap a face template onto a scan and write it: `skinrig fit template`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from capture.importers.meshes import SCAN_FILE, ScannedMesh, read_mesh
from capture.session import Session
from reconstruction.correspondence.landmark_table import read_point_table
from reconstruction.scan.face_template import FaceTemplate, load_default_template
from reconstruction.scan.mesh import load_ply
from reconstruction.scan.repair import ScanMeshError, TriangleMesh, weld
from reconstruction.scan.template_wrapping import WrappedTemplate, wrap_template
from skinrig.arrays import Float64Array, Int64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UsageError


@dataclass(frozen=True, slots=True, eq=False)
class TemplateFiles:
    """Inputs of a wrapping.

    Attributes
    ----------
    scan
        OBJ or PLY file, or a session with a scan.
    template
        OBJ or PLY file with texture coordinates, mm; None: the built-in average face.
    landmarks, template_landmarks
        CSV tables name,x,y,z in mm: points of the scan and of `template`.
    unit
        Unit of the scan's file.
    """

    scan: Path
    template: Path | None = None
    landmarks: Path | None = None
    template_landmarks: Path | None = None
    unit: str = "mm"


def fit_template(
    files: TemplateFiles,
    *,
    out: Path,
    search: bool | None = None,
    steps: int = 8,
    progress: Callable[[str], None] | None = None,
) -> WrappedTemplate:
    """Wrap a template onto a scan and write it as a PLY in the scan's frame, mm.

    The PLY has the template's vertices in their order, its triangles and texture coordinates, and
    per vertex ``valid`` (1 or 0) and the standard uncertainties ``across_mm`` and ``along_mm``.

    Parameters
    ----------
    files
        Scan, template and landmarks.
    out
        File to write, replaced as a whole.
    search, steps, progress
        As in `reconstruction.scan.template_wrapping.wrap_template`.

    Raises
    ------
    ScanMeshError
        If the scan is not of a face, or the template has no texture coordinates.
    """
    if files.template_landmarks is not None and files.template is None:
        raise UsageError("--template-landmarks: applies to your own template only; add --template")
    template, layout = _read_template(files)
    points = None if files.landmarks is None else read_point_table(files.landmarks)
    found = wrap_template(
        template,
        _read_scan(files),
        landmarks_mm=None if points is None else {k: np.array(v) for k, v in points.items()},
        search=search,
        steps=steps,
        progress=progress,
    )
    row = layout.vertex
    mesh = ScannedMesh(
        found.mesh.vertices_mm[row].astype(np.float32),
        layout.faces.astype(np.int32),
        layout.uv.astype(np.float32),
        {},
    )
    properties = {"valid": found.valid, "across_mm": found.across_mm, "along_mm": found.along_mm}
    write_atomically(out, mesh.to_ply({name: value[row] for name, value in properties.items()}))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """Vertices of a template's file, which has several at seams of its texture.

    Attributes
    ----------
    vertex
        Welded vertex of each vertex of the file, shape (V,).
    faces
        Triangles of the file's vertices, shape (F, 3).
    uv
        Texture coordinates of the file's vertices, shape (V, 2).
    """

    vertex: Int64Array
    faces: Int64Array
    uv: Float64Array


def _read_template(files: TemplateFiles) -> tuple[FaceTemplate, _Layout]:
    """Return the template, welded, and the layout of its file."""
    if files.template is None:
        template = load_default_template()
        faces = template.mesh.faces
        uv = np.zeros((len(template.mesh.vertices_mm), 2))
        uv[faces] = template.texture()
        return template, _Layout(np.arange(len(uv)), faces, uv)
    read = read_mesh(files.template)
    faces, vertices = read.faces.astype(np.int64), read.vertices_mm.astype(np.float64)
    corner_uv = None if read.uv is None else read.uv.astype(np.float64)[faces]
    mesh = weld(TriangleMesh(vertices, faces, corner_uv))
    vertex = np.asarray(cKDTree(mesh.vertices_mm).query(vertices)[1], np.int64)
    points = {} if files.template_landmarks is None else read_point_table(files.template_landmarks)
    landmarks = {name: np.array(point) for name, point in points.items()}
    template = FaceTemplate(mesh, landmarks)
    uv = np.zeros((len(vertices), 2))
    uv[faces] = template.texture()
    return template, _Layout(vertex, faces, uv)


def _read_scan(files: TemplateFiles) -> TriangleMesh:
    """Return the triangles of a file, or of a session's scan."""
    if files.scan.is_dir():
        session = Session.open(files.scan)
        if SCAN_FILE not in session.attachments():
            raise ScanMeshError(
                f"session {session.id}: got no scan, expected one; give the file of a scan, or add "
                "it with `skinrig import mesh`"
            )
        return load_ply(session.attachment(SCAN_FILE))
    read = read_mesh(files.scan, unit=files.unit)
    return TriangleMesh(read.vertices_mm.astype(np.float64), read.faces.astype(np.int64))
