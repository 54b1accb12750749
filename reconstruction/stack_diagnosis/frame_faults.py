"""Find images that are empty, padded, repeated, clipped or full-bright."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.finding import Finding

MIN_BRIGHTNESS = 0.05
"""Bright samples of an image over the median image's, below which it shows no light."""
MIN_PADDED_FRACTION = 0.03
"""Fraction of an image's rows or columns with one and the same value that counts as padding."""
MIN_EDGE_BRIGHTNESS = 0.3
"""Light of the line next to padding over that of the typical image."""
MAX_CLIPPED_FRACTION = 0.02
"""Fraction of the samples of the object that may be saturated."""
BRIGHT_QUANTILE, MIN_FULL_BRIGHT = 0.8, 2.0
MAX_REPEAT_DIFFERENCE = 0.25
"""Difference of two images over the typical difference of an image to its most similar one."""
MIN_REPEAT_ANGLE_DEG = 2.0
"""Angle between listed lights up to which images may be equal."""


def find_unlit(gray: Float64Array, inside: BoolArray) -> Iterator[Finding]:
    """Yield images without light, and images of which a part is filled with one value."""
    bright = np.array([np.quantile(image[inside], 0.99) for image in gray])
    relative = bright / max(float(np.median(bright)), 1e-12)
    for number in np.flatnonzero(relative < MIN_BRIGHTNESS):
        empty = np.ptp(gray[number]) == 0.0
        fault = "empty image" if empty else "dead light"
        light = f"has {relative[number]:.1%} of the light of the median image"
        what = "has one value everywhere" if empty else light
        yield Finding(
            fault, (int(number),), f"image {number + 1} {what}",
            1.0 - float(relative[number]), 1.0 - MIN_BRIGHTNESS,
            "take the image again, or leave its row of the list out",
        )  # fmt: skip
    lit = relative >= MIN_BRIGHTNESS
    typical = np.median(gray[lit], axis=0) if lit.any() else gray[0]
    for number in np.flatnonzero(lit):
        for axis, name in ((1, "rows"), (0, "columns")):
            padded = _constant_lines(gray[number], typical, inside, axis)
            if padded > MIN_PADDED_FRACTION:
                yield Finding(
                    "padded image", (int(number),),
                    f"{padded:.0%} of the {name} of image {number + 1} have one value",
                    padded, MIN_PADDED_FRACTION,
                    "read the image again: a part of it was lost on its way",
                )  # fmt: skip
                break


def _constant_lines(
    image: Float64Array, typical: Float64Array, inside: BoolArray, axis: int
) -> float:
    """Return the fraction of lines through the object that have one value, other images not.

    The line next to them is as bright as usual: an attached shadow grows dark by degrees.
    """
    crossed = inside.sum(axis=axis) >= 8
    if not crossed.any():
        return 0.0
    low = np.where(inside, image, np.inf).min(axis=axis)
    high = np.where(inside, image, -np.inf).max(axis=axis)
    brightest = np.where(inside, typical, 0.0).max(axis=axis)
    flat = crossed & (low == high) & (low < 0.5 * brightest) & (brightest > 0.05 * typical.max())
    usual = np.where(inside, image, 0.0).sum(axis=axis) > MIN_EDGE_BRIGHTNESS * np.where(
        inside, typical, 0.0
    ).sum(axis=axis)
    lines = np.flatnonzero(flat)
    neighbors = np.concatenate([lines - 1, lines + 1])
    neighbors = neighbors[(neighbors >= 0) & (neighbors < len(flat))]
    edge = neighbors[crossed[neighbors] & ~flat[neighbors]]
    if not edge.size or not usual[edge].any():
        return 0.0
    return float(lines.size / np.count_nonzero(crossed))


def find_full_bright(samples: Float64Array) -> Iterator[Finding]:
    """Yield images that are brighter at most points (N, P) than one light makes them."""
    bright = np.quantile(samples, BRIGHT_QUANTILE, axis=0)
    times = np.median(samples / np.maximum(bright, 1e-12), axis=1)
    for number in np.flatnonzero(times > MIN_FULL_BRIGHT):
        yield Finding(
            "full-bright image", (int(number),),
            f"most points of image {number + 1} have {times[number]:.1f} times the light of their "
            "bright images",
            float(times[number]), MIN_FULL_BRIGHT, "leave the image out: several lights are on",
        )  # fmt: skip


def find_clipped(fraction: Float64Array) -> Iterator[Finding]:
    """Yield the clipping of all images; single ones are named when others are not clipped.

    Parameters
    ----------
    fraction
        (N,), of each image's samples of the object, that are saturated.
    """
    worst = np.flatnonzero(fraction > MAX_CLIPPED_FRACTION)
    if worst.size:
        frames = () if worst.size > len(fraction) // 2 else tuple(int(k) for k in worst)
        yield Finding(
            "clipped images", frames,
            f"up to {fraction.max():.0%} of an image's samples are saturated, in {worst.size} "
            "images",
            float(fraction.max()), MAX_CLIPPED_FRACTION,
            "expose for less light; saturated samples carry no shading",
        )  # fmt: skip


def find_repeated(samples: Float64Array, directions: Float64Array) -> Iterator[Finding]:
    """Yield pairs of images that differ far less than others do whose lights are as far apart.

    Parameters
    ----------
    samples
        (N, P).
    directions
        (N, 3), listed unit vectors.
    """
    n = len(samples)
    unit = samples / np.maximum(np.linalg.norm(samples, axis=1, keepdims=True), 1e-12)
    apart = np.sqrt(np.maximum(2.0 - 2.0 * unit @ unit.T, 0.0)) + 10.0 * np.eye(n)
    typical = float(np.median(apart.min(axis=1)))
    if typical == 0.0:
        yield Finding(
            "repeated images", (), "most images have the same content", 1.0, 0.5,
            "import one image per light",
        )  # fmt: skip
        return
    angle = np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)))
    per_degree = apart / np.maximum(angle, 1e-3)
    alike = (apart < MAX_REPEAT_DIFFERENCE * typical) & (angle > MIN_REPEAT_ANGLE_DEG)
    alike &= per_degree < MAX_REPEAT_DIFFERENCE * np.median(per_degree[angle > 0.0])
    for i, j in np.argwhere(np.triu(alike)):
        yield Finding(
            "repeated image", (int(i), int(j)),
            f"images {i + 1} and {j + 1} differ by {apart[i, j] / typical:.1%} of a typical "
            "difference",
            float(1.0 - apart[i, j] / typical), 1.0 - MAX_REPEAT_DIFFERENCE,
            "one of the two is a copy: find the missing image",
        )  # fmt: skip
