"""Factors of standard errors that give intervals their coverage.

Rationale: a factor is fitted to errors that occur. Expected: with errors of known distribution the
factor has a closed form. Tolerance: 2 sampling errors of a 68 % coverage (0.033 for 800 skins).
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from model import color_table, skin_tone
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import invert
from reconstruction.chromophores.pixel_checks import ChromophoreError
from reconstruction.chromophores.table_fit import fitting, interval_factors
from skinrig.benchmarks.flash_rig import independent_skin as independent

SKINS_PER_BAND = 800


def normal_quantiles(number):
    return special.ndtri((np.arange(number) + 0.5) / number)


@pytest.fixture
def skins():
    angle = np.repeat([60.0, 48.0, 34.0, 19.0, -10.0, -45.0], SKINS_PER_BAND)
    zeros = np.zeros(angle.size)
    return interval_factors.IntervalSkins(zeros[:, None], np.ones(1), angle, zeros, zeros)


@pytest.mark.parametrize("scale", [0.6, 1.0, 1.7])
def test_coverage_factor_of_normal_errors_is_scale(scale):
    found = interval_factors.coverage_factor(scale * normal_quantiles(20_000))
    assert found == pytest.approx(scale, rel=0.02)


def test_coverage_factor_weighs_both_coverages():
    # errors of one size: any factor that contains them covers 100 %
    even = interval_factors.coverage_factor(np.linspace(-1.0, 1.0, 20_000))
    assert 0.5 < even < 1.0 / special.ndtri(0.5 + 0.5 * 0.95) + 0.1
    tails = np.concatenate([normal_quantiles(9000), 6.0 * normal_quantiles(1000)])
    assert 1.0 < interval_factors.coverage_factor(tails) < 1.6


def test_band_factors_follow_errors_of_bands(skins):
    scale = np.repeat([0.6, 0.8, 1.0, 1.1, 1.3, 1.5], SKINS_PER_BAND)
    error = np.tile(normal_quantiles(SKINS_PER_BAND), 6) * scale
    every = np.ones(error.size, np.bool_)
    centers, factors = interval_factors.fit_band_factors(
        np.stack([error, error[::-1]], axis=-1), skins, every, skins.typology_angle_deg
    )
    assert (np.diff(centers) < 0.0).all()
    np.testing.assert_allclose(factors[:, 0], scale[::SKINS_PER_BAND], rtol=0.03)
    np.testing.assert_allclose(factors[:, 1], scale[::-SKINS_PER_BAND], rtol=0.03)


def test_band_without_estimates_has_factor_one(skins):
    error = 1.5 * np.tile(normal_quantiles(SKINS_PER_BAND), 6)[:, None]
    valid = skins.band != 2
    _, factors = interval_factors.fit_band_factors(error, skins, valid, skins.typology_angle_deg)
    assert factors[2, 0] == 1.0
    assert (factors[[0, 1, 3, 4, 5], 0] > 1.4).all()


def test_skins_without_estimate_have_no_center(skins):
    # their angles are those of failed fits
    error = np.tile(normal_quantiles(SKINS_PER_BAND), 6)[:, None]
    valid = np.ones(error.size, np.bool_)
    valid[SKINS_PER_BAND // 4 : SKINS_PER_BAND] = False
    valid[skins.band == 3] = False
    angle = np.where(valid, skins.typology_angle_deg - 1.0, np.nan)
    centers, _ = interval_factors.fit_band_factors(error, skins, valid, angle)
    assert centers.tolist() == [59.0, 47.0, 33.0, 19.0, -11.0, -46.0]


def test_bands_out_of_order_are_refused(skins):
    every = np.ones(skins.band.size, np.bool_)
    with pytest.raises(ChromophoreError, match="expected decreasing"):
        interval_factors.fit_band_factors(
            np.ones((every.size, 1)), skins, every, -skins.typology_angle_deg
        )


def test_band_factors_follow_angle_of_estimates(skins):
    # type I is estimated at 68 degrees: a factor at 60 would not be the one that is applied
    error = np.tile(normal_quantiles(SKINS_PER_BAND), 6)[:, None]
    error[skins.band == 0] *= 0.8
    angle = np.where(skins.band == 0, 68.0, skins.typology_angle_deg)
    centers, factors = interval_factors.fit_band_factors(
        error, skins, np.ones(angle.size, np.bool_), angle
    )
    assert centers[0] == 68.0
    assert factors[0, 0] == pytest.approx(0.8, abs=0.03)
    assert factors[1, 0] == pytest.approx(1.0, abs=0.03)


def test_interpolated_factors_are_constant_beyond_centers():
    centers, factors = np.array([50.0, 0.0]), np.array([[1.0, 2.0], [3.0, 4.0]])
    found = interval_factors.interpolate_factors(np.array([90.0, 25.0, -90.0]), centers, factors)
    np.testing.assert_allclose(found, [[1.0, 2.0], [2.0, 3.0], [3.0, 4.0]])


@pytest.fixture(scope="module")
def table():
    return color_table.build("Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN)


def test_node_typology_angles_fall_with_melanin(table):
    angle = interval_factors.node_typology_angles(table)
    assert angle.shape == (interval_factors.NODES_PER_AXIS,) * 2
    assert (np.diff(angle[:, 5]) < 0.0).all()
    assert skin_tone.ita_band(angle[1, 10]) == 1


def test_interval_skins_are_not_judged_skins():
    sets = interval_factors.load_interval_skins()
    judges = independent.load_skins()
    assert set(sets.band.astype(int)) == set(range(6))
    assert not np.isin(judges.blood.astype(np.float32), sets.hemoglobin.astype(np.float32)).any()


def test_invert_without_factors_covers_too_much(table, monkeypatch):
    # the factors are needed: without them, intervals of the lightest skin are too wide
    skins = independent.load_skins()
    rgb = independent.noisy_colors(skins, "Nikon 5100 (NPL)", "D55")
    monkeypatch.setattr(fitting, "_interval_factors", lambda table: fitting._NO_FACTORS)
    plain, _ = independent.accuracy_by_type(table, skins, rgb)
    monkeypatch.undo()
    found, _ = independent.accuracy_by_type(table, skins, rgb)
    assert plain["I"].within_68 > 0.8
    assert 0.6 < found["I"].within_68 < 0.78
    assert found["I"].bias == plain["I"].bias


def test_camera_without_sensitivities_has_no_factors(table):
    own = replace(table, camera="own")
    rgb = table.lookup([0.002, 0.04], 0.012)
    one, other = (invert(rgb, each, shading="known") for each in (table, own))
    np.testing.assert_array_equal(one.melanin, other.melanin)
    ratio = one.stderr_melanin / other.stderr_melanin
    factors = fitting._interval_factors(table)[..., 0]
    assert ratio[0] < 0.95
    assert 0.999 * factors.min() < ratio.min() < ratio.max() < 1.001 * factors.max()
