"""Simulate a block of skin pushed by a probe; its surface strain drives microstructure.

The patch of Nagano et al. 2015, fig. 14 (doi:10.1145/2766894): a coarse finite-element mesh yields
shape and strain of the surface; convolution of the displacement map yields relief of 10 um pixels.

The tissue is a compressible neo-Hookean solid with the energy
``mu / 2 (|F|^2 - 3 - 2 ln J) + lambda / 2 (ln J)^2`` per neutral volume, for large deformations;
for small ones it is linear elasticity. Pressure ``p = lambda ln J`` is a field of its own on MINI
elements (Arnold, Brezzi and Fortin 1984, doi:10.1007/BF02576171), which do not lock as Poisson's
ratio approaches 1/2. Only displacements are evaluated, so the shear modulus cancels and Poisson's
ratio is the only material constant. Newton's method solves the push in steps; scikit-fem (optional
part ``fem``) supplies the elements.

Axes: x to the right and y up on the skin, z out of it; mm; the block's surface is z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike
from scipy.sparse.linalg import LinearOperator, norm, onenormest, splu

from model import microstructure
from model.microstructure import FOREHEAD, KernelTable, MeshStrain, strain_fields
from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome
from skinrig.applying.microstructure import convolve_by_strain
from skinrig.arrays import Float32Array, Float64Array, Int64Array
from skinrig.errors import MissingExtra

BLOCK_DIVISIONS = (23, 23, 8)
"""Cells along x, y, z, six tetrahedra each: 25,392, about the number of the paper's mesh."""
MAX_NEWTON_ITERATIONS = 30
MIN_PUSH_STEP = 1.0 / 64.0
"""Minimum step, fraction of the push; if it does not converge, the search ends."""
RELATIVE_MOVE_TOL = 1e-7
"""Convergence limit of the last correction of the displacement, fraction of the block's width."""


class PushError(ValueError):
    """Invalid block or push."""


class PushDiverged(PushError, ArithmeticError):
    """Newton's method did not converge: the push is too large for the mesh."""


@dataclass(frozen=True, slots=True)
class SkinBlock:
    """A block of tissue, fixed at its bottom and its sides."""

    width_mm: float = 10.0
    """Side of its square surface, mm, > 0."""
    depth_mm: float = 4.0
    """Thickness, mm, > 0."""
    poisson: float = 0.49
    """Poisson's ratio, 0.01 to 0.5; 0.5 is incompressible."""
    divisions: tuple[int, int, int] = BLOCK_DIVISIONS
    """Cells along x, y and z, six tetrahedra each."""

    def __post_init__(self) -> None:
        for name in ("width_mm", "depth_mm"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise PushError(f"{name}: got {getattr(self, name)}, expected above 0")
        if not 0.01 <= self.poisson <= 0.5:
            raise PushError(f"poisson: got {self.poisson}, expected 0.01 to 0.5")
        if len(self.divisions) != 3 or not all(1 <= n <= 64 for n in self.divisions):
            raise PushError(f"divisions: got {self.divisions}, expected three of 1...64")

    @property
    def inverse_lame_lambda(self) -> float:
        """Inverse of Lamé's first parameter for a shear modulus of 1."""
        return (1.0 - 2.0 * self.poisson) / (2.0 * self.poisson)


@dataclass(frozen=True, slots=True)
class Push:
    """A probe with a spherical tip that adheres to the skin and moves it."""

    contact_mm: float = 1.2
    """Radius of the contact area, mm, > 0."""
    tip_mm: float = 4.0
    """Radius of the tip, mm, >= ``contact_mm``."""
    depth_mm: float = 0.8
    """Indentation of the tip's lowest point, mm; negative: pull."""
    shift_mm: tuple[float, float] = (0.8, 0.0)
    """Displacement of the tip along x and y, mm."""
    center_mm: tuple[float, float] = (0.0, 0.0)
    """Center of the contact along x and y, mm from the center of the block."""

    def __post_init__(self) -> None:
        if not 0 < self.contact_mm <= self.tip_mm < math.inf:
            raise PushError(
                f"contact_mm, tip_mm: got {self.contact_mm}, {self.tip_mm}, "
                "expected 0 < contact <= tip"
            )
        if not np.isfinite([self.depth_mm, *self.shift_mm, *self.center_mm]).all():
            raise PushError(
                "depth_mm, shift_mm, center_mm: got NaN or infinity, expected finite numbers"
            )


@dataclass(frozen=True, slots=True, eq=False)
class PushedPatch:
    """Equilibrium of a pushed block."""

    rest_mm: Float64Array
    """(V, 3) node positions before the push."""
    deformed_mm: Float64Array
    """(V, 3) node positions after the push."""
    tetrahedra: Int64Array
    """(T, 4) node indices."""
    surface: Int64Array
    """(F, 3) node indices of the triangles at z = 0, counterclockwise from outside."""
    width_mm: float
    """Side of the surface, mm."""
    outcome: SolverOutcome
    """All Newton iterations; the last one's largest move, mm, and condition number (1-norm)."""

    @property
    def uv(self) -> Float64Array:
        """(V, 2) texture coordinates of the nodes: u to the right, v up, 0 to 1."""
        return self.rest_mm[:, :2] / self.width_mm + 0.5

    @property
    def volume_ratio(self) -> float:
        """Ratio of the total volume after the push to that before."""
        after, before = (self._volumes(nodes) for nodes in (self.deformed_mm, self.rest_mm))
        return float(after.sum() / before.sum())

    def _volumes(self, nodes: Float64Array) -> Float64Array:
        corner = nodes[self.tetrahedra]
        return np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) / 6.0

    def strain(self) -> MeshStrain:
        """Return the strain of the surface, on the nodes of the whole mesh."""
        return microstructure.strain(self.rest_mm, self.deformed_mm, self.surface, self.uv)

    def convolve(
        self, height_um: ArrayLike, *, table: KernelTable = FOREHEAD
    ) -> tuple[Float32Array, strain_fields.TextureStrain]:
        """Convolve a displacement map of the surface by the strain of the push.

        Parameters
        ----------
        height_um : array_like, shape (N, N)
            Neutral displacement of the whole surface, um; row 0 is the +y side.
        table : KernelTable
            Kernels over stretch; default: the paper's forehead.

        Returns
        -------
        height_um : ndarray of float32, shape (N, N)
        strain : model.microstructure.strain_fields.TextureStrain
            Stretch ratios and axes per pixel.
        """
        height = np.asarray(height_um, np.float32)
        if height.ndim != 2 or height.shape[0] != height.shape[1]:
            raise PushError(f"height_um: got shape {height.shape}, expected (N, N)")
        return convolve_by_strain(height, self.strain(), self.surface, self.uv, table)


