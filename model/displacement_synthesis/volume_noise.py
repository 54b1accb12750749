"""Band-limited noise in space, for skin without a measured patch and without an atlas.

A sum of plane waves of random direction, wave number and phase. It is a function of the position in
space alone, so a surface that is evaluated point by point has neither seams nor a preferred
direction (the volume noise of Nagano et al. 2015, fig. 5 top, doi:10.1145/2766894, who do not
specify its kind).

The spectrum is given: power is distributed over wave numbers k (waves per mm) between two ends with
a density proportional to ``k^slope``. The noise at distance r then has the covariance ``variance *
integral of p(k) sin(2 pi k r) / (2 pi k r) dk`` with that density p.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks

CHUNK_POINTS = 512
"""Points per block: their sums stay in the cache during the loop over waves."""
_RADIAL_NODES = 2001


class VolumeNoiseError(ValueError):
    """Error for a spectrum or positions from which no noise can be made."""


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_of_waves(points: Any, waves: Any, phases: Any, amplitude: Any, out: Any) -> None:
    """Write the sum of cosines at each point.

    Parameters
    ----------
    points : (N, 3) float64
    waves : (M, 3) float64, waves per unit of length
    phases : (M,) float64, in turns
    amplitude : float
    out : (N,) float64, written
    """
    x, y, z = np.empty(CHUNK_POINTS), np.empty(CHUNK_POINTS), np.empty(CHUNK_POINTS)
    total = np.empty(CHUNK_POINTS)
    for begin in range(0, out.size, CHUNK_POINTS):
        count = min(CHUNK_POINTS, out.size - begin)
        for i in range(count):
            x[i], y[i], z[i] = points[begin + i, 0], points[begin + i, 1], points[begin + i, 2]
            total[i] = 0.0
        for m in range(phases.size):
            a, b, c, phase = waves[m, 0], waves[m, 1], waves[m, 2], phases[m]
            for i in range(count):
                turn = a * x[i] + b * y[i] + c * z[i] + phase
                turn -= math.floor(turn)
                # cos(2 pi turn) = sin(2 pi q) for turn in [0, 1): Taylor's series, 6e-12 off
                q = abs(turn - 0.5) - 0.25
                s = q * q
                total[i] += q * (
                    6.283185307179586
                    + s
                    * (
                        -41.34170224039975
                        + s
                        * (
                            81.60524927607504
                            + s
                            * (
                                -76.70585975306136
                                + s
                                * (
                                    42.05869394489765
                                    + s
                                    * (
                                        -15.094642576822984
                                        + s * (3.8199525848482803 - s * 0.7181223017785001)
                                    )
                                )
                            )
                        )
                    )
                )
        for i in range(count):
            out[begin + i] = amplitude * total[i]


@dataclass(frozen=True, slots=True, eq=False)
class VolumeNoise:
    """Noise of a given spectrum and variance; see :meth:`draw`."""

    waves_per_mm: Float64Array
    """(M, 3) wave vectors."""
    phases: Float64Array
    """(M,) phases, in turns."""
    rms_um: float
    """Root mean square over all space, um."""
    band_per_mm: tuple[float, float]
    """Least and largest wave number, waves per mm."""
    slope: float
    """Exponent of k in the power's density over wave numbers."""

    @classmethod
    def draw(
        cls,
        *,
        rms_um: float,
        band_per_mm: tuple[float, float],
        slope: float = -1.0,
        waves: int = 256,
        rng: np.random.Generator,
    ) -> VolumeNoise:
        """Draw a random noise field.

        Parameters
        ----------
        rms_um : float
            Root mean square, um, >= 0.
        band_per_mm : (float, float)
            Least and largest wave number, waves per mm, 0 < least < largest. Keep the largest one
            below the Nyquist frequency of the map, one wave per two pixels.
        slope : float
            Exponent of the density; -1 gives equal power per octave.
        waves : int
            Number of plane waves; more bring values nearer to a normal distribution and take
            longer.
        rng
            Draws directions, wave numbers and phases.

        Raises
        ------
        VolumeNoiseError

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> noise = VolumeNoise.draw(rms_um=5.0, band_per_mm=(1.0, 8.0), rng=rng)
        >>> noise.at(np.zeros((4, 2, 3))).shape
        (4, 2)
        """
        low, high = (float(v) for v in band_per_mm)
        check = Checks(VolumeNoiseError).within
        check("least of band_per_mm", low, "(0, inf)")
        check("largest of band_per_mm", high, f"({low}, inf)")
        check("rms_um", rms_um, "[0, inf)")
        check("slope", slope, "[-20, 20]")
        check("waves", waves, "[8, 65536]")
        # Stratified: one wave in each of M parts of equal power, with independent directions. So
        # every part of the spectrum occurs in each draw, and each wave is uniform over directions.
        share = (np.arange(waves) + rng.random(waves)) / waves
        if slope == -1.0:
            k = low * (high / low) ** share
        else:
            power = slope + 1.0
            ratio = (high / low) ** power
            k = low * (1.0 + share * (ratio - 1.0)) ** (1.0 / power)
        cosine = 2.0 * (rng.permutation(waves) + rng.random(waves)) / waves - 1.0
        turn = 2.0 * np.pi * (rng.permutation(waves) + rng.random(waves)) / waves
        sine = np.sqrt(1.0 - cosine**2)
        directions = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1)
        return cls(
            waves_per_mm=k[:, None] * directions,
            phases=rng.random(waves),
            rms_um=float(rms_um),
            band_per_mm=(low, high),
            slope=float(slope),
        )

    def at(self, points_mm: ArrayLike) -> Float64Array:
        """Return the noise at positions.

        Parameters
        ----------
        points_mm : array_like, shape (..., 3)
            Positions in space, mm, such as those of an atlas' pixels on the undeformed skin.

        Returns
        -------
        ndarray of float64, shape (...)
            Heights, um, of mean 0 over space.

        Raises
        ------
        VolumeNoiseError
            For positions that are not finite or do not have 3 coordinates.
        """
        points = np.ascontiguousarray(points_mm, np.float64)
        Checks(VolumeNoiseError).shape("points_mm", points, ("...", 3))
        Checks(VolumeNoiseError).within("points_mm", points)
        out = np.empty(points.shape[:-1])
        amplitude = self.rms_um * math.sqrt(2.0 / self.phases.size)
        flat = points.reshape(-1, 3)
        _sum_of_waves(flat, self.waves_per_mm, self.phases, amplitude, out.reshape(-1))
        return out

    def covariance(self, distance_mm: ArrayLike) -> Float64Array:
        """Return the covariance of the noise at two positions, over all draws.

        Parameters
        ----------
        distance_mm : array_like
            Distance of the positions, mm.

        Returns
        -------
        ndarray of float64
            um^2.
        """
        distance = np.asarray(distance_mm, np.float64)
        low, high = self.band_per_mm
        log_k = np.linspace(math.log(low), math.log(high), _RADIAL_NODES)
        density = np.exp((self.slope + 1.0) * (log_k - log_k[-1]))
        density /= np.trapezoid(density, log_k)
        values = density * np.sinc(2.0 * np.exp(log_k) * distance[..., None])
        return np.asarray(self.rms_um**2 * np.trapezoid(values, log_k, axis=-1))

    @property
    def slope_variance(self) -> float:
        """Return the expected squared slope along any direction of a plane, dimensionless."""
        k2 = float((self.waves_per_mm**2).sum(axis=1).mean())
        return (2.0 * math.pi * self.rms_um * 1e-3) ** 2 * k2 / 3.0
