import numpy as np
import pytest

from model import metrics


# pairs of Sharma, Wu, Dalal 2005, table 1 (doi 10.1002/col.20070): near blue, the turn of the
# mean hue, near gray, large differences
@pytest.mark.parametrize(
    ("first", "second", "difference"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0000),
        ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
        ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0009), 7.1792),
        ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0011), 7.2195),
        ((50.0, 2.5, 0.0), (50.0, 0.0, -2.5), 4.3065),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((50.0, 2.5, 0.0), (58.0, 24.0, 15.0), 19.4535),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_ciede2000_equals_the_published_pairs_in_both_directions(first, second, difference):
    assert metrics.delta_e_2000(first, second) == pytest.approx(difference, abs=5e-5)
    assert metrics.delta_e_2000(second, first) == pytest.approx(difference, abs=5e-5)


def test_a_color_does_not_differ_from_itself():
    lab = np.array([[0.0, 0, 0], [50, 30, -20], [100, 0, 0]])
    np.testing.assert_array_equal(metrics.delta_e_2000(lab, lab), 0.0)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_angles_are_exact_from_the_smallest_to_the_largest(angle):
    turned = [np.sin(angle), 0.0, np.cos(angle)]
    assert metrics.angular_error_rad([0, 0, 2.0], turned) == pytest.approx(
        angle, rel=1e-9, abs=1e-15
    )


def test_a_vector_without_direction_has_no_angle():
    assert np.isnan(metrics.angular_error_rad([0, 0, 0], [0, 0, 1]))


def test_honest_intervals_cover_what_they_say_and_halved_ones_do_not(rng):
    truth = np.zeros(4000)
    estimate = rng.normal(0.0, 2.0, 4000)
    honest = metrics.coverage(estimate, np.full(4000, 2.0), truth)
    # the exact 95 % interval misses the nominal share in 5 % of seeds; this seed is fixed
    assert honest.interval[0] < 0.6827 < honest.interval[1]
    assert metrics.coverage(estimate, np.full(4000, 1.0), truth).interval[1] < 0.6827


def test_masked_and_undefined_trials_do_not_count():
    result = metrics.coverage([0, np.nan, 9], 1.0, 0.0, valid=[True, True, False])
    assert (result.share, result.count) == (1.0, 1)
    assert np.isnan(metrics.coverage([np.nan], [1.0], [0.0]).share)


def test_the_interval_of_a_median_shrinks_with_the_root_of_the_count(rng):
    def width(n):
        low, high = metrics.median_with_interval(rng.normal(size=n), rng=rng)[1]
        return high - low

    assert 3.0 < width(200) / width(20_000) < 30.0
