"""Images under many lights, reduced to a size at which faults of lights still show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import BoolArray, Float64Array

MAX_SIDE_PX = 160
"""Images are reduced to this size: faults of lights are in all pixels."""
SMOOTHING_PX = 1.5
"""Standard deviation of the filter that lowers noise before images are compared."""


@dataclass(frozen=True, slots=True)
class ReducedStack:
    """Reduced images (N, H, W), which samples are usable, and the object (H, W).

    A pixel is the mean of ``step`` x ``step`` pixels of the images.
    """

    gray: Float64Array
    usable: BoolArray
    inside: BoolArray
    step: int = 1


def reduce_stack(
    gray: Sequence[NDArray[Any]] | NDArray[Any], usable: BoolArray | None, inside: BoolArray
) -> tuple[ReducedStack, Float64Array]:
    """Average blocks of pixels, image by image, and return each image's unusable fraction.

    A block is usable where all of its samples are.
    """
    height, width = inside.shape
    step = max(1, int(np.ceil(max(height, width) / MAX_SIDE_PX)))
    h, w = height // step, width // step

    def blocks(values: NDArray[Any]) -> NDArray[Any]:
        return values[: h * step, : w * step].reshape(h, step, w, step)

    means, good, unusable = np.zeros((len(gray), h, w)), np.zeros((len(gray), h, w), bool), []
    for number, image in enumerate(gray):
        finite = np.isfinite(image)
        kept = finite if usable is None else finite & usable[number]
        means[number] = blocks(np.where(finite, image, 0.0)).mean(axis=(1, 3), dtype=np.float64)
        good[number] = blocks(kept).all(axis=(1, 3))
        unusable.append(1.0 - float(kept[inside].mean()) if inside.any() else 1.0)
    whole = np.asarray(blocks(inside).all(axis=(1, 3)))
    return ReducedStack(means, good, whole, step), np.array(unusable)


def smooth_inside(image: Float64Array, inside: BoolArray) -> Float64Array:
    """Blur an image (H, W) by `SMOOTHING_PX` without the light of pixels that are not inside."""
    import cv2

    weight = cv2.GaussianBlur(inside.astype(np.float64), (0, 0), SMOOTHING_PX)
    blurred = cv2.GaussianBlur(np.where(inside, image, 0.0), (0, 0), SMOOTHING_PX)
    return np.asarray(blurred / np.maximum(weight, 1e-6), np.float64)
