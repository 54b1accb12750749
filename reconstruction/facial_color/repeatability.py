"""Repeatability of expressions: variation within states against between them, and melanin drift.

A subject makes each expression several times, with others in between. The mean of a map over each
region of the face is computed per image. The scatter within a state is compared with noise (a
chi-square test) and with the differences between states (the intraclass correlation). Melanin
should stay constant: its drift over the time of capture is fitted with a free level per state, so
that blood mistaken for melanin does not count as drift.

References
----------
Jimenez et al. 2010, doi:10.1145/1866158.1866167, section 3.1
Donner 1986, A review of inference procedures for the intraclass correlation coefficient in the
one-way random effects model, doi:10.2307/1403259
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array

SCATTER_FALSE_ALARM_RATE = 0.01
"""Probability of a reported scatter or drift in any region when there is none."""
MIN_REGION_PIXELS = 16
WHOLE_REGION = "whole face"
"""Name of the region of all valid pixels."""


class RepeatabilityError(ValueError):
    """Captures whose repeats cannot be compared."""


@dataclass(frozen=True, slots=True)
class RegionRepeatability:
    """One region over all captures.

    Attributes
    ----------
    name : str
    pixels : int
        Number of pixels valid in all captures.
    means : ndarray of float64, shape (N,)
        Mean of the map in each capture.
    within : float
        Standard deviation of repeats about their state's mean.
    between : float
        Standard deviation of the states' levels, corrected for noise and repeats; 0 where the
        states do not differ by more.
    correlation, correlation_stderr : float
        Intraclass correlation: fraction of the variance that is between states, at most 1, and its
        standard error for normally distributed levels.
    chi_square : float
        Chi-square of repeats about their state, by standard errors of noise.
        Probability of such scatter by noise alone.
    p_value : float
        Chance of so much scatter by noise alone.
    scatters : bool
        Whether the p-value is below the false-alarm rate, corrected for the number of regions.
    change_to_scatter : float
        Largest change of a state from the reference, divided by `within`.
    """

    name: str
    pixels: int
    means: Float64Array
    within: float
    between: float
    correlation: float
    correlation_stderr: float
    chi_square: float
    p_value: float
    scatters: bool
    change_to_scatter: float


@dataclass(frozen=True, slots=True)
class Repeatability:
    """Comparison of all regions.

    Attributes
    ----------
    states : tuple of str
        State of each capture.
    regions : tuple of RegionRepeatability
        Regions; the whole face is the last one.
    false_alarm : float
        Probability of a reported scatter in any region by noise alone.
    omitted : tuple of (str, str)
        Regions with too few valid pixels, and their number.
    """

    states: tuple[str, ...]
    regions: tuple[RegionRepeatability, ...]
    false_alarm: float
    omitted: tuple[tuple[str, str], ...]

    def region(self, name: str) -> RegionRepeatability:
        """Return a region by name."""
        for found in self.regions:
            if found.name == name:
                return found
        names = ", ".join(found.name for found in self.regions)
        raise RepeatabilityError(f"region: got {name!r}, expected one of {names}; choose one")


@dataclass(frozen=True, slots=True)
class MapDrift:
    """Change of a map over the time of capture.

    Attributes
    ----------
    name : str
        Name of the region.
    slope_per_minute, slope_stderr : float
        In units of the map per minute, and its standard error.
    p_value : float
        Probability of such a slope without drift.
    drifts : bool
        Whether the p-value is below the false-alarm rate, corrected for the number of regions.
    """

    name: str
    slope_per_minute: float
    slope_stderr: float
    p_value: float
    drifts: bool


def compare_states(
    maps: ArrayLike,
    states: Sequence[str],
    *,
    stderr: ArrayLike,
    valid: ArrayLike | None = None,
    regions: Mapping[str, ArrayLike] | None = None,
    reference: str = "neutral",
    correlated_px: float = 1.0,
    false_alarm: float = SCATTER_FALSE_ALARM_RATE,
) -> Repeatability:
    """Compare the variation within states with that between states.

    Parameters
    ----------
    maps : array_like, shape (N, H, W)
        The map of each capture, aligned.
    states : sequence of str
        State of each capture, N; at least one of them twice.
    stderr : array_like, shape (N, H, W)
        Standard error by noise alone, such as `hemoglobin_noise_stderr`, without errors common to
        all captures.
    valid : array_like of bool, shape (N, H, W), optional
    regions : mapping of str to array_like of bool (H, W), optional
        By default a grid of 3 x 3 over the valid pixels.
    reference : str
        State that changes refer to; if it was not captured, the mean of the states.
    correlated_px : float
        Number of pixels with common noise, at least 1: divides the number of independent pixels
        of a region. Interpolation and demosaicing make it some 2 to 4.
    false_alarm : float
        Probability of a reported scatter in any region by noise alone.

    Returns
    -------
    Repeatability

    Raises
    ------
    RepeatabilityError
        For mismatched shapes, states without repeats, or regions without pixels.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> level = np.array([0.02, 0.03, 0.02, 0.03])[:, None, None]
    >>> maps = level + 1e-3 * rng.standard_normal((4, 24, 24))
    >>> found = compare_states(
    ...     maps, ["neutral", "smile"] * 2, stderr=np.full(maps.shape, 1e-3)
    ... ).region("whole face")
    >>> found.correlation > 0.99, found.scatters
    (True, False)
    """
    captured = _Captures.of(maps, states, stderr, valid)
    repeated = len(captured.states) > len(captured.groups)
    expected = "at least one that is repeated; add repeats"
    Checks(RepeatabilityError).require(repeated, "states", "each once", expected)
    chosen, left_out, limit = captured.regions(regions, correlated_px, false_alarm)
    found = tuple(_compared(region, captured.groups, reference, limit) for region in chosen)
    return Repeatability(captured.states, found, false_alarm, left_out)


def fit_drift(
    maps: ArrayLike,
    states: Sequence[str],
    times_s: ArrayLike,
    *,
    stderr: ArrayLike,
    valid: ArrayLike | None = None,
    regions: Mapping[str, ArrayLike] | None = None,
    correlated_px: float = 1.0,
    false_alarm: float = SCATTER_FALSE_ALARM_RATE,
) -> tuple[MapDrift, ...]:
    """Fit the drift of a map, such as melanin, over the time of capture.

    Parameters
    ----------
    maps, states, stderr, valid, regions, correlated_px, false_alarm
        See `compare_states`; states captured once do not contribute.
    times_s : array_like, shape (N,)
        Time of each capture, s.

    Returns
    -------
    tuple of MapDrift
        By region, the whole face last. Each state has a free level, so that differences between
        interleaved states do not count as drift. The error is from the scatter about the line, or
        from noise where that is larger.

    Raises
    ------
    RepeatabilityError
        When captures minus states leave no degree of freedom, or times do not differ within
        states.

    Examples
    --------
    >>> times = 60.0 * np.arange(6)
    >>> maps = 0.02 + 1e-4 * np.arange(6)[:, None, None] + np.zeros((6, 8, 8))
    >>> found = fit_drift(maps, ["neutral", "smile"] * 3, times, stderr=np.full(maps.shape, 1e-4))
    >>> f"{found[-1].slope_per_minute:.5f}", found[-1].drifts
    ('0.00010', True)
    """
    captured = _Captures.of(maps, states, stderr, valid)
    names, groups = captured.states, captured.groups
    times = Checks(RepeatabilityError).numbers("times_s", times_s, (len(names),))
    degrees = len(names) - len(groups) - 1
    apart = captured.within_states(times / 60.0)
    square = float((apart**2).sum())
    if degrees < 1 or not square > 0:
        raise RepeatabilityError(
            f"states: {len(names)} captures of {len(groups)} states leave no repeats over time; "
            "expected at least two more captures than states; capture repeats"
        )
    chosen, _, limit = captured.regions(regions, correlated_px, false_alarm)
    found = []
    for region in chosen:
        rest = captured.within_states(region.means)
        slope = float((apart * rest).sum() / square)
        scatter = math.sqrt(float(((rest - slope * apart) ** 2).sum()) / degrees)
        by_noise = math.sqrt(float((apart**2 * region.noise**2).sum())) / square
        by_scatter = scatter / math.sqrt(square)
        stderr_slope = max(by_scatter, by_noise)
        sigmas = abs(slope) / max(stderr_slope, 1e-300)
        one_side = stats.t.sf(sigmas, degrees) if by_scatter >= by_noise else stats.norm.sf(sigmas)
        p_value = float(2 * one_side)
        found.append(MapDrift(region.name, slope, stderr_slope, p_value, p_value < limit))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """Means of the captures in one region, and their standard errors by noise, (N,)."""

    name: str
    pixels: int
    means: Float64Array
    noise: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _Captures:
    """Checked maps of captures, (N, H, W), and the pixels valid in all of them, (H, W)."""

    values: Float64Array
    stderr: Float64Array
    known: BoolArray
    states: tuple[str, ...]
    groups: Mapping[str, NDArray[np.intp]]
    """Captures of each state."""

    @staticmethod
    def of(
        maps: ArrayLike, states: Sequence[str], stderr: ArrayLike, valid: ArrayLike | None
    ) -> _Captures:
        values, error = np.asarray(maps, np.float64), np.asarray(stderr, np.float64)
        check = Checks(RepeatabilityError)
        check.require(values.ndim == 3, "maps", f"shape {values.shape}", "(N, H, W)")
        check.shape("stderr", error, values.shape)
        check.shape("states", states, (len(values),))
        good = np.ones(values.shape, bool) if valid is None else np.asarray(valid, bool)
        check.shape("valid", good, values.shape)
        known = np.asarray((good & np.isfinite(values) & np.isfinite(error)).all(axis=0))
        check.within("stderr", error[:, known], "[0, inf)")
        groups = {
            state: np.flatnonzero([other == state for other in states])
            for state in dict.fromkeys(states)
        }
        return _Captures(values, error, known, tuple(states), groups)

    def within_states(self, values: Float64Array) -> Float64Array:
        """Subtract their state's mean from values of the captures (N,)."""
        rest = values.copy()
        for members in self.groups.values():
            rest[members] -= values[members].mean()
        return rest

    def regions(
        self, regions: Mapping[str, ArrayLike] | None, correlated_px: float, false_alarm: float
    ) -> tuple[list[_Region], tuple[tuple[str, str], ...], float]:
        """Return the regions with pixels, those without, and the p-value limit of one region."""
        check = Checks(RepeatabilityError)
        check.within("false_alarm", false_alarm, "(0, 1)")
        check.within("correlated_px", correlated_px, "[1, inf]")
        given = _grid(self.known) if regions is None else regions
        wanted = {name: np.asarray(mask, bool) for name, mask in given.items()}
        chosen, left_out = [], []
        for name, mask in {**wanted, WHOLE_REGION: np.ones_like(self.known)}.items():
            check.shape(f"regions, {name!r}", mask, self.known.shape)
            seen = mask & self.known
            count = int(seen.sum())
            if count < MIN_REGION_PIXELS:
                left_out.append((name, f"{count} pixels are valid in all captures"))
                continue
            means = self.values[:, seen].mean(axis=1)
            squares = (self.stderr[:, seen] ** 2).sum(axis=1)
            noise = np.sqrt(squares * min(correlated_px, count)) / count
            # include the rounding of float32 maps in the noise
            noise = np.maximum(noise, 1e-9 * np.abs(means) + 1e-30)
            chosen.append(_Region(name, count, means, noise))
        got = "no region with pixels that are valid in all captures"
        check.require(chosen, "valid", got, "some; check masks and regions")
        # Sidak correction: the family of regions has the given rate
        return chosen, tuple(left_out), 1.0 - (1.0 - false_alarm) ** (1.0 / len(chosen))


