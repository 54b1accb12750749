"""Add wrinkles to a face's normals: partial derivative maps, masked zones, signed weights.

A tangent-space normal n is stored as (n_x/n_z, n_y/n_z), whose sum is that of the summed
displacements: the base map, plus one wrinkle map times the strength of its zones. Frames: +X right,
+Y up, +Z outward; row 0 is the top. For a height h over x right and y up the stored values are
-dh/dx and -dh/dy (the paper drops the sign of the original encoding twice).

Examples
--------
>>> normals = np.array([[[0.6, 0.0, 0.8]]])
>>> encode(normals).round(12).tolist(), decode(encode(normals)).round(12).tolist()
([[[0.75, 0.0]]], [[[0.6, 0.0, 0.8]]])

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1. ISBN 978-1-56881-718-7. Listing 1.1 lost an operator in print:
``mask = weights`` is ``mask *= weights``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from model import texture_resampling as resampling
from model.arrays import BoolArray, FloatArray
from model.checks import Checks
from model.vectors import unit_vectors
from model.wrinkles import kernels
from model.wrinkles.expressions import (
    JIMENEZ2011_TABLE,
    Clamp,
    Table,
    Weights,
    WrinkleError,
    clamp_sums,
    zone_sums,
)
from model.wrinkles.masks import Masks, mask_stack, real_array, zone_strength

ZONE_NAMES = JIMENEZ2011_TABLE.zones
MAX_DERIVATIVE = 1.0
"""Largest derivative in a texture of [0, 1]: slopes of 45 degrees along x and y."""


@dataclass(frozen=True, slots=True)
class EncodedDerivatives:
    """Encoded derivatives with masks of invalid and clamped pixels.

    Attributes
    ----------
    derivatives : ndarray, shape (..., 2)
        n_x/n_z and n_y/n_z; 0 where not valid.
    valid : ndarray of bool, shape (...)
        The normal is finite and points out of the surface (n_z > 0).
    clamped : ndarray of bool, shape (...)
        A derivative was clamped to the limit; valid pixels only.
    clamped_fraction : float
        Fraction of the valid pixels; 0 without any.
    """

    derivatives: FloatArray
    valid: BoolArray
    clamped: BoolArray
    clamped_fraction: float


def encode(normals: ArrayLike, *, limit: float | None = MAX_DERIVATIVE) -> FloatArray:
    """Return partial derivatives of tangent-space normals.

    Parameters
    ----------
    normals : array_like, shape (..., 3)
        +X right, +Y up, +Z outward, of any positive length.
    limit : float, optional
        Derivatives are clamped to [-limit, limit]; None keeps them unchanged.
        :func:`encode_with_report` returns masks of clamped pixels, and 0 in place of NaN.

    Returns
    -------
    ndarray, shape (..., 2)
        Dimensionless; float32 for float32 and float16 normals, float64 otherwise. NaN where a
        normal is not finite, zero, or does not point outward: it has no derivative, and 0 would be
        a flat surface. :func:`decode` gives (0, 0, 0) there.

    Examples
    --------
    >>> encode([[0.6, 0.0, 0.8], [0.0, 0.0, -1.0]]).round(9).tolist()
    [[0.75, 0.0], [nan, nan]]
    """
    report = encode_with_report(normals, limit=limit)
    report.derivatives[~report.valid] = np.nan
    return report.derivatives


def encode_with_report(
    normals: ArrayLike, *, limit: float | None = MAX_DERIVATIVE
) -> EncodedDerivatives:
    """Encode as :func:`encode`, with masks of clamped pixels and of pixels without a derivative.

    Examples
    --------
    >>> report = encode_with_report([[0, 0, 1.0], [0.8, 0, 0.6], [0, 0, -1.0]])
    >>> report.derivatives.tolist(), report.clamped_fraction, report.valid.tolist()
    ([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]], 0.5, [True, True, False])
    """
    n = real_array(normals)
    Checks(WrinkleError).shape("normals", n, ("...", 3))
    if limit is not None:
        Checks(WrinkleError).within("limit", limit, "(0, inf]")
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        d = n[..., :2] / n[..., 2:]
        # an infinite quotient is a slope beyond any limit; without a limit it is not valid
        outward = np.asarray(np.isfinite(n).all(axis=-1) & (n[..., 2] > 0))
        valid = outward if limit is not None else np.asarray(outward & np.isfinite(d).all(axis=-1))
        beyond = np.zeros(valid.shape, np.bool_)
        if limit is not None:
            beyond = np.asarray(valid & (np.abs(d) > limit).any(axis=-1))
            np.clip(d, -limit, limit, out=d)
    d[~valid] = 0.0
    count = int(np.count_nonzero(valid))
    share = float(np.count_nonzero(beyond)) / count if count else 0.0
    return EncodedDerivatives(d, valid, beyond, share)


def decode(derivatives: ArrayLike) -> FloatArray:
    """Return unit normals of partial derivatives.

    Parameters
    ----------
    derivatives : array_like, shape (..., 2)
        n_x/n_z and n_y/n_z, of any size.

    Returns
    -------
    ndarray, shape (..., 3)
        Unit vectors with n_z > 0; (0, 0, 0) where a derivative is not finite.
    """
    d = real_array(derivatives)
    Checks(WrinkleError).shape("derivatives", d, ("...", 2))
    out = np.empty((*d.shape[:-1], 3), d.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.square(d[..., 0]) + np.square(d[..., 1])
        z = 1.0 / np.sqrt(squares + d.dtype.type(1.0))
        np.multiply(d, z[..., None], out=out[..., :2])
        out[..., 2] = z
    lost = np.asarray(~np.isfinite(squares))
    if lost.any():  # squares overflow before derivatives do: scale large ones first
        out[lost] = _decoded_huge(d[lost])
    return out


def _decoded_huge(d: FloatArray) -> FloatArray:
    good = np.asarray(np.isfinite(d).all(axis=-1))
    d = np.where(good[:, None], d, 0.0)
    scale = np.maximum(np.abs(d).max(axis=-1, keepdims=True), d.dtype.type(1.0))
    n = unit_vectors(np.concatenate([d / scale, 1.0 / scale], axis=-1))
    return np.where(good[:, None], n, 0.0)


def to_unit(derivatives: ArrayLike, *, limit: float = MAX_DERIVATIVE) -> FloatArray:
    """Return derivatives in [-limit, limit] as texture values in [0, 1]; 0 becomes 0.5."""
    d = real_array(derivatives)
    Checks(WrinkleError).within("derivatives (of encode)", d, f"[-{limit}, {limit}]")
    return d * d.dtype.type(0.5 / limit) + d.dtype.type(0.5)


def from_unit(values: ArrayLike, *, limit: float = MAX_DERIVATIVE) -> FloatArray:
    """Return the derivatives encoded by texture values in [0, 1] (listing 1.1)."""
    t = real_array(values)
    return (t * t.dtype.type(2.0) - t.dtype.type(1.0)) * t.dtype.type(limit)


@dataclass(frozen=True, slots=True)
class WrinkleLayer:
    """One wrinkle map with its zones, and their weights by expression.

    Attributes
    ----------
    wrinkle : ndarray, shape (h, w, 2)
        Derivatives that a weight of 1 adds to the base; finite.
    masks : ndarray, shape (Z, h, w)
        Or RGBA textures, see :func:`mask_stack`; any resolution.
    table : ExpressionTable or mapping
        Rows of Z weights; an expression that is missing here but in other layers' tables is an
        error, so give it a row of 0.
    stderr : ndarray, shape (h, w, 2), optional
        Standard error of `wrinkle`; None for one that was painted or is ground truth.
    valid : ndarray of bool, shape (h, w), optional
        Where `wrinkle` was measured; elsewhere it is 0. None: everywhere.
    """

    wrinkle: FloatArray
    masks: FloatArray
    table: Table = JIMENEZ2011_TABLE
    stderr: FloatArray | None = None
    valid: BoolArray | None = None

    def __post_init__(self) -> None:
        """Raise for maps of other shapes or with NaN."""
        object.__setattr__(self, "wrinkle", _derivative_map("wrinkle", self.wrinkle, finite=True))
        object.__setattr__(self, "masks", mask_stack(self.masks))
        shape = self.wrinkle.shape
        Checks(WrinkleError).shape("stderr", self.stderr, shape)
        Checks(WrinkleError).shape("valid", self.valid, shape[:2])


def combine(
    base: ArrayLike,
    wrinkle: ArrayLike,
    masks: Masks,
    weights: Weights,
    *,
    clamp: Clamp = "unit",
    table: Table = JIMENEZ2011_TABLE,
) -> FloatArray:
    """Return the normals of a base map with wrinkles (listing 1.1).

    Parameters
    ----------
    base : array_like, shape (..., H, W, 2) or (..., H, W, 3)
        Derivatives of the neutral face, or its normals, which are encoded without a limit.
    wrinkle : array_like, shape (..., h, w, 2) or (..., h, w, 3)
        Derivatives to add, or normals of which they are, at any resolution over the same square;
        read bilinearly, averaged first where finer than the base. Leading axes broadcast with
        those of the base.
    masks : array_like, shape (8, h, w), or two RGBA textures (h, w, 4)
        In the order of `ZONE_NAMES`, at any resolution; the same for all leading axes.
    weights : mapping of str to float, or array_like, shape (8,)
        Any number of blend shapes by name, or the zones' sums.
    clamp : {"unit", "signed"}
        Range of each zone's sum over blend shapes: [0, 1], as in the paper, or [-1, 1].
    table : ExpressionTable or mapping, optional
        Zones' weights of each blend shape.

    Returns
    -------
    ndarray, shape (..., H, W, 3)
        Unit tangent-space normals of the base's type; (0, 0, 0) where the base is not finite
        (or beyond 1e18, whose square overflows float32) or a normal of it points inward.

    Raises
    ------
    WrinkleError
        For shapes that do not fit, and for wrinkles or masks that are not finite.

    Examples
    --------
    >>> base, wrinkle, masks = np.zeros((4, 4, 2)), np.full((2, 2, 2), 0.5), np.ones((8, 1, 1))
    >>> n = combine(base, wrinkle, masks, {"surprise": 1, "anger": 1}, table={
    ...     "surprise": [0.8, 0, 0, 0, 0, 0, 0, 0], "anger": [-0.6, 0, 0, 0, 0, 0, 0, 0]})
    >>> encode(n)[0, 0].round(9).tolist()
    [0.1, 0.1]
    """
    below, above = _derivatives("base", base), _derivatives("wrinkle", wrinkle)
    try:
        lead = np.broadcast_shapes(below.shape[:-3], above.shape[:-3])
    except ValueError:
        raise WrinkleError(
            f"base, wrinkle: got leading axes {below.shape[:-3]} and {above.shape[:-3]}, "
            f"expected ones that broadcast"
        ) from None
    if not lead:
        return combine_layers(below, [WrinkleLayer(above, masks, table)], weights, clamp=clamp)  # type: ignore[arg-type]
    below = np.broadcast_to(below, (*lead, *below.shape[-3:]))
    above = np.broadcast_to(above, (*lead, *above.shape[-3:]))
    out = np.empty((*below.shape[:-1], 3), below.dtype)
    for at in np.ndindex(lead):
        layer = WrinkleLayer(above[at], masks, table)  # type: ignore[arg-type]
        out[at] = combine_layers(below[at], [layer], weights, clamp=clamp)
    return out


def combine_layers(
    base: ArrayLike, layers: Sequence[WrinkleLayer], weights: Weights, *, clamp: Clamp = "unit"
) -> FloatArray:
    """Return the normals of a base map with several wrinkle maps, such as one of a lemon pose.

    Parameters
    ----------
    base : array_like, shape (H, W, 2)
        Derivatives.
    layers : sequence of Layer
        Any number, none included.
    weights : mapping of str to float, or array_like (Z,)
        Blend shapes by name, looked up in each layer's table; or sums that apply to every layer,
        whose numbers of zones must then agree.
    clamp : {"unit", "signed"}

    Returns
    -------
    ndarray, shape (H, W, 3)
    """
    total = _derivative_map("base", base, finite=False)
    if not layers:
        return decode(total)
    for last, layer in zip([False] * (len(layers) - 1) + [True], layers, strict=True):
        strength = zone_strength(layer.masks, clamp_sums(zone_sums(weights, layer.table), clamp))
        shape = (total.shape[0], total.shape[1])
        parts = (
            *to_kernel_planes(np.moveaxis(layer.wrinkle, 2, 0), shape, total.dtype),
            *to_kernel_planes(strength[None], shape, total.dtype),
        )
        if last:
            normals = np.empty((*shape, 3), total.dtype)
            with kernels.choose_thread_count(shape[0] * shape[1]):
                kernels.add_and_normalize(total, *parts, normals)
            return normals
        if total is base or np.shares_memory(total, np.asarray(base)):
            total = total.copy()
        with kernels.choose_thread_count(shape[0] * shape[1]):
            kernels.add(total, *parts)
    raise AssertionError("a last layer returns")


def to_kernel_planes(planes: FloatArray, shape: tuple[int, int], dtype: Any) -> tuple[Any, ...]:
    """Return a texture for the kernels: planes with the base's columns, and row taps.

    Parameters
    ----------
    planes : ndarray, shape (C, h, w)
    shape : (int, int)
        Of the base.
    dtype
        Of the base.

    Returns
    -------
    C planes (h', W), first texel row (H,) int64 and part of the next (H,)
    """
    rows = min(planes.shape[1], shape[0])
    wide = resampling.resample(planes.astype(dtype, copy=False), (rows, shape[1]))
    first, part = resampling.bilinear_taps(rows, shape[0])
    return (*np.ascontiguousarray(wide, dtype), first, part.astype(dtype))


def _derivatives(name: str, values: ArrayLike) -> FloatArray:
    """Return maps of derivatives as they are, and those of normals encoded."""
    d = real_array(values)
    Checks(WrinkleError).shape(name, d, ("...", "H", "W", 2), ("...", "H", "W", 3))
    return encode(d, limit=None) if d.shape[-1] == 3 else d


def _derivative_map(name: str, values: ArrayLike, *, finite: bool) -> FloatArray:
    d = real_array(values)
    if d.ndim != 3 or d.shape[2] != 2 or 0 in d.shape:
        hint = "; encode normals first" if d.ndim == 3 and d.shape[2] == 3 else ""
        raise WrinkleError(f"{name}: got shape {d.shape}, expected (H, W, 2){hint}")
    if finite and not np.isfinite(d).all():
        raise WrinkleError(
            f"{name}: got NaN or infinity, expected finite derivatives, or normals with n_z > 0"
        )
    return np.ascontiguousarray(d)
