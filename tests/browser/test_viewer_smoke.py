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


@pytest.mark.long
def test_changed_page_equals_page_opened_so(open_page, procedural_html, viewer):
    """Bit for bit, whatever was drawn before: light, camera, expression, parts, and back.

    The other page has the same states in the opposite order.
    """
    expression = {"weights": {"anger": 0.8, "surprise": 0.3}}
    steps = [
        {"light_azimuth_deg": -50, "light_elevation_deg": 10, "eyes_open": 1, "brows": 1},
        {"hair": 1, "camera_yaw_deg": 55, "camera_pitch_deg": 12},
        {"fill": 0.3, "rim": 0.4, "environment": "window", **expression},
        {"camera_distance_mm": 240, "camera_yaw_deg": -20},
        {"camera_distance_mm": 700, "weights": {"anger": 0.0}, "environment": "none", "fill": 0},
    ]
    states = [dict(viewer.set(**step)) for step in steps]
    fresh = open_page(procedural_html)
    names = ("irradiance", "specular", "albedo", "radiance", "hair", "display", "strain", "lit")
    expected = []
    for state in reversed(states):
        fresh.set(**state)
        expected.append({name: fresh.read(name) for name in names})
    for state, buffers in zip(states, reversed(expected), strict=True):
        viewer.set(**state)
        for name, values in buffers.items():
            np.testing.assert_array_equal(viewer.read(name), values)
    for i, one in enumerate(expected[1:]):
        assert np.abs(one["display"] - expected[i]["display"]).max() > 0.1
