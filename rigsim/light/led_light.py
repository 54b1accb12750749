"""Define the dome's unit of light: the signal of a perfect white in front of an LED."""

import math
from typing import Final

import numpy as np

from capture.rig import Light, View
from model import spectra
from rigsim.arrays import Float64Array

DOME_METER_RATE_PER_S: Final = 12.0
"""Full scales per second in the strongest channel of a perfect white that faces the LED of
`METERING_LED`: white needs 60 ms for 0.7 of full scale."""

METERING_LED: Final = (1.0, 40.0, 700.0)
"""Power in W, half-intensity angle in degrees and distance in mm of the LED that defines it."""


def white_intensity(light: Light, view: View) -> Float64Array:
    """Return the signal of a perfect white in front of an LED, shape (3,).

    A Lambertian white of reflectance 1 that faces the light on its axis at d mm gives
    ``white_intensity / d**2`` of full scale per second in camera RGB.

    Parameters
    ----------
    light
        An LED with its power, lobe and spectrum.
    view
        A camera with its sensitivities.

    Raises
    ------
    ValueError
        The light is not an LED.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("dome")
    >>> (white_intensity(rig.lights[0], rig.views[0]) / 700.0**2).round(1).tolist()
    [9.3, 12.0, 7.4]
    """
    if light.power_w is None:
        raise ValueError(f"light {light.name!r}: got no power_w, expected an LED; add power_w")
    power, half_deg, distance_mm = METERING_LED
    # The lobe cos^n over the half sphere integrates to 2 pi / (n + 1) times its axial value.
    unit = power * (_exponent(half_deg) + 1.0) / distance_mm**2
    strength = light.power_w * (lobe_exponent(light) + 1.0)
    white = spectra.camera_white(view.spectral_sensitivity, light.illuminant)
    return np.asarray(DOME_METER_RATE_PER_S * strength / unit * white)


def lobe_exponent(light: Light) -> float:
    """Return n of the lobe cos^n that halves at the light's ``half_intensity_deg``."""
    half_deg = light.half_intensity_deg
    return 0.0 if half_deg is None else _exponent(half_deg)


def _exponent(half_deg: float) -> float:
    return math.log(0.5) / math.log(math.cos(math.radians(half_deg)))
