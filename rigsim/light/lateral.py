"""Scatter light laterally in skin by heat flow over the surface, on its texture.

Convolution with a Gaussian of standard deviation s on a surface is heat flow for the time s^2 / 2.
Solved with the surface's own lengths it conserves light on stretched textures and curved faces,
preserves a uniform field, and stops at the texture's borders. A sum of Gaussians is one flow,
sampled at several times.

Notes
-----
Lengths along u and v are treated as perpendicular (the skew of the texture is neglected). Time
steps are implicit, alternating between directions; alternating also their order halves the
splitting error. The kernel of a stage of `IMPLICIT_STEPS` steps has an excess kurtosis of 3 /
STEPS.
"""

import math
from typing import Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.atlas import Atlas

IMPLICIT_STEPS: Final = 6
"""Implicit steps between two widths."""

MIN_SIGMA_TEXELS: Final = 0.25
"""Kernels narrower than this fraction of the smallest texel leave the field unchanged."""

COLUMN_BLOCK: Final = 64


class LateralError(ValueError):
    """An unusable kernel or field."""


def scatter_laterally(
    field: Float32Array, atlas: Atlas, sigmas_mm: ArrayLike, weights: ArrayLike
) -> Float32Array:
    """Convolve a field on the surface with a sum of Gaussians per channel.

    Parameters
    ----------
    field
        Light per area, shape (N, N, C); zero where the texture has no surface.
    atlas
        The surface.
    sigmas_mm
        Light per area, shape (N, N, C); zero where the texture has no surface.
    weights
        Weights, >= 0, shape (C, K), each row summing to 1.

    Returns
    -------
    ndarray of float32
        Shape (N, N, C); the integral over the surface of each channel is that of `field`.

    Raises
    ------
    LateralError
        Shapes disagree, widths do not increase, or weights do not sum to 1.
    """
    sigma = np.asarray(sigmas_mm, np.float64)
    weight = np.asarray(weights, np.float64)
    if field.ndim != 3 or field.shape[:2] != atlas.prim.shape:
        raise LateralError(f"field: got shape {field.shape}, expected (N, N, C) of the atlas")
    if sigma.ndim != 1 or not (np.diff(sigma) > 0).all() or not (sigma > 0).all():
        raise LateralError(f"sigmas_mm: got {sigma.tolist()}, expected increasing widths > 0")
    if weight.shape != (field.shape[2], sigma.size) or (weight < 0).any():
        raise LateralError(f"weights: got shape {weight.shape}, expected (C, K) numbers >= 0")
    if np.abs(weight.sum(axis=1) - 1.0).max() > 1e-6:
        raise LateralError(f"weights: got sums {weight.sum(axis=1).tolist()}, expected 1")
    area, along_u, along_v, smallest_mm = _metric(atlas)
    state = np.where(atlas.covered[..., None], field, 0.0).astype(np.float32)
    total = np.zeros_like(state)
    time = 0.0
    for k, width in enumerate(sigma):
        if width > MIN_SIGMA_TEXELS * smallest_mm:
            step = (0.5 * width * width - time) / IMPLICIT_STEPS
            for n in range(IMPLICIT_STEPS):
                order = (_flow_rows, _flow_columns) if n % 2 == 0 else (_flow_columns, _flow_rows)
                for flow in order:
                    flow(state, area, along_u if flow is _flow_rows else along_v, step)
            time = 0.5 * width * width
        total += weight[:, k].astype(np.float32) * state
    return total


def edge_width_mm(sigmas_mm: ArrayLike, weights: ArrayLike) -> Float64Array:
    """Return the width from 10 to 90 % of an edge blurred by a sum of Gaussians.

    Parameters
    ----------
    sigmas_mm, weights
        As for `scatter_laterally`.

    Returns
    -------
    ndarray
        Width in mm, shape (C,).

    Examples
    --------
    >>> edge_width_mm([1.0], [[1.0]]).round(3).tolist()
    [2.563]
    """
    sigma = np.asarray(sigmas_mm, np.float64)
    weight = np.atleast_2d(np.asarray(weights, np.float64))
    x = np.linspace(0.0, 6.0 * float(sigma.max()), 20001)
    parts = np.array([[0.5 * math.erf(t / (s * math.sqrt(2.0))) for t in x] for s in sigma])
    edges = 0.5 + weight @ parts
    return np.array([2.0 * np.interp(0.9, edge, x) for edge in edges])


