"""Simulate a person's face: geometry with its ground-truth maps of melanin, blood and surface."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final
from weakref import WeakValueDictionary

import numpy as np

from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import Atlas, texture_of_vertices, unwrap
from rigsim.geometry.mesh import Mesh, center_face, load_mesh
from rigsim.subject import (
    expression_wrinkles,
    expressions,
    face_regions,
    landmarks,
    pigment,
    relief,
    tissue_pressure,
)
from rigsim.subject.head import LANDMARKS_MM, build_head
from rigsim.subject.perfusion import STATE_NAMES, Perfusion, StateError, draw_perfusion
from rigsim.subject.thickness import thickness_ratio
from rigsim.tissue.skin_layers import TYPICAL_SKIN, TissueProperties

PRESET_NAMES: Final = tuple(pigment.MELANIN_PRESETS)
"""Names of the presets, pale to dark."""

SIZE_RANGE: Final = (64, 8192)
"""Texels along each side of the ground-truth maps."""


class SubjectError(ValueError):
    """A subject with invalid arguments."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class ExpressionPose:
    """The surface of a face in an expression, on the texture of the face at rest."""

    state: str
    """Name of the expression."""
    amount: float
    """Strength, 0 to 1.5."""
    origin: tuple[Mesh, Float32Array]
    """Mesh and relief of the face at rest."""
    lines: expression_wrinkles.WrinkleLines
    """Lines of possible buckling of this person's skin."""
    mesh: Mesh
    """The moved face; the same triangles and texture coordinates."""
    atlas: Atlas
    """Its surface under each texel."""
    wrinkles: expression_wrinkles.Wrinkles
    """Wrinkles where the skin is shortened."""
    height_um: Float32Array
    """Relief at rest and wrinkles, um, shape (N, N)."""
    normal: Float32Array
    """Unit normals of mesh, relief and wrinkles, shape (N, N, 3), rig frame."""
    pressure_mbar: Float32Array
    """Change of the pressure in the skin at each vertex, shape (V,), mbar."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSubject:
    """One face; maps are textures of shape (N, N), row 0 is the top (v = 1)."""

    preset: str
    """Name of the preset of melanin."""
    seed: int
    """Seed of all random draws."""
    mesh: Mesh
    """Geometry in mm, rig frame, facing +z."""
    atlas: Atlas
    """Surface under each texel."""
    melanin: Float32Array
    """Volume fraction of melanosomes in an epidermis of `TissueProperties.melanin_reference_mm`, 0
    to 0.5."""
    perfusion: Perfusion
    """Blood by compartment, with its response to the states."""
    roughness: Float32Array
    """GGX alpha of the surface, 0.15 to 0.5."""
    height_um: Float32Array
    """Pores and wrinkles over the mesh, um."""
    hair: Float32Array
    """Fraction of each texel that brows and lashes cover, 0 to 1."""
    normal: Float32Array
    """Unit normals of mesh and relief, shape (N, N, 3), rig frame."""
    pose: ExpressionPose | None = None
    """Expression of the geometry; ``None`` at rest."""
    rest: SimulatedSubject | None = None
    """The same face at rest; ``None`` for a face that is at rest itself."""
    beard: Float32Array | None = None
    """Amount of stubble below the surface, shape (N, N), 0 to 1; ``None``: none."""
    tissue: TissueProperties = TYPICAL_SKIN
    """Properties of the skin except for melanin and blood."""
    oiliness: float = 1.0
    """Factor of the surface fraction covered by oil."""
    offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Translation of the whole face from its original position, rig frame, see `translate`."""

    @property
    def size(self) -> int:
        """Texels along each side of the maps."""
        return self.atlas.size

    @property
    def thickness_ratio(self) -> Float32Array:
        """Thickness of the epidermis over that between the face's regions, shape (N, N)."""
        return thickness_ratio(self.perfusion.regions, self.tissue.site_contrast)

    def hemoglobin(self, state: str = "neutral") -> Float32Array:
        """Return the blood volume fraction of the dermis in a state, shape (N, N), 0 to 0.32.

        Parameters
        ----------
        state
            One of `rigsim.subject.perfusion.STATE_NAMES`, independent of the pose. An expression
            that the face shows has the amount of its pose, any other is complete.

        Raises
        ------
        rigsim.subject.perfusion.StateError
            The state is unknown.
        """
        return self.perfusion.blood(state, self.tissue_pressure_mbar(state))

    def tissue_pressure_mbar(self, state: str) -> Float32Array | None:
        """Return the change of the pressure in the skin by the strain of an expression.

        Parameters
        ----------
        state
            As for `hemoglobin`.

        Returns
        -------
        ndarray of float32 or None
            Shape (N, N), mbar; 0 off the surface. None for states that do not move the face.
        """
        if state not in expressions.EXPRESSION_STRENGTHS:
            return None
        if self.pose is not None and self.pose.state == state:
            pressure = self.pose.pressure_mbar
        else:
            rest = self.mesh if self.rest is None else self.rest.mesh
            deltas = expressions.displacement_mm(rest, state, seed=self.seed)
            pressure = tissue_pressure.expression_pressure_mbar(
                rest, rest.vertices_mm + deltas, seed=self.seed
            )
        return texture_of_vertices(self.mesh, pressure, self.size)

    def with_expression(self, state: str, amount: float = 1.0) -> SimulatedSubject:
        """Return this face in an expression, with its wrinkles.

        Parameters
        ----------
        state
            One of `rigsim.subject.perfusion.STATE_NAMES`; those that are not expressions do not
            move the face.
        amount
            0 (rest) to 1 (full) and 1.5 (an extreme).

        Returns
        -------
        SimulatedSubject
            The same person with another mesh, atlas, relief and normals; triangles, texture
            coordinates and the skin's composition stay. A posed face is posed from its rest. Its
            blood in this state follows the strain of this pose, see `hemoglobin`.

        Raises
        ------
        rigsim.subject.perfusion.StateError
            The state is unknown.
        rigsim.subject.expressions.ExpressionError
            The amount is out of range.
        """
        if state not in STATE_NAMES:
            raise StateError(f"state: got {state!r}, expected one of {', '.join(STATE_NAMES)}")
        low, high = expressions.AMOUNT_RANGE
        if not low <= amount <= high:
            raise expressions.ExpressionError(f"amount: got {amount}, expected {low:g} to {high}")
        rest = self if self.rest is None else self.rest
        if amount == 0.0 or not expressions.is_moving_state(state):
            return rest
        pose = _pose(rest, state, float(amount))
        return dataclasses.replace(
            rest,
            mesh=pose.mesh,
            atlas=pose.atlas,
            height_um=pose.height_um,
            normal=pose.normal,
            pose=pose,
            rest=rest,
        )

    def translate(self, offset_mm: tuple[float, float, float]) -> SimulatedSubject:
        """Return this face at another position.

        Parameters
        ----------
        offset_mm
            Translation, mm, rig frame; for zero the same object is returned.

        Returns
        -------
        SimulatedSubject
            The same person, in the same pose, with another mesh and atlas; all else stays.

        Raises
        ------
        SubjectError
            The offset is not three finite numbers.
        """
        x, y, z = _validate_offset(offset_mm)
        if (x, y, z) == (0.0, 0.0, 0.0):
            return self
        rest = self if self.rest is None else self.rest
        way = np.array([x, y, z], np.float32)
        there = dataclasses.replace(
            rest,
            mesh=dataclasses.replace(rest.mesh, vertices_mm=rest.mesh.vertices_mm + way),
            atlas=rest.atlas.translate(way),
            offset_mm=(rest.offset_mm[0] + x, rest.offset_mm[1] + y, rest.offset_mm[2] + z),
        )
        return (
            there if self.pose is None else there.with_expression(self.pose.state, self.pose.amount)
        )

    def blend_shapes(self) -> dict[str, Float32Array]:
        """Return each expression's vertex displacements, {state: (V, 3) in mm}, rig frame."""
        rest = self if self.rest is None else self.rest
        return expressions.blend_shapes(rest.mesh, seed=self.seed)

    def tangent_normal(self) -> Float32Array:
        """Return the normals in the texture's frame (`rigsim.subject.relief.tangent_normals`).

        Returns
        -------
        ndarray of float32
            Unit vectors, shape (N, N, 3): relief and wrinkles without the mesh's own curvature.
        """
        return relief.tangent_normals(self.atlas, self.normal)

    def landmarks_mm(self) -> dict[str, tuple[float, float, float]]:
        """Return named points of the mean head, mapped to this face, mm in the rig frame.

        They move with the expression as the nearest skin does.
        """
        rest = self.mesh if self.rest is None else self.rest.mesh
        points = face_regions.from_mean_head(np.array(list(LANDMARKS_MM.values())), rest)
        if self.rest is not None:
            away = np.linalg.norm(points[:, None] - rest.vertices_mm[None], axis=-1)
            nearest = np.argmin(away, axis=1)
            points = points + self.mesh.vertices_mm[nearest] - rest.vertices_mm[nearest]
        return {
            name: (float(x), float(y), float(z))
            for name, (x, y, z) in zip(LANDMARKS_MM, points, strict=True)
        }

    def surface_landmarks(self) -> landmarks.SurfacePoints:
        """Return named points of the skin; `SurfacePoints.positions_on` gives their positions."""
        return landmarks.find_landmarks(self.mesh if self.rest is None else self.rest.mesh)


