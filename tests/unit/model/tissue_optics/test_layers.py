"""Chromophores to layers to reflectance: constants, monotony, and measured skin."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from model import spectra
from model.tissue_optics import PAPER_CONSTANTS, SKIN_CONSTANTS
from model.tissue_optics.layers import (
    C_HD_MAX,
    C_M_MAX,
    TissueError,
    blood_absorption,
    layer_stack_reflectance,
    skin_layers,
    two_layer_reflectance,
)

# Mean reflectance factor of 100 forearms, specular part included: Cooksey, Allen, Tsai 2017,
# doi:10.6028/jres.122.026 (data doi:10.18434/M38597).
NIST_WAVELENGTH_NM = [400.0, 450.0, 500.0, 540.0, 560.0, 575.0, 600.0, 650.0, 700.0]
NIST_MEAN = [0.185, 0.252, 0.328, 0.317, 0.323, 0.327, 0.447, 0.557, 0.602]


def test_layers_hold_the_chromophores_of_their_depth():
    sigma_a, sigma_s, thickness = skin_layers(500.0, 0.1, 0.08, constants=PAPER_CONSTANTS)
    pigment = 0.61 * 67.92 + 0.39 * 43.88
    epidermis = 0.1 * pigment + 0.02 * 11.200 + (1 - 0.1 - 0.02) * 0.0702
    dermis = 0.08 * 11.200 + 0.92 * 0.0702
    np.testing.assert_allclose(sigma_a, [epidermis, dermis], rtol=3e-4)
    np.testing.assert_allclose(sigma_s, [7.276, 3.638], rtol=2e-4)
    np.testing.assert_array_equal(thickness, [0.25, np.inf])


def test_skin_has_thin_epidermis_without_blood():
    sigma_a, sigma_s, thickness = skin_layers(500.0, 0.1, 0.08, constants=SKIN_CONSTANTS)
    pigment = 0.8 * 67.92 + 0.2 * 43.88
    dermis = 0.08 * 11.200 + 0.92 * 0.0702
    np.testing.assert_allclose(sigma_a, [0.1 * pigment + 0.9 * 0.0702, dermis], rtol=3e-4)
    np.testing.assert_allclose(sigma_s, [9.2, 4.6], rtol=1e-12)
    np.testing.assert_array_equal(thickness, [0.09, np.inf])
    redder = skin_layers(600.0, 0.1, 0.08, constants=SKIN_CONSTANTS)[1]
    np.testing.assert_allclose(redder[1], 4.6 * 1.2**-1.421)


@pytest.mark.parametrize(
    ("name", "bad"), [("epidermis_mm", 0.0), ("oxygenation", 1.1), ("eumelanin_fraction", np.nan)]
)
def test_constants_that_no_tissue_has_are_refused(name, bad):
    with pytest.raises(TissueError, match=name):
        replace(SKIN_CONSTANTS, **{name: bad})


def test_deoxygenated_blood_is_darker_in_the_red_only():
    assert blood_absorption(660.0, oxygenation=0.2) > 3.0 * blood_absorption(660.0, oxygenation=1.0)
    assert blood_absorption(500.0, oxygenation=0.2) == pytest.approx(
        float(blood_absorption(500.0, oxygenation=1.0)), rel=0.02
    )


@pytest.mark.parametrize("tier", ["adding_doubling", "diffusion"])
def test_more_chromophore_darkens_skin_at_every_wavelength(tier):
    melanin = C_M_MAX * np.linspace(0.0, 1.0, 6) ** 3
    blood = C_HD_MAX * np.linspace(0.0, 1.0, 5) ** 3
    # Above 600 nm blood is nearly as clear as the tissue that it displaces: 10 nm up to 600.
    r = two_layer_reflectance(np.arange(400.0, 601.0, 20.0), melanin[:, None], blood, tier=tier)
    assert r.shape == (6, 5, 11)
    assert np.all(np.diff(r, axis=0) < 0.0)
    assert np.all(np.diff(r, axis=1) < 0.0)
    assert r.min() > 0.0
    assert r.max() < 1.0


def test_tiers_agree_to_a_fifth_over_whole_range():
    melanin = C_M_MAX * np.linspace(0.0, 1.0, 5) ** 3
    blood = C_HD_MAX * np.linspace(0.0, 1.0, 5) ** 3
    exact = two_layer_reflectance(spectra.WAVELENGTH_NM, melanin[:, None], blood)
    fast = two_layer_reflectance(spectra.WAVELENGTH_NM, melanin[:, None], blood, tier="diffusion")
    relative = fast / exact - 1.0
    assert -0.1 < relative.min()
    assert relative.max() < 0.21


def test_measured_skin_fits_with_small_specular_offset():
    def residual(p):
        model = two_layer_reflectance(NIST_WAVELENGTH_NM, p[0], p[1], beta_m=p[2], oxygenation=p[3])
        return model + p[4] - NIST_MEAN

    fit = least_squares(
        residual,
        [0.02, 0.02, 0.6, 0.75, 0.02],
        bounds=([0.0, 0.0, 0.0, 0.0, 0.0], [0.5, 0.32, 1.0, 1.0, 0.06]),
        x_scale=[0.02, 0.02, 0.5, 0.5, 0.02],
    )
    rms = np.sqrt(np.mean(fit.fun**2))
    assert rms < 0.03


def test_shapes_are_fractions_then_wavelengths():
    assert two_layer_reflectance(550.0, 0.1, 0.1).shape == ()
    assert two_layer_reflectance([550.0, 600.0], np.full((2, 1), 0.1), np.full(3, 0.1)).shape == (
        2,
        3,
        2,
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((500.0, -0.01, 0.1), r"c_m.*-0\.01"),
        ((500.0, 0.1, np.nan), "c_hd.*nan"),
        ((500.0, 1.01, 0.2), r"c_m"),
    ],
)
def test_impossible_fractions_are_refused_by_name(arguments, message):
    with pytest.raises(TissueError, match=message):
        two_layer_reflectance(*arguments)


def test_layers_whose_shapes_do_not_broadcast_are_named():
    with pytest.raises(
        TissueError, match=r"sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm: got"
    ):
        layer_stack_reflectance(np.ones(3), np.ones(2), np.ones(2))
