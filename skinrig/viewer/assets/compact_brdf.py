"""Fitted lobes small enough for a page: which form, how many bytes and look-ups, what error.

Two forms stand to choice. A coarser table keeps fewer slabs of phi_d and is read by one filtered
look-up a four lobes. Separable factors are the products that a singular value decomposition of
each lobe gives, theta_h on one side, theta_d and phi_d on the other, of the values or of their
logarithms; they are smaller and need two look-ups a lobe. `measured` says what each costs, `chosen`
takes the smallest that is good enough and needs no more look-ups than that.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 7 (the lobes).
Kautz and McCool 1999, doi:10.1007/978-3-7091-6809-7_24 (separable factors of BRDFs).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from model import merl
from model.brdf import tables as brdf_tables
from model.brdf.tables import NODES_D, NODES_H, NODES_PHI, BrdfBasis
from skinrig.arrays import Float32Array, Float64Array

Form = Literal["table", "factors", "log factors"]

TRIED_SLABS: Final = (1, 2, 3, 4, 6, 12)
TRIED_RANKS: Final = (1, 2, 3, 4, 6, 8)
MIN_STRONG_FRACTION: Final = 0.01
"""Values above this share of a lobe's peak count for the error of single values."""
MAX_FORM_ERROR: Final = 0.01
"""Bound on both errors of a form that is chosen, relative."""
LOBES_PER_LOOKUP: Final = 4
"""Lobes that one look-up reads."""
_MIN_LOG_VALUE: Final = 1e-6  # 1/sr, below which a logarithm is of no use


@dataclass(frozen=True, slots=True, eq=False)
class CompactBrdf:
    """Lobes in one form, and what that costs.

    Attributes
    ----------
    form : {"table", "factors", "log factors"}
    detail : int
        Slabs of phi_d, or rank.
    table : ndarray of float64, shape (32, 12, 90, K)
        1/sr, what a page reads back at the nodes of `model.brdf.tables`.
    numbers : int
        Stored values, of 16 bits each.
    lookups : int
        Filtered look-ups for one light, all lobes together.
    rms_error : float
        RMS difference over that of the lobe, nodes counting by solid angle and both cosines; of
        the worst lobe.
    strong_error : float
        95th percentile of the relative difference where a lobe exceeds `MIN_STRONG_FRACTION` of
        its peak; of the worst lobe.
    """

    form: Form
    detail: int
    table: Float64Array
    numbers: int
    lookups: int
    rms_error: float
    strong_error: float

    @property
    def size_bytes(self) -> int:
        """Bytes before compression."""
        return 2 * self.numbers


