"""Calibration targets: their spectra, their layout, what the cameras will see of them."""

import numpy as np
import pytest

from rigsim.targets.flat import TARGET_NAMES, TargetError, make_target, patch_centers_mm

CAMERA, LIGHT = "Nikon 5100 (NPL)", "D55"


def test_white_reference_reflects_99_percent_in_every_channel():
    np.testing.assert_allclose(make_target("white").rgb(CAMERA, LIGHT), 0.99, atol=1e-6)


def test_chart_has_patch_colors_at_their_positions():
    chart = make_target("chart")
    rgb = chart.rgb(CAMERA, LIGHT)
    size = len(rgb)
    half_mm = chart.mesh.vertices_mm[:, 0].max()
    x, y = patch_centers_mm().T
    column = ((x / half_mm + 1.0) / 2.0 * size).astype(int)
    row = ((1.0 - y / half_mm) / 2.0 * size).astype(int)
    patch = rgb[row, column].reshape(4, 6, 3)
    # The last row is a gray scale, white on the left.
    gray = patch[3]
    assert (np.diff(gray.mean(axis=-1)) < 0.0).all()
    assert gray[0].min() > 0.8
    assert gray[5].max() < 0.05
    assert np.ptp(gray, axis=-1).max() < 0.05
    # Row three starts blue, green, red.
    assert [int(np.argmax(color)) for color in patch[2, :3]] == [2, 1, 0]


def test_patches_are_evenly_spaced_from_the_top_left():
    centers = patch_centers_mm().reshape(4, 6, 2)
    assert centers[0, 0, 0] < 0.0 < centers[0, 0, 1]
    np.testing.assert_allclose(np.diff(centers[..., 0], axis=1), 27.0)
    np.testing.assert_allclose(np.diff(centers[..., 1], axis=0), -27.0)
    np.testing.assert_allclose(centers.mean(axis=(0, 1)), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", TARGET_NAMES)
def test_every_target_faces_camera_and_conserves_energy(name):
    target = make_target(name)
    np.testing.assert_allclose(target.mesh.normals, [[0.0, 0.0, 1.0]] * 4)
    assert target.palette.min() >= 0.0
    assert target.palette.max() <= 1.0


def test_an_unknown_target_is_named():
    with pytest.raises(TargetError, match="target: got 'mirror', expected one of white, chart"):
        make_target("mirror")
