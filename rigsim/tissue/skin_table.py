"""Reflectance spectra of one person's skin over melanin and blood, and their interpolation.

A table belongs to the properties of one person's skin (`rigsim.tissue.skin_layers`) and is
interpolated from the Monte Carlo table of `rigsim.tissue.skin_transport`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import exp
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from rigsim.arrays import Float64Array
from rigsim.tissue.lateral_kernels import LateralKernels
from rigsim.tissue.skin_layers import (
    BASAL_THICKNESS_FRACTION,
    DERMIS_SCATTERING_RATIO,
    MAX_C_HD,
    MAX_C_M,
    TYPICAL_SKIN,
    SkinCoefficients,
    TissueProperties,
    skin_coefficients,
)
from rigsim.tissue.skin_transport import SkinCoordinates, SkinTransport

WAVELENGTH_NM: Final = np.arange(400.0, 701.0, 10.0)
"""Wavelengths of every table, nm."""
NODES_PER_AXIS: Final = 41
"""Nodes of melanin and of blood."""
RING_EDGES_MM: Final = np.concatenate([[0.0], np.geomspace(0.01, 15.0, 40)])
"""Edges of the rings of lateral profiles, mm."""
MAX_CACHED_TABLES: Final = 32
"""Number of cached tables; each takes 0.9 MB."""


class SkinTableError(ValueError):
    """Error for a request outside the table."""


@dataclass(frozen=True, eq=False)
class SkinTable:
    """Diffuse reflectance of a person's skin over melanin, blood and wavelength."""

    tissue: TissueProperties
    """All other properties of the skin."""
    wavelength_nm: Float64Array
    """Wavelengths in nm, shape (n_wavelength,)."""
    c_m: Float64Array
    """Nodes of the volume fraction of melanosomes in the epidermis, 0 to 0.5, equally spaced in
    their cube root, shape (n_m,)."""
    c_hd: Float64Array
    """Nodes of the volume fraction of blood in the dermis, 0 to 0.32, likewise, shape (n_h,)."""
    reflectance: Float64Array
    """Diffuse reflectance at normal incidence without the specular part, in (0, 1),
    shape (n_m, n_h, n_wavelength)."""
    _patches: Float64Array
    """log R with its slopes and twist per cell edge, shape (n_m, n_h, 4, n_wavelength)."""

    @classmethod
    def load(
        cls, tissue: TissueProperties = TYPICAL_SKIN, wavelength_nm: ArrayLike = WAVELENGTH_NM
    ) -> SkinTable:
        """Return the table of a person's skin; it is computed once, in 0.3 s.

        Parameters
        ----------
        tissue
            Properties of the skin except for melanin and blood.
        wavelength_nm
            Wavelengths in nm, shape (n_wavelength,).

        Raises
        ------
        rigsim.tissue.skin_transport.SkinTransportError
            When the properties lie outside the Monte Carlo table.
        """
        return _load(tissue, tuple(np.asarray(wavelength_nm, np.float64).tolist()))

    @cached_property
    def standard_error(self) -> Float64Array:
        """Return the standard error of `reflectance`, same shape.

        Errors of different fractions are strongly correlated (same photons).
        """
        transport = SkinTransport.load()
        relative = [
            transport.relative_error(_coordinates(coefficients, self.tissue))
            for coefficients in self._coefficients(self.c_m, self.c_hd)
        ]
        shape = self.reflectance.shape[:2]
        return self.reflectance * np.stack([part.reshape(shape) for part in relative], axis=-1)

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

    def _coefficients(self, c_m: Float64Array, c_hd: Float64Array) -> list[SkinCoefficients]:
        return _coefficients_by_wavelength(c_m, c_hd, self.tissue, self.wavelength_nm)

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
        Cubic splines of the logarithm of the ring fractions over the coordinates of
        `rigsim.tissue.skin_transport`. Wavelengths of a channel are weighted by their reflectance.

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
        for name, value, limit in (("c_m", c_m, MAX_C_M), ("c_hd", c_hd, MAX_C_HD)):
            _fractions(name, np.asarray(value), limit)
        share = _ring_fractions(c_m, c_hd, self.tissue, self.wavelength_nm, RING_EDGES_MM)
        in_bands = (share * self.spectra(c_m, c_hd)) @ weights
        return LateralKernels.from_rings(RING_EDGES_MM, in_bands.T)


def interpolate_spectra(
    c_m: Float64Array, c_hd: Float64Array, tissue: TissueProperties, wavelength_nm: ArrayLike
) -> Float64Array:
    """Return spectra of a few skins without a table, 0.2 ms per wavelength.

    Parameters
    ----------
    c_m, c_hd
        Volume fractions of melanosomes, 0 to 0.5, and of blood, 0 to 0.32, shape (n,) each.
    tissue
        All other properties.
    wavelength_nm
        Wavelengths, nm, 400 to 700, shape (w,).

    Returns
    -------
    ndarray
        Diffuse reflectance as of `SkinTable.spectra`, shape (n, w), within 1e-4 of it.

    Raises
    ------
    rigsim.tissue.skin_transport.SkinTransportError
        When the properties lie outside the Monte Carlo table.

    Examples
    --------
    >>> melanin, blood = np.array([0.02]), np.array([0.03])
    >>> found = interpolate_spectra(melanin, blood, TYPICAL_SKIN, np.array([540.0]))
    >>> bool(np.isclose(found[0, 0], SkinTable.load().spectra(0.02, 0.03)[14], rtol=1e-4))
    True
    """
    transport = SkinTransport.load()
    return np.stack(
        [
            np.exp(
                transport.log_reflectance(
                    _coordinates(skin_coefficients(nm, c_m, c_hd, tissue), tissue)
                )
            )
            for nm in np.asarray(wavelength_nm)
        ],
        axis=-1,
    )