def measured(lobes: BrdfBasis) -> tuple[CompactBrdf, ...]:
    """Return every form of some lobes, smallest first.

    Parameters
    ----------
    lobes
        K lobes, 1/sr.

    Examples
    --------
    >>> lobes = brdf_tables.tabulate({"flat": lambda light, view: 0.25 + 0.0 * light[..., 2]})
    >>> [round(one.rms_error, 3) for one in measured(lobes)][:2]
    [0.0, 0.0]
    """
    table = lobes.table[..., : lobes.size].astype(np.float64)
    weight = _solid_weight()
    groups = -(-lobes.size // LOBES_PER_LOOKUP)
    found = []
    for slabs in TRIED_SLABS:
        numbers = slabs * NODES_D * NODES_H * groups * LOBES_PER_LOOKUP
        found.append(_judged("table", slabs, in_slabs(table, slabs), numbers, groups, table))
    for form in ("factors", "log factors"):
        for rank in TRIED_RANKS:
            back = np.stack(
                [_separated(one, weight, rank, form) for one in np.moveaxis(table, -1, 0)], -1
            )
            numbers = lobes.size * rank * (NODES_D * NODES_PHI + NODES_H)
            lookups = 2 * lobes.size * -(-rank // LOBES_PER_LOOKUP)
            found.append(_judged(form, rank, back, numbers, lookups, table))
    return tuple(sorted(found, key=lambda one: one.numbers))


def chosen(lobes: BrdfBasis, bound: float = MAX_FORM_ERROR) -> CompactBrdf:
    """Return the table with the fewest slabs whose errors are within a bound.

    `measured` shows that factors of that error need more look-ups, and no fewer numbers where the
    bound is tight; the finest table is off by its 16 bits only, so that one always fits.
    """
    table = lobes.table[..., : lobes.size].astype(np.float64)
    groups = -(-lobes.size // LOBES_PER_LOOKUP)
    for slabs in TRIED_SLABS:
        numbers = slabs * NODES_D * NODES_H * groups * LOBES_PER_LOOKUP
        found = _judged("table", slabs, in_slabs(table, slabs), numbers, groups, table)
        if max(found.rms_error, found.strong_error) <= bound:
            return found
    return found


def in_slabs(table: Float64Array, slabs: int) -> Float64Array:
    """Return (32, 12, 90, K) with runs of phi_d nodes at their mean over the visible half-space."""
    if slabs not in TRIED_SLABS:
        raise ValueError(f"slabs: got {slabs}, expected one of {', '.join(map(str, TRIED_SLABS))}")
    weight = _cosines()[..., None] + 1e-9
    width = NODES_PHI // slabs
    parts = table.reshape(NODES_D, slabs, width, NODES_H, -1)
    share = weight.reshape(NODES_D, slabs, width, NODES_H, 1)
    mean = (parts * share).sum(axis=2, keepdims=True) / share.sum(axis=2, keepdims=True)
    held = np.asarray(mean, np.float16).astype(np.float64)
    return np.broadcast_to(held, parts.shape).reshape(table.shape)


def atlas(found: CompactBrdf) -> Float32Array:
    """Return a table as an image for one bilinear look-up, (G * slabs * 32, 90, 4).

    Group g of four lobes, slab s, node i of theta_d is row (g * slabs + s) * 32 + i, theta_h goes
    along columns, lobe 4 g + c is channel c. Lobes that fill a group up are 0.
    """
    if found.form != "table":
        raise ValueError(f"form: got {found.form!r}, expected 'table'")
    size = found.table.shape[-1]
    groups = -(-size // LOBES_PER_LOOKUP)
    padded = np.zeros((NODES_D, found.detail, NODES_H, groups * LOBES_PER_LOOKUP), np.float32)
    padded[..., :size] = found.table[:, :: NODES_PHI // found.detail]
    split = padded.reshape(NODES_D, found.detail, NODES_H, groups, LOBES_PER_LOOKUP)
    return np.ascontiguousarray(split.transpose(3, 1, 0, 2, 4)).reshape(
        -1, NODES_H, LOBES_PER_LOOKUP
    )


def _judged(
    form: Form, detail: int, back: Float64Array, numbers: int, lookups: int, table: Float64Array
) -> CompactBrdf:
    weight = (_solid_weight() * _cosines())[..., None]
    axes = (0, 1, 2)
    off = np.sum(weight * (back - table) ** 2, axis=axes)
    own = np.sum(weight * table**2, axis=axes)
    rms = float(np.sqrt(np.max(np.where(own > 0.0, off / np.maximum(own, 1e-300), 0.0))))
    worst = 0.0
    for k in range(table.shape[-1]):
        one = table[..., k]
        strong = (one > MIN_STRONG_FRACTION * one.max()) & (_cosines() > 0.0)
        if strong.any():
            relative = np.abs(back[..., k] - one)[strong] / one[strong]
            worst = max(worst, float(np.percentile(relative, 95.0)))
    return CompactBrdf(form, detail, back, numbers, lookups, rms, worst)


def _separated(one: Float64Array, weight: Float64Array, rank: int, form: str) -> Float64Array:
    """Return (32, 12, 90) of a lobe's first products."""
    shape = (NODES_D * NODES_PHI, NODES_H)
    if form == "log factors":
        u, s, v = np.linalg.svd(
            np.log(np.maximum(one, _MIN_LOG_VALUE)).reshape(shape), full_matrices=False
        )
        return np.asarray(np.exp((u[:, :rank] * s[:rank]) @ v[:rank]).reshape(one.shape))
    # products stay products when rows and columns are weighted, each by its own
    rows = np.sqrt(weight.reshape(shape).mean(axis=1, keepdims=True)) + 1e-6
    columns = np.sqrt(weight.reshape(shape).mean(axis=0, keepdims=True)) + 1e-6
    u, s, v = np.linalg.svd(one.reshape(shape) * rows * columns, full_matrices=False)
    back = (u[:, :rank] * s[:rank]) @ v[:rank] / rows / columns
    return np.asarray(np.maximum(back, 0.0).reshape(one.shape))


def _solid_weight() -> Float64Array:
    d, _, h = brdf_tables.nodes()
    solid = np.sin(2.0 * d)[:, None, None] * (np.sin(h) * np.gradient(h))
    return np.asarray(np.broadcast_to(solid, (NODES_D, NODES_PHI, NODES_H)))


def _cosines() -> Float64Array:
    """Return the product of the cosines of light and view at the nodes, 0 below the horizon."""
    d, phi, h = np.meshgrid(*brdf_tables.nodes(), indexing="ij")
    light, view = merl.to_directions(h, d, phi)
    mu_l, mu_v = light[..., 2], view[..., 2]
    return np.asarray(np.where((mu_l > 0.0) & (mu_v > 0.0), mu_l * mu_v, 0.0))
