"""The spline over dimensionless coordinates against adding-doubling at each wavelength."""

from dataclasses import replace

import numpy as np
import pytest

from model import spectra
from model.tissue_optics import SKIN_CONSTANTS, TissueError, two_layer_reflectance
from model.tissue_optics.band_signals import IS_LOG, NUISANCE_SD, BandSignals
from model.tissue_optics.layers import ANISOTROPY_SKIN
from model.tissue_optics.skin_spectra import SKIN_PARAMETERS, log_reflectance, typical_skin
from model.tissue_optics.uncertainty import NUISANCE_PARAMETERS

LEDS = ("LED-450-20", "LED-600-20")


def drawn_skin(rng):
    """Return skin over published ranges, its constants and fractions."""
    drawn = {}
    for one in NUISANCE_PARAMETERS:
        ends = (one.low, one.high)
        drawn[one.name] = float(
            np.exp(rng.uniform(*np.log(ends))) if one.is_log else rng.uniform(*ends)
        )
    constants = replace(SKIN_CONSTANTS, **drawn)
    c_m, blood = rng.uniform(0.2, 0.65) ** 3, np.exp(rng.uniform(np.log(0.002), np.log(0.08)))
    skin = typical_skin(c_m * constants.melanin_depth_factor, blood)
    for name, value in drawn.items():
        skin[SKIN_PARAMETERS.index(name)] = value
    return skin, constants, c_m, blood


def test_spline_agrees_with_adding_doubling_of_drawn_skin():
    """Tolerance: 0.6 % anywhere, 0.05 % in the median; LEDs change colors by 3 % and more."""
    rng = np.random.default_rng(3)
    nm = np.array([420.0, 450.0, 541.0, 577.0, 603.0, 690.0])
    errors = []
    for _ in range(12):
        skin, constants, c_m, blood = drawn_skin(rng)
        exact = two_layer_reflectance(
            nm, c_m, blood, constants=constants, anisotropy=ANISOTROPY_SKIN
        )
        errors.append(np.abs(np.exp(log_reflectance(nm, skin)) / exact - 1.0))
    assert np.max(errors) < 6e-3
    assert np.median(errors) < 5e-4


def test_leading_axes_broadcast_like_a_loop():
    skin = typical_skin(np.array([[0.1, 0.4], [0.2, 0.8]]), 0.01)
    whole = log_reflectance([500.0, 600.0], skin)
    each = [[log_reflectance([500.0, 600.0], one) for one in row] for row in skin]
    np.testing.assert_allclose(whole, each, rtol=1e-12)


def test_skin_beyond_table_is_one_error():
    with pytest.raises(TissueError, match="absorption depth"):
        log_reflectance([400.0], typical_skin(60.0, 0.01))


def test_fine_sampling_matters_at_hemoglobin_bands():
    """Rationale: at 10 nm steps the signal at 577 nm is off by more than camera noise."""
    skin = typical_skin(0.1, 0.02)
    fine = BandSignals("Nikon 5100 (NPL)", "D55", ("LED-577-20",)).log_signals(skin)[3]
    nm = spectra.WAVELENGTH_NM
    share = spectra.illuminant("LED-577-20", np.arange(400.0, 701.0))
    coarse = np.interp(np.arange(400.0, 701.0), nm, np.exp(log_reflectance(nm, skin)))
    assert abs(np.log(coarse @ share / share.sum()) - fine) > 0.004


def test_jacobian_predicts_small_changes():
    signals = BandSignals("Nikon 5100 (NPL)", "D55", LEDS)
    skin = typical_skin(0.2, 0.012)
    slopes, before = signals.jacobian(skin), signals.log_signals(skin)
    for k, is_log in enumerate(IS_LOG):
        moved = skin.copy()
        moved[k] = moved[k] * np.exp(0.005) if is_log else moved[k] + 0.005
        change = signals.log_signals(moved) - before
        np.testing.assert_allclose(change, 0.005 * slopes[:, k], atol=2e-5)


def test_residual_covariance_is_positive_for_any_leds():
    leds = tuple(f"LED-{nm}-20" for nm in range(440, 681, 20))
    signals = BandSignals("Nikon 5100 (NPL)", "D55", leds)
    covariance = signals.residual_covariance(typical_skin([0.05, 0.3, 1.0], 0.012))
    assert np.linalg.eigvalsh(covariance).min() > 0.001**2
    assert NUISANCE_SD.shape == (len(SKIN_PARAMETERS) - 2,)
