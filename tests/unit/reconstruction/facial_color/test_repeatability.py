"""Repeats of states against noise and against what states differ by; melanin over the hour."""

import numpy as np
import pytest
from scipy import stats

from reconstruction.facial_color import repeatability
from reconstruction.facial_color.repeatability import RepeatabilityError

SIDE = 24
ORDER = ("neutral", "smile", "anger") * 4
LEVELS = {"neutral": 0.020, "smile": 0.026, "anger": 0.031}


def captures(rng, *, noise=2e-3, scatter=0.0, slope=0.0, order=ORDER, side=SIDE):
    """Maps (N, side, side) with pixel noise, a scatter of whole captures, and a drift a capture."""
    level = np.array([LEVELS[state] for state in order])
    level = level + scatter * rng.standard_normal(len(order)) + slope * np.arange(len(order))
    maps = level[:, None, None] + noise * rng.standard_normal((len(order), side, side))
    return maps, np.full(maps.shape, noise)


def test_noise_only_repeats_alarm_at_stated_rate(rng):
    """300 sets, 10 regions each, 5 % false alarms a set: within a binomial's 4 deviations."""
    alarms = 0
    sets = 300
    for _ in range(sets):
        maps, stderr = captures(rng)
        found = repeatability.compare_states(maps, ORDER, stderr=stderr, false_alarm=0.05)
        # the last region is all pixels of the others again
        alarms += any(region.scatters for region in found.regions)
    assert stats.binom.cdf(alarms, sets, 0.05) > 3e-5
    assert alarms <= 0.05 * sets + 4 * np.sqrt(sets * 0.05 * 0.95)


def test_region_p_values_are_uniform_under_noise(rng):
    values = []
    for _ in range(300):
        maps, stderr = captures(rng, side=8)
        found = repeatability.compare_states(maps, ORDER, stderr=stderr)
        values.append(found.region("whole face").p_value)
    assert stats.kstest(values, "uniform").pvalue > 1e-4


def test_captures_differing_beyond_noise_are_found(rng):
    maps, stderr = captures(rng, scatter=1e-3)
    found = repeatability.compare_states(maps, ORDER, stderr=stderr).region("whole face")
    assert found.scatters
    np.testing.assert_allclose(found.within, 1e-3, rtol=4 / np.sqrt(2 * (len(ORDER) - 3)))


