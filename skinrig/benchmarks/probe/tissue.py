"""Benchmarks of the layered reflectance and of the color table."""

from __future__ import annotations

from functools import partial

import numpy as np

from model import color_table, metrics, spectra
from model.tissue_optics import layers as tissue_optics
from rigsim.tissue.skin_table import SkinTable
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import (
    BandError,
    Case,
    Limit,
    Point,
    StageBenchmark,
    compare,
    measure,
)
from skinrig.benchmarks.resampling import median_error
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
    tiers: list[dict[str, str | float]] = [{"tier": "diffusion"}]
    for g in (0.0, tissue_optics.ANISOTROPY_SKIN):
        for directions in (4, 8) if toy else (4, 8, 16, 24):
            tiers.append({"tier": "adding_doubling", "g": g, "directions": directions})

    def evaluate(knobs: dict[str, str | float]) -> Float64Array:
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

    def by_band() -> dict[str, BandError]:
        off, bands = relative(evaluate(tiers[-1])), melanin_band(c_m)
        return {band: median_error(off[bands == band]) for band in MELANIN_BANDS}

    return compare(
        StageBenchmark(
            "layered-reflectance",
            "median error of R, %",
            "Monte Carlo transport with the full phase function",
            float(reference_error),
            interval_of="chromophores and wavelengths",
        ),
        [
            Case(
                knobs,
                partial(evaluate, knobs),
                lambda found: BandError(*metrics.median_with_interval(relative(found), rng=rng)),
            )
            for knobs in tiers
        ],
        repeats=1 if toy else 3,
        by_band=by_band,
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

        def build(size: int = size) -> color_table.ColorTable:
            return color_table.build(spectra.LINEAR_SRGB, "D65", size=size)

        timing = measure(build, repeats=1 if toy or size > 512 else 3, memory=size <= 512)
        made = build()
        # as the paper's texture is read by graphics hardware, and as the table reads itself
        for between, color in (
            ("spline", made.lookup(c_m, c_hd)),
            ("bilinear", _bilinear(made, c_m, c_hd)),
        ):
            difference = metrics.delta_e_2000(_lab(color), reference)
            worst = float(difference.max())
            points.append(
                Point({"size": size, "between nodes": between}, timing, worst, _largest(difference))
            )
            if (size, between) == (BAND_TABLE_SIZE, "spline"):
                by_band = {
                    band: BandError(float(some.max()), _largest(some))
                    for band in MELANIN_BANDS
                    for some in (difference[melanin_band(c_m) == band],)
                }
            if worst < 0.5 and not np.isfinite(smallest[between]):
                smallest[between] = size
    return StageBenchmark(
        "color-table",
        "largest Delta E 2000",
        "direct evaluation of the layered model, no table",
        0.0,
        tuple(points),
        tuple(
            Limit(
                f"smallest table with every Delta E 2000 below 0.5, {between}",
                size,
                128,
                "<=",
                "nodes",
            )
            for between, size in smallest.items()
        ),
        interval_of="chromophores: of the largest error of all, by the two largest seen",
        by_band=by_band,
    )


def _largest(difference: Float64Array) -> tuple[float, float]:
    """Return a 68 % interval of the largest error there is, from the two largest seen.

    Robson and Whitlock 1964, Biometrika 51, 33, doi 10.1093/biomet/51.1-2.33.
    """
    second, worst = np.sort(difference)[-2:]
    return float(worst), float(worst + 0.68 / 0.32 * (worst - second))


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
