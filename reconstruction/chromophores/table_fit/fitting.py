"""Fit a color table to pixels: arguments, priors and start values of the compiled kernel."""

from functools import lru_cache

import numpy as np
from scipy import ndimage

from model import spectra
from model.color_table import ColorTable
from model.threads import run_in_blocks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.chromophores.model_error import model_covariance
from reconstruction.chromophores.start import evaluate_table, inverse_table_for
from reconstruction.chromophores.table_fit import interval_factors, kernels

MAX_IDENTIFIABLE_STDERR = 1.0
"""Relative standard error above which a chromophore counts as not identifiable."""
POPULATION_MELANIN = 0.037
"""Median melanin of measured spectra of skin (ISSA), as a volume fraction."""
POPULATION_BLOOD = 0.011
"""Median blood volume fraction of them."""
POPULATION_LOG_SD = (1.0, 1.5)
"""Standard deviations of log melanin and of log blood over people and sites. Types I to VI span
2.7 in log melanin; published blood volume fractions of skin span 0.002 to 0.07, or 3.6."""
_TASK_PIXELS = 8192
_NO_FACTORS = np.ones((1, 1, 2), np.float32)
_NO_SLOPES = np.zeros((1, 1, 3), np.float32)
_SLOPE_HEIGHTS = (-0.05, 0.05)
"""Heights over the table's surface in log RGB between which the start grid's slopes are taken."""
_NO_LIMITS = np.float32(np.inf), np.float32(MAX_IDENTIFIABLE_STDERR)


def fit_colors(
    rgb: Float32Array,
    variance: Float32Array,
    shading: tuple[bool, Float32Array, BoolArray],
    covariance: Float64Array,
    table: ColorTable,
    limits: tuple[np.float32, np.float32],
) -> tuple[Float32Array, BoolArray]:
    """Fit pixels; return maps (7, n) and masks (5, n), see `kernels.fit_pixels`.

    Parameters
    ----------
    rgb, variance
        (n, 3); one variance (1, 3) serves all pixels.
    shading
        Whether it is free, the known shading and which pixels are usable, (n,) or (1,) each.
    covariance
        (3, 3): covariance of relative errors that is added to the noise.
    table
        Color table, with its covariance by unknown optics.
    limits
        Largest plausible log shading, and largest relative standard error of an identifiable
        chromophore.
    """
    if shading[0] or table.optics_covariance is None:
        start = inverse_table_for(table, shading[0]).axes, _NO_SLOPES
        return _fit(rgb, variance, shading, covariance, table, start, _NO_FACTORS, limits)
    start, factors = _start_with_optics(table), _interval_factors(table)
    return _fit(rgb, variance, shading, covariance, table, start, factors, limits)


def _fit(
    rgb: Float32Array,
    variance: Float32Array,
    shading: tuple[bool, Float32Array, BoolArray],
    covariance: Float64Array,
    table: ColorTable,
    start_grid: tuple[Float32Array, Float32Array],
    factors: Float32Array,
    limits: tuple[np.float32, np.float32],
) -> tuple[Float32Array, BoolArray]:
    """Fit pixels from a start grid, see `_start_with_optics`, with factors of errors (k, k, 2)."""
    maps = np.empty((len(kernels.INVERSION_MAPS), len(rgb)), dtype=np.float32)
    masks = np.empty((len(kernels.INVERSION_MASKS), len(rgb)), dtype=np.bool_)
    free, known, usable = shading
    start = inverse_table_for(table, free)
    run_in_blocks(
        kernels.fit_pixels,
        len(rgb),
        _TASK_PIXELS,
        rgb,
        variance,
        known,
        usable,
        free,
        covariance.astype(np.float32),
        optics_triangles(table),
        _axis_prior(table, free),
        factors,
        np.ascontiguousarray(table.cells, dtype=np.float32),
        np.array([table.c_m_max, table.c_hd_max], dtype=np.float32),
        np.ascontiguousarray(start.projection, dtype=np.float32),
        *start_grid,
        np.ascontiguousarray(start.normal, dtype=np.float32),
        start.twin_log,
        limits[0],
        np.float32(start.side),
        limits[1],
        maps,
        masks,
    )
    return maps, masks


