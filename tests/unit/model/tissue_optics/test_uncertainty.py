"""Covariance of skin's colors by unknown optics, against adding-doubling."""

from dataclasses import replace

import numpy as np
import pytest

from model import color_table, spectra
from model.tissue_optics import SKIN_CONSTANTS, two_layer_reflectance
from model.tissue_optics import uncertainty as optics_uncertainty
from model.tissue_optics.layers import ANISOTROPY_SKIN
from model.tissue_optics.uncertainty import NUISANCE_PARAMETERS

CAMERA = "Nikon 5100 (NPL)", "D55"


@pytest.fixture(scope="module")
def table():
    return color_table.build(*CAMERA, anisotropy=ANISOTROPY_SKIN)


def color_of(constants, c_m, c_hd):
    """Color by adding-doubling at the melanin optical depth of c_m in SKIN_CONSTANTS."""
    c_m = c_m * SKIN_CONSTANTS.melanin_depth_factor / constants.melanin_depth_factor
    reflectance = two_layer_reflectance(
        spectra.WAVELENGTH_NM, c_m, c_hd, constants=constants, anisotropy=ANISOTROPY_SKIN
    )
    return spectra.band_average(reflectance, *CAMERA)


def without_all_but(name):
    return [n.name for n in NUISANCE_PARAMETERS if n.name != name]


@pytest.mark.parametrize("nuisance", NUISANCE_PARAMETERS, ids=lambda n: n.name)
@pytest.mark.parametrize("c_m", [0.015, 0.06, 0.16])
def test_each_nuisance_moves_colors_as_stated(nuisance, c_m):
    u, v = color_table.spectral_axes(optics_uncertainty.COVARIANCE_NODES)
    i, j = np.abs(u**3 - c_m).argmin(), np.abs(v**3 - 0.012).argmin()
    c_m, c_hd = u[i] ** 3, v[j] ** 3
    reflectance = np.broadcast_to(
        two_layer_reflectance(
            spectra.WAVELENGTH_NM, c_m, c_hd, constants=SKIN_CONSTANTS, anisotropy=ANISOTROPY_SKIN
        ),
        (u.size, u.size, 31),
    )
    found = optics_uncertainty.log_color_covariance(
        *CAMERA, reflectance, without=without_all_but(nuisance.name), residual=False
    )[i, j]
    usual, step = getattr(SKIN_CONSTANTS, nuisance.name), 0.5 * nuisance.sd
    ends = usual * np.exp([-step, step]) if nuisance.is_log else usual + np.array([-step, step])
    low, high = (
        color_of(replace(SKIN_CONSTANTS, **{nuisance.name: end}), c_m, c_hd) for end in ends
    )
    moved = np.log(high / low)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.abs(moved), rtol=0.12, atol=2e-3)


def test_covariance_is_positive_and_grows_by_residual(table):
    least = np.linalg.eigvalsh(table.optics_covariance).min(axis=-1)
    assert least.min() > 0.0
    whole = table.log_covariance(0.03, 0.012)
    assert 0.05 < np.sqrt(whole[1, 1]) < 0.25


def test_log_covariance_interpolates_and_exact_optics_has_none(table):
    nodes = table.optics_covariance
    size = len(nodes)
    c_m, c_hd = (end * (k / (size - 1)) ** 3 for end, k in ((0.5, 9), (0.32, 12)))
    np.testing.assert_allclose(table.log_covariance(c_m, c_hd), nodes[9, 12], rtol=1e-9)
    exact = color_table.with_exact_optics(table)
    assert exact is color_table.with_exact_optics(table)
    assert not exact.log_covariance(c_m, [c_hd, c_hd]).any()
    with pytest.raises(color_table.ColorTableError, match="c_m"):
        table.log_covariance(0.6, 0.1)


def test_optical_depth_is_fraction_times_thickness_times_absorption(table):
    depth = 0.02 * SKIN_CONSTANTS.epidermis_mm * float(SKIN_CONSTANTS.melanin_absorption(550.0))
    assert float(table.melanin_optical_depth(0.02)) == pytest.approx(depth)


@pytest.mark.parametrize(("shape", "bad"), [((3, 4, 3, 3), 0.0), ((2, 2, 3), 0.0)])
def test_covariance_of_another_shape_is_refused(table, shape, bad):
    with pytest.raises(color_table.ColorTableError, match="optics_covariance"):
        replace(table, optics_covariance=np.full(shape, bad))


def test_typology_angle_of_gray_is_upright():
    assert optics_uncertainty.typology_angle(np.full(31, 0.5)) == pytest.approx(90.0, abs=0.5)
    assert optics_uncertainty.typology_angle(np.full(31, 0.1)) == pytest.approx(-90.0, abs=0.5)
