"""Convert masks of wrinkle zones between planes and RGBA textures, and sum them by weight."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import FloatArray
from model.checks import Checks
from model.wrinkles.expressions import WrinkleError

Masks: TypeAlias = FloatArray | Sequence[FloatArray]


def mask_stack(masks: Masks) -> FloatArray:
    """Return masks as (Z, h, w), given so or as RGBA textures (h, w, 4) of four zones each.

    Parameters
    ----------
    masks : ndarray (Z, h, w), ndarray (T, h, w, 4), or sequence of (h, w) or of (h, w, 4)
        Finite; 1 where a zone's weight counts in full.

    Raises
    ------
    WrinkleError
        For other shapes, or a value that is not finite.
    """
    try:
        stack = real_array(np.stack([real_array(one) for one in masks]))
    except ValueError as error:
        raise WrinkleError(f"masks: got arrays of different shapes: {error}") from error
    if stack.ndim == 4 and stack.shape[3] == 4:
        stack = np.moveaxis(stack, 3, 1).reshape(-1, *stack.shape[1:3])
    Checks(WrinkleError).shape("masks", stack, ("zones", "h", "w"), ("textures", "h", "w", 4))
    Checks(WrinkleError).within("masks", stack)
    return stack


def mask_textures(masks: Masks) -> FloatArray:
    """Return masks as RGBA textures (T, h, w, 4), four zones each; unused channels are 0.

    Examples
    --------
    >>> mask_textures(np.ones((8, 2, 3))).shape
    (2, 2, 3, 4)
    """
    stack = mask_stack(masks)
    zones, h, w = stack.shape
    out = np.zeros((math.ceil(zones / 4), 4, h, w), stack.dtype)
    out.reshape(-1, h, w)[:zones] = stack
    return np.ascontiguousarray(np.moveaxis(out, 1, 3))


def zone_strength(masks: FloatArray, sums: FloatArray) -> FloatArray:
    """Return masks (Z, h, w) summed with their zones' weights (Z,): (h, w), float64.

    Interpolation is linear, so one summed map is resampled instead of one per zone.
    """
    if sums.shape[0] != masks.shape[0]:
        last = masks.shape[2] == sums.shape[0]
        hint = "; zones come first: numpy.moveaxis(masks, -1, 0)" if last else ""
        raise WrinkleError(
            f"masks: got shape {masks.shape}, expected ({sums.shape[0]}, h, w), one for each of "
            f"the {sums.shape[0]} zones' weights{hint}"
        )
    return np.tensordot(sums, masks.astype(np.float64, copy=False), axes=1)


def real_array(values: ArrayLike) -> FloatArray:
    """Return float32 arrays as they are, half as float32, and everything else as float64."""
    given = np.asarray(values)
    if given.dtype in (np.float16, np.float32):
        return given.astype(np.float32, copy=False)
    return given.astype(np.float64, copy=False)
