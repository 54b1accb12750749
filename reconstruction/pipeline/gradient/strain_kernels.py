"""Histograms of the normals of strained skin, and kernels that map neutral skin's to them."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from model.microstructure import KernelTableError
from model.skin import SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from reconstruction.kernel_fit import fit_kernel
from reconstruction.kernel_fit.fit import ALPHA_GRID, SIGMAS_UM
from reconstruction.kernel_fit.outcome import KernelFit
from reconstruction.kernel_fit.table import (
    KernelTableFitError,
    estimate_direction_dependence,
    fit_table,
)
from reconstruction.normal_histogram.blocks import (
    BLOCKS_PER_SIDE,
    block_grid_shape,
    count_block_normals,
)
from reconstruction.normal_histogram.relief_slopes import rotate_components, slopes
from reconstruction.normal_histogram.statistics import NormalStatistics, measure_normals
from reconstruction.pipeline.gradient.skin_strain import StateStrain
from reconstruction.pipeline.graph import select_attributes

MIN_SAMPLES = 1000
"""Minimum number of pixels of a histogram."""
MIN_STRAIN = 0.01
"""Minimum strain of a kernel: below it, the kernel would fit the noise."""
LINE_POINTS = 61
MAX_FULL_GRID_PX = 1_000_000
"""Patches of fewer pixels resolve kernels no finer than `COARSE_GRID_STEP` steps of the paper's
grid."""
COARSE_GRID_STEP = 3
UNRESOLVED_VARIANCE = 1.07
"""True variances over those found: walls that hide most of their lights look less steep, and relief
that the lens does not resolve has slopes, too. Set on forehead (seeds 0, 31) and cheek (32)."""
HIDDEN_VARIANCE_RATIO = 0.1
"""Relative error of a variance by walls that hide their lights, and detail that the lens removes.
An upper bound: the root mean square over both axes and 47 steps of eight patches of 1.2 mm is 0.06.
It is a bias, not scatter: states and patches share it."""


def count_normals(
    strains: Sequence[StateStrain], heights: Mapping[str, SkinMap], *, pixel_um: float
) -> dict[str, NormalStatistics]:
    """Count the normals of every state on axes along and across its jaws.

    Parameters
    ----------
    strains
        Of every state; the first is the neutral one.
    heights
        By the name of the state, um.
    pixel_um
        Size of a pixel.

    Returns
    -------
    dict
        By the name of the state; states with too few pixels are omitted.
    """
    found: dict[str, NormalStatistics] = {}
    for each in strains:
        height = heights[each.state.name]
        both = common_skin(each, strains[0], heights)
        if np.count_nonzero(both) >= MIN_SAMPLES:
            found[each.state.name] = measure_normals(
                height.values, pixel=pixel_um, valid=both, angle_rad=each.state.angle_rad
            )
    return found


def lost_variances(
    height: Float32Array,
    slope_error: Float32Array,
    *,
    pixel_um: float,
    valid: BoolArray,
    angle_rad: float,
) -> tuple[float, float]:
    """Return the variances of the normals' components that the errors of the slopes stand for.

    The most probable relief is smoother than the true one: of each wave it lacks as much variance
    as the wave's error has. The errors here are a part of it, half to three quarters in linear
    simulations: integration removes what belongs to no surface, which lost relief does not.

    Parameters
    ----------
    height
        (H, W), um.
    slope_error
        (H, W): variance of one slope's error, that of the other is equal and independent.
    pixel_um
        Size of a pixel.
    valid
        (H, W): pixels whose normals are counted.
    angle_rad
        Axis of the jaws, counterclockwise from +x.

    Returns
    -------
    float, float
        Along and across the jaws, to first order in the error: the normal -p w with
        w = (1 + p^2 + q^2)^-1/2 has the derivatives -(1 + q^2) w^3 and p q w^3. 0 without a slope.

    Examples
    --------
    A plane of slope 1 along x:

    >>> plane, error = np.arange(9.0) * np.ones((9, 1)), np.full((9, 9), 0.01)
    >>> valid = np.ones((9, 9), bool)
    >>> found = lost_variances(plane, error, pixel_um=1.0, valid=valid, angle_rad=0.0)
    >>> [round(one, 5) for one in found]
    [0.00125, 0.005]
    """
    p, q, known = slopes(height, pixel=pixel_um, valid=valid)
    if not known.any():
        return 0.0, 0.0
    p, q = (one[known] ** 2 for one in rotate_components(p, q, angle_rad))
    lost = slope_error[known] / (1.0 + p + q) ** 3
    along, across = (np.mean(lost * ((1.0 + one) ** 2 + p * q)) for one in (q, p))
    return float(along), float(across)


def histogram_document(
    strains: Sequence[StateStrain],
    found: Mapping[str, NormalStatistics],
    lost: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, Any]:
    """Return the histograms as a document.

    Its variances are those of the height maps and of what their filter has removed, times
    `UNRESOLVED_VARIANCE`. Standard errors of the variances include the variation between patches of
    the same skin and size, and `HIDDEN_VARIANCE_RATIO`.

    Parameters
    ----------
    strains
        Of every state.
    found
        Statistics by the name of the state.
    lost
        Variances along and across the jaws by the name of the state, see `lost_variances`; None:
        all 0.
    """
    removed = lost or {}
    of_samples = "samples outside effective_samples samples_per_bucket aliased"

    def hidden(stderr: float, variance: float) -> float:
        return math.hypot(stderr, HIDDEN_VARIANCE_RATIO * variance)

    return {
        "schema": "skinrig.histograms/1",
        "axes": "rows n across the jaws, columns n along them, each -1 to 1",
        "states": [
            {
                "name": each.state.name,
                "angle_deg": each.state.angle_deg,
                "counts": one.histogram,
                **select_attributes(one, of_samples),
                "variance_s": UNRESOLVED_VARIANCE * (one.variance_x + gone[0]),
                "variance_s_stderr": UNRESOLVED_VARIANCE * hidden(one.stderr_x, one.variance_x),
                "variance_t": UNRESOLVED_VARIANCE * (one.variance_y + gone[1]),
                "variance_t_stderr": UNRESOLVED_VARIANCE * hidden(one.stderr_y, one.variance_y),
                "lost_variance_s": gone[0],
                "lost_variance_t": gone[1],
            }
            for each in strains
            if (one := found.get(each.state.name)) is not None
            and (gone := removed.get(each.state.name, (0.0, 0.0))) is not None
        ],
    }


def common_skin(
    each: StateStrain, neutral: StateStrain, heights: Mapping[str, SkinMap], *, there: bool = True
) -> BoolArray:
    """Return the valid pixels whose skin is visible in both the state and the neutral one.

    Parameters
    ----------
    each, neutral
        The states.
    heights
        By the name of the state, um.
    there
        True: pixels of the state; False: pixels of the neutral one.

    Returns
    -------
    ndarray of bool, shape (H, W)
        All valid pixels of a state whose strain is unknown.
    """
    other, own = (heights[one.state.name].mask for one in (neutral, each))
    if not there:
        other, own = own, other
    shape = own.shape
    if not each.usable:
        return own
    seen = other.astype(np.uint8)
    affine = each.strain.affine_px((shape[0], shape[1]))
    # a pixel of the state is common where its inverse-mapped position is valid in the neutral map
    back = affine if not there else _inverse(affine)
    common = ndimage.map_coordinates(seen, _moved(back, shape), order=0, cval=0) > 0
    return np.asarray(own & common)


def _moved(affine: Float64Array, shape: tuple[int, ...]) -> list[Float64Array]:
    """Return the rows and columns to which an affine map of (column, row) takes each pixel."""
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    return [
        affine[1, 0] * columns + affine[1, 1] * rows + affine[1, 2],
        affine[0, 0] * columns + affine[0, 1] * rows + affine[0, 2],
    ]


def _skin_blocks(
    each: StateStrain, height: SkinMap, *, pixel_um: float, there: BoolArray
) -> Int64Array:
    """Count a state's normals in each block of the neutral map's skin, rotated to its jaws.

    Parameters
    ----------
    each, height
        The state.
    pixel_um
        Size of a pixel.
    there
        (H, W): pixels of the state to count.

    Returns
    -------
    ndarray, shape (rows, columns, bins, bins)
        As `fit_kernel` takes them.
    """
    shape = (there.shape[0], there.shape[1])
    row, column = _moved(_inverse(each.strain.affine_px(shape)), shape)
    # from the neutral map to its rotation by `_along_x`
    c, s = math.cos(each.state.angle_rad), math.sin(each.state.angle_rad)
    middle = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    x, y = column - middle[0], middle[1] - row
    row, column = middle[1] - (c * y - s * x), middle[0] + (c * x + s * y)
    grid = block_grid_shape(shape, BLOCKS_PER_SIDE)
    down, right = (
        np.floor((place + 0.5) * parts / side).astype(np.int64)
        for place, parts, side in zip((row, column), grid, shape, strict=True)
    )
    inside = (down >= 0) & (down < grid[0]) & (right >= 0) & (right < grid[1])
    block = np.where(inside, down * grid[1] + right, -1)
    angle_rad, blocks = each.state.angle_rad, grid[0] * grid[1]
    counts = count_block_normals(
        height.values, block, blocks, pixel=pixel_um, valid=there, angle_rad=angle_rad
    )
    return counts.reshape(*grid, *counts.shape[1:])


def _inverse(affine: Float64Array) -> Float64Array:
    linear = np.linalg.inv(affine[:, :2])
    return np.column_stack([linear, -linear @ affine[:, 2]])


def _along_x(
    height: Float32Array, valid: BoolArray, angle_rad: float
) -> tuple[Float32Array, BoolArray]:
    """Rotate a map so that the jaws' axis is along its rows."""
    if abs(math.sin(angle_rad)) < 1e-9:
        return height, valid
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    rows, columns = np.indices(height.shape)
    middle = np.array([(height.shape[1] - 1) / 2, (height.shape[0] - 1) / 2])
    x, y = columns - middle[0], middle[1] - rows
    places = [middle[1] - (s * x + c * y), middle[0] + (c * x - s * y)]
    turned = ndimage.map_coordinates(height, places, order=3, mode="nearest")
    # a cubic spline has a support of two pixels to each side, all of which must be valid
    solid = ndimage.binary_erosion(valid, iterations=2, border_value=0)
    return turned, ndimage.map_coordinates(solid.astype(np.uint8), places, order=0, cval=0) > 0


