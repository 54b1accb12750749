"""Nominal color of a rig's cameras, for programs that develop its raw files."""

from functools import lru_cache
from typing import Final

import numpy as np

from capture.raw import CameraColor
from capture.rig import Rig
from model import color_table, spectra
from model.tissue_optics.layers import ANISOTROPY_SKIN
from skinrig.arrays import Float64Array

MATRIX_ILLUMINANT: Final = "D65"
WHITE_D65: Final = np.array([0.95047, 1.0, 1.08883])
"""CIE XYZ of D65, IEC 61966-2-1."""
SKIN_NODES: Final = 24
"""Nodes per axis of the skin color table to which `fit_skin_colors` fits."""
PEAK_SD_NM: Final = 40.0
"""Standard deviation of the peaks of spectra that are not skin; one peak per wavelength."""
SKIN_WEIGHT, WHITE_WEIGHT = 10.0, 1e4
"""Weights in the fit of a matrix; those of spectra with a peak are 1."""


def nominal_camera_colors(rig: Rig) -> dict[str, CameraColor]:
    """Return the color of each camera, by view, from the sensitivities that the rig names.

    The matrix maps colors of surfaces under D65 to camera RGB in the light of the rig. It is fitted
    to spectra of skin and to smooth spectra, and is exact for white. Cameras without a color filter
    array, or with sensitivities or lights that `model.spectra` does not contain, have no entry.
    """
    light = rig.lights[0].illuminant if rig.lights else ""
    if light not in spectra.illuminant_names():
        return {}
    return {
        view.name: _nominal_color(view.spectral_sensitivity, light)
        for view in rig.views
        if view.cfa != "MONO" and view.spectral_sensitivity in spectra.camera_names()
    }


def fit_skin_colors(camera: str, illuminant: str) -> tuple[Float64Array, float]:
    """Fit a matrix from camera RGB of skin, relative to white, to linear sRGB under D65.

    Parameters
    ----------
    camera, illuminant
        Names of `model.spectra`.

    Returns
    -------
    matrix : ndarray of float64, shape (3, 3)
        For rows of colors: ``rgb @ matrix``.
    rms : float
        Root mean square of the residuals over the skin color table.

    Examples
    --------
    >>> matrix, rms = fit_skin_colors("linear sRGB", "D65")
    >>> bool(np.allclose(matrix, np.eye(3))), rms < 1e-9
    (True, True)
    """
    measured, shown = (
        color_table.build(*pair, size=SKIN_NODES, anisotropy=ANISOTROPY_SKIN).rgb.reshape(-1, 3)
        for pair in ((camera, illuminant), (spectra.LINEAR_SRGB, MATRIX_ILLUMINANT))
    )
    matrix = np.asarray(np.linalg.lstsq(measured, shown, rcond=None)[0], np.float64)
    return matrix, float(np.sqrt(np.mean((measured @ matrix - shown) ** 2)))


@lru_cache(maxsize=8)
def _nominal_color(camera: str, light: str) -> CameraColor:
    reflectance, weight = _training_spectra()
    xyz = reflectance * spectra.illuminant(MATRIX_ILLUMINANT) @ spectra.color_matching_functions()
    rgb = reflectance * spectra.illuminant(light) @ spectra.camera_sensitivity(camera)
    scale = (weight / xyz[:, 1])[:, None]  # relative errors count
    matrix = np.linalg.lstsq(xyz * scale, rgb * scale, rcond=None)[0].T
    # rounded, so that the last bits of a solver never change the bytes of a session
    matrix = np.round(matrix / (matrix @ WHITE_D65).max(), 4)
    red, green, blue = np.round(spectra.camera_white(camera, light), 4).tolist()
    return CameraColor(matrix, (red, green, blue))


def _training_spectra() -> tuple[Float64Array, Float64Array]:
    """Return reflectances (n, 31) of skin, of colored peaks and of white, and weights (n,)."""
    wavelength_nm = spectra.WAVELENGTH_NM
    c_m, c_hd = np.geomspace(0.004, 0.4, 12)[:, None], np.geomspace(0.003, 0.06, 6)
    skin = color_table.spectral_reflectance(c_m, c_hd, anisotropy=ANISOTROPY_SKIN)
    peaks = np.exp(-0.5 * np.square((wavelength_nm[:, None] - wavelength_nm) / PEAK_SD_NM))
    white = np.ones((1, wavelength_nm.size))
    parts = (
        (skin.reshape(-1, wavelength_nm.size), SKIN_WEIGHT),
        (peaks, 1.0),
        (white, WHITE_WEIGHT),
    )
    reflectance = np.concatenate([part for part, _ in parts])
    return reflectance, np.concatenate([np.full(len(part), each) for part, each in parts])
