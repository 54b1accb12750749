"""Two estimates of one map: how far apart they are, in the unit and in their standard errors."""

from dataclasses import dataclass

import numpy as np

from model import metrics
from model.skin import SkinMap
from skinrig.arrays import BoolArray, Float64Array
from skinrig.reporting.page import short_unit

SIGMA_LEVELS = (1.0, 2.0, 3.0)
"""Combined standard errors that shares of pixels beyond are told for."""
CHANCE_FRACTIONS = (0.3173, 0.0455, 0.0027)
"""Shares beyond them of two estimates with independent normal errors of the stated size."""
MAX_SIGMAS = 35.0
"""Differences of more standard errors are told as this many: tails beyond are no numbers."""


@dataclass(frozen=True, slots=True)
class MapDifference:
    """How two estimates of a map differ, B less A.

    Attributes
    ----------
    name, unit
        Of the map; "°" for normals, whose difference is an angle and has no sign.
    pixels, only_a, only_b
        Pixels that both have a value at, and those that one of them has.
    median_a, median_b
        Of those that both have; NaN for normals.
    bias, median, high
        Median of the difference, and the median and 95th percentile of its size.
    combined
        Median of the two standard errors' root sum of squares, in ``unit``; NaN without them.
    beyond
        Shares of pixels farther apart than `SIGMA_LEVELS` combined standard errors; empty without
        them.
    difference, sigmas
        (H, W): signed difference and difference over the combined standard error, NaN where one
        has no value; of several channels the mean and the farthest one.
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
        """Whether more pixels lie beyond three combined standard errors than chance leaves."""
        return bool(self.beyond) and self.beyond[-1] > MAX_FRACTION_BEYOND


MAX_FRACTION_BEYOND = 0.01
"""Share of pixels beyond three combined standard errors up to which two estimates agree: chance
leaves 0.27 %, and as neighbors share errors, that share itself scatters."""


def compare(name: str, a: SkinMap, b: SkinMap) -> MapDifference:
    """Compare two estimates of one map, pixel by pixel.

    Parameters
    ----------
    name
        Maps with "normals" in their name hold unit vectors, and standard errors of the angle in
        each of two directions, rad.
    a, b
        Of the same shape, on the same pixels.

    Raises
    ------
    ValueError
        When shapes or units differ.

    Notes
    -----
    The combined standard error takes both errors as independent. What the two share, a
    calibration or the model's own error, cancels in the difference: pixels then lie closer
    together than stated errors let expect, never farther.

    Examples
    --------
    >>> one = SkinMap(np.full((2, 2), 1.0), "mm", np.full((2, 2), 0.3))
    >>> other = SkinMap(np.full((2, 2), 2.0), "mm", np.full((2, 2), 0.4))
    >>> found = compare("thickness", one, other)
    >>> found.bias, round(found.combined, 3), found.sigmas.round(3).tolist()
    (1.0, 0.5, [[2.0, 2.0], [2.0, 2.0]])
    """
    if a.values.shape != b.values.shape:
        raise ValueError(
            f"{name}: got shapes {a.values.shape} and {b.values.shape}, expected the same"
        )
    if a.unit != b.unit:
        raise ValueError(f"{name}: got units {a.unit!r} and {b.unit!r}, expected the same")
    if "normals" in name and a.values.ndim == 3:
        return _of_normals(name, a, b)
    return _of_values(name, a, b)


def _of_values(name: str, a: SkinMap, b: SkinMap) -> MapDifference:
    va, vb = a.values.astype(np.float64), b.values.astype(np.float64)
    both = _known(a) & _known(b)
    difference = vb - va
    sigmas = spread = None
    if a.stderr is not None and b.stderr is not None:
        spread = np.hypot(a.stderr.astype(np.float64), b.stderr.astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            sigmas = np.where(difference == 0.0, 0.0, difference / spread)
    medians = _median(va[both]), _median(vb[both]), _median(difference[both])
    return _difference(name, short_unit(a.unit), a, b, medians, difference, spread, sigmas)


def _of_normals(name: str, a: SkinMap, b: SkinMap) -> MapDifference:
    from scipy.special import ndtri

    both = _known(a) & _known(b)
    angle = np.full(both.shape, np.nan)
    angle[both] = metrics.angular_error_rad(
        a.values[both].astype(np.float64), b.values[both].astype(np.float64)
    )
    sigmas = spread = None
    if a.stderr is not None and b.stderr is not None:
        spread = np.hypot(a.stderr[..., 0].astype(np.float64), b.stderr[..., 0].astype(np.float64))
        # an angle is the length of errors in two directions: as many standard errors as a number
        # would be off by with the same chance, exp(-angle^2 / 2 spread^2)
        with np.errstate(divide="ignore", invalid="ignore", under="ignore"):
            chance = np.exp(-0.5 * np.square(angle / spread))
        chance = np.where(angle == 0.0, 1.0, chance)
        sigmas = np.fmin(-ndtri(np.maximum(0.5 * chance, 1e-300)), MAX_SIGMAS)
        spread = np.degrees(spread)
    return _difference(name, "°", a, b, (np.nan, np.nan, np.nan), np.degrees(angle), spread, sigmas)


def _difference(
    name: str,
    unit: str,
    a: SkinMap,
    b: SkinMap,
    medians: tuple[float, float, float],
    difference: Float64Array,
    spread: Float64Array | None,
    sigmas: Float64Array | None,
) -> MapDifference:
    """Summarize a difference in its unit, and over the combined standard error."""
    good_a, good_b = _known(a), _known(b)
    both = good_a & good_b
    only = int((good_a & ~good_b).sum()), int((good_b & ~good_a).sum())
    told = np.abs(difference[both])
    high = float(np.percentile(told, 95)) if told.size else float("nan")
    combined = float("nan")
    beyond: tuple[float, ...] = ()
    if spread is not None and sigmas is not None:
        combined, beyond = _median(spread[both]), _beyond(sigmas[both])
        if sigmas.ndim == 3:
            farthest = np.argmax(np.abs(np.nan_to_num(sigmas)), axis=2)[..., None]
            sigmas = np.take_along_axis(sigmas, farthest, axis=2)[..., 0]
        sigmas = np.where(both, np.clip(sigmas, -MAX_SIGMAS, MAX_SIGMAS), np.nan)
    flat = difference if difference.ndim == 2 else difference.mean(axis=2)
    middle = *medians, _median(told)
    drawn = np.where(both, flat, np.nan)
    pixels = int(both.sum()), *only
    return MapDifference(name, unit, *pixels, *middle, high, combined, beyond, drawn, sigmas)


def _known(one: SkinMap) -> BoolArray:
    finite = np.isfinite(one.values)
    good = finite if finite.ndim == 2 else finite.all(axis=2)
    return np.asarray(good & one.mask, bool)


def _beyond(sigmas: Float64Array) -> tuple[float, ...]:
    told = np.abs(sigmas[~np.isnan(sigmas)])
    if not told.size:
        return ()
    return tuple(float(np.mean(told > level)) for level in SIGMA_LEVELS)


def _median(values: Float64Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
