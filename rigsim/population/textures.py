"""Read, validate and resample the textures of a subject's file."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom
from scipy.sparse import csr_array

from capture.documents import InputError
from model.store import StoreError, read_exr
from rigsim.arrays import Float32Array
from rigsim.subject import pigment
from rigsim.subject.person import SIZE_RANGE

MAP_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "melanin_map": (0.0005, pigment.MAX_MELANIN),
    "hemoglobin_map": (0.0, 0.31),
}
"""Range of each map; that of blood is just below the maximum filling of the vessels, where the
inverse of the fold diverges."""


class SubjectFileError(InputError):
    """A subject that is neither a preset nor a usable file."""


def load_texture(key: str, path: str) -> Float32Array:
    """Load a texture in the file's own size.

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
        Wrong file type or shape, or values out of range.
    """
    low, high = MAP_RANGES[key]
    where = f"{key}: {path}"
    if path.endswith(".npy"):
        values = _npy(key, path)
    elif path.endswith(".exr"):
        try:
            values = read_exr(path)
        except StoreError as error:
            raise SubjectFileError(f"{key}: {error}") from error
        _check_shape(where, values.dtype, values.shape)
    else:
        raise SubjectFileError(f"{where}: got another file type, expected .npy or .exr")
    if not (np.isfinite(values).all() and values.min() >= low and values.max() <= high):
        raise SubjectFileError(
            f"{where}: got {values.min():g} to {values.max():g}, expected finite volume fractions "
            f"from {low:g} to {high:g}"
        )
    return np.asarray(values, np.float32)


def _npy(key: str, path: str) -> NDArray[Any]:
    """Return the array of a .npy file, after its header has been checked."""
    where = f"{key}: {path}"
    try:
        with Path(path).open("rb") as stream:  # np.load also accepts archives of arrays
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0
            if version[0] != 1:
                header = np.lib.format.read_array_header_2_0
            shape, _, dtype = header(stream)
            _check_shape(where, dtype, shape)
            wanted = math.prod(shape) * dtype.itemsize
            there = Path(path).stat().st_size - stream.tell()
            if there < wanted:  # NumPy would allocate all that the header declares
                raise SubjectFileError(
                    f"{where}: got {there} bytes of data, expected {wanted} for {dtype} of shape "
                    f"{shape}; the file was cut short"
                )
            stream.seek(0)
            return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
    except SubjectFileError:
        raise
    except (ValueError, EOFError, OSError) as error:
        raise SubjectFileError(
            f"{where}: got no valid .npy file ({error}), expected one written by numpy.save"
        ) from error


def _check_shape(where: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise if an array is not square, too small or large, or not of real numbers."""
    low, high = SIZE_RANGE
    square = len(shape) == 2 and shape[0] == shape[1]
    if dtype.kind not in "fiu" or not square or not low <= shape[0] <= high:
        raise SubjectFileError(
            f"{where}: got {dtype} of shape {shape}, expected real numbers of shape (N, N), "
            f"N {low} to {high}"
        )


def resample_texture(key: str, path: str, size: int) -> Float32Array:
    """Resample a texture to a number of texels per side.

    Downsampling averages over the area of each texel, which prevents aliasing; upsampling
    interpolates.

    Parameters
    ----------
    key, path
        See `load_texture`.
    size
        Texels per side.

    Returns
    -------
    ndarray of float32
        Shape (size, size), volume fractions.
    """
    values = load_texture(key, path)
    if size < values.shape[0]:
        values = average_areas(values, size)
    elif size > values.shape[0]:
        scale = size / values.shape[0]
        values = zoom(values, scale, order=1, mode="nearest", grid_mode=True)
    return np.ascontiguousarray(values, np.float32)


def average_areas(values: Float32Array, size: int) -> Float32Array:
    """Average a square image over fewer, larger texels, whose edges may cut its own.

    Parameters
    ----------
    values
        Shape (N, N).
    size
        Texels per side of the result, up to N.

    Returns
    -------
    ndarray of float32
        Shape (size, size), of the same mean.

    Examples
    --------
    >>> average_areas(np.array([[0, 2, 0], [2, 8, 2], [0, 2, 0]], np.float32), 1).item()
    1.7777777910232544
    """
    many = values.shape[0]
    # row i holds the weight of each of the file's texels in texel i of the result
    edges = np.linspace(0.0, many, size + 1)
    first = np.floor(edges[:-1]).astype(int)
    width = math.ceil(many / size) + 1
    column = first[:, None] + np.arange(width)
    overlap = np.minimum(column + 1, edges[1:, None]) - np.maximum(column, edges[:-1, None])
    share = np.where(column < many, np.maximum(overlap, 0.0), 0.0) * (size / many)
    row = np.repeat(np.arange(size), width)
    at = (row, np.minimum(column, many - 1).ravel())
    weights = csr_array((share.ravel().astype(np.float32), at), shape=(size, many))
    means = (weights @ (weights @ values).T).T
    # a mean is within the range of its values; in single precision it may exceed it slightly
    return np.asarray(np.clip(means, values.min(), values.max()), np.float32)
