"""Camera color of simulated skin: Monte Carlo spectra in a camera's bands under one light.

The table is part of the simulation. It is built from Monte Carlo spectra per camera and light,
independently of the table that estimators invert.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numba import njit, prange

from model import spectra
from rigsim.arrays import Float32Array, Float64Array
from rigsim.tissue.skin_layers import MAX_C_HD, MAX_C_M, TYPICAL_SKIN, TissueProperties
from rigsim.tissue.skin_table import SkinTable

NODES_PER_AXIS: Final = 257
"""Nodes along each axis; linear interpolation of log R between them errs by less than 1e-4."""


@dataclass(frozen=True, slots=True, eq=False)
class SkinColor:
    """White-balanced camera RGB of skin over melanin and blood."""

    camera: str
    """Name of the camera's sensitivity."""
    light: str
    """Name of the light's spectrum."""
    log_rgb: Float64Array
    """Logarithm of the reflectance per channel, shape (NODES, NODES, 3), over cube roots."""

    def rgb(self, c_m: Float32Array, c_hd: Float32Array) -> Float32Array:
        """Return the diffuse reflectance per channel, white-balanced.

        Parameters
        ----------
        c_m, c_hd
            Volume fractions, shape (...), 0 to 0.5 and 0 to 0.32.

        Returns
        -------
        ndarray of float32
            Shape (..., 3); 1 would be a perfect white at normal incidence.
        """
        melanin, blood = _flat(c_m, MAX_C_M), _flat(c_hd, MAX_C_HD)
        return _lookup(self.log_rgb, melanin, blood).reshape(*np.shape(c_m), 3)

    def nearest_fractions(
        self, rgb: Float32Array, c_m: Float32Array, c_hd: Float32Array, *, steps: int = 12
    ) -> tuple[Float32Array, Float32Array]:
        """Return the volume fractions whose color is nearest to a given one in log reflectance.

        These are the estimates from blurred skin by a model that is exact except for the blur.

        Parameters
        ----------
        rgb
            Reflectance per channel, shape (..., 3), > 0.
        c_m, c_hd
            Fractions to start from, shape (...).
        steps
            Damped Gauss-Newton steps.

        Returns
        -------
        c_m, c_hd : ndarray of float32
            Shape (...), inside the table.
        """
        melanin, blood = _flat(c_m, MAX_C_M), _flat(c_hd, MAX_C_HD)
        target = np.ascontiguousarray(rgb.reshape(-1, 3), np.float32)
        _approach(self.log_rgb, target, melanin, blood, steps)
        shape = np.shape(c_m)
        return (
            (MAX_C_M * melanin**3).astype(np.float32).reshape(shape),
            (MAX_C_HD * blood**3).astype(np.float32).reshape(shape),
        )


@lru_cache(maxsize=24)
def skin_color(camera: str, light: str, tissue: TissueProperties = TYPICAL_SKIN) -> SkinColor:
    """Return the color table of a person's skin for a camera and a light; it is built once.

    Parameters
    ----------
    camera, light
        Names of `model.spectra`.
    tissue
        Properties of the skin except for melanin and blood.

    Returns
    -------
    SkinColor
        Read-only.

    Examples
    --------
    >>> table = skin_color("Nikon 5100 (NPL)", "D55")
    >>> fair = table.rgb(np.float32([0.01]), np.float32([0.02]))[0]
    >>> bool(fair[0] > fair[1] > fair[2])
    True
    """
    table = SkinTable.load(tissue, spectra.sampling(light))
    weights = spectra.band_weights(camera, light, table.wavelength_nm)
    position = np.linspace(0.0, 1.0, NODES_PER_AXIS)
    melanin = MAX_C_M * position**3
    blood = MAX_C_HD * position**3
    log_rgb = np.empty((NODES_PER_AXIS, NODES_PER_AXIS, 3))
    for i, c_m in enumerate(melanin):
        log_rgb[i] = np.log(table.spectra(np.full(NODES_PER_AXIS, c_m), blood) @ weights)
    log_rgb.setflags(write=False)
    return SkinColor(camera, light, log_rgb)


def _flat(fraction: Float32Array, limit: float) -> Float64Array:
    """Return cube-root positions in [0, 1]."""
    values = np.asarray(fraction, np.float64).reshape(-1)
    if values.size and not (values.min() >= 0.0 and values.max() <= limit * (1.0 + 1e-6)):
        raise ValueError(f"fraction: got {values.min()} to {values.max()}, expected 0 to {limit}")
    return np.cbrt(np.minimum(values / limit, 1.0))


@njit(cache=True, inline="always")
def _cell(position, nodes):  # type: ignore[no-untyped-def]
    x = min(max(position, 0.0), 1.0) * (nodes - 1)
    i = min(int(x), nodes - 2)
    return i, x - i


@njit(parallel=True, cache=True)
def _lookup(log_rgb, melanin, blood):  # type: ignore[no-untyped-def]
    out = np.empty((melanin.shape[0], 3), np.float32)
    nodes = log_rgb.shape[0]
    for n in prange(melanin.shape[0]):
        i, s = _cell(melanin[n], nodes)
        j, t = _cell(blood[n], nodes)
        for c in range(3):
            low = (1.0 - t) * log_rgb[i, j, c] + t * log_rgb[i, j + 1, c]
            high = (1.0 - t) * log_rgb[i + 1, j, c] + t * log_rgb[i + 1, j + 1, c]
            out[n, c] = np.exp((1.0 - s) * low + s * high)
    return out


@njit(parallel=True, cache=True)
def _approach(log_rgb, target, melanin, blood, steps):  # type: ignore[no-untyped-def]
    nodes = log_rgb.shape[0]
    for n in prange(melanin.shape[0]):
        for _ in range(steps):
            i, s = _cell(melanin[n], nodes)
            j, t = _cell(blood[n], nodes)
            aa, ab, bb, ra, rb = 0.0, 0.0, 0.0, 0.0, 0.0
            for c in range(3):
                f00, f01 = log_rgb[i, j, c], log_rgb[i, j + 1, c]
                f10, f11 = log_rgb[i + 1, j, c], log_rgb[i + 1, j + 1, c]
                value = (1.0 - s) * ((1.0 - t) * f00 + t * f01) + s * ((1.0 - t) * f10 + t * f11)
                dm = ((1.0 - t) * (f10 - f00) + t * (f11 - f01)) * (nodes - 1)
                dh = ((1.0 - s) * (f01 - f00) + s * (f11 - f10)) * (nodes - 1)
                rest = np.log(max(target[n, c], 1e-6)) - value
                aa += dm * dm
                ab += dm * dh
                bb += dh * dh
                ra += dm * rest
                rb += dh * rest
            damp = 1e-9 * (aa + bb) + 1e-12
            aa += damp
            bb += damp
            determinant = aa * bb - ab * ab
            # Steps are limited to a tenth of the range: the linearization is valid only nearby.
            step_m = (bb * ra - ab * rb) / determinant
            step_h = (aa * rb - ab * ra) / determinant
            melanin[n] = min(max(melanin[n] + min(max(step_m, -0.1), 0.1), 0.0), 1.0)
            blood[n] = min(max(blood[n] + min(max(step_h, -0.1), 0.1), 0.0), 1.0)
