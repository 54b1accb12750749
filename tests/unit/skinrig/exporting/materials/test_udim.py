"""Meshes over several UDIM tiles: maps on the first, and nothing made up on the others."""

import json

import numpy as np
import OpenEXR
import pytest

from rigsim.geometry.mesh import Mesh, MeshError
from skinrig.errors import UnusableError, UsageError
from skinrig.exporting.materials import gltf, materialx, udim, usd
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import ExportError, ExportSettings


def two_tiles(patch, tile=(1.0, 0.0)):
    """Return the patch, and its mirror image behind it on another tile, seams shared."""
    front = patch.mesh(shapes=True)
    back = front.vertices_mm * [1.0, 1.0, -1.0]
    count = len(front.vertices_mm)
    return {
        "vertices_mm": np.concatenate([front.vertices_mm, back]),
        "faces": np.concatenate([front.faces, front.faces[:, ::-1] + count]),
        "uv": np.concatenate([front.uv, front.uv + tile]),
        "shape_names": np.array(list(front.shapes)),
        "shape_deltas_mm": np.stack(
            [np.concatenate([moved, -moved]) for moved in front.shapes.values()]
        ),
    }


@pytest.fixture(scope="module")
def head(patch, tmp_path_factory):
    path = tmp_path_factory.mktemp("head") / "head.npz"
    np.savez(path, **two_tiles(patch))
    return path


def read(path):
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        return channels["RGB" if "RGB" in channels else "Y"].pixels.copy()


def test_each_tile_has_textures_and_first_has_maps(simulated_face, head, tmp_path):
    left_out = materialx.write(simulated_face, tmp_path, ExportSettings(mesh=head, udim="dot"))
    assert [what for what, _ in left_out] == ["maps of tile 1002"]
    material = Material.of(simulated_face, head)
    first, other = (read(tmp_path / f"textures/base_color.{n}.exr") for n in (1001, 1002))
    np.testing.assert_array_equal(first, material.base_color)
    usual = np.median(material.base_color[material.valid], axis=0)
    np.testing.assert_allclose(other, np.broadcast_to(usual, other.shape), rtol=1e-6)
    names = {path.name for path in (tmp_path / "textures").iterdir()}
    firsts = {n for n in names if ".1001." in n}
    assert names - firsts == {n.replace("1001", "1002") for n in firsts}
    told = json.loads((tmp_path / "material.json").read_text())
    assert told["udim"] == {"tiles": [1001, 1002], "measured": [1001]}
    entry = told["files"]["textures/base_color.1002.exr"]
    assert entry["valid_share"] == 0.0
    assert entry["what"].startswith("tile without measurements")
    text = (tmp_path / "skin.mtlx").read_text()
    assert "base_color.&lt;UDIM&gt;.exr" in text
    assert "1001" not in text


def test_empty_tile_normal_map_is_flat_either_green(simulated_face, head, tmp_path):
    import cv2

    order = ExportSettings(mesh=head, udim="underscore", normal_y="dx")
    materialx.write(simulated_face, tmp_path, order)
    codes = cv2.imread(str(tmp_path / "textures/normal_1002.png"), cv2.IMREAD_UNCHANGED)[0, 0, ::-1]
    np.testing.assert_allclose(codes / 65535.0, [0.5, 0.5, 1.0], atol=1e-5)


def test_maps_match_mesh_of_first_tile_alone(simulated_face, head, shapes_file):
    """The frames at the rim follow the whole mesh: its normals average both sides there."""
    both = Material.of(simulated_face, head)
    alone = Material.of(simulated_face, shapes_file)
    np.testing.assert_array_equal(both.base_color, alone.base_color)
    np.testing.assert_array_equal(both.covered, alone.covered)
    inner = np.zeros(both.covered.shape, bool)
    inner[12:-12, 12:-12] = True
    np.testing.assert_allclose(both.normals[inner], alone.normals[inner], atol=1e-6)
    assert len(both.mesh.faces) == 2 * len(alone.mesh.faces)
    assert both.mesh.uv[:, 0].max() == 2.0
    np.testing.assert_allclose(
        both.shapes["jawOpen"][: len(alone.mesh.uv)], alone.shapes["jawOpen"], atol=1e-6
    )


