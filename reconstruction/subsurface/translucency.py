"""Interpolate translucency, 1/sigma_tr, over a face from a few sites, with its standard error.

log(1/sigma_tr) over a face is modeled as a person's level plus a smooth field, both normal: the
prior of a person is a population's (`model.translucency_population`), and correlations over the
face fall off as ``exp(-d^2 / 2 length^2)``. A map is the posterior of that model (kriging): it
passes through well measured sites and returns to the person's level away from them, where its
standard error grows to the deviation between people and sites. Nothing is extrapolated.

Translucency is 1/sigma_tr in mm (Weyrich et al. 2005, section 8): of two places, the one of
smaller sigma_tr is the more translucent.

References
----------
Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, section 2.2.
Weyrich et al. 2005, MERL TR2005-071, published as doi:10.1145/1141911.1141987
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from model.checks import FINITE_RANGE, Checks
from model.translucency_population import weyrich_2005
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.subsurface.models import blas_threads

TEXTURE_MM: Final = (200.0, 330.0)
"""Width and height of the head texture on the skin near the middle of the face, mm; towards the
ears the width is up to 340."""
CORRELATION_LENGTH_MM: Final = 60.0
"""Distance at which deviations from the person's level are correlated by 0.61: assumed, about from
a cheek to the nose. The paper states "slowly varying" without a number."""
MAX_RELATIVE_ERROR: Final = 0.5
"""Relative standard error of sigma_tr above which a site is omitted: it may be 0."""
REPEAT_DISTANCE_MM: Final = 2.0
"""Distance up to which measurements are repeats of one site."""
CONFLICT_P_VALUE: Final = 0.01
"""Repeats of one site whose scatter is less probable than this count as contradictory."""
MIN_RELATIVE_VARIANCE: Final = 1e-10
"""Least posterior variance over the prior's."""


class TranslucencyError(ValueError):
    """Sites, values or a prior that no map can be computed from."""