def fit_kernels(
    strains: Sequence[StateStrain],
    heights: Mapping[str, SkinMap],
    statistics: Mapping[str, NormalStatistics],
    *,
    pixel_um: float,
    compute_tiles: Callable[..., Iterator[dict[str, Any] | None]],
) -> dict[str, Any]:
    """Fit a kernel to every strained state, and lines to the kernels of each angle.

    Parameters
    ----------
    strains, heights, pixel_um
        As of `count_normals`.
    statistics
        What it returned.
    compute_tiles
        See `reconstruction.pipeline.inputs.Inputs.compute_tiles`.

    Returns
    -------
    dict
        The document.
    """
    neutral = strains[0]
    height = heights[neutral.state.name]
    counted = [each for each in strains[1:] if each.usable and each.state.name in statistics]
    todo = [each for each in counted if abs(each.stretch_s[0] - 1.0) >= MIN_STRAIN]

    def fit_state(each: StateStrain) -> dict[str, Any] | None:
        seen = common_skin(each, neutral, heights, there=False)
        turned, inside = _along_x(height.values, seen, each.state.angle_rad)
        if np.count_nonzero(inside) < MIN_SAMPLES:
            return None
        target, strained = statistics[each.state.name], heights[each.state.name]
        there = common_skin(each, neutral, heights)
        every = 1 if np.count_nonzero(inside) >= MAX_FULL_GRID_PX else COARSE_GRID_STEP
        fit = fit_kernel(
            turned,
            target.histogram,
            stretch=each.stretch_s[0],
            axis="x",
            pixel_um=pixel_um,
            valid=inside,
            stretch_across=each.stretch_t[0],
            grid=(ALPHA_GRID[::every], SIGMAS_UM[::every]),
            target_samples=target.effective_samples,
            target_blocks=_skin_blocks(each, strained, pixel_um=pixel_um, there=there),
        )
        return _entry(each, fit)

    fits = [fit for fit in compute_tiles("kernels", todo, fit_state) if fit is not None]
    angles = sorted({fit["angle_deg"] for fit in fits})
    tables = [table for angle in (None, *angles) if (table := _table(fits, angle)) is not None]
    found = {"fits": fits, "tables": tables, "direction": _direction(fits)}
    return {"schema": "skinrig.kernels/1", **found}


