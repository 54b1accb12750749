"""Import scanned meshes into SESSION/: OBJ and PLY, checked, in millimeters."""

import codecs
import hashlib
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import Float32Array, Float64Array, Int32Array, Int64Array
from capture.documents import Fault, InputError
from capture.session import Session, SessionError, reopen_copy

MM_PER_UNIT: Final[Mapping[str, float]] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
EXTENT_RANGE_MM: Final = (20.0, 3000.0)
"""Range of the longest side of a scan of a face, a head or a person."""
MAX_FILE_BYTES: Final = 2**31
SCAN_FILE: Final = "scan.ply"
"""Name of the attachment that holds a session's scanned mesh."""

_PLY_COUNT: Final = re.compile(rb"element[ \t]+(vertex|face)[ \t]+(\d+)")


class MeshImportError(InputError):
    """Raised for a mesh file that cannot be used."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedMesh:
    """Triangles of a file, in millimeters; nothing is cleaned or joined."""

    vertices_mm: Float32Array
    """Positions, shape (V, 3), mm, the scanner's frame."""
    faces: Int32Array
    """Vertex indices, shape (F, 3); polygons with more corners are split into triangles."""
    uv: Float32Array | None
    """Texture coordinates, shape (V, 2), (0, 0) bottom left; None when the file has none."""
    about: Mapping[str, str | int | float | bool]
    """Provenance: hash and kind of the file, unit, counts."""

    def to_ply(self, properties: Mapping[str, ArrayLike] | None = None) -> bytes:
        """Return the mesh as a binary PLY with float32 positions (and ``s``, ``t``).

        Parameters
        ----------
        properties : mapping of str to array_like, shape (V,), optional
            Further float32 properties of the vertices, by name.
        """
        fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
        columns = [self.vertices_mm]
        if self.uv is not None:
            fields += [("s", "<f4"), ("t", "<f4")]
            columns.append(self.uv)
        for name, values in (properties or {}).items():
            fields.append((name, "<f4"))
            columns.append(np.asarray(values, np.float32)[:, None])
        names = "".join(f"property float {name}\n" for name, _ in fields)
        header = (
            "ply\nformat binary_little_endian 1.0\ncomment unit mm\n"
            f"element vertex {len(self.vertices_mm)}\n{names}"
            f"element face {len(self.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        corners = np.empty(len(self.faces), [("count", "u1"), ("index", "<i4", 3)])
        corners["count"], corners["index"] = 3, self.faces
        vertices = np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4")
        return header.encode("ascii") + vertices.tobytes() + corners.tobytes()


@dataclass(frozen=True, slots=True)
class MeshImport:
    """Result of an import."""

    path: str
    """The session that contains the mesh now."""
    vertices: int
    faces: int
    has_uv: bool
    extent_mm: tuple[float, float, float]
    """Width, height and depth, mm."""
    reopened: bool
    """Whether the session is a copy of a closed one."""


def read_mesh(path: str | Path, *, unit: str = "mm") -> ScannedMesh:
    """Read an OBJ or PLY file, ascii or binary, of triangles or polygons, in any groups.

    Parameters
    ----------
    path : str or Path
        A file that ends in .obj or .ply.
    unit : {"mm", "cm", "m", "inch"}
        Unit of the file's coordinates.

    Returns
    -------
    ScannedMesh

    Raises
    ------
    MeshImportError
        When the file is missing, empty, truncated or not a mesh, when a position is not finite, or
        when the extent in this unit is implausible for a face.
    """
    place = Path(path)
    if unit not in MM_PER_UNIT:
        raise _error(place, "unit", repr(unit), f"one of {', '.join(MM_PER_UNIT)}")
    kind = place.suffix.lower().removeprefix(".")
    if kind not in ("obj", "ply"):
        raise _error(place, "file", f"suffix {place.suffix!r}", ".obj or .ply")
    try:
        data = place.read_bytes() if place.stat().st_size <= MAX_FILE_BYTES else None
    except OSError as exc:
        raise MeshImportError.at(
            "cannot be read",
            "file",
            str(exc.strerror),
            "a mesh",
            where=place,
            advice="Check the name, and the folder that the command runs in.",
            code="SR-IMP-016",
        ) from exc
    if data is None:
        raise _error(place, "file", "a larger one", f"at most {MAX_FILE_BYTES} bytes")
    if not data.strip():
        raise _error(place, "file", "an empty one", "vertices and faces")
    vertices, faces, uv = _decode(data, kind, place)
    _check(vertices, faces, data if kind == "ply" else b"", place)
    if uv is not None and not np.isfinite(uv).all():
        uv = None
    scale = MM_PER_UNIT[unit]
    _check_extent(np.ptp(vertices[np.unique(faces)], axis=0) * scale, scale, place)
    about: dict[str, str | int | float | bool] = {
        "origin": "imported",
        "sha256": f"sha256:{hashlib.sha256(data).hexdigest()}",
        "format": kind,
        "unit": unit,
        "vertices": len(vertices),
        "faces": len(faces),
        "uv": uv is not None,
    }
    return ScannedMesh(
        (vertices * scale).astype(np.float32),
        faces.astype(np.int32),
        None if uv is None else uv.astype(np.float32),
        about,
    )


def import_mesh(
    path: str | Path, *, session: str | Path, out: str | Path | None = None, unit: str = "mm"
) -> MeshImport:
    """Attach a scanned mesh to a session that contains none yet, as ``scan.ply`` in mm.

    Parameters
    ----------
    path : str or Path
        See `read_mesh`.
    session : str or Path
        An open session, which stays open; or, with `out`, a closed one, which is not modified.
    out : str or Path, optional
        New folder for a copy of a closed session, which contains the mesh and is closed again.
    unit : {"mm", "cm", "m", "inch"}
        Unit of the file's coordinates.

    Raises
    ------
    MeshImportError
        When the mesh cannot be used.
    SessionError
        When the session contains a scan already, or is closed and no `out` is given.
    """
    mesh = read_mesh(path, unit=unit)
    found = Session.open(session)
    if SCAN_FILE in found.attachments():
        advice = "Attachments are never replaced: make a new session for another scan."
        faults = [Fault("attachment", f"{SCAN_FILE}, attached before", "none of that name")]
        raise SessionError(
            "contains a scan already",
            where=str(session),
            faults=faults,
            advice=advice,
            code="SR-IMP-001",
        )
    if found.closed and out is None:
        advice = "Name a folder for a copy with the mesh: --out COPY."
        what = "the session is closed"
        raise SessionError(what, where=str(session), advice=advice, code="SR-IMP-002")
    if out is not None:
        opened, reason = reopen_copy(session, out)
        with opened:
            opened.attach(SCAN_FILE, mesh.to_ply(), about=mesh.about)
            opened.close(missing_reason=reason)
    else:
        with Session.resume(session) as opened:
            opened.attach(SCAN_FILE, mesh.to_ply(), about=mesh.about)
    width, height, depth = (float(x) for x in np.ptp(mesh.vertices_mm, axis=0))
    counts, size_mm = (len(mesh.vertices_mm), len(mesh.faces)), (width, height, depth)
    written = str(out if out is not None else session)
    return MeshImport(written, *counts, mesh.uv is not None, size_mm, out is not None)


_Arrays = tuple[Float64Array, Int64Array, Float64Array | None]


def _decode(data: bytes, kind: str, source: Path) -> _Arrays:
    """Return vertices, faces and texture coordinates of all parts of a file."""
    import trimesh

    try:
        # a stream and not a path: files named inside (materials, textures) are not opened
        stream: io.BytesIO | io.StringIO = io.BytesIO(data)
        if kind == "obj":  # names and comments of unknown encoding: the library would guess it
            wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
            stream = io.StringIO(data.decode("utf-16" if wide else "utf-8-sig", "replace"))
        loaded: Any = trimesh.load_scene(stream, file_type=kind, process=False)
        parts = [part for part in loaded.dump() if hasattr(part, "faces")]
    except Exception as exc:  # the readers raise whatever their parsers raise
        reason = str(exc).splitlines()[0] if str(exc) else type(exc).__name__
        raise _error(source, "content", reason, f"a whole {kind.upper()} file") from exc
    if not parts or not sum(len(part.faces) for part in parts):
        got = "points only" if parts or loaded.geometry else "nothing"
        raise _error(source, "faces", got, "at least one triangle")
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    faces = np.concatenate(
        [np.asarray(part.faces, np.int64) + at for part, at in zip(parts, first, strict=False)]
    )
    uvs = [getattr(part.visual, "uv", None) for part in parts]
    whole = all(
        uv is not None and len(uv) == len(part.vertices)
        for uv, part in zip(uvs, parts, strict=True)
    )
    uv = np.concatenate([np.asarray(uv, np.float64)[:, :2] for uv in uvs]) if whole else None
    return vertices, faces, uv


def _check(vertices: Float64Array, faces: Int64Array, ply: bytes, where: Path) -> None:
    counts = {name: int(count) for name, count in _PLY_COUNT.findall(ply.split(b"end_header")[0])}
    for name, got in ((b"vertex", len(vertices)), (b"face", len(faces))):
        if got < counts.get(name, 0):
            text = f"{counts[name]}, as in its header"
            raise _error(where, f"{name.decode()} elements", f"{got}: the file is truncated", text)
    if faces.min() < 0 or faces.max() >= len(vertices):
        text = f"0 to {len(vertices) - 1}"
        raise _error(where, "faces", f"vertices {faces.min()} to {faces.max()}", text)
    bad = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
    if bad:
        raise _error(where, "vertices", f"{bad} that are not finite", "numbers only")


def _check_extent(extent_mm: Float64Array, scale: float, where: Path) -> None:
    low, high = EXTENT_RANGE_MM
    longest = float(extent_mm.max())
    if low <= longest <= high:
        return
    fitting = [u for u, s in MM_PER_UNIT.items() if low <= longest / scale * s <= high]
    hint = f"it would be in {' or '.join(fitting)}: --unit {fitting[0]}" if fitting else ""
    raise MeshImportError(
        "is implausible in size for a face",
        where=str(where),
        faults=[Fault("size", f"{longest:.4g} mm", f"{low:g} to {high:g} mm", hint)],
        advice="Give the unit of the file with --unit.",
        code="SR-IMP-003",
    )


def _error(source: Path, field: str, got: str, expected: str) -> MeshImportError:
    faults = [Fault(field, got, expected)]
    return MeshImportError(
        "is not a mesh that can be used",
        where=str(source),
        faults=faults,
        advice="Export it again as .ply or .obj with triangles.",
        code="SR-IMP-004",
    )
