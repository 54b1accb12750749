"""Signals of skin in a camera's channels and under narrow-band LEDs, with their uncertainty.

The three channels under the camera's light, then one signal per LED: the sum of the channels. A
signal is relative to that of a perfect white. Unknown properties of skin and what the model leaves
unexplained of measured spectra enter as in `model.tissue_optics.uncertainty`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from model import spectra
from model.arrays import Float64Array
from model.fresnel import ETA_SKIN, normal_reflectance
from model.tissue_optics import uncertainty
from model.tissue_optics.skin_spectra import SKIN_PARAMETERS, log_reflectance

IS_LOG: Final = np.array(
    [True, True]
    + [
        next(one.is_log for one in uncertainty.NUISANCE_PARAMETERS if one.name == name)
        for name in SKIN_PARAMETERS[2:]
    ]
)
"""Whether a property of `SKIN_PARAMETERS` is varied by its logarithm."""
NUISANCE_SD: Final = np.array(
    [
        next(one.sd for one in uncertainty.NUISANCE_PARAMETERS if one.name == name)
        for name in SKIN_PARAMETERS[2:]
    ]
)
"""Prior standard deviations of all but melanin and blood, of the logarithm where `IS_LOG`."""
_STEP: Final = 0.01  # of central differences


@dataclass(frozen=True)
class BandSignals:
    """Signals of skin for one camera, its light, and LEDs."""

    camera: str
    """Name of the camera's sensitivity in `model.spectra`."""
    illuminant: str
    """Name of the light's spectrum."""
    leds: tuple[str, ...]
    """Names of the LEDs' spectra, such as "LED-590-20"."""

    @cached_property
    def wavelength_nm(self) -> Float64Array:
        """Wavelengths of all lights, one after the other, (n,)."""
        return np.concatenate([spectra.sampling(name) for name in (self.illuminant, *self.leds)])

    @cached_property
    def weights(self) -> Float64Array:
        """Weights of the wavelengths in each signal, (n, 3 + leds); each column sums to 1."""
        color = spectra.band_weights(self.camera, self.illuminant)
        bands = [gray_weights(self.camera, name)[:, None] for name in self.leds]
        return np.asarray(block_diag(color, *bands))

    def log_signals(self, skin: ArrayLike) -> Float64Array:
        """Return the logarithm of the signals.

        Parameters
        ----------
        skin
            Shape (..., 8), see `model.tissue_optics.skin_spectra.typical_skin`.

        Returns
        -------
        ndarray
            Shape (..., 3 + leds).

        Examples
        --------
        >>> from model.tissue_optics.skin_spectra import typical_skin
        >>> signals = BandSignals("Nikon 5100 (NPL)", "D55", ("LED-630-20",))
        >>> np.exp(signals.log_signals(typical_skin(0.1, 0.01))).round(2).tolist()
        [0.35, 0.25, 0.2, 0.42]
        """
        return np.asarray(np.log(np.exp(log_reflectance(self.wavelength_nm, skin)) @ self.weights))

    def jacobian(self, skin: ArrayLike) -> Float64Array:
        """Return derivatives of the log signals by all properties, of the logarithm where `IS_LOG`.

        Parameters
        ----------
        skin
            As in `log_signals`.

        Returns
        -------
        ndarray
            Shape (..., 3 + leds, 8).

        Examples
        --------
        >>> from model.tissue_optics.skin_spectra import typical_skin
        >>> signals = BandSignals("Nikon 5100 (NPL)", "D55", ())
        >>> bool((signals.jacobian(typical_skin(0.1, 0.01))[:, :2] < 0.0).all())
        True
        """
        at = np.asarray(skin, np.float64)
        columns = []
        for k, is_log in enumerate(IS_LOG):
            ends = []
            for step in (_STEP, -_STEP):
                moved = at.copy()
                moved[..., k] = moved[..., k] * np.exp(step) if is_log else moved[..., k] + step
                ends.append(self.log_signals(moved))
            columns.append((ends[0] - ends[1]) / (2.0 * _STEP))
        return np.stack(columns, axis=-1)

    def residual_covariance(self, skin: ArrayLike) -> Float64Array:
        """Return the covariance of log signals by what the model leaves unexplained.

        Parameters
        ----------
        skin
            As in `log_signals`.

        Returns
        -------
        ndarray
            Shape (..., signals, signals): residuals of measured spectra, by typology angle.
        """
        at = np.asarray(skin, np.float64)
        own = np.exp(log_reflectance(self.wavelength_nm, at))
        share = own[..., None] * self.weights / (own @ self.weights)[..., None, :]
        whole = np.exp(log_reflectance(spectra.WAVELENGTH_NM, at))
        angle = uncertainty.typology_angle(whole + normal_reflectance(ETA_SKIN))
        factors = uncertainty.residual_factors(angle, self.wavelength_nm)
        moved = factors @ share
        rest = uncertainty.unstored_residual_variance(angle)[..., None, None]
        return np.asarray(np.swapaxes(moved, -1, -2) @ moved + rest * np.eye(moved.shape[-1]))


def gray_weights(camera: str, illuminant_name: str) -> Float64Array:
    """Return weights that turn a sampled reflectance into the sum of a camera's channels.

    Parameters
    ----------
    camera, illuminant_name
        Names known to `model.spectra`.

    Returns
    -------
    ndarray
        Shape (n,) at `model.spectra.sampling` of the light; the sum is 1, the signal of a white.

    Examples
    --------
    >>> weights = gray_weights("Nikon 5100 (NPL)", "LED-590-20")
    >>> round(float(weights @ spectra.sampling("LED-590-20")))
    590
    """
    grid = spectra.sampling(illuminant_name)
    fine = np.linspace(grid[0], grid[-1], 8 * (grid.size - 1) + 1)
    response = spectra.illuminant(illuminant_name, fine) * spectra.camera_sensitivity(
        camera, fine
    ).sum(axis=-1)
    hats = np.maximum(1.0 - np.abs(fine - grid[:, None]) / (grid[1] - grid[0]), 0.0)
    weights = hats @ response
    return np.asarray(weights / weights.sum())
