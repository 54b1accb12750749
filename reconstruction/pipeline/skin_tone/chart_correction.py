"""Color of skin through a camera that a chart calibrated.

A color matrix is fitted to the patches of a chart. Skin has other spectra than patches: through
a camera without colorimetric sensitivities their color is off by up to 6 degrees of typology angle.
The camera's nominal sensitivities predict that error: the same fit on the chart's published spectra
is evaluated on spectra of modeled skin. The correction is a regression of the logarithm of XYZ.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from capture.calibration.color import (
    ColorMatrix,
    Method,
    chart_reference,
    fit_matrix,
    neutral_white,
)
from capture.calibration.color.colorimetry import WHITE_XYZ, chart_spectra
from model import color_table, skin_tone, spectra
from model.arrays import BoolArray, Float64Array
from model.tissue_optics import uncertainty as optics_uncertainty
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from model.tissue_optics.uncertainty import COVARIANCE_NODES
from reconstruction.pipeline.skin_tone.kernels import MIN_RELATIVE_XYZ

CENTER_SD_NM: Final = 1.5
"""Assumed standard deviation of the center of each channel between a camera and its nominal one."""
WIDTH_SD: Final = 0.02
"""Assumed relative standard deviation of the width of each channel, likewise."""
MELANIN_RANGE: Final = (0.003, 0.45)
"""Volume fractions of melanosomes of the modeled skin."""
BLOOD_RANGE: Final = (0.003, 0.03)
"""Volume fractions of blood of the modeled skin: faces without angiomas or bruises."""
N_LIGHTNESS_NODES: Final = 6
"""Nodes of the covariance of the remaining error, in the logarithm of Y."""
_STEP_NM: Final = 1.0
_NOMINAL: Final = np.zeros(6)
_TO_XYZ: Final = np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB)


@dataclass(frozen=True, slots=True, eq=False)
class SkinColorCorrection:
    """Regression from a chart-calibrated color of skin to its color, with the remaining error."""

    coefficients: Float64Array
    """(7, 3): change of log XYZ per term of `_terms`."""
    log_y: Float64Array
    """(n,): nodes of log Y of the covariance, increasing."""
    log_covariance: Float64Array
    """(n, 3, 3): covariance of log XYZ by unknown optics of the tissue and sensitivities."""
    nominal: ColorMatrix
    """Fit on the chart's published spectra, of white-balanced camera RGB."""

    def apply(self, linear_srgb: Float64Array) -> Float64Array:
        """Return the corrected linear sRGB, (..., 3)."""
        log_xyz = _log_xyz(linear_srgb)
        corrected = log_xyz + _terms(log_xyz) @ self.coefficients
        return np.asarray(np.exp(corrected) @ spectra.XYZ_TO_LINEAR_SRGB.T)


@lru_cache(maxsize=8)
def skin_color_correction(
    camera: str, illuminant: str, *, has_chart: bool = True, method: Method = "linear"
) -> SkinColorCorrection:
    """Return the correction of skin's colors for a camera under a light; it is fitted once.

    Parameters
    ----------
    camera, illuminant
        Names known to `model.spectra`.
    has_chart
        Whether a chart calibrates the actual camera. Without one the nominal matrix is used, and
        the remaining error has all that other sensitivities change.
    method
        Method of the color matrix.

    Notes
    -----
    Skin is that of the color tables, with each nuisance parameter of `optics_uncertainty` one
    standard deviation off. It includes `model.skin_tone.sphere_specular`, as instruments do.
    """
    skin = _modeled_skin()
    nominal = _fit_to_chart(camera, illuminant, _NOMINAL, method)
    calibrated = nominal.to_linear_srgb(skin @ _weights(camera, illuminant, _NOMINAL))
    truth = spectra.band_average(skin, spectra.LINEAR_SRGB, "D65")
    log_truth, log_given = _log_xyz(truth), _log_xyz(calibrated)
    solved = np.linalg.lstsq(_terms(log_given), log_truth - log_given, rcond=None)[0]
    found = np.asarray(solved, np.float64)

    def error(matrix: ColorMatrix, off: Float64Array) -> Float64Array:
        seen = _log_xyz(matrix.to_linear_srgb(skin @ _weights(camera, illuminant, off)))
        return np.asarray(seen + _terms(seen) @ found - log_truth)

    usual = error(nominal, _NOMINAL)
    products = usual[:, :, None] * usual[:, None, :]
    steps = np.diag([CENTER_SD_NM] * 3 + [WIDTH_SD] * 3)
    for step in np.concatenate([steps, -steps]):
        matrix = _fit_to_chart(camera, illuminant, step, method) if has_chart else nominal
        change = error(matrix, step) - usual
        products += 0.5 * change[:, :, None] * change[:, None, :]
    edges = np.quantile(log_truth[:, 1], np.linspace(0.0, 1.0, N_LIGHTNESS_NODES + 1))
    place = np.clip(np.searchsorted(edges, log_truth[:, 1], side="right") - 1, 0, edges.size - 2)
    nodes = range(N_LIGHTNESS_NODES)
    covariance = np.stack([products[place == node].mean(axis=0) for node in nodes])
    log_y = np.array([log_truth[place == node, 1].mean() for node in nodes])
    return SkinColorCorrection(found, log_y, covariance, nominal)


