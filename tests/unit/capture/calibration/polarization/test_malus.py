from datetime import date

import numpy as np
import pytest
from scipy.stats import binom

from capture.calibration import store
from capture.calibration.polarization.malus import (
    PolarizationCalibration,
    PolarizationError,
    find_modulated_pixels,
    fit_malus,
)

ANGLES = np.deg2rad(np.arange(0.0, 181.0, 15.0))


def malus(angles, *, zero=0.03, extinction=500.0, top=0.8):
    c = np.cos(angles - zero) ** 2
    return top * (c + (1 - c) / extinction)


def measured(rng, *, extinction=500.0, jitter=0.005, noise=2e-5, repeats=2, zero=0.03):
    angles = np.tile(ANGLES, repeats)
    truth = malus(angles, extinction=extinction, zero=zero)
    variance = noise**2 + 1e-8 * truth
    light = 1 + jitter * rng.normal(size=angles.size)
    return angles, truth * light + np.sqrt(variance) * rng.normal(size=angles.size), variance


@pytest.mark.parametrize("zero_deg", [-89.0, -30.0, 0.0, 2.5, 60.0, 89.9])
@pytest.mark.parametrize("extinction", [1.5, 20.0, 1e3, 1e6])
def test_noise_free_series_gives_exact_zero_and_extinction(zero_deg, extinction):
    zero = np.deg2rad(zero_deg)
    fit = fit_malus(ANGLES, malus(ANGLES, zero=zero, extinction=extinction))
    assert fit.zero_rad[0] == pytest.approx(zero, abs=1e-9)
    assert fit.leak[0] == pytest.approx(1 / extinction, abs=1e-9)


def test_analyzer_rotated_oppositely_has_opposite_zero():
    fit = fit_malus(-ANGLES, malus(ANGLES, zero=0.1))
    assert fit.zero_rad[0] == pytest.approx(-0.1)


def covered(values, truth, errors, *, share=0.6827, false_alarm=1e-3):
    inside = int((np.abs(values - truth) < errors).sum())
    low, high = binom.ppf([false_alarm / 2, 1 - false_alarm / 2], len(values), share)
    return low <= inside <= high


@pytest.fixture(scope="module")
def fits():
    series = [measured(np.random.default_rng([5, seed])) for seed in range(150)]
    return [fit_malus(a, i, variance=v) for a, i, v in series]


def test_stated_zero_and_leak_errors_cover_68_percent(fits):
    """26 frames, light scattering by 0.5 %, which the fit has to find out: false-alarm rate 1e-3.

    One standard error from 23 degrees of freedom holds 67 %, which the band includes.
    """
    zero = np.array([f.zero_rad[0] for f in fits])
    leak = np.array([f.leak[0] for f in fits])
    assert covered(zero, 0.03, np.array([f.zero_stderr_rad[0] for f in fits]))
    assert covered(leak, 1 / 500, np.array([f.leak_stderr[0] for f in fits]))


def test_coverage_test_fails_for_wrong_zero_and_leak(fits):
    zero = np.array([f.zero_rad[0] for f in fits])
    leak = np.array([f.leak[0] for f in fits])
    error = np.array([f.zero_stderr_rad[0] for f in fits])
    assert not covered(zero, 0.03 + 2 * error.mean(), error)
    error = np.array([f.leak_stderr[0] for f in fits])
    assert not covered(leak, 1 / 500 + 2 * error.mean(), error)


def test_extinction_interval_coverage_is_95_percent(fits):
    inside = sum(f.extinction_lower[0] < 500 < f.extinction_upper[0] for f in fits)
    low, high = binom.ppf([5e-4, 1 - 5e-4], len(fits), 0.95)
    assert low <= inside <= high


def test_the_scatter_of_the_light_is_found(fits):
    jitter = np.array([f.light_jitter[0] for f in fits])
    assert np.median(jitter) == pytest.approx(0.005, rel=0.15)


