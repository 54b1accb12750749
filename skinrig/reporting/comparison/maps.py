"""Compare two estimates of one map, in its unit and in standard uncertainties."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from skinrig.arrays import BoolArray, Float64Array
from skinrig.evaluating import flash, microrelief, subsurface
from skinrig.evaluating import surface as surface_evaluation
from skinrig.evaluating.surface import errors_by_band
from skinrig.reporting.map_names import map_title
from skinrig.reporting.page import format_short_unit
from skinrig.unit_format import format_unit

SIGMA_LEVELS = (1.0, 2.0, 3.0)
"""Combined standard uncertainties; fractions of pixels beyond them are listed."""
CHANCE_FRACTIONS = (0.3173, 0.0455, 0.0027)
"""Expected fractions beyond them, for independent normal errors of the stated size."""
MAX_SIGMAS = 35.0
"""Cap of differences in standard uncertainties: probabilities beyond underflow."""


@dataclass(frozen=True, slots=True)
class MapDifference:
    """Difference of two estimates of a map, B minus A.

    Attributes
    ----------
    name, unit
        Name and unit of the map; "°" for normals, whose difference is an unsigned angle.
    pixels, only_a, only_b
        Pixels with values of both, of A only and of B only.
    median_a, median_b
        Medians over the pixels of both; NaN for normals.
    bias, median, high
        Median of the difference, and median and 95th percentile of its magnitude.
    combined
        Median of the combined standard uncertainty (root sum of squares), in ``unit``; NaN if
        unknown.
    beyond
        Fractions of pixels that differ by more than `SIGMA_LEVELS` combined standard
        uncertainties; empty if unknown.
    difference, sigmas
        (H, W): signed difference (mean of channels), and difference in combined standard
        uncertainties (maximum of channels); NaN where one has no value.
    """

    name: str
    unit: str
    pixels: int
    only_a: int
    only_b: int
    median_a: float
    median_b: float
    bias: float
    median: float
    high: float
    combined: float
    beyond: tuple[float, ...]
    difference: Float64Array
    sigmas: Float64Array | None

    @property
    def disagree(self) -> bool:
        """Whether more pixels than by chance exceed three combined standard uncertainties."""
        return bool(self.beyond) and self.beyond[-1] > MAX_FRACTION_BEYOND


MAX_FRACTION_BEYOND = 0.01
"""Maximum fraction of pixels beyond three combined standard uncertainties of estimates that agree.

