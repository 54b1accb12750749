"""Prepare a scanned mesh for measurements: repair, refine to many points, and unwrap."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.sparse import csr_array

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from reconstruction.scan.hole_patches import close_scan
from reconstruction.scan.repair import (
    RepairReport,
    ScanMeshError,
    TriangleMesh,
    boundary_edges,
    crop,
    directed_edges,
    repair_mesh,
)

FACE_BOX_MM: Final = ((-100.0, -108.0, -105.0), (100.0, 150.0, 60.0))
"""Box around a face in the rig frame; the neck below the chin and clothes are outside."""
MAX_POINTS: Final = 4_000_000
UNWRAP_SMOOTHINGS: Final = 3
"""Smoothing steps before the unwrapping.

On four simulated scans of faces, 3 leave 6 to 13 charts, none 17 to 247. Texels then have 0.8 to
1.2 times their median size."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinedScan:
    """Surface of many points at which photographs are sampled."""

    points_mm: Float32Array
    """Shape (P, 3)."""
    normals: Float32Array
    """Unit, outward, shape (P, 3)."""
    faces: Int32Array
    """Triangles of points, shape (F, 3)."""
    corner_uv: Float32Array
    """Texture coordinates of each triangle's corners, shape (F, 3, 2), (0, 0) bottom left."""
    coarse: TriangleMesh
    """The repaired scan before refinement, with texture coordinates; used for ray casting."""
    report: RepairReport
    """Counts of the repairs."""
    stderr_mm: Float32Array | None = None
    """Standard error across the surface at each point, shape (P,); None: not known."""
    hole_stderr_mm: Float32Array | None = None
    """Standard error across the surface of points in closed holes and at their rims, 0 elsewhere,
    shape (P,); None: no hole was closed with a stated error."""
    hole_faces: BoolArray | None = None
    """Triangles of `coarse` that close holes, shape (F,); None: none."""

    @property
    def patch_stderr_mm(self) -> Float32Array:
        """Return the standard error by closed holes at each point, shape (P,), mm."""
        none = np.zeros(len(self.points_mm), np.float32)
        return none if self.hole_stderr_mm is None else self.hole_stderr_mm

    def scanned_mesh(self) -> TriangleMesh:
        """Return the repaired scan without the triangles that close holes."""
        return (
            self.coarse if self.hole_faces is None else self.coarse.select_faces(~self.hole_faces)
        )

    def transform(self, rotation: Float64Array, translation_mm: Float64Array) -> RefinedScan:
        """Apply a rigid motion ``rotation @ p + translation_mm`` to the surface."""
        turn = np.asarray(rotation, np.float64)
        vertices_mm = self.coarse.vertices_mm @ turn.T + translation_mm
        coarse = replace(self.coarse, vertices_mm=vertices_mm)
        return replace(
            self,
            points_mm=(self.points_mm @ turn.T + translation_mm).astype(np.float32),
            normals=(self.normals @ turn.T).astype(np.float32),
            coarse=coarse,
        )


