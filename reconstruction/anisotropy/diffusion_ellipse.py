"""Describe and fit the ellipse of 1/sigma_tr over the directions of anisotropic tissue.

With parameters ``l, u, v``: h = hypot(u, v) is the log of the ratio of its axes, (u, v) / h is
(cos, sin) of twice the direction of its long axis, and l the log of the geometric mean of the
extremes of sigma_tr^2::

    sigma_tr(theta)^2 = exp(l) (cosh h - sinh(h) / h (u cos 2 theta + v sin 2 theta))

Any (l, u, v) is an ellipse, and none is singular at the circle, u = v = 0.
"""

import logging

import numpy as np

from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome
from reconstruction.anisotropy.direction_harmonics import AXIAL_COLUMNS, ODD_COLUMNS, HarmonicFit
from reconstruction.arrays import BoolArray, Float64Array

_log = logging.getLogger(__name__)

N_MEAN_DIRECTIONS = 360
"""Directions over which sigma_tr is averaged; exact to rounding up to ratios of 25."""
MAX_ELLIPSE_ITERATIONS = 100
MAX_ELLIPSE_STEP = 1.0
"""Largest step of u and v in one iteration."""
ELLIPSE_STEP_TOL = 1e-11
"""Step of the parameters at which the fit has converged."""


