"""Fit levels, delay and time constant of relaxing blood, with standard errors and intervals.

This module defines the curves of a prompted cycle and of an event, and the result of a fit.
`reconstruction.facial_color.perfusion_likelihood` computes the likelihood of delays and time
constants and its intervals.

Where the face moves, the blood of one pose is offset from that of the other by an unknown step, the
same in all samples of a pose. The step is as prompt as the movement and would look like fast blood.
It is therefore an additional level of each curve, with its standard error as prior.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from model.checks import Checks
from reconstruction.arrays import Float64Array
from reconstruction.facial_color.perfusion_curves import CurveError
from reconstruction.facial_color.perfusion_likelihood import ProfileLikelihood, RelaxationGrid
from reconstruction.facial_color.perfusion_samples import CurveSamples, PoseStep

TimeConstantStatus = Literal["estimated", "only below", "only above", "unknown"]

BOUND_LEVEL = 0.95
"""Confidence of bounds."""
ONE_SIGMA_LEVEL = 0.6827
"""Confidence of the interval whose half-width is the standard error."""
COVERAGE_FACTOR_95 = 1.959964
"""Coverage factor k of a 95 % interval."""
LEVEL_TEST_P_VALUE = 0.001
"""Maximum probability, by chance, of a difference at which two levels count as different."""
_GRID_NODES = 97
_DELAY_NODES = 81
_POSE_DELAY_NODES = 41


@dataclass(frozen=True, slots=True, eq=False)
class RelaxationFit:
    """Shared parameters of relaxing curves, and the levels of each."""

    start: Float64Array
    """(P,): initial level: rest, or that at the event's end."""
    end: Float64Array
    """(P,): final level."""
    stderr_start: Float64Array
    """(P,)"""
    stderr_end: Float64Array
    """(P,)"""
    time_constant_s: float
    """Best time constant, s."""
    stderr_time_constant_s: float
    """Half of its 68 % interval, s; NaN where it is only bounded."""
    interval_s: tuple[float, float]
    """95 % interval of the time constant, s; 0 or inf at an unbounded end."""
    interval_68_s: tuple[float, float]
    """68 % interval of the time constant, s, within the 95 % one. Its ends follow the likelihood on
    each side, so the interval can be asymmetric."""
    known: TimeConstantStatus
    """Whether the time constant is estimated, or "only below" the interval's upper end, or "only
    above" its lower one, or "unknown" because the levels do not differ."""
    delay_s: float
    """Time from prompt to change, s; 0 where none is fitted. With steps of a pose, the posterior
    mean."""
    stderr_delay_s: float
    """Half of its 68 % interval, s; with steps of a pose, the standard deviation."""
    delay_interval_s: tuple[float, float]
    """95 % interval of the delay, s; for a fast change, the gap between two samples."""
    stderr_change: Float64Array
    """(P,): standard error of ``end`` minus ``start``, which are correlated."""
    step: Float64Array
    """(P,): common offset of the samples of a moved face from the curve; 0 without one."""
    stderr_step: Float64Array
    """(P,)"""
    noise: Float64Array
    """(P,): standard deviation of one sample about the curve."""
    chi2: float
    """Reduced chi-square by the given standard errors; NaN without."""

    def __str__(self) -> str:
        low, high = self.interval_s
        if self.known == "estimated":
            return f"{self.time_constant_s:.3g} +- {self.stderr_time_constant_s:.2g} s"
        if self.known == "only below":
            return f"below {high:.3g} s"
        if self.known == "only above":
            return f"above {low:.3g} s"
        if np.any(self.stderr_step > 0):
            return "unknown: the levels do not differ by more than the pose step allows"
        return "unknown: the levels do not differ"


