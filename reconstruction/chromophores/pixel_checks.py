"""Checks of what goes along with the pixels of a picture."""

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, FloatArray


class ChromophoreError(ValueError):
    """Arguments of the chromophore fit that do not fit each other."""


def usable_colors(colors: FloatArray) -> BoolArray:
    """Return where colors (..., 3) are finite and above 0, (...)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(colors).all(axis=-1) & (colors > 0.0).all(axis=-1))


def checked_mask(valid: ArrayLike, shape: tuple[int, ...]) -> BoolArray:
    """Return a mask of bool of a shape, or raise `ChromophoreError`."""
    given = np.asarray(valid)
    Checks(ChromophoreError).mask("valid", given, shape)
    return given


def broadcast(name: str, given: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return what goes along with pixels broadcast to a shape, or raise `ChromophoreError`."""
    values = np.asarray(given)
    try:
        return np.broadcast_to(values, shape)
    except ValueError as error:
        expected = f"a number or a shape that broadcasts to {shape}"
        raise ChromophoreError(f"{name}: got {values.shape}, expected {expected}") from error


def colors_of(rgb: ArrayLike, *leading: str) -> Float32Array:
    """Return colors as float32, or raise `ChromophoreError` for a shape other than (..., 3).

    Parameters
    ----------
    rgb
        Colors of pixels.
    leading
        Names of the axes before the channels; any by default.
    """
    colors = np.asarray(rgb, dtype=np.float32)
    Checks(ChromophoreError).shape("rgb", colors, (*(leading or ("...",)), 3))
    return colors
