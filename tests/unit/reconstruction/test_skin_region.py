"""Skin of a face is kept and its surroundings are left out, for colors of measured skin."""

import numpy as np
import pytest
import skimage.color
import skimage.data

from model.skin import SkinMap
from model.skin_tone.measured import measured_skin
from reconstruction.pipeline.flash.skin_stage import _keep_skin
from reconstruction.pipeline.inputs import InputsError
from reconstruction.skin_region import find_face_skin

SIDE = 120
FACE = (0.3, 0.3, 0.4, 0.4)
SURROUNDINGS = {
    "wall": (0.55, 0.52, 0.50),
    "dark hair": (0.020, 0.016, 0.013),
    "cloth": (0.10, 0.20, 0.50),
}


def linear(lab):
    shown = skimage.color.lab2rgb(lab)
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def scene(band, around, seed=0):
    """An ellipse of skin of one band with shading, spots of blood and noise, and its place."""
    rng = np.random.default_rng(seed)
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE - 0.5
    skin = (x / 0.24) ** 2 + (y / 0.28) ** 2 < 1
    colors = measured_skin()
    lab = [colors.at(band, name, 50.0) for name in ("lightness", "a_star", "b_star")]
    low, high = (colors.at(band, "a_star", p) for p in (25.0, 75.0))
    changed = np.tile(lab, (SIDE, SIDE, 1))
    changed[..., 1] += np.clip(rng.normal(0, 0.5 * (high - low), skin.shape), -3, 3)
    shade = np.sqrt(np.maximum(1 - (x / 0.28) ** 2 - (y / 0.34) ** 2, 0.04))
    rgb = np.where(skin[..., None], linear(changed) * shade[..., None], around)
    return (rgb * (1 + 0.01 * rng.standard_normal(rgb.shape))).astype(np.float32), skin


@pytest.mark.parametrize("around", SURROUNDINGS)
@pytest.mark.parametrize("band", ["I", "II", "III", "IV", "V", "VI"])
def test_skin_is_kept_surroundings_left_out(band, around):
    rgb, skin = scene(band, SURROUNDINGS[around])
    found = find_face_skin(rgb, np.ones(skin.shape, bool), FACE)
    assert found[skin].mean() > 0.93
    assert found[~skin].mean() < 0.005


def test_surroundings_of_skin_color_enter():
    """What the test above would miss: the color decides, not the ellipse."""
    rgb, skin = scene("III", tuple(linear([60.0, 12.0, 18.0])))
    found = find_face_skin(rgb, np.ones(skin.shape, bool), FACE)
    assert found[~skin].mean() > 0.1


def test_balance_of_light_does_not_matter():
    rgb, skin = scene("IV", SURROUNDINGS["wall"])
    everywhere = np.ones(skin.shape, bool)
    plain = find_face_skin(rgb, everywhere, FACE)
    tinted = find_face_skin(rgb * np.float32([0.1, 0.3, 0.2]), everywhere, FACE)
    assert np.array_equal(plain, tinted)


def test_invalid_pixels_stay_out():
    rgb, skin = scene("II", SURROUNDINGS["cloth"])
    valid = np.ones(skin.shape, bool)
    valid[50:60, 50:60] = False
    rgb[60:70, 60:70] = np.nan
    found = find_face_skin(rgb, valid, FACE)
    assert found.any()
    assert not found[50:60, 50:60].any()
    assert not found[60:70, 60:70].any()


def test_face_without_values_has_none():
    rgb, skin = scene("II", SURROUNDINGS["cloth"])
    assert not find_face_skin(rgb, ~skin & False, FACE).any()


def test_portrait_keeps_skin_alone():
    """Points were read from the portrait that scikit-image ships."""
    shown = skimage.data.astronaut() / 255.0
    rgb = (shown**2.2).astype(np.float32)
    square = np.divide((163.0, 62.0, 94.0, 94.0), 512.0)
    found = find_face_skin(rgb, np.ones(rgb.shape[:2], bool), tuple(square))
    skin = {
        "forehead": (92, 222),
        "cheek": (135, 195),
        "other cheek": (132, 252),
        "chin": (168, 222),
    }
    rest = {
        "hair": (50, 220),
        "hair at the side": (110, 160),
        "wall": (40, 60),
        "suit": (300, 150),
        "teeth": (147, 222),
        "collar": (215, 225),
        "pupil": (101, 200),
    }
    assert {name for name, place in skin.items() if found[place]} == set(skin)
    assert {name for name, place in rest.items() if found[place]} == set()


def test_clipped_cheeks_are_refused():
    rgb, skin = scene("II", SURROUNDINGS["cloth"])
    everywhere = np.ones(skin.shape, bool)
    _keep_skin("s: neutral", FACE, SkinMap(rgb, "1", valid=everywhere))
    clipped = everywhere & ~skin
    with pytest.raises(InputsError, match="cheeks and nose may be clipped"):
        _keep_skin("s: neutral", FACE, SkinMap(rgb, "1", valid=clipped))
