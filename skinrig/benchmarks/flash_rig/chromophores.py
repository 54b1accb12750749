"""Benchmark of the chromophore inversion, beside SciPy's least squares in the same run."""

import time
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores
from skinrig.arrays import Float64Array, FloatArray
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import BandError
from skinrig.benchmarks.stage import Stage
from skinrig.evaluating.skin_bands import MelaninBand

CHANNEL_NOISE = 0.01
SHADINGS: dict[str, Literal["known"] | None] = {"known": "known", "free": None}
MIN_MELANIN = 0.004
"""Volume fraction of the palest skin that is drawn."""


def inversion(stage: Stage) -> None:
    """Invert a noisy picture with the shading known and free, through tables of several sizes."""
    side, pixels = (96, 8) if stage.toy else (2048, 40)
    rng = np.random.default_rng(0)
    table = color_table.build("Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN)
    y, x = np.mgrid[0:side, 0:side] / side
    c_m = 0.02 + 0.01 * np.sin(9 * x) * np.cos(7 * y)
    c_hd = 0.05 + 0.03 * np.cos(8 * x + 3 * y)
    color = np.concatenate([table.lookup(m, h) for m, h in zip(c_m, c_hd, strict=True)])
    noisy = (color * (1 + CHANNEL_NOISE * rng.standard_normal(color.shape))).astype(np.float32)
    picture = noisy.reshape(side, side, 3)
    variance = (CHANNEL_NOISE * color.reshape(side, side, 3)).astype(np.float32) ** 2
    for shading in SHADINGS:
        for size in (16, 128) if stage.toy else (16, 32, 64, 128):
            coarse = color_table.build(
                "Nikon 5100 (NPL)", "D55", size=size, anisotropy=ANISOTROPY_SKIN
            )
            timing, found = stage.time(
                lambda: chromophores.invert(
                    picture, coarse, shading=SHADINGS[shading], variance=variance
                )
            )
            outcome = _error(found, c_m, rng)
            stage.add({"shading": shading, "table": size}, timing, outcome)
        if shading == "free":
            peer_s = _scipy_seconds(picture.reshape(-1, 3)[:: side * side // pixels], table)
            ours_s = timing.seconds / side**2
            stage.limits = {("seconds", side): timing.seconds, "speed_up": peer_s / ours_s}
    count = 500 if stage.toy else 20_000

    def on_skin(band: MelaninBand) -> BandError:
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

    stage.on_each_skin(on_skin)


def _error(
    found: chromophores.ChromophoreMaps, c_m: Float64Array, rng: np.random.Generator | None = None
) -> BandError:
    """Return the median error of melanin, %."""
    off = 100 * np.abs(found.melanin / c_m - 1)[found.valid]
    # the median of |error| of a normal error of the bound's size
    bound = 67.45 * float(np.median((found.stderr_melanin / c_m)[found.valid]))
    return median_error(off, bound, rng=rng)


def _scipy_seconds(rgb: FloatArray, table: color_table.ColorTable) -> float:
    """Return seconds a pixel of a plain fit of cube roots and log shading."""
    start = time.perf_counter()
    for color in rgb:

        def residual(p: Float64Array, color: FloatArray = color) -> Float64Array:
            c_m, c_hd = np.clip(p[:2], 1e-3, [0.79, 0.68]) ** 3
            return np.asarray((np.exp(p[2]) * table.lookup(c_m, c_hd) / color - 1) / CHANNEL_NOISE)

        least_squares(residual, [0.27, 0.33, 0.0])
    return (time.perf_counter() - start) / len(rgb)
