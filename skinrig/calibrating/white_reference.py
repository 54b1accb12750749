"""Check that an image shows a white reference: an even, neutral surface that fills it."""

from typing import Final

import numpy as np

from capture.calibration.sensor.transfer_curve import block_sums
from skinrig.arrays import BoolArray, FloatArray

BLOCKS_ACROSS: Final = 24
"""Blocks along the shorter side of the image; averaging over a block removes the pixel noise."""
MIN_BLOCK_PX: Final = 4
"""Minimum side of a block, px, if three fit into the image: 3 % noise becomes 0.8 %."""
MAX_NEIGHBOR_DIFFERENCE: Final = 0.03
"""Maximum relative difference between a block and the mean of its four neighbors. Light from a lamp
one meter away and lens shading vary slowly: where they fall by 6 % from block to block, this second
difference is 0.4 %. Cheeks, noses, hair and edges give tens of percent."""
MAX_COLOR_DIFFERENCE: Final = 0.1
"""Maximum relative difference of red or blue over green from its median over the image. A white
reference has one color under one illuminant; color shading of a lens adds a few percent."""
MIN_EVEN_FRACTION: Final = 0.8
"""Minimum fraction of the image that must be even; a margin or a holder may fill the rest. One
face that fills a sixth of the image before an even wall, or an eighth in the dark, leaves less."""
MIN_FILLED_FRACTION: Final = 0.95
"""Fraction of the image below which a warning reports a partly filled image: a speck of dust, with
the blocks next to it, takes a hundredth."""


class NoWhiteReferenceError(ValueError):
    """A frame of target "white" that does not show a white reference."""


def even_fraction(rgb: FloatArray, valid: BoolArray) -> float:
    """Return the fraction of an image that is as even and neutral as a lit white reference.

    Parameters
    ----------
    rgb
        Linear camera RGB without dark signal, (H, W, 3), any unit.
    valid
        (H, W); saturated pixels are False and not evaluated.

    Returns
    -------
    float
        From 0 to 1; also 1 if no block can be evaluated, such as in a fully saturated image.

    Notes
    -----
    The image is divided into square blocks. A block is even if its green value differs from the
    mean of its four neighbors by less than `MAX_NEIGHBOR_DIFFERENCE`, and its red and blue over
    green from their medians by less than `MAX_COLOR_DIFFERENCE`. Brightness and color of the light
    are ignored, because the reference measures them.

    Examples
    --------
    >>> light = np.linspace(0.4, 0.8, 96)[:, None, None] * np.array([0.6, 1.0, 0.7])
    >>> tile = np.broadcast_to(light, (96, 144, 3))
    >>> even_fraction(tile, np.ones((96, 144), bool))
    1.0
    """
    shorter = min(valid.shape)
    side = max(shorter // BLOCKS_ACROSS, min(MIN_BLOCK_PX, shorter // 3), 1)
    count = block_sums(valid.astype(np.float64), side)
    evaluated = count >= side * side / 2
    sums = [block_sums(np.where(valid, rgb[..., k], 0.0), side) for k in range(3)]
    mean = np.stack(sums, axis=-1) / np.maximum(count, 1.0)[..., None]
    lit = evaluated & (mean > 0).all(axis=-1)
    # differences of logarithms are relative differences, independent of the light's level
    logs = np.log(np.where(lit[..., None], mean, 1.0))
    inner = np.s_[1:-1, 1:-1]
    cross = (np.s_[2:, 1:-1], np.s_[:-2, 1:-1], np.s_[1:-1, 2:], np.s_[1:-1, :-2])
    whole = evaluated[inner] & np.logical_and.reduce([evaluated[shift] for shift in cross])
    if not whole.any():
        return 1.0
    bright = np.logical_and.reduce([lit[shift] for shift in (inner, *cross)])
    green = logs[..., 1]
    around = sum((green[shift] for shift in cross), np.zeros_like(green[inner])) / len(cross)
    tint = logs[..., (0, 2)] - green[..., None]
    typical = np.median(tint[lit], axis=0) if lit.any() else np.zeros(2)
    even = (np.abs(green[inner] - around) < MAX_NEIGHBOR_DIFFERENCE) & bright
    even &= (np.abs(tint[inner] - typical) < MAX_COLOR_DIFFERENCE).all(axis=-1)
    return float(np.count_nonzero(even & whole) / np.count_nonzero(whole))


def check_white_reference(rgb: FloatArray, valid: BoolArray, image_name: str) -> tuple[str, ...]:
    """Raise unless an image shows a white reference; warn if the reference does not fill it.

    Parameters
    ----------
    rgb, valid
        See `even_fraction`.
    image_name
        Name of the image, for messages.

    Returns
    -------
    tuple of str
        Warnings; empty if the reference fills the image.

    Raises
    ------
    NoWhiteReferenceError
        If less than `MIN_EVEN_FRACTION` of the image is even and neutral.
    """
    even = even_fraction(rgb, valid)
    fraction = f"{100 * even:.0f} % of the image"
    if even < MIN_EVEN_FRACTION:
        raise NoWhiteReferenceError(
            f"sessions: {image_name} does not show a white reference: {fraction} is even and"
            " neutral, expected all; give a session of a reference that fills the image"
            " (`skinrig capture flash --target white`, `skinrig simulate flash --target white`)"
        )
    if even < MIN_FILLED_FRACTION:
        return (
            f"{image_name}: {fraction} is even and neutral; maps will be wrong where the reference"
            " is missing, dirty or shadowed: clean it, fill the image and capture it again",
        )
    return ()
