"""Curves of blood at sites of a face, against time and against the phase of a cycle.

A sequence of maps gives each site a value and a standard error per frame. Plotted against the true
phase of each frame, they show one cycle, sampled more finely than by the camera (Jimenez et al.
2010, section 3.1 and figures 5 and 6). A test decides whether samples exist between the two levels,
at a given false-alarm rate; its power for a single sample is reported.

References
----------
Jimenez et al. 2010, doi:10.1145/1866158.1866167, section 3.1
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, Int64Array

FACE_SITES = ("forehead", "cheek", "nose", "chin", "temple")
"""Sites of the curves."""
LANDMARK_ALIASES: Mapping[str, str] = {
    "cheek": "cheek left",
    "nose": "nose tip",
    "temple": "temple left",
}
"""Landmark that replaces a site's own name in a table without it."""
TRANSITION_FALSE_ALARM_RATE = 0.05
"""Probability of a detected transition in a cycle without one."""
MAX_PHASE_FRACTION = 0.25
"""Maximum gap within one phase, as a fraction of the sampling interval."""
_FACE_POSITIONS: Mapping[str, tuple[float, float]] = {
    "forehead": (0.50, 0.14),
    "cheek": (0.27, 0.57),
    "nose": (0.50, 0.57),
    "chin": (0.50, 0.90),
    "temple": (0.17, 0.30),
}
"""Positions of the sites between left and right, top and bottom of a face that fills the image's
height from hairline to chin: Jimenez et al. 2010, figure 7, by eye."""


class CurveError(ValueError):
    """Samples that a curve cannot be computed from."""


@dataclass(frozen=True, slots=True, eq=False)
class DiscMeans:
    """Means over discs of maps."""

    mean: Float64Array
    """(P, N): mean of each site in each map; NaN where no pixel is valid."""
    stderr: Float64Array
    """(P, N): its standard error, from errors independent between pixels."""
    pixels: Int64Array
    """(P, N): number of valid pixels."""

    @property
    def valid(self) -> BoolArray:
        """(P, N): whether any pixel is valid."""
        return self.pixels > 0


