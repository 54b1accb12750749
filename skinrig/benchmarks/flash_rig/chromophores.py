"""Benchmarks of the chromophore inversion of one image and of expressions with shared melanin."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

from model import color_table
from model.color_table import ColorTable
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.facial_color import shared_melanin
from rigsim.subject import make_subject
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.benchmarks.flash_rig.alignment import face_mask, load_color_table
from skinrig.benchmarks.measurement import LIMIT_CORES, measure_processor_seconds
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MelaninBand

CHANNEL_NOISE = 0.01
SHADING_MODES: dict[str, Literal["known"] | None] = {"known": "known", "free": None}
MIN_MELANIN = 0.004
"""Melanosome volume fraction of the palest skin that is drawn."""


def measure_inversion(stage: BenchmarkStage) -> None:
    """Measure the inversion of a noisy image with known and free shading over table sizes."""
    side, pixels = (96, 8) if stage.toy else (2048, 40)
    rng = np.random.default_rng(0)
    table = color_table.build(
        "Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )
    y, x = np.mgrid[0:side, 0:side] / side
    c_m = 0.02 + 0.01 * np.sin(9 * x) * np.cos(7 * y)
    c_hd = 0.05 + 0.03 * np.cos(8 * x + 3 * y)
    color = np.concatenate([table.lookup(m, h) for m, h in zip(c_m, c_hd, strict=True)])
    noisy = (color * (1 + CHANNEL_NOISE * rng.standard_normal(color.shape))).astype(np.float32)
    image = noisy.reshape(side, side, 3)
    variance = (CHANNEL_NOISE * color.reshape(side, side, 3)).astype(np.float32) ** 2
    for shading in SHADING_MODES:
        for size in (16, 128) if stage.toy else (16, 32, 64, 128):
            coarse = color_table.build(
                "Nikon 5100 (NPL)", "D55", size=size, anisotropy=ANISOTROPY_SKIN, exact_optics=True
            )
            timing, found = stage.time(
                lambda: chromophores.invert(
                    image, coarse, shading=SHADING_MODES[shading], variance=variance
                )
            )
            outcome = _error(found, c_m, rng)
            stage.add({"shading": shading, "table": size}, timing, outcome)
        if shading == "free":
            peer_s = _time_scipy_fit(image.reshape(-1, 3)[:: side * side // pixels], table)
            ours_s = timing.seconds / side**2
            stage.limits = {("seconds", side): timing.seconds, "speed_up": peer_s / ours_s}
    count = 500 if stage.toy else 20_000

    def on_skin(band: MelaninBand) -> ErrorEstimate:
        low, high = band.melanin_range
        c_m = rng.uniform(max(low, MIN_MELANIN), min(high, table.c_m_max), count)
        c_hd = rng.uniform(0.02, 0.08, count)
        color = table.lookup(c_m, c_hd)
        noisy = color * (1 + CHANNEL_NOISE * rng.standard_normal(color.shape))
        found = chromophores.invert(
            noisy.astype(np.float32)[None],
            table,
            variance=(CHANNEL_NOISE * color[None]).astype(np.float32) ** 2,
        )
        return _error(found, c_m)

    stage.measure_bands(on_skin)


def _error(
    found: chromophores.ChromophoreMaps, c_m: Float64Array, rng: np.random.Generator | None = None
) -> ErrorEstimate:
    """Return the median error of melanin, %."""
    off = 100 * np.abs(found.melanin / c_m - 1)[found.valid]
    # median of |error| of a normal error: 0.6745 standard deviations
    bound = 67.45 * float(np.median((found.stderr_melanin / c_m)[found.valid]))
    return median_error(off, bound, rng=rng)


def _time_scipy_fit(rgb: FloatArray, table: color_table.ColorTable) -> float:
    """Return the seconds per pixel of SciPy's least squares in cube roots and log shading."""
    start = time.perf_counter()
    for color in rgb:

        def residual(p: Float64Array, color: FloatArray = color) -> Float64Array:
            c_m, c_hd = np.clip(p[:2], 1e-3, [0.79, 0.68]) ** 3
            return np.asarray((np.exp(p[2]) * table.lookup(c_m, c_hd) / color - 1) / CHANNEL_NOISE)

        least_squares(residual, [0.27, 0.33, 0.0])
    return (time.perf_counter() - start) / len(rgb)


