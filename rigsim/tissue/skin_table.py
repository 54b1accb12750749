"""Tabulated Monte Carlo reflectance of two-layer skin, and its interpolation.

The table is package data made by ``tools/make_skin_reflectance.py``; its optics are those of
`rigsim.tissue.skin_layers`.

Accuracy: the relative standard error has a median of 0.10 % where R > 0.3, 0.16 % where
0.1 < R < 0.3, 0.35 % where R < 0.01, and is nowhere above 0.74 %. Interpolation adds at most 0.03 %
(between the nodes, same photons), 0.002 % in the mean square. Lateral kernels are off by at most
0.0021 of the light within any radius between the nodes, and their Gaussians by 0.017.

Plausibility: against the mean of 100 forearms (Cooksey, Allen, Tsai 2017, doi:10.18434/M38597; nine
wavelengths from 400 to 700 nm) the best fit is C_m = 0.0030, C_hd = 0.037 under a specular 0.04,
with residuals of 0.035 root mean square and 0.051 at most: too bright below 500 nm, too dark above.
A homogeneous epidermis of 0.25 mm needs that little melanin: C_m = 0.05 reflects 0.23 at
700 nm where the forearms reflect 0.60, so fair skin lies below C_m = 0.01 and 0.05 is dark already.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from math import exp
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from rigsim.arrays import Float64Array
from rigsim.tissue.lateral_kernels import LateralKernels
from rigsim.tissue.skin_layers import MAX_C_HD, MAX_C_M

_TABLE_FILE = "skin_reflectance_mc.npz"
EMPTY_RING_FRACTION = 1e-9  # fraction assigned to a far ring without photons


class SkinTableError(ValueError):
    """Error for a request outside the table."""


def c_m_axis(nodes: int) -> Float64Array:
    """Return melanin fractions from 0 to 0.5, equally spaced in their cube root."""
    return np.asarray(MAX_C_M * np.linspace(0.0, 1.0, nodes) ** 3)


def c_hd_axis(nodes: int) -> Float64Array:
    """Return dermal blood fractions from 0 to 0.32, equally spaced in their cube root."""
    return np.asarray(MAX_C_HD * np.linspace(0.0, 1.0, nodes) ** 3)


@dataclass(frozen=True, slots=True, eq=False)
class SkinTable:
    """Diffuse reflectance of two-layer skin over melanin, blood and wavelength."""

    wavelength_nm: Float64Array
    """Wavelengths in nm, 400 to 700 in steps of 10, shape (n_wavelength,)."""
    c_m: Float64Array
    """Nodes of the volume fraction of melanosomes in the epidermis, 0 to 0.5, shape (n_m,)."""
    c_hd: Float64Array
    """Nodes of the volume fraction of blood in the dermis, 0 to 0.32, shape (n_h,)."""
    reflectance: Float64Array
    """Diffuse reflectance at normal incidence without the specular part, in (0, 1),
    shape (n_m, n_h, n_wavelength)."""
    standard_error: Float64Array
    """Standard error of `reflectance`, same shape. Errors of different wavelengths are independent,
    those of different fractions are strongly correlated (same photons)."""
    lateral_c_m: Float64Array
    """Nodes of melanin of the lateral profiles, shape (k_m,)."""
    lateral_c_hd: Float64Array
    """Nodes of blood of the lateral profiles, shape (k_h,)."""
    ring_edges_mm: Float64Array
    """Edges of the rings around the point of entry in mm, shape (rings + 1,)."""
    lateral: Float64Array
    """Reflectance that leaves within each ring, shape (k_m, k_h, rings, n_wavelength)."""
    lateral_standard_error: Float64Array
    """Standard error of `lateral`, same shape."""
    provenance: Mapping[str, Any]
    """Recipe version, seed, photons, optical constants and library versions."""
    _patches: Float64Array
    """log R with its slopes and twist per cell edge, shape (n_m, n_h, 4, n_wavelength)."""
    _log_shares: Float64Array
    """log of each ring's fraction of `lateral`, shape (k_m, k_h, rings, n_wavelength)."""

    @classmethod
    def load(cls) -> SkinTable:
        """Return the packaged table; it is read once."""
        return _load()

    def spectra(self, c_m: ArrayLike, c_hd: ArrayLike) -> Float64Array:
        """Return reflectance spectra by smooth, monotone interpolation.

        Parameters
        ----------
        c_m
            Volume fraction of melanosomes in the epidermis, 0 to 0.5, any shape.
        c_hd
            Volume fraction of blood in the dermis, 0 to 0.32, broadcast against `c_m`.

        Returns
        -------
        ndarray
            Diffuse reflectance at normal incidence, shape (..., n_wavelength); float32 when both
            inputs are float32, else float64.

        Raises
        ------
        SkinTableError
            When a fraction is outside the table or not finite.

        Notes
        -----
        Bicubic Hermite patches of log R over the cube roots of the fractions, with Fritsch-Carlson
        slopes along both axes.

        Examples
        --------
        >>> table = SkinTable.load()
        >>> fair, dark = table.spectra([0.01, 0.2], 0.03)
        >>> bool((fair > dark).all())
        True
        """
        melanin, blood = np.broadcast_arrays(np.asarray(c_m), np.asarray(c_hd))
        single = melanin.dtype == np.float32 and blood.dtype == np.float32
        flat_m = _fractions("c_m", melanin, MAX_C_M)
        flat_h = _fractions("c_hd", blood, MAX_C_HD)
        out = np.empty(
            (flat_m.size, self.wavelength_nm.size), dtype=np.float32 if single else np.float64
        )
        if single:
            _interpolate_f32(self._patches, flat_m, flat_h, out)
        else:
            _interpolate_f64(self._patches, flat_m, flat_h, out)
        return out.reshape(*melanin.shape, -1)

    def lateral_kernels(
        self, c_m: float, c_hd: float, band_weights: ArrayLike | None = None
    ) -> LateralKernels:
        """Return the lateral scattering kernels per camera channel.

        Parameters
        ----------
        c_m, c_hd
            Fractions as in `spectra`, one value each.
        band_weights
            Weights of the wavelengths in each channel, shape (n_wavelength, channels), as
            ``model.spectra.band_weights`` returns them; without them every wavelength is a channel.

        Returns
        -------
        LateralKernels
            Radial densities, each normalized to 1 within the largest ring.

        Raises
        ------
        SkinTableError
            When a fraction is outside the table or the weights have another length.

        Notes
        -----
        Cubic splines of the logarithm of the ring fractions over the cube roots of the volume
        fractions. Wavelengths of a channel are weighted by their reflectance.

        Examples
        --------
        >>> kernels = SkinTable.load().lateral_kernels(0.01, 0.03)
        >>> bool(kernels.rms_mm[-1] > kernels.rms_mm[14])  # red light scatters farther than green
        True
        """
        n = self.wavelength_nm.size
        weights = np.eye(n) if band_weights is None else np.asarray(band_weights, np.float64)
        if weights.ndim != 2 or weights.shape[0] != n or not np.all(np.isfinite(weights)):
            raise SkinTableError(
                f"band_weights: expected finite numbers of shape ({n}, channels), one row for each "
                f"wavelength, got shape {weights.shape}"
            )
        log_share = self._log_shares
        for name, value, limit in (("c_m", c_m, MAX_C_M), ("c_hd", c_hd, MAX_C_HD)):
            at = float(_fractions(name, np.asarray(value), limit)[0])
            # Smooth in c itself: d/d(cbrt c) = 3 cbrt(c)^2 d/dc, so the slope over cbrt c is 0 at
            # 0.
            flat = (1, np.zeros(log_share.shape[1:]))
            nodes = np.linspace(0.0, 1.0, log_share.shape[0])
            log_share = CubicSpline(nodes, log_share, bc_type=(flat, "not-a-knot"))(at)
        share = np.exp(log_share)
        share /= share.sum(axis=0)
        in_bands = (share * self.spectra(c_m, c_hd)) @ weights
        return LateralKernels.from_rings(self.ring_edges_mm, in_bands.T)