def average_discs(
    maps: ArrayLike,
    positions: Mapping[str, tuple[float, float]],
    radius_px: float,
    *,
    stderr: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> DiscMeans:
    """Average maps over discs.

    Parameters
    ----------
    maps : array_like, shape (N, H, W)
        Aligned maps, such as hemoglobin, one per frame.
    positions : mapping of str to (x, y)
        Centers, px: x to the right and y down from the center of the first pixel.
    radius_px : float
        Radius of the discs, px, > 0; the pixel nearest to the center always belongs to it.
    stderr : array_like, shape (N, H, W), optional
        Standard errors of the maps. None: the scatter within each disc, which overestimates them
        on uneven skin.
    valid : array_like of bool, shape (N, H, W), optional

    Returns
    -------
    DiscMeans

    Raises
    ------
    CurveError
        For a mismatched shape, or a center outside the maps.

    Examples
    --------
    >>> ramp = np.arange(25.0).reshape(1, 5, 5)
    >>> average_discs(ramp, {"middle": (2, 2)}, 1.0).mean.tolist()
    [[12.0]]
    """
    values = np.asarray(maps, np.float64)
    Checks(CurveError).require(values.ndim == 3, "maps", f"shape {values.shape}", "(N, H, W)")
    Checks(CurveError).within("radius_px", radius_px, "(0, inf)")
    good = np.isfinite(values)
    if valid is not None:
        good &= _broadcast_like(valid, values, "valid").astype(bool)
    spread = (
        None if stderr is None else _broadcast_like(stderr, values, "stderr").astype(np.float64)
    )
    if spread is not None:
        good &= np.isfinite(spread)
    means, errors, counts = [], [], []
    for name, place in positions.items():
        rows, columns = disc_pixels(values.shape[1:], name, place, radius_px)
        here = good[:, rows, columns]
        shown = np.where(here, values[:, rows, columns], 0.0)
        count = here.sum(axis=1)
        several = np.maximum(count, 1)
        mean = shown.sum(axis=1) / several
        if spread is None:
            deviation = np.where(here, shown - mean[:, None], 0.0)
            scatter = (deviation**2).sum(axis=1) / np.maximum(count - 1, 1)
            error = np.where(count > 1, np.sqrt(scatter / several), np.nan)
        else:
            own = np.where(here, spread[:, rows, columns], 0.0)
            error = np.sqrt((own**2).sum(axis=1)) / several
        means.append(np.where(count > 0, mean, np.nan))
        errors.append(np.where(count > 0, error, np.nan))
        counts.append(count)
    return DiscMeans(np.array(means), np.array(errors), np.array(counts, np.int64))


def disc_pixels(
    shape: tuple[int, ...], name: str, position: tuple[float, float], radius_px: float
) -> tuple[Int64Array, Int64Array]:
    """Return rows and columns of the pixels of a disc around (x, y), px.

    Raises
    ------
    CurveError
        Where the center is outside the map.
    """
    height, width = shape
    x, y = position
    inside = -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
    expected = f"within {width} x {height} px; move it"
    Checks(CurveError).require(inside, name, f"({x:g}, {y:g}) px", expected)
    rows, columns = np.indices((height, width))
    squared = (columns - x) ** 2 + (rows - y) ** 2
    found_rows, found_columns = np.nonzero(squared <= max(radius_px**2, float(squared.min())))
    return found_rows, found_columns


def standard_positions(skin: ArrayLike) -> dict[str, tuple[float, float]]:
    """Return the sites' positions on a face, px, from its outline alone.

    Parameters
    ----------
    skin : array_like of bool, shape (H, W)
        Pixels of skin: a frontal face that fills the image's height.

    Returns
    -------
    dict
        (x, y) of :data:`FACE_SITES`, relative to the central 96 % of the skin in each direction.

    Raises
    ------
    CurveError
        When the mask is empty or not two-dimensional.
    """
    shown = np.asarray(skin, bool)
    Checks(CurveError).require(shown.ndim == 2, "skin", f"shape {shown.shape}", "(H, W)")
    rows, columns = np.nonzero(shown)
    Checks(CurveError).require(rows.size != 0, "skin", "none", "a face; check the mask")
    left, right = np.percentile(columns, (2, 98))
    top, bottom = np.percentile(rows, (2, 98))
    return {
        name: (float(left + u * (right - left)), float(top + v * (bottom - top)))
        for name, (u, v) in _FACE_POSITIONS.items()
    }


def select_sites(table: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Select the sites' positions from a table of landmarks, by name or alias.

    Parameters
    ----------
    table : mapping of str to (x, y)
        Landmarks, px.

    Returns
    -------
    dict
        (x, y) of those of :data:`FACE_SITES` that the table has.

    Raises
    ------
    CurveError
        If the table has none.

    Examples
    --------
    >>> select_sites({"nose tip": (3.0, 4.0), "ear": (0.0, 0.0)})
    {'nose': (3.0, 4.0)}
    """
    named = {
        name: name if name in table else LANDMARK_ALIASES.get(name, name) for name in FACE_SITES
    }
    found = {name: table[place] for name, place in named.items() if place in table}
    expected = f"one of {', '.join((*FACE_SITES, *LANDMARK_ALIASES.values()))}"
    Checks(CurveError).require(found, "names of landmarks", ", ".join(table) or "none", expected)
    return found


@dataclass(frozen=True, slots=True)
class Reproducibility:
    """Repeatability of a phase over several cycles."""

    sd: float
    """Standard deviation of one sample within its phase; NaN without repeats."""
    repeats: int
    """Number of samples minus number of phases: degrees of freedom."""
    longest_s: float
    """Longest time between two samples of one phase, s; 0 without repeats."""


def estimate_reproducibility(
    time_s: ArrayLike, phase_s: ArrayLike, values: ArrayLike, *, cycle_s: float
) -> Reproducibility:
    """Compare samples of the same phase in different cycles.

    Parameters
    ----------
    time_s, phase_s : array_like, shape (N,)
        Time of each sample, s, and its phase, s.
    values : array_like, shape (N,)
    cycle_s : float
        Length of the cycle, s.

    Examples
    --------
    >>> found = estimate_reproducibility([0, 5, 10], [0, 5, 0.01], [1.0, 2.0, 1.2], cycle_s=10)
    >>> round(found.sd, 3), found.repeats, found.longest_s
    (0.141, 1, 10.0)
    """
    time, phase, value = (np.asarray(v, np.float64) for v in (time_s, phase_s, values))
    groups = group_by_phase(phase, cycle_s=cycle_s)
    squares, repeats, longest = 0.0, 0, 0.0
    for group in np.unique(groups):
        members = groups == group
        if members.sum() > 1:
            squares += float(((value[members] - value[members].mean()) ** 2).sum())
            repeats += int(members.sum()) - 1
            longest = max(longest, float(np.ptp(time[members])))
    sd = float(np.sqrt(squares / repeats)) if repeats else float("nan")
    return Reproducibility(sd, repeats, longest)


def group_by_phase(phase_s: ArrayLike, *, cycle_s: float) -> Int64Array:
    """Group samples by phase: return the group number of each sample, shape (N,).

    Groups are separated at gaps wider than `MAX_PHASE_FRACTION` of the usual interval.
    """
    phase = np.asarray(phase_s, np.float64) % cycle_s
    order = np.argsort(phase, kind="stable")
    gaps = np.diff(phase[order], append=phase[order[0]] + cycle_s)
    usual = cycle_s / max(1, int((gaps > 0.05 * gaps.max()).sum()))
    wide = gaps > MAX_PHASE_FRACTION * usual
    groups = np.empty(phase.size, np.int64)
    groups[order] = np.concatenate([[0], np.cumsum(wide)[:-1]])
    if not wide[-1]:  # the last group continues in the first, across the cycle's end
        groups[groups == groups.max()] = 0
    return groups


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """Result of the test for samples between the two levels of blood."""

    seen: bool
    """Whether at least one sample is between the levels."""
    where: Int64Array
    """Indices of those samples."""
    tested: int
    """Number of samples tested."""
    false_alarm: float
    """Maximum probability of a detected transition in a cycle without one."""
    high: float
    """Level towards the end of the expression."""
    low: float
    """Level towards the end of rest."""
    noise: float
    """Standard deviation of one sample."""
    power: float
    """Probability of detecting a single sample half way between the levels."""

    @property
    def decided(self) -> bool:
        """Whether the test had enough power; if not, a negative result is inconclusive."""
        return self.power >= 0.5


def find_transition(
    phase_s: ArrayLike,
    values: ArrayLike,
    *,
    cycle_s: float,
    stderr: ArrayLike | None = None,
    false_alarm: float = TRANSITION_FALSE_ALARM_RATE,
) -> Transition:
    """Test whether a sample is between the two levels of a cycle.

    Parameters
    ----------
    phase_s : array_like, shape (N,)
        Phase of each sample, s; the expression is prompted at 0 and rest after half of the cycle.
    values : array_like, shape (N,)
    cycle_s : float
        Length of the cycle, s.
    stderr : array_like, shape (N,), optional
        Standard errors; lower bounds of the samples' noise.
    false_alarm : float
        Maximum probability of a detected transition in a cycle of two levels only.

    Returns
    -------
    Transition

    Raises
    ------
    CurveError
        When fewer than 3 samples fall into the second half of either state.

    Notes
    -----
    The levels are the means of the second half of each state. The noise is that of successive
    differences there, so that a drift does not count as noise. Every other sample is tested against
    both levels by Student's t: it must be above the lower and below the upper one. The rate of each
    test keeps the family below ``false_alarm`` (Sidak). A sample at one level is an alarm only if
    it deviates from that level, so the rate is kept whichever level each sample has.
    """
    Checks(CurveError).within("false_alarm", false_alarm, "(0, 1)")
    phase = np.asarray(phase_s, np.float64) % cycle_s
    value = np.asarray(values, np.float64)
    middle = 0.5 * cycle_s
    settled = [
        _between(phase, value, 0.5 * middle, middle),
        _between(phase, value, 0.5 * (middle + cycle_s), cycle_s),
    ]
    few, enough = "fewer than 3 samples late in a state", all(part.size >= 3 for part in settled)
    Checks(CurveError).require(enough, "phases", few, "at least 3; record more cycles")
    steps = np.concatenate([np.diff(value[part]) for part in settled])
    noise2 = float((steps**2).mean() / 2)
    own2 = np.full(value.size, noise2)
    if stderr is not None:
        own2 = np.maximum(own2, np.square(np.asarray(stderr, np.float64)))
    # successive differences share a sample: they have two thirds of the degrees of freedom
    freedom = max(1.0, 2.0 * steps.size / 3.0)
    means = [float(value[part].mean()) for part in settled]
    counts = [part.size for part in settled]
    tested = np.setdiff1d(np.arange(phase.size), np.concatenate(settled))
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, tested.size))
    limit = float(stats.t.isf(each, freedom))
    usual2 = float(np.median(own2))
    upper, lower = (0, 1) if means[0] >= means[1] else (1, 0)

    def window(variance: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the range of values that deviate from both levels, for a sample's variance."""
        reach = [limit * np.sqrt(variance + usual2 / count) for count in counts]
        return means[lower] + reach[lower], means[upper] - reach[upper]

    bottom, top = window(own2[tested])
    hit = tested[(value[tested] < top) & (value[tested] > bottom)]
    half = 0.5 * (means[upper] + means[lower])
    noise = float(np.sqrt(usual2))
    least, most = (float(end[0]) for end in window(np.array([usual2])))
    inside = float(most > least)
    if noise > 0:
        inside = float(stats.norm.cdf(most, half, noise) - stats.norm.cdf(least, half, noise))
    return Transition(
        seen=bool(hit.size),
        where=hit,
        tested=int(tested.size),
        false_alarm=false_alarm,
        high=means[0],
        low=means[1],
        noise=noise,
        power=max(inside, 0.0),
    )


def _between(phase: Float64Array, value: Float64Array, begin: float, end: float) -> Int64Array:
    """Return the samples of a phase interval that have a value, in the order of phase."""
    order = np.argsort(phase, kind="stable")
    inside = (phase[order] >= begin) & (phase[order] < end) & np.isfinite(value[order])
    return np.asarray(order[inside], np.int64)


def _broadcast_like(part: ArrayLike, values: Float64Array, name: str) -> NDArray[np.generic]:
    array = np.asarray(part)
    Checks(CurveError).shape(name, array, values.shape)
    return array