def _metric(atlas: Atlas) -> tuple[Float32Array, Float32Array, Float32Array, float]:
    """Return texel areas, conductances to the right and lower neighbors, and the finest texel."""
    a, b = (length.astype(np.float64) for length in atlas.texel_mm())
    covered = atlas.covered & (a > 1e-9) & (b > 1e-9)
    a, b = np.where(covered, a, 1.0), np.where(covered, b, 1.0)
    across, down = b / a, a / b
    along_u, along_v = np.zeros_like(a), np.zeros_like(a)
    both = covered[:, 1:] & covered[:, :-1]
    # Flux between texels in series: the harmonic mean of their conductances.
    along_u[:, :-1] = np.where(both, 2.0 / (1.0 / across[:, 1:] + 1.0 / across[:, :-1]), 0.0)
    both = covered[1:] & covered[:-1]
    along_v[:-1] = np.where(both, 2.0 / (1.0 / down[1:] + 1.0 / down[:-1]), 0.0)
    smallest = float(np.quantile(np.minimum(a, b)[covered], 0.01)) if covered.any() else 1.0
    return (
        (a * b).astype(np.float32),
        along_u.astype(np.float32),
        along_v.astype(np.float32),
        smallest,
    )


@njit(parallel=True, cache=True)
def _flow_rows(field, area, conductance, step):  # type: ignore[no-untyped-def]
    """Solve one implicit step along the rows in place (Thomas's algorithm)."""
    # Backward Euler of area dF/dt = div(conductance grad F) gives per row the tridiagonal system
    # (area + s (c_left + c_right)) F_i - s c_left F_(i-1) - s c_right F_(i+1) = area F_i(old).
    # Its columns sum to the areas, so that the sum of area times F, the light, is conserved.
    rows, columns, channels = field.shape
    for i in prange(rows):
        ratio = np.empty(columns)
        left = 0.0
        for j in range(columns):
            right = step * conductance[i, j]
            pivot = area[i, j] + left + right
            if j > 0:
                pivot -= left * ratio[j - 1]
            ratio[j] = right / pivot
            for c in range(channels):
                value = area[i, j] * field[i, j, c]
                if j > 0:
                    value += left * field[i, j - 1, c]
                field[i, j, c] = value / pivot
            left = right
        for j in range(columns - 2, -1, -1):
            for c in range(channels):
                field[i, j, c] += ratio[j] * field[i, j + 1, c]


@njit(parallel=True, cache=True)
def _flow_columns(field, area, conductance, step):  # type: ignore[no-untyped-def]
    """Solve one implicit step along the columns in place, a block of columns at a time."""
    rows, columns, channels = field.shape
    for block in prange((columns + COLUMN_BLOCK - 1) // COLUMN_BLOCK):
        first = block * COLUMN_BLOCK
        last = min(first + COLUMN_BLOCK, columns)
        ratio = np.empty((rows, last - first))
        for i in range(rows):
            for j in range(first, last):
                up = step * conductance[i - 1, j] if i > 0 else 0.0
                down = step * conductance[i, j]
                pivot = area[i, j] + up + down
                if i > 0:
                    pivot -= up * ratio[i - 1, j - first]
                ratio[i, j - first] = down / pivot
                for c in range(channels):
                    value = area[i, j] * field[i, j, c]
                    if i > 0:
                        value += up * field[i - 1, j, c]
                    field[i, j, c] = value / pivot
        for i in range(rows - 2, -1, -1):
            for j in range(first, last):
                for c in range(channels):
                    field[i, j, c] += ratio[i, j - first] * field[i + 1, j, c]
