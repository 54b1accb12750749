"""Start values of the chromophore fit: the color table inverted on a grid of log colors.

With the shading known there is a direction in log RGB along which the table's surface can be
projected on a plane without folding, so that each point of the plane has one pair of
chromophores. With the shading free the direction is that of gray, and dark skin folds back over
lighter skin. The start is then on the light side of the fold, and the grid stores the brightness of
the other solution.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b

import numpy as np
from scipy import ndimage
from scipy.optimize import linprog
from scipy.spatial import cKDTree

from model.color_table import ColorTable
from reconstruction.arrays import BoolArray, Float32Array, Float64Array

MIN_AXIS_FRACTION = 0.04
"""Smallest fraction of an axis that is fitted: 6.4e-5 of the largest volume fraction."""
START_GRID_SIZE = 256
"""Nodes along each axis of the start grid."""
_SAMPLES_PER_AXIS = 384  # colors along each axis of the table that the grid is filled from
_PLANE_MARGIN = 0.02  # fraction of the plane's extent around the table's colors
_POLISH_STEPS = 3
_USUAL_EXTENTS = (0.9, 0.8, 0.7, 0.6)
"""Fractions of both axes that an unfolding direction is searched for, in this order."""


@dataclass(frozen=True, slots=True, eq=False)
class InverseColorTable:
    """Inverted table: from a projected log color to fractions of the table's axes."""

    projection: Float64Array
    """Shape (2, 4): rows transform (log R, log G, log B, 1) to grid units."""
    axes: Float32Array
    """Shape (GRID, GRID, 2): fractions of the melanin and the blood axis, in [LOWEST, 1]."""
    twin_log: Float32Array
    """Shape (GRID, GRID): largest mean log RGB of a second solution, -inf without one."""
    normal: Float64Array
    """Shape (3,): unit direction in log RGB that is projected away."""
    side: float
    """Sign of the surface's side, seen along `normal`, that `axes` lie on."""


@dataclass(frozen=True, slots=True)
class _SameColors:
    """Table that equals another of the same colors: its inverse depends on nothing else."""

    digest: bytes
    table: ColorTable = field(compare=False)


def inverse_table_for(table: ColorTable, free_shading: bool) -> InverseColorTable:
    """Return the inverted table, cached for the colors of the tables used last."""
    digest = blake2b(table.rgb.tobytes()).digest()
    return _invert_table(_SameColors(digest, table), free_shading)


@lru_cache(maxsize=16)
def _invert_table(colors: _SameColors, free_shading: bool) -> InverseColorTable:
    table = colors.table
    fraction = np.linspace(MIN_AXIS_FRACTION, 1.0, _SAMPLES_PER_AXIS)
    a, b = np.meshgrid(fraction, fraction, indexing="ij")
    rgb, by_a, by_b = evaluate_table(table, a, b)
    log_rgb = np.log(rgb)
    across = np.cross(by_a / rgb, by_b / rgb)
    normal = np.full(3, 1.0 / np.sqrt(3.0)) if free_shading else _unfolding_direction(across)
    facing = across @ normal
    most = np.sign(np.median(facing))
    chosen = _light_side(facing) if free_shading else facing * most > 0.0
    plane = _plane(log_rgb[chosen], normal)
    y = log_rgb @ plane.T
    low, high = y[chosen].min(axis=0), y[chosen].max(axis=0)
    margin = _PLANE_MARGIN * (high - low)
    scale = (START_GRID_SIZE - 1) / (high - low + 2.0 * margin)
    projection = plane * scale[:, None]
    offset = -(low - margin) * scale
    line = np.arange(START_GRID_SIZE, dtype=np.float64)
    nodes = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    # Distances are in log color, not grid units: the nearest color is the start outside the table.
    tree = cKDTree(y[chosen])
    _, nearest = tree.query((nodes.reshape(-1, 2) - offset) / scale)
    axes = np.stack([a[chosen][nearest], b[chosen][nearest]], axis=-1)
    axes = _polish(table, axes, nodes.reshape(-1, 2), projection, offset)
    twin = _twin_grid(log_rgb[~chosen], projection, offset)
    return InverseColorTable(
        np.column_stack([projection, offset]),
        axes.reshape(START_GRID_SIZE, START_GRID_SIZE, 2).astype(np.float32),
        twin,
        normal,
        float(np.sign(np.median(facing[chosen]))),
    )


