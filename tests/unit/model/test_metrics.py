import numpy as np
import pytest
from scipy import special

from model import metrics


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_angles_are_exact_from_smallest_to_largest(angle):
    turned = [np.sin(angle), 0.0, np.cos(angle)]
    assert metrics.angular_error_rad([0, 0, 2.0], turned) == pytest.approx(
        angle, rel=1e-9, abs=1e-15
    )


def test_a_vector_without_direction_has_no_angle():
    assert np.isnan(metrics.angular_error_rad([0, 0, 0], [0, 0, 1]))


def test_correct_intervals_reach_coverage_and_halved_ones_fail(rng):
    truth = np.zeros(4000)
    estimate = rng.normal(0.0, 2.0, 4000)
    honest = metrics.coverage(estimate, np.full(4000, 2.0), truth)
    # the exact 95 % interval misses the nominal share in 5 % of seeds; this seed is fixed
    assert honest.interval[0] < 0.6827 < honest.interval[1]
    assert metrics.coverage(estimate, np.full(4000, 1.0), truth).interval[1] < 0.6827


def test_masked_and_undefined_trials_do_not_count():
    result = metrics.coverage([0, np.nan, 9], 1.0, 0.0, valid=[True, True, False])
    assert (result.fraction, result.count) == (1.0, 1)
    assert np.isnan(metrics.coverage([np.nan], [1.0], [0.0]).fraction)


@pytest.mark.parametrize("n", [1, 2, 7, 400])
def test_median_interval_is_quantile_of_drawn_medians(n):
    values = np.random.default_rng(n).integers(0, 1 + n // 2, n) / 7.0  # with equal values
    found = metrics.median_with_interval(values, rng=np.random.default_rng(5))
    draws = np.random.default_rng(5).integers(0, n, (metrics.N_MEDIAN_DRAWS, n))
    medians = np.median(values[draws], axis=1)
    assert found == (np.median(values), tuple(np.quantile(medians, [0.16, 0.84])))


def test_median_interval_shrinks_with_root_of_count(rng):
    def width(n):
        low, high = metrics.median_with_interval(rng.normal(size=n), rng=rng)[1]
        return high - low

    assert 3.0 < width(200) / width(20_000) < 30.0


@pytest.mark.parametrize(("inside", "count"), [(0, 9), (1, 9), (9, 9), (680, 1000)])
def test_interval_of_coverage_is_exact_binomial(inside, count):
    error = np.where(np.arange(count) < inside, 0.0, 2.0)
    low, high = metrics.coverage(error, np.ones(count), np.zeros(count)).interval
    # the tails of the binomial distribution, summed term by term
    k = np.arange(count + 1)
    of_them = special.gammaln(count + 1) - special.gammaln(k + 1) - special.gammaln(count - k + 1)

    def probability(chance, chosen):
        logs = of_them + special.xlogy(k, chance) + special.xlog1py(count - k, -chance)
        return np.exp(logs[chosen]).sum()

    assert probability(low, k >= inside) == pytest.approx(0.025 if inside else 1.0, rel=1e-6)
    assert probability(high, k <= inside) == pytest.approx(0.025 if inside < count else 1.0)