def fit_cycle(
    phase_s: ArrayLike,
    values: ArrayLike,
    *,
    cycle_s: float,
    change_s: float | None = None,
    stderr: ArrayLike | None = None,
    pose: PoseStep | None = None,
    bend: float = 0.0,
) -> RelaxationFit:
    """Fit blood that relaxes to one level after a prompt and back after the next, periodically.

    Parameters
    ----------
    phase_s : array_like, shape (N,)
        Phase of each sample, s.
    values : array_like, shape (N,) or (P, N)
        One curve, or several that share delay and time constant; NaN is omitted.
    cycle_s : float
        Length of the cycle, s; the expression is prompted at 0.
    change_s : float, optional
        Time of the prompt of rest, s; None: after half of the cycle.
    stderr : array_like, optional
        Standard errors of the values, their shape: relative weights, and the basis of ``chi2``.
    pose : PoseStep, optional
        Samples of a moved face, and the standard error of their offset from those at rest. Blood
        is then assumed to start with the movement: with a free step, a late start and a slow course
        are indistinguishable. None: all samples are of one pose.
    bend : float
        See `fit_course`.

    Returns
    -------
    RelaxationFit
        ``start`` is the level of rest, ``end`` that of the expression.

    Raises
    ------
    CurveError
        For fewer than 6 samples, a mismatched shape, or a cycle without both changes.

    Examples
    --------
    >>> phase = np.arange(20) * 0.5
    >>> true = np.where(phase < 5, 1 - np.exp(-phase / 2), np.exp(-(phase - 5) / 2))
    >>> found = fit_cycle(phase, 0.03 + 0.01 * true, cycle_s=10)
    >>> found.known
    'estimated'
    """
    middle = 0.5 * cycle_s if change_s is None else change_s
    phase = np.asarray(phase_s, np.float64)
    check = Checks(CurveError)
    check.within("bend", bend, "[0, 1)")
    check.within("cycle_s", cycle_s, "(0, inf)")
    check.within("change_s", middle, f"(0, {cycle_s})")
    data = CurveSamples.of(phase, values, stderr, pose)
    phase = np.where(np.isfinite(phase), phase, 0.0)  # weight 0, but a finite number

    def straight(delay: Float64Array, constant: Float64Array) -> Float64Array:
        """Fraction of the way to the expression's level, in the steady cycle."""
        on, off = middle, cycle_s - middle
        into = (phase - delay) % cycle_s
        up, down = np.exp(-on / constant), np.exp(-off / constant)
        # level at the start of the expression, after infinitely many cycles
        begin = (1.0 - up) * down / (1.0 - up * down)
        top = 1.0 - (1.0 - begin) * up
        rising = 1.0 - (1.0 - begin) * np.exp(-np.minimum(into, on) / constant)
        falling = top * np.exp(-np.maximum(into - on, 0.0) / constant)
        return np.where(into < on, rising, falling)

    spacing = cycle_s / phase.size
    constants = np.geomspace(spacing / 50, 4 * cycle_s, _GRID_NODES)
    longest = 0.5 * min(middle, cycle_s - middle)
    delays = np.linspace(0.0, longest, _DELAY_NODES)
    if data.has_steps:
        between = data.pose_change_interval(phase % cycle_s, middle, longest)
        delays = np.linspace(*between, _POSE_DELAY_NODES)
    changes = np.concatenate([phase % cycle_s, (phase - middle) % cycle_s])
    return _fit_bent(data, RelaxationGrid(straight, delays, constants, changes), bend)


def fit_course(time_s: ArrayLike, values: ArrayLike, *, bend: float = 0.0) -> RelaxationFit:
    """Fit blood that relaxes to a new level after an event at time 0.

    Parameters
    ----------
    time_s : array_like, shape (N,)
        Time after the event, s; samples before it are not used.
    values : array_like, shape (N,) or (P, N)
        One curve, or several that share the time constant; NaN is omitted.
    bend : float
        Standard error of the values' curvature over the change, in [0, 1): a fraction s appears as
        s +- bend s (1 - s). The best time constant is that without bend; its shifts by both signs
        of the bend are added to its errors in quadrature.

    Returns
    -------
    RelaxationFit
        ``start`` is the level right after the event, ``end`` the asymptotic one.

    Raises
    ------
    CurveError
        For fewer than 5 samples after the event, a mismatched shape, or a bend out of range.
    """
    Checks(CurveError).within("bend", bend, "[0, 1)")
    time = np.asarray(time_s, np.float64)
    after = (time >= 0) & np.isfinite(time)
    time = time[after]
    data = CurveSamples.of(time, np.atleast_2d(np.asarray(values, np.float64))[:, after], None)

    def course(delay: Float64Array, constant: Float64Array) -> Float64Array:
        """Fraction of the way to the new level."""
        return np.asarray(-np.expm1(-time / constant))

    span = float(np.ptp(time))
    spacing = span / max(1, time.size - 1)
    constants = np.geomspace(spacing / 50, 50 * span, _GRID_NODES)
    return _fit_bent(data, RelaxationGrid(course, np.zeros(1), constants, np.zeros(0)), bend)


def _fit_bent(data: CurveSamples, search: RelaxationGrid, bend: float) -> RelaxationFit:
    """Fit curves without bend, and add the bend's contribution to the time constant's errors."""

    def fit(amount: float) -> RelaxationFit:
        def shape(delay: Float64Array, constant: Float64Array) -> Float64Array:
            """Return the shape s + amount s (1 - s)."""
            part = search.curve(delay, constant)
            return np.asarray(part + amount * part * (1.0 - part)) if amount else part

        return _fit(data, replace(search, curve=shape))

    straight, *bent = (fit(amount) for amount in ((0.0, -bend, bend) if bend else (0.0,)))
    if not bent or straight.known == "unknown":
        return straight
    moved_to = [one.time_constant_s for one in bent]
    middle = straight.time_constant_s
    moved = (min(moved_to), max(moved_to))

    def widened(interval: tuple[float, float], sigmas: float) -> tuple[float, float]:
        """Widen an interval of ``sigmas`` by the bend, in quadrature of log time constants."""
        low, high = (
            middle * np.exp(sign * np.hypot(np.log(end / middle), sigmas * np.log(by / middle)))
            if 0.0 < end < np.inf
            else end
            for sign, end, by in zip((-1.0, 1.0), interval, moved, strict=True)
        )
        return float(low), float(high)

    half = 0.5 * (moved[1] - moved[0])
    return replace(
        straight,
        interval_s=widened(straight.interval_s, COVERAGE_FACTOR_95),
        interval_68_s=widened(straight.interval_68_s, 1.0),
        stderr_time_constant_s=float(np.hypot(straight.stderr_time_constant_s, half)),
    )


