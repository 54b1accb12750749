import numpy as np
import pytest

from model import skin_tone, spectra

SKIN = np.array([[0.62, 0.45, 0.37], [0.35, 0.2, 0.13], [0.05, 0.03, 0.02], [1.0, 1.0, 1.0]])
"""Linear sRGB of light, brown and dark skin, and of a white reference."""


def test_lab_equals_colour_science():
    import colour  # takes two seconds, that each process would wait for

    xyz = SKIN @ np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB).T
    white = np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB).sum(axis=1)
    expected = colour.XYZ_to_Lab(xyz / white[1], colour.XYZ_to_xy(white))
    np.testing.assert_allclose(skin_tone.lab(SKIN), expected, atol=1e-9)


def test_lab_of_spectra_equals_colour_science():
    import colour  # takes two seconds, that each process would wait for

    wavelength = spectra.WAVELENGTH_NM
    reflectance = 0.05 + 0.5 / (1.0 + np.exp(-(wavelength - 590.0) / 40.0))
    table = colour.SpectralDistribution(reflectance, wavelength).align(
        colour.SpectralShape(360, 830, 1)
    )
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    light = colour.SDS_ILLUMINANTS["D65"].copy().align(observer.shape)
    xyz = colour.sd_to_XYZ(table, observer, light, method="Integration") / 100.0
    expected = colour.XYZ_to_Lab(
        xyz, colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    )
    # colour extends the spectrum beyond 400 to 700 nm, this package counts nothing there
    np.testing.assert_allclose(skin_tone.lab_of_spectra(reflectance), expected, atol=0.15)


def test_leading_axes_broadcast_and_inputs_stay():
    image = np.stack([SKIN, SKIN[::-1]])
    before = image.copy()
    found = skin_tone.lab(image)
    np.testing.assert_allclose(found[1, 0], skin_tone.lab(SKIN[3]), atol=1e-12)
    np.testing.assert_array_equal(image, before)


def test_covariance_equals_the_scatter_of_draws():
    rng = np.random.default_rng(3)
    covariance = 1e-6 * np.array([[4.0, 1.0, 0.0], [1.0, 2.0, -0.5], [0.0, -0.5, 3.0]])
    draws = rng.multivariate_normal(SKIN[1], covariance, 40_000)
    found = skin_tone.lab_covariance(SKIN[1], covariance)
    scatter = np.cov(skin_tone.lab(draws).T)
    # the variance of 40,000 draws has a relative standard error of 0.7 %
    size = np.sqrt(np.outer(np.diagonal(scatter), np.diagonal(scatter)))
    np.testing.assert_allclose(found / size, scatter / size, atol=0.035)
    diagonal = skin_tone.lab_covariance(SKIN[1], np.diag(np.diagonal(covariance)))
    assert np.abs(diagonal / size - scatter / size).max() > 0.05  # correlations matter


def test_dark_colors_use_the_linear_part():
    covariance = skin_tone.lab_covariance([0.001, 0.001, 0.001], 1e-10 * np.eye(3))
    step = 1e-5
    slope = (skin_tone.lab([0.001 + step, 0.001, 0.001]) - skin_tone.lab([0.001] * 3)) / step
    assert covariance[0, 0] > 0.0
    assert np.isfinite(slope).all()
    assert np.isfinite(skin_tone.lab([-0.01, 0.0, 0.0])).all()


def test_hue_and_chroma_are_polar_coordinates():
    hue, chroma = skin_tone.hue_chroma([[50.0, 0.0, 12.0], [50.0, 3.0, -3.0]])
    np.testing.assert_allclose(hue, [90.0, 315.0])
    np.testing.assert_allclose(chroma, [12.0, np.hypot(3.0, 3.0)])


def test_wrong_shapes_are_refused_by_name():
    with pytest.raises(ValueError, match="linear_srgb"):
        skin_tone.lab([0.5, 0.5])
    with pytest.raises(ValueError, match="covariance"):
        skin_tone.lab_covariance([0.5, 0.5, 0.5], np.eye(2))