@cache
def _load() -> SkinTable:
    source = resources.files("rigsim").joinpath("data", _TABLE_FILE)
    with source.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
        arrays = {
            name: stored[name].astype(np.float64) for name in stored.files if name != "provenance"
        }
        provenance = json.loads(str(stored["provenance"]))
    arrays["standard_error"] = arrays.pop("reflectance_standard_error")
    patches = _hermite_patches(arrays["reflectance"])
    log_shares = _log_shares(arrays["lateral"])
    for array in (*arrays.values(), patches, log_shares):
        array.setflags(write=False)
    return SkinTable(provenance=provenance, _patches=patches, _log_shares=log_shares, **arrays)


def _log_shares(rings: Float64Array) -> Float64Array:
    shares = rings / rings.sum(axis=2, keepdims=True)
    return np.log(np.maximum(shares, EMPTY_RING_FRACTION))


def _hermite_patches(reflectance: Float64Array) -> Float64Array:
    """Return value, two slopes and twist of log R at the nodes, per unit of node index."""
    value = np.log(reflectance)
    by_m, by_h = (
        PchipInterpolator(np.arange(value.shape[axis]), value, axis=axis).derivative()(
            np.arange(value.shape[axis])
        )
        for axis in (0, 1)
    )
    by_h = np.asarray(by_h)
    twist = 0.5 * (np.gradient(by_m, axis=1) + np.gradient(by_h, axis=0))
    return np.ascontiguousarray(np.stack([value, by_m, by_h, twist], axis=2))


