"""Textures that a subject's file names: read, checked, and brought to a scene's texels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from scipy.ndimage import zoom

from capture.documents import InputError
from rigsim import pigment
from rigsim.mesh import Float32Array
from rigsim.subject import SIZE_RANGE

MAP_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "melanin_map": (0.0005, pigment.MELANIN_LIMIT), "hemoglobin_map": (0.0, 0.31),
}  # fmt: skip
"""Of blood just below the limit that vessels fill at most, where the compartments would be
without end."""


class SubjectFileError(InputError):
    """A subject that is neither a preset nor a file that can be used."""


def load(key: str, path: str) -> Float32Array:
    """Return a texture as its file has it.

    Parameters
    ----------
    key
        One of `MAP_RANGES`.
    path
        A file .npy or .exr.

    Returns
    -------
    ndarray of float32
        Shape (N, N), volume fractions, row 0 is the top (v = 1).

    Raises
    ------
    SubjectFileError
        It is no such file, of another shape, or out of range.
    """
    low, high = MAP_RANGES[key]
    where = f"{key}: {path}"
    if path.endswith(".npy"):
        try:
            with Path(path).open("rb") as stream:  # np.load takes archives of arrays, too
                values = np.lib.format.read_array(stream, allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise SubjectFileError(f"{where}: is no .npy file ({error})") from error
    elif path.endswith(".exr"):
        from model.store import StoreError, read_exr

        try:
            values = read_exr(path)
        except StoreError as error:
            raise SubjectFileError(f"{key}: {error}") from error
    else:
        raise SubjectFileError(f"{where}: expected a file .npy or .exr")
    side = f"{SIZE_RANGE[0]} to {SIZE_RANGE[1]}"
    if (
        values.dtype.kind not in "fiu" or values.ndim != 2 or values.shape[0] != values.shape[1]
        or not SIZE_RANGE[0] <= values.shape[0] <= SIZE_RANGE[1]
    ):  # fmt: skip
        raise SubjectFileError(
            f"{where}: got {values.dtype} of shape {values.shape}, expected real numbers of shape "
            f"(N, N), N {side}"
        )
    if not (np.isfinite(values).all() and values.min() >= low and values.max() <= high):
        raise SubjectFileError(
            f"{where}: got {values.min():g} to {values.max():g}, expected finite volume fractions "
            f"from {low:g} to {high:g}"
        )
    return np.asarray(values, np.float32)


def texture(key: str, path: str, size: int) -> Float32Array:
    """Return a texture of so many texels a side, interpolated between the file's."""
    values = load(key, path)
    if values.shape[0] != size:
        scale = size / values.shape[0]
        values = zoom(values, scale, order=1, mode="nearest", grid_mode=True)
    return np.ascontiguousarray(values, np.float32)
