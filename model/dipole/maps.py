"""Coefficients of the diffusion dipole over a texture, from albedo and translucency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array
from model.dipole import profile as dipole


@dataclass(frozen=True, slots=True, eq=False)
class DipoleMaps:
    """Coefficients of the medium under each texel and channel, all of shape (H, W, 3).

    R_d of 1 gives alpha' = 1 and an infinite sigma_t': no medium has such an albedo with a finite
    1/sigma_tr. Such values are masked, but do not count as outliers.

    Attributes
    ----------
    deficit : ndarray
        1 - alpha', in (0, 1], with all its digits near alpha' = 1; NaN where not `valid`.
    sigma_s_prime_per_mm, sigma_a_per_mm : ndarray
        1/mm; NaN where not `valid`.
    outlier : ndarray of bool
        R_d is known and outside [0, 1]: no medium has it.
    valid : ndarray of bool
    """

    deficit: Float64Array
    sigma_s_prime_per_mm: Float64Array
    sigma_a_per_mm: Float64Array
    outlier: BoolArray
    valid: BoolArray

    @property
    def albedo_prime(self) -> Float64Array:
        """Return alpha'; it rounds to 1 where `deficit` is small."""
        return 1.0 - self.deficit

    @staticmethod
    def of(
        r_d: ArrayLike, translucency_mm: ArrayLike, *, eta: float, valid: ArrayLike | None = None
    ) -> DipoleMaps:
        """Return the coefficients for R_d and 1/sigma_tr (section 9 of Weyrich et al.).

        Parameters
        ----------
        r_d, translucency_mm
            R_d and 1/sigma_tr, mm, (..., C).
        eta
            Refractive index of the medium over that of air.
        valid
            Texels that count, (...); None: all.

        Examples
        --------
        >>> found = DipoleMaps.of([[0.436, 1.2]], [[3.674, 3.0]], eta=1.3)
        >>> found.sigma_a_per_mm[0, 0].round(3).tolist(), found.outlier.tolist()
        (0.032, [[False, True]])
        """
        albedo = np.asarray(r_d, np.float64)
        depth = np.broadcast_to(np.asarray(translucency_mm, np.float64), albedo.shape)
        counts = np.ones(albedo.shape, bool)
        if valid is not None:
            counts &= np.asarray(valid, bool)[..., None]
        finite = np.isfinite(albedo)
        outlier = counts & finite & dipole.is_outlier(albedo)
        good = counts & finite & ~outlier & np.isfinite(depth) & (depth > 0.0)
        deficit = dipole.invert_to_deficit(np.where(good, albedo, 0.5), eta)
        good &= deficit > 0.0
        safe = np.where(good, deficit, 1.0)
        sigma_tr = 1.0 / np.where(good, depth, 1.0)
        # Section 9: sigma_t' = sigma_tr / sqrt(3 (1 - alpha'))
        absorbed, scattered = dipole.coefficients(safe, sigma_tr)

        def masked(values: Float64Array) -> Float64Array:
            return np.asarray(np.where(good, values, np.nan))

        return DipoleMaps(masked(deficit), masked(scattered), masked(absorbed), outlier, good)
