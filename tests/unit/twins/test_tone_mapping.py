"""Tone curves: ends, order, the toe that keeps blacks."""

from __future__ import annotations

import numpy as np
import pytest
from twins.tone_mapping import filmic, srgb_encoded


def test_srgb_is_continuous_where_its_pieces_meet():
    low, high = srgb_encoded([0.0031308 - 1e-9, 0.0031308 + 1e-9])
    assert high - low == pytest.approx(0.0, abs=1e-6)


def test_srgb_decodes_to_encoded_value():
    linear = np.linspace(0.0, 1.0, 101)
    code = srgb_encoded(linear)
    back = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(back, linear, atol=2e-6)  # the standard's own rounding


def test_filmic_keeps_black_and_order_rolling_off_highlights():
    x = np.linspace(0.0, 20.0, 2001)
    y = filmic(x)
    assert y[0] == pytest.approx(0.0, abs=1e-15)
    assert np.all(np.diff(y) > 0.0)
    assert filmic(5.6) == pytest.approx(1.0)
    slope = np.gradient(y, x)
    assert slope[1000] < 0.2 * slope.max()