def test_weights_let_dark_angles_determine_the_extinction():
    """Unsteady light moves the bright angles most: unweighted, the leak is far less certain."""
    weighted, plain = [], []
    for seed in range(40):
        angles, intensity, variance = measured(np.random.default_rng([6, seed]), jitter=0.01)
        weighted.append(fit_malus(angles, intensity, variance=variance).leak[0])
        plain.append(fit_malus(angles, intensity).leak[0])
    assert np.std(weighted) < 0.5 * np.std(plain)


def test_extinction_below_noise_floor_has_lower_bound_only():
    angles, intensity, variance = measured(
        np.random.default_rng(3), extinction=1e7, noise=2e-3, jitter=0.0
    )
    fit = fit_malus(angles, intensity, variance=variance)
    assert np.isinf(fit.extinction_upper[0])
    assert 50 < fit.extinction_lower[0] < 1e7


def test_channels_are_fitted_each_as_if_alone():
    angles, intensity, variance = measured(np.random.default_rng(4))
    together = fit_malus(
        angles,
        np.stack([intensity, 2 * intensity], 1),
        variance=np.stack([variance, 4 * variance], 1),
    )
    alone = fit_malus(angles, intensity, variance=variance)
    np.testing.assert_allclose(together.leak, alone.leak[0], rtol=1e-9)
    np.testing.assert_allclose(together.zero_rad, alone.zero_rad[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("angles", "intensity", "says"),
    [
        (ANGLES, np.ones(13), "specular target"),
        (ANGLES, np.zeros(13), "does not follow"),
        (ANGLES[:3], malus(ANGLES[:3]), "four different"),
        (np.array([0, np.pi, 2 * np.pi, 0.5, 0.5]), np.ones(5), "four different"),
        (ANGLES, np.ones(12), "shapes"),
        (ANGLES, np.where(ANGLES > 1, np.nan, 1.0), "finite"),
    ],
)
def test_unusable_series_error_names_required_frames(angles, intensity, says):
    with pytest.raises(PolarizationError, match=says):
        fit_malus(angles, intensity)


def test_polarized_target_is_located_in_image():
    rng = np.random.default_rng(7)
    target = np.zeros((30, 40), bool)
    target[10:20, 15:25] = True
    images = [
        (np.where(target, malus(a), 0.3)[..., None] + 1e-3 * rng.normal(size=(30, 40, 3)))
        for a in ANGLES
    ]
    np.testing.assert_array_equal(find_modulated_pixels(ANGLES, images), target)
    masked = find_modulated_pixels(ANGLES, images, valid=~target | (np.arange(40) < 20))
    np.testing.assert_array_equal(masked, target & (np.arange(40) < 20))


def test_misaligned_analyzer_leaks_with_square_of_angle():
    calibration = PolarizationCalibration.from_fit(
        fit_malus(ANGLES, np.stack([malus(ANGLES, zero=0.05, extinction=1e9)] * 3, 1)), "RGB"
    )
    np.testing.assert_allclose(calibration.crossed_leak(), np.tan(0.05) ** 2, rtol=1e-4)
    np.testing.assert_allclose(
        calibration.crossed_leak(parallel_rad=0.05, crossed_rad=0.05 + np.pi / 2), 0.0, atol=1e-8
    )


def test_a_polarization_calibration_survives_the_disk(tmp_path):
    rng = np.random.default_rng(8)
    angles, intensity, variance = measured(rng)
    _, dim, dim_variance = measured(rng, extinction=1e7, noise=2e-3)
    fit = fit_malus(
        angles,
        np.stack([intensity, intensity, dim], 1),
        variance=np.stack([variance, variance, dim_variance], 1),
    )
    calibration = PolarizationCalibration.from_fit(fit, ("R", "G", "B"))
    store.save(
        calibration.to_calibration(
            serial="N1", rig="flash", source="simulated", created=date(2026, 11, 21)
        ),
        tmp_path,
    )
    again = PolarizationCalibration.from_calibration(store.load(tmp_path, "polarization"), "N1")
    np.testing.assert_array_equal(again.leak.value, calibration.leak.value)
    assert again.extinction_interval == calibration.extinction_interval
    assert again.extinction_interval[2][1] is None
    np.testing.assert_allclose(again.crossed_leak(), calibration.crossed_leak())
