"""Whether a picture shows a white tile: one even, neutral surface, and not a face."""

from typing import Final

import numpy as np

from capture.calibration.sensor.transfer_curve import block_sums
from skinrig.arrays import BoolArray, FloatArray

BLOCKS_ACROSS: Final = 24
"""Along the shorter side of the picture; the noise of a pixel is averaged away in them."""
MIN_BLOCK_PX: Final = 4
"""Pixels a side of a square, where a picture has room for three: 3 % noise becomes 0.8 %."""
MAX_NEIGHBOR_DIFFERENCE: Final = 0.03
"""Most that a block may differ from its four neighbors' mean, relative. Light of a lamp a metre
away and the shading of a lens change over much of the field: even where they fall by 6 % from block
to block they bend by 0.4 %. Cheeks, noses, hair and edges bend by tens of percent."""
MAX_COLOR_DIFFERENCE: Final = 0.1
"""Most that red or blue over green may differ from its median over the field, relative. A tile has
one color under one kind of light, of which a lens that tints its corners leaves a few percent."""
MIN_EVEN_FRACTION: Final = 0.8
"""Share of the picture that must be even: a tile may leave a margin, or a holder cover one. A
face that takes a sixth of the picture before an even wall leaves less, in the dark an eighth."""
MIN_FILLED_FRACTION: Final = 0.95
"""Share of the picture below which a tile is said not to fill it: a speck of dust, with the squares
that border on it, is a hundredth."""


class NoWhiteReferenceError(ValueError):
    """A frame that is to show a white tile and shows something else."""


def even_fraction(rgb: FloatArray, valid: BoolArray) -> float:
    """Return the share of a picture that is as even and as neutral as a lit white tile.

    Parameters
    ----------
    rgb
        Linear camera RGB without dark signal, (H, W, 3), any unit.
    valid
        (H, W); saturated pixels are False and not judged.

    Returns
    -------
    float
        From 0 to 1; 1 too where nothing can be judged, such as a picture saturated all over.

    Notes
    -----
    The picture is cut into squares. Such a one is even where its green light differs from the mean
    of its four neighbors by less than `MAX_NEIGHBOR_DIFFERENCE`, and its red and blue over green
    from those of the median square by less than `MAX_COLOR_DIFFERENCE`. How bright it is and which
    color the light has play no part: both are what a white tile is to tell.

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
    judged = count >= side * side / 2
    sums = [block_sums(np.where(valid, rgb[..., k], 0.0), side) for k in range(3)]
    mean = np.stack(sums, axis=-1) / np.maximum(count, 1.0)[..., None]
    lit = judged & (mean > 0).all(axis=-1)
    logs = np.log(np.where(lit[..., None], mean, 1.0))
    inner = np.s_[1:-1, 1:-1]
    cross = (np.s_[2:, 1:-1], np.s_[:-2, 1:-1], np.s_[1:-1, 2:], np.s_[1:-1, :-2])
    whole = judged[inner] & np.logical_and.reduce([judged[place] for place in cross])
    if not whole.any():
        return 1.0
    bright = np.logical_and.reduce([lit[place] for place in (inner, *cross)])
    green = logs[..., 1]
    around = sum((green[place] for place in cross), np.zeros_like(green[inner])) / len(cross)
    tint = logs[..., (0, 2)] - green[..., None]
    usual = np.median(tint[lit], axis=0) if lit.any() else np.zeros(2)
    even = (np.abs(green[inner] - around) < MAX_NEIGHBOR_DIFFERENCE) & bright
    even &= (np.abs(tint[inner] - usual) < MAX_COLOR_DIFFERENCE).all(axis=-1)
    return float(np.count_nonzero(even & whole) / np.count_nonzero(whole))


def check_white_reference(rgb: FloatArray, valid: BoolArray, image_name: str) -> tuple[str, ...]:
    """Refuse a picture of something else than a white tile, and tell of one it does not fill.

    Parameters
    ----------
    rgb, valid
        As of `even_fraction`.
    what
        What the picture is called.

    Returns
    -------
    tuple of str
        What is wrong with it; empty where nothing is.

    Raises
    ------
    NoTileError
    """
    even = even_fraction(rgb, valid)
    share = f"{100 * even:.0f} % of the picture"
    if even < MIN_EVEN_FRACTION:
        raise NoWhiteReferenceError(
            f"sessions: {image_name} shows no white tile: {share} is even and neutral, expected"
            f" all of"
            " it; give a session of a tile that fills the picture (`skinrig capture flash"
            " --target white`, `skinrig simulate flash --target white`)"
        )
    if even < MIN_FILLED_FRACTION:
        return (
            f"{image_name}: {share} is even and neutral; where the tile does not reach, or is"
            f" dirty or"
            " shadowed, maps will be wrong",
        )
    return ()
