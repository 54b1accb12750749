"""Spectral tables against published values and against colour-science as an independent copy."""

import numpy as np
import pytest

from model import spectra

FINE_NM = np.arange(400.0, 701.0, 5.0)


@pytest.mark.parametrize(
    ("wavelength_nm", "blood_per_mm"),
    [(500.0, 11.200), (540.0, 27.618), (600.0, 3.250), (700.0, 0.3567)],
)
def test_whole_blood_at_75_percent_saturation_matches_literature(wavelength_nm, blood_per_mm):
    oxy, deoxy = spectra.hemoglobin_extinction(wavelength_nm)
    molar = spectra.HEMOGLOBIN_IN_BLOOD_G_PER_L / spectra.HEMOGLOBIN_MOLAR_MASS_G_PER_MOL
    absorption = np.log(10.0) * molar * (0.75 * oxy + 0.25 * deoxy) / 10.0
    assert absorption == pytest.approx(blood_per_mm, rel=2e-4)


def test_hemoglobin_isosbestic_near_500_nm_oxy_dips_560():
    oxy, deoxy = spectra.hemoglobin_extinction([500.0, 542.5, 560.0, 577.5])
    assert oxy[0] == pytest.approx(deoxy[0], rel=0.02)
    assert oxy[2] < oxy[1]
    assert oxy[2] < oxy[3]
    assert deoxy[2] > oxy[2]


@pytest.mark.parametrize(
    ("function", "at_500", "at_700"),
    [
        (spectra.eumelanin_absorption, 67.92, 22.15),
        (spectra.pheomelanin_absorption, 43.88, 8.875),
        (spectra.baseline_absorption, 0.0702, 0.0266),
        (spectra.reduced_scattering, 7.276, 4.404),
    ],
)
def test_tissue_spectra_have_their_published_values(function, at_500, at_700):
    np.testing.assert_allclose(function([500.0, 700.0]), [at_500, at_700], rtol=2e-3)


@pytest.mark.parametrize("name", ["D50", "D55", "D65", "A", "E"])
def test_illuminants_agree_with_the_cie_tables(name):
    import colour

    table = colour.SDS_ILLUMINANTS[name].copy().align(colour.SpectralShape(400, 700, 10))
    np.testing.assert_allclose(
        spectra.illuminant(name), 100 * table.values / table[560.0], rtol=2e-4
    )


def test_flash_color_temperature_is_5500_to_6100_k():
    wavelength = np.arange(380.0, 781.0, 5.0)
    xyz = spectra.illuminant("xenon flash", wavelength) @ spectra.color_matching_functions(
        wavelength
    )
    x, y = xyz[:2] / xyz.sum()
    n = (x - 0.3320) / (0.1858 - y)  # McCamy 1992, doi:10.1002/col.5080170211
    assert 5500.0 < 449.0 * n**3 + 3525.0 * n**2 + 6823.3 * n + 5520.33 < 6100.0


@pytest.mark.parametrize("name", [n for n in spectra.camera_names() if n != spectra.LINEAR_SRGB])
def test_camera_sensitivities_agree_with_the_published_data_set(name):
    import colour

    published = colour.MSDS_CAMERA_SENSITIVITIES[name]
    np.testing.assert_allclose(
        spectra.camera_sensitivity(name, published.wavelengths), published.values, rtol=5e-5
    )


def test_the_standard_observer_agrees_with_the_cie_table():
    import colour

    table = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    wavelength = np.arange(400.0, 701.0, 5.0)
    index = np.searchsorted(table.wavelengths, wavelength)
    np.testing.assert_allclose(
        spectra.color_matching_functions(wavelength), table.values[index], rtol=1e-5, atol=1e-12
    )


@pytest.mark.parametrize("name", spectra.illuminant_names())
@pytest.mark.parametrize("camera", spectra.camera_names())
def test_gray_reflectance_gives_equal_channels_any_light(camera, name):
    rgb = spectra.band_average(np.full((2, 31), 0.3), camera, name)
    np.testing.assert_allclose(rgb, 0.3, rtol=1e-12)


def test_band_averages_are_independent_of_linear_reflectance_sampling():
    coarse = spectra.band_average(spectra.WAVELENGTH_NM / 700.0, "Nikon 5100 (NPL)", "D55")
    fine = spectra.band_average(FINE_NM / 700.0, "Nikon 5100 (NPL)", "D55", wavelength_nm=FINE_NM)
    np.testing.assert_allclose(coarse, fine, rtol=1e-12)
    assert coarse[0] > coarse[1] > coarse[2]


def test_camera_white_reddens_from_daylight_to_incandescent():
    day = spectra.camera_white("Nikon 5100 (NPL)", "D65")
    bulb = spectra.camera_white("Nikon 5100 (NPL)", "A")
    assert day.max() == 1.0
    assert bulb[0] / bulb[2] > 2.0 * day[0] / day[2]


def test_unknown_name_error_lists_valid_names():
    with pytest.raises(spectra.SpectrumNameError, match="Nikon 5100"):
        spectra.camera_sensitivity("Nikon 5100")
    with pytest.raises(spectra.SpectrumNameError, match="D55"):
        spectra.illuminant("D60")


def test_wavelengths_outside_the_hemoglobin_table_are_refused():
    with pytest.raises(
        ValueError, match=r"wavelength_nm in the table hemoglobin_extinction\.csv: got"
    ):
        spectra.hemoglobin_extinction([300.0])


def test_the_default_wavelengths_cannot_be_modified():
    with pytest.raises(ValueError, match="read-only"):
        spectra.WAVELENGTH_NM[0] = 0.0


def test_spectra_mismatching_wavelengths_are_refused():
    with pytest.raises(ValueError, match="spectra: got"):
        spectra.band_average(np.ones(30), "Nikon 5100 (NPL)", "D55")


def test_linear_srgb_of_reflectance_matches_xyz_under_d65():
    wavelength = np.arange(400.0, 701.0, 10.0)
    reflectance = 0.2 + 0.5 / (1.0 + np.exp(-(wavelength - 590.0) / 12.0))
    rgb = spectra.band_average(reflectance, spectra.LINEAR_SRGB, "D65", wavelength_nm=wavelength)
    fine = np.arange(400.0, 701.0, 1.0)
    light = spectra.illuminant("D65", fine)
    observer = spectra.color_matching_functions(fine)
    xyz = (np.interp(fine, wavelength, reflectance) * light) @ observer
    white = light @ observer
    expected = (xyz / white * [0.9505, 1.0, 1.089]) @ spectra.XYZ_TO_LINEAR_SRGB.T
    np.testing.assert_allclose(rgb, expected, atol=2e-3)
