"""Resample textures over the unit square: bilinear interpolation and area averaging.

Texel i of n covers [i/n, (i + 1)/n] of the square, its center at (i + 1/2)/n; beyond the outer
centers the edge texel is repeated, as by a graphics sampler with clamping.
"""

from typing import Any

import numpy as np
from scipy import sparse

from model.arrays import Float64Array, FloatArray, Int64Array
from model.checks import Checks


def bilinear_taps(texels: int, pixels: int) -> tuple[Int64Array, Float64Array]:
    """Return each pixel's first texel and the weight of the next one, for linear interpolation.

    Parameters
    ----------
    texels, pixels : int
        Numbers of texels and of pixels over the same length, each >= 1.

    Examples
    --------
    >>> first, part = bilinear_taps(2, 4)
    >>> first.tolist(), part.tolist()
    ([0, 0, 0, 1], [0.0, 0.25, 0.75, 0.0])
    """
    Checks().within("texels, pixels", (texels, pixels), "[1, inf)")
    place = np.clip((np.arange(pixels) + 0.5) * texels / pixels - 0.5, 0.0, texels - 1.0)
    first = np.floor(place).astype(np.int64)
    return first, place - first


def reading_matrix(texels: int, pixels: int) -> Any:
    """Return the sparse matrix that interpolates `texels` linearly at `pixels`; rows sum to 1."""
    first, part = bilinear_taps(texels, pixels)
    rows = np.arange(pixels)
    after = np.minimum(first + 1, texels - 1)
    values = np.concatenate([1.0 - part, part])
    places = (np.concatenate([rows, rows]), np.concatenate([first, after]))
    return sparse.csr_array((values, places), shape=(pixels, texels))


def averaging_matrix(pixels: int, texels: int) -> Any:
    """Return the sparse matrix that averages `pixels` over each of `texels`; rows sum to 1."""
    Checks().within("pixels, texels", (pixels, texels), "[1, inf)")
    edges = np.arange(texels + 1) * (pixels / texels)
    values, rows, columns = [], [], []
    for i in range(texels):
        inside = np.arange(int(edges[i]), min(int(np.ceil(edges[i + 1] - 1e-9)), pixels))
        share = np.minimum(inside + 1, edges[i + 1]) - np.maximum(inside, edges[i])
        values.append(share / share.sum())
        rows.append(np.full(inside.size, i))
        columns.append(inside)
    places = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array((np.concatenate(values), places), shape=(texels, pixels))


def resample(texture: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return a texture at another resolution: averaged where finer, interpolated where coarser.

    Parameters
    ----------
    texture : ndarray, shape (..., h, w)
        Floating point numbers of any precision, finite; channels lead.
    shape : (int, int)
        Rows and columns wanted.

    Returns
    -------
    ndarray, shape (..., *shape)
        Of the texture's type.

    Raises
    ------
    ValueError
        For a texture that is empty or not of floats, and for a shape without pixels.

    Examples
    --------
    >>> resample(np.arange(4.0)[None], (1, 2)).tolist()
    [[0.5, 2.5]]
    """
    given = np.asarray(texture)
    real = np.issubdtype(given.dtype, np.floating)
    Checks().require(real, "texture", given.dtype, "floating point numbers")
    Checks().shape("texture", given, ("...", "h", "w"))
    Checks().numbers("shape", shape, (2,), interval="[1, inf)")
    # sparse matrices do not support float16: sum in float32
    out = given.astype(np.promote_types(given.dtype, np.float32), copy=False)
    for axis, pixels in ((-2, shape[0]), (-1, shape[1])):
        texels = out.shape[axis]
        if texels != pixels:
            finer = texels > pixels
            matrix = averaging_matrix(texels, pixels) if finer else reading_matrix(texels, pixels)
            moved = np.moveaxis(out, axis, 0)
            flat = matrix.astype(out.dtype) @ moved.reshape(texels, -1)
            out = np.moveaxis(flat.reshape(pixels, *moved.shape[1:]), 0, axis)
    return out.astype(given.dtype, copy=False)
