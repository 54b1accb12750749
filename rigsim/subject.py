"""A simulated person's face: geometry with its truth maps of melanin, blood and surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from rigsim import face_regions, pigment, relief
from rigsim.atlas import Atlas, unwrap
from rigsim.head import LANDMARKS_MM, build_head
from rigsim.mesh import Float32Array, Mesh, centered, load_mesh
from rigsim.perfusion import STATES, Perfusion, perfuse

PRESETS: Final = tuple(pigment.MELANIN_PRESETS)
"""Names of the presets, pale to dark."""

SIZE_RANGE: Final = (64, 8192)
"""Texels along one side of the truth maps."""


class SubjectError(ValueError):
    """A subject is asked for that cannot be made."""


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """One face; maps are textures of shape (N, N), row 0 is the top (v = 1)."""

    preset: str
    """Name of the preset of melanin."""
    seed: int
    """Seed of everything that is drawn."""
    mesh: Mesh
    """Geometry in mm, rig frame, facing +z."""
    atlas: Atlas
    """Surface under each texel."""
    melanin: Float32Array
    """Volume fraction of melanosomes in the epidermis, 0 to 0.5."""
    perfusion: Perfusion
    """Blood by compartment, and what the states do to it."""
    roughness: Float32Array
    """GGX alpha of the surface, 0.15 to 0.5."""
    height_um: Float32Array
    """Pores and wrinkles over the mesh, um."""
    hair: Float32Array
    """Part of each texel that brows and lashes cover, 0 to 1."""
    normal: Float32Array
    """Unit normals of mesh and relief, shape (N, N, 3), rig frame."""

    @property
    def size(self) -> int:
        """Texels along one side of the maps."""
        return self.atlas.size

    def hemoglobin(self, state: str = "neutral") -> Float32Array:
        """Return the volume fraction of blood in the dermis in a state, shape (N, N), 0 to 0.32.

        Raises
        ------
        rigsim.perfusion.StateError
            The state is unknown.
        """
        return self.perfusion.blood(state)

    def landmarks_mm(self) -> dict[str, tuple[float, float, float]]:
        """Return named points of the mean head, moved to this face, mm in the rig frame."""
        tips = self.mesh.vertices_mm[np.argmax(self.mesh.vertices_mm[:, 2])].astype(np.float64)
        mapped = face_regions.on_mean_head(self.mesh.vertices_mm[:2], self.mesh)
        span = np.linalg.norm(self.mesh.vertices_mm[1] - self.mesh.vertices_mm[0])
        scale = float(np.linalg.norm(mapped[1] - mapped[0]) / max(float(span), 1e-9))
        tip = np.array(LANDMARKS_MM["nose tip"])
        return {
            name: tuple(((np.array(point) - tip) / scale + tips).tolist())
            for name, point in LANDMARKS_MM.items()
        }


def make_subject(
    preset: str = "III",
    *,
    seed: int = 0,
    size: int = 512,
    mesh: Mesh | str | Path | None = None,
    blood: float = 1.0,
) -> Subject:
    """Make a face.

    Parameters
    ----------
    preset
        One of `PRESETS`: skin types I to VI, or "palest" or "darkest".
    seed
        Seed of shape and patterns, >= 0; the same arguments give the same face.
    size
        Texels along one side of the maps, 64 to 8192; a face of 512 has texels of about 0.5 mm.
    mesh
        Geometry in mm, or its file (.npz, .obj), instead of the procedural head; the tip of its
        nose must be its foremost point. A file's mesh is moved to the rig's centre.
    blood
        Factor of all blood, 0.1 to 4.

    Returns
    -------
    Subject
        The face with its truth maps.

    Raises
    ------
    SubjectError
        An argument is outside its range.
    rigsim.mesh.MeshError
        The mesh cannot be used.

    Examples
    --------
    >>> face = make_subject("II", seed=1, size=64)
    >>> face.melanin.shape, sorted(face.landmarks_mm())[:2]
    ((64, 64), ['brow left', 'brow right'])
    """
    if preset not in pigment.MELANIN_PRESETS:
        raise SubjectError(f"preset: got {preset!r}, expected one of {', '.join(PRESETS)}")
    if seed < 0:
        raise SubjectError(f"seed: got {seed}, expected >= 0")
    if not SIZE_RANGE[0] <= size <= SIZE_RANGE[1]:
        raise SubjectError(f"size: got {size}, expected {SIZE_RANGE[0]} to {SIZE_RANGE[1]} texels")
    if not 0.1 <= blood <= 4.0:
        raise SubjectError(f"blood: got {blood}, expected 0.1 to 4")
    if mesh is None:
        surface = _head(seed)
    elif isinstance(mesh, Mesh):
        surface = mesh
    else:
        surface = centered(load_mesh(mesh))
    atlas = unwrap(surface, size)
    points = face_regions.on_mean_head(atlas.position_mm, surface)
    regions = face_regions.region_masks(points)
    height = relief.height_um(points, regions, texel_mm=_typical_texel_mm(atlas), seed=seed)
    return Subject(
        preset=preset,
        seed=seed,
        mesh=surface,
        atlas=atlas,
        melanin=pigment.melanin_map(points, regions, pigment.MELANIN_PRESETS[preset], seed=seed),
        perfusion=perfuse(points, regions, seed=seed, amount=blood),
        roughness=relief.roughness_map(points, regions, seed=seed),
        height_um=height,
        hair=relief.hair_map(points, seed=seed),
        normal=relief.relief_normals(atlas, height),
    )


@lru_cache(maxsize=4)
def _head(seed: int) -> Mesh:
    return build_head(np.random.default_rng([seed, 0]))


def _typical_texel_mm(atlas: Atlas) -> float:
    along_u, along_v = atlas.texel_mm()
    return float(np.median(np.maximum(along_u, along_v)[atlas.covered]))


__all__ = ["PRESETS", "STATES", "Subject", "SubjectError", "make_subject"]
