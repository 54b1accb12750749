"""How likely each delay and time constant of relaxing blood is: profiles, intervals, errors.

Levels enter a curve linearly: for each delay and time constant they are solved for, and what
remains is a landscape of two numbers, looked at as a whole. So a time constant far below the
sampling interval is no failure of a search: the landscape is flat there, and what is told is the
bound. The noise is that of what the best curve leaves. Intervals are of the profile likelihood: all
values at which the square sum, least over everything else, exceeds the least one by no more than
Fisher's F allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from reconstruction.arrays import Float64Array
from reconstruction.facial_color.perfusion_samples import CurveSamples

Interval = tuple[float, float]
Shape = Callable[[Float64Array, Float64Array], Float64Array]
"""Delays and constants of shape (..., 1) to the part of the way, (..., N)."""

_SLOPE_NODES = np.array([0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.5])
"""Time constants since the beginning of a change at which samples are tried."""
_MIN_DELAY_STEPS = 3.0
"""Constants below so many steps of the delay need delays between them."""


@dataclass(frozen=True, slots=True)
class RelaxationGrid:
    """What is tried for a curve."""

    curve: Shape
    """Part of the way that blood has gone."""
    delays: Float64Array
    """(D,): delays that are tried with each constant, s, ascending; one where none is fitted."""
    constants: Float64Array
    """(C,): time constants that are tried, s, ascending; their logarithms in equal steps."""
    at: Float64Array
    """(M,): how long after a prompt samples are, s; () where there are no prompts."""


@dataclass(frozen=True, slots=True, eq=False)
class ProfileLikelihood:
    """Square sums of curves over their noise, at delays and time constants."""

    data: CurveSamples
    search: RelaxationGrid
    total: Float64Array
    """(C, D or more): square sums of the best levels; beyond D are delays of each constant's
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
    """Least square sum."""
    chi2: float
    """Weighted square sum over the degrees of freedom by the given standard errors; NaN without."""

    @staticmethod
    def evaluate(data: CurveSamples, search: RelaxationGrid) -> ProfileLikelihood:
        """Look at all delays and constants, and refine the best.

        Parameters
        ----------
        data
            Samples of P curves.
        search
            What is tried.
        """
        delays, constants = search.delays, search.constants

        def residuals(delay: Float64Array, constant: Float64Array) -> Float64Array:
            """(..., P) square sums for delays and constants that broadcast to (...)."""
            return data.residual(search.curve(delay[..., None], constant[..., None]))

        # by constant: the common delays, and where those are too coarse some that put a sample on a
        # slope
        least = _MIN_DELAY_STEPS * (delays[1] - delays[0]) if delays.size > 1 else 0.0
        quick = constants < least
        near = np.array([_near(search.at, constant, delays) for constant in constants[quick]])
        tried = delays.size + (near.shape[1] if quick.any() else 0)
        by_curve = np.full((constants.size, tried, len(data.values)), np.inf)
        # one constant after the other: all at once would take hundreds of megabytes
        for row, constant in enumerate(constants):
            by_curve[row, : delays.size] = residuals(delays, np.full(delays.size, constant))
        for place, some in zip(np.flatnonzero(quick), near, strict=True):
            by_curve[place, delays.size :] = residuals(some, np.full(some.size, constants[place]))
        curves = len(data.values)
        samples = (data.weights > 0).sum(axis=1)
        # each curve by its own noise, which the best common curve leaves
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
        """Return the ends of the time constant's interval of a confidence, s; 0, inf: none.

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
        """Return the ends of the delay's interval of a confidence, s, within what is tried.

        Parameters
        ----------
        level
            Confidence, in (0, 1).
        """
        delays = self.search.delays
        low, high = _crossings(delays, self._along(), self.delay_s, self._excess(level))
        return max(low, float(delays[0])), min(high, float(delays[-1]))

    def delay_weights(self) -> Float64Array:
        """Return the probability of each delay, (D,), all alike before; with its best constant."""
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

        By the information that the samples hold, and with what delay and constant add where they
        are known.

        Parameters
        ----------
        gap : ndarray, shape (P,)
            Change of level.
        with_constant, with_delay
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
            else:  # no step: not a number of this fit
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
        """Return the excess of the square sum over its least, by delay, (D,)."""
        least = self.total[:, : self.search.delays.size].min(axis=0)
        return np.asarray(least - self.min_chi2)

    def _excess(self, level: float) -> float:
        return float(stats.f.ppf(level, 1, self.dof))


def _near(since: Float64Array, constant: float, delays: Float64Array) -> Float64Array:
    """Return delays that leave a sample, so long after a prompt, on the slope of the change, s.

    Their number is the same for each constant; those beyond the range are put into it.
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
    """Return delay, logarithm of the constant, and height of the lowest point near the start."""

    def around(grid: Float64Array, at: float) -> tuple[float, float]:
        step = float(grid[1] - grid[0])
        return max(grid[0], at - step), min(grid[-1], at + step)

    if delays.size == 1:
        found = optimize.minimize_scalar(
            lambda log: landscape(float(delays[0]), log),
            bounds=around(logs, start[1]),
            method="bounded",
        )
        point, height = (float(delays[0]), float(found.x)), float(found.fun)
    else:
        bounds = [around(delays, start[0]), around(logs, start[1])]
        simplex = optimize.minimize(
            lambda v: landscape(v[0], v[1]),
            start,
            method="Nelder-Mead",
            bounds=bounds,
            options={"xatol": 1e-5, "fatol": 1e-9},
        )
        point, height = (float(simplex.x[0]), float(simplex.x[1])), float(simplex.fun)
    if height < at_start:
        return (*point, height)
    return float(start[0]), float(start[1]), at_start


def _crossings(grid: Float64Array, profile: Float64Array, best: float, excess: float) -> Interval:
    """Return where a profile first rises by ``excess`` on both sides of its best; inf: nowhere."""
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
        # square roots of a parabola's heights are straight
        a, b, c = (np.sqrt(max(v, 0.0)) for v in (level, float(height[k]), excess))
        ends.append(inner + (float(side[k]) - inner) * float((c - a) / max(b - a, 1e-12)))
    return ends[0], ends[1]
