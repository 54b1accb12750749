import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from model.microstructure.mesh_strain import strain
from rigsim.geometry.mesh import MeshError, MeshFileError
from skinrig.blend_shapes.meshes import load

ICT = Path(__file__).parents[5] / "shared/data/ict_face.npz"

OBJ = """# a folded strip of two squares, one seam in the texture
v 0 0 0
v 10 0 0
v 10 10 0
v 0 10 0
v 20 0 3
v 20 10 3
vt 0.1 0.1
vt 0.4 0.1
vt 0.4 0.4
vt 0.1 0.4
vt 0.6 0.1
vt 0.9 0.1
vt 0.9 0.4
vt 0.6 0.4
vn 0 0 1
g strip
f 1/1/1 2/2/1 3/3/1 4/4/1
f -5/5 -2/6 -1/7 -4/8
"""


def obj_folder(folder, *, shape=None):
    folder.mkdir(exist_ok=True)
    (folder / "Neutral.obj").write_text(OBJ)
    moved = OBJ.replace("v 20 0 3", "v 25 0 3").replace("v 20 10 3", "v 25 10 3")
    (folder / "wide.obj").write_text(moved if shape is None else shape)
    (folder / "notes.txt").write_text("not a mesh")
    return folder


def gltf_document(*, sparse=True):
    """A square of 20 mm, in metres, shown by a node that is scaled and turned; two targets."""
    points = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.02, 0], [0, 0.02, 0]], "<f4")
    uv = np.array([[0, 65535], [65535, 65535], [65535, 0], [0, 0]], "<u2")
    corners = np.array([0, 1, 2, 0, 2, 3], "<u1")
    pull = np.zeros((4, 3), "<f4")
    pull[1:3, 0] = 0.004
    places, values = np.array([2], "<u2"), np.array([[0, 0, 0.01]], "<f4")
    data, views = b"", []
    for array in (points, uv, corners, pull, places, values):
        data += b"\0" * (-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        data += array.tobytes()
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 4, "type": "VEC2", "normalized": True},
        {"bufferView": 2, "componentType": 5121, "count": 6, "type": "SCALAR"},
        {"bufferView": 3, "componentType": 5126, "count": 4, "type": "VEC3"},
        {
            "componentType": 5126,
            "count": 4,
            "type": "VEC3",
            "sparse": {
                "count": 1,
                "indices": {"bufferView": 4, "componentType": 5123},
                "values": {"bufferView": 5},
            },
        },
    ]
    primitive = {
        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
        "indices": 2,
        "targets": [{"POSITION": 3}, {"POSITION": 4 if sparse else 3}],
    }
    half = float(np.sqrt(0.5))
    return {
        "asset": {"version": "2.0"},
        "nodes": [
            {"children": [1], "translation": [1.0, 0, 0]},
            {"mesh": 1, "rotation": [0, 0, half, half], "scale": [2.0, 1, 1]},
        ],
        "meshes": [
            {"name": "teeth", "primitives": [{"attributes": {"POSITION": 0}}]},
            {
                "name": "face",
                "primitives": [primitive],
                "extras": {"targetNames": ["pull", "lift"]},
            },
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }, data


def glb(document, data):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    body += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def test_obj_folder_is_split_at_seams_and_triangulated(tmp_path):
    mesh = load(obj_folder(tmp_path / "head"))
    assert mesh.vertices_mm.shape == (8, 3)  # two vertices have two texture coordinates each
    assert mesh.faces.shape == (4, 3)
    assert list(mesh.shapes) == ["wide"]
    found = strain(mesh.vertices_mm, mesh.deform({"wide": 1.0}), mesh.faces, mesh.uv)
    width = np.hypot(10.0, 3.0)
    right = mesh.uv[:, 0] > 0.55
    outer = right & (mesh.uv[:, 0] > 0.7)
    np.testing.assert_allclose(found.r_s[outer], np.hypot(15.0, 3.0) / width, rtol=1e-6)
    seam = np.flatnonzero(mesh.vertices_mm[:, 0] == 10.0)
    assert len(np.unique(found.point_index[seam])) == 2
    assert load(tmp_path / "head" / "Neutral.obj").shapes.keys() == mesh.shapes.keys()


@pytest.mark.parametrize(
    ("damage", "word"),
    [
        (("v 20 0 3", "v 20 0"), "line 6: got 2 numbers"),
        (("v 20 0 3", "v 20 zero 3"), "line 6"),
        (("v 20 0 3", "v nan 0 3"), "line 6"),
        (("1/1/1 2/2/1", "1/1/1 99/2/1"), "line 18: got vertex 99"),
        (("1/1/1 2/2/1", "0/1/1 2/2/1"), "line 18: got vertex 0"),
        (("1/1/1 2/2/1", "1/one 2/2/1"), "v/vt"),
        (("f 1/1/1 2/2/1 3/3/1 4/4/1", "f 1/1 2/2"), "corners"),
        (("f 1/1/1 2/2/1 3/3/1 4/4/1", "f 1 2 3 4"), "texture"),
        (("f ", "# "), "no faces"),
    ],
)
def test_damaged_obj_files_are_named_with_their_line(tmp_path, damage, word):
    folder = obj_folder(tmp_path / "head")
    text = OBJ.replace(*damage)
    for file in ("Neutral.obj", "wide.obj"):
        (folder / file).write_text(text)
    with pytest.raises(MeshFileError, match=word):
        load(folder)


def test_obj_shapes_of_another_topology_are_refused(tmp_path):
    with pytest.raises(MeshFileError, match="6 as in"):
        load(obj_folder(tmp_path / "a", shape=OBJ.replace("v 20 0 3\n", "v 20 0 3\nv 1 1 1\n")))
    with pytest.raises(MeshFileError, match="faces differ"):
        load(obj_folder(tmp_path / "b", shape=OBJ.replace("f 1/1/1 2/2/1", "f 2/2/1 1/1/1")))
    (tmp_path / "b" / "Neutral.obj").unlink()
    with pytest.raises(MeshFileError, match="expected one of that name"):
        load(tmp_path / "b")


@pytest.mark.parametrize("kind", ["glb", "gltf", "data"])
def test_gltf_targets_are_mm_in_scene_frame(tmp_path, kind):
    document, data = gltf_document()
    if kind == "glb":
        path = tmp_path / "face.glb"
        path.write_bytes(glb(document, data))
    else:
        path = tmp_path / "face.gltf"
        if kind == "gltf":
            document["buffers"][0]["uri"] = "face%20data.bin"
            (tmp_path / "face data.bin").write_bytes(data)
        else:
            uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
            document["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document))
    mesh = load(path)
    # x doubled, then turned by a quarter onto y, then moved by 1 m
    np.testing.assert_allclose(mesh.vertices_mm[2], [1000.0 - 20.0, 40.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(mesh.uv, [[0, 0], [1, 0], [1, 1], [0, 1]], atol=1e-6)
    np.testing.assert_allclose(mesh.shapes["pull"][1], [0.0, 8.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(mesh.shapes["lift"], 10.0 * np.eye(4, 3)[[3, 3, 2, 3]], atol=1e-4)
    found = strain(mesh.vertices_mm, mesh.deform({"pull": 0.5}), mesh.faces, mesh.uv)
    np.testing.assert_allclose(found.r_s, 1.1, rtol=1e-5)


@pytest.mark.parametrize(
    ("damage", "word"),
    [
        (lambda d: d["asset"].update(version="1.0"), "version 1.0"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "draco"),
        (lambda d: d["meshes"].pop(), "0 meshes with morph targets"),
        (lambda d: d["meshes"].append(d["meshes"][1]), "expected one"),
        (lambda d: d["meshes"][1]["primitives"][0].update(mode=5), "mode 5"),
        (lambda d: d["meshes"][1]["primitives"][0]["attributes"].pop("TEXCOORD_0"), "TEXCOORD_0"),
        (lambda d: d["accessors"].pop(), "missing"),
        (lambda d: d["accessors"][0].update(count=400), "shorter"),
        (lambda d: d["accessors"][0].update(type="VEC2"), "VEC2"),
        (lambda d: d["accessors"][0].update(componentType=1), "component"),
        (lambda d: d["accessors"][2].update(count=5), "not those of triangles"),
        (
            lambda d: d["accessors"][4]["sparse"]["indices"].update(bufferView=1, byteOffset=2),
            "sparse",
        ),
        (lambda d: d["bufferViews"][0].update(byteOffset=10**6), "shorter"),
        (lambda d: d["meshes"][1]["extras"].update(targetNames=["pull"]), "names"),
        (lambda d: d["nodes"][1].update(children=[0]), "cyclic"),
        (lambda d: d["buffers"][0].update(byteLength=10**6), "truncated"),
        (lambda d: d["buffers"][0].update(uri="../face.bin"), "next to"),
        (lambda d: d["buffers"][0].update(uri="gone.bin"), "not readable"),
        (lambda d: d["buffers"][0].update(uri="data:;base64,?"), "data URI"),
    ],
)
def test_damaged_gltf_files_are_named_with_fault(tmp_path, damage, word):
    document, data = gltf_document()
    damage(document)
    path = tmp_path / "face.glb"
    path.write_bytes(glb(document, data))
    with pytest.raises(MeshFileError, match=word):
        load(path)


def test_glb_files_truncated_or_foreign_are_refused(tmp_path):
    whole = glb(*gltf_document())
    path = tmp_path / "face.glb"
    for content, word in (
        (whole[:-8], "expected"),
        (b"solid", "not a GLB"),
        (whole[:4] + struct.pack("<II", 2, 20) + b"\0" * 8, "JSON"),
    ):
        path.write_bytes(content)
        with pytest.raises(MeshFileError, match=word):
            load(path)
    path.write_bytes(whole)
    assert load(path).shapes.keys() == {"pull", "lift"}


def arrays():
    return {
        "vertices_mm": np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0.0]], np.float32),
        "uv": np.zeros((3, 2), np.float32),
        "faces": np.array([[0, 1, 2]], np.int32),
        "shape_names": np.array(["up"]),
        "shape_deltas_mm": np.ones((1, 3, 3), np.float16),
    }


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"uv": None}, "uv missing"),
        ({"shape_names": np.array(["up", "up"])}, "twice"),
        ({"shape_names": np.array([1])}, "text"),
        ({"shape_names": np.array(["up"], object)}, "npz"),
        ({"shape_deltas_mm": np.ones((2, 3, 3))}, "shape_deltas_mm"),
        ({"faces": np.array([[0.0, 1, 2]])}, "integers"),
        ({"faces": np.array([[0, 1, 3]])}, "indices"),
        ({"vertices_mm": np.full((3, 3), np.nan)}, "not finite"),
        ({"vertices_mm": np.eye(3) * 1e-3}, "millimeters"),
        ({"uv": np.zeros((2, 2))}, "uv"),
    ],
)
def test_incomplete_or_contradictory_npz_files_are_refused(tmp_path, change, word):
    given = {**arrays(), **change}
    np.savez(tmp_path / "m.npz", **{k: v for k, v in given.items() if v is not None})
    with pytest.raises(MeshError, match=word):
        load(tmp_path / "m.npz")


