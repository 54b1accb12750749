"""Lobes and places of an appearance as MERL and RGL files, against the model they come from."""

import json

import numpy as np
import pytest

from model import fresnel, merl, store
from model.brdf import rgl
from model.brdf import tables as brdf_tables
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import BASIS_FILE
from reconstruction.pipeline.dome.lobes import _basis_bytes
from skinrig.cli import main
from skinrig.exporting.brdfs import write
from skinrig.exporting.export import export
from skinrig.exporting.options import ExportError, ExportSettings, SkinPosition

UP = np.array([0.0, 0.0, 1.0])
R_D = np.array([0.5, 0.35, 0.25])
SIDE = 8


@pytest.fixture(scope="module")
def lobes():
    materials = brdf_tables.default_basis()
    mix = np.zeros((2, materials.size))
    mix[0, materials.names.index("ggx 0.22 eta 1.4")] = 1.0
    mix[1, materials.names.index("beckmann 0.5")] = 1.0
    return materials, mix, materials.mix_materials(mix)


@pytest.fixture(scope="module")
def appearance(lobes, tmp_path_factory):
    """A face whose left half is oily, the right matt; the upper row is not known."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    oily = (x < SIDE // 2).astype(float)
    normals = np.broadcast_to(UP, (SIDE, SIDE, 3))
    valid = y > 0
    maps = {
        "position": SkinMap(np.stack([x, -y, np.zeros_like(x)], -1), "mm", valid=valid),
        "normals": SkinMap(normals, "1", valid=valid),
        "r_d": SkinMap(np.broadcast_to(R_D, (SIDE, SIDE, 3)), "1", valid=valid),
        "basis_weight_0": SkinMap(0.8 * oily, "1", valid=valid),
        "basis_weight_1": SkinMap(0.5 * np.ones((SIDE, SIDE)), "1", valid=valid),
    }
    materials, mix, _ = lobes
    made = SkinAppearance(
        maps, "simulated", files={BASIS_FILE: _basis_bytes(materials, 2, {2: (mix, 0.0)})}
    )
    return store.write(tmp_path_factory.mktemp("out") / "appearance", made)


def directions(rng, count):
    z = rng.uniform(0.2, 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    s = np.sqrt(1.0 - z**2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)


def looked_up(path, light, view):
    if path.suffix == ".bsdf":
        return rgl.read(path).evaluate(light, view)
    return merl.read(path).lookup(*merl.to_angles(light, view, UP))


@pytest.fixture(scope="module")
def exported(appearance, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exports")
    for to in ("merl", "rgl"):
        export(
            appearance,
            folder / to,
            to=to,
            delivery=ExportSettings(place=SkinPosition(0.2, 0.5, 0.9)),
        )
    return folder


@pytest.mark.long
@pytest.mark.parametrize(("to", "suffix"), [("merl", ".binary"), ("rgl", ".bsdf")])
def test_exported_lobes_are_white_and_match_model(to, suffix, exported, lobes, rng):
    """Tolerance: half a bin of MERL, or interpolation of RGL, moves the edge of a lobe by 5 %."""
    light, view = directions(rng, 2000), directions(rng, 2000)
    true = lobes[2].evaluate(light, view, UP)
    for k in range(2):
        found = looked_up(exported / to / f"lobe_{k}{suffix}", light, view)
        np.testing.assert_allclose(found[:, 1:], found[:, :1].repeat(2, 1), rtol=1e-12)
        error = np.sqrt(np.mean((found[:, 0] - true[:, k]) ** 2) / np.mean(true[:, k] ** 2))
        assert error < 0.06
        other = np.sqrt(np.mean((found[:, 0] - true[:, 1 - k]) ** 2) / np.mean(true[:, 1 - k] ** 2))
        assert other > 0.2  # it can fail


@pytest.mark.long
@pytest.mark.parametrize(("to", "suffix"), [("merl", ".binary"), ("rgl", ".bsdf")])
def test_exported_position_is_mixture_plus_subsurface_light(to, suffix, exported, lobes, rng):
    light, view = directions(rng, 2000), directions(rng, 2000)
    passed = (1 - fresnel.reflectance(light[:, 2], 1.4)) * (
        1 - fresnel.reflectance(view[:, 2], 1.4)
    )
    true = (lobes[2].evaluate(light, view, UP) @ [0.8, 0.5])[:, None] + passed[
        :, None
    ] * R_D / np.pi
    found = looked_up(exported / to / f"place{suffix}", light, view)
    assert np.median(np.abs(found / true - 1.0)) < 0.005
    assert np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)) < 0.06


@pytest.mark.long
def test_document_reports_light_size_and_file_contents(exported, lobes):
    told = json.loads((exported / "merl" / "brdfs.json").read_text())
    assert told["light_radius_rad"] == lobes[2].light_radius_rad
    assert set(told["files"]) == {"lobe_0.binary", "lobe_1.binary", "place.binary"}
    assert told["source"] == "simulated"
    assert told["files"]["place.binary"]["texels"] == 1
    assert told["files"]["place.binary"]["light_from_inside"]
    text = rgl.read(exported / "rgl" / "lobe_0.bsdf").description
    assert f"{lobes[2].light_radius_rad:.6g} rad" in text
    assert (exported / "rgl" / "ascmhl").is_dir()


@pytest.mark.long
def test_below_the_horizon_nothing_was_measured(exported):
    table = merl.read(exported / "merl" / "place.binary")
    light, view = merl.to_directions(*np.meshgrid(*merl.bin_centers(), indexing="ij"))
    above = (light[..., 2] > 0.0) & (view[..., 2] > 0.0)
    np.testing.assert_array_equal(table.measured, above)
    assert np.all(table.stored[:, ~above] == -1.0)


@pytest.mark.long
def test_a_region_is_the_mean_over_its_texels(appearance, tmp_path, lobes, rng):
    place = SkinPosition(0.5, 0.5, radius_mm=100.0, diffuse=False)
    done = export(appearance, tmp_path / "all", to="rgl", delivery=ExportSettings(place=place))
    light, view = directions(rng, 500), directions(rng, 500)
    found = rgl.read(done.path / "place.bsdf").evaluate(light, view)[:, 0]
    true = lobes[2].evaluate(light, view, UP) @ [0.4, 0.5]
    assert np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)) < 0.06


@pytest.mark.long
def test_positions_without_reflectance_are_named(appearance, tmp_path):
    with pytest.raises(ExportError, match="row 0, column 4"):
        write(store.read(appearance), tmp_path, SkinPosition(0.5, 1.0), "rgl")
    with pytest.raises(ExportError, match=r"u 1\.5"):
        SkinPosition(1.5, 0.0)
    with pytest.raises(ExportError, match=r"expected one of .*merl, rgl"):
        export(appearance, tmp_path / "x", to="bsdf")
    read = store.read(appearance)
    dark = read.maps | {"r_d": SkinMap(np.full((SIDE, SIDE, 3), -0.01), "1")}
    store.write(tmp_path / "dark", SkinAppearance(dark, "simulated", files=read.files))
    with pytest.raises(ExportError, match="r_d is"):
        write(store.read(tmp_path / "dark"), tmp_path, SkinPosition(0.5, 0.5), "rgl")


@pytest.mark.long
def test_command_line_exports_and_reports_errors(appearance, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert main(["export", str(appearance), "--to", "rgl", "--at", "0.2,0.4", "--out", out]) == 0
    assert (tmp_path / "out" / "place.bsdf").is_file()
    for arguments, code, message in [
        (["--to", "rgl", "--at", "here"], 2, "--at: got 'here'"),
        (["--to", "mhl"], 3, "--to: got 'mhl', but"),
        (["--to", "rgl"], 3, "exists"),
    ]:
        assert main(["export", str(appearance), *arguments, "--out", out]) == code
        assert message in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.glob(".*"))
