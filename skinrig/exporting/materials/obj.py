"""Meshes as Wavefront OBJ text."""

from __future__ import annotations

from skinrig.exporting.materials.tangents import FramedMesh


def text(mesh: FramedMesh, per_mm: float, unit: str) -> str:
    """Return a mesh as OBJ with texture coordinates and normals.

    Parameters
    ----------
    mesh
        In mm.
    per_mm
        Scene units in one mm.
    unit
        Name of the scene unit, for the comment.
    """
    lines = [f"# skin, scene unit {unit}, +y up; texture coordinate (0, 0) is bottom left"]
    lines += ["v {:.9g} {:.9g} {:.9g}".format(*row) for row in (mesh.vertices_mm * per_mm).tolist()]
    lines += ["vt {:.9g} {:.9g}".format(*row) for row in mesh.uv.tolist()]
    lines += ["vn {:.6g} {:.6g} {:.6g}".format(*row) for row in mesh.normals.tolist()]
    for a, b, c in (mesh.faces + 1).tolist():
        lines.append(f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}")
    return "\n".join(lines) + "\n"
