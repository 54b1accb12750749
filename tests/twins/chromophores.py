"""The chromophore fit in plain NumPy: slow, double precision, and short enough to check by eye.

It minimises the same sum as `reconstruction.chromophores.table_fit.kernels`, by Levenberg-Marquardt
on all pixels at once instead of damped Newton on each, and sums the same probability as
`reconstruction.chromophores.posterior_kernels`, over a dense plane. Both kernels are tested against
it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from model.color_table import ColorTable
from reconstruction.arrays import Float64Array
from reconstruction.chromophores.face_distribution import FaceDistribution
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.chromophores.start import MIN_AXIS_FRACTION, evaluate_table, inverse_table_for

_MAX_STEPS = 200


def fit(
    rgb: Float64Array, table: ColorTable, weights: Float64Array, *, free_shading: bool
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Fit all pixels by bounded Levenberg-Marquardt.

    Parameters
    ----------
    rgb
        Shape (n, 3), positive, white-balanced camera RGB over the known shading.
    table
        Color table.
    weights
        Shape (n, 3, 3): inverse covariance of the relative errors, a free shading projected out.
    free_shading
        Whether one factor per pixel is fitted too.

    Returns
    -------
    tuple of ndarray
        C_m, C_hd, shading and the weighted square sum of log differences, each of shape (n,).
    """
    start = inverse_table_for(table, free_shading)
    place = np.log(rgb) @ start.projection[:, :3].T + start.projection[:, 3]
    i, j = np.clip(np.rint(place), 0, start.axes.shape[0] - 1).astype(np.intp).T
    x = np.clip(start.axes[i, j].astype(np.float64), MIN_AXIS_FRACTION, 1.0)
    damping = np.full(len(x), 1e-3)
    shading, residual, gradient = _linearise(rgb, table, x, free_shading)
    cost = _square(residual, weights)
    for _ in range(_MAX_STEPS):
        normal = np.swapaxes(gradient, -1, -2) @ weights @ gradient
        right = np.einsum("nci,ncd,nd->ni", gradient, weights, residual)
        # A coordinate at its bound whose step leads outside is kept there.
        held = ((x <= MIN_AXIS_FRACTION) & (right < 0.0)) | ((x >= 1.0) & (right > 0.0))
        right = np.where(held, 0.0, right)
        normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal)
        diagonal = np.einsum("nii->ni", normal) * (1.0 + damping[:, None])
        normal = normal.copy()
        normal[:, [0, 1], [0, 1]] = np.where(held, 1.0, np.maximum(diagonal, 1e-300))
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        tried = np.clip(x + np.clip(step, -0.1, 0.1), MIN_AXIS_FRACTION, 1.0)
        new_shading, new_residual, new_gradient = _linearise(rgb, table, tried, free_shading)
        new_cost = _square(new_residual, weights)
        better = new_cost <= cost
        x = np.where(better[:, None], tried, x)
        shading = np.where(better, new_shading, shading)
        residual = np.where(better[:, None], new_residual, residual)
        gradient = np.where(better[:, None, None], new_gradient, gradient)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, 0.2 * damping, 5.0 * damping), 1e-12, 1e8)
    return table.c_m_max * x[:, 0] ** 3, table.c_hd_max * x[:, 1] ** 3, shading, cost


def _linearise(
    rgb: Float64Array, table: ColorTable, x: Float64Array, free_shading: bool
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return shading, relative residuals and the color's relative derivatives at x."""
    color, by_a, by_b = evaluate_table(table, x[:, 0], x[:, 1])
    residual = np.log(rgb / color)
    shading = np.ones(len(x))
    if free_shading:
        # The projected weights know no common factor; any mean of the ratios serves.
        shading = np.exp(residual.mean(axis=-1))
        residual = residual - np.log(shading)[:, None]
    return shading, residual, np.stack([by_a / color, by_b / color], axis=-1)


def _square(residual: Float64Array, weights: Float64Array) -> Float64Array:
    return np.asarray(np.einsum("nc,ncd,nd->n", residual, weights, residual))


def estimate(
    rgb: Float64Array,
    table: ColorTable,
    covariance: Float64Array,
    prior: ShadingPrior,
    *,
    face: FaceDistribution | None = None,
    size: tuple[int, int] = (1200, 500),
) -> Float64Array:
    """Sum the probability of one pixel's chromophores over a dense plane of their cube roots.

    Parameters
    ----------
    rgb
        Shape (3,), positive, over that of a white tile.
    table
        Color table.
    covariance
        Shape (3, 3), of the relative errors: noise and model.
    prior
        Of the log shading.
    face
        Of melanin and blood; None: any are as probable.
    size
        Places along melanin and along blood.

    Returns
    -------
    ndarray
        Shape (2, 2): median and 68 % reach of C_m, and of C_hd.
    """
    edges = [np.linspace(MIN_AXIS_FRACTION, 1.0, count + 1) for count in size]
    a, b = np.meshgrid(*[0.5 * (edge[1:] + edge[:-1]) for edge in edges], indexing="ij")
    residual = np.log(rgb / evaluate_table(table, a, b)[0])
    weights = np.linalg.inv(covariance)
    whole = weights.sum()
    shading = residual @ weights.sum(axis=0) / whole
    color = weights - np.outer(weights.sum(axis=0), weights.sum(axis=0)) / whole
    log_density = np.einsum("...c,cd,...d->...", residual, -0.5 * color, residual)
    log_density += np.interp(shading, prior.nodes, np.log(prior.density)) - np.log(a)
    if face is not None:
        log_density += np.log(face.melanin.relative_density(np.log(table.c_m_max * a**3)))
        log_density += np.log(face.blood.relative_density(b))
    density = np.exp(log_density - log_density.max())
    return np.array(
        [
            _median_and_reach(end * edge**3, density.sum(axis=axis))
            for end, edge, axis in zip((table.c_m_max, table.c_hd_max), edges, (1, 0), strict=True)
        ]
    )


def _median_and_reach(edges: Float64Array, density: Float64Array) -> tuple[float, float]:
    below = np.concatenate([[0.0], np.cumsum(density)]) / density.sum()
    center = float(np.interp(0.5, below, edges))

    def missing(reach: float) -> float:
        inside = np.interp([center - reach, center + reach], edges, below)
        return float(inside[1] - inside[0]) - 0.682689492137086

    return center, float(brentq(missing, 0.0, edges[-1], xtol=1e-9))