def evaluate_table(
    table: ColorTable, a: Float64Array, b: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the color and its derivatives by the fractions a and b of the table's axes."""
    last = table.size - 1
    i, j = a * last, b * last
    row = np.clip(i.astype(np.intp), 0, last - 1)
    column = np.clip(j.astype(np.intp), 0, last - 1)
    x, y = (i - row)[..., None, None], (j - column)[..., None]
    cell = table.cells[row, column]
    inner = ((cell[..., 3, :] * x + cell[..., 2, :]) * x + cell[..., 1, :]) * x + cell[..., 0, :]
    inner_x = (3.0 * cell[..., 3, :] * x + 2.0 * cell[..., 2, :]) * x + cell[..., 1, :]

    def along(c: Float64Array) -> Float64Array:
        return ((c[..., 3] * y + c[..., 2]) * y + c[..., 1]) * y + c[..., 0]

    by_y = (3.0 * inner[..., 3] * y + 2.0 * inner[..., 2]) * y + inner[..., 1]
    return along(inner), last * along(inner_x), last * by_y


def _unfolding_direction(across: Float64Array) -> Float64Array:
    """Return the unit vector that maximizes the minimum cosine to the surface's normals.

    All facets then project with the same orientation, so that the projection does not fold. As a
    linear program: maximize m subject to n . d >= m for all unit normals n, |d_i| <= 1. A camera
    that hardly separates blood from melanin can fold the surface in any direction; then only skin
    of usual melanin and blood counts.
    """
    facets = across[::8, ::8]
    facets = facets / np.linalg.norm(facets, axis=-1, keepdims=True)
    for extent in (1.0, *_USUAL_EXTENTS):
        end = round(extent * len(facets))
        direction, margin = _widest_cone(facets[:end, :end].reshape(-1, 3))
        if margin > 1e-6:
            break
    return direction / np.linalg.norm(direction)


def _widest_cone(facets: Float64Array) -> tuple[Float64Array, float]:
    """Return the direction of the greatest minimum product with unit normals, and that product."""
    result = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.c_[-facets, np.ones(len(facets))],
        b_ub=np.zeros(len(facets)),
        bounds=[(-1.0, 1.0)] * 3 + [(None, None)],
    )
    if not result.x[3] > 0.0:
        return np.asarray(facets.mean(axis=0)), 0.0
    return np.asarray(result.x[:3]), float(result.x[3])