def square_levels(fit: RelaxationFit) -> RelaxationFit:
    """Convert a fit to the square root of blood into levels of blood.

    Blood fills its vessels' cross-section. If their radius relaxes exponentially, so does the
    square root of blood, but not blood itself. The variance of b = r^2 is 4 r^2 times that of r.

    Parameters
    ----------
    fit
        Fit to square roots of blood.

    Returns
    -------
    RelaxationFit
        With levels, their standard errors and the noise of blood.

    Examples
    --------
    >>> time = np.linspace(0.0, 60.0, 12)
    >>> found = square_levels(fit_course(time, 0.15 + 0.03 * np.exp(-time / 20.0)))
    >>> round(float(found.start[0]), 4), round(float(found.end[0]), 4), round(found.time_constant_s)
    (0.0324, 0.0225, 20)
    """
    start, end = np.maximum(fit.start, 0.0), np.maximum(fit.end, 0.0)
    return replace(
        fit,
        start=start**2,
        end=end**2,
        stderr_start=2.0 * start * fit.stderr_start,
        stderr_end=2.0 * end * fit.stderr_end,
        stderr_change=(start + end) * fit.stderr_change,
        step=(start + end) * fit.step,
        stderr_step=(start + end) * fit.stderr_step,
        noise=(start + end) * fit.noise,
    )


def _fit(given: CurveSamples, search: RelaxationGrid) -> RelaxationFit:
    data = given.with_free_step()
    for _ in range(1 + data.has_steps):
        fit = _fit_once(data, search)
        # the prior's weight on a step depends on the noise, which a fit with a free step estimates
        data = given.with_prior(np.square(fit.noise))
    return fit


def _fit_once(data: CurveSamples, search: RelaxationGrid) -> RelaxationFit:
    landscape = ProfileLikelihood.evaluate(data, search)
    curve, delays = search.curve, search.delays
    delay, constant, noise2 = landscape.delay_s, landscape.time_constant_s, landscape.noise2
    interval, inner = map(landscape.constant_interval, (BOUND_LEVEL, ONE_SIGMA_LEVEL))
    delay_interval, stderr_delay = (0.0, 0.0), 0.0
    if delays.size > 1:
        delay_interval = landscape.delay_interval(BOUND_LEVEL)
        first, last = landscape.delay_interval(ONE_SIGMA_LEVEL)
        stderr_delay = 0.5 * (last - first)

    curves = len(data.values)
    found_shape = curve(np.array([[delay]]), np.array([[constant]]))
    level, gap = (part[0] for part in data.levels(found_shape))
    flat = (data.residual(np.zeros_like(found_shape))[0] / noise2).sum()
    differ = (flat - landscape.min_chi2) / curves / max(landscape.min_chi2 / landscape.dof, 1e-300)
    changes = stats.f.sf(differ, curves, landscape.dof) < LEVEL_TEST_P_VALUE
    known: TimeConstantStatus = "estimated"
    if not changes:
        known, interval, inner = "unknown", (0.0, float("inf")), (0.0, float("inf"))
    elif interval[0] == 0.0:
        known = "only below"
    elif np.isinf(interval[1]):
        known = "only above"
    step = data.step(found_shape)[0]
    errors = landscape.level_errors(
        gap, with_constant=known == "estimated", with_delay=delays.size > 1 and not data.has_steps
    )
    if data.has_steps:
        # with a step, delay and levels are correlated and the delay's likelihood is flat over its
        # range: average over all delays by their probability
        weights = landscape.delay_weights()
        shapes = curve(delays[:, None], landscape.constant_at_delays()[:, None])
        levels, gaps = data.levels(shapes)
        away = (levels - level, levels + gaps - level - gap, gaps - gap, data.step(shapes) - step)
        errors = tuple(
            np.sqrt(error**2 + weights @ off**2) for error, off in zip(errors, away, strict=True)
        )
        delay = float(weights @ delays)
        stderr_delay = float(np.sqrt(weights @ (delays - delay) ** 2))
    return RelaxationFit(
        start=level,
        end=level + gap,
        stderr_start=errors[0],
        stderr_end=errors[1],
        stderr_change=errors[2],
        step=step,
        stderr_step=errors[3],
        time_constant_s=constant,
        stderr_time_constant_s=0.5 * (inner[1] - inner[0]) if known == "estimated" else np.nan,
        interval_s=interval,
        interval_68_s=inner,
        known=known,
        delay_s=delay,
        stderr_delay_s=stderr_delay,
        delay_interval_s=delay_interval,
        noise=np.sqrt(noise2),
        chi2=landscape.chi2,
    )
