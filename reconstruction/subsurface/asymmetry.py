"""Find media whose asymmetry g is outside the prior, by fits with other g.

Near the source a profile depends on the phase function. A medium of another g than the prior's is
then fitted by wrong coefficients: sigma_tr is up to 40 % off for isotropic scattering. Such a
profile is fitted well with any g of the photon table, while layered tissue is fitted by no
homogeneous medium. The gain of chi2 by the free g follows at most chi2 of one degree of freedom for
media inside the prior, since their prior's part of chi2 is that of one normal deviate (Wilks 1938,
doi:10.1214/aoms/1177732360).

Fibers beyond a few transport lengths collect diffuse light, of any g. Where such a profile does not
exclude isotropic scattering, its sigma_tr relies on the prior. The standard error then includes the
difference to the sigma_tr of isotropic scattering.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from model.photon_table import stored_asymmetries
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.subsurface.models import ProfileModel
from reconstruction.subsurface.profile_batch import Fits, ProfileBatch
from reconstruction.subsurface.profile_fit import MISFIT_P_VALUE, fit_profiles

MAX_ASYMMETRY_GAIN: Final = 10.83
"""Gain of chi2 above which g counts as outside its prior: chi2 of one degree at p = 0.001."""
MIN_PULL: Final = 1.0
"""Deviations of the prior by which a fitted g is off, from which a fit with any g is made. Misfits
have it too."""
MIN_BIAS_GAIN: Final = 2.0
"""Gain of chi2 from which the other fit's sigma_tr widens the standard error."""
MIN_PRIOR_FRACTION: Final = 0.5
"""Posterior over prior deviation of g from which isotropic scattering is compared."""
FLAT_PRIOR_SIGMA: Final = 1e3
"""Standard deviation of g that makes its prior flat."""


def compare_asymmetries(
    batch: ProfileBatch, fits: Fits, model_with: Callable[[float, float], ProfileModel]
) -> Fits:
    """Return fits with their `Fits.asymmetry_gain`, and with the error due to g in `Fits.bias`.

    Where a free g fits better without doubt, the gain makes the fit invalid. Where it fits only
    somewhat better, or where isotropic scattering fits as well, the difference of log sigma_tr is
    added to the systematic error.

    Parameters
    ----------
    batch
        The profiles, with variances.
    fits
        Their fits within the prior.
    model_with
        Function from mean and standard deviation of g to a model.
    """
    low, high = stored_asymmetries()[0], stored_asymmetries()[-1]
    mean, deviation = batch.prior[3]
    misfit = _is_misfit(fits)
    gain, bias = fits.asymmetry_gain.copy(), fits.bias.copy()

    pull = np.abs(fits.theta[:, 3] - mean) / deviation
    rows = np.flatnonzero((pull > MIN_PULL) | misfit)
    if rows.size:
        center = 0.5 * (low + high)
        model = model_with(center, (high - low) / 6.0)  # three deviations to either side
        other = _fit_with(batch, rows, model, center, FLAT_PRIOR_SIGMA)
        better = np.maximum(fits.chi2[rows] - other.chi2, 0.0)
        gain[rows] = np.where(_is_misfit(other), 0.0, better)
        shift = _log_sigma_tr(other.theta) - _log_sigma_tr(fits.theta[rows])
        bias[rows] = np.hypot(bias[rows], np.where(gain[rows] > MIN_BIAS_GAIN, shift, 0.0))

    unclear = np.sqrt(fits.covariance[:, 3, 3]) > MIN_PRIOR_FRACTION * deviation
    rows = np.flatnonzero(unclear & ~misfit & (gain <= MAX_ASYMMETRY_GAIN))
    if rows.size:
        other = _fit_with(batch, rows, model_with(low, 0.0), low, 0.0)
        excluded = other.chi2 - fits.chi2[rows] > MAX_ASYMMETRY_GAIN
        shift = _log_sigma_tr(other.theta) - _log_sigma_tr(fits.theta[rows])
        bias[rows] = np.hypot(bias[rows], np.where(excluded, 0.0, shift))
    return replace(fits, asymmetry_gain=gain, bias=bias)


def _fit_with(
    batch: ProfileBatch, rows: NDArray[np.intp], model: ProfileModel, g: float, g_error: float
) -> Fits:
    """Fit some profiles with another prior of g."""
    prior = batch.prior.copy()
    prior[3] = g, g_error
    return fit_profiles(replace(batch.select(rows), prior=prior), model)


def _is_misfit(fits: Fits) -> BoolArray:
    """Return which fits have residuals above their stated errors, (N,)."""
    dof = np.maximum(fits.used.sum(axis=1) - 2, 1)
    return np.asarray(gammaincc(dof / 2.0, fits.chi2 / 2.0) < MISFIT_P_VALUE)


def _log_sigma_tr(theta: Float64Array) -> Float64Array:
    """Return log sigma_tr up to a constant, (N,)."""
    a, s = np.exp(theta[:, 0]), np.exp(theta[:, 1])
    return np.asarray(0.5 * np.log(a * (a + s)))