def _light_side(facing: Float64Array) -> BoolArray:
    """Return the samples that melanin reaches without a fold, around light skin with some blood.

    A second fold can follow the first one; behind it dark skin has the orientation of light skin.
    """
    corner = facing[: _SAMPLES_PER_AXIS // 8, _SAMPLES_PER_AXIS // 4 : _SAMPLES_PER_AXIS // 2]
    same = facing * np.sign(np.median(corner)) > 0.0
    regions, _ = ndimage.label(np.logical_and.accumulate(same, axis=0))
    seed = regions[: _SAMPLES_PER_AXIS // 8, _SAMPLES_PER_AXIS // 4 : _SAMPLES_PER_AXIS // 2]
    if not seed.any():  # a coarse table is folded at its lightest skin too
        return np.asarray(same)
    return np.asarray(regions == np.bincount(seed[seed > 0]).argmax())


def _plane(log_rgb: Float64Array, normal: Float64Array) -> Float64Array:
    """Return two unit vectors across `normal`, along the principal axes of the colors."""
    flat = log_rgb - np.outer(log_rgb @ normal, normal)
    flat = flat - flat.mean(axis=0)
    _, vectors = np.linalg.eigh(flat.T @ flat)
    first = vectors[:, -1] - (vectors[:, -1] @ normal) * normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _polish(
    table: ColorTable,
    axes: Float64Array,
    nodes: Float64Array,
    projection: Float64Array,
    offset: Float64Array,
) -> Float64Array:
    """Move the fractions towards their node's projected color by damped Newton steps."""
    best = axes.copy()
    best_miss = np.full(len(axes), np.inf)
    for _ in range(_POLISH_STEPS + 1):
        rgb, by_a, by_b = evaluate_table(table, axes[:, 0], axes[:, 1])
        miss = nodes - np.log(rgb) @ projection.T - offset
        size = np.hypot(miss[:, 0], miss[:, 1])
        closer = size < best_miss
        best[closer], best_miss[closer] = axes[closer], size[closer]
        j_a, j_b = (by_a / rgb) @ projection.T, (by_b / rgb) @ projection.T
        det = j_a[:, 0] * j_b[:, 1] - j_a[:, 1] * j_b[:, 0]
        det = np.where(np.abs(det) > 1e-9, det, 1e-9)
        step_a = (miss[:, 0] * j_b[:, 1] - miss[:, 1] * j_b[:, 0]) / det
        step_b = (j_a[:, 0] * miss[:, 1] - j_a[:, 1] * miss[:, 0]) / det
        step = np.stack([step_a, step_b], axis=-1)
        reach = 2.0 / _SAMPLES_PER_AXIS
        axes = np.clip(best + np.clip(step, -reach, reach), MIN_AXIS_FRACTION, 1.0)
    return best


def _twin_grid(
    log_rgb: Float64Array, projection: Float64Array, offset: Float64Array
) -> Float32Array:
    """Return, per grid cell, the mean log RGB of the lightest second solution."""
    grid = np.full((START_GRID_SIZE, START_GRID_SIZE), -np.inf)
    place = np.rint(log_rgb @ projection.T + offset).astype(np.intp)
    inside = np.all((place >= 0) & (place < START_GRID_SIZE), axis=-1)
    place = place[inside]
    np.maximum.at(grid, (place[:, 0], place[:, 1]), log_rgb[inside].mean(axis=-1))
    return np.asarray(ndimage.grey_dilation(grid, size=(3, 3)), dtype=np.float32)


N_LINES = 49
"""Number of lines, each at one melanin value."""
N_LINE_NODES = 65
"""Blood values at which each line's colors are stored."""
NODES_PER_LINE = 32
"""Nodes of melanin's probability per line interval."""
MELANIN_AXIS = np.linspace(float(MIN_AXIS_FRACTION), 1.0, (N_LINES - 1) * NODES_PER_LINE + 1)
"""Fractions of the melanin axis, its cube root, at these nodes."""


@dataclass(frozen=True, slots=True, eq=False)
class EqualMelaninLines:
    """Log colors of skin along lines of equal melanin, each array (LINES, NODES, 3)."""

    log_rgb: Float64Array
    """Natural logarithm of the color over that of a white reference."""
    by_a: Float64Array
    """Derivative by the fraction of the melanin axis."""
    by_b: Float64Array
    """Derivative by the fraction of the blood axis."""


@lru_cache(maxsize=16)
def equal_melanin_lines(table: ColorTable) -> EqualMelaninLines:
    """Return the lines of a table, cached for the tables used last."""
    low = float(MIN_AXIS_FRACTION)
    a, b = np.meshgrid(
        np.linspace(low, 1.0, N_LINES), np.linspace(low, 1.0, N_LINE_NODES), indexing="ij"
    )
    color, by_a, by_b = evaluate_table(table, a, b)
    return EqualMelaninLines(np.log(color), by_a / color, by_b / color)
