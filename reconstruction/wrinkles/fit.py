"""Fit wrinkle maps and zone weights to normals of a neutral face and of its expressions.

In the model an expression e adds D_e(x) = (sum_z w_ez m_z(x)) W(x) to the neutral derivatives: one
wrinkle map W, blended by masks m_z with weights w_ez. Given masks, W is linear in the data and so
are the weights, each with the other fixed; :func:`fit_wrinkle_map` alternates between them. Weights
and map are determined up to a scale of each zone (and its sign). A fit starts with a largest weight
of 1 in each zone, overlapping zones determine their ratio, and the final weights are at most 1.

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1. ISBN 978-1-56881-718-7
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model import texture_resampling as resampling
from model.checks import Checks
from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome, StopReason
from model.wrinkles import Masks, WrinkleError, WrinkleLayer, mask_stack
from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.expressions import JIMENEZ2011_TABLE, ZONE_SUM_LIMITS, Clamp, ExpressionTable
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.normal_maps import NormalMaps
from reconstruction.wrinkles.texels import (
    SOLVER_TOL,
    Derivatives,
    Texels,
    fit_texels,
    measure_derivatives,
)
from reconstruction.wrinkles.weights import (
    Difference,
    ZoneEquations,
    ZoneWeights,
    build_equations,
    fit_zone_weights,
)

_log = logging.getLogger(__name__)

Measured: TypeAlias = ArrayLike | NormalMaps | Derivatives

FIT_ROUNDS = 20
COARSE_SIDE = 256
"""Texels per side of the map at which weights are estimated."""
MISFIT_TOL = 1e-5
"""Decrease of the misfit per round, relative to the differences, at which the fit stops."""


@dataclass(frozen=True, slots=True)
class WrinkleFit:
    """A wrinkle map with the weights of the expressions that it was fitted to.

    Attributes
    ----------
    layer : Layer
        Map, masks and table for evaluation; with standard error and valid mask.
    expressions : mapping of str to ZoneWeights
        Estimated weights with their errors: the rows of the layer's table, unless that was given.
    base : Derivatives
        Derivatives of the neutral face.
    explained : float
        1 - |misfit|^2 / |differences|^2 with the table's weights, all expressions together.
    outcome : SolverOutcome
        Of the alternations of map and weights, 0 where the weights were given; its residual is the
        last round's gain of `explained`, its tolerance `MISFIT_TOL`.
    clamp : {"unit", "signed"}
        Range of the weights.
    """

    layer: WrinkleLayer
    expressions: Mapping[str, ZoneWeights]
    base: Derivatives
    explained: float
    outcome: SolverOutcome
    clamp: Clamp

    def model(self) -> WrinkleModel:
        """Return the face with its wrinkles, for evaluation and export."""
        stderr = np.sqrt(self.base.variance)
        errors = {name: tuple(one.stderr) for name, one in self.expressions.items()}
        return WrinkleModel(
            self.base.values, (self.layer,), self.clamp, self.base.valid, stderr, errors
        )


def fit_weights(
    layer: WrinkleLayer, neutral: Measured, expression: Measured, *, clamp: Clamp = "unit"
) -> ZoneWeights:
    """Estimate the zone weights with which a wrinkle map fits a new expression best.

    Parameters
    ----------
    layer : Layer
        Wrinkle map and masks, of any resolution.
    neutral, expression : array_like (H, W, 3), NormalMaps, or Derivatives
        Tangent-space normals.
    clamp : {"unit", "signed"}
        Bounds of the weights: [0, 1] or [-1, 1].

    Returns
    -------
    ZoneWeights
    """
    Checks(WrinkleError).choice("clamp", clamp, ZONE_SUM_LIMITS)
    difference = differences(measure_derivatives(neutral), {"expression": expression})["expression"]
    wrinkle = _read(np.asarray(layer.wrinkle, np.float64), difference.weight.shape)
    return fit_zone_weights(
        np.asarray(layer.masks, np.float64), wrinkle, difference, ZONE_SUM_LIMITS[clamp]
    )


def fit_wrinkle_map(
    neutral: Measured,
    expressions: Mapping[str, Measured],
    masks: Masks,
    *,
    size: tuple[int, int],
    zones: tuple[str, ...] | None = None,
    table: ExpressionTable | None = None,
    clamp: Clamp = "unit",
) -> WrinkleFit:
    """Fit one wrinkle map, and the weights of expressions that no table gives.

    Parameters
    ----------
    neutral : array_like (H, W, 3), NormalMaps, or Derivatives
        Tangent-space normals, +X right, +Y up, of the face at rest.
    expressions : mapping of str to the same
        At least one, in the neutral face's map space.
    masks : array_like, shape (Z, h, w), or RGBA textures
        Zones, of any resolution; `reconstruction.wrinkles.zones` fits them.
    size : (int, int)
        Rows and columns of the wrinkle map.
    zones : tuple of str, optional
        Names of the zones; the paper's for eight, numbers otherwise.
    table : ExpressionTable, optional
        Known weights with one row per expression: only the map is fitted.
    clamp : {"unit", "signed"}
        Range of the weights in later evaluation: [0, 1], or [-1, 1], where an expression may
        flatten what others wrinkle, as anger does the forehead in table 1.1.

    Returns
    -------
    WrinkleFit

    Raises
    ------
    WrinkleError
        For mismatched sizes, or without expressions.
    """
    Checks(WrinkleError).choice("clamp", clamp, ZONE_SUM_LIMITS)
    if not expressions:
        raise WrinkleError("expressions: got none, expected at least one; add one")
    stack = mask_stack(masks).astype(np.float64)
    names = zones if zones is not None else _zone_names(len(stack))
    if len(names) != len(stack):
        hint = "give one name per mask"
        raise WrinkleError(f"zones: got {len(names)} names, expected {len(stack)}; {hint}")
    base = measure_derivatives(neutral)
    data = differences(base, expressions)
    outcome = SolverOutcome(0, 0.0, UNKNOWN_CONDITION, "tolerance")
    if table is not None:
        rows = {name: table.row(name) for name in data}
        for name, row in rows.items():
            Checks(WrinkleError).shape(f"table[{name!r}]", row, (len(stack),))
    else:
        rows, outcome = _alternate(stack, data, base, size, clamp)
    texels = _solve_map(stack, rows, data, size)
    wrinkle = _read(texels.values, base.valid.shape)
    found = {
        name: fit_zone_weights(stack, wrinkle, one, ZONE_SUM_LIMITS[clamp])
        for name, one in data.items()
    }
    source = "fitted to normals" if table is None else table.source
    if table is None:
        rows = {name: one.weights for name, one in found.items()}
    equations = _equations(stack, texels, data)
    misfit = sum(one.misfit(rows[name]) for name, one in equations.items())
    total = sum(one.total for one in equations.values())
    layer = WrinkleLayer(
        texels.values.astype(np.float32),
        stack.astype(np.float32),
        ExpressionTable(names, {name: tuple(row) for name, row in rows.items()}, source),
        np.where(texels.valid[..., None], texels.stderr, 0.0).astype(np.float32),
        texels.valid,
    )
    return WrinkleFit(
        layer, found, base, 1.0 - misfit / total if total > 0 else 0.0, outcome, clamp
    )


def _alternate(
    masks: Float64Array,
    data: Mapping[str, Difference],
    base: Derivatives,
    size: tuple[int, int],
    clamp: Clamp,
) -> tuple[dict[str, Float64Array], SolverOutcome]:
    """Alternate map and weights; return the weights and how the rounds ended.

    Weights hardly depend on fine detail: they are estimated at a resolution of two pixels per texel
    of map or masks.
    """
    rows = _initial_weights(masks, data, base)
    if len(data) == 1:
        # all weights are 1
        return rows, SolverOutcome(0, 0.0, UNKNOWN_CONDITION, "tolerance")
    shape = base.valid.shape
    rough = min(size[0], COARSE_SIDE), min(size[1], COARSE_SIDE)
    texels = max(rough[0], masks.shape[1]), max(rough[1], masks.shape[2])
    small = min(2 * texels[0], shape[0]), min(2 * texels[1], shape[1])
    data = {name: _reduced(one, small) for name, one in data.items()}
    bounds = (0.0 if clamp == "unit" else -math.inf, math.inf)
    left, gain, rounds = math.inf, math.inf, 0
    while gain > MISFIT_TOL and rounds < FIT_ROUNDS:
        rounds += 1
        equations = _equations(masks, _solve_map(masks, rows, data, rough, tolerance=1e-7), data)
        free = {name: one.solve_bounded(bounds) for name, one in equations.items()}
        rows = _limited(free)
        misfit = sum(equations[name].misfit(row) for name, row in free.items())
        total = sum(one.total for one in equations.values())
        gain, left = (left - misfit) / max(total, 1e-300), misfit
    stop: StopReason = "tolerance" if gain <= MISFIT_TOL else "limit"
    outcome = SolverOutcome(rounds, gain, UNKNOWN_CONDITION, stop)
    return rows, outcome.warn_unless_converged("wrinkle map and weights", _log)


def _reduced(difference: Difference, shape: tuple[int, int]) -> Difference:
    """Return a difference averaged to fewer pixels, weighted by its pixel weights."""
    height, width = difference.weight.shape
    if shape == (height, width):
        return difference
    ay = resampling.averaging_matrix(height, shape[0])
    ax = resampling.averaging_matrix(width, shape[1])

    def mean(image: FloatArray) -> Float64Array:
        return np.asarray((ay @ image.astype(np.float64)) @ ax.T)

    v = difference.weight.astype(np.float64)
    weight = mean(v)
    inverse = np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0)
    pixels = height * width / (shape[0] * shape[1])
    values = [mean(v * difference.values[..., c]) * inverse for c in (0, 1)]
    variance = [mean(v * v * difference.variance[..., c]) * inverse**2 / pixels for c in (0, 1)]
    return Difference(
        np.stack(values, axis=-1).astype(np.float32),
        np.stack(variance, axis=-1).astype(np.float32),
        weight.astype(np.float32),
    )


def differences(base: Derivatives, expressions: Mapping[str, Measured]) -> dict[str, Difference]:
    """Return expressions minus the neutral face, on pixels that are valid in both."""
    data = {}
    for name, given in expressions.items():
        one = measure_derivatives(given)
        Checks(WrinkleError).shape(name, one.values, base.values.shape)
        good = base.valid & one.valid
        kept = good[..., None]
        variance = np.where(kept, base.variance + one.variance, 0.0).astype(np.float32)
        values = np.where(kept, one.values - base.values, 0.0).astype(np.float32)
        data[name] = Difference(values, variance, _pixel_weights(variance, good))
    return data


def _pixel_weights(variance: FloatArray, good: BoolArray) -> Float32Array:
    """Return 1/variance relative to its median; 1 where it is not known; 0 where invalid."""
    mean = variance.mean(axis=2)
    known = good & (mean > 0)
    if not known.any():
        return good.astype(np.float32)
    low, middle = np.percentile(mean[known], [5, 50])
    return np.where(good, middle / np.maximum(mean, low), 0.0).astype(np.float32)


def _zone_names(count: int) -> tuple[str, ...]:
    known = JIMENEZ2011_TABLE.zones
    return known if count == len(known) else tuple(f"zone {z}" for z in range(count))


def _read(texels: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    planes = resampling.resample(np.moveaxis(texels, 2, 0), (shape[0], shape[1]))
    return np.moveaxis(planes, 0, 2)


def _solve_map(
    masks: Float64Array,
    rows: Mapping[str, Float64Array],
    data: Mapping[str, Difference],
    size: tuple[int, int],
    *,
    tolerance: float = SOLVER_TOL,
) -> Texels:
    """Solve for the map that fits expressions with known weights best."""
    # normal equations of sum_e v (s_e W - D_e)^2: weight sum v s^2, right side sum v s D, whose
    # variance is sum (v s)^2 var(D)
    shape = next(iter(data.values())).weight.shape
    weight, covered = np.zeros(shape), np.zeros(shape)
    product, noise = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    for name, one in data.items():
        small = np.tensordot(rows[name], masks, axes=1)
        strength = resampling.resample(small, (shape[0], shape[1]))
        v = one.weight * strength
        weight += v * strength
        product += v[..., None] * one.values
        noise += (v * v)[..., None] * one.variance
        covered = np.maximum(covered, one.weight > 0)
    return fit_texels(weight, product, noise, covered, size, tolerance=tolerance)


def _equations(
    masks: Float64Array, texels: Texels, data: Mapping[str, Difference]
) -> dict[str, ZoneEquations]:
    shape = next(iter(data.values())).weight.shape
    return build_equations(masks, _read(texels.values, shape), data, with_noise=False)


def _initial_weights(
    masks: Float64Array, data: Mapping[str, Difference], base: Derivatives
) -> dict[str, Float64Array]:
    """Return initial weights: in each zone, the leading eigenvector of the expressions' products.

    With one zone at a pixel, sum_x m_z D_e . D_f is w_e w_f times the zone's energy. The noise of
    an expression adds to the diagonal, and that of the shared neutral image to all entries: both
    are subtracted.
    """
    names = list(data)
    texels, shape = masks.shape[1:], base.valid.shape
    reduced = resampling.resample(masks, (min(texels[0], shape[0]), min(texels[1], shape[1])))
    by, bx = (
        resampling.reading_matrix(t, p) for t, p in zip(reduced.shape[1:], shape, strict=True)
    )
    products = np.zeros((len(masks), len(names), len(names)))
    for i, first in enumerate(names):
        for j, second in enumerate(names[: i + 1]):
            a, b = data[first], data[second]
            both = (a.weight > 0) & (b.weight > 0)
            shared = a.variance if i == j else base.variance
            dot = (a.values.astype(np.float64) * b.values - shared).sum(axis=2) * both
            small = (by.T @ dot) @ bx
            products[:, i, j] = products[:, j, i] = np.tensordot(reduced, small, axes=2)
    rows = np.zeros((len(names), len(masks)))
    for z, gram in enumerate(products):
        values, vectors = np.linalg.eigh(gram)
        if values[-1] > 0:
            rows[:, z] = vectors[:, -1]
    return _scaled({name: rows[i] for i, name in enumerate(names)})


def _limited(rows: Mapping[str, Float64Array]) -> dict[str, Float64Array]:
    """Return weights divided by their largest magnitude, where that is above 1."""
    largest = max(1.0, *(float(np.abs(row).max()) for row in rows.values()))
    return {name: row / largest for name, row in rows.items()}


def _scaled(rows: Mapping[str, Float64Array]) -> dict[str, Float64Array]:
    """Return weights with a largest magnitude of 1 in each zone; zones of zeros stay."""
    table = np.stack(list(rows.values()))
    largest = np.take_along_axis(table, np.abs(table).argmax(axis=0)[None], axis=0)[0]
    table = table / np.where(largest == 0, 1.0, largest)
    return dict(zip(rows, table, strict=True))
