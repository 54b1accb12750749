"""Find polarized pairs whose two images were exchanged, or have different exposures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis.finding import Finding
from reconstruction.stack_diagnosis.reduced_stack import smooth_inside

MIN_EXCHANGED, EXCHANGED_RATIO = 0.05, 2.0
"""Excess of the crossed over the parallel image: over the bright level, above what the energies of
two flashes differ by; and over the opposite excess."""
TAIL_QUANTILE, BRIGHT_QUANTILE = 0.99, 0.95
MIN_CHROMA = 0.1
"""Distance of a color from gray over its brightness, from which it shows the exposure."""
MIN_COLORED_FRACTION = 0.2
"""Fraction of the object that must have a color before exposures are compared."""
MAX_EXPOSURE_RATIO = 1.5
"""Ratio of exposures that counts as a fault: a wrong white balance moves the estimate by less."""
EXCHANGED, UNEQUAL = "exchanged polarizers", "unequal exposures"


def find_pair_faults(
    parallel: FloatArray, crossed: FloatArray, inside: BoolArray
) -> Iterator[Finding]:
    """Yield that a pair's two images are exchanged, or differ in exposure.

    Both images have half of the diffuse light. Only the parallel one has specular reflection, and
    is at least as bright as the crossed one everywhere. Specular reflection is white and diffuse
    light is not, so that colors show the ratio of exposures; gray images count as equally exposed.
    Frame 0 of a finding is the parallel image, frame 1 the crossed one.

    Parameters
    ----------
    parallel, crossed
        (H, W), or (H, W, 3) in balanced color; linear samples, black subtracted, any unit.
    inside
        (H, W), the object without saturated samples.

    Raises
    ------
    PhotometricStereoError
        For images of another shape than the mask's.
    """
    checks = Checks(PhotometricStereoError)
    colored = np.ndim(parallel) == 3
    shape = (*inside.shape, 3) if colored else inside.shape
    for name, image in (("parallel", parallel), ("crossed", crossed)):
        checks.shape(name, np.asarray(image), shape)
    if not inside.any():
        return
    a, b = (_smooth_channels(image, inside) for image in (parallel, crossed))
    ratio = _estimate_exposure_ratio(a, b) if colored else None
    limit = np.log(MAX_EXPOSURE_RATIO)
    scale = 1.0
    if ratio is not None and abs(np.log(ratio)) > limit:
        scale = ratio
        yield Finding(
            UNEQUAL, (0, 1),
            f"the colors agree if the parallel image has {ratio:.2f} times the crossed one's "
            f"exposure; else the specular image is off by {abs(ratio - 1.0):.0%} of the crossed "
            "light",
            float(abs(np.log(ratio))), float(limit),
            f"divide the parallel image by {ratio:.2f}, or take both with one exposure",
        )  # fmt: skip
    a, b = a.mean(axis=-1), scale * b.mean(axis=-1)
    level = 0.5 * float(np.quantile(a, BRIGHT_QUANTILE) + np.quantile(b, BRIGHT_QUANTILE))
    relative = (a - b) / max(level, 1e-12)
    above = float(np.quantile(relative, TAIL_QUANTILE))
    below = -float(np.quantile(relative, 1.0 - TAIL_QUANTILE))
    least = max(MIN_EXCHANGED, EXCHANGED_RATIO * above)
    if below > least:
        yield Finding(
            EXCHANGED, (0, 1),
            f"the crossed image is brighter in highlights by {below:.0%} of the bright level: "
            "specular light is then negative, and diffuse light contains the highlights",
            below, least, "exchange the names of the parallel and the crossed image",
        )  # fmt: skip


def _smooth_channels(image: FloatArray, inside: BoolArray) -> Float64Array:
    """Return the smooth samples of the object, (P, C)."""
    channels = np.atleast_3d(np.asarray(image, np.float64))
    smooth = [smooth_inside(channels[..., k], inside)[inside] for k in range(channels.shape[2])]
    return np.stack(smooth, axis=-1)


def _estimate_exposure_ratio(parallel: Float64Array, crossed: Float64Array) -> float | None:
    """Return the parallel image's exposure over the crossed one's; None where all is gray.

    White light does not change the components (P, 3) across gray, which then scale alike.
    """
    across = [one - one.mean(axis=-1, keepdims=True) for one in (parallel, crossed)]
    square = np.sum(across[1] ** 2, axis=-1)
    bright = crossed.mean(axis=-1)
    colored = np.sqrt(square) > MIN_CHROMA * np.maximum(bright, 1e-12)
    colored &= bright > 0.2 * np.quantile(bright, BRIGHT_QUANTILE)
    if colored.mean() < MIN_COLORED_FRACTION:
        return None
    product = np.sum(across[0] * across[1], axis=-1)
    ratio = float(np.median(product[colored] / square[colored]))
    return ratio if ratio > 0.0 else None
