"""Estimate normals from all light at a point, highlights included, with the full fitted model.

Subsurface-scattered light constrains a normal by its slowly varying cosine; a highlight constrains
it by its position, and on dark or glossy skin it is most of the light. Given R_d and the weights of
the basis BRDFs, the normal of each point minimizes the misfit of the model to the samples. The
minimization uses Gauss-Newton steps on two tilts. The weights include the error of the lobes,
outliers have Huber's constant influence, and steps are halved until they lower the misfit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model.brdf.tables import BrdfBasis
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.brdf_basis import mixture_kernels
from reconstruction.lumitexels import Lumitexels, boundary_kernels

N_GAUSS_NEWTON_STEPS: Final = 2
"""Gauss-Newton steps per call; R_d and the lobes are refitted between calls."""
MAX_HALVINGS: Final = 3
DIFFERENCE_RAD: Final = np.radians(0.5)
"""Tilt of the finite differences: about a node spacing of the tables at a highlight's flank."""
MAX_STEP_RAD: Final = np.radians(3.0)
"""Longest step: lobes are too nonlinear for longer ones."""
HUBER_SIGMAS: Final = 3.0
SAMPLE_RELATIVE_ERROR: Final = 0.02
"""Relative error of every sample of the model, for its weight."""
LOBE_RELATIVE_ERROR: Final = 0.1
"""Relative error of a fitted lobe, for the weight of samples in it."""
MIN_NORMAL_COS_LIGHT: Final = 0.15
MIN_NORMAL_COS_VIEW: Final = 0.2
"""Flatter samples are not used for normals: there the boundary's transmittance is nonlinear."""


@dataclass(frozen=True, slots=True, eq=False)
class PointLobes:
    """Reflection lobes of the surface at each point: weights of basis BRDFs, (P, K)."""

    weights: Float64Array
    basis: BrdfBasis

    def __getitem__(self, rows: slice | NDArray[np.integer]) -> PointLobes:
        """Return the lobes of some of the points."""
        return PointLobes(self.weights[rows], self.basis)

    def where(self, known: BoolArray) -> PointLobes:
        """Return the lobes with weight 0 at points that are not known, (P,)."""
        return PointLobes(np.where(known[:, None], self.weights, 0.0), self.basis)

    def evaluate(self, samples: Lumitexels, normals: Float64Array) -> Float32Array:
        """Return f_r of the lobes for samples at normals (P, 3)."""
        ways = samples.light_dir, samples.view_dir
        return mixture_kernels.evaluate_mixtures(self.basis.table, self.weights, *ways, normals)


@dataclass(frozen=True, slots=True, eq=False)
class ModelNormals:
    """Normals at the best fit of the model.

    Attributes
    ----------
    normals : ndarray of float64, shape (P, 3)
        Unit vectors; as given where not `valid`.
    stderr_rad : ndarray of float64, shape (P,)
        Of each of two tilts, from the misfit's curvature and size; pi where not `valid`.
    moved_rad : ndarray of float64, shape (P,)
        Angle to the given normals.
    valid : ndarray of bool, shape (P,)
        At least four samples, and a misfit that determines both tilts.
    """

    normals: Float64Array
    stderr_rad: Float64Array
    moved_rad: Float64Array
    valid: BoolArray


