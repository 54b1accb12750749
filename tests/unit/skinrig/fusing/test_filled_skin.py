"""Gaps of fused colors are filled from their neighborhood, with errors that contain it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model.skin import MAP_UNITS, SkinMap
from skinrig.fusing.filled_normals import MAX_GAP_DISTANCE_MM
from skinrig.fusing.filled_skin import fill_skin

SIDE = 80
"""Texels of 1 mm along a side."""
STATED = 0.02
"""Relative standard error of a measured texel."""


def points():
    at = np.arange(SIDE) - SIDE / 2
    x, y = np.meshgrid(at, at)
    return SkinMap(np.stack([x, y, 0.01 * x * y], axis=-1), "mm")


def disc(radius_mm, center=(0.0, 0.0)):
    at = points().values
    return np.hypot(at[..., 0] - center[0], at[..., 1] - center[1]) <= radius_mm


def skin(gap):
    """Return maps of R_d with a gap, and the true R_d: variation over some 2 mm."""
    rng = np.random.default_rng(4)
    pattern = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 1.5)
    true = 0.3 * np.exp(0.08 * pattern / pattern.std())
    true = true[..., None] * np.array([1.0, 0.8, 0.6])
    values = np.where(gap[..., None], 0.0, true)
    stderr = STATED * values
    maps = {
        "r_d": SkinMap(values, "1", stderr, ~gap, "drawn"),
        "r_d_texel_stderr": SkinMap(0.5 * stderr, "1", None, ~gap),
    }
    return maps, true


def test_fill_skin_of_gaps_states_its_error():
    gap = np.zeros((SIDE, SIDE), bool)
    for x in range(-30, 31, 15):
        for y in range(-30, 31, 15):
            gap |= disc(3.0, (x, y))
    maps, true = skin(gap)
    found = fill_skin(maps, points())
    r_d = found["r_d"]
    assert r_d.mask.all()
    np.testing.assert_array_equal(found["r_d_measured"].values, ~gap)
    np.testing.assert_array_equal(r_d.values[~gap], maps["r_d"].values[~gap])
    off = np.abs(r_d.values - true)[gap]
    held = np.mean(off < r_d.stderr[gap])
    assert 0.95 > held > 0.6 > np.mean(off < STATED * r_d.values[gap])
    assert (found["r_d_texel_stderr"].values[gap] < r_d.stderr[gap]).all()


def test_fill_skin_far_from_measured_stays_masked():
    maps, _ = skin(disc(20.0))
    found = fill_skin(maps, points())["r_d"]
    assert not found.mask[disc(19.0 - MAX_GAP_DISTANCE_MM)].any()
    assert found.mask[~disc(10.0)].all()


def test_translucency_is_filled_within_four_millimeters():
    maps, _ = skin(disc(20.0))
    found = fill_skin({"translucency": maps["r_d"]}, points())["translucency"]
    assert not found.mask[disc(15.0)].any()
    assert found.mask[~disc(17.0)].all()


def test_fill_skin_ignores_texels_facing_away():
    """Two lips 1 mm apart: a gap of the lower one is filled from the lower one alone."""
    at = np.arange(SIDE) - SIDE / 2
    x, y = np.meshgrid(at, at)
    upper = y >= 0.0
    folded = SkinMap(np.stack([x, np.abs(y), upper * 1.0], axis=-1), "mm")
    up = np.where(upper, -1.0, 1.0)
    normals = SkinMap(np.stack([0.0 * x, 0.0 * x, up], axis=-1), "1")
    gap = disc(3.0, (0.0, -20.0))
    values = np.where(gap, 0.0, np.where(upper, 0.8, 0.2))
    maps = {"melanin": SkinMap(values, MAP_UNITS["melanin"], STATED * values, ~gap)}
    found = fill_skin(maps, folded, normals)["melanin"]
    np.testing.assert_allclose(found.values[gap], 0.2)
    mixed = fill_skin(maps, folded)["melanin"]
    assert mixed.values[gap].max() > 0.4
    turned = SkinMap(np.where(gap[..., None], -normals.values, normals.values), "1")
    alone = SkinMap(values, MAP_UNITS["melanin"], STATED * values, ~gap & ~upper)
    assert not fill_skin({"melanin": alone}, folded, turned)["melanin"].mask[gap].any()


@pytest.mark.parametrize("radius_mm", [-1.0, 200.0])
def test_fill_skin_without_gap_or_neighbors_changes_nothing(radius_mm):
    maps, _ = skin(disc(radius_mm))
    assert fill_skin(maps, points()) == maps


def test_fill_skin_keeps_shape_of_one_channel():
    gap = disc(3.0)
    maps, true = skin(gap)
    red, stderr = maps["r_d"].values[..., 0], maps["r_d"].stderr[..., 0]
    found = fill_skin({"melanin": SkinMap(red, MAP_UNITS["melanin"], stderr, ~gap)}, points())
    one = found["melanin"]
    assert one.values.shape == one.stderr.shape == gap.shape
    assert 0.0 < np.abs(np.log(one.values / true[..., 0]))[gap].max() < 0.5