def _compared(
    region: _Region, groups: Mapping[str, NDArray[np.intp]], reference: str, limit: float
) -> RegionRepeatability:
    means, noise = region.means, region.noise
    count, kinds = len(means), len(groups)
    levels = {state: float(means[members].mean()) for state, members in groups.items()}
    sizes = np.array([len(members) for members in groups.values()], np.float64)
    degrees = count - kinds
    square_within = sum(
        float(((means[members] - levels[state]) ** 2).sum()) for state, members in groups.items()
    )
    within = math.sqrt(square_within / degrees)
    chi_square = sum(_scatter(means[members], noise[members]) for members in groups.values())
    p_value = float(stats.chi2.sf(chi_square, degrees))
    between, correlation, error = 0.0, 0.0, math.nan
    if kinds > 1:
        grand = float(means.mean())
        square_between = sum(
            size * (levels[state] - grand) ** 2 for size, state in zip(sizes, groups, strict=True)
        )
        # effective number of captures per state, which makes E[MS_between] =
        # within^2 + typical * between^2 for unequal sizes
        typical = (count - float((sizes**2).sum()) / count) / (kinds - 1)
        ms_between, ms_within = square_between / (kinds - 1), square_within / degrees
        variance = (ms_between - ms_within) / typical
        between = math.sqrt(max(variance, 0.0))
        whole = variance + ms_within
        correlation = float(variance / whole) if whole > 0 else 0.0
        error = _correlation_stderr(correlation, typical, kinds, count)
    start = levels.get(reference, float(np.mean(list(levels.values()))))
    largest = max(abs(level - start) for level in levels.values())
    return RegionRepeatability(
        region.name,
        region.pixels,
        means,
        within,
        between,
        correlation,
        error,
        chi_square,
        p_value,
        p_value < limit,
        largest / within if within > 0 else math.inf,
    )


