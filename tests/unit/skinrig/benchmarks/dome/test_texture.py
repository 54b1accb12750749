import sys

import numpy as np
import pytest

from model.texture_statistics.steerable_pyramid import analyze
from skinrig.benchmarks.dome import texture
from skinrig.benchmarks.stage import BenchmarkStage


def test_missing_peer_is_reported_without_claimed_limit(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrtools", None)
    monkeypatch.setitem(sys.modules, "pyrtools.pyramids", None)
    stage = BenchmarkStage("texture-matching")
    texture.compare_with_peer(stage)
    assert stage.limits == {}
    assert "10 x pyrtools" in stage.omitted[0][0]
    assert "skinrig[peers]" in stage.omitted[0][1]


def test_responses_match_peer(rng):
    """Tolerance: the peer interpolates its filters in a table."""
    pytest.importorskip("pyrtools")
    image = rng.standard_normal((512, 512))
    for ours, theirs in zip(analyze(image), texture.filter_with_peer(image), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)


@pytest.mark.long
def test_matching_converges_as_close_as_peer():
    pytest.importorskip("pyrtools")
    stage = BenchmarkStage("texture-matching")
    texture.compare_with_peer(stage, 512)
    assert stage.omitted == []
    assert [limit.passed for limit in stage.to_benchmark().limits[2:]] == [True, True]


def test_made_texture_is_periodic_with_distinct_spot_color(rng):
    plain = texture.synthesize_skin_texture(128, spots=0.0, rng=np.random.default_rng(1))
    spotted = texture.synthesize_skin_texture(128, spots=10.0, rng=np.random.default_rng(1))
    assert np.abs(plain[0] - plain[-1]).max() < 2.0 * np.abs(np.diff(plain, axis=0)).max()
    darker = np.log(plain / spotted)
    assert darker.min() > -1e-6
    deep = darker[darker[..., 1] > 0.2].mean(axis=0)
    np.testing.assert_allclose(deep / deep[1], [0.2, 1.0, 0.6], atol=1e-3)
