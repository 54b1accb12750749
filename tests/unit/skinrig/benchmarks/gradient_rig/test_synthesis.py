"""Peer and measures of the benchmark of grown maps: blended tiles, statistics of structure."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from skinrig.benchmarks.gradient_rig import synthesis


@pytest.fixture
def patches(rng):
    return [
        np.exp(gaussian_filter(rng.standard_normal((160, 160)), 2.0) * 8).astype(np.float32)
        for _ in range(2)
    ]


def test_blended_tiles_keep_the_histogram_of_heights(patches, rng):
    """Tolerance of the peer's quantiles: a twentieth of the range."""
    found = synthesis.blend_hexagonal_tiles(patches, 400, edge_px=40, rng=rng)
    shares = np.linspace(0.05, 0.95, 19)
    ought = np.quantile(patches, shares)
    assert np.abs(np.quantile(found, shares) - ought).max() < 0.05 * np.ptp(ought)


def test_blended_tiles_have_no_edges(patches, rng):
    found = synthesis.blend_hexagonal_tiles(patches, 400, edge_px=40, rng=rng)
    for axis in (0, 1):
        steps = np.abs(np.diff(found, axis=axis)).max()
        assert steps < 1.5 * max(np.abs(np.diff(p, axis=axis)).max() for p in patches)


def test_autocorrelation_of_a_wave_is_a_wave():
    y = np.arange(400.0)
    found = synthesis.autocorrelation(np.tile(np.sin(y / 5.0)[:, None], (1, 400)))
    np.testing.assert_allclose(found[:, 64], np.cos(np.arange(-64, 65) / 5.0), atol=0.03)


def test_grooves_are_skewed_unlike_their_normal_twin(rng):
    furrows = -np.exp(-((gaussian_filter(rng.standard_normal((300, 300)), 4.0) / 0.02) ** 2))
    smooth = gaussian_filter(rng.standard_normal((300, 300)), 4.0)
    found = [
        synthesis.skewness_of_curvature(gaussian_filter(h, 1.0).astype(np.float32))
        for h in (furrows, smooth)
    ]
    assert abs(found[0]) > 5 * abs(found[1])
    assert found[0] < 0
