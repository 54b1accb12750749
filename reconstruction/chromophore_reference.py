"""The chromophore fit in plain NumPy: slow, double precision, and short enough to check by eye.

It minimises the same sum as `reconstruction.chromophore_kernels`, by Levenberg-Marquardt on all
pixels at once instead of damped Newton on each, and is what the kernel is tested against.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from model.color_table import ColorTable
from reconstruction.chromophore_start import LOWEST, evaluate, start_for

Floats = NDArray[np.float64]

_STEPS = 200


def fit(
    rgb: Floats, table: ColorTable, weights: Floats, *, free_shading: bool
) -> tuple[Floats, Floats, Floats, Floats]:
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
    start = start_for(table, free_shading)
    place = np.log(rgb) @ start.projection[:, :3].T + start.projection[:, 3]
    i, j = np.clip(np.rint(place), 0, start.axes.shape[0] - 1).astype(np.intp).T
    x = np.clip(start.axes[i, j].astype(np.float64), LOWEST, 1.0)
    damping = np.full(len(x), 1e-3)
    shading, residual, gradient = _linearise(rgb, table, x, free_shading)
    cost = _square(residual, weights)
    for _ in range(_STEPS):
        normal = np.swapaxes(gradient, -1, -2) @ weights @ gradient
        right = np.einsum("nci,ncd,nd->ni", gradient, weights, residual)
        # A coordinate at its bound whose step leads outside is kept there.
        held = ((x <= LOWEST) & (right < 0.0)) | ((x >= 1.0) & (right > 0.0))
        right = np.where(held, 0.0, right)
        normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal)
        diagonal = np.einsum("nii->ni", normal) * (1.0 + damping[:, None])
        normal = normal.copy()
        normal[:, [0, 1], [0, 1]] = np.where(held, 1.0, np.maximum(diagonal, 1e-300))
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        tried = np.clip(x + np.clip(step, -0.1, 0.1), LOWEST, 1.0)
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
    rgb: Floats, table: ColorTable, x: Floats, free_shading: bool
) -> tuple[Floats, Floats, Floats]:
    """Return shading, relative residuals and the color's relative derivatives at x."""
    color, by_a, by_b = evaluate(table, x[:, 0], x[:, 1])
    residual = np.log(rgb / color)
    shading = np.ones(len(x))
    if free_shading:
        # The projected weights know no common factor; any mean of the ratios serves.
        shading = np.exp(residual.mean(axis=-1))
        residual = residual - np.log(shading)[:, None]
    return shading, residual, np.stack([by_a / color, by_b / color], axis=-1)


def _square(residual: Floats, weights: Floats) -> Floats:
    return np.asarray(np.einsum("nc,ncd,nd->n", residual, weights, residual))