STATE_NAMES = ("neutral", "smile", "anger", "fear", "happiness", "sadness", "surprise")
SUPERPIXEL_NOISE = 0.003
"""Relative noise of a superpixel of the flash rig's camera on light skin."""
LIGHT_CHANGE = 0.05
"""Amplitude of the smooth relative change of illumination between expressions."""
FULL_SIDE_PX = 1024


def measure_shared_melanin(stage: BenchmarkStage) -> None:
    """Measure joint inversion of 2 to 7 expressions against separate inversion of each."""
    side = 64 if stage.toy else 192
    model = _ChromophoreModel(
        load_color_table(), shading_prior.face_prior(), model_error.load_covariance()
    )
    images = _StateImages.of("II", side, STATE_NAMES, model)

    def invert_separately() -> Float64Array:
        each = [
            chromophore_posterior.estimate(
                images.rgb[k],
                model.colors,
                prior=model.prior,
                variance=images.variance[k],
                model_error=model.covariance,
                valid=images.mask,
            )
            for k in (0, 1)
        ]
        return np.asarray(each[1].hemoglobin - each[0].hemoglobin, np.float64)

    def invert_jointly(count: int, window: float | None) -> shared_melanin.SharedMelanin:
        return images.invert_jointly(count, window, model)

    def add(knobs: Knobs, call: Callable[[], Any], change: Callable[[Any], Float64Array]) -> None:
        timing, made = stage.time(call, repeats=1, memory=False)
        stage.add(knobs, timing, _dense_error(images.errors(change(made))))

    add({"way": "each alone", "states": 2}, invert_separately, lambda made: made)
    settings: list[tuple[int, float | None]] = [(2, None), (3, None), (2, 3.0)]
    if not stage.toy:
        settings = [(2, None), (4, None), (7, None), (7, 3.0), (7, 8.0)]
    for count, window in settings:
        knobs: Knobs = {"way": "together", "states": count, "light": window or "free"}
        add(knobs, lambda: invert_jointly(count, window), lambda made: made.change[1])
    stage.measure_bands(lambda band: _on_skin(band.preset, side, model))
    if not stage.toy:
        found = invert_jointly(7, 3.0)
        stated = found.stderr_change[1][images.mask]
        stage.limits = {
            "over_alone": stage.points[0].error / stage.points[4].error,
            "within": float(np.mean(images.errors(found.change[1]) < 2.0 * stated)),
            **_melanin_limits(model),
            **_full_size(model),
        }


