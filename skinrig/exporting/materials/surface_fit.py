"""Fit a single GGX lobe to mixtures of basis BRDFs, as material formats have one lobe.

Least squares over the directions of the basis grid up to 60 degrees of half angle between light and
view. Weights are solid angle times both cosines, over the mean lobe, so that neither the peak nor
the tail dominates. The squared error of a mixture w is w' G w - 2 s w' c + s^2 g with products G,
c, g that are computed once; a texel costs K (K + 69) products.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model import merl
from model.brdf import microfacet
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from skinrig.arrays import BoolArray, Float32Array, Float64Array

ROUGHNESS_NODES: Final = np.linspace(0.15, 1.0, 69)
"""Candidates of roughness, the square root of the slope width alpha."""
TEXELS_PER_FIT: Final = 1 << 15
"""Texels per batch; 69 sums per texel are in memory."""
MIN_FIT_COSINE: Final = 0.2
MAX_THETA_D: Final = np.deg2rad(60.0)
"""Maximum half angle between light and view.

At grazing angles, one lobe of a smooth dielectric's index cannot follow a mixture; fitting them
would increase the errors at normal incidence.
"""
LOBE_FLOOR_FRACTION: Final = 0.03
"""Offset of the mean lobe in the weights, fraction of its maximum; it limits far tails."""
STRIDE_D, STRIDE_PHI, STRIDE_H = 2, 3, 2
"""Strides over the nodes of the grid: the lobes are smooth, and 3 000 directions suffice."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """One fitted GGX lobe per texel.

    Attributes
    ----------
    roughness : ndarray of float32, shape (H, W)
        Square root of GGX's alpha, as in OpenPBR and glTF.
    weight : ndarray of float32, shape (H, W)
        Factor of the reflection of a smooth dielectric of the given index; not clipped.
    misfit : ndarray of float32, shape (H, W)
        Weighted RMS of the residual over that of the mixture.
    """

    roughness: Float32Array
    weight: Float32Array
    misfit: Float32Array


def fit_ggx_lobe(lobes: BrdfBasis, weights: ArrayLike, *, eta: float) -> SurfaceFit:
    """Fit roughness and weight of a GGX lobe to mixtures of basis BRDFs.

    Parameters
    ----------
    lobes
        K tables, 1/sr, with Fresnel reflection included.
    weights
        Weights, (H, W, K), at least 0.
    eta
        Refractive index over that of air.

    Returns
    -------
    SurfaceFit
        Texels without surface reflection have weight 0 and roughness 1.
    """
    share = np.asarray(weights)
    products = _products(lobes, eta)
    flat = share.reshape(-1, share.shape[-1])
    found = np.empty((3, len(flat)), np.float32)
    for start in range(0, len(flat), TEXELS_PER_FIT):
        part = slice(start, start + TEXELS_PER_FIT)
        found[:, part] = _fit(flat[part].astype(np.float64), *products)
    roughness, weight, misfit = found.reshape(3, *share.shape[:-1])
    return SurfaceFit(roughness, weight, misfit)


def _fit(
    weights: Float64Array, gram: Float64Array, cross: Float64Array, ggx_norm: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return roughness, weight and misfit of N mixtures from the products of `_products`."""
    energy = np.einsum("...k,kl,...l->...", weights, gram, weights)
    along = weights @ cross  # (N, R)
    explained = np.maximum(along, 0.0) ** 2 / ggx_norm
    best = np.argmax(explained, axis=-1)
    inner = np.clip(best, 1, len(ROUGHNESS_NODES) - 2)

    def at(offset: int) -> Float64Array:
        return np.take_along_axis(explained, (inner + offset)[..., None], axis=-1)[..., 0]

    below, here, above = at(-1), at(0), at(1)
    bend = below - 2.0 * here + above
    curved = bend < -1e-12 * np.maximum(here, 1e-30)
    shift = np.where(curved, 0.5 * (below - above) / np.where(curved, bend, -1.0), 0.0)
    place = np.where(best == inner, inner + np.clip(shift, -0.5, 0.5), best)
    nodes = np.arange(len(ROUGHNESS_NODES))
    roughness = np.interp(place, nodes, ROUGHNESS_NODES)
    low = np.clip(np.floor(place).astype(np.intp), 0, len(ROUGHNESS_NODES) - 2)
    part = place - low

    def between(table: Float64Array) -> Float64Array:
        return (1.0 - part) * np.take_along_axis(table, low[..., None], -1)[..., 0] + (
            part * np.take_along_axis(table, (low + 1)[..., None], -1)[..., 0]
        )

    scale = np.maximum(between(along / ggx_norm), 0.0)
    left = np.maximum(energy - np.maximum(here, explained.max(axis=-1)), 0.0)
    dark = energy <= 1e-30
    misfit = np.sqrt(left / np.where(dark, 1.0, energy))
    return (np.where(dark, 1.0, roughness), np.where(dark, 0.0, scale), np.where(dark, 0.0, misfit))


def evaluate_ggx(roughness: float, eta: float) -> Float64Array:
    """Evaluate GGX of a roughness at the directions of the sums, 1/sr, shape (N,)."""
    return microfacet.brdf(*_directions()[0], roughness=roughness**2, eta=eta, kind="ggx")


def _products(lobes: BrdfBasis, eta: float) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return weighted products: lobe-lobe (K, K), lobe-GGX (K, R), GGX-GGX (R,)."""
    _, solid, keep = _directions()
    table = lobes.table[::STRIDE_D, ::STRIDE_PHI, ::STRIDE_H, : lobes.size]
    values = table.reshape(-1, lobes.size)[keep].astype(np.float64)
    mean = values.mean(axis=1)
    weight = solid / (mean + LOBE_FLOOR_FRACTION * mean.max(initial=1e-12))
    model = np.stack([evaluate_ggx(float(r), eta) for r in ROUGHNESS_NODES], axis=1)
    scaled = values * weight[:, None]
    return values.T @ scaled, scaled.T @ model, np.sum(weight[:, None] * model**2, axis=0)


@lru_cache(maxsize=1)
def _directions() -> tuple[tuple[Float64Array, ...], Float64Array, BoolArray]:
    """Return cosines of light, view, half vector and difference angle at the used nodes.

    Also return the solid angle times both cosines per node, up to a factor, and the used nodes.
    """
    d, phi, h = brdf_tables.grid_nodes()
    picked = np.meshgrid(d[::STRIDE_D], phi[::STRIDE_PHI], h[::STRIDE_H], indexing="ij")
    theta_d, phi_d, theta_h = (axis.reshape(-1) for axis in picked)
    light, view = (w[:, 2] for w in merl.to_directions(theta_h, theta_d, phi_d))
    keep = (light > MIN_FIT_COSINE) & (view > MIN_FIT_COSINE) & (theta_d <= MAX_THETA_D)
    light, view, theta_d, theta_h = light[keep], view[keep], theta_d[keep], theta_h[keep]
    # nodes are uniform in sqrt(theta_h), so that d theta_h is proportional to sqrt(theta_h)
    solid = np.sin(2.0 * theta_d) * np.sin(theta_h) * np.sqrt(np.maximum(theta_h, 0.0))
    solid = solid * np.clip(light, 0.0, 1.0) * np.clip(view, 0.0, 1.0)
    return (light, view, np.cos(theta_h), np.cos(theta_d)), solid, keep