def _scatter(means: Float64Array, noise: Float64Array) -> float:
    """Return the chi-square of some captures about their weighted mean."""
    weight = noise**-2.0
    center = float((weight * means).sum() / weight.sum())
    return float((weight * (means - center) ** 2).sum())


def _correlation_stderr(correlation: float, size: float, kinds: int, count: int) -> float:
    """Return the large-sample standard error of an intraclass correlation (Donner 1986, 3.1)."""
    # large-sample variance 2 (N - 1) (1 - r)^2 (1 + (n - 1) r)^2 / (n^2 (N - k) (k - 1))
    spread = (1.0 - correlation) * (1.0 + (size - 1.0) * correlation)
    return math.sqrt(2.0 * (count - 1) / ((kinds - 1) * (count - kinds))) * abs(spread) / size


def _grid(known: BoolArray) -> dict[str, BoolArray]:
    """Return 3 x 3 cells over the valid pixels, named by their position in the image."""
    places = np.argwhere(known)
    out: dict[str, BoolArray] = {}
    if not len(places):
        return out
    low, high = places.min(axis=0), places.max(axis=0) + 1
    rows, columns = (
        np.linspace(a, b, 4).round().astype(int) for a, b in zip(low, high, strict=True)
    )
    for i, vertical in enumerate(("upper", "middle", "lower")):
        for j, across in enumerate(("left", "center", "right")):
            mask = np.zeros_like(known)
            mask[rows[i] : rows[i + 1], columns[j] : columns[j + 1]] = True
            out[f"{vertical} {across}"] = mask
    return out
