"""Fit many radial profiles by Levenberg and Marquardt's method, in parallel threads (Numba).

The parallel kernel is called from one thread. Sums may be taken in any order within a profile, but
a profile's result does not depend on the others nor on the number of threads.

References
----------
Marquardt 1963, doi:10.1137/0111030.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

from reconstruction.arrays import Float64Array, Int64Array
from reconstruction.subsurface.kernels import decay, evaluate_one

MAX_LOG_STEP = 1.5
"""Largest change of a logarithm in one step."""
LOG_STEP_TOL = 1e-5
"""Step of the logarithms at which the fit has converged."""
_FAST_MATH = {"contract", "nsz"}
_MIN_REFLECTANCE = 1e-290


class FitProblem(NamedTuple):
    """Data, weights, prior and limits of a fit."""

    y: Float64Array
    """(N, F): reflectance, or its logarithm where `logarithmic`."""
    variance: Float64Array
    """(N, F): of `y`; infinite where a fiber is omitted."""
    logarithmic: bool
    """Compare logarithms; then the model's error is not added."""
    prior: Float64Array
    """(4, 2): mean and standard deviation; 0: fixed; infinite: free."""
    model_error: Float64Array
    """(3,), relative: everywhere; at the source, falling by exp(-r (sigma_a + sigma_s')); and times
    sigma_a/sigma_s'."""
    bounds: Float64Array
    """(4, 2): least and greatest value of each parameter."""
    rounds: int
    """Times the weights are recomputed with the model's error."""
    max_steps: int
    """Largest number of steps per round."""


class FitBuffers(NamedTuple):
    """Arrays that a fit fills."""

    theta: Float64Array
    """(N, 4): start; becomes the result."""
    covariance: Float64Array
    """(N, 4, 4), infinite where singular."""
    chi2: Float64Array
    """(N,), with the priors' part."""
    predicted: Float64Array
    """(N, F): the profile."""
    total: Float64Array
    """(N, F): its variance with the model's error."""
    steps: Int64Array
    """(N,): evaluations, negative: not converged."""


@njit(error_model="numpy")
def _solve(h, g, chosen, count, damping, low, x):  # type: ignore[no-untyped-def]
    """Solve (h + damping diag h) x = g for the chosen parameters by Cholesky; False: singular."""
    for r in range(count):
        i = chosen[r]
        for c in range(r + 1):
            j = chosen[c]
            total = h[i, j]
            if r == c:
                total *= 1.0 + damping
            for e in range(c):
                total -= low[r, e] * low[c, e]
            if r == c:
                if not total > 1e-13 * h[i, i]:
                    return False
                low[r, r] = math.sqrt(total)
            else:
                low[r, c] = total / low[c, c]
    for r in range(count):
        total = g[chosen[r]]
        for e in range(r):
            total -= low[r, e] * x[chosen[e]]
        x[chosen[r]] = total / low[r, r]
    for r in range(count - 1, -1, -1):
        total = x[chosen[r]]
        for e in range(r + 1, count):
            total -= low[e, r] * x[chosen[e]]
        x[chosen[r]] = total / low[r, r]
    return True


@njit(fastmath=_FAST_MATH, error_model="numpy")
def _misfit(y, m, weight, logarithmic):  # type: ignore[no-untyped-def]
    total = 0.0
    if logarithmic:
        for f in range(y.size):
            d = y[f] - math.log(max(m[f], _MIN_REFLECTANCE))
            total += weight[f] * d * d
    else:
        for f in range(y.size):
            d = y[f] - m[f]
            total += weight[f] * d * d
    return total


@njit(fastmath=_FAST_MATH, error_model="numpy")
def _normal(y, m, jac, weight, logarithmic, active, count, h, g):  # type: ignore[no-untyped-def]
    """Fill J'WJ and J'W residual of the active parameters; scale `jac` to logs if logarithmic."""
    if logarithmic:
        for r in range(count):
            row = jac[active[r]]
            for f in range(y.size):
                row[f] /= max(m[f], _MIN_REFLECTANCE)
    for r in range(count):
        i = active[r]
        for c in range(r + 1):
            j = active[c]
            total = 0.0
            for f in range(y.size):
                total += weight[f] * jac[i, f] * jac[j, f]
            h[i, j] = total
            h[j, i] = total
        total = 0.0
        if logarithmic:
            for f in range(y.size):
                total += weight[f] * jac[i, f] * (y[f] - math.log(max(m[f], _MIN_REFLECTANCE)))
        else:
            for f in range(y.size):
                total += weight[f] * jac[i, f] * (y[f] - m[f])
        g[i] = total


