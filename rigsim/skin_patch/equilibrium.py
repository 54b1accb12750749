"""Find the equilibrium of a stiff layer with relief on a stretched soft half-space.

The layer is a shell over material coordinates X: a node moves to x = F X + u(X) in the plane and to
the height w(X). Its energy against the neutral state (u = 0, F = 1, w = h) is

* stretching: an incompressible neo-Hookean membrane, geometrically nonlinear in slopes and strains,
  against the metric of the neutral relief;
* bending: (Laplacian of w - h)^2 in material coordinates (Koiter's shell for moderate slopes).

The tissue below is a compressible neo-Hookean half-space. Under F its free surface rises by the
factor z, so that without a layer the relief would be z h; deviations from that and from the
affine stretch cost the energy of a linear elastic half-space (Johnson 1985, "Contact Mechanics",
ch. 2; doi:10.1017/CBO9781139171731), at the wave vectors of the stretched surface. Because the
surface is tilted, the stress of the stretched tissue pulls on it with -P grad h (P the nominal
in-plane stress): ridges follow a stretch less than grooves do.

Unit of energy: modulus E of the tissue times um; of length: um. Not modeled: the anisotropy of
stretched tissue (it softens towards Biot's instability at r = 0.54), contact of a groove's walls,
layers below the half-space's first.
"""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numba import get_num_threads, set_num_threads
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import brentq

from rigsim.arrays import ComplexArray, Float32Array, Float64Array
from rigsim.skin_patch.stretch_kernels import (
    add_bending_forces,
    add_membrane_forces,
    add_tissue_forces,
    find_least_area,
    gather_coefficient_forces,
    rotate_coefficients,
)

Pairs = deque[tuple[Float32Array, Float32Array, float]]


SQUEEZED_DEPTH_UM: Final = 10.0
"""Depth of tissue that resists the compression of a groove beyond the linear half-space, um. As in
a compressible neo-Hookean solid, -log J keeps neighboring points from changing sides; this
project's choice, small against the wavelengths of the relief."""


MIN_PARALLEL_NODES: Final = 400_000
"""Patches with fewer nodes use one thread."""


class EquilibriumError(RuntimeError):
    """Error for an equilibrium that was not reached within the allowed steps."""


def surface_rise_factor(stretch_s: float, stretch_t: float, poisson: float) -> float:
    """Return the factor by which the free surface of stretched tissue rises.

    Parameters
    ----------
    stretch_s, stretch_t
        Principal stretches in the plane, > 0.
    poisson
        Poisson's ratio of the tissue, 0 to 0.5; at 0.5 its volume is constant and the result is 1 /
        (s t).

    Examples
    --------
    >>> round(surface_rise_factor(1.25, 0.8944, 0.5), 3)
    0.894
    >>> surface_rise_factor(1.25, 0.8944, 0.0)
    1.0
    """
    area = stretch_s * stretch_t
    if poisson > 0.4999:
        return 1.0 / area
    lame = 2.0 * poisson / (1.0 - 2.0 * poisson)
    if lame == 0.0 or area == 1.0:
        return 1.0
    # free surface of a compressible neo-Hookean solid: z^2 - 1 + (lambda / mu) log J = 0, J = s t z
    low, high = min(1.0, 1.0 / area), max(1.0, 1.0 / area)
    return float(brentq(lambda z: z * z - 1.0 + lame * np.log(area * z), low, high, xtol=1e-13))


@dataclass(frozen=True, slots=True)
class Convergence:
    """Convergence history of a search that reached its tolerance; entries of the tuples correspond.

    A search that stalls or reaches its limit raises `EquilibriumError` with steps, residual,
    condition and reason.
    """

    evaluations: int
    residual: float
    """Norm of the out-of-balance force over that of the affine state, preconditioned."""
    condition: float
    """Largest over smallest curvature along the steps, a lower bound; NaN without a step."""
    energies: tuple[float, ...] = field(repr=False)
    """Mean energy per area after each step, the affine state first."""
    residuals: tuple[float, ...] = field(repr=False)