def estimate(
    samples: Lumitexels, normals: Float64Array, r_d: Float64Array, lobes: PointLobes
) -> ModelNormals:
    """Move normals to where the model fits the measured samples best.

    Parameters
    ----------
    samples : Lumitexels
        Of P points; f is computed with the scan's cosine.
    normals : ndarray, shape (P, 3)
        Initial unit normals.
    r_d : ndarray, shape (P,)
        Mean R_d of the channels.
    lobes : PointLobes
        Of the same points.
    """
    fit = _Fit(
        samples,
        r_d,
        lobes,
        gray=samples.f.mean(axis=-1).astype(np.float64),
        noise=np.where(samples.valid, samples.variance.mean(axis=-1), 1.0) / 3.0,
    )
    valid = np.ones(len(normals), np.bool_)
    start = n = normals.astype(np.float64)
    state = fit.at(n)
    normal_matrix = np.broadcast_to(np.eye(2), (len(n), 2, 2))
    for _ in range(N_GAUSS_NEWTON_STEPS):
        first, second = _tangents(n)
        slope = np.stack([fit.slope(n, axis) for axis in (first, second)], axis=-1)
        # Huber weight: 1 below the limit, limit / |residual| beyond it
        far = HUBER_SIGMAS / np.sqrt(np.maximum(state.misfit2, 1))
        pull = np.where(state.misfit2 < HUBER_SIGMAS**2, 1.0, far)
        weight = np.where(state.use, pull / state.variance, 0.0)
        normal_matrix = np.einsum("pm,pmi,pmj->pij", weight, slope, slope)
        gradient = np.einsum("pm,pmi,pm->pi", weight, slope, fit.gray - state.value)
        size = np.trace(normal_matrix, axis1=1, axis2=2)
        solvable = (np.linalg.det(normal_matrix) > 1e-12 * np.square(size)) & valid
        safe = np.where(solvable[:, None, None], normal_matrix, np.eye(2))
        step = np.where(solvable[:, None], np.linalg.solve(safe, gradient[..., None])[..., 0], 0.0)
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        step *= np.minimum(1.0, MAX_STEP_RAD / np.maximum(length, 1e-300))
        for _ in range(MAX_HALVINGS):
            tried = _unit(n + step[:, [0]] * first + step[:, [1]] * second)
            there = fit.at(tried)
            better = there.cost < state.cost
            n = np.where(better[:, None], tried, n)
            state = fit.at(n)
            step = np.where(better[:, None], 0.0, 0.5 * step)
        valid = valid & solvable
    count = np.count_nonzero(state.use, axis=1)
    valid = valid & (count > 3)
    size = np.sum(np.where(state.use, np.minimum(state.misfit2, HUBER_SIGMAS**2), 0.0), axis=1)
    inflation = np.maximum(size / np.maximum(count - 3, 1), 1.0)
    safe = np.where(valid[:, None, None], normal_matrix, np.eye(2))
    variance = 0.5 * np.trace(np.linalg.inv(safe), axis1=1, axis2=2) * inflation
    cosine = np.clip(np.sum(n * start, axis=-1), -1.0, 1.0)
    return ModelNormals(
        np.where(valid[:, None], n, normals),
        np.where(valid, np.minimum(np.sqrt(variance), np.pi), np.pi),
        np.where(valid, np.arccos(cosine), 0.0),
        valid,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The model at the current normals."""

    value: Float64Array
    variance: Float64Array
    misfit2: Float64Array
    use: BoolArray
    cost: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Samples of points, and their model as a function of the normals."""

    samples: Lumitexels
    r_d: Float64Array
    lobes: PointLobes
    gray: Float64Array
    noise: Float64Array

    def at(self, normals: Float64Array) -> _State:
        value, lobes, cos_light, cos_view = self._predicted(normals)
        use = self.samples.valid & (cos_light > MIN_NORMAL_COS_LIGHT)
        use &= cos_view > MIN_NORMAL_COS_VIEW
        variance = self.noise + np.square(LOBE_RELATIVE_ERROR * lobes)
        variance += np.square(SAMPLE_RELATIVE_ERROR * value)
        misfit2 = np.square(self.gray - value) / variance
        far = 2 * HUBER_SIGMAS * np.sqrt(misfit2) - HUBER_SIGMAS**2
        huber = np.where(misfit2 < HUBER_SIGMAS**2, misfit2, far)
        # the variance depends on the model: the Gaussian -2 log p includes log(variance), without
        # which brighter lobes would always cost less
        cost = np.where(use, huber + np.log(variance), 0.0).sum(axis=1)
        return _State(value, variance, misfit2, use, cost / np.maximum(use.sum(axis=1), 1))

    def slope(self, normals: Float64Array, axis: Float64Array) -> Float64Array:
        ahead, behind = (
            self._predicted(_unit(normals + sign * DIFFERENCE_RAD * axis))[0]
            for sign in (1.0, -1.0)
        )
        return (ahead - behind) / (2.0 * DIFFERENCE_RAD)

    def _predicted(
        self, normals: Float64Array
    ) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
        s = self.samples
        cos_light = np.einsum("pmk,pk->pm", s.light_dir, normals)
        cos_view = np.einsum("pmk,pk->pm", s.view_dir, normals)
        lobes = self.lobes.evaluate(s, normals)
        through = boundary_kernels.boundary_transmittance(cos_light, cos_view)
        # f was computed from the radiance with the scan's cosine
        ratio = np.clip(cos_light, 0.0, None) / s.cos_light
        value = (self.r_d[:, None] * through / np.pi + lobes) * ratio
        return value, lobes * ratio, cos_light, cos_view


def _tangents(normals: Float64Array) -> tuple[Float64Array, Float64Array]:
    helper = np.where(np.abs(normals[:, [0]]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = _unit(np.cross(normals, helper))
    return first, np.cross(normals, first)


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
