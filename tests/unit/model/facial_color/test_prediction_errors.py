"""Errors of a predicted state beside those of doing without a rig."""

import numpy as np
import pytest

from model.facial_color.prediction_errors import compare_prediction


def test_single_gain_is_best_factor(rng):
    neutral = rng.uniform(0.01, 0.05, (30, 20))
    truth = 1.4 * neutral + 0.002 * rng.standard_normal(neutral.shape)
    found = compare_prediction(truth, truth, neutral)
    assert found.predicted == 0.0
    assert found.one_gain < found.neutral_kept
    for other in (found.gain - 1e-3, found.gain + 1e-3):
        assert np.sqrt(np.mean((other * neutral - truth) ** 2)) > found.one_gain


def test_masked_and_missing_pixels_are_ignored(rng):
    neutral = rng.uniform(0.01, 0.05, (10, 10))
    predicted = neutral.copy()
    predicted[0] = 9.0
    predicted[1] = np.nan
    found = compare_prediction(
        predicted, neutral, neutral, valid=np.arange(10)[:, None] * np.ones(10) > 0
    )
    assert found.pixels == 80
    assert found.predicted == 0.0
    with pytest.raises(ValueError, match="no pixel"):
        compare_prediction(predicted * np.nan, neutral, neutral)
    with pytest.raises(ValueError, match="predicted: got"):
        compare_prediction(predicted[1:], neutral, neutral)
