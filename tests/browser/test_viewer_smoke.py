"""The page opens, draws a face, asks nobody for anything."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.long
def test_page_draws_face_without_errors_or_requests(viewer):
    picture = viewer.read("display")
    assert picture.shape == (256, 256, 4)
    assert viewer.read("albedo")[..., 3].mean() > 0.2
    assert picture[..., :3].std() > 0.05
    assert np.isfinite(viewer.read("radiance")).all()
    assert viewer.problems == []


@pytest.mark.long
def test_first_image_equals_redrawn_image(open_page, procedural_html):
    """Textures reach the device while the first frame is drawn, and keep their own places.

    Others have drawn on the page that all share.
    """
    viewer = open_page(procedural_html)
    first = viewer.read("albedo")
    assert first[first[..., 3] > 0, 0].std() > 0.005
    viewer.bench(1)
    np.testing.assert_array_equal(viewer.read("albedo"), first)
