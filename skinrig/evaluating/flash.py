"""Evaluate maps against ground truth: error, coverage and masked fraction by melanin band."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.flash.stages import NOISE_STDERR_SUFFIX
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.evaluating.bounds import chromophore_bounds

MELANIN_RANGES: tuple[tuple[float, float], ...] = (
    (0.0, 0.02),
    (0.02, 0.05),
    (0.05, 0.1),
    (0.1, 0.2),
    (0.2, 0.51),
)
"""Melanin bands, volume fraction: about very light, light, tan, brown and dark skin."""


@dataclass(frozen=True, slots=True)
class MapAccuracy:
    """Accuracy of one map against one ground truth in one band of melanin.

    Attributes
    ----------
    name
        Name of the map.
    against
        Ground truth: "sharp" (the subject's own) or "blurred" (after lateral scattering).
    band
        Bounds of the true melanin fraction; None: all pixels.
    pixels, masked
        Pixels with ground truth, and the fraction of them without a valid estimate.
    median_relative, interval
        Median of |estimate - truth| / truth and its 68 % bootstrap interval.
    bias
        Median of (estimate - truth) / truth.
    coverage
        Fraction of true values in the 68 % interval of the estimate.
    median_stderr
        Median of the relative half-width of the estimate's 68 % interval.
    noise_coverage
        Fraction of true values in the interval of noise alone, without model error; NaN if no map
        has it.
    median_bound
        Median of the relative Cramér-Rao bound at the true chromophores, of noise, model error
        and the light's prior; NaN if it is unknown.
    """

    name: str
    against: str
    band: tuple[float, float] | None
    pixels: int
    masked: float
    median_relative: float
    interval: tuple[float, float]
    bias: float
    coverage: metrics.Coverage
    median_stderr: float
    noise_coverage: float = float("nan")
    median_bound: float = float("nan")

    @property
    def band_name(self) -> str:
        """Label of the band."""
        return "all" if self.band is None else f"melanin {self.band[0]:g}–{self.band[1]:g}"


MAX_MEDIAN_MELANIN_ERROR = 0.15
MIN_BOUND_ERROR = 0.10
BOUND_FACTOR = 1.3


def limit(row: MapAccuracy) -> float:
    """Return the limit of the median relative error.

    The limit is 15 % if the Cramér-Rao bound at the truth is below 10 %, and otherwise 1.3 times
    that bound. The estimate's own standard error replaces the bound only if the bound is unknown.
    """
    least = bound(row)
    return MAX_MEDIAN_MELANIN_ERROR if least < MIN_BOUND_ERROR else BOUND_FACTOR * least


def bound(row: MapAccuracy) -> float:
    """Return the relative bound that sets a row's limit, see `limit`."""
    return row.median_bound if np.isfinite(row.median_bound) else row.median_stderr


def compare(
    appearance: SkinAppearance,
    truth: SkinAppearance,
    *,
    names: tuple[str, ...] = ("melanin", "hemoglobin"),
    rng: np.random.Generator,
) -> list[MapAccuracy]:
    """Compare maps with their ground truth, over all pixels and in each band of melanin.

    Parameters
    ----------
    appearance
        Estimated maps with standard errors.
    truth
        Maps of the same size: ``NAME`` is sharp, ``NAME_blurred`` includes lateral scattering,
        ``mask`` is True on skin. ``melanin`` is required.
    names
        Names of the maps to compare.
    rng
        For the bootstrap intervals.

    Raises
    ------
    ValueError
        When sizes differ or the truth has no melanin.
    """
    if "melanin" not in truth.maps:
        raise ValueError("truth: has no map 'melanin' for the bands; name a ground truth with it")
    melanin = truth.maps["melanin"].values
    bounds = chromophore_bounds(appearance, truth)
    rows = []
    for name in names:
        if name not in appearance.maps:
            continue
        estimate = appearance.maps[name]
        for suffix, against in (("", "sharp"), ("_blurred", "blurred")):
            if name + suffix not in truth.maps:
                continue
            true_map = truth.maps[name + suffix]
            if true_map.values.shape != estimate.values.shape:
                raise ValueError(
                    f"{name}: got an estimate of shape {estimate.values.shape} and a truth of "
                    f"shape {true_map.values.shape}, expected the same; compare maps of one session"
                )
            skin = _skin(truth, true_map.values)
            floors = appearance.maps.get(name + NOISE_STDERR_SUFFIX), bounds.get(name)
            for band in (None, *MELANIN_RANGES):
                chosen = skin
                if band is not None:
                    chosen = skin & (melanin >= band[0]) & (melanin < band[1])
                figures = _figures(estimate, true_map.values, chosen, rng, *floors)
                rows.append(MapAccuracy(name=name, against=against, band=band, **figures))
    return [row for row in rows if row.pixels >= 20]


def _skin(truth: SkinAppearance, values: Float32Array) -> BoolArray:
    skin = np.isfinite(values) & (values > 0)
    if "mask" in truth.maps:
        skin &= truth.maps["mask"].values > 0.5
    return skin


def _figures(
    estimate: SkinMap,
    true_values: Float32Array,
    chosen: BoolArray,
    rng: np.random.Generator,
    noise: SkinMap | None,
    bound: Float64Array | None,
) -> dict[str, Any]:
    """Compute the figures of a `MapAccuracy` over chosen pixels."""
    valid = chosen & intersect_valid(estimate)
    pixels = int(np.count_nonzero(chosen))
    value = estimate.values[valid].astype(np.float64)
    true_value = true_values[valid].astype(np.float64)
    relative = (value - true_value) / true_value
    median, interval = metrics.median_with_interval(np.abs(relative), rng=rng)
    if estimate.stderr is None:
        held, spread = metrics.coverage([], [], []), float("nan")
    else:
        stderr = estimate.stderr[valid].astype(np.float64)
        held = metrics.coverage(value, stderr, true_value)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = stderr / np.abs(value)
        spread = float(np.median(ratios)) if ratios.size else float("nan")
    noise_held = float("nan")
    if noise is not None:
        noise_held = metrics.coverage(value, noise.values[valid], true_value).fraction
    finite = np.empty(0) if bound is None else bound[valid & np.isfinite(bound)]
    return {
        "pixels": pixels,
        "masked": 1.0 - valid.sum() / pixels if pixels else float("nan"),
        "median_relative": median,
        "interval": interval,
        "bias": float(np.median(relative)) if relative.size else float("nan"),
        "coverage": held,
        "median_stderr": spread,
        "noise_coverage": noise_held,
        "median_bound": float(np.median(finite)) if finite.size else float("nan"),
    }