def interpolate_rings(
    c_m: float,
    c_hd: float,
    tissue: TissueProperties,
    wavelength_nm: ArrayLike,
    ring_edges_mm: Float64Array,
) -> Float64Array:
    """Return the reflectance of rings around a narrow beam without a table, 1 ms per wavelength.

    Parameters
    ----------
    c_m, c_hd, tissue, wavelength_nm
        As for `interpolate_spectra`, fractions of one skin.
    ring_edges_mm
        Increasing radii from 0, mm, shape (rings + 1,).

    Returns
    -------
    ndarray
        Reflected fraction of the beam per ring and wavelength, shape (rings, w); the last ring has
        all light beyond it.

    Raises
    ------
    rigsim.tissue.skin_transport.SkinTransportError
        When the properties lie outside the Monte Carlo table.

    Examples
    --------
    >>> rings = interpolate_rings(0.02, 0.03, TYPICAL_SKIN, [540.0], np.array([0.0, 1.0, 2.0]))
    >>> whole = interpolate_spectra(np.array([0.02]), np.array([0.03]), TYPICAL_SKIN, [540.0])
    >>> rings.shape, bool(np.isclose(rings.sum(), whole[0, 0]))
    ((2, 1), True)
    """
    spectrum = interpolate_spectra(np.array([c_m]), np.array([c_hd]), tissue, wavelength_nm)
    return spectrum * _ring_fractions(c_m, c_hd, tissue, wavelength_nm, ring_edges_mm)


def _ring_fractions(
    c_m: float,
    c_hd: float,
    tissue: TissueProperties,
    wavelength_nm: ArrayLike,
    ring_edges_mm: Float64Array,
) -> Float64Array:
    """Return the fraction of the reflectance in each ring, shape (rings, w)."""
    one_m, one_h, transport = np.array([float(c_m)]), np.array([float(c_hd)]), SkinTransport.load()
    each = [skin_coefficients(nm, one_m, one_h, tissue) for nm in np.asarray(wavelength_nm)]
    scale = DERMIS_SCATTERING_RATIO * ring_edges_mm
    rings = [
        transport.ring_fractions(_coordinates(one, tissue), scale * one.scattering[0])
        for one in each
    ]
    return np.stack(rings, axis=-1)


@lru_cache(maxsize=MAX_CACHED_TABLES)
def _load(tissue: TissueProperties, wavelength_nm: tuple[float, ...]) -> SkinTable:
    wavelengths = np.array(wavelength_nm)
    steps = np.linspace(0.0, 1.0, NODES_PER_AXIS) ** 3
    c_m, c_hd = MAX_C_M * steps, MAX_C_HD * steps
    transport = SkinTransport.load()
    log_reflectance = [
        transport.log_reflectance(_coordinates(coefficients, tissue))
        for coefficients in _coefficients_by_wavelength(c_m, c_hd, tissue, wavelengths)
    ]
    shape = NODES_PER_AXIS, NODES_PER_AXIS
    values = np.stack([part.reshape(shape) for part in log_reflectance], axis=-1)
    arrays = wavelengths, c_m, c_hd, np.exp(values), _hermite_patches(values)
    for array in arrays:
        array.setflags(write=False)
    return SkinTable(tissue, *arrays)


def _coefficients_by_wavelength(
    c_m: Float64Array, c_hd: Float64Array, tissue: TissueProperties, wavelength_nm: Float64Array
) -> list[SkinCoefficients]:
    """Return the coefficients at each wavelength, of all pairs of fractions, shape (pairs,)."""
    melanin, blood = (axis.ravel() for axis in np.meshgrid(c_m, c_hd, indexing="ij"))
    return [skin_coefficients(nm, melanin, blood, tissue) for nm in wavelength_nm]


def _coordinates(coefficients: SkinCoefficients, tissue: TissueProperties) -> SkinCoordinates:
    scattering = float(coefficients.scattering[0])
    basal_mm = BASAL_THICKNESS_FRACTION * tissue.epidermis_mm
    basal = basal_mm * coefficients.basal
    depth = (tissue.epidermis_mm - basal_mm) * coefficients.upper + basal
    return SkinCoordinates(
        tissue.epidermis_mm * scattering,
        np.maximum(basal / depth, BASAL_THICKNESS_FRACTION),
        depth,
        coefficients.dermis / (DERMIS_SCATTERING_RATIO * scattering),
    )


def _hermite_patches(value: Float64Array) -> Float64Array:
    """Return value, two slopes and twist of log R at the nodes, per unit of node index."""
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
