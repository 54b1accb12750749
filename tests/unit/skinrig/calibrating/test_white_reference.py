"""A white tile is told from other pictures by what lamps and lenses can do to it."""

import numpy as np
import pytest

from skinrig.calibrating.white_reference import (
    MIN_EVEN_FRACTION,
    NoWhiteReferenceError,
    check_white_reference,
    even_fraction,
)


def field(height=256, width=384):
    y, x = np.mgrid[:height, :width]
    return (y - height / 2) / (width / 2), (x - width / 2) / (width / 2)


def tile(rng, *, fall=1.0, tint=0.0, noise=0.02):
    """Return a tile behind a lens of 30 degrees, a lamp beside it, corners that are tinted."""
    y, x = field()
    lens = np.cos(np.arctan(np.hypot(x, y) * np.tan(np.deg2rad(30.0)))) ** 4
    lamp = np.exp(-fall * (x + 0.5 * y))
    color = np.stack([1 + tint * (x**2 + y**2), np.ones_like(x), 1 - tint * x**2], axis=-1)
    light = (lens * lamp)[..., None] * color * (0.6, 1.0, 0.7)
    return light * (1 + noise * rng.standard_normal(light.shape))


@pytest.mark.parametrize("fall", [0.0, 1.0])
@pytest.mark.parametrize("tint", [0.0, 0.05])
@pytest.mark.parametrize("brightness", [1e-4, 1.0, 1e4])
def test_tile_under_slanted_light_wide_lens_is_uniform(fall, tint, brightness, rng):
    picture = brightness * tile(rng, fall=fall, tint=tint)
    assert even_fraction(picture, np.ones(picture.shape[:2], bool)) > 0.99


def test_dust_speck_and_saturated_pixels_do_not_matter(rng):
    picture, valid = tile(rng), np.ones((256, 384), bool)
    picture[100:108, 200:208] = 0.05
    picture[:60, :90], valid[:60, :90] = 50.0, False
    assert even_fraction(picture, valid) > 0.95


def test_margin_around_tile_counts_as_nonuniform(rng):
    picture = tile(rng)
    picture[:, 288:] = 0.001 * rng.random((256, 96, 3))
    share = even_fraction(picture, np.ones((256, 384), bool))
    assert share == pytest.approx(0.75, abs=0.04)


def test_lit_ball_before_darkness_is_not_a_tile(rng):
    y, x = field()
    depth = np.sqrt(np.clip(0.36 - x**2 - y**2, 0, None))
    picture = depth[..., None] * (0.9, 0.6, 0.4) + 1e-4 * rng.standard_normal((256, 384, 3))
    assert even_fraction(picture, np.ones((256, 384), bool)) < MIN_EVEN_FRACTION


def test_evenly_lit_color_chart_is_not_a_tile(rng):
    patches = rng.uniform(0.05, 0.9, (8, 12, 3))
    picture = patches.repeat(32, axis=0).repeat(32, axis=1)
    assert even_fraction(picture, np.ones((256, 384), bool)) < MIN_EVEN_FRACTION


def test_fully_saturated_image_gives_no_verdict():
    assert even_fraction(np.ones((96, 96, 3)), np.zeros((96, 96), bool)) == 1.0


def test_images_of_few_pixels_are_evaluated(rng):
    assert even_fraction(np.ones((8, 8, 3)), np.ones((8, 8), bool)) == 1.0
    assert even_fraction(rng.random((8, 8, 3)), np.ones((8, 8), bool)) < MIN_EVEN_FRACTION


def test_thumbnail_noise_is_not_unevenness(rng):
    picture = tile(rng, noise=0.0)[::6, ::6]
    picture = picture * (1 + 0.03 * rng.standard_normal(picture.shape))
    assert even_fraction(picture, np.ones(picture.shape[:2], bool)) > 0.99


def test_face_before_uniform_wall_is_not_a_tile(rng):
    picture = tile(rng)
    y, x = field()
    inside = x**2 / 0.3**2 + y**2 / 0.45**2 < 1  # a sixth of the picture
    skin = np.sqrt(np.clip(1 - x**2 / 0.3**2 - y**2 / 0.45**2, 0, 1))[..., None] * (0.5, 0.4, 0.2)
    picture = np.where(inside[..., None], skin, picture)
    with pytest.raises(NoWhiteReferenceError, match="frame 1 does not show a white reference"):
        check_white_reference(picture, np.ones((256, 384), bool), "frame 1")
