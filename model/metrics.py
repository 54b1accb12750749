"""Error metrics of estimates against ground truth, and coverage of their intervals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from model.arrays import Float64Array, Int64Array
from model.checks import Checks

N_MEDIAN_DRAWS = 200


def angular_error_rad(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """Return the angle between vectors, accurate for small angles too.

    Parameters
    ----------
    a, b
        (..., 3), of any length but zero.

    Returns
    -------
    ndarray
        (...), rad, in [0, pi]; NaN where a vector has no direction.

    Examples
    --------
    >>> float(angular_error_rad([0, 0, 1], [0, 1e-9, 1]))
    1e-09
    """
    a = np.asarray(a, np.float64)
    b = np.asarray(b, np.float64)
    # arctan2 of sine and cosine; arccos alone loses half of the digits of small angles
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    dot = np.sum(a * b, axis=-1)
    angle = np.arctan2(cross, dot)
    return np.where((cross == 0) & (dot == 0), np.nan, angle)


def individual_typology_angle_deg(lightness: ArrayLike, b_star: ArrayLike) -> Float64Array:
    """Return the individual typology angle, arctan((L* - 50) / b*), in degrees.

    Parameters
    ----------
    lightness, b_star
        CIE L* and b* under D65, any shape that broadcasts.

    Notes
    -----
    Above 55 very light, above 41 light, above 28 intermediate, above 10 tan, above -30 brown,
    else dark (Chardon, Cretois, Hourseau 1991, doi 10.1111/j.1467-2494.1991.tb00561.x).

    Examples
    --------
    >>> float(individual_typology_angle_deg(60.0, 10.0))
    45.0
    """
    return np.degrees(np.arctan2(np.asarray(lightness, np.float64) - 50.0, b_star))


@dataclass(frozen=True, slots=True)
class Coverage:
    """Fraction of intervals that contain the ground truth.

    Attributes
    ----------
    fraction
        In [0, 1]; NaN without trials.
    interval
        Exact (Clopper-Pearson) 95 % interval of the fraction, for independent trials.
    count
        Number of trials.
    """

    fraction: float
    interval: tuple[float, float]
    count: int


def coverage(
    estimate: ArrayLike,
    stderr: ArrayLike,
    truth: ArrayLike,
    *,
    level: float = 0.6827,
    valid: ArrayLike | None = None,
) -> Coverage:
    """Return how often the Gaussian interval of ``estimate`` contains ``truth``.

    Parameters
    ----------
    estimate, stderr, truth
        Arrays that broadcast.
    level
        Nominal coverage, between 0 and 1.
    valid
        Trials that count; None: all that are finite.

    Examples
    --------
    >>> coverage([0.0, 0.0], [1.0, 1.0], [0.5, 3.0]).fraction
    0.5
    """
    Checks().within("level", level, "(0, 1)")
    deviation = np.abs(np.asarray(estimate, np.float64) - np.asarray(truth, np.float64))
    error = np.broadcast_to(np.asarray(stderr, np.float64), deviation.shape)
    counted = np.isfinite(deviation) & np.isfinite(error)
    if valid is not None:
        counted &= np.asarray(valid, bool)
    n = int(np.count_nonzero(counted))
    if n == 0:
        return Coverage(float("nan"), (0.0, 1.0), 0)
    reach = special.ndtri(0.5 + level / 2)
    k = int(np.count_nonzero(deviation[counted] <= reach * error[counted]))
    # Clopper and Pearson (1934); scipy.stats has the same and takes long to import
    low = float(special.betaincinv(k, n - k + 1, 0.025)) if k > 0 else 0.0
    high = float(special.betaincinv(k + 1, n - k, 0.975)) if k < n else 1.0
    return Coverage(k / n, (low, high), n)


def median_with_interval(
    values: ArrayLike, *, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """Return the median and its bootstrap interval of 68 %.

    Parameters
    ----------
    values
        Any shape; NaN are omitted. More than 20,000 are thinned by a random choice.
    rng
        Draws the bootstrap samples.

    Returns
    -------
    median, (low, high)
        NaN without values.
    """
    kept = np.asarray(values, np.float64).ravel()
    kept = kept[np.isfinite(kept)]
    if not kept.size:
        return float("nan"), (float("nan"), float("nan"))
    if kept.size > 20_000:
        kept = rng.choice(kept, 20_000, replace=False)
    draws = rng.integers(0, kept.size, (N_MEDIAN_DRAWS, kept.size))
    ascending, place = _rank(kept)
    medians = [_median_of_draw(ascending, place, draw) for draw in draws]
    low, high = np.quantile(medians, [0.5 - 0.68 / 2, 0.5 + 0.68 / 2])
    return float(np.median(kept)), (float(low), float(high))


def _rank(values: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return the values in ascending order, and the place of each value in it."""
    order = np.argsort(values, kind="stable")
    place = np.empty(len(values), np.int64)
    place[order] = np.arange(len(values))
    return values[order], place


def _median_of_draw(ascending: Float64Array, place: Int64Array, draw: Int64Array) -> float:
    """Return the median of drawn values; counting is 2.5 times as fast as partial sorting."""
    count = len(draw)
    reached = np.cumsum(np.bincount(place[draw], minlength=count))
    middle = np.searchsorted(reached, [(count - 1) // 2 + 1, count // 2 + 1])
    return float(np.mean(ascending[middle]))
