"""Find zones of wrinkles: regions where expressions raise wrinkles in the same proportions.

Within a texel of the masks, by eq. D_e(x) = a_e W(x), the expressions' differences are one pattern
times a factor each: their matrix of products has rank one. Its leading eigenvector gives the
texel's amplitudes a_e, up to a common scale and sign; texels with the same amplitudes form a zone.
Two quantities are undetermined: the scale of a zone against its wrinkle map, and the border of
zones with proportional weights (left and right of a face), which positions or a layout separate.

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1 (zones of figure 1.3, which an artist drew). ISBN 978-1-56881-718-7
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.ndimage import distance_transform_edt

from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome
from model.texture_resampling import averaging_matrix
from model.vectors import project_to_simplex
from model.wrinkles import Masks, WrinkleError, mask_stack
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.wrinkles.fit import Measured, differences
from reconstruction.wrinkles.texels import measure_derivatives

_log = logging.getLogger(__name__)

MIN_SIGNAL = 3.0
"""Minimum energy of a texel's pattern over its scatter by the standard errors: their variance over
the square root of pixels per expression."""
MIN_ENERGY = 1e-3
"""Minimum energy of a texel's pattern, relative to the strongest texel's."""
ZONE_ROUNDS = 40
GRADIENT_STEPS = 60
LAYOUT_WEIGHT = 0.03
"""Weight of the initial layout, against the data of a texel well above noise."""
PROPORTIONAL_COSINE = 0.98
"""Cosine above which two zones' weights count as proportional."""


@dataclass(frozen=True, slots=True)
class Amplitudes:
    """Amplitudes of the expressions' wrinkles in each texel.

    Attributes
    ----------
    values : ndarray, shape (E, h, w)
        Largest magnitude 1 in each texel; 0 where not valid.
    energy : ndarray, shape (h, w)
        Mean square of the pattern at amplitude 1, minus the noise.
    rank_one_fraction : ndarray, shape (h, w)
        Fraction of the texel's sum of squares that one pattern explains; 0 where not valid.
    valid : ndarray of bool, shape (h, w)
        At least one expression changes the texel by more than its errors.
    names : tuple of str
        Names of the expressions.
    """

    values: Float64Array
    energy: Float64Array
    rank_one_fraction: Float64Array
    valid: BoolArray
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ZoneFit:
    """Masks estimated from the data.

    Attributes
    ----------
    masks : ndarray, shape (Z, h, w), float32
        At least 0, with a sum of 1 in every texel.
    weights : mapping of str to tuple of float
        One row per expression; the scale of a zone is that of its amplitudes.
    valid : ndarray of bool, shape (h, w)
        The data determine the texel's mask; elsewhere it is the layout's.
    rank_one_fraction : float
        Fraction of the sum of squares that one pattern per texel explains: a test of the assumption
        of one wrinkle map.
    explained : float
        Fraction of the amplitudes' squares that the masks explain, weighted by energy.
    distinct : int
        Number of zones with weights not proportional to another's, which the data can separate.
    """

    masks: Float32Array
    weights: Mapping[str, tuple[float, ...]]
    valid: BoolArray
    rank_one_fraction: float
    explained: float
    distinct: int


