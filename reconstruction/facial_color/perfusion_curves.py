"""Curves of blood at a few places of a face: against time, and against the phase of a cycle.

A sequence of maps gives each place a value and a standard error a frame. Against the true phase at
which each frame was taken they show one cycle, sampled finer than the camera could (Jimenez et al.
2010, section 3.1 and figures 5 and 6). Whether there is anything between the two states is a
question of statistics, and is answered with a stated rate of false alarms, and with how deep a
transition would have been seen.

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
"""Places that are followed."""
TRANSITION_FALSE_ALARM_RATE = 0.05
"""Rate at which a cycle without transition is said to have one."""
MAX_PHASE_FRACTION = 0.25
"""Shots belong to one phase when they lie closer than this part of the sampling interval."""
_FACE_POSITIONS: Mapping[str, tuple[float, float]] = {
    "forehead": (0.50, 0.14),
    "cheek": (0.27, 0.57),
    "nose": (0.50, 0.57),
    "chin": (0.50, 0.90),
    "temple": (0.17, 0.30),
}
"""Where the places lie between left and right, top and bottom of a face that fills the picture's
height from hairline to chin: Jimenez et al. 2010, figure 7, by eye."""


class CurveError(ValueError):
    """A curve that cannot be made of what is given."""


@dataclass(frozen=True, slots=True, eq=False)
class DiscMeans:
    """What discs of maps hold."""

    mean: Float64Array
    """(P, N): mean of each place in each map; NaN where no pixel is valid."""
    stderr: Float64Array
    """(P, N): its standard error, of errors that differ from pixel to pixel."""
    pixels: Int64Array
    """(P, N): how many valid pixels it is of."""

    @property
    def valid(self) -> BoolArray:
        """(P, N): whether there is a mean."""
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
        Aligned maps, such as hemoglobin, one a frame.
    positions : mapping of str to (x, y)
        Centres, px: x to the right and y down from the centre of the first pixel.
    radius_px : float
        Of the discs, px, > 0; the pixel nearest to the centre always belongs to it.
    stderr : array_like, shape (N, H, W), optional
        Standard errors of the maps. None: the scatter within each disc, which overestimates them
        where the skin is not even.
    valid : array_like of bool, shape (N, H, W), optional

    Returns
    -------
    DiscMeans

    Raises
    ------
    CurveError
        For a shape that does not fit, or a disc beyond the maps.

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
    """Return rows and columns of the pixels of a disc about (x, y), px.

    Raises
    ------
    CurveError
        Where its centre lies beyond the map.
    """
    height, width = shape
    x, y = position
    inside = -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
    expected = f"within {width} x {height} px"
    Checks(CurveError).require(inside, name, f"({x:g}, {y:g}) px", expected)
    rows, columns = np.indices((height, width))
    squared = (columns - x) ** 2 + (rows - y) ** 2
    found_rows, found_columns = np.nonzero(squared <= max(radius_px**2, float(squared.min())))
    return found_rows, found_columns


def standard_positions(skin: ArrayLike) -> dict[str, tuple[float, float]]:
    """Return where the places are on a face of which only the outline is known, px.

    Parameters
    ----------
    skin : array_like of bool, shape (H, W)
        Pixels that show skin: a face from the front that fills the picture's height.

    Returns
    -------
    dict
        (x, y) of :data:`FACE_SITES`; by the middle 96 % of the skin in each direction.

    Raises
    ------
    CurveError
        When there is no skin, or no picture.
    """
    shown = np.asarray(skin, bool)
    Checks(CurveError).require(shown.ndim == 2, "skin", f"shape {shown.shape}", "(H, W)")
    rows, columns = np.nonzero(shown)
    Checks(CurveError).require(rows.size != 0, "skin", "none", "a face")
    left, right = np.percentile(columns, (2, 98))
    top, bottom = np.percentile(rows, (2, 98))
    return {
        name: (float(left + u * (right - left)), float(top + v * (bottom - top)))
        for name, (u, v) in _FACE_POSITIONS.items()
    }


@dataclass(frozen=True, slots=True)
class Reproducibility:
    """How well a phase is repeated when it is met again."""

    sd: float
    """Standard deviation of one shot among those of its phase; NaN without repeats."""
    repeats: int
    """How many shots more than phases: degrees of freedom."""
    longest_s: float
    """Longest time between two shots of one phase, s; 0 without repeats."""


def estimate_reproducibility(
    time_s: ArrayLike, phase_s: ArrayLike, values: ArrayLike, *, cycle_s: float
) -> Reproducibility:
    """Compare shots of the same phase in different cycles.

    Parameters
    ----------
    time_s, phase_s : array_like, shape (N,)
        When each shot was taken, s, and the phase it met, s.
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
    """Return a number for each shot that those of one phase share, shape (N,).

    Phases are parted at gaps that are wider than a quarter of the usual interval.
    """
    phase = np.asarray(phase_s, np.float64) % cycle_s
    order = np.argsort(phase, kind="stable")
    gaps = np.diff(phase[order], append=phase[order[0]] + cycle_s)
    usual = cycle_s / max(1, int((gaps > 0.05 * gaps.max()).sum()))
    wide = gaps > MAX_PHASE_FRACTION * usual
    groups = np.empty(phase.size, np.int64)
    groups[order] = np.concatenate([[0], np.cumsum(wide)[:-1]])
    if not wide[-1]:  # the last and the first are one phase, across the cycle's end
        groups[groups == groups.max()] = 0
    return groups


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """Whether any shot shows the blood between its two levels."""

    seen: bool
    """Whether at least one does."""
    where: Int64Array
    """Indices of those shots."""
    tested: int
    """How many shots could."""
    false_alarm: float
    """Most probability that a cycle without transition is said to have one."""
    high: float
    """Level towards the end of the expression."""
    low: float
    """Level towards the end of rest."""
    noise: float
    """Standard deviation of one shot."""
    power: float
    """Probability that a single shot half way between the levels would have been noticed."""

    @property
    def decided(self) -> bool:
        """Whether the data could have shown a transition: where not, none seen means nothing."""
        return self.power >= 0.5


