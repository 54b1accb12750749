"""Uncertainty of skin's colors by optics that a color does not determine.

Skin of one melanin optical depth and one blood volume fraction has no single color: thickness of
the epidermis, oxygenation, scattering, baseline absorption and the kind of melanin differ between
people and sites. These nuisance parameters have published ranges (`NUISANCE_PARAMETERS`). Their
effect on the logarithm of a color is linearized around `SKIN_CONSTANTS`: a covariance J P J', with
the derivatives J at constant melanin optical depth at 550 nm and the priors' variances P. What the
model then still leaves unexplained of measured reflectance spectra is added as the covariance of
their residuals, by individual typology angle.

The data file is made by ``tools/make_optics_uncertainty.py``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from model import skin_tone, spectra
from model.arrays import Float64Array
from model.fresnel import ETA_SKIN, normal_reflectance

DATA_FILE: Final = "optics_uncertainty.npz"
COVARIANCE_NODES: Final = 33
"""Nodes along each axis of a color table's covariance, evenly in the axes' cube roots."""


@dataclass(frozen=True, slots=True)
class Nuisance:
    """A property of tissue that changes its color and is not estimated."""

    name: str
    """Field of `model.tissue_optics.TissueConstants`."""
    low: float
    """Lower end of the published range."""
    high: float
    """Upper end of the published range."""
    is_log: bool
    """Whether the distribution is of the logarithm."""
    source: str
    """Publication of the range."""

    @property
    def sd(self) -> float:
        """Standard deviation, of the logarithm if `is_log`: the range is read as +-2 of them."""
        ends = np.log([self.low, self.high]) if self.is_log else np.array([self.low, self.high])
        return float(np.ptp(ends) / 4.0)


_JACQUES = "Jacques 2013, doi:10.1088/0031-9155/58/11/R37"
NUISANCE_PARAMETERS: Final = (
    Nuisance("epidermis_mm", 0.05, 0.15, True, "Xu 2017, doi:10.1016/j.jaad.2017.06.009"),
    Nuisance("oxygenation", 0.4, 0.95, False, _JACQUES),
    Nuisance("scattering_per_mm", 2.0 * 2.97, 2.0 * 6.87, True, f"{_JACQUES}, table 1, skin"),
    Nuisance("scattering_slope", 0.705, 2.453, False, f"{_JACQUES}, table 1, skin"),
    Nuisance("baseline_factor", 0.5, 2.0, True, _JACQUES),
    Nuisance("eumelanin_fraction", 0.3, 1.0, False, "Donner 2008, doi:10.1145/1409060.1409093"),
)
"""Nuisance parameters in the order of the stored derivatives."""


@lru_cache(maxsize=1)
def _stored() -> dict[str, Float64Array]:
    source = resources.files("model").joinpath("data", DATA_FILE)
    with source.open("rb") as stream, np.load(stream) as stored:
        return {name: np.asarray(stored[name], dtype=np.float64) for name in stored.files}


@lru_cache(maxsize=1)
def _derivatives() -> Float64Array:
    """Return d log R / d nuisance at the covariance's nodes, (n, n, nuisances, wavelengths)."""
    gradient = _stored()["log_gradient"]
    coarse = np.linspace(0.0, 1.0, gradient.shape[0])
    fine = np.linspace(0.0, 1.0, COVARIANCE_NODES)
    flat = gradient.reshape(coarse.size, coarse.size, -1)
    found = [
        RectBivariateSpline(coarse, coarse, flat[..., k])(fine, fine) for k in range(flat.shape[2])
    ]
    return np.stack(found, axis=-1).reshape(fine.size, fine.size, *gradient.shape[2:])


def log_color_covariance(
    camera: str,
    illuminant: str,
    reflectance: Float64Array,
    *,
    without: Sequence[str] = (),
    residual: bool = True,
) -> Float64Array:
    """Return the covariance of log color by unknown optics, per node of a color table.

    Parameters
    ----------
    camera, illuminant
        Names known to `model.spectra`.
    reflectance
        (n, n, 31): spectra of `SKIN_CONSTANTS` at `COVARIANCE_NODES` nodes along each axis of a
        color table, at `model.spectra.WAVELENGTH_NM`.
    without
        Names of nuisance parameters that are taken as exactly known.
    residual
        Whether to add the covariance of measured spectra's residuals.

    Returns
    -------
    ndarray, shape (n, n, 3, 3)
        Covariance of the natural logarithm of white-balanced camera RGB.
    """
    weights = spectra.band_weights(camera, illuminant)
    color = reflectance @ weights
    # d log color = sum over the wavelengths of (w R / color) d log R
    share = reflectance[..., None] * weights / color[..., None, :]
    sd = np.array([0.0 if n.name in without else n.sd for n in NUISANCE_PARAMETERS])
    moved = np.einsum("ijkw,ijwc->ijck", _derivatives() * sd[:, None], share)
    covariance = np.einsum("ijck,ijdk->ijcd", moved, moved)
    if residual:
        covariance = covariance + _residual_covariance(reflectance, share)
    return np.asarray(covariance)


