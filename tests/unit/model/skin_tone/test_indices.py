import numpy as np
import pytest

from model import skin_tone, spectra, tissue_optics
from model.skin_tone.indices import GREEN_BAND_NM, RED_BAND_NM


def skin(c_m, c_hd):
    return tissue_optics.two_layer_reflectance(spectra.WAVELENGTH_NM, c_m, c_hd, tier="diffusion")


def bands(reflectance):
    nm = spectra.WAVELENGTH_NM
    return [np.interp(at, nm, reflectance) for at in (RED_BAND_NM, GREEN_BAND_NM)]


def test_indices_are_decadic_logarithms():
    assert float(skin_tone.erythema_index(0.4, 0.04)) == pytest.approx(100.0)
    assert float(skin_tone.melanin_index(0.01)) == pytest.approx(200.0)


def test_blood_raises_erythema_and_pigment_raises_melanin():
    pale, red, tan = skin(0.02, 0.01), skin(0.02, 0.05), skin(0.05, 0.01)
    erythema = [float(skin_tone.erythema_index(*bands(one))) for one in (pale, red)]
    melanin = [float(skin_tone.melanin_index(bands(one)[0])) for one in (pale, red, tan)]
    dawson = [
        float(skin_tone.dawson_erythema_index(one, spectra.WAVELENGTH_NM))
        for one in (pale, red, tan)
    ]
    assert erythema[1] > erythema[0] + 5.0
    assert melanin[2] > melanin[0] + 3.0
    assert dawson[1] > dawson[0] + 5.0
    # Dawson's index corrects for the slope of melanin: pigment changes it less than blood
    assert abs(dawson[2] - dawson[0]) < 0.5 * (dawson[1] - dawson[0])


@pytest.mark.parametrize("correlation", [0.0, 0.8, -0.5])
def test_erythema_stderr_equals_the_scatter(correlation):
    rng = np.random.default_rng(7)
    deviation = np.array([0.004, 0.003])
    cross = correlation * deviation[0] * deviation[1]
    covariance = np.array([[deviation[0] ** 2, cross], [cross, deviation[1] ** 2]])
    draws = rng.multivariate_normal([0.45, 0.25], covariance, 40_000)
    scatter = np.std(skin_tone.erythema_index(draws[:, 0], draws[:, 1]))
    found = skin_tone.erythema_index_stderr(0.45, 0.25, *deviation, correlation=correlation)
    assert float(found) == pytest.approx(scatter, rel=0.03)


def test_shading_cancels_in_erythema_only():
    common = skin_tone.erythema_index_stderr(0.4, 0.2, 0.04, 0.02, correlation=1.0)
    assert float(common) == pytest.approx(0.0, abs=1e-6)
    assert float(skin_tone.melanin_index_stderr(0.4, 0.04)) == pytest.approx(4.34, abs=0.01)


def test_dark_pixels_have_no_index():
    assert np.isnan(skin_tone.erythema_index([0.3, 0.3], [0.0, -0.1])).all()
    assert np.isnan(skin_tone.melanin_index_stderr(0.0, 0.01))


def test_dawson_refuses_missing_bands():
    with pytest.raises(ValueError, match="510 to 610"):
        skin_tone.dawson_erythema_index(np.full(5, 0.3), np.linspace(520.0, 620.0, 5))
    with pytest.raises(ValueError, match="increasing"):
        skin_tone.dawson_erythema_index(np.full(3, 0.3), [500.0, 490.0, 700.0])
