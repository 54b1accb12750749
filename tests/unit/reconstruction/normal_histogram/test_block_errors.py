"""Standard errors of a map's mean where neighboring blocks are alike."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from reconstruction.normal_histogram.blocks import MIN_BLOCKS, mean_stderr

SIDE = 8
PLACES = np.stack(np.divmod(np.arange(SIDE * SIDE), SIDE), axis=1).astype(np.float64)


def block_means(field):
    part = field.shape[0] // SIDE
    return field.reshape(SIDE, part, SIDE, part).mean(axis=(1, 3)).ravel()


def test_independent_blocks_have_the_error_of_independent_samples(rng):
    values = rng.normal(size=(40, SIDE * SIDE))
    stated = [mean_stderr(one, np.ones(one.size), PLACES)[0] for one in values]
    # no less; more by the weak fields that 64 blocks cannot exclude
    assert 1.0 / SIDE <= np.sqrt(np.mean(np.square(stated))) <= 1.3 / SIDE


@pytest.mark.parametrize("reach", [0.5, 1.0])
def test_correlated_field_mean_intervals_have_nominal_coverage(reach, rng):
    """White noise smoothed over part of a block, cut out of a larger field whose mean is 0."""
    held, naive, trials, part = 0, 0, 150, 6
    for _ in range(trials):
        field = gaussian_filter(
            rng.normal(size=(3 * SIDE * part,) * 2), 0.5 * reach * part, mode="wrap"
        )
        values = block_means(field[: SIDE * part, : SIDE * part])
        stderr, growth = mean_stderr(values, np.ones(values.size), PLACES)
        held += abs(values.mean()) <= stderr
        naive += abs(values.mean()) <= values.std(ddof=1) / SIDE
        assert growth >= 1.0
    # the promised 60 to 76 %, and two standard deviations of so many trials
    chance = 2.0 * np.sqrt(0.68 * 0.32 / trials)
    assert 0.60 - chance <= held / trials <= 0.76 + chance
    assert naive / trials < 0.6


def test_a_block_counts_by_its_samples(rng):
    """A block of one sample that is far off moves the mean of all, and its error, by little."""
    values, sizes = rng.normal(size=SIDE * SIDE), np.full(SIDE * SIDE, 100.0)
    before, _ = mean_stderr(values, sizes, PLACES)
    values[10], sizes[10] = 8.0, 1.0
    after, _ = mean_stderr(values, sizes, PLACES)
    assert after == pytest.approx(before, rel=0.2)


def test_too_few_blocks_give_nothing_equal_zero_error():
    few = np.arange(MIN_BLOCKS - 1.0)
    assert mean_stderr(few, np.ones(few.size), PLACES[: few.size]) == (np.inf, 1.0)
    assert mean_stderr(np.full(9, 0.5), np.ones(9), PLACES[:9]) == (0.0, 1.0)
