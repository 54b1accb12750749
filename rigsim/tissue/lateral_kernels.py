"""Lateral scattering kernels of skin per channel, and their fit by sums of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls

from rigsim.arrays import Float64Array

GAUSSIAN_SIGMAS_MM = (0.004, 0.01, 0.025, 0.06, 0.15, 0.35, 0.8, 1.8, 4.0)
"""Default widths for `LateralKernels.gaussians`, common to all channels and all skins."""


SIGMAS_MM: Final = (0.02, 0.06, 0.15, 0.35, 0.8, 1.8, 4.0)
"""Widths of the Gaussians fitted to the lateral profiles, mm."""


@dataclass(frozen=True, slots=True)
class GaussianSum:
    """Isotropic Gaussians of common widths whose weighted sum approximates each channel's kernel.

    ``K(r) = sum_k weights[k] exp(-r^2 / (2 sigma_k^2)) / (2 pi sigma_k^2)``, each channel's
    weights sum to 1.
    """

    sigmas_mm: Float64Array
    """Standard deviations along one axis in mm, shape (k,)."""
    weights: Float64Array
    """Non-negative weights, shape (channels, k)."""
    worst_encircled: Float64Array
    """Largest error of the encircled fraction over all radii, shape (channels,)."""


@dataclass(frozen=True, slots=True)
class LateralKernels:
    """Radial densities of the exit points of light that entered at a point, normalized to 1."""

    ring_edges_mm: Float64Array
    """Edges of the rings in mm, shape (n + 1,)."""
    radius_mm: Float64Array
    """Radius of each ring in mm that halves its area, shape (n,)."""
    density_per_mm2: Float64Array
    """Mean density in each ring in 1/mm^2, shape (channels, n); times ring area it sums to 1."""
    encircled: Float64Array
    """Fraction within the outer edge of each ring, in [0, 1], shape (channels, n)."""
    rms_mm: Float64Array
    """Root mean square radius in mm, shape (channels,); per axis it is that over sqrt(2)."""

    @classmethod
    def from_rings(cls, ring_edges_mm: ArrayLike, rings: ArrayLike) -> LateralKernels:
        """Build kernels from light counted in rings.

        Parameters
        ----------
        ring_edges_mm
            Increasing radii in mm, shape (n + 1,), finite.
        rings
            Light in each ring, any unit, >= 0, shape (channels, n).

        Raises
        ------
        ValueError
            When the shapes disagree or a channel has no light.

        Examples
        --------
        >>> disc = LateralKernels.from_rings([0.0, 1.0, 2.0], [[0.25, 0.75]])
        >>> disc.density_per_mm2.round(4).tolist(), disc.rms_mm.round(4).tolist()
        ([[0.0796, 0.0796]], [1.4142])
        """
        edges = np.asarray(ring_edges_mm, dtype=np.float64)
        light = np.asarray(rings, dtype=np.float64)
        if light.ndim != 2 or light.shape[1] != edges.size - 1:
            raise ValueError(
                f"rings: expected shape (channels, {edges.size - 1}), got {light.shape}"
            )
        total = light.sum(axis=1, keepdims=True)
        if not (np.all(light >= 0.0) and np.all(total > 0.0)):
            raise ValueError("rings: expected light >= 0 and some in every channel")
        share = light / total
        squares = edges * edges
        halving = 0.5 * (squares[:-1] + squares[1:])
        return cls(
            ring_edges_mm=edges,
            radius_mm=np.sqrt(halving),
            density_per_mm2=share / (np.pi * np.diff(squares)),
            encircled=np.cumsum(share, axis=1),
            rms_mm=np.sqrt(share @ halving),
        )

    def gaussians(self, sigmas_mm: ArrayLike = GAUSSIAN_SIGMAS_MM) -> GaussianSum:
        """Fit non-negative weights of Gaussians of given widths to the encircled fractions.

        Parameters
        ----------
        sigmas_mm
            Widths in mm, > 0, shape (k,).

        Returns
        -------
        GaussianSum
            Weights per channel, each summing to 1, with the largest error of the fit.

        Raises
        ------
        ValueError
            When a width is not positive.

        Examples
        --------
        >>> edges = np.linspace(0.0, 8.0, 81)
        >>> inside = 1.0 - np.exp(-edges**2 / (2 * 0.3**2))
        >>> kernels = LateralKernels.from_rings(edges, [np.diff(inside)])
        >>> kernels.gaussians([0.1, 0.3, 1.0]).weights.round(3).tolist()
        [[0.0, 1.0, 0.0]]
        """
        sigmas = np.asarray(sigmas_mm, dtype=np.float64)
        if sigmas.ndim != 1 or not np.all(sigmas > 0.0):
            raise ValueError(f"sigmas_mm: expected widths > 0 on one axis, got {sigmas.tolist()}")
        outer = self.ring_edges_mm[1:, None]
        inside = -np.expm1(-0.5 * (outer / sigmas) ** 2)
        # A heavily weighted extra row constrains the sum to 1; the other rows fit encircled
        # fractions.
        heavy = 1e3
        system = np.vstack([inside, np.full(sigmas.size, heavy)])
        weights = np.array([nnls(system, np.append(row, heavy))[0] for row in self.encircled])
        weights /= weights.sum(axis=1, keepdims=True)
        worst = np.abs(weights @ inside.T - self.encircled).max(axis=1)
        return GaussianSum(sigmas, weights, worst)
