"""Points and media of the benchmark of intervals."""

import numpy as np
import pytest

from reconstruction.anisotropy import estimation as anisotropy
from skinrig.benchmarks.intervals import coverage_stage as intervals
from skinrig.benchmarks.intervals import probe as interval_trials_probe
from skinrig.benchmarks.intervals.coverage import IntervalCoverage
from skinrig.benchmarks.results import Timing

ONCE = Timing(1.0, (1.0, 1.0), 1.0, None)


def point(fraction, interval):
    return intervals._point(IntervalCoverage("x", "any", 68, fraction, interval, 6, 1.0, "%"), ONCE)


def test_interval_containing_nominal_coverage_allows_zero_distance():
    found = point(0.72, (0.60, 0.80))
    assert found.error == pytest.approx(4.0)
    assert found.error_interval == pytest.approx((0.0, 12.0))


@pytest.mark.parametrize(("fraction", "interval"), [(0.5, (0.4, 0.6)), (0.86, (0.76, 0.96))])
def test_interval_excluding_nominal_coverage_excludes_zero_distance(fraction, interval):
    found = point(fraction, interval)
    assert found.error == pytest.approx(18.0)
    assert found.error_interval == pytest.approx((8.0, 28.0))


def test_media_distinguish_axis_mirrored_or_across():
    """Wrong axes differ by 10 degrees at least; the axis is estimated to a few.

    At 0 and 90 degrees a direction is equal to its mirror image; at 45 degrees the direction across
    is equal to the mirror image.
    """
    for medium in intervals.ANISOTROPIC_MEDIA:
        true_deg = interval_trials_probe._farthest_deg(medium)
        for wrong_deg in (-true_deg, true_deg + 90.0, 90.0 - true_deg):
            turn = abs((wrong_deg - true_deg + 90.0) % 180.0 - 90.0)
            assert turn >= 10.0


@pytest.mark.parametrize("medium", intervals.ANISOTROPIC_MEDIA)
def test_estimator_finds_axis_that_evaluates_media(medium):
    """Exact decays are smallest in the direction in which light propagates farthest."""
    true_deg = interval_trials_probe._farthest_deg(medium)
    angle = np.radians(np.arange(8) * 22.5)
    along = np.cos(2.0 * (angle - np.radians(true_deg)))
    found = anisotropy.estimate(angle, (0.5 - 0.05 * along)[:, None] * np.ones(3), outliers=False)
    turn = (np.degrees(found.axis_rad) - true_deg + 90.0) % 180.0 - 90.0
    np.testing.assert_allclose(turn, 0.0, atol=2.0)