def simulate_colors(
    colors: ColorTable,
    melanin: FloatArray,
    blood: Float64Array,
    covariance: Float64Array,
    *,
    rng: np.random.Generator,
    noise: float = SUPERPIXEL_NOISE,
) -> tuple[Float32Array, Float32Array]:
    """Simulate colors (S, H, W, 3) of one melanin map and S blood maps; return also their variance.

    Each pixel has one model error, common to all expressions. Each expression has an illumination
    that varies smoothly over the face.
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
    noisy = clean * (1.0 + noise * rng.standard_normal(clean.shape))
    return noisy.astype(np.float32), ((noise * clean) ** 2).astype(np.float32)


def _on_skin(preset: str, side: int, model: _ChromophoreModel) -> ErrorEstimate:
    """Return the error of a smile's change of blood on a preset's skin, three states jointly."""
    images = _StateImages.of(preset, side, STATE_NAMES[:3], model)
    found = images.invert_jointly(3, 3.0, model)
    return median_error(images.errors(found.change[1]))


@dataclass(frozen=True, slots=True)
class _ChromophoreModel:
    """Color table, shading prior and model error that all inversions use."""

    colors: ColorTable
    prior: ShadingPrior
    covariance: Float64Array

    def invert(
        self, rgb: Float32Array, variance: Float32Array, **options: Any
    ) -> shared_melanin.SharedMelanin:
        """Estimate one melanin map and the blood of each state from colors (S, H, W, 3)."""
        return shared_melanin.estimate_shared_melanin(
            rgb,
            self.colors,
            prior=self.prior,
            variance=variance,
            model_error=self.covariance,
            **options,
        )


@dataclass(frozen=True, slots=True)
class _StateImages:
    """Images of a face with several expressions, and their ground truth."""

    rgb: Float32Array
    variance: Float32Array
    blood: Float64Array
    mask: BoolArray

    @classmethod
    def of(
        cls, preset: str, side: int, names: Sequence[str], model: _ChromophoreModel
    ) -> _StateImages:
        """Simulate the colors of a preset's face in the named states."""
        face = make_subject(preset, seed=3, size=side)
        blood = np.stack([face.hemoglobin(name) for name in names]).astype(np.float64)
        rng = np.random.default_rng(0)
        noisy = simulate_colors(model.colors, face.melanin, blood, model.covariance, rng=rng)
        return cls(*noisy, blood, face_mask(side))

    def invert_jointly(
        self, count: int, window: float | None, model: _ChromophoreModel
    ) -> shared_melanin.SharedMelanin:
        """Invert the first states jointly, with light smooth in a window, px, or free (None)."""
        valid = np.broadcast_to(self.mask, self.blood[:count].shape)
        return model.invert(
            self.rgb[:count], self.variance[:count], valid=valid, shading_window_px=window
        )

    def errors(self, change: Float64Array) -> Float64Array:
        """Return absolute errors of the second state's change of blood, (n,)."""
        return np.asarray(np.abs(change - (self.blood[1] - self.blood[0]))[self.mask])


def _dense_error(errors: Float64Array) -> ErrorEstimate:
    """Return the median of many errors with its 68 % interval."""
    errors = errors[np.isfinite(errors)]
    # the rank of a sample median has the standard deviation sqrt(n) / 2, 0.5 / sqrt(n) in quantile
    low, high = np.quantile(errors, 0.5 + np.array([-0.5, 0.5]) / np.sqrt(errors.size))
    return ErrorEstimate(float(np.median(errors)), (float(low), float(high)))


def _melanin_limits(model: _ChromophoreModel) -> LimitValues:
    """Return the ratio of melanin's noise variance between 1 and 7 expressions."""
    rng = np.random.default_rng(1)
    variances = {}
    for count in (1, 7):
        clean = 0.6 * np.broadcast_to(model.colors.lookup(0.02, 0.025), (count, 4000, 3))
        noisy = clean * (1.0 + 2e-3 * rng.standard_normal(clean.shape))
        found = shared_melanin.estimate_shared_melanin(
            noisy, model.colors, prior=model.prior, variance=(2e-3 * clean) ** 2
        )
        variances[count] = float(found.melanin.var())
    return {"melanin": variances[1] / variances[7]}


def _full_size(model: _ChromophoreModel) -> LimitValues:
    """Return processor seconds for 7 states of a megapixel, extrapolated from a band of rows."""
    rng = np.random.default_rng(2)
    band = 96
    melanin = np.full((band, FULL_SIDE_PX), 0.02)
    blood = 0.32 * rng.uniform(0.35, 0.5, (len(STATE_NAMES), band, FULL_SIDE_PX)) ** 3
    noisy = simulate_colors(model.colors, melanin, blood, model.covariance, rng=rng)
    run = partial(model.invert, *noisy, shading_window_px=shared_melanin.SHADING_WINDOW_PX)
    return {"seconds": measure_processor_seconds(run, 2) * FULL_SIDE_PX / band / LIMIT_CORES}