def push_block(block: SkinBlock, probe: Push, *, steps: int = 2) -> PushedPatch:
    """Compute the equilibrium of a pushed block of skin.

    Parameters
    ----------
    block : SkinBlock
    probe : Push
    steps : int
        Number of increments of the push; an increment that does not converge is halved.

    Returns
    -------
    PushedPatch

    Raises
    ------
    PushError
        If the contact area is not within the block's edges.
    PushDiverged
        If no equilibrium is found.
    skinrig.errors.MissingExtra
        If scikit-fem, the optional part ``fem``, is not installed.
    """
    mesh = _mesh(block)
    nodes = mesh.p.T
    away = nodes[:, :2] - np.asarray(probe.center_mm)
    distance = np.hypot(away[:, 0], away[:, 1])
    half = 0.5 * block.width_mm
    touched = (nodes[:, 2] > -1e-9) & (distance <= probe.contact_mm + 1e-9)
    edge = (np.abs(nodes[:, :2]) > half - 1e-9).any(axis=1)
    held = (nodes[:, 2] < 1e-9 - block.depth_mm) | edge
    if not touched.any() or (touched & held).any():
        raise PushError(
            "center_mm, contact_mm: expected a contact within the block's edges with at least one "
            "surface node; enlarge it or move it inwards"
        )
    given = np.full(nodes.shape, np.nan)
    given[held] = 0.0
    given[touched, :2] = probe.shift_mm
    given[touched, 2] = (
        probe.tip_mm - np.sqrt(probe.tip_mm**2 - distance[touched] ** 2) - probe.depth_mm
    )
    return solve_equilibrium(block, given, steps=steps)


def solve_equilibrium(block: SkinBlock, given_mm: ArrayLike, *, steps: int = 2) -> PushedPatch:
    """Compute the equilibrium of a block with prescribed displacements of some nodes.

    Parameters
    ----------
    block : SkinBlock
    given_mm : array_like, shape (V, 3)
        Displacements of the nodes (those of ``solve_equilibrium(...).rest_mm``), mm; NaN: free.
    steps : int
        Number of increments of the displacements, >= 1.

    Raises
    ------
    PushError, PushDiverged, skinrig.errors.MissingExtra
        See :func:`push_block`.
    """
    tissue = _Tissue(block)
    given = np.asarray(given_mm, np.float64)
    if given.shape != tissue.nodes.shape:
        raise PushError(f"given_mm: got shape {given.shape}, expected {tissue.nodes.shape}")
    if np.isinf(given).any() or np.isnan(given).all():
        raise PushError("given_mm: expected finite displacements of some nodes")
    if not 1 <= steps <= 1000:
        raise PushError(f"steps: got {steps}, expected 1...1000")
    state = tissue.neutral()
    reached, step, iterations = 0.0, 1.0 / steps, 0
    while reached < 1.0 - 1e-12:
        target = min(1.0, reached + step)
        found, end = tissue.find_equilibrium(state, given * target)
        iterations += end.iterations
        if found is None:
            step *= 0.5
            if step < MIN_PUSH_STEP / steps:
                raise PushDiverged(
                    f"push: found no equilibrium beyond {100 * reached:.0f} % of it in "
                    f"{iterations} iterations (last move {end.residual:.2g} mm, {end.stop}), "
                    "expected convergence; use a smaller push, a finer mesh or a wider contact"
                )
        else:
            state, reached = found, target
    return PushedPatch(
        rest_mm=tissue.nodes,
        deformed_mm=tissue.nodes + state.nodes_mm,
        tetrahedra=tissue.corners,
        surface=_surface(tissue.mesh),
        width_mm=block.width_mm,
        outcome=replace(end, iterations=iterations),
    )