def _residual_covariance(reflectance: Float64Array, share: Float64Array) -> Float64Array:
    """Return the covariance of measured spectra's residuals, by each node's typology angle."""
    stored = _stored()
    of_band = [np.einsum("kw,ijwc->ijck", factors, share) for factors in stored["residual_factors"]]
    bands = np.stack([np.einsum("ijck,ijdk->ijcd", part, part) for part in of_band])
    angle = typology_angle(reflectance + normal_reflectance(ETA_SKIN))
    low, part = _band_position(angle)
    part = part[..., None, None]
    i, j = np.indices(angle.shape)
    return np.asarray((1.0 - part) * bands[low, i, j] + part * bands[low + 1, i, j])


def residual_factors(angle_deg: ArrayLike, wavelength_nm: ArrayLike) -> Float64Array:
    """Return the largest factors F of the covariance F'F of measured spectra's residuals in log R.

    Parameters
    ----------
    angle_deg
        Individual typology angles, degrees, any shape; those beyond the stored ones count as these.
    wavelength_nm
        Wavelengths in nm, shape (w,), interpolated linearly between `model.spectra.WAVELENGTH_NM`;
        beyond them the nearest one counts.

    Returns
    -------
    ndarray, shape (..., f, w)

    Examples
    --------
    >>> residual_factors([20.0, -30.0], [550.0, 560.0]).shape
    (2, 12, 2)
    """
    stored = _stored()
    grid = spectra.WAVELENGTH_NM
    nm = np.clip(np.asarray(wavelength_nm, np.float64), grid[0], grid[-1])
    hats = np.maximum(1.0 - np.abs(grid[:, None] - nm) / (grid[1] - grid[0]), 0.0)
    low, part = _band_position(np.asarray(angle_deg, np.float64))
    part = part[..., None, None]
    factors = stored["residual_factors"] @ hats
    both = np.sqrt(1.0 - part) * factors[low], np.sqrt(part) * factors[low + 1]
    return np.concatenate(both, axis=-2)


def unstored_residual_variance(angle_deg: ArrayLike) -> Float64Array:
    """Return a variance per wavelength for the factors of the residuals that are not stored.

    It is that of the smallest stored factor, of which none of the others is larger.

    Parameters
    ----------
    angle_deg
        Individual typology angles, degrees, any shape.

    Examples
    --------
    >>> float(np.sqrt(unstored_residual_variance(35.0)).round(4))
    0.0032
    """
    smallest = np.square(_stored()["residual_factors"][:, -1]).mean(axis=-1)
    low, part = _band_position(np.asarray(angle_deg, np.float64))
    return np.asarray((1.0 - part) * smallest[low] + part * smallest[low + 1])


def _band_position(angle_deg: Float64Array) -> tuple[NDArray[np.intp], Float64Array]:
    """Return the band of typology angles below each angle, and the fraction of the next one."""
    centers = _stored()["typology_angle_deg"]
    place = np.interp(-angle_deg, -centers, np.arange(centers.size))
    low = np.minimum(place.astype(np.intp), centers.size - 2)
    return low, np.asarray(place - low)


def typology_angle(reflectance: ArrayLike) -> Float64Array:
    """Return the individual typology angle of spectra (..., 31) under D65, degrees, (...).

    Examples
    --------
    >>> typology_angle(np.linspace(0.2, 0.6, 31)).round().tolist()
    47.0
    """
    return skin_tone.ita(skin_tone.lab_of_spectra(reflectance, spectra.WAVELENGTH_NM))


def sigma_spectra(reflectance: Float64Array) -> Float64Array:
    """Return spectra with each unknown of skin one standard deviation below and above its mean.

    Parameters
    ----------
    reflectance
        (n, n, 31), as for `log_color_covariance`.

    Returns
    -------
    ndarray, shape (1 + 2 k, n, n, 31)
        The given spectra, then two for each of the k unknowns, to first order in log R: the
        `NUISANCE_PARAMETERS`, then the principal residuals of measured spectra of each node's
        typology angle.

    Examples
    --------
    >>> found = sigma_spectra(np.full((COVARIANCE_NODES, COVARIANCE_NODES, 31), 0.4))
    >>> found.shape[0] > 2 * len(NUISANCE_PARAMETERS), found.shape[1:]
    (True, (33, 33, 31))
    """
    stored = _stored()
    steps = list(np.moveaxis(_derivatives(), 2, 0) * _nuisance_sd()[:, None, None, None])
    angle = typology_angle(reflectance + normal_reflectance(ETA_SKIN))
    band = np.abs(angle[..., None] - stored["typology_angle_deg"]).argmin(axis=-1)
    steps += list(np.moveaxis(stored["residual_factors"][band], 2, 0))
    both = [np.zeros_like(reflectance), *(sign * step for step in steps for sign in (-1.0, 1.0))]
    return np.asarray(reflectance * np.exp(np.stack(both)))


def _nuisance_sd() -> Float64Array:
    return np.array([nuisance.sd for nuisance in NUISANCE_PARAMETERS])
