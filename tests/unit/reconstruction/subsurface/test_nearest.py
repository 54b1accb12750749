"""The nearest medium to a profile that is of none: by its definition, with errors of readings."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from model import photon_table
from reconstruction import subsurface
from reconstruction.subsurface.nearest import MIN_REFLECTANCE_PER_MM2
from reconstruction.subsurface.outcome import FitOutcome

RADIUS = 0.3 + 0.25 * np.arange(28)
CORES = {"core_mm": 0.2, "source_core_mm": 0.2}
LAYERED = 0.05 * np.sin(1.3 * np.sqrt(RADIUS) * np.pi)
"""Misfit of the logarithm that no homogeneous medium has."""


def table(a, s):
    return photon_table.reflectance(RADIUS, a, s, g=0.8, collection="fiber", **CORES)


@pytest.fixture(scope="module")
def layered():
    return 0.4 * table(0.03, 4.0) * np.exp(LAYERED)


def by_definition(profile):
    """Return log sigma_tr by a search of its own: equal weights of all logarithms."""

    def off(logs):
        found = np.log(profile) - np.log(table(*np.exp(logs)))
        return found - found.mean()

    a, s = np.exp(least_squares(off, np.log([0.03, 4.0])).x)
    return 0.5 * np.log(3.0 * a * (a + s))


def test_nearest_medium_matches_definition_under_any_noise(layered):
    assert (layered > MIN_REFLECTANCE_PER_MM2).all()
    told = by_definition(layered)
    for noise in (1e-4, 1e-3):
        growing = noise * np.exp(0.3 * RADIUS)  # far fibers are the worse
        fit = subsurface.nearest_medium(RADIUS, layered, variance=(growing * layered) ** 2, **CORES)
        assert np.log(fit.sigma_tr_per_mm) == pytest.approx(told, abs=5e-3)
        assert fit.valid
    # weights by the noise find another medium, so the test can fail
    weights = 1e-3 * np.exp(0.3 * RADIUS)

    def off(parameters):
        a, s, factor = np.exp(parameters)
        return (np.log(layered) - np.log(factor * table(a, s))) / weights

    a, s, _ = np.exp(least_squares(off, np.log([0.03, 4.0, 0.4])).x)
    assert abs(0.5 * np.log(3.0 * a * (a + s)) - told) > 0.01


def test_standard_errors_come_from_readings_not_misfit(layered):
    """200 draws; deviations are known to 5 %, and the table's own error is not drawn."""
    rng = np.random.default_rng(4)
    noise = 0.01
    readings = layered * (1.0 + noise * rng.standard_normal((200, 28)))
    variance = np.broadcast_to((noise * layered) ** 2, (200, 28))
    fit = subsurface.nearest_medium(RADIUS, readings, variance=variance, **CORES)
    off = np.log(fit.sigma_tr_per_mm) - by_definition(layered)
    stated = np.median(fit.sigma_tr_stderr / fit.sigma_tr_per_mm)
    assert 0.65 < np.sqrt(np.mean(off**2)) / stated < 1.2
    assert stated < 0.5 * np.median(fit.model_error)


def test_noisy_far_fibers_keep_estimate_near_definition(layered):
    """200 draws, noise of half a far reading: that profiles are smooth tells what is hidden."""
    rng = np.random.default_rng(11)
    noise = 0.002 * np.exp(0.8 * RADIUS)
    readings = layered * (1.0 + noise * rng.standard_normal((200, 28)))
    variance = np.broadcast_to((noise * layered) ** 2, readings.shape)
    fit = subsurface.nearest_medium(RADIUS, readings, variance=variance, **CORES)
    off = np.log(fit.sigma_tr_per_mm) - by_definition(layered)
    stated = fit.sigma_tr_stderr / fit.sigma_tr_per_mm
    assert fit.valid.all()
    assert np.sqrt(np.mean((off / stated) ** 2)) < 1.5
    assert np.median(stated) < 0.06

    # near fibers alone, as far as noise leaves them, find another medium: the test can fail
    def residual(parameters):
        a, s, factor = np.exp(parameters)
        return (np.log(layered) - np.log(factor * table(a, s))) / np.hypot(noise, 0.02)

    a, s, _ = np.exp(least_squares(residual, np.log([0.03, 4.0, 0.4])).x)
    weighed = 0.5 * np.log(3.0 * a * (a + s)) - by_definition(layered)
    assert abs(np.mean(off)) < 0.3 * abs(weighed)


def test_fiber_far_from_nearest_medium_is_not_omitted(layered):
    bent = layered.copy()
    bent[0] *= 1.3
    fit = subsurface.nearest_medium(RADIUS, bent, variance=(1e-3 * bent) ** 2, **CORES)
    assert fit.used.all()
    assert np.log(fit.sigma_tr_per_mm) == pytest.approx(by_definition(bent), abs=3e-3)
    assert fit.outcome & FitOutcome.MISFIT


def test_fibers_below_definition_light_level_are_ignored():
    dark = 0.5 * table(0.6, 2.0) * np.exp(LAYERED)
    fit = subsurface.nearest_medium(RADIUS, dark, variance=(1e-3 * dark) ** 2, **CORES)
    assert 10 < fit.used.sum() < 28
    # one fiber at the limit may be on either side of it
    assert (fit.used != (dark >= MIN_REFLECTANCE_PER_MM2)).sum() <= 1


def test_too_little_light_gives_no_estimate(layered):
    fit = subsurface.nearest_medium(RADIUS, layered, variance=(3.0 * layered) ** 2, **CORES)
    assert not fit.valid
    assert fit.outcome & (FitOutcome.NO_SIGNAL | FitOutcome.TOO_FEW_FIBERS)
    assert np.isnan(fit.sigma_tr_per_mm)
    assert np.isinf(fit.sigma_tr_stderr)
