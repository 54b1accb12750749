"""Benchmarks of the layered reflectance and of the color table."""

from functools import partial
from typing import Any

import numpy as np

from capture.calibration.color.colorimetry import delta_e_2000
from model import color_table, skin_tone, spectra
from model.tissue_optics import SKIN_CONSTANTS, two_layer_reflectance
from model.tissue_optics.layers import ANISOTROPY_SKIN
from rigsim.tissue.skin_table import SkinTable
from skinrig.arrays import Float64Array
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MELANIN_BANDS, classify_melanin

BAND_TABLE_SIZE = 64
"""Size of the table for errors by melanin band."""


def measure_layered_reflectance(stage: BenchmarkStage) -> None:
    """Measure the tiers of the layered reflectance against the simulator's Monte Carlo table."""
    rng = np.random.default_rng(0)
    truth = SkinTable.load()
    count = 24 if stage.toy else 200
    # at the nodes of the Monte Carlo table, where it has no interpolation error
    rows = rng.integers(2, truth.c_m.size, count)
    columns = rng.integers(2, truth.c_hd.size, count)
    c_m, c_hd = truth.c_m[rows], truth.c_hd[columns]
    reference = truth.reflectance[rows, columns]
    stage.reference_error = float(100 * np.median(truth.standard_error[rows, columns] / reference))
    tiers: list[Knobs] = [{"tier": "diffusion"}]
    for g in (0.0, ANISOTROPY_SKIN):
        for directions in (4, 8) if stage.toy else (4, 8, 16, 24):
            tiers.append({"tier": "adding_doubling", "g": g, "directions": directions})

    def evaluate(knobs: Knobs) -> Float64Array:
        options: dict[str, Any] = {"tier": "diffusion"}
        if knobs != options:
            options = {"anisotropy": float(knobs["g"]), "directions": int(knobs["directions"])}
        return two_layer_reflectance(
            truth.wavelength_nm, c_m, c_hd, constants=SKIN_CONSTANTS, **options
        )

    def relative(found: Float64Array) -> Float64Array:
        return np.asarray(100 * np.abs(found / reference - 1))

    for knobs in tiers:
        stage.measure(
            knobs, partial(evaluate, knobs), lambda found: median_error(relative(found), rng=rng)
        )
    off, bands = relative(evaluate(tiers[-1])), classify_melanin(c_m)
    stage.by_band |= {band: median_error(off[bands == band]) for band in MELANIN_BANDS}


def measure_color_table(stage: BenchmarkStage) -> None:
    """Measure the color table's interpolation error in Delta E 2000 over its size."""
    rng = np.random.default_rng(0)
    count = 40 if stage.toy else 400
    c_m = 0.5 * rng.random(count) ** 3
    c_hd = 0.32 * rng.random(count) ** 3
    wavelength = spectra.WAVELENGTH_NM
    direct = two_layer_reflectance(wavelength, c_m, c_hd, constants=SKIN_CONSTANTS)
    reference = skin_tone.lab(spectra.band_average(direct, spectra.LINEAR_SRGB, "D65"))
    stage.limits = {("smallest", between): np.nan for between in ("spline", "bilinear")}
    for size in (8, 16, 32, 64) if stage.toy else (8, 16, 32, 64, 128, 256, 512, 1024):
        timing, made = stage.time(
            lambda: color_table.build(spectra.LINEAR_SRGB, "D65", size=size),
            repeats=1 if stage.toy or size > 512 else 3,
            memory=size <= 512,
        )
        # "bilinear" is the filter of graphics hardware, "spline" the table's own
        for between, color in (
            ("spline", made.lookup(c_m, c_hd)),
            ("bilinear", _bilinear(made, c_m, c_hd)),
        ):
            difference = delta_e_2000(skin_tone.lab(color), reference)
            outcome = _max_error(difference)
            stage.add({"size": size, "between nodes": between}, timing, outcome)
            if (size, between) == (BAND_TABLE_SIZE, "spline"):
                bands = classify_melanin(c_m)
                stage.by_band |= {b: _max_error(difference[bands == b]) for b in MELANIN_BANDS}
            if outcome.error < 0.5 and not np.isfinite(stage.limits["smallest", between]):
                stage.limits["smallest", between] = size


def _max_error(difference: Float64Array) -> ErrorEstimate:
    """Return the largest error with a 68 % interval from the two largest sampled ones.

    Robson and Whitlock 1964, Biometrika 51, 33, doi 10.1093/biomet/51.1-2.33.
    """
    second, worst = np.sort(difference)[-2:]
    # the end point's upper bound at confidence c is y_n + c / (1 - c) (y_n - y_(n-1))
    upper = float(worst + 0.68 / 0.32 * (worst - second))
    return ErrorEstimate(float(worst), (float(worst), upper))


def _bilinear(made: color_table.ColorTable, c_m: Float64Array, c_hd: Float64Array) -> Float64Array:
    """Return colors of eq. (7)'s texture with bilinear filtering between texel centers."""
    i = (made.size - 1) * np.cbrt(c_m / made.c_m_max)
    j = (made.size - 1) * np.cbrt(c_hd / made.c_hd_max)
    row, column = (np.minimum(at.astype(np.intp), made.size - 2) for at in (i, j))
    x, y = (i - row)[:, None], (j - column)[:, None]
    rgb = made.rgb
    return np.asarray(
        (1 - x) * ((1 - y) * rgb[row, column] + y * rgb[row, column + 1])
        + x * ((1 - y) * rgb[row + 1, column] + y * rgb[row + 1, column + 1])
    )