@dataclass(frozen=True, slots=True)
class TranslucencyPrior:
    """Prior of log(1/sigma_tr) for an unmeasured person, by channel.

    Attributes
    ----------
    log_mean : ndarray of float64, shape (C,)
        Mean of log(1/sigma_tr), sigma_tr in 1/mm.
    person_deviation : ndarray of float64, shape (C,)
        Standard deviation of the level of a face between people, above 0.
    place_deviation : ndarray of float64, shape (C,)
        Standard deviation between sites of a face, above 0.
    length_mm : float
        Distance of correlation over the face, above 0.
    source : str
    """

    log_mean: Float64Array
    person_deviation: Float64Array
    place_deviation: Float64Array
    length_mm: float = CORRELATION_LENGTH_MM
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse deviations and lengths that are not positive."""
        shape, check = np.shape(self.log_mean), Checks(TranslucencyError)
        for name in ("log_mean", "person_deviation", "place_deviation"):
            values = np.array(getattr(self, name), np.float64)
            interval = FINITE_RANGE if name == "log_mean" else "(0, inf)"
            check.require(values.ndim == 1, name, f"shape {values.shape}", "(C,)")
            check.shape(name, values, shape)
            check.within(name, values, interval)
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        check.within("length_mm", self.length_mm, "(0, inf)")


def population_prior() -> TranslucencyPrior:
    """Return the prior of a person from table 2 of Weyrich et al. 2005.

    The level varies by the part of the variance that sites have in common, the sites by the rest
    and by the variance of their means. Variances are averaged over sites. The table's deviations
    include the noise of measurement, so that the prior is rather too wide.

    Examples
    --------
    >>> prior = population_prior()
    >>> np.exp(prior.log_mean).round(2).tolist()
    [1.75, 0.97, 0.61]
    >>> np.hypot(prior.person_deviation, prior.place_deviation).round(2).tolist()
    [0.29, 0.26, 0.21]
    """
    people = weyrich_2005()
    deviation, places = people.log_deviation, len(people.sites)
    squares = (deviation**2).sum(axis=0)
    # mean covariance of two different places
    pairs = (deviation.sum(axis=0) ** 2 - squares) / (places * (places - 1))
    shared = max(people.site_correlation, 1e-6) * pairs
    rest = (deviation**2).mean(axis=0) - shared
    return TranslucencyPrior(
        log_mean=-people.log_mean.mean(axis=0),
        person_deviation=np.sqrt(shared),
        place_deviation=np.sqrt(rest + people.log_mean.var(axis=0, ddof=1)),
        source=people.source,
    )


@dataclass(frozen=True, slots=True)
class TranslucencyMap:
    """1/sigma_tr over a texture.

    Attributes
    ----------
    values : ndarray of float32, shape (H, W, C)
        1/sigma_tr, mm, above 0: the posterior's median; 0 where not valid. Row 0 is v = 1.
    stderr : ndarray of float32, shape (H, W, C)
        Half of the width of its 68 % interval, mm; 0 where not valid.
    valid : ndarray of bool, shape (H, W, C)
        False outside the mask, and in a channel without a usable site.
    log_stderr : ndarray of float32, shape (H, W, C)
        Standard deviation of log(1/sigma_tr): the interval is values times exp(-+ log_stderr).
    used : ndarray of bool, shape (S, C)
        Measurements that the map uses.
    p_value : ndarray of float64, shape (C,)
        Probability under the population of a face at least as far from its mean; 1 without a usable
        site. Where it is tiny, do not rely on standard errors away from the sites.
    omitted : tuple of (str, str)
        Measurement and channel, and why it was omitted.
    conflicts : tuple of (str, str)
        Site and channel whose repeats contradict each other, and how; their error was widened.
    """

    values: Float32Array
    stderr: Float32Array
    valid: BoolArray
    log_stderr: Float32Array
    used: BoolArray
    p_value: Float64Array
    omitted: tuple[tuple[str, str], ...]
    conflicts: tuple[tuple[str, str], ...]


def interpolate(
    sites_uv: ArrayLike,
    sigma_tr_per_mm: ArrayLike,
    stderr_per_mm: ArrayLike,
    shape: tuple[int, int],
    *,
    valid: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    prior: TranslucencyPrior | None = None,
    texture_mm: tuple[float, float] = TEXTURE_MM,
    mask: ArrayLike | None = None,
) -> TranslucencyMap:
    """Interpolate 1/sigma_tr over a texture from some sites.

    Parameters
    ----------
    sites_uv : array_like, shape (S, 2)
        Texture coordinates of the measurements, u to the right, v up, each 0...1; repeats have
        equal ones (within `REPEAT_DISTANCE_MM`).
    sigma_tr_per_mm, stderr_per_mm : array_like, shape (S, C)
        Measured, with standard errors, 1/mm.
    shape : (int, int)
        Rows and columns of the map.
    valid : array_like of bool, shape (S, C) or (S,), optional
        Measurements to use.
    names : sequence of str, optional
        Names of the measurements in messages; by default their numbers.
    prior : TranslucencyPrior, optional
        Of C channels; that of table 2's population by default, which has three.
    texture_mm : (float, float)
        Width and height of the texture on the skin, mm.
    mask : array_like of bool, shape (H, W), optional
        Where there is skin.

    Returns
    -------
    TranslucencyMap

    Raises
    ------
    TranslucencyError
        If no measurement is usable, with the reason for each; for shapes that do not fit,
        coordinates beyond the texture, or standard errors below 0.

    Examples
    --------
    >>> from reconstruction.subsurface.probe_sites import SITE_UV
    >>> places = [SITE_UV[name] for name in ("forehead", "cheek", "chin")]
    >>> sigma_tr = np.array([[0.54, 0.98, 1.55], [0.56, 0.98, 1.55], [0.69, 1.25, 1.92]])
    >>> found = interpolate(places, sigma_tr, 0.03 * sigma_tr, (64, 64))
    >>> row, column = int((1 - 0.82) * 64), 32
    >>> [f"{v:.2f}" for v in found.values[row, column]], f"{found.stderr[row, column, 0]:.2f}"
    (['1.85', '1.02', '0.64'], '0.06')
    """
    prior = population_prior() if prior is None else prior
    at, sigma, stderr, good, labels = _checked(
        sites_uv, sigma_tr_per_mm, stderr_per_mm, valid, names, prior
    )
    check = Checks(TranslucencyError)
    check.within("shape", shape, "[1, inf)")
    rows, columns = shape
    size = check.numbers("texture_mm", texture_mm, (2,), interval="(0, inf)")
    skin = np.ones(shape, bool) if mask is None else np.asarray(mask, bool)
    check.shape("mask", skin, tuple(shape))
    usable, left_out = _usable(sigma, stderr, good, labels)
    if not usable.any():
        why = "; ".join(f"{where}: {reason}" for where, reason in left_out)
        raise TranslucencyError(
            f"sigma_tr_per_mm: got no usable measurement ({why}), expected one at least; "
            "check the sites or measure again"
        )

    channels = prior.log_mean.size
    values, half, log_stderr = np.zeros((3, rows, columns, channels), np.float32)
    p_value = np.ones(channels)
    conflicts: list[tuple[str, str]] = []
    u_mm = size[0] * (np.arange(columns) + 0.5) / columns
    v_mm = size[1] * (1.0 - (np.arange(rows) + 0.5) / rows)
    for c in range(channels):
        chosen = np.flatnonzero(usable[:, c])
        if not chosen.size:
            continue
        places = _merged(
            size * at[chosen],
            -np.log(sigma[chosen, c]),
            stderr[chosen, c] / sigma[chosen, c],
            [f"{labels[k]}, channel {c}" for k in chosen],
        )
        conflicts += places.conflicts
        posterior = _Posterior.of(places, prior, c)
        p_value[c] = posterior.p_value
        # products this small take longer on several threads than on one
        with blas_threads().limit(limits=1):
            median, deviation = (a.astype(np.float32) for a in posterior.over(u_mm, v_mm))
        np.exp(median, out=values[..., c])
        np.multiply(values[..., c], np.sinh(deviation), out=half[..., c])
        log_stderr[..., c] = deviation
    for array in (values, half, log_stderr):
        array[~skin] = 0.0
    return TranslucencyMap(
        values=values,
        stderr=half,
        valid=skin[..., None] & usable.any(axis=0),
        log_stderr=log_stderr,
        used=usable,
        p_value=p_value,
        omitted=tuple(left_out),
        conflicts=tuple(conflicts),
    )


def _checked(
    sites_uv: ArrayLike,
    sigma_tr_per_mm: ArrayLike,
    stderr_per_mm: ArrayLike,
    valid: ArrayLike | None,
    names: Sequence[str] | None,
    prior: TranslucencyPrior,
) -> tuple[Float64Array, Float64Array, Float64Array, BoolArray, list[str]]:
    check = Checks(TranslucencyError)
    at = check.numbers("sites_uv", sites_uv, ("S", 2), interval="[0, 1]")
    sigma = np.asarray(sigma_tr_per_mm, np.float64)
    stderr = np.asarray(stderr_per_mm, np.float64)
    expected = (len(at), prior.log_mean.size)
    good = np.ones(expected, bool)
    if valid is not None:
        good = np.array(valid, bool)
        good = np.repeat(good[:, None], expected[1], axis=1) if good.ndim == 1 else good
    for name, array in (("sigma_tr_per_mm", sigma), ("stderr_per_mm", stderr), ("valid", good)):
        check.shape(name, array, expected)
    check.within("stderr_per_mm", np.nan_to_num(stderr[good]), "[0, inf]")
    labels = [str(k) for k in range(len(at))] if names is None else list(names)
    check.require(len(labels) == len(at), "names", len(labels), f"{len(at)}")
    return at, sigma, stderr, good, labels


def _usable(
    sigma: Float64Array, stderr: Float64Array, good: BoolArray, labels: list[str]
) -> tuple[BoolArray, list[tuple[str, str]]]:
    """Return which measurements count (S, C), and why the others are omitted."""
    usable = np.zeros(good.shape, bool)
    left_out = []
    for s, c in np.ndindex(good.shape):
        value, error = float(sigma[s, c]), float(stderr[s, c])
        reason = ""
        if not good[s, c]:
            reason = "not valid"
        elif not (math.isfinite(value) and math.isfinite(error)):
            reason = "sigma_tr or its standard error is not finite"
        elif value <= 0 or error > MAX_RELATIVE_ERROR * value:
            reason = f"sigma_tr {value:.3g} ± {error:.3g} per mm does not differ from 0"
        usable[s, c] = not reason
        if reason:
            left_out.append((f"{labels[s]}, channel {c}", reason))
    return usable, left_out


@dataclass(frozen=True, slots=True)
class _Places:
    """Distinct sites of one channel: positions (P, 2), mm; logs and their variances (P,)."""

    at_mm: Float64Array
    log: Float64Array
    variance: Float64Array
    conflicts: tuple[tuple[str, str], ...]


def _merged(
    at_mm: Float64Array, log: Float64Array, error: Float64Array, labels: list[str]
) -> _Places:
    """Average repeats of a site by their errors, widened where the scatter exceeds these."""
    # an error of 0 would take all weight from the others; rounding is the least error
    error = np.maximum(error, 1e-7)
    left = np.arange(len(log))
    at, mean, variance, conflicts = [], [], [], []
    while left.size:
        near = np.hypot(*(at_mm[left] - at_mm[left[0]]).T) <= REPEAT_DISTANCE_MM
        same, left = left[near], left[~near]
        weight = error[same] ** -2.0
        center = float((weight * log[same]).sum() / weight.sum())
        chi2 = float((weight * (log[same] - center) ** 2).sum())
        dof = same.size - 1
        spread = max(1.0, chi2 / dof) if dof else 1.0
        if dof and stats.chi2.sf(chi2, dof) < CONFLICT_P_VALUE:
            times = f"{math.sqrt(spread):.1f} times their errors"
            conflicts.append((labels[same[0]], f"{same.size} repeats differ by {times}"))
        at.append(at_mm[same].mean(axis=0))
        mean.append(center)
        variance.append(spread / weight.sum())
    return _Places(np.array(at), np.array(mean), np.array(variance), tuple(conflicts))


@dataclass(frozen=True, slots=True)
class _Posterior:
    """Normal posterior of log(1/sigma_tr) over the texture, one channel."""

    at_mm: Float64Array
    length_mm: float
    log_mean: float
    shared: float
    """Prior variance of the person's level."""
    local: float
    """Prior variance of a site about it."""
    inverse: Float64Array
    """Inverse covariance of the measurements, (P, P)."""
    pull: Float64Array
    """That inverse times the measurements less the mean, (P,)."""
    p_value: float

    @classmethod
    def of(cls, places: _Places, prior: TranslucencyPrior, channel: int) -> _Posterior:
        shared = float(prior.person_deviation[channel]) ** 2
        local = float(prior.place_deviation[channel]) ** 2
        mean = float(prior.log_mean[channel])
        apart = places.at_mm[:, None] - places.at_mm[None]
        squared = (apart**2).sum(axis=-1) / prior.length_mm**2
        noise = places.variance + MIN_RELATIVE_VARIANCE * (shared + local)
        covariance = shared + local * np.exp(-0.5 * squared) + np.diag(noise)
        inverse = np.linalg.inv(covariance)
        off = places.log - mean
        pull = inverse @ off
        p_value = float(stats.chi2.sf(max(float(off @ pull), 0.0), off.size))
        return cls(places.at_mm, prior.length_mm, mean, shared, local, inverse, pull, p_value)

    def over(self, u_mm: Float64Array, v_mm: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return mean and standard deviation (H, W) at columns ``u_mm`` and rows ``v_mm``.

        The kernel is a product of one over u and one over v, so maps are products of few columns.
        """
        # Rasmussen and Williams, eqs. (2.25) and (2.26): mean k'K^-1 y, variance k(x, x) - k'K^-1 k
        # with k = shared + local * along * across, expanded in products of rows and columns
        across = np.exp(-0.5 * ((u_mm[:, None] - self.at_mm[:, 0]) / self.length_mm) ** 2)
        along = np.exp(-0.5 * ((v_mm[:, None] - self.at_mm[:, 1]) / self.length_mm) ** 2)
        first, second = np.triu_indices(len(self.pull))
        twice = np.where(first == second, 1.0, 2.0) * self.inverse[first, second]
        total = self.shared + self.local
        level = self.log_mean + self.shared * self.pull.sum()
        left = total - self.shared**2 * self.inverse.sum()
        mean = _product(level, self.local * along * self.pull, across)
        by_place = -2.0 * self.shared * self.local * along * self.inverse.sum(axis=0)
        by_pair = -(self.local**2) * along[:, first] * along[:, second] * twice
        variance = _product(
            left,
            np.column_stack([by_place, by_pair]),
            np.column_stack([across, across[:, first] * across[:, second]]),
        )
        np.maximum(variance, MIN_RELATIVE_VARIANCE * total, out=variance)
        return mean, np.sqrt(variance, out=variance)


def _product(constant: float, rows: Float64Array, columns: Float64Array) -> Float64Array:
    """Return ``constant + rows columns'``, (H, W), in one pass."""
    left = np.column_stack([np.full(len(rows), constant), rows])
    right = np.column_stack([np.ones(len(columns)), columns])
    return np.asarray(left @ right.T)
