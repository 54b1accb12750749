"""Find candidate spots in a raw mosaic and fit blurred discs to them."""

import logging
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.optimize import least_squares
from scipy.special import erfc

from capture.arrays import Float64Array
from capture.calibration.fiber.merge import MergedSeries, color_masks

_log = logging.getLogger(__name__)

GrayImage = tuple[Float64Array, Float64Array]
"""Sum of a cell's colors at every pixel, full scales per second, and its variance, (H, W)."""
DiscFit = tuple[Float64Array, Float64Array, float, bool]
"""x, y, radius, edge in pixels, their standard errors, the radius of a disc with the area above
half maximum, and whether the fit converged.
"""

SEARCH_BLUR_PITCH: Final = 0.12
"""Blur of the search for spots, in distances of neighbors."""
SPOT_NOISE_SIGMAS: Final = 8.0
"""Smallest height of a spot above the noise, in standard deviations."""
MIN_SPOT_CONTRAST: Final = 0.3
"""Smallest height of a spot above the light around it, relative."""
BORDER_PITCH: Final = 0.2
"""Border of the image without a search for spots, in distances of neighbors."""
MAX_DISC_EVALUATIONS: Final = 30
MAX_CENTER_STDERR_PITCH: Final = 0.04
"""Largest standard error of a valid position, pixels."""
SPOT_SCATTER: Final = 0.03
"""Scatter of a spot's pixels about a smooth disc, relative."""
SPOT_GRADIENT_PRIOR: Final = 0.1
"""Prior standard deviation of slopes and curvature of the light over a spot, relative."""


def gray_image(merged: MergedSeries, pattern: str) -> GrayImage:
    """Return the sum of a cell's colors at every pixel, and its variance; gaps are filled."""
    values = np.where(merged.valid, merged.rate, merged.smooth)
    # saturated in every frame: brighter than any measured pixel nearby
    if merged.saturated.any():
        top = float(values.max(initial=0.0))
        values = np.where(merged.saturated, max(top, 1e-12), values)
    if pattern == "MONO":
        return values, merged.variance
    total, variance = np.zeros_like(values), np.zeros_like(values)
    padded = np.pad(values, 1, mode="edge")
    noisy = np.pad(merged.variance, 1, mode="edge")
    height, width = values.shape
    # (1 2 1) x (1 2 1) weights each color of a 2 x 2 cell equally, centered on the pixel
    for i, a in enumerate((0.25, 0.5, 0.25)):
        for j, b in enumerate((0.25, 0.5, 0.25)):
            total += a * b * padded[i : i + height, j : j + width]
            variance += (a * b) ** 2 * noisy[i : i + height, j : j + width]
    return total, variance


def find_candidates(image: GrayImage, pitch: float) -> Float64Array:
    """Return maxima above noise and surroundings, brightest first, shape (n, 2)."""
    gray, variance = image
    blur = SEARCH_BLUR_PITCH * pitch
    smooth = gaussian_filter(gray, blur, mode="nearest")
    # noise of the blurred sum over cells, whose neighbors share pixels: at most that of 4 pixels
    noise = np.sqrt(gaussian_filter(variance, blur, mode="nearest") * 4.0) / (2.0 * blur)
    side = 2 * int(0.3 * pitch) + 1
    top = smooth == maximum_filter(smooth, side, mode="nearest")
    lift = round(0.65 * pitch)
    above = np.pad(smooth, ((lift, 0), (0, 0)), mode="edge")[: smooth.shape[0]]
    below = np.pad(smooth, ((0, lift), (0, 0)), mode="edge")[lift:]
    around = np.minimum(above, below)
    is_prominent = (smooth - around > SPOT_NOISE_SIGMAS * noise) & (
        smooth - around > MIN_SPOT_CONTRAST * np.abs(around)
    )
    # at the border the blur doubles the noise
    border = round(BORDER_PITCH * pitch)
    inner = np.zeros_like(top)
    inner[border : top.shape[0] - border, border : top.shape[1] - border] = True
    rows, columns = np.nonzero(top & is_prominent & inner & (smooth > 0))
    order = np.argsort(-smooth[rows, columns], kind="stable")[:200]
    return np.stack([columns, rows], axis=1)[order].astype(np.float64)