def _validate_offset(offset_mm: tuple[float, float, float]) -> tuple[float, float, float]:
    given = np.asarray(offset_mm, np.float64)
    if given.shape != (3,) or not np.isfinite(given).all():
        raise SubjectError(f"offset_mm: got {offset_mm!r}, expected three finite numbers")
    return float(given[0]), float(given[1]), float(given[2])


_poses: WeakValueDictionary[tuple[int, int, int, str, float], ExpressionPose] = (
    WeakValueDictionary()
)
"""Poses in use, by their ingredients; a pose holds its origin, so that an id stays that of the
same object."""
_lines: WeakValueDictionary[tuple[int, int, int], expression_wrinkles.WrinkleLines] = (
    WeakValueDictionary()
)
"""Their lines, by the first three of the same."""


def _pose(rest: SimulatedSubject, state: str, amount: float) -> ExpressionPose:
    """Return a pose of a face at rest; the same object as long as any caller holds it."""
    key = (id(rest.mesh), id(rest.height_um), rest.seed, state, amount)
    pose = _poses.get(key)
    if pose is None:
        deltas = expressions.displacement_mm(rest.mesh, state, amount=amount, seed=rest.seed)
        mesh = expressions.displace_mesh(rest.mesh, deltas)
        atlas = unwrap(mesh, rest.size)
        lines = _lines.get(key[:3])
        if lines is None:
            points = face_regions.to_mean_head(rest.atlas.position_mm, rest.mesh)
            lines = expression_wrinkles.draw_wrinkle_lines(
                points, rest.atlas.covered, seed=rest.seed
            )
            _lines[key[:3]] = lines
        wrinkles = expression_wrinkles.form_wrinkles(lines, rest.atlas, atlas)
        height = rest.height_um + wrinkles.height_um
        pose = ExpressionPose(
            state=state,
            amount=amount,
            origin=(rest.mesh, rest.height_um),
            lines=lines,
            mesh=mesh,
            atlas=atlas,
            wrinkles=wrinkles,
            height_um=height,
            normal=relief.relief_normals(atlas, height),
            pressure_mbar=tissue_pressure.expression_pressure_mbar(
                rest.mesh, mesh.vertices_mm, seed=rest.seed
            ),
        )
        _poses[key] = pose
    return pose


