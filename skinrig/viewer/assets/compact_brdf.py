"""Fitted lobes small enough for a page: a table with few slabs, how many look-ups, what error.

A coarser table keeps fewer slabs of phi_d and is read by one filtered look-up a four lobes.
Separable factors, the products that a singular value decomposition of each lobe gives, need more
look-ups at the same error, and no fewer numbers where the bound is tight.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 7 (the lobes).
Kautz and McCool 1999, doi:10.1007/978-3-7091-6809-7_24 (separable factors of BRDFs).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from model import merl
from model.brdf import tables as brdf_tables
from model.brdf.tables import NODES_D, NODES_H, NODES_PHI, BrdfBasis
from skinrig.arrays import Float32Array, Float64Array

TRIED_SLABS: Final = (1, 2, 3, 4, 6, 12)
MIN_STRONG_FRACTION: Final = 0.01
"""Values above this share of a lobe's peak count for the error of single values."""
MAX_FORM_ERROR: Final = 0.01
"""Bound on both errors of a table that is chosen, relative."""
LOBES_PER_LOOKUP: Final = 4
"""Lobes that one look-up reads."""


@dataclass(frozen=True, slots=True, eq=False)
class CompactBrdf:
    """Lobes in a table, and what that costs.

    Attributes
    ----------
    slabs : int
        Of phi_d.
    table : ndarray of float64, shape (32, 12, 90, K)
        1/sr, what a page reads back at the nodes of `model.brdf.tables`.
    rms_error, strong_error : float
        See `errors`.
    """

    slabs: int
    table: Float64Array
    rms_error: float
    strong_error: float

    @property
    def lookups(self) -> int:
        """Filtered look-ups for one light, all lobes together."""
        return -(-self.table.shape[-1] // LOBES_PER_LOOKUP)

    @property
    def size_bytes(self) -> int:
        """Bytes before compression: values of 16 bits."""
        return 2 * self.slabs * NODES_D * NODES_H * self.lookups * LOBES_PER_LOOKUP


def chosen(lobes: BrdfBasis) -> CompactBrdf:
    """Return the table with the fewest slabs whose errors are within `MAX_FORM_ERROR`.

    The finest table is off by its 16 bits only, so that one always fits.
    """
    table = lobes.table[..., : lobes.size].astype(np.float64)
    for slabs in TRIED_SLABS:
        back = in_slabs(table, slabs)
        found = CompactBrdf(slabs, back, *errors(back, table))
        if max(found.rms_error, found.strong_error) <= MAX_FORM_ERROR:
            break
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
    kept = found.table[:, :: NODES_PHI // found.slabs].astype(np.float32)
    layers = in_fours(kept)
    return np.ascontiguousarray(layers.transpose(0, 2, 1, 3, 4)).reshape(
        -1, NODES_H, LOBES_PER_LOOKUP
    )


def in_fours(values: Float32Array) -> Float32Array:
    """Return values (..., K) of lobes as layers of four, (L, ..., 4); what fills them up is 0."""
    groups = -(-values.shape[-1] // LOBES_PER_LOOKUP)
    missing = groups * LOBES_PER_LOOKUP - values.shape[-1]
    padded = np.pad(values, (*[(0, 0)] * (values.ndim - 1), (0, missing)))
    split = padded.reshape(*values.shape[:-1], groups, LOBES_PER_LOOKUP)
    return np.ascontiguousarray(np.moveaxis(split, -2, 0))


def errors(back: Float64Array, table: Float64Array) -> tuple[float, float]:
    """Return how far (32, 12, 90, K) values are from a table's, both of the worst lobe.

    Returns
    -------
    rms : float
        RMS difference over that of the lobe, nodes counting by solid angle and both cosines.
    strong : float
        95th percentile of the relative difference where a lobe exceeds `MIN_STRONG_FRACTION` of
        its peak.
    """
    weight = (solid_weight() * _cosines())[..., None]
    off = np.sum(weight * (back - table) ** 2, axis=(0, 1, 2))
    own = np.sum(weight * table**2, axis=(0, 1, 2))
    rms = float(np.sqrt(np.max(np.where(own > 0.0, off / np.maximum(own, 1e-300), 0.0))))
    worst = 0.0
    for k in range(table.shape[-1]):
        one = table[..., k]
        strong = (one > MIN_STRONG_FRACTION * one.max()) & (_cosines() > 0.0)
        if strong.any():
            relative = np.abs(back[..., k] - one)[strong] / one[strong]
            worst = max(worst, float(np.percentile(relative, 95.0)))
    return rms, worst


def solid_weight() -> Float64Array:
    """Return the solid angle of each node up to a factor, (32, 12, 90)."""
    d, _, h = brdf_tables.nodes()
    solid = np.sin(2.0 * d)[:, None, None] * (np.sin(h) * np.gradient(h))
    return np.asarray(np.broadcast_to(solid, (NODES_D, NODES_PHI, NODES_H)))


def _cosines() -> Float64Array:
    """Return the product of the cosines of light and view at the nodes, 0 below the horizon."""
    d, phi, h = np.meshgrid(*brdf_tables.nodes(), indexing="ij")
    light, view = merl.to_directions(h, d, phi)
    mu_l, mu_v = light[..., 2], view[..., 2]
    return np.asarray(np.where((mu_l > 0.0) & (mu_v > 0.0), mu_l * mu_v, 0.0))
