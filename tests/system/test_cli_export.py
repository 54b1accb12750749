"""`skinrig export` of maps and materials as a user calls it."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from model import store
from model.brdf import recipe as brdf_recipe
from model.brdf import tables as brdf_tables
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.skin_reflectance import BASIS_FILE
from reconstruction.pipeline.dome.lobes import _basis_bytes
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from skinrig.cli import app, main
from skinrig.exporting.materials.tangents import FramedMesh

SIDE = 32


@pytest.fixture
def dome(tmp_path):
    """A bent square of skin that was measured."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5)))
    points = np.stack([90 * u - 45, 90 * v - 45, 20 * np.sin(np.pi * u)], -1)
    corner = np.arange(25).reshape(5, 5)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    mesh = build_mesh(points, faces, np.stack([u, v], -1))
    atlas = unwrap(mesh, SIDE)
    every = dict(brdf_recipe.materials())
    lobes = brdf_tables.tabulate({"ggx": every["ggx 0.33 eta 1.4"]})
    maps = {
        "position": SkinMap(atlas.position_mm, "mm", valid=atlas.covered),
        "normals": SkinMap(atlas.normal, "1", valid=atlas.covered),
        "r_d": SkinMap(np.full((SIDE, SIDE, 3), 0.4), "1"),
        "basis_weight_0": SkinMap(np.full((SIDE, SIDE), 0.9), "1"),
    }
    agreed = {"pseudonym": "P042", "consent_scope": ["research"], "consent_expires": None}
    return store.write(
        tmp_path / "dome",
        SkinAppearance(
            maps,
            "measured",
            {"consent": [agreed]},
            files={
                BASIS_FILE: _basis_bytes(lobes, 1, {1: (np.eye(1), 0.0)}),
                "mesh.obj": FramedMesh.of(mesh).to_obj(1.0, "mm").encode(),
            },
        ),
    )


def run(capsys, *argv):
    code = main([str(one) for one in argv])
    return code, capsys.readouterr()


@pytest.mark.parametrize("to", ["maps", "mtlx", "gltf", "usd"])
def test_export_format_ends_with_next_step_sealed_folder(dome, tmp_path, capsys, to):
    if to == "usd":
        pytest.importorskip("pxr")
    out = tmp_path / "out"
    code, said = run(capsys, "export", dome, "--to", to, "--use", "research", "--out", out)
    assert code == 0, said.err
    assert "next: " in said.out
    assert list(out.glob("ascmhl/*.mhl"))


def test_export_json_lists_written_and_omitted_items(dome, tmp_path, capsys):
    out = tmp_path / "out"
    argv = ["export", dome, "--to", "gltf", "--use", "research", "--out", out, "--json"]
    code, said = run(capsys, *argv)
    assert code == 0
    told = json.loads(said.out)
    assert (told["schema"], told["to"], told["files"]) == ("skinrig.export/1", "gltf", 3)
    assert [what for what, _ in told["left_out"]] == ["subsurface light", "morph targets"]


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--to", "maps"], 2, "--use: got none"),
        (["--to", "maps", "--use", "film"], 3, "P042 has not agreed"),
        (["--to", "fbx", "--use", "research"], 3, "expected one of maps, ome-zarr, mtlx"),
        (["--to", "mtlx", "--use", "research", "--unit", "inch"], 3, "--unit: got 'inch'"),
        (["--to", "gltf", "--use", "research", "--normal-y", "dx"], 2, "the only one of glTF"),
        (["--to", "maps", "--use", "research", "--only", "melanin"], 3, "got melanin"),
        (["--to", "spectral", "--use", "research"], 3, "as of the flash rig"),
        (["--to", "metahuman", "--use", "research"], 3, "skinrig fit wrinkles"),
        (["--to", "lp"], 3, "dome holds maps; expected one of maps, ome-zarr, mtlx"),
    ],
)
def test_impossible_export_gives_reason_and_writes_nothing(
    dome, tmp_path, capsys, arguments, code, says
):
    out = tmp_path / "out"
    found, said = run(capsys, "export", dome, *arguments, "--out", out)
    assert found == code
    assert says in said.err
    assert "Traceback" not in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dome"]


def test_maps_are_not_asked_of_a_session(tmp_path, capsys):
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "session.json").write_text("{}", encoding="utf-8")
    argv = ["export", tmp_path / "session", "--to", "gltf", "--out", tmp_path / "out"]
    code, said = run(capsys, *argv)
    assert code == 3
    assert (
        "session holds a session; expected one of mhl, frames, event-model, lp, stokes" in said.err
    )


def test_a_folder_that_is_not_there_is_named(tmp_path, capsys):
    code, said = run(capsys, "export", tmp_path / "no", "--to", "maps", "--out", tmp_path / "out")
    assert code == 3
    assert "is not an APPEARANCE/ folder" in said.err


def test_simulated_maps_need_no_use(tmp_path, capsys):
    melanin = SkinMap(np.full((4, 6), 0.05), MAP_UNITS["melanin"])
    blood = SkinMap(np.full((4, 6), 0.03), MAP_UNITS["hemoglobin"])
    folder = store.write(
        tmp_path / "flash", SkinAppearance({"melanin": melanin, "hemoglobin": blood}, "simulated")
    )
    code, said = run(capsys, "export", folder, "--to", "spectral", "--out", tmp_path / "out")
    assert code == 0, said.err
    assert "omitted: stokes.exr" in said.out


def test_the_help_names_every_format():
    from skinrig.exporting.export import APPEARANCE_FORMATS, SESSION_FORMATS

    text = CliRunner().invoke(app, ["export", "--help"], env={"COLUMNS": "200"}).output
    text = re.sub(r"-\s+", "-", text)  # lines end at hyphens, too
    for name in (*APPEARANCE_FORMATS, *SESSION_FORMATS):
        assert name in text