def make_subject(
    preset: str = "III",
    *,
    seed: int = 0,
    size: int = 512,
    mesh: Mesh | str | Path | None = None,
    blood: float = 1.0,
) -> SimulatedSubject:
    """Build a face.

    Parameters
    ----------
    preset
        One of `PRESET_NAMES`: skin types I to VI, or "palest" or "darkest".
    seed
        Seed of shape and patterns, >= 0; the same arguments give the same face.
    size
        Texels along each side of the maps, 64 to 8192; a face of 512 has texels of about 0.5 mm.
    mesh
        Geometry in mm, or its file (.npz, .obj), instead of the procedural head; the tip of its
        nose must be its foremost point. The mesh of a file is moved to the rig's center.
    blood
        Factor of all blood, 0.1 to 4.

    Returns
    -------
    SimulatedSubject
        The face with its ground-truth maps.

    Raises
    ------
    SubjectError
        An argument is outside its range.
    rigsim.geometry.mesh.MeshError
        The mesh cannot be used.

    Examples
    --------
    >>> face = make_subject("II", seed=1, size=64)
    >>> face.melanin.shape, sorted(face.landmarks_mm())[:2]
    ((64, 64), ['brow left', 'brow right'])
    """
    if preset not in pigment.MELANIN_PRESETS:
        raise SubjectError(f"preset: got {preset!r}, expected one of {', '.join(PRESET_NAMES)}")
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
        surface = center_face(load_mesh(mesh))
    atlas = unwrap(surface, size)
    points = face_regions.to_mean_head(atlas.position_mm, surface)
    regions = face_regions.region_masks(points)
    height = relief.height_um(points, regions, texel_mm=atlas.typical_texel_mm(), seed=seed)
    melanin = pigment.MELANIN_PRESETS[preset]
    return SimulatedSubject(
        preset=preset,
        seed=seed,
        mesh=surface,
        atlas=atlas,
        melanin=pigment.draw_melanin_map(points, regions, melanin, seed=seed),
        perfusion=draw_perfusion(
            points, regions, pigment.typical_blood(melanin), seed=seed, amount=blood
        ),
        roughness=relief.roughness_map(points, regions, seed=seed),
        height_um=height,
        hair=relief.hair_map(points, seed=seed),
        normal=relief.relief_normals(atlas, height),
    )


@lru_cache(maxsize=4)
def _head(seed: int) -> Mesh:
    return build_head(np.random.default_rng([seed, 0]))


__all__ = ["PRESET_NAMES", "STATE_NAMES", "SimulatedSubject", "SubjectError", "make_subject"]
