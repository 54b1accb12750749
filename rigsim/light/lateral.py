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
from typing import Final, TypeAlias

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike
from scipy.special import erf

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.atlas import Atlas

IMPLICIT_STEPS: Final = 6
"""Implicit steps between two widths."""

MINOR_WEIGHT: Final = 0.05
MINOR_STEPS: Final = 2
"""Largest weight in a channel up to which a Gaussian takes fewer implicit steps, and their number:
2e-4 of the brightest light at most."""

MIN_SIGMA_TEXELS: Final = 0.25
"""Kernels narrower than this fraction of the smallest texel leave the field unchanged."""

COLUMN_BLOCK: Final = 64

_Factors: TypeAlias = tuple[Float32Array, Float32Array, Float32Array]
"""Factors of a texel's old value, of its predecessor and of its successor, shape (N, N) each."""


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
    if field.ndim != 3 or field.shape[:2] != atlas.prim.shape:
        raise LateralError(f"field: got shape {field.shape}, expected (N, N, C) of the atlas")
    if np.ndim(weights) != 2 or len(np.asarray(weights)) != field.shape[2]:
        raise LateralError(
            f"weights: got shape {np.shape(weights)}, expected (C, K), C = {field.shape[2]}"
        )
    return HeatFlow(atlas, sigmas_mm, weights).scatter(field)


class HeatFlow:
    """Lateral scattering on one surface, for many fields.

    The factors of the implicit steps depend on the surface and the widths alone.

    Parameters
    ----------
    atlas, sigmas_mm, weights
        As for `scatter_laterally`.

    Raises
    ------
    LateralError
        Widths do not increase, or weights do not sum to 1.
    """

    def __init__(self, atlas: Atlas, sigmas_mm: ArrayLike, weights: ArrayLike) -> None:
        sigma = np.asarray(sigmas_mm, np.float64)
        self._weight = np.asarray(weights, np.float64)
        if sigma.ndim != 1 or not (np.diff(sigma) > 0).all() or not (sigma > 0).all():
            raise LateralError(f"sigmas_mm: got {sigma.tolist()}, expected increasing widths > 0")
        if (
            self._weight.ndim != 2
            or self._weight.shape[1] != sigma.size
            or (self._weight < 0).any()
        ):
            raise LateralError(
                f"weights: got shape {self._weight.shape}, expected (C, K) numbers >= 0"
            )
        if np.abs(self._weight.sum(axis=1) - 1.0).max() > 1e-6:
            raise LateralError(f"weights: got sums {self._weight.sum(axis=1).tolist()}, expected 1")
        self._covered = atlas.covered[..., None]
        area, along_u, along_v, smallest_mm = _metric(atlas)
        self._stages: list[tuple[int, _Factors, _Factors] | None] = []
        time = 0.0
        for k, width in enumerate(sigma):
            if width <= MIN_SIGMA_TEXELS * smallest_mm:
                self._stages.append(None)
                continue
            is_minor = float(self._weight[:, k].max()) <= MINOR_WEIGHT
            count = MINOR_STEPS if is_minor else IMPLICIT_STEPS
            step = (0.5 * width * width - time) / count
            turned = (np.ascontiguousarray(part.T) for part in (area, along_u))
            self._stages.append((count, _factorize(*turned, step), _factorize(area, along_v, step)))
            time = 0.5 * width * width

    def scatter(self, field: Float32Array) -> Float32Array:
        """Convolve a field, see `scatter_laterally`."""
        if field.shape[2] != len(self._weight):
            raise LateralError(
                f"weights: got shape {self._weight.shape}, expected one row for each of "
                f"{field.shape[2]} channels"
            )
        light = np.where(self._covered, field, np.float32(0.0)).astype(np.float32)
        # rows of the texture are columns of the turned one, along which `_flow` is vectorized
        state, is_turned = np.ascontiguousarray(np.moveaxis(light, 2, 0)), False
        total = np.zeros_like(state)
        for k, stage in enumerate(self._stages):
            if stage is not None:
                count, rows, columns = stage
                for n in range(2 * count):
                    along_rows = n % 4 in (0, 3)
                    if along_rows != is_turned:
                        state, is_turned = _turn(state), along_rows
                    _flow(state, *(rows if along_rows else columns))
            part = np.moveaxis(state, 1, 2) if is_turned else state
            total += self._weight[:, k, None, None].astype(np.float32) * part
        return np.ascontiguousarray(np.moveaxis(total, 0, 2))


def _turn(state: Float32Array) -> Float32Array:
    return np.ascontiguousarray(np.moveaxis(state, 1, 2))


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
    edges = 0.5 + 0.5 * weight @ erf(x / (math.sqrt(2.0) * sigma[:, None]))
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
def _factorize(area, conductance, step):  # type: ignore[no-untyped-def]
    """Factorize one implicit step along the columns (Thomas's algorithm)."""
    # Backward Euler of area dF/dt = div(conductance grad F) gives per column the tridiagonal system
    # (area + s (c_up + c_down)) F_i - s c_up F_(i-1) - s c_down F_(i+1) = area F_i(old).
    # Its columns sum to the areas, so that the sum of area times F, the light, is conserved.
    rows, columns = area.shape
    own, before, after = np.empty_like(area), np.empty_like(area), np.empty_like(area)
    for j in prange(columns):
        up, ratio = 0.0, 0.0
        for i in range(rows):
            down = step * conductance[i, j]
            inverse = 1.0 / (area[i, j] + up + down - up * ratio)
            ratio = down * inverse
            own[i, j], before[i, j], after[i, j] = area[i, j] * inverse, up * inverse, ratio
            up = down
    return own, before, after


@njit(parallel=True, cache=True, nogil=True)
def _flow(field, own, before, after):  # type: ignore[no-untyped-def]
    """Solve one implicit step along the columns in place, a block of columns at a time."""
    channels, rows, columns = field.shape
    blocks = (columns + COLUMN_BLOCK - 1) // COLUMN_BLOCK
    for task in prange(channels * blocks):
        light = field[task % channels]  # neighboring tasks share their factors
        first = task // channels * COLUMN_BLOCK
        last = min(first + COLUMN_BLOCK, columns)
        # slices of rows, so that the inner loops are vectorized
        here = light[0, first:last]
        scale = own[0, first:last]
        for j in range(here.shape[0]):
            here[j] *= scale[j]
        for i in range(1, rows):
            last_row, here = light[i - 1, first:last], light[i, first:last]
            scale, link = own[i, first:last], before[i, first:last]
            for j in range(here.shape[0]):
                here[j] = scale[j] * here[j] + link[j] * last_row[j]
        for i in range(rows - 2, -1, -1):
            next_row, here = light[i + 1, first:last], light[i, first:last]
            link = after[i, first:last]
            for j in range(here.shape[0]):
                here[j] += link[j] * next_row[j]
