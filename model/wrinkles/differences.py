"""Add differences of normals to the base normals: the alternative to partial derivatives.

It supports ordinary normal maps and slopes beyond 45 degrees, needs three channels instead of two,
and is exact only for a weight of 1 on its own base: other weights blend normals along a chord
instead of scaling the relief.

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1 (section 1.2.1). ISBN 978-1-56881-718-7
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, FloatArray
from model.checks import Checks
from model.wrinkles import kernels
from model.wrinkles import partial_derivatives as wrinkles
from model.wrinkles.expressions import (
    JIMENEZ2011_TABLE,
    Clamp,
    Table,
    Weights,
    WrinkleError,
    clamp_sums,
    zone_sums,
)
from model.wrinkles.masks import Masks, mask_stack, zone_strength


@dataclass(frozen=True, slots=True)
class NormalDifference:
    """A difference of normals, encoded for a texture of [0, 1].

    Attributes
    ----------
    values : ndarray, shape (h, w, 3)
        0.5 + 0.5 (w - b); 0.5 where not valid.
    valid : ndarray of bool, shape (h, w)
        Both normals are finite and not zero.
    clamped_fraction : float
        Fraction of the valid texels with a component of w - b beyond [-1, 1], as for opposite
        slopes of more than 30 degrees.
    """

    values: FloatArray
    valid: BoolArray
    clamped_fraction: float


def difference_map(base: ArrayLike, wrinkled: ArrayLike) -> NormalDifference:
    """Return the scaled and biased difference of two maps of unit normals.

    Parameters
    ----------
    base, wrinkled : array_like, shape (h, w, 3)
        Unit normals in the same tangent space.

    Examples
    --------
    >>> difference_map([[[0, 0, 1.0]]], [[[0.6, 0, 0.8]]]).values.round(9).tolist()
    [[[0.8, 0.5, 0.4]]]
    """
    b, w = _normals("base", base), _normals("wrinkled", wrinkled)
    Checks(WrinkleError).shape("wrinkled", w, b.shape)
    valid = np.asarray(np.isfinite(b).all(axis=2) & np.isfinite(w).all(axis=2))
    valid &= (b != 0).any(axis=2) & (w != 0).any(axis=2)
    with np.errstate(invalid="ignore"):
        d = np.where(valid[..., None], 0.5 + 0.5 * (w - b), 0.5)
    beyond = valid & ((d < 0) | (d > 1)).any(axis=2)
    count = int(np.count_nonzero(valid))
    share = float(np.count_nonzero(beyond)) / count if count else 0.0
    return NormalDifference(np.clip(d, 0.0, 1.0).astype(b.dtype, copy=False), valid, share)


def combine(
    base: ArrayLike,
    difference: NormalDifference | ArrayLike,
    masks: Masks,
    weights: Weights,
    *,
    clamp: Clamp = "unit",
    table: Table = JIMENEZ2011_TABLE,
    renormalize: bool = True,
) -> FloatArray:
    """Return base normals plus the difference, times the strength of its zones.

    Parameters
    ----------
    base : array_like, shape (H, W, 3)
        Unit normals of the neutral face.
    difference : NormalDifference, or array_like (h, w, 3) in [0, 1]
        At any resolution over the same square.
    masks, weights, clamp, table
        As of `wrinkles.combine`.
    renormalize : bool
        Return unit vectors, as the paper advises for compressed differences; otherwise the sum,
        shorter or longer.

    Returns
    -------
    ndarray, shape (H, W, 3)
        Of the base's type; 0 where the base is not finite or the sum vanishes.
    """
    normals = np.ascontiguousarray(_normals("base", base))
    given = difference.values if isinstance(difference, NormalDifference) else difference
    d = wrinkles.from_unit(_normals("difference", given))
    Checks(WrinkleError).within("difference", d)
    stack = mask_stack(masks)
    sums = clamp_sums(zone_sums(weights, table), clamp)
    shape = (normals.shape[0], normals.shape[1])
    out = np.empty_like(normals)
    with kernels.choose_thread_count(shape[0] * shape[1]):
        kernels.add_difference(
            normals,
            *wrinkles.to_kernel_planes(np.moveaxis(d, 2, 0), shape, normals.dtype),
            *wrinkles.to_kernel_planes(zone_strength(stack, sums)[None], shape, normals.dtype),
            int(renormalize),
            out,
        )
    return out


def _normals(name: str, values: ArrayLike) -> FloatArray:
    n = np.asarray(values)
    n = n if n.dtype in (np.float32, np.float64) else n.astype(np.float64)
    Checks(WrinkleError).shape(name, n, ("H", "W", 3))
    return n
