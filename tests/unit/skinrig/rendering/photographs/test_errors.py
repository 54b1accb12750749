"""Errors of renderings against photographs: what counts as lit, and what each number means."""

import numpy as np
import pytest

from skinrig.rendering.camera import RenderingError
from skinrig.rendering.photographs import errors
from skinrig.rendering.photographs.errors import Photograph

SIDE = 24


def scene(rng):
    """Return a smooth photograph with some noise, and where it is skin and lit."""
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE
    light = 0.2 + 0.5 * row + 0.2 * np.sin(9 * column)
    rgb = light[..., None] * np.array([1.0, 0.7, 0.5])
    covered = np.zeros((SIDE, SIDE), bool)
    covered[2:-2, 2:-2] = True
    lit = covered & (column < 0.7)
    sigma = 0.005
    noisy = rgb + sigma * rng.standard_normal(rgb.shape)
    valid = np.ones((SIDE, SIDE), bool)
    return rgb, Photograph(noisy, np.full(rgb.shape, sigma**2), valid), covered, lit


def test_correct_rendering_differs_by_noise_alone(rng):
    rgb, photo, covered, lit = scene(rng)
    pair = errors.compare_pair(photo, rgb, covered=covered, lit=lit)
    count = np.count_nonzero(pair.lit)
    # the median of `count` absolute normal deviates, within 4 standard errors
    assert abs(pair.median / pair.noise - 1) < 4 * 1.17 / np.sqrt(count)
    assert pair.ssim > 0.98


def test_color_difference_has_its_closed_form():
    gray, skin = np.full((4, 4, 3), 0.5), np.ones((4, 4), bool)
    # the photograph is white, L* = 100; of two grays CIEDE2000 is the difference over S_L
    light = 116.0 * 0.9 ** (1.0 / 3.0) - 16.0
    off = (0.5 * (100.0 + light) - 50.0) ** 2
    expected = (100.0 - light) / (1.0 + 0.015 * off / np.sqrt(20.0 + off))
    assert errors.color_difference(gray, 0.9 * gray, skin) == pytest.approx(expected, rel=1e-3)
    redder = gray * np.array([1.0, 0.98, 0.98])
    assert errors.color_difference(gray, redder, skin) > 0.5


@pytest.mark.parametrize("factor", [0.9, 1.05, 1.3])
def test_rendering_too_bright_by_factor_errs_by_factor(rng, factor):
    rgb, photo, covered, lit = scene(rng)
    exact = Photograph(rgb, photo.variance, photo.valid)
    pair = errors.compare_pair(exact, factor * rgb, covered=covered, lit=lit)
    assert pair.median == pytest.approx(abs(factor - 1))
    assert pair.total_error == pytest.approx(abs(factor - 1))
    assert np.sign(np.nanmedian(pair.signed)) == np.sign(factor - 1)


def test_missing_structure_lowers_similarity_beyond_uniform_error(rng):
    rgb, photo, covered, lit = scene(rng)
    fine = rgb * (1 + 0.03 * rng.choice([-1.0, 1.0], rgb.shape[:2]))[..., None]
    exact = Photograph(fine, photo.variance, photo.valid)
    smooth = errors.compare_pair(exact, rgb, covered=covered, lit=lit)
    even = errors.compare_pair(exact, 1.03 * fine, covered=covered, lit=lit)
    assert smooth.median == pytest.approx(even.median, rel=0.1)
    assert smooth.ssim < even.ssim < 1.0


def test_pixels_count_as_lit_only_with_lit_neighbors(rng):
    _, photo, covered, lit = scene(rng)
    lit[10, 10] = False
    found = errors.find_lit_pixels(photo, covered=covered, lit=lit)
    assert not found[9:12, 9:12].any()
    assert found[7, 7]
    assert not found[2].any()  # beside the skin's border
    assert found[3, 5]


def test_saturated_and_noisy_pixels_do_not_count(rng):
    rgb, photo, covered, lit = scene(rng)
    valid = photo.valid.copy()
    valid[8, 8] = False
    variance = np.array(photo.variance)
    variance[12, 12] = 1.0
    found = errors.find_lit_pixels(Photograph(rgb, variance, valid), covered=covered, lit=lit)
    assert not found[8, 8]
    assert not found[12, 12]
    assert found[8, 9]
    # how well the two agree has no part in it
    pair = errors.compare_pair(Photograph(rgb, variance, valid), 7 * rgb, covered=covered, lit=lit)
    assert (pair.lit == found).all()


def test_photograph_summary_pools_pixels_with_interval_over_photographs(rng):
    rgb, photo, covered, lit = scene(rng)
    exact = Photograph(rgb, photo.variance, photo.valid)
    pairs = [
        errors.compare_pair(exact, f * rgb, covered=covered, lit=lit)
        for f in (1.01, 1.02, 1.03, 1.1)
    ]
    found = errors.summarize_pairs(pairs, rng=rng)
    assert found.pairs == 4
    assert found.pixels == 4 * np.count_nonzero(pairs[0].lit)
    assert 0.02 <= found.median <= 0.03
    assert found.interval[0] < found.median < found.interval[1]
    assert found.p95 == pytest.approx(0.1)
    assert found.bias == pytest.approx(found.median)


def test_errors_by_band_use_pixels_of_band(rng):
    rgb, photo, covered, lit = scene(rng)
    exact = Photograph(rgb, photo.variance, photo.valid)
    factor = np.where(np.arange(SIDE)[:, None] < 12, 1.02, 1.2)[..., None]
    pair = errors.compare_pair(exact, factor * rgb, covered=covered, lit=lit)
    bands = np.where(np.arange(SIDE)[:, None] < 12, "light", "dark") + np.zeros((1, SIDE), "U1")
    found = errors.group_errors_by_band([pair], [np.where(covered, bands, "")])
    assert found["light"][1] == pytest.approx(0.02)
    assert found["dark"][1] == pytest.approx(0.2)
    assert found["light"][0] + found["dark"][0] == np.count_nonzero(pair.lit)


def test_images_that_cannot_be_compared_are_refused(rng):
    rgb, photo, covered, lit = scene(rng)
    with pytest.raises(RenderingError, match="expected"):
        errors.compare_pair(photo, rgb[:5], covered=covered, lit=lit)
    with pytest.raises(RenderingError, match="no unsaturated pixel"):
        errors.compare_pair(photo, rgb, covered=covered & False, lit=lit)
    dark = errors.compare_pair(photo, rgb, covered=covered, lit=lit & False)
    assert np.isnan(dark.median)
    with pytest.raises(RenderingError, match="no lit pixel"):
        errors.summarize_pairs([dark], rng=rng)
    with pytest.raises(RenderingError, match="variance"):
        Photograph(rgb, np.zeros((2, 2)), photo.valid)
