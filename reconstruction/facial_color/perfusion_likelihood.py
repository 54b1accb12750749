"""Profile likelihood of the delay and time constant of relaxing blood, with intervals.

Levels enter a curve linearly and are solved for at each delay and time constant. The remaining
function of two parameters is evaluated on a full grid. A time constant far below the sampling
interval is therefore reported as a bound, because the likelihood is flat there. The noise is that
of the best curve's residuals. An interval contains all values at which the square sum, minimized
over all other parameters, exceeds its minimum by at most Fisher's F quantile.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from model.solver_outcome import outcome_from_scipy
from reconstruction.arrays import Float64Array
from reconstruction.facial_color.perfusion_samples import CurveSamples

_log = logging.getLogger(__name__)

Interval = tuple[float, float]
Shape = Callable[[Float64Array, Float64Array], Float64Array]
"""Function from delays and constants of shape (..., 1) to the fraction of the way, (..., N)."""

_SLOPE_NODES = np.array([0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.5])
"""Time since the start of a change at which a sample is placed, in time constants."""
_MIN_DELAY_STEPS = 3.0
"""Time constants below this many delay steps get delays of their own."""
_SIMPLEX_FATOL = 1e-9
"""Spread of the square sums of a simplex at which the search ends."""


@dataclass(frozen=True, slots=True)
class RelaxationGrid:
    """Grid of delays and time constants for a curve."""

    curve: Shape
    """Fraction of the way between the levels."""
    delays: Float64Array
    """(D,): delays for each constant, s, ascending; one where none is fitted."""
    constants: Float64Array
    """(C,): time constants, s, ascending, with equal steps of the logarithm."""
    at: Float64Array
    """(M,): times of the samples after a prompt, s; () without prompts."""


@dataclass(frozen=True, slots=True, eq=False)
class ProfileLikelihood:
    """Square sums of curves over their noise, at delays and time constants."""

    data: CurveSamples
    search: RelaxationGrid
    total: Float64Array
    """(C, D or more): square sums at the best levels; beyond D for delays of each constant's
    own."""
    noise2: Float64Array
    """(P,): variance of one sample of each curve."""
    dof: float
    """Degrees of freedom of all curves together."""
    delay_s: float
    """Most likely delay, s."""
    time_constant_s: float
    """Most likely time constant, s."""
    min_chi2: float
    """Minimum square sum."""
    chi2: float
    """Reduced chi-square by the given standard errors; NaN without."""

    @staticmethod
    def evaluate(data: CurveSamples, search: RelaxationGrid) -> ProfileLikelihood:
        """Evaluate all delays and constants, and refine the best.

        Parameters
        ----------
        data
            Samples of P curves.
        search
            Grid to evaluate.
        """
        delays, constants = search.delays, search.constants

        def residuals(delay: Float64Array, constant: Float64Array) -> Float64Array:
            """(..., P) square sums for delays and constants that broadcast to (...)."""
            return data.residual(search.curve(delay[..., None], constant[..., None]))

        # per constant: the common delays and, where their spacing is too coarse, delays that place
        # a sample on the slope
        least = _MIN_DELAY_STEPS * (delays[1] - delays[0]) if delays.size > 1 else 0.0
        quick = constants < least
        near = np.array([_near(search.at, constant, delays) for constant in constants[quick]])
        tried = delays.size + (near.shape[1] if quick.any() else 0)
        by_curve = np.full((constants.size, tried, len(data.values)), np.inf)
        # one constant at a time limits the memory to megabytes
        for row, constant in enumerate(constants):
            by_curve[row, : delays.size] = residuals(delays, np.full(delays.size, constant))
        for place, some in zip(np.flatnonzero(quick), near, strict=True):
            by_curve[place, delays.size :] = residuals(some, np.full(some.size, constants[place]))
        curves = len(data.values)
        samples = (data.weights > 0).sum(axis=1)
        # each curve has its own noise, from the residuals of the best common curve
        freedom = np.maximum(samples - 2.0 - (1.0 + (delays.size > 1)) / curves, 1.0)
        noise2 = np.full(curves, 1.0)
        tiny = np.finfo(float).eps * np.maximum((data.weights * data.values**2).sum(axis=1), 1e-300)
        for _ in range(2):
            total = (by_curve / noise2).sum(axis=-1)
            best = np.unravel_index(int(np.argmin(total)), total.shape)
            noise2 = np.maximum(by_curve[best] / freedom, tiny)
        total = (by_curve / noise2).sum(axis=-1)

        def landscape(delay: float, log_constant: float) -> float:
            sums = residuals(np.array([delay]), np.exp(np.array([log_constant])))
            return float((sums[0] / noise2).sum())

        begin = np.append(delays, near[int(quick[: best[0]].sum())] if quick[best[0]] else [])
        begin = begin[best[1]]
        start = np.array([begin, np.log(constants[best[0]])])
        found = _refined(landscape, start, delays, np.log(constants), float(total[best]))
        delay, constant, least = float(found[0]), float(np.exp(found[1])), found[2]
        nu = float(freedom.sum())
        known = np.isfinite(data.variance).all()
        return ProfileLikelihood(
            data,
            search,
            total=total,
            noise2=noise2,
            dof=nu,
            delay_s=delay,
            time_constant_s=constant,
            min_chi2=min(least, float(total.min())),
            chi2=float((by_curve[best] / data.variance).sum() / nu) if known else float("nan"),
        )

    def constant_interval(self, level: float) -> Interval:
        """Return the time constant's confidence interval, s; 0, inf: unbounded.

        Parameters
        ----------
        level
            Confidence, in (0, 1).
        """
        logs, best = np.log(self.search.constants), float(np.log(self.time_constant_s))
        profile = self.total.min(axis=1) - self.min_chi2
        low, high = _crossings(logs, profile, best, self._excess(level))
        return float(np.exp(low)), float(np.exp(high))

    def delay_interval(self, level: float) -> tuple[float, float]:
        """Return the delay's confidence interval, s, within the grid.

        Parameters
        ----------
        level
            Confidence, in (0, 1).
        """
        delays = self.search.delays
        low, high = _crossings(delays, self._along(), self.delay_s, self._excess(level))
        return max(low, float(delays[0])), min(high, float(delays[-1]))

    def delay_weights(self) -> Float64Array:
        """Return the posterior of each delay, (D,), with a uniform prior and its best constant."""
        weights = np.exp(-0.5 * self._along())
        return np.asarray(weights / weights.sum())

    def constant_at_delays(self) -> Float64Array:
        """Return the best time constant for each delay, (D,), s."""
        best = np.argmin(self.total[:, : self.search.delays.size], axis=0)
        return np.asarray(self.search.constants[best])

    def level_errors(
        self, gap: Float64Array, *, with_constant: bool, with_delay: bool
    ) -> tuple[Float64Array, ...]:
        """Return standard errors of start, end, their difference, and the step of a pose.

        From the Fisher information of the samples; estimated delays and constants add to it.

        Parameters
        ----------
        gap : ndarray, shape (P,)
            Change of level.
            Change of level, ``end`` minus ``start``.
            Whether they are estimated from the samples.

        Returns
        -------
        tuple of ndarray, each of shape (P,)
        """
        delay, constant = self.delay_s, self.time_constant_s

        def at(d: float, c: float) -> Float64Array:
            shape = self.search.curve(np.array([[d]]), np.array([[c]]))
            return np.asarray(shape[0], np.float64)

        base = at(delay, constant)
        slopes = []
        if with_constant:
            h = 1e-3 * constant
            slopes.append((at(delay, constant + h) - at(delay, constant - h)) / (2 * h))
            if with_delay and delay > 1e-3 * constant:
                slopes.append((at(delay + h, constant) - at(delay - h, constant)) / (2 * h))
        curves = len(gap)
        size = 3 * curves + len(slopes)
        normal = np.zeros((size, size))
        for p in range(curves):
            rows = np.zeros((size, base.size))
            rows[2 * p], rows[2 * p + 1] = 1.0 - base, base  # start and end
            rows[2 * curves + p] = self.data.moved
            for k, slope in enumerate(slopes):
                rows[3 * curves + k] = gap[p] * slope
            normal += (rows * self.data.weights[p] / self.noise2[p]) @ rows.T
            step = 2 * curves + p
            if self.data.stderr_of_pose[p] > 0 and normal[step, step] > 0:
                normal[step, step] += 1.0 / self.data.stderr_of_pose[p] ** 2
            else:  # without a step, its row is removed from the normal equations
                normal[step, :] = normal[:, step] = 0.0
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        covariance = np.linalg.pinv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
        errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        start, end = np.arange(0, 2 * curves, 2), np.arange(1, 2 * curves, 2)
        change2 = errors[start] ** 2 + errors[end] ** 2 - 2.0 * covariance[start, end]
        return (
            errors[start],
            errors[end],
            np.asarray(np.sqrt(np.maximum(change2, 0.0))),
            errors[2 * curves : 3 * curves],
        )

    def _along(self) -> Float64Array:
        """Return the excess of the square sum over its minimum, by delay, (D,)."""
        least = self.total[:, : self.search.delays.size].min(axis=0)
        return np.asarray(least - self.min_chi2)

    def _excess(self, level: float) -> float:
        return float(stats.f.ppf(level, 1, self.dof))


def _near(since: Float64Array, constant: float, delays: Float64Array) -> Float64Array:
    """Return delays that place a sample on the slope of the change, s.

    Their number is the same for each constant; those beyond the range are clipped to it.
    """
    late = since[np.isfinite(since) & (since <= 2 * delays[-1])]
    return np.clip((late[:, None] - constant * _SLOPE_NODES).ravel(), delays[0], delays[-1])


def _refined(
    landscape: Callable[[float, float], float],
    start: Float64Array,
    delays: Float64Array,
    logs: Float64Array,
    at_start: float,
) -> tuple[float, float, float]:
    """Return delay, logarithm of the constant, and square sum at the minimum near the start."""

    def around(grid: Float64Array, at: float) -> tuple[float, float]:
        step = float(grid[1] - grid[0])
        return max(grid[0], at - step), min(grid[-1], at + step)

    if delays.size == 1:
        found = optimize.minimize_scalar(
            lambda log: landscape(float(delays[0]), log),
            bounds=around(logs, start[1]),
            method="bounded",
        )
        outcome = outcome_from_scipy(found, math.nan)  # SciPy keeps the bracket's width
        point, height = (float(delays[0]), float(found.x)), float(found.fun)
    else:
        bounds = [around(delays, start[0]), around(logs, start[1])]
        simplex = optimize.minimize(
            lambda v: landscape(v[0], v[1]),
            start,
            method="Nelder-Mead",
            bounds=bounds,
            options={"xatol": 1e-5, "fatol": _SIMPLEX_FATOL},
        )
        spread = float(np.ptp(simplex.final_simplex[1])) / _SIMPLEX_FATOL
        outcome = outcome_from_scipy(simplex, spread)
        point, height = (float(simplex.x[0]), float(simplex.x[1])), float(simplex.fun)
    outcome.warn_unless_converged("course of blood", _log)
    if height < at_start:
        return (*point, height)
    return float(start[0]), float(start[1]), at_start


def _crossings(grid: Float64Array, profile: Float64Array, best: float, excess: float) -> Interval:
    """Return where a profile first rises by ``excess`` on both sides of its minimum, or inf."""
    ends: list[float] = []
    for sign in (-1, 1):
        side = grid[sign * (grid - best) > 0][::sign]
        height = profile[sign * (grid - best) > 0][::sign]
        above = np.flatnonzero(height > excess)
        if above.size == 0:
            ends.append(sign * np.inf)
            continue
        k = int(above[0])
        inner, level = (best, 0.0) if k == 0 else (float(side[k - 1]), float(height[k - 1]))
        # the square root of a parabola is linear, so interpolate square roots
        a, b, c = (np.sqrt(max(v, 0.0)) for v in (level, float(height[k]), excess))
        ends.append(inner + (float(side[k]) - inner) * float((c - a) / max(b - a, 1e-12)))
    return ends[0], ends[1]