@njit(error_model="numpy")
def _fit_share(begin, end, curves, problem, found):  # type: ignore[no-untyped-def]
    """Fit the profiles from `begin` to `end`; see `fit`."""
    radius, y, logarithmic = curves.radius_mm, problem.y, problem.logarithmic
    model_error, prior, bounds = problem.model_error, problem.prior, problem.bounds
    theta, total = found.theta, found.total
    fibers = radius.size
    m, trial_m = np.empty(fibers), np.empty(fibers)
    jac, trial_jac = np.empty((4, fibers)), np.empty((4, fibers))
    weight, w = np.zeros(fibers), np.zeros((6, 4))
    h, g, low = np.zeros((4, 4)), np.zeros(4), np.zeros((4, 4))
    x, trial, unit = np.zeros(4), np.zeros(4), np.zeros(4)
    active, chosen = np.zeros(4, np.int64), np.zeros(4, np.int64)
    count = 0
    for p in range(4):
        if prior[p, 1] > 0.0:
            active[count] = p
            count += 1
    for n in range(begin, end):
        now = theta[n]
        evaluate_one(curves, now, w, m, jac)
        done = 1
        settled = False
        best = 0.0
        changing = not logarithmic and (
            model_error[0] > 0.0 or model_error[1] > 0.0 or model_error[2] > 0.0
        )
        for round_ in range(problem.rounds):
            close = max(LOG_STEP_TOL, 1e-2 * 0.01**round_) if changing else LOG_STEP_TOL
            extinction = math.exp(now[0]) + math.exp(now[1])
            base = model_error[0] ** 2 + (model_error[2] * math.exp(now[0] - now[1])) ** 2
            for f in range(fibers):
                v = problem.variance[n, f]
                if not logarithmic and v < np.inf:
                    e = base
                    if model_error[1] > 0.0:
                        e += (model_error[1] * decay(radius[f] * extinction)) ** 2
                    v += e * m[f] * m[f]
                total[n, f] = v
                weight[f] = 1.0 / v
            first = True
            settled = False
            damping = 1e-4
            best = _misfit(y[n], m, weight, logarithmic)
            for r in range(count):
                p = active[r]
                best += ((now[p] - prior[p, 0]) / prior[p, 1]) ** 2
            fresh = True
            for _ in range(problem.max_steps):
                if fresh:
                    _normal(y[n], m, jac, weight, logarithmic, active, count, h, g)
                    free = 0
                    for r in range(count):
                        p = active[r]
                        h[p, p] += 1.0 / prior[p, 1] ** 2
                        g[p] -= (now[p] - prior[p, 0]) / prior[p, 1] ** 2
                        # a parameter at its limit stays there while the gradient points outward
                        if not (
                            (now[p] <= bounds[p, 0] and g[p] < 0.0)
                            or (now[p] >= bounds[p, 1] and g[p] > 0.0)
                            or h[p, p] <= 0.0
                        ):
                            chosen[free] = p
                            free += 1
                    fresh = False
                if free == 0:
                    settled = True
                    break
                x[:] = 0.0
                if not _solve(h, g, chosen, free, damping, low, x):
                    damping = max(damping * 10.0, 1e-12)
                    if damping > 1e10:
                        break
                    continue
                longest = 0.0
                for p in range(4):
                    longest = max(longest, abs(x[p]))
                shrink = min(1.0, MAX_LOG_STEP / max(longest, 1e-300))
                longest = 0.0
                for p in range(4):
                    to = now[p] + shrink * x[p]
                    if x[p] == 0.0:
                        to = now[p]
                    trial[p] = min(max(to, bounds[p, 0]), bounds[p, 1])
                    longest = max(longest, abs(trial[p] - now[p]))
                if longest < 1e-9:
                    settled = True
                    break
                evaluate_one(curves, trial, w, trial_m, trial_jac)
                done += 1
                there = _misfit(y[n], trial_m, weight, logarithmic)
                for r in range(count):
                    p = active[r]
                    there += ((trial[p] - prior[p, 0]) / prior[p, 1]) ** 2
                if there <= best:
                    gain = best - there
                    best = there
                    now[:] = trial
                    m, trial_m = trial_m, m
                    jac, trial_jac = trial_jac, jac
                    fresh = True
                    first = first and longest < 1e-7
                    damping = max(damping * 0.1, 1e-9)
                    if longest < close or gain <= 1e-13 * best:
                        settled = True
                        break
                else:
                    if there - best <= 1e-11 * best and longest < 1e-4:
                        settled = True  # rounding is all that is left
                        break
                    damping *= 10.0
                    if damping > 1e10:
                        settled = longest < 1e-6
                        break
            if not changing or (first and close <= LOG_STEP_TOL):
                break
        found.steps[n] = done if settled else -done
        found.chi2[n] = best
        found.predicted[n] = m
        if fresh:
            _normal(y[n], m, jac, weight, logarithmic, active, count, h, g)
            for r in range(count):
                h[active[r], active[r]] += 1.0 / prior[active[r], 1] ** 2
        found.covariance[n] = 0.0
        for r in range(count):
            unit[:] = 0.0
            unit[active[r]] = 1.0
            x[:] = 0.0
            if _solve(h, unit, active, count, 0.0, low, x):
                found.covariance[n, active[r]] = x
            else:
                found.covariance[n, active[r], :] = np.inf


@njit(cache=True, parallel=True, error_model="numpy")
def fit(curves: Any, problem: Any, found: Any, parts: Any) -> None:
    """Fit every profile, starting from `found.theta`.

    Parameters
    ----------
    curves : ForwardModel
    problem : FitProblem
    found : FitBuffers
    parts : int
        Number of parts that the profiles are divided into.
    """
    profiles = problem.y.shape[0]
    for part in prange(parts):
        begin, end = part * profiles // parts, (part + 1) * profiles // parts
        _fit_share(begin, end, curves, problem, found)