@dataclass(eq=False)
class LayerProblem:
    """Energy of a layer on a periodic patch, rows growing with y."""

    neutral_um: Float64Array
    """Height in the neutral state, (N, M), both even."""
    membrane_um: Float64Array
    """Shear modulus of the layer times its thickness over E, um, (N, M)."""
    bending_um3: Float64Array
    """Bending stiffness of the layer over E, um^3, (N, M)."""
    texel_um: float
    gradient: Float64Array
    """Mean deformation gradient F, (2, 2)."""
    poisson: float
    """Of the tissue, 0 to 0.5."""

    def __post_init__(self) -> None:
        shape = self.neutral_um.shape
        if len(shape) != 2 or shape[0] % 2 or shape[1] % 2:
            raise ValueError(f"neutral_um: got shape {shape}, expected two even sides")
        if np.linalg.det(self.gradient) <= 0.0:
            raise ValueError("gradient: expected a positive determinant")
        self._moment = np.empty(shape)
        # Small patches are quicker without waiting for other threads.
        self._workers = (
            1 if self.neutral_um.size < MIN_PARALLEL_NODES else min(2, get_num_threads())
        )
        left, stretches, right = np.linalg.svd(self.gradient)
        # factor by which a relief without a layer rises
        self.rise = surface_rise_factor(float(stretches[0]), float(stretches[1]), self.poisson)
        shear = 0.5 / (1.0 + self.poisson)
        self._bulk = shear * SQUEEZED_DEPTH_UM
        nominal = shear * (stretches - self.rise**2 / stretches)
        pull = (left * nominal) @ right
        h = self.neutral_um
        slope_x = (np.roll(h, -1, 1) - np.roll(h, 1, 1)) / (2.0 * self.texel_um)
        slope_y = (np.roll(h, -1, 0) - np.roll(h, 1, 0)) / (2.0 * self.texel_um)
        self._traction = np.stack(
            [pull[axis, 0] * slope_x + pull[axis, 1] * slope_y for axis in range(2)]
        )
        self._prepare(shear)

    def _prepare(self, shear: float) -> None:
        rows, columns = self.neutral_um.shape
        ky = 2.0 * np.pi / self.texel_um * np.fft.fftfreq(rows)[:, None]
        kx = 2.0 * np.pi / self.texel_um * np.fft.rfftfreq(columns)[None, :]
        kx, ky = np.broadcast_arrays(kx, ky)
        inverse = np.linalg.inv(self.gradient)
        area = float(np.linalg.det(self.gradient))
        # Wave vector on the stretched surface, k = F^-T K: the half-space deforms at this
        # wavelength.
        sx = inverse[0, 0] * kx + inverse[1, 0] * ky
        sy = inverse[0, 1] * kx + inverse[1, 1] * ky
        s = np.hypot(sx, sy)
        live = s > 0.0
        live[rows // 2, :] = False
        live[:, columns // 2] = False
        safe = np.where(live, s, 1.0)
        ux, uy = sx / safe, sy / safe
        nu = self.poisson
        normal = area * 4.0 * (1.0 - nu) * shear / (3.0 - 4.0 * nu) * s
        mixed = area * 2.0 * (1.0 - 2.0 * nu) * shear / (3.0 - 4.0 * nu) * s
        across = area * shear * s
        for stiffness in (normal, mixed, across):
            stiffness[~live] = 0.0
        # Preconditioner: the layer's stiffness about the affine state, by the grid's own symbols.
        h = self.texel_um
        k2x, k2y = (2.0 - 2.0 * np.cos(h * kx)) / h**2, (2.0 - 2.0 * np.cos(h * ky)) / h**2
        k2 = k2x + k2y
        m = float(self.membrane_um.mean())
        F = self.gradient
        cofactor = area * inverse.T
        cx, cy = (
            cofactor[0, 0] * kx + cofactor[0, 1] * ky,
            cofactor[1, 0] * kx + cofactor[1, 1] * ky,
        )
        roll = k2 / np.maximum(kx**2 + ky**2, 1e-30)
        along_l = (cx * ux + cy * uy) ** 2 * roll
        along_t = (cy * ux - cx * uy) ** 2 * roll
        p_l = normal + m * (k2 + 3.0 * area**-4 * along_l) + self._bulk * area**-2 * along_l
        p_t = across + m * (k2 + 3.0 * area**-4 * along_t)
        metric = F.T @ F
        tension = m * (np.eye(2) - area**-2 * np.linalg.inv(metric))
        pulled = tension[0, 0] * k2x + tension[1, 1] * k2y
        pulled = pulled + 2.0 * tension[0, 1] * np.sin(h * kx) * np.sin(h * ky) / h**2
        p_z = normal + float(self.bending_um3.mean()) * k2**2
        p_z = np.maximum(p_z + pulled, 0.3 * p_z)
        weight = np.full(kx.shape, 2.0)
        weight[:, [0, -1]] = 1.0
        self._scale = np.stack(
            [
                np.where(live, 1.0 / np.sqrt(weight * np.where(live, p, 1.0)), 0.0)
                for p in (p_l, p_t, p_z)
            ]
        )
        self._elastic = np.stack([normal, across, mixed])
        self._unit = np.stack([ux, uy])
        self._weight = weight

    def affine(self) -> Float64Array:
        """Return the state (u, w) of a relief without a layer, (3, N, M) in um."""
        state = np.zeros((3, *self.neutral_um.shape))
        state[2] = self.rise * self.neutral_um
        return state

    def _spread(self, q: ComplexArray) -> ComplexArray:
        out = np.empty_like(q)
        with self._threads():
            rotate_coefficients(q, self._scale, self._unit, out)
        return out

    @contextmanager
    def _threads(self) -> Iterator[None]:
        before = get_num_threads()
        set_num_threads(min(self._workers, before))
        try:
            yield
        finally:
            set_num_threads(before)

    def state(self, q: ComplexArray) -> Float64Array:
        """Return the state (u, w) of scaled Fourier coefficients of its deviation from affine."""
        return self._state(self._spread(q))

    def _state(self, spread: ComplexArray) -> Float64Array:
        state = fft.irfft2(spread, s=self.neutral_um.shape, norm="forward", workers=self._workers)
        state[2] += self.rise * self.neutral_um
        return np.asarray(state)

    def energy(self, state: Float64Array) -> tuple[float, Float64Array]:
        """Return mean energy per area and its derivative by every node times their number.

        Parameters
        ----------
        state
            In-plane displacements x, y and height, um, (3, N, M).
        """
        local, force = self._local(state)
        deviation = state - self.affine()
        hat = fft.rfft2(deviation, norm="forward", workers=self._workers)
        pulled = np.zeros_like(hat)
        elastic = add_tissue_forces(hat, self._elastic, self._unit, self._weight, pulled)
        force += fft.irfft2(pulled, s=self.neutral_um.shape, norm="forward", workers=self._workers)
        return local + elastic, force

    def _local(self, state: Float64Array) -> tuple[float, Float64Array]:
        """Return energy and forces of the layer, and of the tissue's stress on tilted facets."""
        force = np.zeros_like(state)
        with self._threads():
            total = self._layer(state, force)
        total -= float(np.vdot(self._traction, state[:2]))
        force[:2] -= self._traction
        return float(total) / self.neutral_um.size, force

    def _layer(self, state: Float64Array, force: Float64Array) -> float:
        total = add_membrane_forces(
            state,
            self.neutral_um,
            self.membrane_um,
            self.gradient,
            self._bulk,
            self.texel_um,
            force,
        )
        total += add_bending_forces(
            state[2], self.neutral_um, self.bending_um3, self.texel_um, self._moment, force[2]
        )
        return float(total)

    def value(self, q: ComplexArray) -> tuple[float, ComplexArray]:
        """Return energy and its derivative by scaled coefficients (3, N, M // 2 + 1)."""
        moved = self._spread(q)
        local, force = self._local(self._state(moved))
        hat = fft.rfft2(force, norm="forward", workers=self._workers)
        slope = np.empty_like(q)
        with self._threads():
            elastic = add_tissue_forces(moved, self._elastic, self._unit, self._weight, hat)
            gather_coefficient_forces(hat, self._scale, self._unit, self._weight, slope)
        return local + elastic, slope

    def start(self) -> ComplexArray:
        """Return the coefficients of the affine state: zeros."""
        rows, columns = self.neutral_um.shape
        return np.zeros((3, rows, columns // 2 + 1), np.complex128)


def find_equilibrium(
    problem: LayerProblem, *, tolerance: float = 1e-3, steps: int = 400, memory: int = 6
) -> tuple[Float64Array, Convergence]:
    """Minimize the energy by L-BFGS in preconditioned Fourier coefficients.

    Parameters
    ----------
    problem
        Problem to minimize, from its affine state.
    tolerance
        Out-of-balance force relative to the affine state's at which the search ends.
    steps
        Largest number of steps.
    memory
        Pairs of the quasi-Newton matrix, kept in single precision.

    Returns
    -------
    state : ndarray (3, N, M)
        In-plane displacement and height, um.
    convergence

    Raises
    ------
    EquilibriumError
        When `steps` are not enough, or elements of the result are inverted.

    References
    ----------
    Liu and Nocedal 1989, doi:10.1007/BF01589116.
    """
    q = problem.start()
    energy, slope = problem.value(q)
    first = _norm(slope)
    energies, residuals = [energy], [1.0]
    evaluations = 1
    pairs: Pairs = deque(maxlen=memory)
    low, high = np.inf, np.nan  # curvatures along the steps
    # Below this the force is rounding error of the sum: already in equilibrium.
    if first < 1e-12 * (1.0 + float(problem.membrane_um.mean())):
        return problem.state(q), Convergence(1, 0.0, np.nan, (energy,), (0.0,))
    for _ in range(steps):
        size = _norm(slope)
        if size <= tolerance * first:
            break
        way = _direction(slope, pairs)
        along = _dot(way, slope)
        if along >= 0.0:
            pairs.clear()
            way, along = -slope, -(size**2)
        length = 1.0
        floor = 1e-13 * abs(energy)
        while True:
            ahead = q + length * way
            got, then = problem.value(ahead)
            evaluations += 1
            if np.isfinite(got) and got <= energy + 1e-4 * length * along + floor:
                break
            length *= (
                0.5 if not np.isfinite(got) else _parabola_step_factor(energy, along, got, length)
            )
            if length < 1e-9:
                raise EquilibriumError(
                    f"residual: got {size / first:.2g} after {len(energies) - 1} steps, expected "
                    f"<= {tolerance}; condition {high / low:.2g}; the energy does not fall any "
                    "further"
                )
        step, turn = length * way, then - slope
        bend = _dot(step, turn)
        if bend > 1e-12 * _norm(step) * _norm(turn):
            pairs.append((_single(step), _single(turn), bend))
            curvature = bend / _norm(step) ** 2
            low, high = min(low, curvature), np.fmax(high, curvature)
        q, energy, slope = ahead, got, then
        energies.append(energy)
        residuals.append(_norm(slope) / first)
    if residuals[-1] > tolerance:
        raise EquilibriumError(
            f"residual: got {residuals[-1]:.2g} after {steps} steps, expected <= {tolerance}; "
            f"condition {high / low:.2g}; the steps are too few"
        )
    state = problem.state(q)
    least = float(find_least_area(state, problem.gradient, problem.texel_um))
    if least <= 0.0:
        raise EquilibriumError(
            f"state: got an element of {least:.2g} times its affine area, expected > 0; the "
            "surface folds over; give a stretch nearer to 1"
        )
    condition = float(high / low)
    history = tuple(energies), tuple(residuals)
    return state, Convergence(evaluations, residuals[-1], condition, *history)


def _direction(slope: ComplexArray, pairs: Pairs) -> ComplexArray:
    """Return the quasi-Newton step by the two-loop recursion, in single precision."""
    scale = max(_norm(slope), 1e-300)
    way = _single(slope / -scale)
    shares = []
    for step, turn, bend in reversed(pairs):
        share = float(np.dot(step, way)) / bend
        way -= np.float32(share) * turn
        shares.append(share)
    if pairs:
        _, turn, bend = pairs[-1]
        way *= np.float32(bend / float(np.dot(turn, turn)))
    for (step, turn, bend), share in zip(pairs, reversed(shares), strict=True):
        way += np.float32(share - float(np.dot(turn, way)) / bend) * step
    return np.asarray(way.view(np.complex64).reshape(slope.shape) * scale, np.complex128)


def _single(a: ComplexArray) -> Float32Array:
    return a.astype(np.complex64).reshape(-1).view(np.float32)


def _parabola_step_factor(
    energy: float, along: float, energy_change: float, length: float
) -> float:
    """Return the step factor to the minimum of a fitted parabola, clamped to 0.1 to 0.5."""
    curve = energy_change - energy - along * length
    return float(np.clip(-0.5 * along * length / curve, 0.1, 0.5)) if curve > 0.0 else 0.5


def _dot(a: NDArray[np.complexfloating], b: NDArray[np.complexfloating]) -> float:
    return float(np.vdot(a, b).real)


def _norm(a: ComplexArray) -> float:
    return float(np.linalg.norm(a.reshape(-1)))
