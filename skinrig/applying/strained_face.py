"""Strain a square of a simulated face by an expression, on texels of 10 um.

The head's vertices are a regular grid over its texture; cubic splines through them give a smooth
surface at rest and in the expression. The relief is grown at rest at its size on the skin, and
convolved by the strain of the square's mesh (Nagano et al. 2015, doi:10.1145/2766894). Wrinkles of
the expression are omitted, so that images show what the microstructure changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import RectBivariateSpline

from model.displacement_synthesis import growth as displacement_synthesis
from model.microstructure import KernelTable
from model.microstructure.mesh_strain import MeshStrain, strain
from model.microstructure.strain_fields import TextureStrain
from rigsim.geometry.mesh import Mesh
from rigsim.subject.expressions import displacement_mm
from rigsim.subject.head import build_head
from skinrig.applying.microstructure import convolve_by_strain
from skinrig.arrays import Float32Array, Float64Array, Int64Array
from skinrig.errors import UnusableError

STRAIN_DIVISIONS: Final = 40
"""Cells of the square's mesh along each side, 0.5 mm each."""


@dataclass(frozen=True, slots=True)
class FaceView:
    """A square of the mean face, and the expression that strains it.

    Attributes
    ----------
    name
        Region and expression, for titles.
    center_mm
        Middle of the square on the mean head, mm, rig frame.
    expression
        Name of a state that moves the face.
    amount
        Strength of the expression; 1 is the full one.
    """

    name: str
    center_mm: tuple[float, float, float]
    expression: str
    amount: float = 1.0


FACE_VIEWS: Final[Mapping[str, FaceView]] = {
    "figure-1": FaceView("forehead, anger", (6.0, 50.0, 5.0), "anger"),
    "figure-15": FaceView("cheek, happiness", (39.8, -25.8, -3.4), "happiness"),
    "figure-16": FaceView("eye corner, surprise", (59.7, 27.6, -25.7), "surprise"),
}
"""Views by figure of the paper, whose expressions are not named in numbers; these are ours."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceCrop:
    """A square of skin at rest and under strain; maps are (N, N), row 0 is the top.

    Attributes
    ----------
    rest_mm, deformed_mm : ndarray, shape (N, N, 3)
        Smooth surface without relief.
    pixel_um : ndarray, shape (N, N)
        Side of the texels on the skin at rest, um.
    strain : MeshStrain
        Strain at the vertices of the square's mesh.
    faces, uv : ndarray
        Triangles and texture coordinates of that mesh.
    """

    rest_mm: Float64Array
    deformed_mm: Float64Array
    pixel_um: Float64Array
    strain: MeshStrain
    faces: Int64Array
    uv: Float64Array

    def grow_relief(
        self, patch_um: Float32Array, *, patch_pixel_um: float, rng: np.random.Generator
    ) -> Float32Array:
        """Grow a patch over the square at rest, at its scale on the skin, (N, N) um."""
        return displacement_synthesis.grow(
            [patch_um],
            len(self.rest_mm),
            rng=rng,
            pixel_um=self.pixel_um,
            patch_pixel_um=patch_pixel_um,
        )

    def convolve(
        self, height_um: Float32Array, *, table: KernelTable
    ) -> tuple[Float32Array, TextureStrain]:
        """Return the relief under strain, and the strain per texel."""
        return convolve_by_strain(height_um, self.strain, self.faces, self.uv, table)

    def slope_variances(
        self, height_um: Float32Array, field: TextureStrain, *, deformed: bool = True
    ) -> tuple[float, float]:
        """Return the variances of the relief's slopes along s and t, on the deformed skin."""
        down, right = (np.asarray(part, np.float64) for part in np.gradient(height_um))
        along = field.axes[..., 0] * right[..., None] + field.axes[..., 1] * down[..., None]
        length = field.stretch if deformed else np.ones_like(field.stretch)
        slopes = 1e-3 * along * field.px_per_mm / length
        along_s, along_t = slopes[field.covered].var(axis=0).tolist()
        return along_s, along_t


