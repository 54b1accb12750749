"""Stiffness of a template's displacement: energies of bending and stretch, as sparse matrices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from reconstruction.arrays import Float64Array
from reconstruction.scan.face_template import vertex_areas_mm2
from reconstruction.scan.repair import TriangleMesh, directed_edges

MIN_RING: Final = 5
"""Number of neighbors below which a vertex also uses their neighbors: an affine map has three
derivatives."""
RING_RIDGE: Final = 0.05
"""Thickness of a ring, relative to its radius, below which displacements are not fitted across it.
"""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceStiffness:
    """Residuals of displacements whose squares are the energies of a surface.

    An affine map of the surface has no bending energy: sizes and proportions of heads are free.
    """

    bending: sparse.csr_matrix
    """Residuals of bending, 1/mm for displacements in mm, shape (R, V)."""
    vertex: Float64Array
    """Vertex of each residual, shape (R,)."""
    stretch: sparse.csr_matrix
    """Differences of displacements along edges, shape (E, V)."""

    def matrix(
        self, length_mm: float, stretch_fraction: float, factor: Float64Array
    ) -> sparse.csc_matrix:
        """Return the matrix of the energy, shape (V, V), mm^2.

        Parameters
        ----------
        length_mm
            Wavelength over 2 pi below which displacements across the surface are suppressed.
        stretch_fraction
            Weight of stretch relative to bending of this wavelength.
        factor
            Local factor of the bending, shape (V,).
        """
        weighted = sparse.diags(factor[self.vertex]) @ self.bending
        bending = length_mm**4 * (self.bending.T @ weighted)
        return (bending + stretch_fraction * length_mm**2 * (self.stretch.T @ self.stretch)).tocsc()


def surface_stiffness(mesh: TriangleMesh) -> SurfaceStiffness:
    """Return the stiffness of a welded surface.

    At each vertex, the displacements of its neighbors relative to its own are fitted by a linear
    map of the neighbors' positions. What remains is bending: for a displacement c x^2 / 2 over a
    plane of regular triangles, the sum of the squared residuals is 3/8 c^2 times the area.

    Parameters
    ----------
    mesh : TriangleMesh

    Returns
    -------
    SurfaceStiffness
    """
    count, points = len(mesh.vertices_mm), mesh.vertices_mm
    edges = np.unique(np.sort(directed_edges(mesh.faces), axis=1), axis=0)
    ones = np.ones(2 * len(edges))
    ends = np.concatenate([edges, edges[:, ::-1]])
    joined = sparse.csr_matrix((ones, (ends[:, 0], ends[:, 1])), (count, count))
    wider = (joined @ joined + joined).tolil()
    wider.setdiag(0)
    wide = wider.tocsr()
    wide.eliminate_zeros()
    area = vertex_areas_mm2(mesh)
    size = np.diff(joined.indptr)
    rings = [(joined if size[i] >= MIN_RING else wide)[i].indices for i in range(count)]
    rows, columns, values, owners, first = [], [], [], [], 0
    for k in np.unique([len(ring) for ring in rings]).tolist():
        here = np.array([i for i, ring in enumerate(rings) if len(ring) == k])
        if not k:
            continue
        near = np.array([rings[i] for i in here])  # (N, k)
        x = points[near] - points[here][:, None]
        radius2 = np.mean(np.sum(x * x, axis=-1), axis=1)
        gram = np.einsum("nkc,nkd->ncd", x, x)
        gram += (RING_RIDGE**2 * radius2 * k / 2)[:, None, None] * np.eye(3)
        keep = np.eye(k) - x @ np.linalg.solve(gram, np.swapaxes(x, 1, 2))
        scale = np.sqrt(4.0 * area[here] / k) / radius2
        entries = np.concatenate([keep, -keep.sum(axis=2, keepdims=True)], axis=2)
        index = np.concatenate([near, here[:, None]], axis=1)
        row = first + np.arange(len(here) * k).reshape(len(here), k)
        rows.append(np.broadcast_to(row[..., None], entries.shape).ravel())
        columns.append(np.broadcast_to(index[:, None], entries.shape).ravel())
        values.append((scale[:, None, None] * entries).ravel())
        owners.append(np.repeat(here, k))
        first += row.size
    where = np.concatenate(rows), np.concatenate(columns)
    bending = sparse.csr_matrix((np.concatenate(values), where), (first, count))
    number = np.arange(len(edges))
    stretch = sparse.csr_matrix(
        (
            np.concatenate([np.ones(len(edges)), -np.ones(len(edges))]),
            (np.concatenate([number, number]), edges.T.ravel()),
        ),
        (len(edges), count),
    )
    return SurfaceStiffness(bending, np.concatenate(owners), stretch)
