"""Find polarized pairs and gradient patterns that were exchanged, are missing or inconsistent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis.axis_faults import find_axes
from reconstruction.stack_diagnosis.finding import Finding

AXIS_NAMES = ("x", "y", "z")
PATTERN_NAMES = ("full", "x", "y", "z", "-x", "-y", "-z")
SMOOTHING_PX = 1.5
"""Standard deviation of the filter that lowers noise before images are subtracted."""
MIN_LIGHT = 0.2
"""Light over that of the bright samples, below which a sample is not compared."""
MIN_EXCHANGED, EXCHANGED_RATIO = 0.02, 2.0
"""Excess of the crossed over the parallel image in highlights: over the bright level, and over the
opposite excess."""
TAIL_QUANTILE = 0.99
SUM_QUANTILE, MAX_SUM_ERROR = 0.9, 0.05
"""Quantile of the difference of pattern and inverse to the full light, relative, and its limit."""
MIN_PATTERN_LIGHT = 0.1
"""Light of a pattern over the full light, below which it is empty; most have about a half."""


def find_exchanged_pair(
    parallel: FloatArray, crossed: FloatArray, inside: BoolArray
) -> Iterator[Finding]:
    """Yield that the two polarizer states of a photograph are exchanged.

    Surfaces keep the polarization in specular reflection, so that the parallel image is brighter
    in highlights. Frame 0 of the finding is the parallel image, frame 1 the crossed one.

    Parameters
    ----------
    parallel, crossed
        (H, W), linear samples at one exposure.
    inside
        (H, W), the object.

    Raises
    ------
    PhotometricStereoError
        For images or masks of another shape.
    """
    shape = _require_equal_shapes({"parallel": parallel, "crossed": crossed}, inside)
    if not inside.any():
        return
    level = float(np.quantile(np.asarray(parallel)[inside], 0.95)) + float(
        np.quantile(np.asarray(crossed)[inside], 0.95)
    )
    difference = np.reshape(np.subtract(parallel, crossed, dtype=np.float64), shape)
    relative = _smooth(difference, inside)[inside] / max(0.5 * level, 1e-12)
    middle = float(np.median(relative))  # diffuse light of both differs by their exposures
    above = float(np.quantile(relative, TAIL_QUANTILE)) - middle
    below = middle - float(np.quantile(relative, 1.0 - TAIL_QUANTILE))
    if below > max(MIN_EXCHANGED, EXCHANGED_RATIO * above):
        yield Finding(
            "exchanged polarizers", (0, 1),
            f"the crossed image is brighter in highlights, by {below:.1%} of the bright level",
            below, max(MIN_EXCHANGED, EXCHANGED_RATIO * above),
            "exchange the names of the parallel and the crossed image",
        )  # fmt: skip


def find_pattern_faults(images: Mapping[str, FloatArray], inside: BoolArray) -> Iterator[Finding]:
    """Yield gradient patterns that are missing, empty, exchanged or inconsistent.

    A pattern and its inverse add up to the full light. Exchanged axes and signs keep these sums:
    then the moments are not the normals of a surface. Frames of findings count `PATTERN_NAMES`.

    Parameters
    ----------
    images
        (H, W) by the names of `PATTERN_NAMES`, linear samples at one exposure, without dark
        signal; a series without any inverse is complete.
    inside
        (H, W), the object.

    Raises
    ------
    PhotometricStereoError
        For an unknown name, or images of another shape.
    """
    checks = Checks(PhotometricStereoError)
    for name in images:
        checks.require(name in PATTERN_NAMES, "images", repr(name), ", ".join(PATTERN_NAMES))
    _require_equal_shapes(images, inside)
    lacking = list(_find_missing(images, inside))
    yield from lacking
    if lacking or not inside.any() or len(images) < len(PATTERN_NAMES):
        return
    smooth = {
        name: _smooth(np.asarray(image, np.float64), inside) for name, image in images.items()
    }
    errors = _sum_errors(smooth, inside)
    wrong = [axis for axis, error in errors.items() if error > MAX_SUM_ERROR]
    if not wrong:
        yield from _find_turned(smooth, inside)
        return
    found = _find_exchange(smooth, inside)
    if found is not None:
        worst = max(errors.values())
        yield Finding(
            "exchanged patterns", tuple(sorted(PATTERN_NAMES.index(name) for name in found)),
            f"pattern and inverse differ from the full light by {worst:.0%}, and by less than "
            f"{MAX_SUM_ERROR:.0%} with {found[0]} and {found[1]} exchanged",
            worst, MAX_SUM_ERROR, f"exchange the images {found[0]} and {found[1]}",
        )  # fmt: skip
        return
    names = [name for axis in wrong for name in (axis, f"-{axis}")]
    if len(wrong) == len(AXIS_NAMES):  # one image is in all three sums
        names = ["full"]
    worst = max(errors.values())
    yield Finding(
        "inconsistent patterns", tuple(sorted(PATTERN_NAMES.index(name) for name in names)),
        f"pattern and inverse differ from the full light by {worst:.0%}: one of "
        f"{', '.join(names)} has another exposure, or the object moved",
        worst, MAX_SUM_ERROR, f"take {', '.join(names)} again",
    )  # fmt: skip


def _require_equal_shapes(images: Mapping[str, FloatArray], inside: BoolArray) -> tuple[int, ...]:
    checks = Checks(PhotometricStereoError)
    for name, image in images.items():
        checks.shape(name, np.asarray(image), inside.shape)
    return inside.shape


def _find_missing(images: Mapping[str, FloatArray], inside: BoolArray) -> Iterator[Finding]:
    """Yield patterns that are not there, and those without light."""
    series = PATTERN_NAMES if any(name.startswith("-") for name in images) else PATTERN_NAMES[:4]
    for number, name in enumerate(series):
        if name not in images:
            yield Finding(
                "missing pattern", (number,), f"the pattern {name} has no image",
                1.0, 0.5, f"take the pattern {name}, or leave all inverse patterns out",
            )  # fmt: skip
    if not inside.any():
        return
    light = {name: float(np.median(np.asarray(one)[inside])) for name, one in images.items()}
    full = max([*light.values(), 1e-12])
    for name, value in light.items():
        if value < MIN_PATTERN_LIGHT * full:
            yield Finding(
                "empty pattern", (PATTERN_NAMES.index(name),),
                f"the image of {name} has {value / full:.1%} of the full light",
                1.0 - value / full, 1.0 - MIN_PATTERN_LIGHT, f"take the pattern {name} again",
            )  # fmt: skip


def _smooth(image: Float64Array, inside: BoolArray) -> Float64Array:
    import cv2

    weight = cv2.GaussianBlur(inside.astype(np.float64), (0, 0), SMOOTHING_PX)
    blurred = cv2.GaussianBlur(np.where(inside, image, 0.0), (0, 0), SMOOTHING_PX)
    return np.asarray(blurred / np.maximum(weight, 1e-6), np.float64)


def _sum_errors(images: Mapping[str, Float64Array], inside: BoolArray) -> dict[str, float]:
    """Return, by axis, how far pattern and inverse are from the full light, relative to it."""
    full = images["full"]
    lit = inside & (full > MIN_LIGHT * np.quantile(full[inside], 0.95))
    return {
        axis: float(
            np.quantile(
                np.abs(images[axis] + images[f"-{axis}"] - full)[lit]
                / np.maximum(full[lit], 1e-12),
                SUM_QUANTILE,
            )
        )
        for axis in AXIS_NAMES
    }


def _moments(images: Mapping[str, Float64Array]) -> Float64Array:
    """Return unit vectors along the moments of the light, (H, W, 3)."""
    moments = np.stack([images[axis] - images[f"-{axis}"] for axis in AXIS_NAMES], axis=-1)
    return unit_vectors(moments, min_length=1e-9)


def _find_exchange(images: Mapping[str, Float64Array], inside: BoolArray) -> tuple[str, str] | None:
    """Return the two images whose exchange makes all sums right, and the moments normals."""
    right = []
    for one, other in combinations(PATTERN_NAMES, 2):
        tried = dict(images) | {one: images[other], other: images[one]}
        if max(_sum_errors(tried, inside).values()) < MAX_SUM_ERROR:
            turned = bool(list(find_axes(_moments(tried), inside)))
            right.append((turned, one, other))
    return min(right)[1:] if right else None


def _find_turned(images: Mapping[str, Float64Array], inside: BoolArray) -> Iterator[Finding]:
    """Yield the axes whose patterns are exchanged with each other or with their inverse."""
    for one in find_axes(_moments(images), inside):
        read = one.axes or AXIS_NAMES
        axes = sorted({axis for axis, term in zip(AXIS_NAMES, read, strict=True) if term != axis})
        names = [name for axis in axes for name in (axis, f"-{axis}")]
        yield Finding(
            "exchanged patterns", tuple(sorted(PATTERN_NAMES.index(name) for name in names)),
            one.evidence, one.measured, one.limit,
            f"read the patterns (x, y, z) as ({', '.join(read)}); -x is the inverse of x",
        )  # fmt: skip
