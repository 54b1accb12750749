"""`skinrig render` as a user calls it, on a small fitted face."""

import io
import json

import numpy as np
import pytest

from model import store
from model.brdf import tables as brdf_tables
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.cli import main
from skinrig.rendering import camera as rendering_camera
from skinrig.rendering.lights import Light
from skinrig.rendering.photographs import held_out as photographs
from skinrig.rendering.photographs.errors import Photograph
from skinrig.rendering.photographs.held_out import HeldOutShot

SIZE = 32
STEPS = 24


def mesh_text(moved=0.0):
    at = np.linspace(0.0, 1.0, STEPS)
    u, v = np.meshgrid(at, at)
    x, y = 120.0 * (u - 0.5), 160.0 * (v - 0.5)
    z = 50.0 * np.sqrt(np.maximum(1.0 - (x**2 + y**2) / 110.0**2, 0.0)) + moved * np.sin(6.0 * u)
    lines = [f"v {a:.4f} {b:.4f} {c:.4f}" for a, b, c in zip(x.flat, y.flat, z.flat, strict=True)]
    lines += [f"vt {a:.5f} {b:.5f}" for a, b in zip(u.flat, v.flat, strict=True)]
    for r in range(STEPS - 1):
        for c in range(STEPS - 1):
            i = r * STEPS + c + 1
            for a, b, d in ((i, i + 1, i + STEPS + 1), (i, i + STEPS + 1, i + STEPS)):
                lines.append(f"f {a}/{a} {b}/{b} {d}/{d}")
    return "\n".join(lines) + "\n"


