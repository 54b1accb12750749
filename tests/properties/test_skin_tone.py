"""Skin tone: Lab, typology angle and indices over their declared domains."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import skin_tone, spectra
from model.tissue_optics import discrete_ordinates
from model.tissue_optics.constants import PAPER_CONSTANTS, SKIN_CONSTANTS, with_fractions

CHEAP = settings(derandomize=True, deadline=None, max_examples=25, database=None)
FEW = settings(CHEAP, max_examples=8)

REFLECTANCE = st.floats(1e-4, 1.0)
COLORS = st.tuples(REFLECTANCE, REFLECTANCE, REFLECTANCE)
DEVIATION = st.floats(1e-6, 0.05)


@CHEAP
@given(color=COLORS, factor=st.floats(1.01, 3.0))
def test_lighter_color_has_more_lightness(color, factor):
    dark, light = skin_tone.lab([color, np.multiply(factor, color)])
    assert light[0] > dark[0]
    hue, chroma = skin_tone.hue_chroma(dark)
    assert chroma == pytest.approx(np.hypot(dark[1], dark[2]))
    assert np.cos(np.radians(hue)) * chroma == pytest.approx(dark[1], abs=1e-9)


@CHEAP
@given(color=COLORS, deviation=DEVIATION)
def test_covariances_scale_with_their_inputs(color, deviation):
    small = np.diag(np.square(np.multiply(deviation, color)))
    one, four = (skin_tone.lab_covariance(color, scale * small) for scale in (1.0, 4.0))
    np.testing.assert_allclose(four, 4.0 * one, rtol=1e-9)
    assert np.linalg.eigvalsh(one).min() >= -1e-9 * np.trace(one)
    lab = skin_tone.lab(color)
    error = skin_tone.ita_stderr(lab, one)
    assert 0.0 <= error <= 104.0
    assert skin_tone.ita_stderr(lab, four) == pytest.approx(min(2.0 * error, 103.924), rel=1e-3)


@CHEAP
@given(color=COLORS)
def test_angle_falls_into_the_band_of_its_edges(color):
    angle = skin_tone.ita(skin_tone.lab(color))
    band = int(skin_tone.ita_band(angle))
    edges = (np.inf, *skin_tone.ITA_EDGES_DEG, -np.inf)
    assert edges[band] < angle <= edges[band - 1] or angle == edges[band]


@FEW
@given(level=REFLECTANCE, slope=st.floats(-0.2, 0.2))
def test_gray_spectra_have_no_chroma(level, slope):
    gray = skin_tone.lab_of_spectra(np.full(31, level), spectra.WAVELENGTH_NM)
    assert np.abs(gray[1:]).max() < 0.2
    ramp = np.clip(level * (1.0 + slope * np.linspace(-1.0, 1.0, 31)), 0.0, None)
    tilted = skin_tone.lab_of_spectra(ramp, spectra.WAVELENGTH_NM)
    assert (tilted[2] - gray[2]) * slope >= -1e-9


@CHEAP
@given(red=REFLECTANCE, green=REFLECTANCE, factor=st.floats(0.1, 0.99), deviation=DEVIATION)
def test_indices_rise_with_absorption(red, green, factor, deviation):
    assert skin_tone.erythema_index(red, factor * green) > skin_tone.erythema_index(red, green)
    assert skin_tone.melanin_index(factor * red) > skin_tone.melanin_index(red)
    errors = deviation * red, deviation * green
    one = skin_tone.melanin_index_stderr(red, errors[0])
    both = skin_tone.erythema_index_stderr(red, green, *errors)
    assert both == pytest.approx(np.sqrt(2.0) * one, rel=1e-6)


@FEW
@given(level=st.floats(0.05, 0.9), dip=st.floats(0.5, 0.99))
def test_dawson_index_sees_a_dip_in_the_green(level, dip):
    flat = np.full(31, level)
    blood = np.where(np.abs(spectra.WAVELENGTH_NM - 560.0) < 25.0, dip * level, level)
    found = [skin_tone.dawson_erythema_index(one, spectra.WAVELENGTH_NM) for one in (flat, blood)]
    assert found[0] == pytest.approx(0.0, abs=1e-9)
    assert found[1] > found[0]


@CHEAP
@given(eumelanin=st.floats(0.0, 1.0), oxygenation=st.floats(0.0, 1.0))
def test_fractions_replace_those_of_constants(eumelanin, oxygenation):
    for constants in (SKIN_CONSTANTS, PAPER_CONSTANTS):
        changed = with_fractions(constants, eumelanin, oxygenation)
        assert (changed.eumelanin_fraction, changed.oxygenation) == (eumelanin, oxygenation)
        assert changed.epidermis_mm == constants.epidermis_mm


@CHEAP
@given(eta=st.floats(1.0, 1.6), g=st.floats(0.0, 0.98))
def test_default_directions_are_even_and_rise_with_anisotropy(eta, g):
    fewer, more = (discrete_ordinates.default_directions(eta, value) for value in (g, g + 0.01))
    assert fewer % 2 == 0
    assert 4 <= fewer <= more
