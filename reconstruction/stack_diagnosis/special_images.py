"""Images of a stack that no single light made: dark ones, and those under all lights."""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.frame_faults import find_unlit

DARK, FULL_BRIGHT = "dark", "full-bright"
SATURATED_FRACTION = 0.97
"""Of the brightest sample; brighter ones can have lost their ratio to other images."""
MIN_UNSATURATED = 0.1
MAX_RATIO_SPREAD = 0.04
"""Spread of an image's ratio to the mean of the others, over its median: many lights together have
the shading of that mean, whatever the exposure; one light has its own."""
MAX_RELATIVE_SPREAD = 0.25
"""Of the median image's spread: on a flat object one light hardly differs from many."""


def find_special_images(
    gray: Float64Array, inside: BoolArray, *, usable: BoolArray | None = None
) -> dict[int, str]:
    """Return the numbers of dark and full-bright images, from 0, with what they are.

    Parameters
    ----------
    gray
        (N, H, W), linear samples.
    inside
        (H, W), the object.
    usable
        (N, H, W), False for saturated samples; None: all are usable.

    Returns
    -------
    dict
        ``"dark"``: less than a twentieth of the light of the median image (ambient light, lens cap,
        dead light); ``"full-bright"``: shaded as by all lights together, or saturated almost
        everywhere where the others are not.
    """
    if not inside.any():
        return {}
    special = {
        number: DARK
        for one in find_unlit(gray, inside)
        if one.fault in ("empty image", "dead light")
        for number in one.frames
    }
    lit = np.array([number for number in range(len(gray)) if number not in special], np.intp)
    if len(lit) < 3:
        return special
    samples = gray[lit][:, inside]
    clear = np.ones(samples.shape, bool) if usable is None else usable[lit][:, inside]
    bright = samples.max(axis=0) > 0.1 * np.quantile(samples, 0.99)
    spread = _ratio_spreads(samples[:, bright], clear[:, bright])
    limit = min(MAX_RATIO_SPREAD, MAX_RELATIVE_SPREAD * float(np.median(spread)))
    return special | {int(number): FULL_BRIGHT for number in lit[spread < limit]}


def _ratio_spreads(samples: Float64Array, usable: BoolArray) -> Float64Array:
    """Return the spread of each image's ratio to the mean of the others; 0 where saturated."""
    top = SATURATED_FRACTION * float(samples.max())
    total = samples.sum(axis=0)
    spreads = np.zeros(len(samples))
    for number, image in enumerate(samples):
        clear = usable[number] & (image < top)
        if clear.mean() < MIN_UNSATURATED:
            continue
        ratio = image[clear] / np.maximum(total[clear] - image[clear], 1e-12)
        low, middle, high = np.quantile(ratio, (0.16, 0.5, 0.84))
        spreads[number] = 0.5 * (high - low) / max(float(middle), 1e-12)
    return spreads
