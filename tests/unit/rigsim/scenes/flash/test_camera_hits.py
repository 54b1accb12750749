"""Hits of the flash camera, averaged over pixels."""

from itertools import pairwise

import numpy as np
import pytest

from rigsim.scenes.flash.surfaces import CameraHits


def make_hits(counts, subpixels):
    """Return hits of a row of pixels, of which every other one has none."""
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    pixel = 2 * np.arange(len(counts), dtype=np.int32)
    slot = np.concatenate([np.arange(n) for n in counts]).astype(np.uint8)
    nothing = np.zeros((int(first[-1]), 3), np.float32)
    shape = (1, 2 * len(counts))
    return CameraHits(shape, subpixels, pixel, first, slot, nothing, nothing[:, :2], None)


@pytest.mark.parametrize("side", [1, 2, 3, 4])
@pytest.mark.parametrize("inner", [(), (3,), (2, 3)])
def test_mean_of_hits_is_that_of_numpy(rng, side, inner):
    """Up to 8 hits the digits are equal; above, both sums are a rounding from the exact mean."""
    counts = [side**2, 1, max(1, side**2 - 1), side**2]
    hits = make_hits(counts, side)
    rows = rng.standard_normal((hits.count, *inner)).astype(np.float32) + np.float32(3.0)
    found = hits.average(rows)
    assert found.shape == (*hits.shape, *inner)
    assert not found[0, 1::2].any()
    sums = np.add.reduceat(rows, hits.first[:-1], axis=0)
    expected = sums / np.float32(counts).reshape(-1, *[1] * len(inner))
    exact = [rows[a:b].mean(axis=0, dtype=np.float64) for a, b in pairwise(hits.first)]
    few = np.array(counts) <= 8
    np.testing.assert_array_equal(found[0, ::2][few], expected[few])
    np.testing.assert_allclose(found[0, ::2], exact, rtol=1e-6)
