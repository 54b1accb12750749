import dataclasses
from datetime import date

import numpy as np
import pytest

from capture.calibration import store
from capture.calibration.color.white import WhiteReference, white_reference

SHAPE = (60, 90)


def shading():
    v, u = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    return (0.6 - 0.1 * u - 0.15 * (u**2 + v**2))[..., None] * np.array([0.7, 1.0, 0.5])


def tile(rng, *, light=1.0, reflectance=0.9, noise=0.004):
    image = light * reflectance * shading() + noise * rng.normal(size=(*SHAPE, 3))
    return image, np.full((*SHAPE, 3), noise**2), np.ones(SHAPE, bool)


def reference(rng, *, degree=4, lights=(1.0, 0.5, 1.0)):
    images, variances, valid = zip(*(tile(rng, light=x) for x in lights), strict=True)
    return white_reference(
        images, variances=variances, valid=valid, lights=lights, reflectance=0.9, degree=degree
    )


def test_white_surface_is_balanced_to_unity_everywhere():
    """Expected: known shading within 5 stated errors everywhere, 0.2 % on average."""
    white = reference(np.random.default_rng(1))
    balanced, variance, valid = white.balance(shading())
    assert valid.all()
    assert np.abs((balanced - 1) / np.sqrt(variance)).max() < 5
    assert np.sqrt(((balanced - 1) ** 2).mean()) < 0.002


def test_half_the_light_gives_the_same_reflectance():
    white = reference(np.random.default_rng(1))
    full, _, _ = white.balance(0.3 * shading())
    half, _, _ = white.balance(0.15 * shading(), light=0.5)
    np.testing.assert_allclose(half, full, rtol=1e-6)
    np.testing.assert_allclose(full.mean(), 0.3, atol=0.0005)


@pytest.mark.parametrize("degree", [4, None])
def test_stated_errors_match_size_of_true_errors(degree):
    """Expected: root mean square of error over stated error between 0.8 and 1.2.

    4 seeds x 3 channels x 15 coefficients are 180 independent numbers: standard deviation 0.05.
    """
    ratios = []
    for seed in range(4):
        white = reference(np.random.default_rng([2, seed]), degree=degree)
        ratios.append(((white.signal - shading()) / white.stderr) ** 2)
    assert 0.8 < np.sqrt(np.mean(ratios)) < 1.2


def test_reflectance_variance_includes_reference_variance():
    white = reference(np.random.default_rng(3), degree=None)
    _, variance, _ = white.balance(0.5 * shading(), variance=np.full((*SHAPE, 3), 1e-5))
    expected = 1e-5 / white.signal**2 + (0.5 * shading() / white.signal**2 * white.stderr) ** 2
    np.testing.assert_allclose(variance, expected, rtol=1e-4)


def test_saturated_pixels_of_the_tile_are_masked():
    rng = np.random.default_rng(4)
    image, variance, valid = tile(rng)
    valid[10:20, 30:40] = False
    white = white_reference([image], variances=[variance], valid=[valid], degree=None)
    assert not white.valid[10:20, 30:40].any()
    assert np.isnan(white.signal[12, 33]).all()
    _, _, good = white.balance(shading())
    np.testing.assert_array_equal(good, valid)


def test_a_white_reference_survives_the_disk(tmp_path):
    rng = np.random.default_rng(5)
    image, variance, valid = tile(rng)
    valid[0, 0] = False
    white = white_reference([image], variances=[variance], valid=[valid])
    store.save(
        white.to_calibration(
            serial="N1", rig="flash", source="simulated", created=date(2026, 11, 21)
        ),
        tmp_path,
    )
    again = WhiteReference.from_calibration(store.load(tmp_path, "white"), "N1")
    np.testing.assert_array_equal(again.signal, white.signal)
    np.testing.assert_array_equal(again.valid, white.valid)
    assert not again.valid[0, 0]


def test_unusable_tiles_state_the_reason():
    image, variance, valid = tile(np.random.default_rng(6))
    with pytest.raises(ValueError, match="saturated"):
        white_reference([image], variances=[variance], valid=[~valid])
    with pytest.raises(ValueError, match="equally many"):
        white_reference([image], variances=[], valid=[valid])
    with pytest.raises(ValueError, match="reflectance"):
        white_reference([image], variances=[variance], valid=[valid], reflectance=1.2)
    white = white_reference([image], variances=[variance], valid=[valid])
    with pytest.raises(ValueError, match="same camera settings"):
        white.balance(image[:10])


def test_led_references_survive_calibration_file(tmp_path):
    rng = np.random.default_rng(7)
    images, variances, valid = zip(*(tile(rng) for _ in range(2)), strict=True)
    gray = white_reference(
        [image.sum(axis=-1, keepdims=True) for image in images],
        variances=[variance.sum(axis=-1, keepdims=True) for variance in variances],
        valid=valid,
        degree=None,
    )
    whole = dataclasses.replace(reference(rng), leds={"LED-590-20": gray})
    made = whole.to_calibration(
        serial="C1", rig="flash", source="simulated", created=date(2026, 11, 21)
    )
    store.save(made, tmp_path)
    loaded = WhiteReference.from_calibration(store.load(tmp_path, "white"), "C1")
    assert list(loaded.leds) == ["LED-590-20"]
    np.testing.assert_array_equal(loaded.leds["LED-590-20"].signal, gray.signal)
    np.testing.assert_array_equal(loaded.signal, whole.signal)
