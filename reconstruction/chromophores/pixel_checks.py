"""Checks of what goes along with the pixels of a picture."""

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import BoolArray, FloatArray


class ChromophoreError(ValueError):
    """Arguments of the chromophore fit that do not fit each other."""


def usable_colors(colors: FloatArray) -> BoolArray:
    """Return where colors (..., 3) are finite and above 0, (...)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(colors).all(axis=-1) & (colors > 0.0).all(axis=-1))


def checked_mask(valid: ArrayLike, shape: tuple[int, ...]) -> BoolArray:
    """Return a mask of bool of a shape, or raise `ChromophoreError`."""
    given = np.asarray(valid)
    if given.dtype != np.bool_ or given.shape != shape:
        raise ChromophoreError(
            f"valid: expected bool of shape {shape}, got {given.dtype} of {given.shape}"
        )
    return given


def broadcast_variance(variance: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return a variance broadcast to the shape of the colors, or raise `ChromophoreError`."""
    values = np.asarray(variance)
    try:
        return np.broadcast_to(values, shape)
    except ValueError as error:
        raise ChromophoreError(
            f"variance: expected a shape that broadcasts to {shape}, got {values.shape}"
        ) from error