def relative_sigma_tr(
    angle_rad: Float64Array, uv: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return sigma_tr over the geometric mean of its extremes, and its derivatives.

    Parameters
    ----------
    angle_rad : ndarray, shape (N,)
    uv : ndarray, shape (B, 2)

    Returns
    -------
    values : ndarray, shape (B, N)
    derivatives : ndarray, shape (B, N, 2)
        Derivatives by u and v.
    """
    c, s = np.cos(2 * angle_rad), np.sin(2 * angle_rad)
    u, v = uv[:, :1], uv[:, 1:]
    h = np.hypot(u, v)
    small = h < 1e-3
    safe = np.where(small, 1.0, h)
    # sinh(h) / h, and its derivative by h divided by h
    k = np.where(small, 1.0 + h * h / 6.0, np.sinh(safe) / safe)
    k1 = np.where(small, 1.0 / 3.0 + h * h / 30.0, (np.cosh(safe) - k) / safe**2)
    along = u * c + v * s
    cosine = along / np.where(h > 0, h, 1.0)
    # cosh h - sinh h cosine, without cancellation along the long axis
    values = np.sqrt(np.exp(-h) + np.sinh(h) * (1.0 - cosine))
    by_u = (k * u - k1 * u * along - k * c) / (2 * values)
    by_v = (k * v - k1 * v * along - k * s) / (2 * values)
    return values, np.stack([by_u, by_v], axis=-1)


def uniform_axial_directions() -> Float64Array:
    """Return directions uniform over all axes, rad, (`N_MEAN_DIRECTIONS`,)."""
    return np.asarray(np.arange(N_MEAN_DIRECTIONS) * (np.pi / N_MEAN_DIRECTIONS))


def fit_ellipses(
    angle_rad: Float64Array, values: Float64Array, weight: Float64Array, start: HarmonicFit
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit ellipses, with the first harmonic as a factor ``1 + a cos theta + b sin theta``.

    Levenberg-Marquardt, from the linear fit of harmonics.

    Parameters
    ----------
    angle_rad : ndarray, shape (N,)
    values, weight : ndarray, shape (N, B)
        Values of sigma_tr, near 1, and weights as in `start`.
    start : HarmonicFit
        Linear fit: which series can be fitted, and which with the first harmonic.

    Returns
    -------
    parameters : ndarray, shape (B, 5)
        l, u, v, a, b; a and b are 0 where not fitted, all are 0 without a fit.
    inverse : ndarray, shape (B, 5, 5)
        Covariance if the weights are inverse variances; 0 for parameters not fitted.
    residual : ndarray, shape (B,)
        Weighted sum of squared residuals.
    """
    count = values.shape[1]
    free = np.column_stack(
        [
            np.repeat(start.determined[:, None], 3, axis=1),
            np.repeat(start.has_first_harmonic[:, None], 2, axis=1),
        ]
    )
    y, w = values.T, np.where(start.determined, weight, 0.0).T
    mean = np.where(start.determined, start.coefficients[:, 0], 1.0)
    mean = np.where(mean > 0, mean, 1.0)
    axial = -start.coefficients[:, AXIAL_COLUMNS] / mean[:, None]
    size = np.hypot(axial[:, 0], axial[:, 1])
    # an amplitude a of sigma_tr makes the ratio (1 + a) / (1 - a)
    lengthen = 2.0 * np.arctanh(np.minimum(size, 0.9)) / np.where(size > 0, size, 1.0)
    p = np.zeros((count, 5))
    p[:, 0] = 2.0 * np.log(mean)
    p[:, 1:3] = axial * np.where(size > 0, lengthen, 2.0)[:, None]
    p[:, 3:] = start.coefficients[:, ODD_COLUMNS] / mean[:, None]
    p *= free
    error, jacobian = _linearized(angle_rad, y, p, free)
    cost = (w * error**2).sum(axis=1)
    damping = np.full(count, 1e-3)
    eye = np.eye(5)
    active = np.arange(count)
    for _ in range(MAX_ELLIPSE_ITERATIONS):
        now, weights, free_now = jacobian[active], w[active], free[active]
        weighted = now * weights[..., None]
        normal = now.transpose(0, 2, 1) @ weighted
        diagonal = np.einsum("bii->bi", normal) * damping[active, None]
        damped = normal + eye * np.where(free_now, diagonal, 1.0)[:, None, :]
        right = np.einsum("bni,bn->bi", weighted, error[active])
        step = np.linalg.solve(damped, right[..., None])[..., 0]
        step /= np.maximum(1.0, np.abs(step[:, 1:3]).max(axis=1) / MAX_ELLIPSE_STEP)[:, None]
        there = _linearized(angle_rad, y[active], p[active] + step, free_now)
        tried = (weights * there[0] ** 2).sum(axis=1)
        better = tried <= cost[active]
        at = active[better]
        p[at] += step[better]
        cost[at], error[at], jacobian[at] = tried[better], there[0][better], there[1][better]
        damping[active] = np.clip(damping[active] * np.where(better, 0.2, 5.0), 1e-12, 1e12)
        active = active[np.abs(step).max(axis=1) > ELLIPSE_STEP_TOL]
        if not active.size:
            break
    else:
        found = SolverOutcome(
            MAX_ELLIPSE_ITERATIONS,
            float(np.abs(step).max() / ELLIPSE_STEP_TOL),
            UNKNOWN_CONDITION,
            "limit",
        )
        found.warn_unless_converged(f"{active.size} of {count} diffusion ellipses", _log)
    # ones on the diagonal of parameters not fitted keep the matrix regular
    rows = np.concatenate([np.sqrt(w)[..., None] * jacobian, eye * ~free[:, None, :]], axis=1)
    triangle = np.linalg.inv(np.linalg.qr(rows, mode="r"))
    inverse = np.einsum("bij,bkj->bik", triangle, triangle) * (free[:, :, None] & free[:, None, :])
    return p, inverse, cost


def _linearized(
    angle_rad: Float64Array, y: Float64Array, p: Float64Array, free: BoolArray
) -> tuple[Float64Array, Float64Array]:
    """Return residuals (B, N) and the model's derivatives (B, N, 5), 0 for fixed parameters."""
    shape, by_uv = relative_sigma_tr(angle_rad, p[:, 1:3])
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    size = np.exp(0.5 * p[:, :1])
    factor = 1.0 + p[:, 3:4] * cosine + p[:, 4:] * sine
    model = size * shape * factor
    derivatives = np.stack(
        [
            0.5 * model,
            (size * factor) * by_uv[..., 0],
            (size * factor) * by_uv[..., 1],
            size * shape * cosine,
            size * shape * sine,
        ],
        axis=-1,
    )
    return y - model, derivatives * free[:, None, :]


def mean_over_directions(parameters: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return sigma_tr averaged over all directions (B,), and its derivatives by l, u, v (B, 3)."""
    shape, by_uv = relative_sigma_tr(uniform_axial_directions(), parameters[:, 1:3])
    size = np.exp(0.5 * parameters[:, 0])
    mean = size * shape.mean(axis=1)
    return mean, np.column_stack([0.5 * mean, size[:, None] * by_uv.mean(axis=1)])