def basis_bytes():
    lobes = brdf_tables.tabulate(
        {
            "broad": lambda light, view: np.full(light.shape[:-1], 0.05),
            "narrow": lambda light, view: 0.2 * np.maximum(light[..., 2] + view[..., 2] - 1.0, 0.0),
        }
    )
    out = io.BytesIO()
    np.savez(
        out, table=lobes.table[..., :2], light_radius_rad=0.0, mix=np.eye(2), materials=["a", "b"]
    )
    return out.getvalue()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a fitted face, one without lobes, and meshes."""
    path = tmp_path_factory.mktemp("render")
    at = (np.arange(SIZE) + 0.5) / SIZE
    u, v = np.meshgrid(at, 1.0 - at)
    x, y = 120.0 * (u - 0.5), 160.0 * (v - 0.5)
    z = 50.0 * np.sqrt(np.maximum(1.0 - (x**2 + y**2) / 110.0**2, 0.0))
    gradient = np.gradient(z, 160.0 / SIZE, 120.0 / SIZE)
    normals = np.stack([-gradient[1], gradient[0], np.ones_like(z)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    valid = np.ones((SIZE, SIZE), bool)
    maps = {
        "position": SkinMap(np.stack([x, y, z], -1), MAP_UNITS["position"], valid=valid),
        "normals": SkinMap(normals, MAP_UNITS["normals"], valid=valid),
        "r_d": SkinMap(
            np.broadcast_to([0.6, 0.4, 0.3], (SIZE, SIZE, 3)), MAP_UNITS["r_d"], valid=valid
        ),
        "basis_weight_0": SkinMap(0.5 + 0.0 * x, "1", valid=valid),
        "basis_weight_1": SkinMap(1.0 + x / 120.0, "1", valid=valid),
    }
    files = {"mesh.obj": mesh_text().encode(), "brdf_basis.npz": basis_bytes()}
    store.write(path / "face", SkinAppearance(maps, "simulated", files=files))
    fewer = {k: m for k, m in maps.items() if not k.startswith("basis")}
    store.write(path / "matt", SkinAppearance(fewer, "simulated", files=files))
    (path / "smile.obj").write_text(mesh_text(3.0))
    (path / "bare.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n")
    store.write_exr(path / "sky.exr", np.ones((4, 8, 3), np.float32))
    return path


def run(folder, monkeypatch, *words):
    monkeypatch.chdir(folder)
    return main(["render", *words, "--size-px", "40"])


@pytest.mark.long
def test_image_components_and_single_document_are_written(folder, monkeypatch, capsys):
    words = ("face", "--light", "1,0.5,2", "--components", "--out", "picture", "--json")
    assert run(folder, monkeypatch, *words) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document["schema"] == "skinrig.render/1"
    assert document["lights"] == {"1,0.5,2": 1}
    assert document["subsurface"] == "dipole"
    assert document["lit_pixels"] > 100
    assert any("population" in text for text in document["assumed"])
    kept = json.loads((folder / "picture" / "render.json").read_text())
    assert kept["files"] == document["files"]
    radiance, diffuse, surface = (
        store.read_exr(folder / "picture" / f"{name}.exr")
        for name in ("radiance", "diffuse", "surface")
    )
    np.testing.assert_allclose(radiance, diffuse + surface, atol=1e-6)
    assert radiance.shape == (40, 40, 3)
    assert radiance[..., 0].max() > radiance[..., 2].max() > 0.0
    assert "read face" in err
    assert not list(folder.glob(".*.part"))


def test_rig_view_environment_and_two_lights_combine(folder, monkeypatch, capsys):
    words = (
        "face",
        "--view",
        "C03",
        "--light",
        "L017*0.2",
        "--light",
        "at:200,0,500*0.3,0.2,0.1",
        "--environment",
        "sky.exr",
        "--environment-lights",
        "6",
        "--subsurface",
        "local",
        "--samples",
        "1",
        "--out",
        "lit",
        "--json",
    )
    assert run(folder, monkeypatch, *words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["lights"]["environment"] == 6
    assert document["view"]["name"] == "C03"
    assert any("view C03" in text or "camera C03" in text for text in document["assumed"])


def test_other_mesh_with_same_layout_carries_normals_along(folder, monkeypatch, capsys):
    words = (
        "face",
        "--mesh",
        "smile.obj",
        "--light",
        "1,0,1",
        "--subsurface",
        "local",
        "--out",
        "smile",
        "--json",
    )
    assert run(folder, monkeypatch, *words) == 0
    assert json.loads(capsys.readouterr().out)["normals_carried_along"] is True


def test_fewer_lobes_and_a_shadow_boundary_are_drawn(folder, monkeypatch, capsys):
    common = ("--light", "1,0,2", "--subsurface", "local", "--json")
    words = ("face", "--bases", "1,2", *common, "--out", "bases")
    assert run(folder, monkeypatch, *words) == 0
    rows = json.loads(capsys.readouterr().out)["bases"]
    assert [row["lobes"] for row in rows] == [1, 2]
    assert [row["refitted"] for row in rows] == [False, True]
    assert rows[0]["surface_difference_from_2"] > rows[1]["surface_difference_from_2"] == 0.0
    monkeypatch.setattr("skinrig.rendering.shadow.FACE_TEXELS", 128)
    monkeypatch.setattr("skinrig.rendering.shadow.PATCH_TEXELS", 64)
    words = ("face", "--shadow-boundary", "--samples", "1", "--out", "shadow", "--json")
    assert run(folder, monkeypatch, *words) == 0
    document = json.loads(capsys.readouterr().out)
    assert "all labels are sigma_tr" in document["labels"]
    assert [row["sigma_tr_per_mm"] for row in document["boundaries"][:2]] == [
        [0.3558, 0.7932, 1.5173],
        [0.9171, 1.5682, 1.6569],
    ]
    assert (folder / "shadow" / "shadow_boundary.png").read_bytes()[:4] == b"\x89PNG"


def test_translucency_that_is_asked_for_is_used(folder, monkeypatch, capsys):
    found = []
    for sigma in ("0.2,0.2,0.2", "5,5,5"):
        words = (
            "face",
            "--light",
            "3,0,1",
            "--samples",
            "1",
            "--translucency",
            sigma,
            "--out",
            "t",
        )
        assert run(folder, monkeypatch, *words) == 0
        found.append(store.read_exr(folder / "t" / "radiance.exr"))
    # a smooth bulge has no shadow edge: light spreads over the change of its slope alone
    assert 0.001 < np.abs(found[0] - found[1]).max() < 0.01


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["face", "--light", "L999"], 3, "L999"),
        (["face"], 2, "--light: got none"),
        (["face", "--light", "1,1,1", "--view", "0,0,-700"], 3, "behind the head"),
        (["face", "--light", "1,1,1", "--view", "C99"], 3, "C99"),
        (["face", "--light", "1,1,1", "--samples", "3"], 3, "--samples"),
        (["face", "--light", "1,1,1", "--subsurface", "wax"], 3, "wax"),
        (["face", "--light", "1,1,1", "--translucency", "1,2"], 2, "--translucency"),
        (["face", "--light", "1,1,1", "--bases", "2,24"], 3, "--rank 24"),
        (["face", "--light", "1,1,1", "--bases", "x"], 2, "--bases"),
        (["face", "--light", "1,1,1", "--calibration", "none"], 3, "none"),
        (["face", "--light", "1,1,1", "--mesh", "bare.obj"], 3, "no texture coordinates"),
        (["face", "--light", "1,1,1", "--exposure", "0"], 3, "--exposure"),
        (["matt", "--light", "1,1,1"], 3, "basis_weight_0"),
        (["face", "face", "--light", "1,1,1"], 2, "--bases"),
        (["nothing", "--light", "1,1,1"], 3, "nothing"),
        (["face", "--environment", "none.exr"], 3, "none.exr: No such file"),
        (["face", "--environment", "bare.obj"], 3, "expected an OpenEXR image"),
        (["face", "--light", "1,1,1", "--rig", "tent"], 3, "tent"),
    ],
)
def test_unrenderable_request_is_refused_with_single_clear_message(
    words, code, says, folder, monkeypatch, capfd
):
    assert run(folder, monkeypatch, *words, "--out", "refused") == code
    out, err = capfd.readouterr()
    assert says in err
    assert "EXR_ERR" not in err  # what libraries print past Python
    assert len(err) < 1000  # a rig of 150 lights is not listed
    assert "Traceback" not in out + err
    assert not (folder / "refused").exists()


def test_a_folder_of_something_else_is_not_replaced(folder, monkeypatch, capsys):
    assert run(folder, monkeypatch, "face", "--light", "1,1,1", "--out", "matt") == 3
    assert "expected a new folder or a rendering" in capsys.readouterr().err
    assert (folder / "matt" / "appearance.json").exists()


class OnePhotograph:
    """A session with one photograph that no fit has seen."""

    assumed = ("the head was static",)
    shots = (HeldOutShot("C03", "L017", "light"),)

    def camera(self, shot):
        return rendering_camera.look_at((200, 0, 600), size_px=(40, 30), name=shot.view)

    def light(self, shot):
        return Light(name=shot.light, direction=(1.0, 0.0, 1.0))

    def photograph(self, shot):
        return Photograph(np.full((30, 40, 3), 0.7), np.ones((30, 40, 3)), np.ones((30, 40), bool))


def test_photograph_is_decomposed_alongside_its_rendering(folder, monkeypatch, capsys):
    monkeypatch.setattr(photographs.HeldOutPhotographs, "of", lambda *_, **__: OnePhotograph())
    words = ("face", "--against", "session", "--components", "--subsurface", "local", "--json")
    lit = ("--view", "C03", "--light", "L017", "--out", "apart")
    assert run(folder, monkeypatch, *words, *lit) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["held_out"] == "light"
    assert "the head was static" in document["assumed"]
    left, diffuse, coverage = (
        store.read_exr(folder / "apart" / f"{name}.exr")
        for name in ("photograph_less_diffuse", "diffuse", "coverage")
    )
    skin = coverage > 0.5
    assert skin.any()
    np.testing.assert_allclose(left[skin], 0.7 - diffuse[skin], atol=1e-6)
    assert np.all(left[~skin] == 0.0)
    other = ("--view", "C03", "--light", "L020", "--out", "other")
    assert run(folder, monkeypatch, *words, *other) == 3
    assert "C03 L017" in capsys.readouterr().err
