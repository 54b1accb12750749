"""Light that spreads in skin, blurred on the screen: a sum of Gaussians whose width knows depth.

Each Gaussian is blurred from the one before, along rows and along columns. Taps lie as far apart
as the slant of the surface makes them on the screen, and count less where they leave its plane:
light hardly leaks across depths (taps between pixels let a tenth reach the first two), and spreads
no further where the surface turns away.

References
----------
Jimenez et al. 2009, doi:10.1145/1609967.1609970 (diffusion on the screen, width by depth and its
gradient).
d'Eon et al. 2007, doi:10.2312/EGWR/EGSR07/147-157 (sums of Gaussians; texturing after scattering).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import BoolArray, Float64Array

Texturing = Literal["post", "pre", "both"]

ALBEDO_POWERS: Final[dict[Texturing, tuple[float, float]]] = {
    "post": (0.0, 1.0),
    "pre": (1.0, 0.0),
    "both": (0.5, 0.5),
}
"""Power of the albedo before and behind the blur. A measured albedo is blurred by the skin itself
already: all but "post" blur it twice."""

INTERPOLATION_PX: Final = 0.75
"""Width, px, below which interpolation blurs more than is wanted; of the least largest error."""


class ScreenScatteringError(ValueError):
    """Light, depth or Gaussians that do not fit together."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How a Gaussian is summed.

    Attributes
    ----------
    taps
        On each side of the middle.
    reach
        Distance of the last, in standard deviations.
    slant_limit
        Largest change of depth along the screen, mm/mm, that narrows the blur.
    """

    taps: int = 3
    reach: float = 2.5
    slant_limit: float = 4.0

    @property
    def offsets(self) -> Float64Array:
        """Distances of the taps on one side, in standard deviations, (taps,)."""
        return self.reach * np.arange(1, self.taps + 1) / self.taps

    @property
    def widening(self) -> float:
        """Factor that undoes what cutting at the reach takes off the standard deviation.

        Examples
        --------
        >>> round(Sampling().widening, 3)
        1.014
        """
        weight = np.exp(-0.5 * self.offsets**2)
        total = 1.0 + 2.0 * float(weight.sum())
        return float(np.sqrt(total / (2.0 * float((weight * self.offsets**2).sum()))))


def scatter(
    light: ArrayLike,
    depth_mm: ArrayLike,
    *,
    variances_mm2: ArrayLike,
    weights: ArrayLike,
    focal_px: float,
    width: ArrayLike = 1.0,
    sampling: Sampling | None = None,
) -> Float64Array:
    """Return light after it has spread.

    Parameters
    ----------
    light
        (H, W, 3), linear; counts where there is a surface, and is finite there.
    depth_mm
        Distance along the view axis, (H, W), mm, finite; 0 or below where there is no surface.
    variances_mm2
        Of the Gaussians along one axis, growing, (G,), finite.
    weights
        Of each for red, green and blue, (G, 3), finite.
    focal_px
        Pixels of 1 mm at a distance of 1 mm, > 0.
    width
        Factor of all standard deviations, a number or (H, W), finite, > 0 on the surface.
    sampling
        How each Gaussian is summed.

    Returns
    -------
    ndarray
        (H, W, 3); 0 where there is no surface.

    Raises
    ------
    ScreenScatteringError
        For shapes that differ, variances that do not grow, and what is not finite.
    """
    E, z = np.asarray(light, np.float64), np.asarray(depth_mm, np.float64)
    variances, share = np.asarray(variances_mm2, np.float64), np.asarray(weights, np.float64)
    if E.shape != (*z.shape, 3) or z.ndim != 2:
        raise ScreenScatteringError(f"light: got shape {E.shape}, expected {(*z.shape, 3)}")
    if (
        share.shape != (len(variances), 3)
        or not np.all(np.diff(variances, prepend=0.0) > 0.0)
        or not np.all(np.isfinite(variances))
    ):
        raise ScreenScatteringError(
            f"variances_mm2: got {variances.tolist()} and weights {share.shape}, expected growing "
            "finite ones above 0 and three weights each"
        )
    how = Sampling() if sampling is None else sampling
    factor = np.where(z > 0.0, np.broadcast_to(np.asarray(width, np.float64), z.shape), 1.0)
    if not np.all((factor > 0.0) & (factor < np.inf)):
        raise ScreenScatteringError(
            f"width: got {factor.min():g} to {factor.max():g}, expected above 0 on the surface, "
            "finite"
        )
    blurred, out = np.where(z[..., None] > 0.0, E, 0.0), np.zeros_like(E)
    for name, values in (("light", blurred), ("depth_mm", z), ("weights", share)):
        if not np.all(np.isfinite(values)):
            raise ScreenScatteringError(f"{name}: got NaN or infinity, expected finite values")
    if not 0.0 < focal_px < np.inf:
        raise ScreenScatteringError(f"focal_px: got {focal_px}, expected a finite number above 0")
    for variance, weight in zip(np.diff(variances, prepend=0.0), share, strict=True):
        sigma = how.widening * np.sqrt(variance) * factor
        for axis in (1, 0):
            blurred = _blurred(blurred, z, sigma, axis, focal_px, how)
        out += weight * blurred
    return out


def narrowed(deviation_px: ArrayLike) -> Float64Array:
    """Return the standard deviation to ask for so that interpolated taps give the one wanted.

    Interpolating between pixels blurs by itself: at a distance x beyond a pixel by x (1 - x) px^2.
    The result is within 3 % of the deviation wanted, at any width.

    Parameters
    ----------
    deviation_px
        Wanted, px, >= 0, any shape.

    Examples
    --------
    >>> narrowed([0.2, 1.0, 5.0]).round(3).tolist()
    [0.053, 0.934, 4.999]
    """
    wide = np.asarray(deviation_px, np.float64)
    # wide^2 / (wide^4 + INTERPOLATION_PX^4)^(1/4), written so that no power overflows
    large = np.maximum(wide, INTERPOLATION_PX)
    ratio = np.minimum(wide, INTERPOLATION_PX) / large
    return np.asarray(wide * (wide / large) / (1.0 + ratio**4) ** 0.25)


def _blurred(
    light: Float64Array,
    z: Float64Array,
    sigma_mm: Float64Array,
    axis: int,
    focal: float,
    how: Sampling,
) -> Float64Array:
    """Return one Gaussian along one axis."""
    if axis == 0:
        turned = _blurred(light.swapaxes(0, 1), z.T, sigma_mm.T, 1, focal, how)
        return np.asarray(turned.swapaxes(0, 1))
    there = z > 0.0
    pixel_mm = np.where(there, z, 1.0) / focal
    slant = np.minimum(_slant(z), how.slant_limit * pixel_mm)
    spread = narrowed(sigma_mm / np.hypot(pixel_mm, slant))
    total, weight = light.copy(), np.ones_like(z)
    column = np.arange(z.shape[1], dtype=np.float64)[None, :]
    rows = np.arange(z.shape[0])[:, None]
    last = z.shape[1] - 1
    for t in (*-how.offsets, *how.offsets):
        at = column + t * spread
        nearest = np.clip(np.floor(at + 0.5), 0, last).astype(np.intp)
        other = z[rows, nearest]
        off = np.maximum(np.abs(other - z) - slant * np.abs(nearest - column), 0.0)
        w = np.exp(-0.5 * (t * t + (off / sigma_mm) ** 2)) * (other > 0.0)
        color, known = _sampled(light, there, rows, at)
        w = w * known
        total += w[..., None] * color
        weight += w
    return np.where(there[..., None], total / weight[..., None], 0.0)


def _slant(z: Float64Array) -> Float64Array:
    """Return the smaller change of depth to the neighbors that are there, mm, 0 beside none."""
    step = np.full((z.shape[0], z.shape[1] + 1), np.inf)
    both = (z[:, 1:] > 0.0) & (z[:, :-1] > 0.0)
    step[:, 1:-1] = np.where(both, np.abs(z[:, 1:] - z[:, :-1]), np.inf)
    # beyond the picture's edge the depth is taken as it is at the edge
    step[:, 0] = step[:, -1] = 0.0
    least = np.minimum(step[:, 1:], step[:, :-1])
    return np.where(np.isfinite(least), least, 0.0)


def _sampled(
    light: Float64Array, there: BoolArray, rows: NDArray[np.intp], at: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Return light between columns, (H, W, 3), from the pixels that show a surface."""
    last = light.shape[1] - 1
    low = np.floor(at)
    share = at - low
    a, b = (np.clip(x, 0, last).astype(np.intp) for x in (low, low + 1.0))
    wa, wb = (1.0 - share) * there[rows, a], share * there[rows, b]
    total = wa + wb
    color = wa[..., None] * light[rows, a] + wb[..., None] * light[rows, b]
    known = total > 1e-3
    return color / np.where(known, total, 1.0)[..., None], known