@lru_cache(maxsize=1)
def _modeled_skin() -> Float64Array:
    """Return spectra of skin with the surface reflection of instruments, (n, 31)."""
    axes = color_table.spectral_axes(COVARIANCE_NODES)
    limits = C_M_MAX, C_HD_MAX
    grids = [np.minimum(axis**3, limit) for axis, limit in zip(axes, limits, strict=True)]
    melanin, blood = np.meshgrid(*grids, indexing="ij")
    nodes = color_table.spectral_reflectance(melanin, blood, anisotropy=ANISOTROPY_SKIN)
    varied = optics_uncertainty.sigma_spectra(nodes)
    usual = _inside(melanin, MELANIN_RANGE) & _inside(blood, BLOOD_RANGE)
    chosen = varied[:, usual].reshape(-1, varied.shape[-1])
    return np.asarray(chosen + skin_tone.sphere_specular())


def _inside(values: Float64Array, limits: tuple[float, float]) -> BoolArray:
    return (values >= limits[0]) & (values <= limits[1])


def _weights(camera: str, illuminant: str, off: Float64Array) -> Float64Array:
    """Return band weights of a camera that is not nominal, white-balanced, (31, 3).

    Parameter `off`, (6,): shift of the center of each channel in nm, relative change of its width.
    """
    if not off.any():
        return spectra.band_weights(camera, illuminant)
    nm = np.arange(spectra.WAVELENGTH_NM[0], spectra.WAVELENGTH_NM[-1] + _STEP_NM, _STEP_NM)
    nominal = spectra.camera_sensitivity(camera, nm)
    channels = []
    for channel in range(3):
        center = float(np.average(nm, weights=np.abs(nominal[:, channel])))
        source = center + (nm - center - off[channel]) / (1.0 + off[3 + channel])
        channels.append(spectra.camera_sensitivity(camera, source)[:, channel])
    product = np.stack(channels, axis=1) * spectra.illuminant(illuminant, nm)[:, None]
    hats = np.stack([np.interp(nm, spectra.WAVELENGTH_NM, row) for row in np.eye(31)])
    found = hats @ product
    return np.asarray(found / found.sum(axis=0))


def _fit_to_chart(camera: str, illuminant: str, off: Float64Array, method: Method) -> ColorMatrix:
    """Fit the color matrix of white-balanced RGB as a calibration does, without noise."""
    patches = chart_spectra(spectra.WAVELENGTH_NM) @ _weights(camera, illuminant, off)
    named = illuminant if illuminant in WHITE_XYZ else "D50"
    patches /= neutral_white(patches).value
    reference = chart_reference(named)
    return fit_matrix(patches, reference, white=np.ones(3), illuminant=named, method=method)


def _log_xyz(linear_srgb: Float64Array) -> Float64Array:
    return np.asarray(np.log(np.maximum(linear_srgb @ _TO_XYZ.T, MIN_RELATIVE_XYZ)))


def _terms(log_xyz: Float64Array) -> Float64Array:
    """Return the regressors: quadratic in the two log ratios, linear in log Y, (..., 7)."""
    y = log_xyz[..., 1]
    x, z = log_xyz[..., 0] - y, log_xyz[..., 2] - y
    return np.stack([np.ones_like(y), x, z, x * x, x * z, z * z, y], axis=-1)
