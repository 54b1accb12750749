"""Spectra of narrow-band LEDs, by names such as LED-590-20: center and full width in nm."""

import re
from typing import Final

import numpy as np

from model.arrays import Float64Array

SAMPLES_PER_WIDTH: Final = 10
"""Samples of reflectance per full width: at 10 nm steps, skin under an LED is 0.7 % off."""
_NAME_PATTERN: Final = re.compile(r"LED-([0-9]{3})-([1-9][0-9]?)")
_HALF_RANGE: Final = 1.6  # widths on either side of the center; 2e-4 of the light is beyond


def is_led(name: str) -> bool:
    """Return whether a light's name is that of a narrow-band LED.

    Examples
    --------
    >>> is_led("LED-590-20"), is_led("LED-B3")
    (True, False)
    """
    return _NAME_PATTERN.fullmatch(name) is not None


def spectrum(name: str, wavelength_nm: Float64Array) -> Float64Array:
    """Return the relative power of an LED, Gaussian, 100 at its center.

    Parameters
    ----------
    name
        Name of the LED.
    wavelength_nm
        Wavelengths in nm, any shape.

    Raises
    ------
    ValueError
        For another name.

    Examples
    --------
    >>> spectrum("LED-590-20", np.array([590.0, 600.0])).tolist()
    [100.0, 50.0]
    """
    center_nm, width_nm = _band(name)
    return np.asarray(100.0 * 0.5 ** np.square(2.0 * (wavelength_nm - center_nm) / width_nm))


def samples(name: str) -> Float64Array:
    """Return wavelengths in nm that resolve skin under an LED.

    Examples
    --------
    >>> samples("LED-590-20")[[0, 16, -1]].tolist()
    [558.0, 590.0, 622.0]
    """
    center_nm, width_nm = _band(name)
    count = round(_HALF_RANGE * SAMPLES_PER_WIDTH)
    return np.asarray(center_nm + width_nm / SAMPLES_PER_WIDTH * np.arange(-count, count + 1))


def _band(name: str) -> tuple[float, float]:
    match = _NAME_PATTERN.fullmatch(name)
    if match is None:
        raise ValueError(f"light {name!r}: expected LED-CENTER-WIDTH in nm, such as LED-590-20")
    return float(match[1]), float(match[2])