def estimate_amplitudes(
    neutral: Measured, expressions: Mapping[str, Measured], *, size: tuple[int, int] = (64, 64)
) -> Amplitudes:
    """Estimate the rank-one amplitudes of expressions in each texel of the masks.

    Parameters
    ----------
    neutral : array_like (H, W, 3), NormalMaps, or Derivatives
    expressions : mapping of str to the same
        At least one.
    size : (int, int)
        Rows and columns of texels, at most those of the normals.
    """
    if not expressions:
        raise WrinkleError("expressions: got none, expected at least one; add one")
    base = measure_derivatives(neutral)
    shape = base.valid.shape
    if size[0] > shape[0] or size[1] > shape[1] or min(size) < 1:
        hint = "choose another size"
        raise WrinkleError(f"size: got {size}, expected 1 to {shape} texels; {hint}")
    data = differences(base, expressions)
    names = tuple(data)
    ay, ax = averaging_matrix(shape[0], size[0]), averaging_matrix(shape[1], size[1])
    seen = np.logical_and.reduce([one.weight > 0 for one in data.values()])
    part = (ay @ seen.astype(np.float64)) @ ax.T
    count = len(names)
    gram, noise = np.zeros((*size, count, count)), np.zeros(size)
    for i, first in enumerate(names):
        for j, second in enumerate(names[: i + 1]):
            # E[D_e . D_f] contains the noise of the neutral image, common to all differences, and
            # for e = f also that of the expression
            a, b = data[first], data[second]
            shared = a.variance if i == j else base.variance
            dot = (a.values.astype(np.float64) * b.values - shared).sum(axis=2) * seen
            mean = (ay @ dot) @ ax.T / np.maximum(part, 1e-12)
            gram[..., i, j] = gram[..., j, i] = mean
        noise = np.maximum(noise, (ay @ (a.variance.sum(axis=2) * seen)) @ ax.T)
    values, vectors = np.linalg.eigh(gram)
    leading, trace = np.maximum(values[..., -1], 0.0), np.trace(gram, axis1=2, axis2=3)
    direction = np.moveaxis(vectors[..., -1], -1, 0)
    peak = np.take_along_axis(direction, np.abs(direction).argmax(axis=0)[None], axis=0)
    # gram = energy a a' with the amplitudes a scaled to a largest magnitude of 1
    energy = leading * peak[0] ** 2
    valid = (part > 0.1) & (leading > 0) & (energy >= MIN_ENERGY * energy.max(initial=0.0))
    pixels = np.maximum(part * seen.size / (size[0] * size[1]), 1.0)
    valid &= energy > MIN_SIGNAL * noise * np.sqrt(count / pixels)
    amplitude = np.where(valid, direction / np.where(peak == 0, 1.0, peak), 0.0)
    share = np.divide(leading, np.maximum(trace, leading), out=np.zeros_like(leading), where=valid)
    return Amplitudes(amplitude, np.where(valid, energy, 0.0), share, valid, names)


def fit_zones(
    amplitudes: Amplitudes, *, zones: int = 8, layout: Masks | None = None, rng: np.random.Generator
) -> ZoneFit:
    """Estimate masks of zones, from an initial layout or from amplitudes and positions alone.

    Parameters
    ----------
    amplitudes : Amplitudes
    zones : int
        Number of zones, without a layout.
    layout : array_like, shape (Z, h, w), optional
        Approximate regions at the resolution of the amplitudes, e.g. an artist's; they are refined,
        and kept where the data do not determine them.
    rng
        Draws the initial centers, without a layout.
    """
    shape = amplitudes.valid.shape
    if not amplitudes.valid.any():
        got = "got no texel with a wrinkle, expected some"
        raise WrinkleError(f"amplitudes: {got}; add expressions with stronger wrinkles")
    if layout is None:
        start = _clustered(amplitudes, zones, rng)
    else:
        start = mask_stack(layout).astype(np.float64)
        if start.shape[1:] != shape:
            hint = "resample the layout"
            got = f"got {start.shape[1:]} texels, expected {shape}"
            raise WrinkleError(f"layout: {got}; {hint}")
        start = np.maximum(start, 0.0)
        total = start.sum(axis=0)
        start = np.where(total > 0, start / np.where(total > 0, total, 1.0), 1.0 / len(start))
    count = len(start)
    prior = start.reshape(count, -1).T
    target = amplitudes.values.reshape(len(amplitudes.names), -1).T
    strength = amplitudes.energy.ravel()
    relative = strength / strength[strength > 0].mean()
    trust = np.where(amplitudes.valid.ravel(), relative / (relative + 0.1), 0.0)
    masks = prior.copy()
    weights = np.zeros((count, target.shape[1]))
    for _ in range(ZONE_ROUNDS):
        before = weights
        weights = _weights_of(masks, target, strength)
        masks = _on_simplex_fit(masks, prior, target, weights, trust)
        change = float(np.abs(weights - before).max())
        if change < 1e-5:
            break
    else:
        SolverOutcome(ZONE_ROUNDS, change, UNKNOWN_CONDITION, "limit").warn_unless_converged(
            "zones of wrinkles", _log
        )
    left = (strength[:, None] * (target - masks @ weights) ** 2).sum()
    whole = (strength[:, None] * target**2).sum()
    squares = strength / np.maximum(amplitudes.rank_one_fraction.ravel(), 1e-12)
    squares *= (target**2).sum(axis=1)
    return ZoneFit(
        masks.T.reshape(count, *shape).astype(np.float32),
        {name: tuple(map(float, weights[:, e])) for e, name in enumerate(amplitudes.names)},
        amplitudes.valid,
        float((strength * (target**2).sum(axis=1)).sum() / squares.sum()),
        float(1.0 - left / whole),
        _distinct(weights),
    )


