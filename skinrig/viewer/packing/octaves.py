"""Words of a texture whose finest octave is kept coarsely: noise costs most, shows least there."""

import numpy as np

from skinrig.arrays import Float64Array, Int64Array, UInt8Array


def split(values: Float64Array, fine: int) -> tuple[UInt8Array, UInt8Array]:
    """Return words of half as many texels a side, and the steps that the finest octave adds.

    Parameters
    ----------
    values
        Words before they are rounded, 0 to 255, shape (L, H, W, C), H and W even.
    fine
        Words a step.

    Returns
    -------
    coarse, steps : ndarray of uint8
        (L, H/2, W/2, C), and (L, H, W, C) modulo 256; `joined` makes words of them.
    """
    L, H, W, C = values.shape
    means = values.reshape(L, H // 2, 2, W // 2, 2, C).mean(axis=(2, 4))
    coarse = np.rint(means).astype(np.uint8)
    steps = np.rint((values - _doubled(coarse)) / fine).astype(np.int64)
    return coarse, (steps % 256).astype(np.uint8)


def joined(coarse: UInt8Array, steps: UInt8Array, fine: int) -> UInt8Array:
    """Return the words of `split`, (L, H, W, C)."""
    words = _doubled(coarse) + fine * steps.view(np.int8).astype(np.int64)
    return np.clip(words, 0, 255).astype(np.uint8)


def _doubled(coarse: UInt8Array) -> Int64Array:
    """Return twice as many texels a side, interpolated linearly and rounded half up, (L, H, W, C).

    Whole numbers throughout, so that the page comes to the same words.
    """
    c = coarse.astype(np.int64)
    for axis in (1, 2):
        ahead = np.concatenate([c.take([0], axis), c.take(range(c.shape[axis] - 1), axis)], axis)
        behind = np.concatenate([c.take(range(1, c.shape[axis]), axis), c.take([-1], axis)], axis)
        pair = np.stack([3 * c + ahead, 3 * c + behind], axis=axis + 1)
        c = pair.reshape(*(n * (2 if k == axis else 1) for k, n in enumerate(c.shape)))
    return (c + 8) >> 4
