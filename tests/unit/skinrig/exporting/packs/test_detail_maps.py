"""Cavity, scatter and micro normal maps: closed forms, seams, scales, and what is not made up."""

import dataclasses
import json

import cv2
import numpy as np
import OpenEXR
import pytest

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.exporting.images import ImageFolder
from skinrig.exporting.options import ExportSettings
from skinrig.exporting.packs import color_deltas, delta_maps, detail_maps
from skinrig.exporting.packs.detail_maps import (
    ambient_visibility,
    compute_periodic_normals,
    make_periodic,
)

SIDE = 48
SOURCE = SkinAppearance({}, "simulated")


def read(path):
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        return channels["RGB" if "RGB" in channels else "Y"].pixels.copy()


@pytest.mark.parametrize("slope", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("turned", [False, True])
def test_groove_occlusion_matches_closed_form_of_walls(slope, turned):
    """An infinite groove leaves 1 / sqrt(1 + s^2): the mean of 1 - sin^2 of its horizons.

    16 directions integrate it within 0.2 %; the reach does not matter while walls go on.
    """
    walls = slope * np.abs(np.arange(65) - 32.0)
    height = np.broadcast_to(walls, (65, 65))
    height = height.T if turned else height
    seen = ambient_visibility(height, np.zeros((65, 65), int))
    assert seen[32, 32] == pytest.approx(1.0 / np.sqrt(1.0 + slope**2), rel=2e-3)


def test_ridges_and_flat_skin_keep_all_light():
    ridge = -np.abs(np.arange(33) - 16.0) * np.ones((33, 1))
    part = np.zeros((33, 33), int)
    assert ambient_visibility(ridge, part)[16, 16] == 1.0
    assert np.array_equal(ambient_visibility(np.full((9, 9), 3.0), part[:9, :9]), np.ones((9, 9)))


def test_heights_of_other_texture_parts_shade_nothing():
    """Parts are integrated for themselves: their heights have no common zero."""
    height, part = np.zeros((16, 16)), np.zeros((16, 16), int)
    height[:, 8:], part[:, 8:] = 50.0, 1
    assert np.array_equal(ambient_visibility(height, part), np.ones((16, 16)))
    assert ambient_visibility(height, np.zeros_like(part))[8, 7] < 0.6


def test_cavity_map_is_dark_only_in_wrinkle_creases(tmp_path):
    x = np.arange(SIDE) - SIDE / 2
    depth = -4.0 * np.exp(-((x / 3.0) ** 2))  # of a crease along y
    slopes = np.zeros((SIDE, SIDE, 2))
    slopes[..., 0] = -np.gradient(depth)
    valid = np.ones((SIDE, SIDE), bool)
    valid[:4] = False
    out = ImageFolder(tmp_path, ExportSettings(), SOURCE)
    told = detail_maps.write_cavity(slopes, valid, 2 * SIDE, out)
    seen = read(tmp_path / "exr/cavity.exr")
    assert seen.shape == (2 * SIDE, 2 * SIDE)
    # its steepest way out rises by 0.85 at 3.4 texels, all along: 0.76 in closed form, and the
    # differences of the slopes and the larger map smooth it
    assert 0.74 < seen[60, SIDE] < 0.84
    assert seen[60, [4, -5]].min() > 0.95
    assert np.array_equal(seen[:4], np.ones((4, 2 * SIDE)))  # nothing is known there
    assert told["cavity"]["least"] == pytest.approx(seen[12:].min(), abs=1e-6)
    assert out.left_out == []
    codes = cv2.imread(str(tmp_path / "png/cavity.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(codes / 65535.0, seen, atol=0.51 / 65535)


def test_cavity_without_valid_normals_is_not_made(tmp_path):
    out = ImageFolder(tmp_path, ExportSettings(), SOURCE)
    told = detail_maps.write_cavity(np.zeros((8, 8, 2)), np.zeros((8, 8), bool), 8, out)
    assert (told, out.left_out) == ({}, [("cavity", "wrinkle normals have no valid texel")])
    assert list(tmp_path.iterdir()) == []


def test_tiled_relief_has_no_seam_and_keeps_variance(rng):
    """Smooth noise: across the tile's border it differs as it does elsewhere, in value and slope.

    Over 24 reliefs the RMS of differences across borders is that inside within 15 %, 5 standard
    errors of some 24 x 2 x 20 independent places; the border of what was measured is far off.
    """
    from scipy.ndimage import gaussian_filter

    across, inside, raw, variance = [], [], [], []
    for _ in range(24):
        # of a larger field: its own border would be rougher
        relief = gaussian_filter(rng.standard_normal((136, 168)), 2.5)[20:-20, 20:-20]
        relief -= relief.mean()
        tile = make_periodic(relief)
        jump = np.diff(np.concatenate([tile[-2:], tile[:2]]), axis=0)
        across += [jump[1], np.diff(jump, axis=0)[0], np.diff(jump, axis=0)[1]]
        steps = np.diff(tile[20:60], axis=0)
        inside += [steps, np.diff(steps, axis=0)]
        raw.append(relief[0] - relief[-1])
        variance.append(tile.var() / relief.var())

    def rms(values):
        return np.sqrt(np.mean(np.concatenate([v.ravel() for v in values]) ** 2))

    assert rms(across[0::3]) == pytest.approx(rms(inside[0::2]), rel=0.15)
    curved = rms(across[1::3] + across[2::3])
    assert curved == pytest.approx(rms(inside[1::2]), rel=0.15)
    assert rms(raw) > 3.0 * rms(inside[0::2])
    assert np.mean(variance) == pytest.approx(1.0, abs=0.05)


def test_micro_normals_match_relief_slopes_in_own_unit():
    x = np.arange(128)
    relief = 5.0 * np.sin(2 * np.pi * 3 * x / 128)[:, None] * np.ones((1, 128))  # um, rows
    normals = compute_periodic_normals(relief, 6.0)
    slope = 5.0 * 2 * np.pi * 3 / (128 * 6.0)
    found = normals[..., 1] / normals[..., 2]
    assert found.max() == pytest.approx(slope, rel=5e-3)
    # it rises downwards in row 0, to the bottom: its normal leans to the top, +Y
    assert found[0, 0] > 0.9 * slope
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-12)


@pytest.fixture
def relief(rng):
    from scipy.ndimage import gaussian_filter

    height = gaussian_filter(rng.standard_normal((SIDE, 2 * SIDE)), 2.0, mode="wrap")
    valid = np.ones(height.shape, bool)
    valid[:3, :3] = False
    entry = {"map": "microrelief_cheek", "table": "kernel_table_cheek.json", "pixel_um": 6.0}
    parts = {
        "microstructure": {
            "maps": ["microrelief_cheek"],
            "files": [],
            "source": "simulated",
            "sites": {"cheek": entry},
        }
    }
    return SkinAppearance(
        {"microrelief_cheek": SkinMap(40.0 * height, "um", valid=valid)},
        "simulated",
        {"kind": "dynamic", "parts": parts},
    )


def test_relief_only_pack_has_micro_normals_with_size(relief, tmp_path):
    left_out = dict(delta_maps.write(relief, tmp_path, ExportSettings(normal_y="dx")))
    told = json.loads((tmp_path / "delta_maps.json").read_text())
    (entry,) = told["micro"].values()
    assert entry["tile_mm"] == pytest.approx([84 * 0.006, 42 * 0.006])  # an eighth is faded
    normals = read(tmp_path / "exr/micro_normal_cheek.exr")
    assert normals.shape == (42, 84, 3)
    assert "-Y (DirectX)" in told["files"]["exr/micro_normal_cheek.exr"]["what"]
    assert set(left_out) >= {
        "base color, cm1 to cm3",
        "normal, wm1 to wm3, masks, cavity",
        "scatter",
    }


def test_the_green_of_micro_normals_follows_the_order(relief, tmp_path):
    for name in ("gl", "dx"):
        (tmp_path / name).mkdir()
        delta_maps.write(relief, tmp_path / name, ExportSettings(normal_y=name))
    up, down = (read(tmp_path / n / "exr/micro_normal_cheek.exr") for n in ("gl", "dx"))
    np.testing.assert_array_equal(up * [1.0, -1.0, 1.0], down)


def test_scatter_is_model_translucency_at_pack_size(patch, tmp_path, monkeypatch):
    monkeypatch.setattr(detail_maps, "SCATTER_SIZE", patch.side)
    face = patch.face(parameters={"assumed": ["translucency is the population's", "other"]})
    onto = store.write(tmp_path / "model", face)
    out = ImageFolder(tmp_path, ExportSettings(target_face=onto), SOURCE)
    told = detail_maps.write_scatter(out)
    shown, depth = read(tmp_path / "exr/scatter.exr"), face.maps["translucency"]
    np.testing.assert_allclose(shown[depth.valid], depth.values[depth.valid], rtol=1e-6)
    assert told["scatter"]["assumed"] == ["translucency is the population's"]
    assert out.left_out == []
    without = {n: m for n, m in face.maps.items() if n != "translucency"}
    bare = store.write(tmp_path / "bare", dataclasses.replace(face, maps=without))
    out = ImageFolder(tmp_path, ExportSettings(target_face=bare), SOURCE)
    assert detail_maps.write_scatter(out) == {}
    assert "skinrig fit reflectance" in out.left_out[0][1]


def test_sizes_of_packs():
    assert (detail_maps.SCATTER_SIZE, delta_maps.NORMAL_SIZE, color_deltas.COLOR_SIZE) == (
        512,
        1024,
        512,
    )