def _fractions(name: str, values: NDArray[Any], limit: float) -> Float64Array:
    flat = np.ascontiguousarray(values, dtype=np.float64).ravel()
    # The largest float32 of a fraction may lie half a unit in the last place above the limit.
    allowed = max(limit, float(np.float32(limit)))
    outside = ~((flat >= 0.0) & (flat <= allowed))
    if outside.any():
        raise SkinTableError(
            f"{name}: expected volume fractions from 0 to {limit}, got {flat[outside][0]:g} "
            f"({int(outside.sum())} of {flat.size} values are outside)"
        )
    return np.cbrt(np.minimum(flat, limit) / limit)


def _interpolate(patches, c_m, c_hd, out):  # type: ignore[no-untyped-def]
    """Evaluate the patches at fractional positions in [0, 1] along both axes."""
    n_m, n_h, _, n_w = patches.shape
    a = np.empty((2, 2))  # basis along melanin: corner, then value or slope
    b = np.empty((2, 2))
    total = np.empty(n_w)
    for point in range(c_m.size):
        x = c_m[point] * (n_m - 1)
        y = c_hd[point] * (n_h - 1)
        i = min(int(x), n_m - 2)
        j = min(int(y), n_h - 2)
        for basis, t in ((a, x - i), (b, y - j)):
            basis[0, 0] = (1.0 + 2.0 * t) * (1.0 - t) * (1.0 - t)
            basis[0, 1] = t * (1.0 - t) * (1.0 - t)
            basis[1, 0] = t * t * (3.0 - 2.0 * t)
            basis[1, 1] = t * t * (t - 1.0)
        total[:] = 0.0
        for k in range(2):
            for m in range(2):
                node = patches[i + k, j + m]
                v = a[k, 0] * b[m, 0]
                d_m = a[k, 1] * b[m, 0]
                d_h = a[k, 0] * b[m, 1]
                d_mh = a[k, 1] * b[m, 1]
                for w in range(n_w):
                    total[w] += (
                        v * node[0, w] + d_m * node[1, w] + d_h * node[2, w] + d_mh * node[3, w]
                    )
        for w in range(n_w):
            out[point, w] = exp(total[w])


_KERNEL_SIGNATURE = (
    "void(Array(float64, 4, 'C', readonly=True), float64[::1], float64[::1], {}[:,::1])"
)
_interpolate_f64 = njit(_KERNEL_SIGNATURE.format("float64"), cache=True, nogil=True)(_interpolate)
_interpolate_f32 = njit(_KERNEL_SIGNATURE.format("float32"), cache=True, nogil=True)(_interpolate)
