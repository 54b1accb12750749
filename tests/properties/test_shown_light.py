"""Values sent to a display and a real-time page, over all light, widths and directions."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from twins import facial_specular, screen_scattering, tone_mapping

from model import color_table

CHEAP = settings(derandomize=True, deadline=None, max_examples=30, database=None)
FEW = settings(CHEAP, max_examples=15)

SHARE = st.floats(0.0, 1.0)
LIGHT = st.floats(-1e308, 1e308)  # subnormals among them
SEED = st.integers(0, 9999)
HALF = st.floats(0.0, np.pi / 2)
TURN = st.floats(-np.pi, np.pi)


def direction(polar, turn):
    return np.array([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])


@CHEAP
@given(light=st.lists(LIGHT, min_size=2, max_size=12), infinite=st.booleans())
def test_more_light_is_never_shown_darker(light, infinite):
    linear = np.sort([*light, np.inf] if infinite else light)
    for curve in (tone_mapping.srgb_encoded, tone_mapping.filmic):
        shown = curve(linear)
        assert np.isfinite(shown).all()
        assert (np.diff(shown) >= -1e-15).all()
        assert (shown[linear <= 0.0] == 0.0).all()
    assert tone_mapping.srgb_encoded(linear).max() <= 1.0


@CHEAP
@given(light=st.floats(0.0, 1.0))
def test_display_returns_the_emitted_light(light):
    shown = float(tone_mapping.srgb_encoded(light))
    back = shown / 12.92 if shown <= 0.04045 else ((shown + 0.055) / 1.055) ** 2.4
    assert back == pytest.approx(light, rel=1e-4, abs=1e-300)


@CHEAP
@given(cosine=st.floats(-2.0, 2.0), f0=SHARE)
def test_facet_reflectance_is_between_normal_incidence_and_all(cosine, f0):
    found = facial_specular.schlick(cosine, f0)
    assert f0 * (1.0 - 1e-12) <= found <= 1.0 + 1e-12
    assert facial_specular.schlick(1.0, f0) == f0


@CHEAP
@given(
    polar=st.tuples(HALF, HALF),
    turn=st.tuples(TURN, TURN),
    f0=SHARE,
    roughness=st.floats(1e-6, 1e6),
)
def test_specular_is_reciprocal_in_light_and_eye(polar, turn, f0, roughness):
    z = [0.0, 0.0, 1.0]
    to_light, to_eye = (direction(p, t) for p, t in zip(polar, turn, strict=True))
    assume(to_light[2] > 0.0)
    assume(to_eye[2] > 0.0)
    found = facial_specular.kelemen(z, to_light, to_eye, roughness, f0=f0)
    assert np.isfinite(found)
    assert found >= 0.0
    back = facial_specular.kelemen(z, to_eye, to_light, roughness, f0=f0)
    assert back == pytest.approx(float(found), rel=1e-6, abs=1e-300)
    under = facial_specular.kelemen(z, -to_light, to_eye, roughness, f0=f0)
    assert under == 0.0


@CHEAP
@given(roughness=st.sampled_from([0.0, -0.3, 1e-300, np.inf, np.nan]))
def test_a_surface_without_roughness_is_refused(roughness):
    z = [0.0, 0.0, 1.0]
    with pytest.raises(ValueError, match="roughness"):
        facial_specular.kelemen(z, z, z, roughness)


@CHEAP
@given(wide=st.lists(st.floats(0.0, 1e308), min_size=2, max_size=9))
def test_wider_blur_needs_wider_taps_within_its_width(wide):
    wanted = np.sort(wide)
    asked = screen_scattering.narrowed(wanted)
    assert np.isfinite(asked).all()
    assert (asked <= wanted).all()
    assert (np.diff(asked) >= 0.0).all()
    far = wanted > 100.0
    np.testing.assert_allclose(asked[far], wanted[far], rtol=1e-8)


@FEW
@given(
    seed=SEED,
    sides=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    depth=st.floats(1e-6, 1e6),
    width=st.floats(1e-100, 1e100),
    level=st.floats(1e-300, 1e100),
    focal=st.floats(1e-3, 1e6),
)
def test_scattered_light_stays_between_darkest_and_brightest(
    seed, sides, depth, width, level, focal
):
    rng = np.random.default_rng(seed)
    light = level * rng.uniform(size=(*sides, 3))
    z = depth * (1.0 + rng.uniform(size=sides)) * (rng.uniform(size=sides) < 0.8)
    kept = light.copy()
    shares = rng.uniform(0.1, 1.0, (3, 3))
    shares /= shares.sum(axis=0)
    told = {"variances_mm2": [0.01, 0.2, 3.0], "weights": shares, "focal_px": focal}
    found = screen_scattering.scatter(light, z, width=width, **told)
    np.testing.assert_array_equal(light, kept)
    there = z > 0.0
    assert np.isfinite(found).all()
    assert (found[~there] == 0.0).all()
    if there.any():
        low, high = light[there].min(), light[there].max()
        assert (found[there] >= low * (1 - 1e-9)).all()
        assert (found[there] <= high * (1 + 1e-9)).all()
        even = np.where(there[..., None], level, 0.0) * np.ones(3)
        np.testing.assert_allclose(
            screen_scattering.scatter(even, z, width=width, **told), even, rtol=1e-9
        )


@CHEAP
@given(
    what=st.sampled_from(["light", "depth", "width", "weights", "focal_px"]),
    bad=st.sampled_from([np.nan, np.inf, -1.0, 0.0]),
)
def test_nonscattering_medium_is_refused_by_name(what, bad):
    told = {
        "light": np.ones((2, 3, 3)),
        "depth": np.full((2, 3), 400.0),
        "width": np.ones((2, 3)),
        "weights": np.full((1, 3), 1.0),
        "focal_px": 1000.0,
    }
    if what == "focal_px":
        told[what] = bad
    else:
        told[what].flat[1] = bad
    light, depth = told.pop("light"), told.pop("depth")
    # no light and no weight are some, and a depth of 0 or below is no surface
    if what in ("light", "depth", "weights") and np.isfinite(bad):
        found = screen_scattering.scatter(light, depth, variances_mm2=[0.1], **told)
        assert np.isfinite(found).all()
        return
    with pytest.raises(screen_scattering.ScreenScatteringError, match=what):
        screen_scattering.scatter(light, depth, variances_mm2=[0.1], **told)


@FEW
@given(
    fractions=st.lists(st.tuples(st.floats(0.0, 0.5), st.floats(0.0, 0.32)), min_size=1, max_size=4)
)
def test_skin_spectrum_is_fraction_and_falls_with_pigment(fractions):
    c_m, c_hd = np.array(fractions).T
    found = color_table.spectral_reflectance(c_m, c_hd)
    assert found.shape == (c_m.size, 31)
    assert ((found > 0.0) & (found < 1.0)).all()
    darker = color_table.spectral_reflectance(0.5 + 0.5 * (c_m - 0.5), c_hd)
    assert (darker <= found * (1.0 + 1e-3)).all()
    one = color_table.spectral_reflectance(c_m[0], c_hd[0])
    np.testing.assert_array_equal(one, found[0])


@CHEAP
@given(bad=st.sampled_from([np.nan, np.inf, -1e-300, 0.51]))
def test_a_spectrum_of_no_skin_is_refused(bad):
    with pytest.raises(color_table.ColorTableError, match="c_m"):
        color_table.spectral_reflectance([0.1, bad], 0.1)
    with pytest.raises(color_table.ColorTableError, match="c_hd"):
        color_table.spectral_reflectance(0.1, [0.1, bad])
