"""Histograms moved by their quantiles: mass kept, shifts exact, opposite changes bring back."""

import numpy as np
import pytest

from model.traits import histogram_transport as transport

EDGES = np.linspace(-4.0, 4.0, 257)


def bell(mean, deviation):
    middle = 0.5 * (EDGES[1:] + EDGES[:-1])
    h = np.exp(-0.5 * ((middle - mean) / deviation) ** 2)
    return h / h.sum()


def test_bell_quantiles_match_normal_distribution():
    from scipy.stats import norm

    found = transport.quantiles(bell(0.3, 0.5), EDGES)
    expected = norm.ppf(transport.quantile_levels(), 0.3, 0.5)
    np.testing.assert_allclose(found[3:-3], expected[3:-3], atol=0.01)


def test_shift_moves_bell_and_keeps_shape():
    found = transport.shift_quantiles(bell(-1.0, 0.4), EDGES, np.full(256, 1.5))
    assert np.abs(np.cumsum(found) - np.cumsum(bell(0.5, 0.4))).max() < 0.01


def test_a_wider_spread_is_a_change_too():
    source = bell(0.0, 0.4)
    change = 0.5 * transport.quantiles(source, EDGES)
    found = transport.shift_quantiles(source, EDGES, change)
    assert np.abs(np.cumsum(found) - np.cumsum(bell(0.0, 0.6))).max() < 0.01


@pytest.mark.parametrize("mean", [-2.0, 0.1, 2.5])
def test_the_opposite_change_brings_back(mean, rng):
    source = bell(mean, 0.3)
    change = 0.2 + 0.3 * np.linspace(-1, 1, 256)
    there = transport.shift_quantiles(source, EDGES, change)
    back = transport.shift_quantiles(there, EDGES, -change)
    assert np.abs(np.cumsum(back) - np.cumsum(source)).max() < 0.02
    assert np.abs(np.cumsum(there) - np.cumsum(source)).max() > 0.2


def test_null_change_is_identity_any_change_keeps_histogram(rng):
    several = rng.random((2, 3, 256)) * (rng.random((2, 3, 256)) > 0.5)
    several /= several.sum(axis=-1, keepdims=True)
    edges = np.broadcast_to(EDGES, (2, 3, 257))
    np.testing.assert_array_equal(transport.shift_quantiles(several, edges, np.zeros(256)), several)
    wild = 10 * rng.standard_normal((2, 3, 256))
    found = transport.shift_quantiles(several, edges, wild)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=-1), 1.0, rtol=1e-12)


def test_a_single_value_moves_as_a_whole():
    spike = np.zeros(256)
    spike[100] = 1.0
    found = transport.shift_quantiles(spike, EDGES, np.full(256, 3 * (EDGES[1] - EDGES[0])))
    assert found[103] == pytest.approx(1.0, abs=1e-6)


def test_wider_edges_contain_values_leaving_old_edges():
    source, change = bell(2.0, 0.3), np.full(256, 3.0)
    wide = transport.widen_edges(source, EDGES, change)
    assert wide[-1] > 5.0
    assert np.all(np.diff(wide) > 0)
    found = transport.shift_quantiles(source, EDGES, change, target_edges=wide)
    middle = 0.5 * (wide[1:] + wide[:-1])
    assert found @ middle == pytest.approx(5.0, abs=0.03)
    np.testing.assert_array_equal(transport.widen_edges(source, EDGES, np.zeros(256)), EDGES)


def test_invalid_histogram_is_refused():
    with pytest.raises(transport.HistogramTransportError, match="edges: got"):
        transport.quantiles(np.ones(4) / 4, np.arange(4.0))
    with pytest.raises(transport.HistogramTransportError, match="sum"):
        transport.quantiles(np.ones(4), np.arange(5.0))
    with pytest.raises(transport.HistogramTransportError, match="finite"):
        transport.shift_quantiles(np.ones(4) / 4, np.arange(5.0), np.full(256, np.nan))
