"""Benchmarks of the layered reflectance and of the color table."""

from functools import partial

import numpy as np

from model import color_table, metrics, spectra
from model.tissue_optics import layers as tissue_optics
from rigsim.tissue.skin_table import SkinTable
from skinrig.arrays import Float64Array
from skinrig.benchmarks.description import described
from skinrig.benchmarks.measurement import measure_and_keep, measured
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import BandError, Knobs, Point, StageBenchmark
from skinrig.evaluating.skin_bands import MELANIN_BANDS, melanin_band

BAND_TABLE_SIZE = 64
"""Of the table that errors by band are of."""


def layered_reflectance(*, toy: bool) -> StageBenchmark:
    """Compare the tiers of the layered reflectance with the simulator's Monte Carlo table."""
    rng = np.random.default_rng(0)
    truth = SkinTable.load()
    count = 24 if toy else 200
    # at the nodes of the Monte Carlo table, where it has no interpolation error
    rows = rng.integers(2, truth.c_m.size, count)
    columns = rng.integers(2, truth.c_hd.size, count)
    c_m, c_hd = truth.c_m[rows], truth.c_hd[columns]
    reference = truth.reflectance[rows, columns]
    reference_error = 100 * np.median(truth.standard_error[rows, columns] / reference)
    tiers: list[Knobs] = [{"tier": "diffusion"}]
    for g in (0.0, tissue_optics.ANISOTROPY_SKIN):
        for directions in (4, 8) if toy else (4, 8, 16, 24):
            tiers.append({"tier": "adding_doubling", "g": g, "directions": directions})

    def evaluate(knobs: Knobs) -> Float64Array:
        if knobs["tier"] == "diffusion":
            return tissue_optics.two_layer_reflectance(
                truth.wavelength_nm, c_m, c_hd, tier="diffusion"
            )
        return tissue_optics.two_layer_reflectance(
            truth.wavelength_nm,
            c_m,
            c_hd,
            anisotropy=float(knobs["g"]),
            directions=int(knobs["directions"]),
        )

    def relative(found: Float64Array) -> Float64Array:
        return np.asarray(100 * np.abs(found / reference - 1))

    points = [
        measured(
            knobs,
            partial(evaluate, knobs),
            lambda found: BandError(*metrics.median_with_interval(relative(found), rng=rng)),
            repeats=1 if toy else 3,
        )
        for knobs in tiers
    ]
    off, bands = relative(evaluate(tiers[-1])), melanin_band(c_m)
    return described(
        "layered-reflectance",
        points,
        by_band={band: median_error(off[bands == band]) for band in MELANIN_BANDS},
        reference_error=float(reference_error),
    )


def table(*, toy: bool) -> StageBenchmark:
    """Measure the color table's interpolation error in Delta E 2000 over its size."""
    rng = np.random.default_rng(0)
    count = 40 if toy else 400
    c_m = 0.5 * rng.random(count) ** 3
    c_hd = 0.32 * rng.random(count) ** 3
    wavelength = spectra.WAVELENGTH_NM
    direct = tissue_optics.two_layer_reflectance(wavelength, c_m, c_hd)
    reference = _lab(spectra.band_average(direct, spectra.LINEAR_SRGB, "D65"))
    points = []
    smallest = {"spline": float("nan"), "bilinear": float("nan")}
    by_band: dict[str, BandError] = {}
    for size in (8, 16, 32, 64) if toy else (8, 16, 32, 64, 128, 256, 512, 1024):
        timing, made = measure_and_keep(
            lambda: color_table.build(spectra.LINEAR_SRGB, "D65", size=size),
            repeats=1 if toy or size > 512 else 3,
            memory=size <= 512,
        )
        # as the paper's texture is read by graphics hardware, and as the table reads itself
        for between, color in (
            ("spline", made.lookup(c_m, c_hd)),
            ("bilinear", _bilinear(made, c_m, c_hd)),
        ):
            difference = metrics.delta_e_2000(_lab(color), reference)
            outcome = _largest(difference)
            points.append(Point.of({"size": size, "between nodes": between}, timing, outcome))
            if (size, between) == (BAND_TABLE_SIZE, "spline"):
                by_band = {
                    band: _largest(difference[melanin_band(c_m) == band]) for band in MELANIN_BANDS
                }
            if outcome.error < 0.5 and not np.isfinite(smallest[between]):
                smallest[between] = size
    return described(
        "color-table",
        points,
        {("smallest", between): size for between, size in smallest.items()},
        by_band=by_band,
    )


def _largest(difference: Float64Array) -> BandError:
    """Return the largest error; its 68 % interval is by the two largest seen.

    Robson and Whitlock 1964, Biometrika 51, 33, doi 10.1093/biomet/51.1-2.33.
    """
    second, worst = np.sort(difference)[-2:]
    most = float(worst + 0.68 / 0.32 * (worst - second))
    return BandError(float(worst), (float(worst), most))


def _bilinear(made: color_table.ColorTable, c_m: Float64Array, c_hd: Float64Array) -> Float64Array:
    """Return colors of eq. (7)'s texture with bilinear filtering between texel centres."""
    i = (made.size - 1) * np.cbrt(c_m / made.c_m_max)
    j = (made.size - 1) * np.cbrt(c_hd / made.c_hd_max)
    row, column = (np.minimum(at.astype(np.intp), made.size - 2) for at in (i, j))
    x, y = (i - row)[:, None], (j - column)[:, None]
    rgb = made.rgb
    return np.asarray(
        (1 - x) * ((1 - y) * rgb[row, column] + y * rgb[row, column + 1])
        + x * ((1 - y) * rgb[row + 1, column] + y * rgb[row + 1, column + 1])
    )


def _lab(linear_srgb: Float64Array) -> Float64Array:
    """CIE Lab under D65 of linear sRGB, (..., 3)."""
    xyz = linear_srgb @ np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB).T
    ratio = xyz / np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB).sum(axis=1)
    bend = (6 / 29) ** 3
    f = np.where(ratio > bend, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)