The expected fraction is 0.27 %; errors of neighbors are correlated, so that it varies.
"""


def compare_maps(name: str, a: SkinMap, b: SkinMap) -> MapDifference:
    """Compare two estimates of one map, pixel by pixel.

    Parameters
    ----------
    name
        Name; maps with "normals" in it have unit vectors, and standard uncertainties of the angle
        in each of two directions, rad.
    a, b
        Maps of the same shape, on the same pixels.

    Raises
    ------
    ValueError
        If shapes or units differ.

    Notes
    -----
    The combined standard uncertainty assumes independent errors. Common errors, of a calibration or
    the model, cancel in the difference, which is then smaller than the stated uncertainties
    suggest, never larger.

    Examples
    --------
    >>> one = SkinMap(np.full((2, 2), 1.0), "mm", np.full((2, 2), 0.3))
    >>> other = SkinMap(np.full((2, 2), 2.0), "mm", np.full((2, 2), 0.4))
    >>> found = compare_maps("thickness", one, other)
    >>> found.bias, round(found.combined, 3), found.sigmas.round(3).tolist()
    (1.0, 0.5, [[2.0, 2.0], [2.0, 2.0]])
    """
    if a.values.shape != b.values.shape:
        raise ValueError(
            f"{name}: got shapes {a.values.shape} and {b.values.shape}, expected the same"
        )
    if a.unit != b.unit:
        raise ValueError(f"{name}: got units {a.unit!r} and {b.unit!r}, expected the same")
    both = a.mask & b.mask
    normals = "normals" in name and a.values.ndim == 3
    difference, spread, sigmas = (_difference_of_normals if normals else _difference_of_values)(
        a, b, both
    )
    medians = np.nan, np.nan, np.nan
    if not normals:
        va, vb = (one.values[both].astype(np.float64) for one in (a, b))
        medians = _median(va), _median(vb), _median(difference[both])
    size = np.abs(difference[both])
    combined = float("nan")
    beyond: tuple[float, ...] = ()
    if spread is not None and sigmas is not None:
        combined, beyond = _median(spread[both]), _beyond(sigmas[both])
        if sigmas.ndim == 3:
            farthest = np.argmax(np.abs(np.nan_to_num(sigmas)), axis=2)[..., None]
            sigmas = np.take_along_axis(sigmas, farthest, axis=2)[..., 0]
        sigmas = np.where(both, np.clip(sigmas, -MAX_SIGMAS, MAX_SIGMAS), np.nan)
    flat = difference if difference.ndim == 2 else difference.mean(axis=2)
    return MapDifference(
        name,
        "°" if normals else format_short_unit(a.unit),
        int(both.sum()),
        int((a.mask & ~b.mask).sum()),
        int((b.mask & ~a.mask).sum()),
        *medians,
        _median(size),
        float(np.percentile(size, 95)) if size.size else float("nan"),
        combined,
        beyond,
        np.where(both, flat, np.nan),
        sigmas,
    )


Differing = tuple[Float64Array, Float64Array | None, Float64Array | None]
"""Difference, combined standard error, and the one over the other; None without errors."""


def _difference_of_values(a: SkinMap, b: SkinMap, both: BoolArray) -> Differing:
    difference = b.values.astype(np.float64) - a.values
    if a.stderr is None or b.stderr is None:
        return difference, None, None
    spread = np.hypot(a.stderr.astype(np.float64), b.stderr.astype(np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        return difference, spread, np.where(difference == 0.0, 0.0, difference / spread)


def _difference_of_normals(a: SkinMap, b: SkinMap, both: BoolArray) -> Differing:
    from scipy.special import ndtri

    angle = np.full(both.shape, np.nan)
    angle[both] = metrics.angular_error_rad(
        a.values[both].astype(np.float64), b.values[both].astype(np.float64)
    )
    if a.stderr is None or b.stderr is None:
        return np.degrees(angle), None, None
    spread = np.hypot(a.stderr[..., 0].astype(np.float64), b.stderr[..., 0].astype(np.float64))
    # an angle is the length of errors in two directions: as many standard errors as a number
    # would be off by with the same chance, exp(-angle^2 / 2 spread^2)
    with np.errstate(divide="ignore", invalid="ignore", under="ignore"):
        chance = np.exp(-0.5 * np.square(angle / spread))
    chance = np.where(angle == 0.0, 1.0, chance)
    sigmas = np.fmin(-ndtri(np.maximum(0.5 * chance, 1e-300)), MAX_SIGMAS)
    return np.degrees(angle), np.degrees(spread), sigmas


def _beyond(sigmas: Float64Array) -> tuple[float, ...]:
    size = np.abs(sigmas[~np.isnan(sigmas)])
    if not size.size:
        return ()
    return tuple(float(np.mean(size > level)) for level in SIGMA_LEVELS)


def _median(values: Float64Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


@dataclass(frozen=True, slots=True)
class QuantityAccuracy:
    """Error of one quantity relative to the ground truth.

    Attributes
    ----------
    quantity, skin
        Quantity, and the skin on which it is evaluated: a band, a strain step, or "all".
    unit
        Unit of the error.
    error
        Median error, or the statistic that the quantity names.
    interval
        68 % bootstrap interval; NaN if unknown.
    coverage
        Coverage of the 68 % intervals; NaN where unknown.
    """

    quantity: str
    skin: str
    unit: str
    error: float
    interval: tuple[float, float] = (float("nan"), float("nan"))
    coverage: float = float("nan")


def list_truth_errors(appearance: SkinAppearance, truth: SkinAppearance) -> list[QuantityAccuracy]:
    """List the errors of an appearance by quantity and skin.

    Parameters
    ----------
    appearance
        Maps of a flash camera, a dome, a gradient sphere or a fiber probe.
    truth
        Of the same session.
    """
    rows: list[QuantityAccuracy] = []
    if "position" in appearance.maps:
        rows += _surface_errors(appearance, truth)
    elif microrelief.find_states(appearance):
        rows += _microrelief_errors(appearance, truth)
    elif "melanin" in truth.maps:
        rows += _chromophore_errors(appearance, truth)
    if subsurface.true_profiles(truth):
        rows += _subsurface_errors(appearance, truth)
    return rows


def _chromophore_errors(
    appearance: SkinAppearance, truth: SkinAppearance
) -> Iterator[QuantityAccuracy]:
    for row in flash.compare(appearance, truth, rng=np.random.default_rng(0)):
        name = (
            f"{map_title(row.name)}, median relative error against the {row.against} ground truth"
        )
        interval = 100 * row.interval[0], 100 * row.interval[1]
        got = 100 * row.median_relative
        yield QuantityAccuracy(name, row.band_name, "%", got, interval, row.coverage.fraction)


def _surface_errors(
    appearance: SkinAppearance, truth: SkinAppearance
) -> Iterator[QuantityAccuracy]:
    for row in surface_evaluation.compare(appearance, truth, rng=np.random.default_rng(0)):
        name, unit = f"{map_title(row.name)}, median error", format_unit(row.unit)
        yield QuantityAccuracy(name, "all", unit, row.median, row.interval, row.coverage.fraction)
    for name, unit, band, _, _, middle, _ in errors_by_band(appearance, truth):
        yield QuantityAccuracy(f"{map_title(name)}, median error", f"{band} skin", unit, middle)


def _microrelief_errors(
    appearance: SkinAppearance, truth: SkinAppearance
) -> Iterator[QuantityAccuracy]:
    for one in microrelief.compare(appearance, truth, rng=np.random.default_rng(0)):
        angles = one.median_deg, one.interval_deg, one.coverage
        yield QuantityAccuracy("normals, median error", one.state, "°", *angles)
        if np.isfinite(one.height_um):
            name, got = "height, relative rms error", 100 * one.height_relative
            yield QuantityAccuracy(name, one.state, "%", got, coverage=one.height_coverage)


def _subsurface_errors(
    appearance: SkinAppearance, truth: SkinAppearance
) -> Iterator[QuantityAccuracy]:
    fits = subsurface.compare_fits(appearance, truth)
    for kind in dict.fromkeys(row.kind for row in fits):
        for one in subsurface.summarize_methods([row for row in fits if row.kind == kind]):
            name, skin = f"sigma_tr by {one.method}, median relative error", f"{kind} tissue"
            yield QuantityAccuracy(name, skin, "%", 100 * one.median, coverage=one.coverage)