def find_transition(
    phase_s: ArrayLike,
    values: ArrayLike,
    *,
    cycle_s: float,
    stderr: ArrayLike | None = None,
    false_alarm: float = TRANSITION_FALSE_ALARM_RATE,
) -> Transition:
    """Test whether there is a shot between the two levels of a cycle.

    Parameters
    ----------
    phase_s : array_like, shape (N,)
        Phase of each shot, s; the expression is asked for at 0 and rest after half of the cycle.
    values : array_like, shape (N,)
    cycle_s : float
        Length of the cycle, s.
    stderr : array_like, shape (N,), optional
        Standard errors; no shot's noise is taken for less than its own.
    false_alarm : float
        Probability with which a cycle of two levels only is said to have a transition, at most.

    Returns
    -------
    Transition

    Raises
    ------
    CurveError
        When fewer than 3 shots fall into the second half of either state.

    Notes
    -----
    The levels are the means of the second half of each state; the noise is that of successive
    differences there, so that a drift does not count as noise. Every other shot is tested for
    lying above the lower and below the upper level, by Student's t, both at a rate that keeps all
    of them together below ``false_alarm`` (Sidak). A shot at one of the levels is an alarm only if
    it seems off it, so the rate is kept whichever level each shot has.
    """
    Checks(CurveError).within("false_alarm", false_alarm, "(0, 1)")
    phase = np.asarray(phase_s, np.float64) % cycle_s
    value = np.asarray(values, np.float64)
    middle = 0.5 * cycle_s
    settled = [
        _between(phase, value, 0.5 * middle, middle),
        _between(phase, value, 0.5 * (middle + cycle_s), cycle_s),
    ]
    few, enough = "fewer than 3 shots late in a state", all(part.size >= 3 for part in settled)
    Checks(CurveError).require(enough, "phases", few, "more to know its level")
    steps = np.concatenate([np.diff(value[part]) for part in settled])
    noise2 = float((steps**2).mean() / 2)
    own2 = np.full(value.size, noise2)
    if stderr is not None:
        own2 = np.maximum(own2, np.square(np.asarray(stderr, np.float64)))
    # neighbouring differences share a shot: two thirds as much is known as by independent ones
    freedom = max(1.0, 2.0 * steps.size / 3.0)
    means = [float(value[part].mean()) for part in settled]
    counts = [part.size for part in settled]
    tested = np.setdiff1d(np.arange(phase.size), np.concatenate(settled))
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, tested.size))
    limit = float(stats.t.isf(each, freedom))
    usual2 = float(np.median(own2))
    upper, lower = (0, 1) if means[0] >= means[1] else (1, 0)

    def window(variance: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return between which values a sample of so much noise is off both levels."""
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
    """Return the shots of a stretch of phases that have a value, in the order of phase."""
    order = np.argsort(phase, kind="stable")
    inside = (phase[order] >= begin) & (phase[order] < end) & np.isfinite(value[order])
    return np.asarray(order[inside], np.int64)


def _broadcast_like(part: ArrayLike, values: Float64Array, name: str) -> NDArray[np.generic]:
    array = np.asarray(part)
    Checks(CurveError).shape(name, array, values.shape)
    return array
