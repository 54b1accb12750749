"""Narrow-band light, skin under it, and the common error of a face's colors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import color_table, led_spectra, spectra
from model.tissue_optics import band_signals, skin_spectra, uncertainty
from reconstruction.chromophores import common_optics, pixel_checks, shading_prior
from reconstruction.chromophores import posterior as chromophore_posterior

FEW = settings(derandomize=True, deadline=None, max_examples=15, database=None)
CENTER = st.integers(420, 680)
WIDTH = st.integers(5, 40)


@pytest.fixture(scope="module")
def table():
    return color_table.build("Nikon 5100 (NPL)", "D55", size=32)


@FEW
@given(center=CENTER, width=WIDTH)
def test_led_has_its_center_and_width(center, width):
    name = f"LED-{center}-{width}"
    assert led_spectra.is_led(name)
    ends = np.array([center - width / 2, center, center + width / 2])
    np.testing.assert_allclose(led_spectra.spectrum(name, ends), [50.0, 100.0, 50.0])
    grid = led_spectra.samples(name)
    assert led_spectra.spectrum(name, grid[[0, -1]]).max() < 0.1
    weights = band_signals.gray_weights(spectra.LINEAR_SRGB, name)
    assert weights.shape == grid.shape
    assert weights.sum() == pytest.approx(1.0)


@pytest.mark.long
@FEW
@given(depth=st.floats(0.01, 3.0), more=st.floats(1.05, 3.0), blood=st.floats(0.001, 0.1))
def test_more_pigment_darkens_every_wavelength(depth, more, blood):
    nm = np.array([450.0, 540.0, 650.0])
    skin = skin_spectra.typical_skin([depth, more * depth, depth], [blood, blood, more * blood])
    plain, pigmented, bloody = skin_spectra.log_reflectance(nm, skin)
    assert (pigmented < plain).all()
    assert (bloody < plain).all()
    assert plain.max() < 0.0


@FEW
@given(low=st.floats(0.05, 0.3), slope=st.floats(0.05, 0.4), darker=st.floats(0.3, 0.9))
def test_darker_skin_has_smaller_typology_angle(low, slope, darker):
    spectrum = np.linspace(low, low + slope, 31)
    light, dark = uncertainty.typology_angle(np.stack([spectrum, darker * spectrum]))
    assert dark < light


@pytest.mark.long
@FEW
@given(
    melanin=st.floats(0.005, 0.2),
    blood=st.floats(0.003, 0.1),
    tint=st.tuples(*[st.floats(-0.15, 0.15)] * 3),
    seed=st.integers(0, 99),
)
def test_common_error_ignores_order_and_single_outliers(table, melanin, blood, tint, seed):
    rng = np.random.default_rng(seed)
    light = np.exp(0.3 * rng.standard_normal((301, 1)))
    rgb = (0.7 * light * table.lookup(melanin, blood) * np.exp(tint)).astype(np.float32)
    prior = shading_prior.lognormal_prior(0.7, 0.3)

    def estimate(colors):
        return common_optics.estimate_common_optics(colors, table, prior=prior, common_light=0.1)

    found = estimate(rgb)
    assert np.isfinite(found.log_color).all()
    assert min(found.melanin_half_width, found.blood_half_width) > 0.0
    assert 0.0 < found.log_light_sd < 0.11
    shuffled = estimate(rng.permutation(rgb))
    np.testing.assert_allclose(shuffled.log_color, found.log_color, atol=1e-6)
    hole = rgb.copy()
    hole[0] = np.nan
    assert not pixel_checks.is_usable_color(hole)[0]
    np.testing.assert_allclose(estimate(hole).log_color, found.log_color, atol=0.02)


@FEW
@given(within=st.floats(0.0, 10.0), optics=st.floats(0.0, 10.0))
def test_errors_of_face_and_optics_add_squared(within, optics):
    whole = np.hypot(within, optics)
    back = chromophore_posterior.errors_within_face(np.array(whole), np.array(optics))
    assert float(back) == pytest.approx(within, abs=1e-6 * (1.0 + whole))