def _fem() -> Any:
    try:
        import skfem
    except ImportError as error:
        raise MissingExtra("a pushed patch of skin", "fem") from error
    return skfem


def _mesh(block: SkinBlock) -> Any:
    half = 0.5 * block.width_mm
    nx, ny, nz = block.divisions
    return _fem().MeshTet.init_tensor(
        np.linspace(-half, half, nx + 1),
        np.linspace(-half, half, ny + 1),
        np.linspace(-block.depth_mm, 0.0, nz + 1),
    )


def _surface(mesh: Any) -> Int64Array:
    """Return the triangles at z = 0, counterclockwise from outside."""
    facets = mesh.facets.T
    faces = np.asarray(facets[(mesh.p[2][facets] > -1e-9).all(axis=1)], np.int64)
    a, b, c = (mesh.p[:2, faces[:, k]].T for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces[turn < 0] = faces[turn < 0][:, ::-1]
    return faces


class _Tissue:
    """Forces and stiffness of one block; bubbles of MINI elements are eliminated per element.

    The unknowns of an element are the displacements of its 4 corners and its bubble, (5, 3), and
    the pressure at its corners, (4,), for a shear modulus of 1.
    """

    def __init__(self, block: SkinBlock) -> None:
        fem = _fem()
        self.mesh = _mesh(block)
        self.nodes = np.ascontiguousarray(self.mesh.p.T)
        self.corners = np.ascontiguousarray(self.mesh.t.T, np.int64)
        self.inverse_lambda = block.inverse_lame_lambda
        self.tolerance_mm = RELATIVE_MOVE_TOL * block.width_mm
        bubble = fem.Basis(self.mesh, fem.ElementTetMini(), intorder=5)
        linear = bubble.with_element(fem.ElementTetP1())
        # (T, Q, 5, 3) gradients, (Q, 4) values, (T, Q) weights
        self.gradients = np.stack([b[0].grad for b in bubble.basis]).transpose(2, 3, 0, 1).copy()
        self.values = np.stack([np.asarray(b[0])[0] for b in linear.basis], axis=1)
        self.weights = np.asarray(bubble.dx)
        count = len(self.nodes)
        self.places = np.concatenate(
            [
                (3 * self.corners[:, :, None] + np.arange(3)).reshape(-1, 12),
                3 * count + self.corners,
            ],
            axis=1,
        )

    def neutral(self) -> _State:
        """Return the state without displacement and pressure."""
        return _State(
            np.zeros_like(self.nodes), np.zeros((len(self.corners), 3)), np.zeros(len(self.nodes))
        )

    def find_equilibrium(
        self, start: _State, displacement_mm: Float64Array
    ) -> tuple[_State | None, SolverOutcome]:
        """Return the equilibrium with given displacements, or None; and how the search ended."""
        known = np.isfinite(displacement_mm)
        free = np.concatenate([~known.reshape(-1), np.ones(len(self.nodes), bool)])
        first = np.zeros(free.size)
        first[: -len(self.nodes)][known.reshape(-1)] = (displacement_mm - start.nodes_mm)[known]
        state, move = start, math.inf
        for count in range(1, MAX_NEWTON_ITERATIONS + 1):
            system = self._system(state)
            if system is None:
                return None, SolverOutcome(count, move, UNKNOWN_CONDITION, "stalled")
            matrix, force, bubbles = system
            step = first if count == 1 else np.zeros(free.size)
            right = -force - matrix @ step
            inner = matrix[free][:, free].tocsc()
            step = step.copy()
            factors = splu(
                inner,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.01,
                options={"SymmetricMode": True},
            )
            step[free] = factors.solve(right[free])
            moves = step[: 3 * len(self.nodes)].reshape(-1, 3)
            local = step[self.places]
            by_bubble, own = bubbles
            state = _State(
                state.nodes_mm + moves,
                state.bubbles_mm - own - (by_bubble @ local[..., None])[..., 0],
                state.pressure + step[3 * len(self.nodes) :],
            )
            move = float(np.abs(moves).max())
            if not np.isfinite(step).all():
                return None, SolverOutcome(count, move, UNKNOWN_CONDITION, "stalled")
            if move < self.tolerance_mm:
                inverse = LinearOperator(
                    inner.shape, factors.solve, partial(factors.solve, trans="T"), dtype=np.float64
                )
                condition = float(norm(inner, 1) * onenormest(inverse, t=1))
                return state, SolverOutcome(count, move, condition, "tolerance")
        return None, SolverOutcome(MAX_NEWTON_ITERATIONS, move, UNKNOWN_CONDITION, "limit")

    def _system(
        self, state: _State
    ) -> tuple[Any, Float64Array, tuple[Float64Array, Float64Array]] | None:
        """Return stiffness, forces and bubble elimination; None if an element is inverted.

        The energy is mu / 2 (|F|^2 - 2 ln J) + p ln J - p^2 / (2 lambda) with mu = 1. With
        G the gradients on the neutral block and H = G F^-1 those on the deformed block, its first
        derivative is the force ``F G - (1 - p) H``. As dH = -H dF F^-1, its second derivative is
        the stiffness ``G.G + (1 - p) H H`` with both indices exchanged.
        """
        moves = np.concatenate([state.nodes_mm[self.corners], state.bubbles_mm[:, None]], axis=1)
        deformation = moves.transpose(0, 2, 1)[:, None] @ self.gradients + np.eye(3)
        ratio, inverse = _invert_matrices(deformation)
        if not (ratio > 0).all():
            return None
        spatial = self.gradients @ inverse
        pressure = state.pressure[self.corners] @ self.values.T
        elements, points = self.weights.shape
        less = self.weights * (1.0 - pressure)
        flat = spatial.reshape(elements, points, 15)
        plain = self.gradients.transpose(0, 2, 1, 3).reshape(elements, 5, -1)
        weighed = (self.gradients * self.weights[..., None, None]).transpose(0, 2, 1, 3)
        weighed = weighed.reshape(elements, 5, -1)
        turned = deformation.transpose(0, 1, 3, 2).reshape(elements, -1, 3)
        force_u = (weighed @ turned).reshape(elements, 15)
        force_u -= (less[:, None] @ flat)[:, 0]
        crossed = (flat.transpose(0, 2, 1) * less[:, None]) @ flat
        stiff = np.ascontiguousarray(crossed.reshape(elements, 5, 3, 5, 3).transpose(0, 1, 4, 3, 2))
        along = weighed @ plain.transpose(0, 2, 1)
        for axis in range(3):
            stiff[:, :, axis, :, axis] += along
        tested = self.weights[..., None] * self.values
        coupling = tested.transpose(0, 2, 1) @ flat
        mass = tested.transpose(0, 2, 1) @ self.values
        excess = np.log(ratio) - self.inverse_lambda * pressure
        force_p = (excess[:, None] @ tested)[:, 0]
        # rows of an element: 12 displacements of corners, 3 of the bubble, 4 pressures
        matrix = np.zeros((elements, 19, 19))
        matrix[:, :15, :15] = stiff.reshape(elements, 15, 15)
        matrix[:, 15:, :15] = coupling
        matrix[:, :15, 15:] = coupling.transpose(0, 2, 1)
        matrix[:, 15:, 15:] = -self.inverse_lambda * mass
        force = np.concatenate([force_u, force_p], axis=1)
        kept = np.r_[0:12, 15:19]
        inside = np.linalg.inv(matrix[:, 12:15, 12:15])
        follows = inside @ matrix[:, 12:15][:, :, kept]
        own = (inside @ force[:, 12:15, None])[..., 0]
        outer = matrix[:, kept][:, :, 12:15]
        small = matrix[:, kept][:, :, kept] - outer @ follows
        push = force[:, kept] - (outer @ own[..., None])[..., 0]
        size = 4 * len(self.nodes)
        rows = np.repeat(self.places, 16, axis=1).reshape(-1)
        columns = np.tile(self.places, (1, 16)).reshape(-1)
        whole = sparse.coo_matrix((small.reshape(-1), (rows, columns)), shape=(size, size))
        total = np.bincount(self.places.reshape(-1), push.reshape(-1), minlength=size)
        return whole.tocsr(), np.asarray(total, np.float64), (follows, own)


def _invert_matrices(matrices: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return determinants and inverses of (..., 3, 3) matrices from cross products of rows."""
    a, b, c = (matrices[..., row, :] for row in range(3))
    columns = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    ratio = np.einsum("...i,...i->...", a, columns[..., 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        return ratio, columns / ratio[..., None, None]


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Displacements of nodes (V, 3) and bubbles (T, 3), mm; pressure (V,) per shear modulus."""

    nodes_mm: Float64Array
    bubbles_mm: Float64Array
    pressure: Float64Array
