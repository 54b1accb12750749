"""Simulated faces: the procedural head, needing no file at all, or another mesh grown a skin."""

from pathlib import Path

import numpy as np

from rigsim.geometry.mesh import Mesh, build_mesh, centered
from rigsim.subject import SimulatedSubject, make_subject
from skinrig.blend_shapes import meshes as blend_shapes
from skinrig.viewer.assembling import assemble
from skinrig.viewer.fine_skin import PERSON_PX, FineSkin
from skinrig.viewer.scene import MAX_TEXTURE_PX, SceneError, SceneSource, ViewerMesh, ViewerScene

DEFAULT_PRESET = "III"
"""Skin type of faces of whom nothing else is known."""
MIN_TEXTURE_PX = 64
POSITION_STEPS_PER_MM = np.float32(1024.0)
"""Steps of a millimetre that positions are rounded to; strain is of the rounded mesh throughout."""


def scene(
    *, preset: str = DEFAULT_PRESET, size: int = 2048, seed: int = 0, mesh: Path | None = None
) -> ViewerScene:
    """Return the scene of a simulated person.

    Parameters
    ----------
    preset
        One of `rigsim.subject.PRESET_NAMES`.
    size
        Texels a side of the textures, 64 to 4096.
    seed
        Of the person.
    mesh
        A face to grow the skin on instead of the procedural head; see `load_mesh`.

    Raises
    ------
    SceneError
        For a size out of range.
    rigsim.subject.SubjectError, rigsim.geometry.mesh.MeshError,
    skinrig.blend_shapes.errors.BlendShapeError
        For a preset, seed or mesh that cannot be used.
    """
    check_size(size)
    surface = None if mesh is None else load_mesh(mesh)
    subject = simulated(surface, preset=preset, size=size, seed=seed)
    source = SceneSource(
        "procedural" if mesh is None else "mesh",
        viewer_mesh(subject),
        size,
        seed=seed,
        subject=subject,
        skin=FineSkin(subject, size),
    )
    provenance = {"source": "simulated", "kind": source.kind, "preset": preset, "seed": seed}
    if mesh is not None:
        provenance["mesh"] = mesh.name
    return assemble(source, provenance=provenance)


def check_size(size: int) -> None:
    """Refuse a texture size that no page can hold."""
    if not MIN_TEXTURE_PX <= size <= MAX_TEXTURE_PX:
        raise SceneError(f"size: got {size}, expected {MIN_TEXTURE_PX} to {MAX_TEXTURE_PX} texels")


def simulated(mesh: Mesh | None, *, preset: str, size: int, seed: int) -> SimulatedSubject:
    """Return the simulated person that wears a mesh, or the procedural head, coarsely."""
    return make_subject(preset, seed=seed, size=min(size, PERSON_PX), mesh=mesh)


def load_mesh(path: Path) -> Mesh:
    """Return a face mesh of a file with or without blend shapes, in place of the procedural head.

    Parameters
    ----------
    path
        .npz, .obj (or a folder of them), .gltf or .glb, see `skinrig.blend_shapes.meshes.load`. The
        face looks towards +z, and its foremost vertex is the tip of the nose.
    """
    loaded = blend_shapes.load(path)
    if loaded.uv.min() < 0.0 or loaded.uv.max() > 1.0:
        raise SceneError(
            f"{path}: texture coordinates reach from {loaded.uv.min():g} to {loaded.uv.max():g}, "
            "expected 0 to 1; export the tile of the face alone"
        )
    return centered(build_mesh(loaded.vertices_mm, loaded.faces, loaded.uv, shapes=loaded.shapes))


def viewer_mesh(subject: SimulatedSubject) -> ViewerMesh:
    """Return a person's mesh; its own blend shapes come behind those of the expressions."""
    rounded = np.round(subject.mesh.vertices_mm * POSITION_STEPS_PER_MM) / POSITION_STEPS_PER_MM
    own = {n: d for n, d in subject.mesh.shapes.items() if np.any(d)}
    return ViewerMesh(
        positions=np.asarray(rounded, np.float32),
        normals=subject.mesh.normals,
        uv=subject.mesh.uv,
        faces=subject.mesh.faces.astype(np.int32),
        shapes={**subject.blend_shapes(), **own},
    )