def crop_face(view: FaceView, *, side_mm: float, texels: int, seed: int = 0) -> FaceCrop:
    """Cut a square out of a simulated head, at rest and in an expression.

    Parameters
    ----------
    view
        Place and expression.
    side_mm
        Side of the square on the skin at rest, mm, > 0.
    texels
        Texels along each side, 32 to 4096.
    seed
        Seed of the head's shape, >= 0.

    Raises
    ------
    UnusableError
        For a square that exceeds the head's texture, or too few or many texels.
    """
    if not 32 <= texels <= 4096:
        raise UnusableError(f"texels: got {texels}, expected 32 to 4096")
    head = build_head(np.random.default_rng(seed))
    moved = head.vertices_mm + displacement_mm(head, view.expression, amount=view.amount, seed=seed)
    rest, bent = (_splines(head, points) for points in (head.vertices_mm, moved))
    middle = head.uv[np.argmin(((head.vertices_mm - view.center_mm) ** 2).sum(axis=1))]
    per_u, per_v = (
        np.linalg.norm([one(middle[1], middle[0], **{way: 1})[0, 0] for one in rest])
        for way in ("dy", "dx")
    )
    half_u, half_v = 0.5 * side_mm / per_u, 0.5 * side_mm / per_v
    low = middle - np.array([half_u, half_v])
    span = 2.0 * np.array([half_u, half_v])
    if low.min() < 0.0 or (low + span).max() > 1.0:
        raise UnusableError(f"side_mm: got {side_mm}, which exceeds the head's texture; reduce it")
    at = (np.arange(texels) + 0.5) / texels
    columns, rows = low[0] + span[0] * at, low[1] + span[1] * at
    rest_mm, deformed_mm = (_evaluate(one, rows, columns) for one in (rest, bent))
    across = np.cross(*_tangents(rest_mm))
    nodes = np.linspace(0.0, 1.0, STRAIN_DIVISIONS + 1)
    where = (low[1] + span[1] * nodes, low[0] + span[0] * nodes)
    coarse = [_evaluate(one, *where)[::-1].reshape(-1, 3) for one in (rest, bent)]
    u, v = (part.reshape(-1) for part in np.meshgrid(nodes, nodes))
    uv = np.stack([u, v], axis=1)
    faces = _grid_triangles(STRAIN_DIVISIONS)
    return FaceCrop(
        rest_mm,
        deformed_mm,
        1e3 * np.sqrt(np.linalg.norm(across, axis=-1)),
        strain(coarse[0], coarse[1], faces, uv),
        faces,
        uv,
    )


def _splines(head: Mesh, points_mm: Float32Array) -> list[RectBivariateSpline]:
    """Return splines of x, y, z over v and u of a head, whose vertices are a grid."""
    u, v = (np.unique(head.uv[:, k]) for k in (0, 1))
    grid = points_mm.reshape(len(v), len(u), 3)
    return [RectBivariateSpline(v, u, grid[..., k]) for k in range(3)]


def _evaluate(
    splines: list[RectBivariateSpline], rows: Float64Array, columns: Float64Array
) -> Float64Array:
    """Return points at ascending v and u, (rows, columns, 3), row 0 at the largest v."""
    return np.stack([one(rows, columns)[::-1] for one in splines], axis=-1)


def _tangents(points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the steps to the right and up, per texel."""
    down, right = (np.asarray(part) for part in np.gradient(points, axis=(0, 1)))
    return right, -down


def surface_normals(points: Float64Array) -> Float64Array:
    """Return outward unit normals of a grid of points, (N, N, 3), row 0 at the top."""
    across = np.cross(*_tangents(points))
    return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))


def _grid_triangles(divisions: int) -> Int64Array:
    row = np.arange(divisions)
    first = (row[:, None] * (divisions + 1) + row).reshape(-1)
    a, b, c = first, first + 1, first + divisions + 1
    return np.concatenate([np.stack([a, b, c + 1], 1), np.stack([a, c + 1, c], 1)])
