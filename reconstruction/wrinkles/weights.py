"""Estimate the zone weights of an expression: eight bounded unknowns, with standard errors.

With the wrinkle map W at full resolution, an expression's difference from neutral is linear in the
weights, and masks are read bilinearly. The normal equations of all weights then follow from one
scalar image, |W|^2, gathered at the masks' resolution.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from model import texture_resampling as resampling
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.wrinkles.texels import gather_texels, normal_matrix

MAX_STDERR = 0.5
"""Maximum standard error of a valid weight; larger ones do not restrict it within [0, 1]."""
BLOCKS_PER_SIDE = 16
"""Blocks per side of the face over which the scatter of the misfit is measured."""
MIN_EIGENVALUE = 1e-9
"""Eigenvalues of the scaled normal matrix below this leave a weight undetermined."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Derivatives of an expression minus the neutral ones.

    Attributes
    ----------
    values, variance : ndarray, shape (H, W, 2), float32
        0 where not valid; variance 0 everywhere without errors.
    weight : ndarray, shape (H, W), float32
        Weight of the pixel in sums of squares; 0 where not valid.
    """

    values: Float32Array
    variance: Float32Array
    weight: Float32Array


@dataclass(frozen=True, slots=True)
class ZoneWeights:
    """Zone weights that fit one expression best, given wrinkle map and masks.

    Attributes
    ----------
    weights : ndarray, shape (Z,)
        Within the bounds; 0 where not valid.
    stderr : ndarray, shape (Z,)
        As without bounds: the larger of the error by the normals' standard errors and that by the
        scatter of the misfit over the face. Infinite for undetermined weights. The wrinkle map's
        error is neglected.
    valid : ndarray of bool, shape (Z,)
        Determined, with a standard error below `MAX_STDERR`.
    at_bound : ndarray of bool, shape (Z,)
    covariance : ndarray, shape (Z, Z)
        By the normals' standard errors alone; 0 for weights that are not determined.
    explained : float
        1 - |misfit|^2 / |difference from neutral|^2 over the valid pixels; 0 where there is no
        difference. Noise is not explained.
    """

    weights: Float64Array
    stderr: Float64Array
    valid: BoolArray
    at_bound: BoolArray
    covariance: Float64Array
    explained: float


@dataclass(frozen=True, slots=True)
class ZoneEquations:
    """Normal equations N w = b of the zones' weights of one expression.

    Attributes
    ----------
    matrix, vector : ndarray, shapes (Z, Z) and (Z,)
    noise : ndarray, shape (Z, Z)
        Covariance of `vector` by the normals' standard errors.
    total : float
        Weighted sum of squared differences.
    """

    matrix: Float64Array
    vector: Float64Array
    noise: Float64Array
    total: float

    def misfit(self, weights: Float64Array) -> float:
        """Return the weighted sum of squared residuals, at least 0."""
        left = self.total - 2.0 * weights @ self.vector + weights @ self.matrix @ weights
        return max(float(left), 0.0)

    def determined(self) -> BoolArray:
        """Return which weights the equations determine, (Z,)."""
        # a weight is undetermined if it has a part in an eigenvector of eigenvalue about 0
        diagonal = np.diag(self.matrix)
        some = diagonal > MIN_EIGENVALUE * diagonal.max(initial=0.0)
        if not some.any():
            return some
        values, vectors = np.linalg.eigh(self._scaled(some))
        loose = vectors[:, values < MIN_EIGENVALUE * values[-1]]
        fast = some.copy()
        fast[some] = (np.abs(loose) < 1e-6).all(axis=1)
        return fast

    def _scaled(self, some: BoolArray) -> Float64Array:
        part = self.matrix[np.ix_(some, some)]
        root = np.sqrt(np.diag(part))
        return part / np.outer(root, root)

    def inverse(self) -> Float64Array:
        """Return the pseudo-inverse of the matrix; ignore rows of undetermined weights."""
        diagonal = np.diag(self.matrix)
        root = np.sqrt(
            np.where(diagonal > MIN_EIGENVALUE * diagonal.max(initial=0.0), diagonal, np.inf)
        )
        scaled = self.matrix / np.outer(root, root)
        return np.linalg.pinv(scaled, rcond=MIN_EIGENVALUE, hermitian=True) / np.outer(root, root)

    def solve_bounded(self, bounds: tuple[float, float]) -> Float64Array:
        """Return the weights within bounds that minimize the misfit; 0 without a wrinkle."""
        # with N = V L V', |L^1/2 V' w - L^-1/2 V' b|^2 is the misfit up to a constant
        diagonal = np.diag(self.matrix)
        some = diagonal > MIN_EIGENVALUE * diagonal.max(initial=0.0)
        weights = np.zeros(len(diagonal))
        if not some.any():
            return weights
        root = np.sqrt(diagonal[some])
        values, vectors = np.linalg.eigh(self._scaled(some))
        kept = values > MIN_EIGENVALUE * values[-1]
        factor = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
        target = (vectors[:, kept].T @ (self.vector[some] / root)) / np.sqrt(values[kept])
        if not math.isfinite(bounds[0]):
            scaled, *_ = np.linalg.lstsq(factor, target, rcond=None)
        else:
            limits = bounds[0] * root, bounds[1] * root
            scaled = lsq_linear(factor, target, bounds=limits, method="bvls").x
        weights[some] = scaled / root
        return np.clip(weights, *bounds)


def build_equations(
    masks: FloatArray,
    wrinkle: FloatArray,
    data: Mapping[str, Difference],
    *,
    with_noise: bool = True,
) -> dict[str, ZoneEquations]:
    """Return the normal equations of several expressions' weights for the same wrinkle map.

    Parameters
    ----------
    masks : ndarray, shape (Z, h, w)
    wrinkle : ndarray, shape (H, W, 2)
        Derivatives to add, read at the pixels of the differences.
    data : mapping of str to Difference
    with_noise : bool
        False leaves `noise` at 0; weights alone do not need it.
    """
    shape = next(iter(data.values())).weight.shape
    masks = resampling.resample(
        masks, (min(masks.shape[1], shape[0]), min(masks.shape[2], shape[1]))
    )
    h, w = masks.shape[1:]
    by, bx = (resampling.reading_matrix(t, p) for t, p in zip((h, w), shape, strict=True))
    flat = masks.reshape(len(masks), -1)

    def squares(image: Float64Array) -> Float64Array:
        return np.asarray(flat @ (normal_matrix(by, bx, image, (h, w)) @ flat.T))

    energy = np.einsum("hwc,hwc->hw", wrinkle, wrinkle)
    weight: Float32Array | None = None
    matrix = np.zeros((len(masks), len(masks)))
    found = {}
    for name, one in data.items():
        v = one.weight.astype(np.float64)
        if weight is None or not np.array_equal(weight, one.weight):
            weight, matrix = one.weight, squares(energy * v)
        agreement = np.einsum("hwc,hwc->hw", wrinkle, one.values) * v
        total = np.einsum("hwc,hwc->hw", one.values, one.values, dtype=np.float64)
        noise = np.zeros_like(matrix)
        if with_noise and one.variance.any():
            scatter = np.einsum("hwc,hwc,hwc->hw", wrinkle, wrinkle, one.variance)
            noise = squares(scatter * v * v)
        found[name] = ZoneEquations(
            matrix, flat @ gather_texels(by, bx, agreement).ravel(), noise, float((v * total).sum())
        )
    return found


def fit_zone_weights(
    masks: Float64Array, wrinkle: FloatArray, difference: Difference, bounds: tuple[float, float]
) -> ZoneWeights:
    """Return the bounded weights of one expression with their errors.

    Parameters
    ----------
    masks, wrinkle
        See :func:`build_equations`.
    difference : Difference
    bounds : (float, float)
    """
    equations = build_equations(masks, wrinkle, {"": difference})[""]
    fast = equations.determined()
    weights = np.where(fast, equations.solve_bounded(bounds), 0.0)
    inverse = equations.inverse()
    covariance = inverse @ equations.noise @ inverse
    seen = inverse @ _scatter(masks, wrinkle, difference, weights) @ inverse
    variance = np.maximum(np.diag(covariance), np.diag(seen))
    stderr = np.where(fast, np.sqrt(np.maximum(variance, 0.0)), np.inf)
    covariance[~fast] = 0.0
    covariance[:, ~fast] = 0.0
    valid = fast & (stderr < MAX_STDERR)
    weights[~valid] = 0.0
    total = equations.total
    return ZoneWeights(
        weights,
        stderr,
        valid,
        valid & np.isin(weights, bounds),
        covariance,
        1.0 - equations.misfit(weights) / total if total > 0 else 0.0,
    )


def _scatter(
    masks: Float64Array, wrinkle: FloatArray, difference: Difference, weights: Float64Array
) -> Float64Array:
    """Return the covariance of the equations' right side, from the misfit's sums over blocks.

    The misfit of a model is correlated along grooves, not independent between pixels; its sums over
    blocks of the face are nearly independent.
    """
    shape = difference.weight.shape
    size = (shape[0], shape[1])
    strength = resampling.resample(np.tensordot(weights, masks, axes=1), size)
    left = difference.values - strength[..., None] * wrinkle
    score = np.einsum("hwc,hwc->hw", wrinkle, left) * difference.weight
    rows, columns = (
        np.arange(min(BLOCKS_PER_SIDE, n)) * n // min(BLOCKS_PER_SIDE, n) for n in size
    )
    sums = []
    for mask in masks:
        image = resampling.resample(mask, size) * score
        sums.append(np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1).ravel())
    blocks = np.stack(sums)
    count = max(int(np.count_nonzero(np.abs(blocks).sum(axis=0))), 1)
    return blocks @ blocks.T * (count / max(count - 1, 1))
