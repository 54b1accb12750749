"""Oxygenation from colors and LEDs: Monte Carlo people, interval calibration, refusals."""

import numpy as np
import pytest

from model.tissue_optics.band_signals import IS_LOG, NUISANCE_SD
from model.tissue_optics.skin_spectra import typical_skin
from reconstruction.chromophores.pixel_checks import ChromophoreError
from reconstruction.narrow_bands.band_fit import (
    OXYGENATION_SD,
    SignalTable,
    fit_bands,
    prior_moments,
    signal_table,
)
from skinrig.benchmarks.flash_rig.oxygenation import (
    LED_SETS,
    LOG_SHADING,
    SIGNAL_NOISE,
    draw_people,
)

LEDS = LED_SETS["450:20,580:20,600:20"]
CAMERA = ("Nikon 5100 (NPL)", "D55")
PEOPLE = 16


@pytest.fixture(scope="module")
def table():
    return signal_table(*CAMERA, LEDS)


def fit(table, signals, **changed):
    flat = signals.reshape(-1, signals.shape[-1])
    return fit_bands(
        flat, np.square(SIGNAL_NOISE * flat), table, **({"log_shading": LOG_SHADING} | changed)
    )


@pytest.mark.long
def test_leds_recover_oxygenation_of_monte_carlo_people(table):
    """Expected: RMS error below the prior's standard deviation by the factor of the intervals."""
    people = draw_people("published", LEDS, PEOPLE)
    found = fit(table, people.signals)
    off = found.oxygenation.reshape(3, -1) - people.oxygenation
    assert (np.sqrt((off**2).mean(axis=1)) < [0.075, 0.08, 0.1]).all()
    assert found.stderr[:, 2].reshape(3, -1)[:2].max() < 0.1


def test_colors_alone_leave_oxygenation_at_prior():
    """Rationale: three channels average over the bands of both hemoglobins."""
    people = draw_people("published", (), 5)  # any number proves it
    found = fit(signal_table(*CAMERA, ()), people.signals)
    assert not found.valid.any()
    assert found.stderr[:, 2].min() > 0.98 * OXYGENATION_SD
    off = found.oxygenation.reshape(3, -1) - people.oxygenation
    assert np.sqrt((off**2).mean()) > 0.9 * people.oxygenation.std()


def drawn_from_model(table, rng, count):
    """Return signals and oxygenation of skin drawn from the estimator's own priors."""
    mean, sd = prior_moments(LOG_SHADING)
    sd = sd * np.array([0.5, 0.5, 1.0, 1.0])
    drawn = mean + sd * rng.standard_normal((count, 4))
    skin = typical_skin(np.exp(drawn[:, 0]), np.exp(drawn[:, 1]))
    skin[:, 2] = np.clip(drawn[:, 2], 0.0, 1.0)
    step = NUISANCE_SD[1:] * rng.standard_normal((count, NUISANCE_SD.size - 1))
    is_log = IS_LOG[3:]
    skin[:, 3:] = np.where(is_log, skin[:, 3:] * np.exp(step), skin[:, 3:] + step)
    skin[:, 3:] = np.clip(skin[:, 3:], [0.04, 5.0, 0.5, 0.4, 0.2], [0.18, 15.0, 2.8, 2.2, 1.0])
    unexplained = np.linalg.cholesky(table.signals.residual_covariance(skin))
    log_light = table.signals.log_signals(skin) + drawn[:, 3:]
    log_light += (unexplained @ rng.standard_normal((*log_light.shape, 1)))[..., 0]
    return np.exp(log_light + SIGNAL_NOISE * rng.standard_normal(log_light.shape)), skin[:, 2]


def test_intervals_cover_skin_of_model_at_stated_rate(table):
    """Expected: 68 %; 2000 draws have a standard error of 1 %, and the model is not linear."""
    light, truth = drawn_from_model(table, np.random.default_rng(8), 2000)
    found = fit(table, light)
    covered = np.abs(found.oxygenation - truth) <= found.stderr[:, 2]
    assert covered.mean() == pytest.approx(0.683, abs=0.05)


def test_intervals_without_unknown_optics_cover_too_little(table):
    light, truth = drawn_from_model(table, np.random.default_rng(8), 500)
    sure = SignalTable(table.signals)
    sure.__dict__["covariance"] = 1e-8 * table.covariance
    found = fit(sure, light)
    assert (np.abs(found.oxygenation - truth) <= found.stderr[:, 2]).mean() < 0.4


def test_noise_error_predicts_scatter_of_repeats(table):
    light = np.exp(table.signals.log_signals(typical_skin(0.12, 0.012)))
    rng = np.random.default_rng(4)
    found = fit(table, light * (1.0 + SIGNAL_NOISE * rng.standard_normal((1000, light.size))))
    ratio = found.oxygenation.std() / np.median(found.noise_stderr[:, 2])
    assert ratio == pytest.approx(1.0, abs=0.15)


def test_other_material_is_invalid(table):
    painted = np.exp(table.signals.log_signals(typical_skin(0.12, 0.012)))
    painted[[0, 3]] *= 0.3
    assert not fit(table, painted[None]).valid.any()


@pytest.mark.parametrize("wrong", [np.ones((2, 5)), np.zeros((2, 6)), np.full((2, 6), np.nan)])
def test_wrong_signals_are_one_error(table, wrong):
    with pytest.raises(ChromophoreError, match="signals"):
        fit_bands(wrong, np.ones_like(wrong), table, log_shading=LOG_SHADING)