def load_ply(data: bytes) -> TriangleMesh:
    """Read a session's scan, a PLY in mm.

    Raises
    ------
    ScanMeshError
        Where the bytes are not a mesh.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
        vertices = np.asarray(loaded.vertices, np.float64)
        faces = np.asarray(loaded.faces, np.int64)
    except Exception as exc:  # the parser raises various types
        raise ScanMeshError(
            f"scan: got {exc}, expected a PLY mesh; export the scan as PLY again"
        ) from exc
    if not len(faces) or not np.isfinite(vertices).all():
        raise ScanMeshError(
            f"scan: got {len(faces)} triangles and "
            f"{np.count_nonzero(~np.isfinite(vertices))} coordinates that are not finite, expected "
            "triangles with finite coordinates; export the scan again"
        )
    uv = getattr(loaded.visual, "uv", None)
    given = uv is not None and len(uv) == len(vertices)
    return TriangleMesh(vertices, faces, np.asarray(uv, np.float64)[faces] if given else None)


def prepare_scan(scan: bytes | TriangleMesh, *, points: int = 500_000) -> RefinedScan:
    """Crop and repair a scan, close its holes, unwrap and refine it.

    A scan with texture coordinates keeps its long holes, as their texture is not known. Its holes
    of up to 40 mm around are closed by flat triangles, without a stated error.

    Parameters
    ----------
    scan : bytes or TriangleMesh
        A PLY in mm, or the result of `load_ply`.
    points : int
        Approximate number of points: Loop subdivision multiplies it by four per step; the nearest
        number of steps is taken.

    Returns
    -------
    RefinedScan
        In the frame of the scan; see `reconstruction.scan.registration.register_scan`.

    Raises
    ------
    ScanMeshError
        Where no part of the scan is usable.
    """
    mesh = load_ply(scan) if isinstance(scan, bytes) else scan
    face = crop(mesh, box_mm=FACE_BOX_MM)
    if face.corner_uv is not None:
        mesh, report = repair_mesh(face)
        return refine_mesh(mesh, points=points, report=report)
    mesh, report = repair_mesh(face, max_hole_mm=0.0)  # patches have a stated error, fans do not
    closed = close_scan(mesh)
    errors = closed.corner_stderr_mm()
    refined = refine_mesh(
        unwrap_mesh(closed.mesh), points=points, report=report, hole_stderr_mm=errors
    )
    if not closed.rims_mm:
        return replace(refined, hole_stderr_mm=None)
    counts = {**report.counts, "holes closed by smooth patches": len(closed.rims_mm)}
    return replace(refined, hole_faces=closed.hole_faces, report=RepairReport(counts))


def unwrap_mesh(mesh: TriangleMesh, *, smoothings: int = UNWRAP_SMOOTHINGS) -> TriangleMesh:
    """Unwrap a surface with little stretch, into charts that fill the unit square (xatlas).

    Charts follow a smoothed copy: on the noise of a scan, xatlas cuts single triangles out of the
    charts, which leaves holes in every map. The surface keeps its vertices.

    Parameters
    ----------
    mesh
        Any surface.
    smoothings
        Times that each vertex of the copy, but for those of its rim, moves to the middle between
        itself and the mean of its neighbors.

    Raises
    ------
    ScanMeshError
        If xatlas drops triangles.
    """
    import xatlas

    _, index, uv = xatlas.parametrize(
        np.ascontiguousarray(_smooth_vertices(mesh, smoothings), np.float32),
        np.ascontiguousarray(mesh.faces, np.uint32),
    )
    if len(index) != len(mesh.faces):
        raise ScanMeshError(
            f"unwrap: got {len(index)} triangles back, expected {len(mesh.faces)}; "
            "decimate the scan and try again"
        )
    return TriangleMesh(mesh.vertices_mm, mesh.faces, np.asarray(uv, np.float64)[index])


def _smooth_vertices(mesh: TriangleMesh, count: int) -> Float64Array:
    """Return vertices (V, 3) after `count` smoothing steps."""
    start, end = directed_edges(np.concatenate([mesh.faces, mesh.faces[:, ::-1]])).T
    near = csr_array(
        (np.ones(len(start)), (start, end)), shape=(len(mesh.vertices_mm), len(mesh.vertices_mm))
    )
    near.data[:] = 1.0
    total = np.maximum(np.asarray(near.sum(axis=1)), 1.0)[:, None]
    inner = ~np.isin(np.arange(len(total)), boundary_edges(mesh.faces))[:, None]
    vertices = np.asarray(mesh.vertices_mm, np.float64)
    for _ in range(count):
        vertices = np.where(inner, 0.5 * (vertices + near @ vertices / total), vertices)
    return vertices


def refine_mesh(
    mesh: TriangleMesh,
    *,
    points: int,
    report: RepairReport | None = None,
    hole_stderr_mm: Float64Array | None = None,
) -> RefinedScan:
    """Refine a clean surface by Loop subdivision to about `points` points.

    Texture coordinates are refined linearly: each half of an edge is half of it in the texture. So
    are the standard errors of corners in closed holes, shape (F, 3); the rim has those of its hole.

    References
    ----------
    Loop 1987, Smooth subdivision surfaces based on triangles, University of Utah.
    """
    from trimesh.remesh import subdivide_loop

    Checks(ScanMeshError).within("points", points, f"[3, {MAX_POINTS}]")
    if mesh.corner_uv is None:
        raise ScanMeshError("mesh: got no texture coordinates, expected some; see unwrap_mesh")
    steps = max(round(float(np.log(points / len(mesh.vertices_mm)) / np.log(4.0))), 0)
    fine = mesh
    if hole_stderr_mm is not None:  # as a third coordinate of each corner
        errors = [mesh.corner_uv, hole_stderr_mm[..., None]]
        fine = replace(mesh, corner_uv=np.concatenate(errors, axis=-1))
    fine = _split_chords(fine)
    for _ in range(steps):
        uv = fine.corner_uv
        vertices, faces = subdivide_loop(fine.vertices_mm, fine.faces, iterations=1)
        fine = TriangleMesh(vertices, np.asarray(faces, np.int64), _halved(uv))
    uv = fine.corner_uv
    if uv is None or len(uv) != len(fine.faces):
        raise ScanMeshError(
            "refine: got different numbers of triangles and texture triangles, expected equal "
            "numbers; unwrap the mesh again"
        )
    stderr = None
    if hole_stderr_mm is not None:
        stderr = np.zeros(len(fine.vertices_mm), np.float32)
        np.maximum.at(stderr, fine.faces, uv[..., 2].astype(np.float32))
    return RefinedScan(
        fine.vertices_mm.astype(np.float32),
        fine.normals(),
        fine.faces.astype(np.int32),
        uv[..., :2].astype(np.float32),
        mesh,
        report or RepairReport(),
        hole_stderr_mm=stderr,
    )


def _halved(uv: Float64Array | None) -> Float64Array | None:
    """Return texture coordinates of the four parts of each triangle, in the order of trimesh."""
    if uv is None:
        return None
    a, b, c = uv[:, 0], uv[:, 1], uv[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    rows = [a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca]
    return np.stack(rows, axis=1).reshape(-1, 3, uv.shape[-1])


def _split_chords(mesh: TriangleMesh) -> TriangleMesh:
    """Halve the inner edges that join two vertices of the rim.

    trimesh takes every neighbor on the rim for a neighbor along it, which would displace the ends
    of such an edge; after the split, and after each subdivision, there is none.
    """
    vertices, faces, uv = mesh.vertices_mm, mesh.faces, mesh.corner_uv
    while True:
        rim = np.zeros(len(vertices), np.bool_)
        edges_of_rim = boundary_edges(faces)
        rim[edges_of_rim] = True
        edges = np.sort(directed_edges(faces), axis=1)
        alone = {tuple(e) for e in np.sort(edges_of_rim, axis=1).tolist()}
        chord = rim[edges].all(axis=1)
        rows = [k for k in np.flatnonzero(chord).tolist() if tuple(edges[k].tolist()) not in alone]
        if not rows:
            return TriangleMesh(vertices, faces, uv)
        # one edge per triangle and pass, so that no triangle is halved along two at once
        by_edge: dict[tuple[int, int], list[int]] = {}
        for k in rows:
            by_edge.setdefault(tuple(edges[k].tolist()), []).append(k)
        taken: set[int] = set()
        middles: list[Float64Array] = []
        halves: list[Int64Array] = []
        half_uv: list[Float64Array] = []
        for (a, b), pair in by_edge.items():
            if any(k // 3 in taken for k in pair):
                continue
            taken.update(k // 3 for k in pair)
            new = len(vertices) + len(middles)
            middles.append(0.5 * (vertices[a] + vertices[b]))
            for k in pair:
                i, j = k % 3, (k + 1) % 3
                for corner in (j, i):  # the half that loses this corner
                    half = faces[k // 3].copy()
                    half[corner] = new
                    halves.append(half)
                    if uv is not None:
                        flat = uv[k // 3].copy()
                        flat[corner] = 0.5 * (uv[k // 3, i] + uv[k // 3, j])
                        half_uv.append(flat)
        keep = np.setdiff1d(np.arange(len(faces)), list(taken))
        vertices = np.concatenate([vertices, np.array(middles)])
        faces = np.concatenate([faces[keep], np.array(halves)])
        if uv is not None:
            uv = np.concatenate([uv[keep], np.array(half_uv)])
