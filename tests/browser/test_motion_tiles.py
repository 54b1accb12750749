"""A large displacement is fetched as tiles, those in view alone, from this machine alone."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy import ndimage

from skinrig.viewer import page, server
from skinrig.viewer.microstructure import assets as microstructure_assets
from skinrig.viewer.microstructure import tiles

SIZE, WINDOW = 2048, 256


@pytest.fixture(scope="module")
def displacement():
    noise = np.random.default_rng(8).standard_normal((SIZE, SIZE)).astype(np.float32)
    smooth = ndimage.gaussian_filter(noise, 1.5, mode="wrap")
    return (12.0 * smooth / smooth.std()).astype(np.float32)


@pytest.mark.long
def test_window_shows_displacement_and_fetches_only_own_tiles(
    open_page, procedural_scene, displacement, tmp_path
):
    pyramid = tiles.build(displacement, tmp_path / "levels")
    scene = microstructure_assets.add_displacement_tiles(procedural_scene, pyramid)
    assert scene.facts["microstructure"]["virtual_px"] == SIZE
    html = page.build(scene, connect=True).encode("utf-8")
    with server.serve(html, pyramid=pyramid) as served:
        viewer = open_page.address(served.url, 720, 560, canvas=256)
        settings = {"microstructure_window_px": WINDOW, "microstructure": 2}
        for at, level in (([0.5, 0.7], 0), ([0.3, 0.4], 1)):
            asked = len(served.requests)
            place = viewer.set(microstructure_at=[*at, level], **settings)["microstructure_place"]
            whole = SIZE >> level
            left, top = int(place[0]), whole - int(place[1]) - WINDOW
            expected = pyramid.levels[level][top : top + WINDOW, left : left + WINDOW]
            until = time.monotonic() + 20.0
            error = np.inf
            while time.monotonic() < until and error > pyramid.step_um:
                viewer.page.wait_for_timeout(100)
                error = np.abs(viewer.read("relief")[..., 0] - expected).max()
            assert error <= pyramid.step_um
            wanted = {
                f"/tiles/{level}/{row}/{column}"
                for row in range(top // 256, (top + WINDOW - 1) // 256 + 1)
                for column in range(left // 256, (left + WINDOW - 1) // 256 + 1)
            }
            assert set(served.requests[asked:]) == wanted
            assert len(served.requests[asked:]) == len(wanted)
        # back at the first place nothing is asked for again
        asked = len(served.requests)
        viewer.set(microstructure_at=[0.5, 0.7, 0], **settings)
        viewer.wait_frames()
        assert served.requests[asked:] == []
        other = [p for p in viewer.problems if not p.startswith(f"request: {served.url}tiles/")]
        assert other == []


@pytest.mark.long
def test_a_page_in_a_file_may_not_fetch(procedural_html):
    assert "connect-src 'none'" in procedural_html