def _entry(each: StateStrain, fit: KernelFit) -> dict[str, Any]:
    names = (
        "alpha alpha_stderr sigma_um sigma_stderr_um alpha_95 sigma_95_um alpha_interval "
        "sigma_interval_um alpha_refined sigma_refined_um distance distance_before"
    )
    return {
        "name": each.state.name,
        "angle_deg": each.state.angle_deg,
        "stretch_s": each.stretch_s[0],
        "stretch_s_stderr": each.stretch_s[1],
        "stretch_t": each.stretch_t[0],
        **select_attributes(fit, names),
        "distance_noise": fit.noise,
        "noise_floor": fit.floor,
        "near_best_count": len(fit.near_best),
        **select_attributes(fit, "at_edge aliased search valid reason"),
    }


def _table(fits: Sequence[Mapping[str, Any]], angle: float | None) -> dict[str, Any] | None:
    """Fit lines to the kernels of one angle, or of all; None where there are too few."""
    chosen = [fit for fit in fits if fit["valid"] and angle in (None, fit["angle_deg"])]
    if angle is not None and len({fit["angle_deg"] for fit in fits}) < 2:
        return None
    try:
        columns = ("stretch_s", "alpha", "sigma_um")
        found = fit_table(*([fit[name] for fit in chosen] for name in columns))
    except (KernelTableFitError, KernelTableError):  # too few points, or lines that reach sigma 0
        return None
    table = found.table
    low, high = table.stretch_range
    r = np.linspace(low, high, LINE_POINTS)
    sigma = np.full(r.size, np.nan)
    for line, part in ((table.sigma_compression_um, r < 1.0), (table.sigma_stretch_um, r >= 1.0)):
        if line is not None:
            sigma[part] = line[0] * r[part] + line[1]
    alpha = np.clip(table.unlimited_alpha(r), -2.0, 1.0)
    lines = "alpha_breaks alpha_lines sigma_compression_um sigma_stretch_um"
    return {
        "name": "all angles" if angle is None else f"{angle:.0f} degrees",
        **select_attributes(table, lines),
        "stretch_range": (low, high),
        **select_attributes(found, "alpha_rms sigma_rms_um"),
        "lines": {"stretch": r, "alpha": alpha, "sigma_um": sigma},
    }


def _direction(fits: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Fit the kernels' dependence on the stretch direction; None where undetermined."""
    chosen = [fit for fit in fits if fit["valid"]]
    names = ("stretch_s", "alpha", "sigma_um", "angle_deg")
    stretch, alpha, sigma, angle_deg = ([fit[name] for fit in chosen] for name in names)
    try:
        table = fit_table(stretch, alpha, sigma).table
        found = estimate_direction_dependence(table, stretch, alpha, sigma, np.radians(angle_deg))
    except (KernelTableFitError, KernelTableError):
        return None
    errors = "alpha_offset alpha_stderr sigma_offset_um sigma_stderr_um p_alpha p_sigma"
    return {"angle_deg": np.degrees(found.angle_rad), **select_attributes(found, errors)}
