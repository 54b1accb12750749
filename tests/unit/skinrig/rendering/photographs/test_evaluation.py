import numpy as np
import pytest

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.evaluating.flash import compare


def appearance(melanin, stderr=None, valid=None):
    return SkinAppearance(
        {"melanin": SkinMap(melanin, MAP_UNITS["melanin"], stderr, valid)}, "simulated"
    )


def test_unbiased_estimate_reports_its_scatter_and_full_coverage(rng):
    truth = np.full((60, 60), 0.08)
    stderr = np.full((60, 60), 0.008)
    estimate = truth + rng.normal(0, 0.008, truth.shape)
    row = compare(appearance(estimate, stderr), appearance(truth), rng=rng)[0]
    assert row.median_relative == pytest.approx(0.6745 * 0.1, rel=0.1)
    assert row.coverage.interval[0] < 0.6827 < row.coverage.interval[1]
    assert abs(row.bias) < 0.01


def test_masked_pixels_are_counted_and_do_not_err(rng):
    truth = np.full((10, 10), 0.08)
    estimate = truth.copy()
    estimate[:3] = np.nan
    row = compare(appearance(estimate, valid=np.isfinite(estimate)), appearance(truth), rng=rng)[0]
    assert row.masked == pytest.approx(0.3)
    assert row.median_relative < 1e-6


def test_each_pixel_is_binned_by_true_melanin(rng):
    truth = np.repeat([[0.01], [0.3]], 30, axis=1)
    rows = compare(appearance(truth * 1.1), appearance(truth), rng=rng)
    assert [(row.band_name, row.pixels) for row in rows] == [
        ("all", 60),
        ("melanin 0–0.02", 30),
        ("melanin 0.2–0.51", 30),
    ]


def test_maps_of_different_size_are_refused(rng):
    with pytest.raises(ValueError, match="expected the same"):
        compare(appearance(np.ones((2, 2))), appearance(np.ones((3, 3))), rng=rng)