def fit_disc(
    merged: MergedSeries, image: GrayImage, pattern: str, position: Float64Array, pitch: float
) -> DiscFit | None:
    """Fit a disc with a blurred edge to the raw mosaic around a position; None without a fit."""
    height, width = merged.rate.shape
    half = int(0.5 * pitch)
    x0, y0 = (round(float(v)) for v in position)
    rows = slice(max(y0 - half, 0), min(y0 + half + 1, height))
    columns = slice(max(x0 - half, 0), min(x0 + half + 1, width))
    if rows.stop - rows.start < half or columns.stop - columns.start < half:
        return None
    y, x = np.mgrid[rows, columns].astype(np.float64)
    good = merged.valid[rows, columns]
    if good.sum() < 50:
        return None
    colors = [mask[rows, columns] & good for mask in color_masks(merged.rate.shape, pattern)]
    value, spread = merged.rate[rows, columns], merged.variance[rows, columns]
    gray = image[0][rows, columns]
    bottom, top = np.quantile(gray, [0.02, 0.98])
    if top <= bottom:
        return None
    area = float((gray > 0.5 * (top + bottom)).sum())
    start_radius = float(np.clip(np.sqrt(area / np.pi), 1.5, 0.5 * pitch))
    order = [np.flatnonzero(mask.ravel()) for mask in colors]
    index = np.concatenate(order)
    color = np.concatenate([np.full(len(part), c) for c, part in enumerate(order)])
    px, py, data = x.ravel()[index], y.ravel()[index], value.ravel()[index]
    levels = np.array(
        [max(float(np.quantile(data[color == c], 0.9)), 0.0) for c in range(len(colors))]
    )
    scale = max(float(levels.max()), 1e-30)
    sigma = np.sqrt(spread.ravel()[index] + (SPOT_SCATTER * levels[color]) ** 2) / scale
    sigma = np.maximum(sigma, 1e-9)
    data = data / scale

    ends = np.cumsum([0, *map(len, order)])
    parts = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    # slopes and curvature of a color have a normal prior with UNEVEN of its level as deviation
    stiff = [
        np.array([0.0, 1.0, 1.0, 1.0, 0.0]) / (SPOT_GRADIENT_PRIOR * max(v / scale, 1e-3))
        for v in levels
    ]

    def misfit(p: Float64Array) -> Float64Array:
        residuals, priors, _ = _solve_colors(p, px, py, data / sigma, sigma, parts, stiff)
        return np.concatenate([*residuals, *priors])

    begin = np.array([*position, start_radius, max(0.1 * start_radius, 0.7)])
    low = np.array([position[0] - 0.5 * pitch, position[1] - 0.5 * pitch, 1.0, 0.2])
    high = np.array(
        [position[0] + 0.5 * pitch, position[1] + 0.5 * pitch, 0.7 * pitch, 0.3 * pitch]
    )
    begin = np.clip(begin, low + 1e-6, high - 1e-6)
    done = least_squares(
        misfit, begin, bounds=(low, high), x_scale=[1, 1, 1, 0.5], max_nfev=MAX_DISC_EVALUATIONS
    )
    amplitude = _solve_colors(done.x, px, py, data / sigma, sigma, parts, stiff)[2]
    at_bound = bool(((done.x <= low + 1e-3) | (done.x >= high - 1e-3))[:2].any())
    if at_bound or amplitude.max() <= 0:
        return None
    error = _standard_errors(done, len(data) - 4 - 5 * len(colors))
    if error is None or error[:2].max() > MAX_CENTER_STDERR_PITCH * pitch:
        return None
    return done.x, error, start_radius, done.status != 0


def _solve_colors(
    disc: Float64Array,
    px: Float64Array,
    py: Float64Array,
    weighted: Float64Array,
    sigma: Float64Array,
    parts: list[slice],
    stiff: list[Float64Array],
) -> tuple[list[Float64Array], list[Float64Array], Float64Array]:
    """Return residuals of each color's best linear model, its priors, and the amplitudes.

    A fiber's modes are not filled evenly: light over the disc has slopes and curvature.
    """
    u, v = (px - disc[0]) / disc[2], (py - disc[1]) / disc[2]
    d = np.hypot(u, v)
    inside = 0.5 * erfc((d - 1.0) * (disc[2] / (np.sqrt(2.0) * disc[3])))
    bend = np.minimum(d, 1.2) ** 2 - 0.5
    design = np.stack([inside, inside * u, inside * v, inside * bend, np.ones_like(inside)])
    residuals, priors = [], []
    amplitude = np.zeros(len(parts))
    for c, at in enumerate(parts):
        rows = design[:, at] / sigma[at]
        normal = rows @ rows.T + np.diag(stiff[c] ** 2)
        ridge = 1e-12 * np.trace(normal) * np.eye(5)
        found = np.linalg.solve(normal + ridge, rows @ weighted[at])
        residuals.append(weighted[at] - found @ rows)
        priors.append((stiff[c] * found)[1:4])
        amplitude[c] = found[0]
    return residuals, priors, amplitude


def _standard_errors(done: Any, freedom: int) -> Float64Array | None:
    """Return the standard errors of a least-squares fit; None when it is not determined."""
    chi2 = 2.0 * done.cost / max(freedom, 1)
    try:
        covariance = np.linalg.inv(done.jac.T @ done.jac) * max(chi2, 1.0)
    except np.linalg.LinAlgError:
        return None
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return error if np.isfinite(error).all() else None


def warn_of_unfinished_fits(fits: Iterable[DiscFit]) -> None:
    """Log one warning with the number of fits that did not converge, if any."""
    unfinished = sum(not fit[3] for fit in fits)
    if unfinished:
        _log.warning(
            "discs of fibers: %d not converged after %d evaluations",
            unfinished,
            MAX_DISC_EVALUATIONS,
        )


def drop_duplicate_fits(fits: list[DiscFit], min_distance: float) -> list[DiscFit]:
    """Return the fits without duplicates of an earlier one."""
    kept: list[DiscFit] = []
    for fit in fits:
        if all(np.hypot(*(fit[0][:2] - other[0][:2])) > min_distance for other in kept):
            kept.append(fit)
    return kept
