"""Sphere and pushed patch: maps follow the strain, subsurface scattering blurs light."""

import json

import numpy as np
import pytest

from model import store
from model.microstructure import FOREHEAD
from skinrig.applying import microstructure_samples as samples
from skinrig.applying.microstructure import strain_image
from skinrig.applying.pushed_patch import Push, SkinBlock, push_block
from skinrig.applying.subsurface_grid import SKIN_COLOR, gather_subsurface
from skinrig.cli import main


@pytest.fixture(scope="module")
def relief():
    return samples.SampleRelief.simulated(0, size_mm=1.6)


@pytest.mark.long
def test_sphere_sample_orders_roughness_by_shape(relief, tmp_path):
    found = samples.draw_sample("sphere", tmp_path, relief, size_px=512)
    variance = {(one["relief"], one["shape"]): one["slope_variances"] for one in found["of"]}
    assert variance["noise", "shrunk"][0] > variance["noise", "neutral"][0]
    assert variance["noise", "neutral"][0] > variance["noise", "grown"][0]
    # sharpening along t needs pixels below its sigma, 10 um, which this small map lacks
    assert variance["patch", "squashed"][0] < 0.95 * variance["patch", "squashed, static"][0]
    strain = store.read_exr(tmp_path / "strain.exr")
    middle = strain[256, 256]
    assert middle == pytest.approx([1.25, 0.8, 0.0], abs=0.02)
    assert json.loads((tmp_path / "sample.json").read_text())["files"] == found["files"]


def test_paper_block_has_25392_tetrahedra():
    assert 6 * int(np.prod(samples.BLOCK_DIVISIONS)) == 25_392


@pytest.mark.long
def test_patch_sample_writes_pushed_maps(relief, tmp_path):
    pytest.importorskip("skfem")
    found = samples.draw_sample("patch", tmp_path, relief, size_px=512, divisions=(7, 7, 2))
    assert found["tetrahedra"] == 6 * 98
    assert found["stretch"][0] < 0.95 < 1.05 < found["stretch"][1]
    assert (tmp_path / "figure-14.png").stat().st_size > 10_000
    neutral, moved = (
        store.read_exr(tmp_path / f"displacement{end}.exr") for end in ("_neutral", "")
    )
    assert np.abs(moved - neutral).max() > 1.0


def test_flat_patch_radiance_is_uniform_skin_color():
    pytest.importorskip("skfem")
    block = SkinBlock(divisions=(5, 5, 2))
    still = push_block(block, Push(contact_mm=1.5, depth_mm=0.0, shift_mm=(0.0, 0.0), tip_mm=1e5))
    image = samples.shade_patch(still, np.zeros((64, 64), np.float32))
    inside = image[24:40, 24:40]
    assert np.ptp(inside[..., 0]) < 0.02 * inside[..., 0].mean()
    red, green, blue = inside.mean(axis=(0, 1))
    assert red > green > blue
    # light that enters: cos 44 degrees, R_d, both transmittances; specular reflection is added
    assert 0.5 * 0.71 * 0.46 < red < 1.2 * 0.71 * 0.46 + 0.1


def test_scattered_light_reaches_shadow_of_step():
    side = 64
    points = np.stack(np.meshgrid(np.linspace(0, 10, side), np.linspace(10, 0, side)), axis=-1)
    points = np.concatenate([points, np.zeros((side, side, 1))], axis=-1)
    lit = np.where(points[..., 0] < 5.0, 1.0, 0.0)
    found = gather_subsurface(points, np.full((side, side), (10 / 63) ** 2), lit)
    row = found[side // 2]
    assert (row[5] > 0.9 * np.array(SKIN_COLOR)).all()
    red, _, blue = row[side // 2 + 6]  # 1 mm into the dark: red light reaches further
    assert red / SKIN_COLOR[0] > 2.0 * blue / SKIN_COLOR[2] > 0.0


def test_strain_image_angle_is_axis_of_s(relief):
    sphere = samples.spheres.Sphere(texels=64)
    made = samples.spheres.deform(sphere, np.zeros((64, 64)), (0.8, 1.25, 1.0), table=FOREHEAD)
    middle = strain_image(made.strain)[32, 32]
    assert abs(middle[2]) == pytest.approx(np.pi / 2, abs=0.05)


@pytest.mark.long
def test_face_sample_writes_three_figures(relief, tmp_path):
    found = samples.draw_sample("face", tmp_path, relief, size_px=200)
    assert [one["figure"] for one in found["of"]] == ["figure-1", "figure-15", "figure-16"]
    for one in found["of"]:
        assert (tmp_path / f"{one['figure']}.png").stat().st_size > 10_000
        strain = store.read_exr(tmp_path / f"{one['figure']}-strain.exr")
        assert strain[..., 0].max() == pytest.approx(one["stretch_s"][1])
        variances = one["slope_variances"]
        stretched = one["stretch_s"][0] > 1.03
        assert not stretched or variances["dynamic"][0] < variances["static"][0]
        compressed = one["stretch_t"][1] < 0.97
        assert not compressed or variances["dynamic"][1] > variances["static"][1]


@pytest.mark.long
def test_apply_sample_by_command_prints_one_document(tmp_path, capsys):
    argv = ["apply", "microstructure", "--on", "sphere", "--size-px", "128"]
    assert main([*argv, "--out", str(tmp_path / "s"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sample"] == "sphere"