def _clustered(found: Amplitudes, zones: int, rng: np.random.Generator) -> Float64Array:
    """Cluster amplitudes and positions to regions (Z, h, w) by k-means, the best of 8 starts.

    Texels without a wrinkle take the region of the nearest one with a wrinkle.
    """
    h, w = found.valid.shape
    y, x = np.mgrid[:h, :w]
    places = np.stack([(x + 0.5) / w, (y + 0.5) / h], axis=-1)
    good = found.valid
    if zones < 1 or zones > np.count_nonzero(good):
        raise WrinkleError(
            f"zones: got {zones}, expected 1 to {np.count_nonzero(good)}, the number of texels "
            "with a wrinkle; choose fewer"
        )
    features = np.concatenate([found.values[:, good].T, 2.0 * places[good]], axis=1)
    best, least = None, np.inf
    for _ in range(8):
        centers, label = kmeans2(features, zones, iter=30, minit="++", seed=rng, missing="warn")
        cost = float((found.energy[good] * ((features - centers[label]) ** 2).sum(axis=1)).sum())
        if cost < least:
            best, least = label, cost
    assert best is not None  # noqa: S101
    near = distance_transform_edt(~good, return_distances=False, return_indices=True)
    labels = np.zeros((h, w), int)
    labels[good] = best
    labels = labels[near[0], near[1]]
    return (labels == np.arange(zones)[:, None, None]).astype(np.float64)


def _weights_of(masks: Float64Array, target: Float64Array, strength: Float64Array) -> Float64Array:
    """Return weights (Z, E) by least squares over texels, with a small ridge to plain averages."""
    counted = masks * strength[:, None]
    mass = counted.sum(axis=0)
    mean = (counted.T @ target) / np.maximum(mass, 1e-300)[:, None]
    ridge = 1e-3 * mass + 1e-12 * mass.max()
    return np.linalg.solve(
        counted.T @ masks + np.diag(ridge), counted.T @ target + ridge[:, None] * mean
    )


def _on_simplex_fit(
    masks: Float64Array,
    prior: Float64Array,
    target: Float64Array,
    weights: Float64Array,
    trust: Float64Array,
) -> Float64Array:
    """Fit each texel's mask weights m >= 0 with sum 1.

    Projected gradient descent on trust |a - m w|^2 + `LAYOUT_WEIGHT` |m - prior|^2. The step is 1
    over the largest eigenvalue of w w' plus the weight, a bound of the Hessian for trust <= 1.
    """
    gram = weights @ weights.T
    scale = 1.0 / (np.linalg.eigvalsh(gram)[-1] + LAYOUT_WEIGHT)
    pull = target @ weights.T
    for _ in range(GRADIENT_STEPS):
        slope = trust[:, None] * (masks @ gram - pull) + LAYOUT_WEIGHT * (masks - prior)
        masks = project_to_simplex(masks - scale * slope)
    return masks


def _distinct(weights: Float64Array) -> int:
    """Return the number of directions of the zones' weights, proportional ones counted once."""
    lengths = np.linalg.norm(weights, axis=1)
    kept: list[Float64Array] = []
    for row in weights[lengths > 1e-6] / lengths[lengths > 1e-6, None]:
        if all(abs(float(row @ other)) < PROPORTIONAL_COSINE for other in kept):
            kept.append(row)
    return len(kept)
