"""The procedural head: a simulated person, needing no file at all."""

from __future__ import annotations

import numpy as np

from skinrig.viewer.assembling import assemble
from skinrig.viewer.scene import SceneSource, ViewerMesh, ViewerScene


def scene(*, preset: str = "III", size: int = 2048, seed: int = 0) -> ViewerScene:
    """Return the scene of a simulated person.

    Parameters
    ----------
    preset
        One of `rigsim.subject.PRESETS`.
    size
        Texels a side of the textures, 64 to 4096.
    seed
        Of the person.
    """
    from rigsim.subject import make_subject

    subject = make_subject(preset, seed=seed, size=size)
    mesh = ViewerMesh(
        positions=subject.mesh.vertices_mm,
        normals=subject.mesh.normals,
        uv=subject.mesh.uv,
        faces=subject.mesh.faces.astype(np.int32),
        shapes=subject.blend_shapes(),
    )
    source = SceneSource("procedural", mesh, size, seed=seed, subject=subject)
    return assemble(
        source,
        provenance={"source": "simulated", "kind": "procedural", "preset": preset, "seed": seed},
    )