def test_usd_keeps_all_faces_and_their_coordinates(simulated_face, head, tmp_path):
    pxr = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    left_out = usd.write(simulated_face, tmp_path, ExportSettings(mesh=head, udim="dot"))
    assert "maps of tile 1002" in dict(left_out)
    stage = pxr.Stage.Open(str(tmp_path / "skin.usdc"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Skin/Face"))
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    assert (st[:, 0].min(), st[:, 0].max()) == (0.0, 2.0)
    assert (tmp_path / "textures/specular_roughness.1002.png").is_file()


def test_multi_tile_mesh_needs_udim_and_rejects_gltf(simulated_face, head, tmp_path):
    with pytest.raises(UsageError, match="--udim: got none for a mesh on tiles 1001, "):
        materialx.write(simulated_face, tmp_path, ExportSettings(mesh=head))
    with pytest.raises(UnusableError, match="tiles 1001, 1002, expected tile 1001"):
        gltf.write(simulated_face, tmp_path, ExportSettings(mesh=head))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("uv", "says"),
    [
        ([[0.5, 0.5], [1.5, 0.5], [0.5, 0.9]], r"face 0 extends from \[0.5, 0.5\] to \[1.5, 0.9\]"),
        ([[-0.9, 0.1], [-0.1, 0.1], [-0.5, 0.9]], "expected u from 0 to 10"),
        ([[10.1, 0.1], [10.9, 0.1], [10.5, 0.9]], "expected u from 0 to 10"),
    ],
    ids=["across a border", "left of the first", "right of the last"],
)
def test_coordinates_that_no_tile_has_are_named(uv, says):
    with pytest.raises(ExportError, match=says):
        udim.find_tiles(np.array(uv), np.array([[0, 1, 2]]))


def test_tiles_are_counted_by_tens_upwards():
    corner = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.9]])
    for shift, number in (((0, 0), 1001), ((9, 0), 1010), ((0, 1), 1011), ((2, 3), 1033)):
        assert udim.find_tiles(corner + shift, np.array([[0, 1, 2]])).tolist() == [number]


def test_mesh_outside_first_tile_is_refused(patch, simulated_face, tmp_path):
    arrays = two_tiles(patch)
    arrays["uv"] = arrays["uv"] + [1.0, 0.0]
    np.savez(tmp_path / "back.npz", **arrays)
    with pytest.raises(ExportError, match="got faces on tiles 1002, 1003, expected some on 1001"):
        Material.of(simulated_face, tmp_path / "back.npz")


def test_obj_over_two_tiles_is_read_like_npz(patch, head, tmp_path):
    arrays = two_tiles(patch)
    lines = ["v {} {} {}".format(*row) for row in arrays["vertices_mm"].tolist()]
    lines += ["vt {} {}".format(*row) for row in arrays["uv"].tolist()]
    lines += ["f {0}/{0} {1}/{1} {2}/{2}".format(*row) for row in (arrays["faces"] + 1).tolist()]
    (tmp_path / "head.obj").write_text("\n".join(lines) + "\n")
    one, other = udim.read(tmp_path / "head.obj"), udim.read(head)
    assert one.tiles == other.tiles == (1001, 1002)
    corners = [mesh.uv[mesh.faces] for mesh in (one, other)]
    np.testing.assert_allclose(corners[0], corners[1], atol=1e-6)


def test_single_tile_meshes_and_mesh_faults_are_unchanged(shapes_file, tmp_path):
    found = udim.read(shapes_file)
    assert found.tiles == (1001,)
    assert isinstance(found.first(), Mesh)
    np.savez(
        tmp_path / "bad.npz",
        vertices_mm=np.zeros((3, 3)),
        faces=np.array([[0, 1, 9]]),
        uv=np.full((3, 2), 1.5),
    )
    with pytest.raises(MeshError, match="faces: got indices"):
        udim.read(tmp_path / "bad.npz")