def test_stated_correlated_noise_is_not_scatter(rng):
    order = ORDER
    coarse = rng.standard_normal((len(order), SIDE // 4, SIDE // 4))
    noise = 2e-3 * np.repeat(np.repeat(coarse, 4, axis=1), 4, axis=2)
    maps = np.array([LEVELS[s] for s in order])[:, None, None] + noise
    stderr = np.full(maps.shape, 2e-3)
    ignored = repeatability.compare_states(maps, order, stderr=stderr).region("whole face")
    told = repeatability.compare_states(maps, order, stderr=stderr, correlated_px=16.0)
    assert ignored.scatters
    assert not told.region("whole face").scatters


def test_between_states_variation_matches_state_differences(rng):
    maps, stderr = captures(rng, scatter=5e-4)
    found = repeatability.compare_states(maps, ORDER, stderr=stderr).region("whole face")
    truth = np.std(list(LEVELS.values()), ddof=1)
    np.testing.assert_allclose(found.between, truth, rtol=0.2)
    expected = truth**2 / (truth**2 + 5e-4**2)
    assert abs(found.correlation - expected) < 4 * found.correlation_stderr
    np.testing.assert_allclose(found.change_to_scatter * found.within, 0.011, rtol=0.2)


def test_intraclass_correlation_error_is_its_scatter(rng):
    states, repeats, draws = 12, 4, 600
    order = tuple(str(k) for k in range(states)) * repeats
    found = []
    for _ in range(draws):
        level = rng.standard_normal(states)
        maps = np.array([level[int(s)] for s in order]) + 0.7 * rng.standard_normal(len(order))
        maps = np.broadcast_to(maps[:, None, None], (len(order), 4, 4))
        region = repeatability.compare_states(
            maps, order, stderr=np.full(maps.shape, 1e-3)
        ).regions[-1]
        found.append((region.correlation, region.correlation_stderr))
    values, errors = np.array(found).T
    np.testing.assert_allclose(values.mean(), 1 / 1.49, atol=0.03)
    # a large-sample formula at 12 states
    np.testing.assert_allclose(np.median(errors), values.std(), rtol=0.2)


def test_drifting_melanin_is_separated_from_changing_blood(rng):
    maps, stderr = captures(rng, slope=2e-4)
    times = 30.0 * np.arange(len(ORDER))
    found = repeatability.fit_drift(maps, ORDER, times, stderr=stderr)[-1]
    assert found.name == repeatability.WHOLE_REGION
    assert found.drifts
    assert abs(found.slope_per_minute - 4e-4) < 4 * found.slope_stderr
    still, stderr = captures(rng)
    found = repeatability.fit_drift(still, ORDER, times, stderr=stderr)[-1]
    assert not found.drifts


def test_states_captured_consecutively_are_not_drift(rng):
    """A line through all captures alike would take the states' order for a drift."""
    order = tuple(sorted(ORDER, key=lambda s: LEVELS[s]))
    maps, stderr = captures(rng, order=order)
    times = 60.0 * np.arange(len(order))
    found = repeatability.fit_drift(maps, order, times, stderr=stderr)[-1]
    assert not found.drifts
    alike = stats.linregress(times / 60.0, maps.mean(axis=(1, 2)))
    assert alike.pvalue < 1e-4


def test_drift_alarms_at_stated_rate_regardless_of_scatter(rng):
    times = 60.0 * np.arange(len(ORDER))
    for scatter in (0.0, 5e-4):
        alarms = 0
        for _ in range(300):
            maps, stderr = captures(rng, scatter=scatter, side=8)
            mask = {"all": np.ones((8, 8), bool)}
            found = repeatability.fit_drift(
                maps, ORDER, times, stderr=stderr, regions=mask, false_alarm=0.05
            )
            alarms += any(region.drifts for region in found)
        assert alarms <= 0.05 * 300 + 4 * np.sqrt(300 * 0.05 * 0.95)


def test_pixels_invalid_in_any_capture_are_in_none(rng):
    maps, stderr = captures(rng)
    valid = np.ones(maps.shape, bool)
    valid[3, :5] = False
    maps[3, :5] = np.nan
    maps[5, 10, 10] = np.nan
    found = repeatability.compare_states(maps, ORDER, stderr=stderr, valid=valid)
    assert found.region("whole face").pixels == SIDE * (SIDE - 5) - 1
    assert np.isfinite(found.region("whole face").means).all()


def test_named_regions_are_measured_independently(rng):
    maps, stderr = captures(rng)
    left = np.zeros((SIDE, SIDE), bool)
    left[:, :12] = True
    maps[:, left] += 0.01
    found = repeatability.compare_states(
        maps, ORDER, stderr=stderr, regions={"left": left, "dot": np.eye(SIDE) * left > 9}
    )
    gap = found.region("left").means - maps[:, :, :12].mean(axis=(1, 2))
    np.testing.assert_allclose(gap, 0.0, atol=1e-12)
    assert found.omitted == (("dot", "0 pixels are valid in all captures"),)


def test_maps_without_noise_or_change_give_no_nan():
    order = ("neutral", "smile") * 2
    flat = np.full((4, 8, 8), 0.02)
    found = repeatability.compare_states(flat, order, stderr=np.zeros(flat.shape)).region(
        "whole face"
    )
    assert found.correlation == 0.0
    assert not found.scatters
    drifted = repeatability.fit_drift(flat, order, [0, 1, 2, 3], stderr=np.zeros(flat.shape))[-1]
    assert not drifted.drifts


def test_captures_that_cannot_be_compared_are_refused(rng):
    maps, stderr = captures(rng)
    cases = (
        ((maps, ORDER[:3]), {"stderr": stderr}, "states: got shape"),
        ((maps[0], ORDER), {"stderr": stderr}, "maps: got shape"),
        ((maps, ORDER), {"stderr": stderr[0]}, "stderr: got shape"),
        ((maps[:3], ORDER[:3]), {"stderr": stderr[:3]}, "got each once"),
        ((maps, ORDER), {"stderr": stderr, "valid": np.zeros(maps.shape, bool)}, "no region"),
        ((maps, ORDER), {"stderr": -stderr}, "stderr: got -"),
        ((maps, ORDER), {"stderr": stderr, "false_alarm": 2.0}, "false_alarm"),
        ((maps, ORDER), {"stderr": stderr, "correlated_px": 0.5}, "correlated_px"),
        (
            (maps, ORDER),
            {"stderr": stderr, "regions": {"a": np.ones((2, 2), bool)}},
            "'a': got shape",
        ),
    )
    for given, options, message in cases:
        with pytest.raises(RepeatabilityError, match=message):
            repeatability.compare_states(*given, **options)
    with pytest.raises(RepeatabilityError, match="leave no repeats over time"):
        repeatability.fit_drift(maps[:4], ORDER[:4], np.arange(4.0), stderr=stderr[:4])
    with pytest.raises(RepeatabilityError, match="times_s: got shape"):
        repeatability.fit_drift(maps, ORDER, [1.0], stderr=stderr)
    with pytest.raises(RepeatabilityError, match="region: got 'chin', expected one of"):
        repeatability.compare_states(maps, ORDER, stderr=stderr).region("chin")
