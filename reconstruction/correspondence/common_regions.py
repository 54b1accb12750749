"""Regions of a face, defined in the common map by its landmarks.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.2 (beard and no beard).
"""

from types import MappingProxyType
from typing import Final

import numpy as np

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.correspondence.common_parameterization import CommonFrame

STANDARD_LANDMARKS_MM: Final = MappingProxyType(
    {
        "nose tip": (0.0, 0.0),
        "nose bridge": (0.0, 30.0),
        "nose wing left": (-18.0, -5.0),
        "nose wing right": (18.0, -5.0),
        "eye inner left": (-20.0, 33.0),
        "eye inner right": (20.0, 33.0),
        "eye outer left": (-58.0, 34.0),
        "eye outer right": (58.0, 34.0),
        "upper lip": (0.0, -27.0),
        "lower lip": (0.0, -42.0),
        "mouth corner left": (-32.0, -35.0),
        "mouth corner right": (32.0, -35.0),
        "chin": (0.0, -65.0),
        "jaw left": (-85.0, -45.0),
        "jaw right": (85.0, -45.0),
        "forehead": (0.0, 80.0),
        "cheek left": (-58.0, 0.0),
        "cheek right": (58.0, 0.0),
        "temple left": (-97.0, 55.0),
        "temple right": (97.0, 55.0),
    }
)
"""Twenty landmarks of a face, left and right as seen in the image, with typical positions when it
is unrolled from the tip of its nose, mm; rounded, for faces without landmarks."""

REGION_NAMES: Final = ("face", "beard", "no-beard", "skin")


class RegionError(ValueError):
    """An unknown region."""


def standard_frame(*, side_mm: float, center_mm: tuple[float, float], size: int) -> CommonFrame:
    """Return a common map with the standard landmarks."""
    names = tuple(STANDARD_LANDMARKS_MM)
    places = np.array([STANDARD_LANDMARKS_MM[name] for name in names], np.float64)
    return CommonFrame(names, places, center_mm, side_mm, size)


def region_mask(name: str, frame: CommonFrame) -> BoolArray:
    """Return the pixels of a region, (N, N).

    Parameters
    ----------
    name
        "face" (all), "beard" (upper lip, chin, jaw and lower cheeks without the lips), "no-beard"
        (the rest, down to the height of the chin), or "skin" (all but eyes, brows, nostrils and
        lips).
    frame
        The common map; standard positions replace landmarks that it lacks.

    Raises
    ------
    RegionError
        For an unknown name.
    """
    Checks(RegionError).choice("region", name, REGION_NAMES)
    grid = frame.grid_mm()
    if name == "face":
        return np.ones(grid.shape[:2], np.bool_)
    at = {
        mark: frame.landmark(mark) if mark in frame.names else np.array(place)
        for mark, place in STANDARD_LANDMARKS_MM.items()
    }
    if name == "skin":
        return ~(_lips(at, grid) | _eyes(at, grid) | _nostrils(at, grid))
    beard = _inside(_beard_outline(at), grid) & ~_lips(at, grid)
    if name == "beard":
        return beard
    above = np.asarray(grid[..., 1] >= at["chin"][1], np.bool_)
    return above & ~beard


def _beard_outline(at: dict[str, Float64Array]) -> Float64Array:
    """Return the outline of the region where a beard grows, mm, from the left jaw around."""
    left, right = at["jaw left"], at["jaw right"]
    wing_left, wing_right = at["nose wing left"], at["nose wing right"]
    mouth = 0.5 * (at["mouth corner left"] + at["mouth corner right"])
    below = np.array([0.0, 22.0])
    return np.array(
        [
            (left[0], max(left[1] + 12.0, mouth[1])),
            (0.5 * (left[0] + at["mouth corner left"][0]), mouth[1] + 2.0),
            (at["mouth corner left"][0] - 6.0, mouth[1] + 10.0),
            (wing_left[0], wing_left[1] - 6.0),
            (wing_right[0], wing_right[1] - 6.0),
            (at["mouth corner right"][0] + 6.0, mouth[1] + 10.0),
            (0.5 * (right[0] + at["mouth corner right"][0]), mouth[1] + 2.0),
            (right[0], max(right[1] + 12.0, mouth[1])),
            tuple(right - 0.6 * below),
            (0.4 * right[0], at["chin"][1] - below[1]),
            tuple(at["chin"] - below),
            (0.4 * left[0], at["chin"][1] - below[1]),
            tuple(left - 0.6 * below),
        ]
    )


def _ellipse(middle: Float64Array, half: tuple[float, float], grid: Float64Array) -> BoolArray:
    return np.asarray((((grid - middle) / np.array(half)) ** 2).sum(axis=-1) <= 1.0, np.bool_)


def _eyes(at: dict[str, Float64Array], grid: Float64Array) -> BoolArray:
    """Return the eyes with the brows above them."""
    out = np.zeros(grid.shape[:2], np.bool_)
    for side in ("left", "right"):
        inner, outer = at[f"eye inner {side}"], at[f"eye outer {side}"]
        middle = 0.5 * (inner + outer) + np.array([0.0, 7.0])
        out |= _ellipse(middle, (0.5 * abs(outer[0] - inner[0]) + 8.0, 20.0), grid)
    return out


def _nostrils(at: dict[str, Float64Array], grid: Float64Array) -> BoolArray:
    left, right = at["nose wing left"], at["nose wing right"]
    middle = 0.5 * (left + right) - np.array([0.0, 4.0])
    return _ellipse(middle, (0.5 * abs(right[0] - left[0]), 7.0), grid)


def _lips(at: dict[str, Float64Array], grid: Float64Array) -> BoolArray:
    left, right = at["mouth corner left"], at["mouth corner right"]
    upper, lower = at["upper lip"], at["lower lip"]
    half = 0.5 * abs(right[0] - left[0]) + 2.0, 0.5 * abs(upper[1] - lower[1]) + 4.0
    return _ellipse(0.5 * (upper + lower), half, grid)


def _inside(corners: Float64Array, grid: Float64Array) -> BoolArray:
    """Return the points inside a polygon, by the parity of the edges to the right of them."""
    u, v = grid[..., 0], grid[..., 1]
    inside = np.zeros(u.shape, np.bool_)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (a[1] > v) != (b[1] > v)
        slope = (b[0] - a[0]) / (b[1] - a[1]) if b[1] != a[1] else 0.0
        inside ^= crosses & (u < a[0] + (v - a[1]) * slope)
    return inside
