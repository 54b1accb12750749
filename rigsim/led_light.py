"""How much of a camera's full scale the light of an LED gives, from watts to electrons."""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import Light, View
from model import spectra

FloatArray = NDArray[np.float64]

PHOTONS_PER_J_NM: Final = 1e-9 / (6.62607015e-34 * 2.99792458e8)
"""Photons in a joule of light per nm of its wavelength (SI, exact constants)."""

PEAK_QUANTUM_EFFICIENCY: Final = 0.45
"""Electrons per photon at the peak of the strongest filter: a common front-lit CMOS sensor."""

LENS_TRANSMISSION: Final = 0.85
"""Of a coated lens of a few elements."""


def white_intensity(light: Light, view: View) -> FloatArray:
    """Return what a camera sees of a perfect white before an LED, shape (3,).

    A Lambertian white of reflectance 1 that faces the light on its axis at d mm, seen from
    anywhere, gives ``white_intensity / d**2`` of full scale per second in camera RGB; d is large
    against the light.

    Parameters
    ----------
    light
        An LED with its power, lobe and spectrum.
    view
        A camera with its lens, pixel, full well and sensitivities.

    Raises
    ------
    ValueError
        The light is no LED.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("dome")
    >>> (white_intensity(rig.lights[0], rig.views[0]) / 700.0**2).round(1).tolist()
    [2.5, 3.2, 2.0]
    """
    if light.power_w is None:
        raise ValueError(f"light {light.name!r}: got no power_w, expected an LED")
    # The lobe cos^n over the half sphere holds 2 pi / (n + 1) of the intensity on the axis.
    peak_w_per_sr = light.power_w * (lobe_exponent(light) + 1.0) / (2.0 * math.pi)
    # E = intensity / d^2 on the white, its radiance E / pi, and pi / 4 N^2 of it on the sensor.
    sensor_w_per_mm2 = peak_w_per_sr / math.pi * math.pi / (4.0 * view.f_number**2)
    watts = sensor_w_per_mm2 * LENS_TRANSMISSION * (view.pixel_um * 1e-3) ** 2
    electrons = watts * _electrons_per_j(light.illuminant, view.spectral_sensitivity)
    return electrons / view.full_well_e


def lobe_exponent(light: Light) -> float:
    """Return n of the lobe cos^n that halves at the light's ``half_intensity_deg``."""
    if light.half_intensity_deg is None:
        return 0.0
    return math.log(0.5) / math.log(math.cos(math.radians(light.half_intensity_deg)))


@cache
def _electrons_per_j(illuminant: str, camera: str) -> FloatArray:
    wavelength_nm = np.arange(380.0, 781.0, 1.0)
    power = spectra.illuminant(illuminant, wavelength_nm)
    sensitivity = spectra.camera_sensitivity(camera, wavelength_nm)  # per unit of energy
    row, column = np.unravel_index(np.argmax(sensitivity), sensitivity.shape)
    peak = PEAK_QUANTUM_EFFICIENCY * PHOTONS_PER_J_NM * wavelength_nm[row]
    return np.asarray(power @ (sensitivity / sensitivity[row, column] * peak) / power.sum())