@lru_cache(maxsize=16)
def _start_with_optics(table: ColorTable) -> tuple[Float32Array, Float32Array]:
    """Return the start grid as unknown optics and priors move it, and its slopes.

    Returns
    -------
    axes : ndarray, shape (g, g, 2)
        Fit of the grid's own colors.
    slopes : ndarray, shape (g, g, 3)
        Height of the table's surface along the grid's normal in log RGB, and the change of both
        fractions per unit of height. Without them, colors off the surface would start far from
        their fit.
    """
    start = inverse_table_for(table, False)
    axes, shape = start.axes, start.axes.shape[:2]
    color, _, _ = evaluate_table(table, *np.moveaxis(axes.reshape(-1, 2).astype(np.float64), 1, 0))
    moved, sides = axes, []
    for height in (0.0, *_SLOPE_HEIGHTS):
        found, good = _fit_axes(table, color * np.exp(height * start.normal), axes)
        if height:
            sides.append(np.where(good, found, np.nan))
        else:
            moved = np.where(good, found, axes)
    change = (sides[1] - sides[0]) / (_SLOPE_HEIGHTS[1] - _SLOPE_HEIGHTS[0])
    level = (np.log(color) @ start.normal).reshape(*shape, 1)
    slopes = np.concatenate([level, np.nan_to_num(change)], axis=-1)
    return moved, np.ascontiguousarray(slopes, np.float32)


def _fit_axes(
    table: ColorTable, color: Float64Array, axes: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Fit the colors of a grid (g, g, 2) without noise; return its axes and which are valid."""
    one, all_usable = np.ones(1, np.float32), np.ones(1, np.bool_)
    maps, masks = _fit(
        np.ascontiguousarray(color, np.float32),
        np.zeros((1, 3), np.float32),
        (False, one, all_usable),
        model_covariance(None, True),
        table,
        (axes, _NO_SLOPES),
        _NO_FACTORS,
        _NO_LIMITS,
    )
    ends = np.array([[table.c_m_max], [table.c_hd_max]])
    found = np.cbrt(maps[:2] / ends).astype(np.float32).T.reshape(axes.shape)
    return found, masks[0].reshape(*axes.shape[:2], 1)


@lru_cache(maxsize=16)
def _interval_factors(table: ColorTable) -> Float32Array:
    """Return factors of both standard errors on the table's axes (k, k, 2); k = 1: none.

    A camera that `model.spectra` does not contain has none, since the skins have no colors for it.
    """
    cameras, lights = spectra.camera_names(), spectra.illuminant_names()
    if table.camera not in cameras or table.illuminant not in lights:
        return _NO_FACTORS
    skins = interval_factors.load_interval_skins()
    rgb = spectra.band_average(
        skins.reflectance, table.camera, table.illuminant, wavelength_nm=skins.wavelength_nm
    )
    rng = np.random.default_rng(0)
    rgb *= 1.0 + interval_factors.CHANNEL_NOISE * rng.standard_normal(rgb.shape)
    one, all_usable = np.ones(1, np.float32), np.ones(1, np.bool_)
    maps, masks = _fit(
        np.ascontiguousarray(rgb, np.float32),
        np.square(interval_factors.CHANNEL_NOISE * rgb).astype(np.float32),
        (False, one, all_usable),
        model_covariance(0.0, False),
        table,
        _start_with_optics(table),
        _NO_FACTORS,
        _NO_LIMITS,
    )
    melanin = skins.melanin_optical_depth / table.constants.melanin_depth_factor
    root = np.cbrt(maps[:2].astype(np.float64).T)
    error = root - np.cbrt(np.stack([melanin, skins.hemoglobin], axis=-1))
    stderr = maps[3:5].T / (3.0 * np.square(root))
    angle = interval_factors.node_typology_angles(table)
    ends = np.cbrt([table.c_m_max, table.c_hd_max])
    nodes = (interval_factors.NODES_PER_AXIS - 1) * root / ends
    estimated = ndimage.map_coordinates(angle, nodes.T, order=1, mode="nearest")
    centers, factors = interval_factors.fit_band_factors(error / stderr, skins, masks[0], estimated)
    found = interval_factors.interpolate_factors(angle, centers, factors)
    return np.ascontiguousarray(found, np.float32)


def _axis_prior(table: ColorTable, free: bool) -> Float32Array:
    """Return means and precisions of the axes' fractions over people.

    They are zeros for exact optics, and for a free shading: a color then has one pair of
    chromophores on the light side of the fold, and `posterior` has the priors.
    """
    if table.optics_covariance is None or free:
        return np.zeros(4, dtype=np.float32)
    ends = np.array([table.c_m_max, table.c_hd_max])
    mean = np.cbrt(np.array([POPULATION_MELANIN, POPULATION_BLOOD]) / ends)
    sd = mean * np.array(POPULATION_LOG_SD) / 3.0  # c = c_max a^3, hence da = a d(ln c) / 3
    return np.concatenate([mean, sd**-2.0]).astype(np.float32)


@lru_cache(maxsize=16)
def optics_triangles(table: ColorTable) -> Float32Array:
    """Return upper triangles of a table's covariance by unknown optics, (n, n, 6); n = 1: none."""
    nodes = table.optics_covariance
    if nodes is None:
        return np.zeros((1, 1, 6), dtype=np.float32)
    row, column = np.triu_indices(3)
    return np.ascontiguousarray(nodes[..., row, column], dtype=np.float32)
