"""Local histogram matching against sorting by hand."""

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter
from twins.sliding_histograms import match_sliding

from model import facial_color
from model.facial_color.disc_statistics import DiscStatisticsError
from model.facial_color.histogram_matching import match


def texture(rng, shape=(70, 60)):
    return 0.05 + 0.01 * gaussian_filter(rng.standard_normal(shape), 1.5)


@pytest.mark.parametrize("way", [match, match_sliding])
def test_affine_target_is_reproduced_to_rounding(way, rng):
    neutral = texture(rng)
    found = way(neutral, 1.7 * neutral - 0.02, 6.5)
    assert found.valid.all()
    np.testing.assert_allclose(found.hemoglobin, 1.7 * neutral - 0.02, atol=1e-15)


def test_pixel_maps_to_its_rank_in_target_window(rng):
    neutral, target = texture(rng, (25, 23)), texture(rng, (25, 23))
    y, x = np.mgrid[:25, :23]
    found = match_sliding(neutral, target, 4.2).hemoglobin
    for at in ((0, 0), (12, 11), (24, 3)):
        inside = (y - at[0]) ** 2 + (x - at[1]) ** 2 <= 4.2**2
        rank = np.count_nonzero(neutral[inside] < neutral[at])
        assert found[at] == np.sort(target[inside])[rank]


def test_matched_map_has_target_distribution_even_non_gaussian(rng):
    neutral = texture(rng, (120, 120))
    target = 0.02 * np.exp(gaussian_filter(rng.standard_normal((120, 120)), 1.5) * 4)
    radius_px = 20.0
    found = match(neutral, target, radius_px).hemoglobin
    (mu_n, sigma_n), (mu, sigma) = (
        facial_color.local_statistics(h, radius_px) for h in (neutral, target)
    )
    gaussian = mu + sigma / sigma_n * (neutral - mu_n)
    inside = np.hypot(*(np.mgrid[:120, :120] - 60)) <= radius_px

    def distance(a):
        return stats.wasserstein_distance(a[inside], target[inside])

    assert distance(found) < 0.5 * distance(gaussian)


def test_denser_windows_come_closer_to_sliding_ones(rng):
    neutral, target = texture(rng), texture(rng)
    exact = match_sliding(neutral, target, 9.0).hemoglobin
    errors = [
        np.sqrt(np.mean((match(neutral, target, 9.0, spacing_px=n).hemoglobin - exact) ** 2))
        for n in (6, 3, 1)
    ]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] == 0.0


def test_masked_pixels_never_leak(rng):
    neutral, target = texture(rng), texture(rng)
    hole = np.zeros(neutral.shape, bool)
    hole[10:50, 20:45] = True
    expected = match(neutral, target, 5.0, valid=~hole, valid_target=~hole)
    found = match(np.where(hole, np.nan, neutral), np.where(hole, np.inf, target), 5.0)
    np.testing.assert_array_equal(found.valid, ~hole)
    np.testing.assert_array_equal(found.hemoglobin[~hole], expected.hemoglobin[~hole])
    assert np.isnan(found.hemoglobin[hole]).all()


def test_pixels_without_reachable_target_are_invalid(rng):
    neutral = texture(rng)
    nowhere = np.zeros(neutral.shape, bool)
    nowhere[:, :10] = True
    found = match_sliding(neutral, neutral, 4.0, valid_target=nowhere)
    assert found.valid[:, :13].all()
    assert not found.valid[:, 14:].any()


def test_flat_neutral_map_takes_target_median(rng):
    target = texture(rng)
    found = match_sliding(np.full(target.shape, 0.3), target, 100.0).hemoglobin
    np.testing.assert_allclose(found, np.median(target), rtol=1e-12)


def test_wrong_spacing_and_shapes_are_named(rng):
    neutral = texture(rng)
    with pytest.raises(DiscStatisticsError, match="spacing_px: got 9, expected a number in"):
        match(neutral, neutral, 9.0, spacing_px=9)
    with pytest.raises(DiscStatisticsError, match="radius_px"):
        match(neutral, neutral, 1.0)
    with pytest.raises(DiscStatisticsError, match="target: got"):
        match(neutral, neutral[1:], 4.0)
    with pytest.raises(DiscStatisticsError, match="valid_target"):
        match(neutral, neutral, 4.0, valid_target=np.ones(3, bool))
