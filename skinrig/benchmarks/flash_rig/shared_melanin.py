"""Benchmark of states inverted together, with one melanin, beside each by itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from model.color_table import ColorTable
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.facial_color import shared_melanin
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.benchmarks.description import Findings, described
from skinrig.benchmarks.flash_rig.alignment import face_of, oval, table
from skinrig.benchmarks.measurement import (
    LIMIT_CORES,
    BandError,
    Knobs,
    Point,
    StageBenchmark,
    measure,
    processor_seconds,
)
from skinrig.benchmarks.resampling import median_error
from skinrig.evaluating.skin_bands import MELANIN_BANDS

STATE_NAMES = ("neutral", "smile", "anger", "fear", "happiness", "sadness", "surprise")
SUPERPIXEL_NOISE = 0.003
"""Relative noise of a superpixel of the flash rig's camera on light skin."""
LIGHT_CHANGE = 0.05
"""How much the light of a state differs, smoothly over the face."""
FULL_SIDE_PX = 1024


def inversion(*, toy: bool) -> StageBenchmark:
    """Invert 1 to 7 states together, the light free or smooth, beside each state alone."""
    side = 64 if toy else 192
    rng = np.random.default_rng(0)
    colors, prior, covariance = table(), shading_prior.of_faces(), model_error.load()
    face = face_of("II", side, seed=3)
    mask = oval(side)
    blood = np.stack([face.hemoglobin(state) for state in STATE_NAMES]).astype(np.float64)
    rgb, variance = pictures(colors, face.melanin, blood, covariance, rng=rng)
    valid = np.broadcast_to(mask, blood.shape)
    truth = blood[1] - blood[0]

    def alone() -> Float64Array:
        each = [
            chromophore_posterior.estimate(
                rgb[k],
                colors,
                prior=prior,
                variance=variance[k],
                model_error=covariance,
                valid=mask,
            )
            for k in (0, 1)
        ]
        return np.asarray(each[1].hemoglobin - each[0].hemoglobin, np.float64)

    def together(count: int, window: float | None) -> shared_melanin.SharedMelanin:
        return shared_melanin.estimate_shared_melanin(
            rgb[:count],
            colors,
            prior=prior,
            variance=variance[:count],
            model_error=covariance,
            valid=valid[:count],
            shading_window_px=window,
        )

    points = [_point({"way": "each alone", "states": 2}, alone, lambda: alone() - truth, mask)]
    settings: list[tuple[int, float | None]] = [(2, None), (3, None), (2, 3.0)]
    if not toy:
        settings = [(2, None), (4, None), (7, None), (7, 3.0), (7, 8.0)]
    for count, window in settings:
        points.append(
            _point(
                {"way": "together", "states": count, "light": "free" if window is None else window},
                lambda count=count, window=window: together(count, window),  # type: ignore[misc]
                lambda count=count, window=window: together(count, window).change[1] - truth,  # type: ignore[misc]
                mask,
            )
        )
    bands = {
        name: _on_skin(band.preset, side, colors, prior, covariance)
        for name, band in MELANIN_BANDS.items()
    }
    limits: Findings = {}
    if not toy:
        found = together(7, 3.0)
        error = np.abs(found.change[1] - truth)[mask]
        within = float(np.mean(error < 2.0 * found.stderr_change[1][mask]))
        limits = {
            "over_alone": points[0].error / points[4].error,
            "within": within,
            **_melanin_limits(colors, prior),
            **_full_size(colors, prior, covariance),
        }
    return described("shared-melanin", points, limits, by_band=bands)


def pictures(
    colors: ColorTable,
    melanin: FloatArray,
    blood: Float64Array,
    covariance: Float64Array,
    *,
    rng: np.random.Generator,
    noise: float = SUPERPIXEL_NOISE,
) -> tuple[Float32Array, Float32Array]:
    """Return colors (S, H, W, 3) of one melanin and S bloods, and their variance.

    Each pixel has an error of the model that all its states share, and each state a light that
    differs smoothly over the face.
    """
    rows, columns = np.mgrid[: melanin.shape[0], : melanin.shape[1]] / melanin.shape[0]
    light = np.stack(
        [
            0.6 * np.exp(LIGHT_CHANGE * np.sin(3 * columns + k) * np.cos(2 * rows - k))
            for k in range(len(blood))
        ]
    )
    shared = rng.multivariate_normal(np.zeros(3), covariance, melanin.shape)
    clean = colors.lookup(np.broadcast_to(melanin, blood.shape), blood)
    clean = clean * np.exp(shared) * light[..., None]
    seen = clean * (1.0 + noise * rng.standard_normal(clean.shape))
    return seen.astype(np.float32), ((noise * clean) ** 2).astype(np.float32)


def _on_skin(
    preset: str, side: int, colors: ColorTable, prior: ShadingPrior, covariance: Float64Array
) -> BandError:
    """Return the error of smile's change of blood on skin of a preset, three states together."""
    face, mask = face_of(preset, side, seed=3), oval(side)
    blood = np.stack([face.hemoglobin(state) for state in STATE_NAMES[:3]]).astype(np.float64)
    rgb, variance = pictures(colors, face.melanin, blood, covariance, rng=np.random.default_rng(0))
    found = shared_melanin.estimate_shared_melanin(
        rgb,
        colors,
        prior=prior,
        variance=variance,
        model_error=covariance,
        valid=np.broadcast_to(mask, blood.shape),
        shading_window_px=3.0,
    )
    return median_error(np.abs(found.change[1] - (blood[1] - blood[0]))[mask])


def _point(
    knobs: Knobs, call: Callable[[], object], error: Callable[[], Float64Array], mask: BoolArray
) -> Point:
    timing = measure(call, repeats=1, memory=False)
    off = np.abs(error())[mask]
    off = off[np.isfinite(off)]
    middle = float(np.median(off))
    # standard error of a median, by the density about it
    low, high = np.quantile(off, 0.5 + np.array([-0.5, 0.5]) / np.sqrt(off.size))
    return Point(knobs, timing, middle, (float(low), float(high)))


def _melanin_limits(colors: ColorTable, prior: ShadingPrior) -> Findings:
    """Check how melanin's variance by noise goes with the number of states."""
    rng = np.random.default_rng(1)
    variances = {}
    for count in (1, 7):
        clean = 0.6 * np.broadcast_to(colors.lookup(0.02, 0.025), (count, 4000, 3))
        seen = clean * (1.0 + 2e-3 * rng.standard_normal(clean.shape))
        found = shared_melanin.estimate_shared_melanin(
            seen, colors, prior=prior, variance=(2e-3 * clean) ** 2
        )
        variances[count] = float(found.melanin.var())
    return {"melanin": variances[1] / variances[7]}


def _full_size(colors: ColorTable, prior: ShadingPrior, covariance: Float64Array) -> Findings:
    """Time 7 states of a megapixel by a band of it."""
    rng = np.random.default_rng(2)
    band = 96
    melanin = np.full((band, FULL_SIDE_PX), 0.02)
    blood = 0.32 * rng.uniform(0.35, 0.5, (len(STATE_NAMES), band, FULL_SIDE_PX)) ** 3
    rgb, variance = pictures(colors, melanin, blood, covariance, rng=rng)
    run = partial(
        shared_melanin.estimate_shared_melanin,
        rgb,
        colors,
        prior=prior,
        variance=variance,
        model_error=covariance,
        shading_window_px=shared_melanin.SHADING_WINDOW_PX,
    )
    whole = processor_seconds(run, 2) * FULL_SIDE_PX / band / LIMIT_CORES
    return {"seconds": whole}
