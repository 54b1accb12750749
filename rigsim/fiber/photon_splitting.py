"""Choose splitting, roulette and scoring of photons for equal statistics at all fibers.

A photon is kept at a target weight that depends on its distance from the entry and on its depth.
The targets are learned from pilot runs and change the cost of a result, never its expectation.
"""

from math import inf
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array

WINDOW_CELLS: Final = 256
SMOOTHING_CELLS: Final = 8  # to each side
MIN_TRACKS: Final = 50.0
MAX_TRACKS: Final = 30.0
"""Limit of collisions at a distance, as a multiple of the maximum without splitting: where nearly
all light is too deep to be scored, splitting it further is not worth its time."""
FULL_SCORING_OPTICAL_DEPTH: Final = 1.5
"""Optical depth down to which every collision is scored; deeper ones are scored less often, with
more weight."""


def uniform_window(reach_mm: float, farthest_mm: float) -> Float64Array:
    """Return target weights: 1 up to the farthest fiber, larger beyond."""
    s = (np.arange(WINDOW_CELLS + 1) + 0.5) * reach_mm / WINDOW_CELLS
    return np.asarray(np.maximum(1.0, (s / farthest_mm) ** 3))


def adapt_window(
    visited: Float64Array, used: Float64Array, reach_mm: float, farthest_mm: float
) -> Float64Array:
    """Return target weights in proportion to the weight that passes each distance."""
    s = (np.arange(len(used)) + 0.5) * reach_mm / WINDOW_CELLS
    kernel = np.ones(2 * SMOOTHING_CELLS + 1)
    around = np.convolve(np.ones(WINDOW_CELLS), kernel, "same")
    scored, every = (np.convolve(row[:-1], kernel, "same") / around for row in visited)
    tracks = [np.convolve(row[:-1] / used[:-1], kernel, "same") for row in visited]
    edge = min(int(np.searchsorted(s, farthest_mm)), WINDOW_CELLS - 1)
    wanted, peak = _falling(scored[: edge + 1], tracks[0][: edge + 1])
    least, _ = _falling(every[: edge + 1], tracks[1][: edge + 1])
    window = np.ones(len(used))
    window[peak : edge + 1] = np.maximum(wanted, least / MAX_TRACKS)[peak:]
    # Beyond the fibers the fraction of light that returns decreases with distance.
    window[edge:] = window[edge] * (s[edge:] / s[edge]) ** 3
    return window


def _falling(weight: Float64Array, tracks: Float64Array) -> tuple[Float64Array, int]:
    """Return weights by distance over their maximum, and its position.

    Where tracks are too few, weights are extrapolated with a reduced slope: a slope that is too
    steep by chance would split photons for minutes.
    """
    enough = tracks > MIN_TRACKS
    reached = len(enough) if enough.all() else int(np.argmin(enough))
    if reached < 2:
        return np.ones(len(weight)), 0
    peak = int(np.argmax(weight[:reached]))
    relative = weight / weight[peak]
    before = max(peak, reached - 4 * SMOOTHING_CELLS)
    fall = 0.0
    if before < reached - 1:
        fall = np.log(relative[reached - 1] / relative[before]) / (reached - 1 - before)
    further = np.arange(1, len(weight) + 1 - reached)
    relative[reached:] = relative[reached - 1] * np.exp(0.7 * min(fall, 0.0) * further)
    return relative, peak


def transport_depth_mm(table: Float64Array) -> float:
    """Return the depth of light after one transport mean free path (scattered or absorbed)."""
    left = 1.0
    for top, bottom, sigma_t, albedo, g in table[1:-1, :5]:
        turned = sigma_t * (1.0 - albedo * g)
        if turned * (bottom - top) >= left:
            return float(top + left / turned)
        left -= turned * (bottom - top) if turned > 0.0 else 0.0
    bottom = float(table[-1, 0])
    return bottom if bottom < inf else 1.0


def scoring_probabilities(table: Float64Array) -> tuple[Float64Array, float]:
    """Return the probability to score a collision by its depth, and the levels per mm."""
    depths, optical = [0.0], [0.0]
    for row in table[1:-1]:
        if row[2] > 0.0:
            limit = (FULL_SCORING_OPTICAL_DEPTH + 40.0 - row[6]) / row[2]
            if limit <= 0.0:
                break
            depths.append(min(row[1], row[0] + limit))
            optical.append(row[6] + row[2] * (depths[-1] - row[0]))
        elif row[1] < inf:
            depths.append(row[1])
            optical.append(row[6])
    levels = 4096
    per_mm = levels / depths[-1] if depths[-1] > 0.0 else 1.0
    at = np.interp(np.arange(levels) / per_mm, depths, optical)
    return np.exp(np.minimum(FULL_SCORING_OPTICAL_DEPTH - at, 0.0)), per_mm