def test_weights_add_up_and_unknown_shapes_suggest_nearest(tmp_path):
    np.savez(tmp_path / "m.npz", **arrays())
    mesh = load(tmp_path / "m.npz")
    np.testing.assert_allclose(mesh.deform({"up": -0.5}), mesh.vertices_mm - 0.5)
    np.testing.assert_array_equal(mesh.deform({}), mesh.vertices_mm)
    with pytest.raises(MeshError, match="did you mean 'up'"):
        mesh.deform({"upp": 1.0})
    with pytest.raises(MeshError, match="nan"):
        mesh.deform({"up": np.nan})


def test_missing_files_or_unknown_kinds_are_refused(tmp_path):
    with pytest.raises(MeshFileError, match="no such"):
        load(tmp_path / "gone.npz")
    (tmp_path / "m.fbx").write_text("")
    with pytest.raises(MeshFileError, match=r"\.fbx"):
        load(tmp_path / "m.fbx")
    (tmp_path / "m.npz").write_text("not a zip")
    with pytest.raises(MeshFileError, match="npz"):
        load(tmp_path / "m.npz")


@pytest.mark.skipif(not ICT.exists(), reason="the shared face mesh is not here")
def test_shared_face_smile_stretches_and_compresses_skin():
    mesh = load(ICT)
    found = strain(
        mesh.vertices_mm,
        mesh.deform({"mouthSmile_L": 1.0, "mouthSmile_R": 1.0}),
        mesh.faces,
        mesh.uv,
    )
    assert found.valid.all()
    assert found.r_s.max() > 1.2
    assert found.r_t.min() < 0.8
    order = np.argsort(found.point_index, kind="stable")
    twins = np.diff(found.point_index[order]) == 0
    assert twins.sum() > 100
    np.testing.assert_array_equal(found.r_s[order][1:][twins], found.r_s[order][:-1][twins])


@pytest.mark.parametrize(
    "text", ['{"asset":0}', '{"asset":{"version":"2.0"},"extensionsRequired":3}', '{"asset":[]}']
)
def test_gltf_of_wrong_types_gives_clear_error(text, tmp_path):
    path = tmp_path / "a.gltf"
    path.write_text(text)
    with pytest.raises(MeshFileError, match=r"version none|got 0 meshes"):
        load(path)
