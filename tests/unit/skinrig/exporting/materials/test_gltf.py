"""The binary glTF file by independent readers: pygltflib, trimesh, the Khronos validator, ours."""

import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from skinrig.blend_shapes import meshes as blend_shapes
from skinrig.drawing.png import srgb_curve
from skinrig.errors import UsageError
from skinrig.exporting.materials import gltf
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import ExportSettings
from skinrig.exporting.sealing import describe_provenance

MM = 0.001


@pytest.fixture(scope="module")
def material(simulated_face, shapes_file):
    return Material.of(simulated_face, shapes_file)


@pytest.fixture(scope="module")
def folder(simulated_face, shapes_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("glb")
    left_out = gltf.write(simulated_face, out, ExportSettings(mesh=shapes_file, with_errors=True))
    assert [what for what, _ in left_out] == ["subsurface light"]
    return out


@pytest.fixture(scope="module")
def parsed(folder):
    pygltflib = pytest.importorskip("pygltflib")
    return pygltflib.GLTF2().load(str(folder / "skin.glb"))


def accessor(parsed, number):
    entry = parsed.accessors[number]
    view = parsed.bufferViews[entry.bufferView]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[entry.type]
    kind = {5126: "<f4", 5125: "<u4"}[entry.componentType]
    blob = parsed.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(blob, kind).reshape(entry.count, width)


def picture(parsed, number):
    view = parsed.bufferViews[parsed.images[number].bufferView]
    blob = parsed.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_UNCHANGED)


def test_file_bears_its_provenance(folder, simulated_face, material):
    """Rationale: programs that copy the file alone keep its asset. Empty lists are left out."""

    def read(blob):
        return json.loads(blob[20 : 20 + int.from_bytes(blob[12:16], "little")])["asset"]["extras"]

    held = read((folder / "skin.glb").read_bytes())["provenance"]
    assert held == {k: v for k, v in describe_provenance(simulated_face).items() if v}
    assert held["source"] == "simulated"
    person = {"source": "measured", "consent": [{"pseudonym": "P042"}], "assumed": ["a"]}
    assert read(gltf.encode_glb(material, person)) == {"provenance": person}


def test_lengths_are_meters_and_texture_v_grows_downwards(parsed, material):
    attributes = parsed.meshes[0].primitives[0].attributes
    points = accessor(parsed, attributes.POSITION)
    np.testing.assert_allclose(points, material.mesh.vertices_mm * MM, atol=1e-9)
    assert np.ptp(points[:, 0]) == pytest.approx(0.1, abs=1e-6)
    st = accessor(parsed, attributes.TEXCOORD_0)
    top = points[:, 1].argmax()
    assert st[top, 1] == pytest.approx(0.0, abs=1e-6)
    faces = accessor(parsed, parsed.meshes[0].primitives[0].indices)
    assert np.array_equal(faces.reshape(-1, 3), material.mesh.faces)


def test_tangents_follow_u_and_bitangents_point_image_up(parsed):
    attributes = parsed.meshes[0].primitives[0].attributes
    normal, tangent = accessor(parsed, attributes.NORMAL), accessor(parsed, attributes.TANGENT)
    middle = len(normal) // 2
    bitangent = tangent[middle, 3] * np.cross(normal[middle], tangent[middle, :3])
    np.testing.assert_allclose(tangent[middle, :3], [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(bitangent, [0, 1, 0], atol=1e-3)


def test_morph_targets_are_named_and_displaced_in_meters(parsed, material):
    mesh = parsed.meshes[0]
    assert mesh.extras["targetNames"] == ["jawOpen", "smile left"]
    for target, name in zip(mesh.primitives[0].targets, mesh.extras["targetNames"], strict=True):
        moved = accessor(parsed, target["POSITION"])
        np.testing.assert_allclose(moved, material.shapes[name] * MM, atol=1e-9)
    assert mesh.weights == [0.0, 0.0]


def test_images_decode_to_color_roughness_normals_and_weight(parsed, material):
    told = parsed.materials[0]
    color = picture(parsed, told.pbrMetallicRoughness.baseColorTexture.index)[..., ::-1] / 255.0
    np.testing.assert_allclose(color, srgb_curve(material.base_color), atol=0.51 / 255)
    rough = picture(parsed, told.pbrMetallicRoughness.metallicRoughnessTexture.index)
    np.testing.assert_allclose(rough[..., 1] / 255.0, material.surface.roughness, atol=0.51 / 255)
    assert rough[..., 0].max() == 0  # blue, metalness; OpenCV has it first
    normal = picture(parsed, told.normalTexture.index)[..., ::-1] / 127.5 - 1.0
    np.testing.assert_allclose(normal, material.normals, atol=1.01 / 255)
    extension = told.extensions["KHR_materials_specular"]
    weight = picture(parsed, extension["specularTexture"]["index"])[..., 3] / 255.0
    np.testing.assert_allclose(weight, material.specular_weight, atol=0.51 / 255)
    # u = 0 is red-poor and v = 1 green-poor: row 0 is the top
    assert color[32, 60, 0] > color[32, 2, 0] + 0.05
    assert color[60, 32, 1] > color[8, 32, 1] + 0.05


def test_values_unsupported_by_gltf_are_in_extras(parsed, material):
    told = parsed.materials[0]
    assert told.extensions["KHR_materials_ior"]["ior"] == pytest.approx(1.4)
    sigma = told.extras["subsurface"]["sigma_tr_per_mm"]
    depth = np.median(material.translucency_mm[material.valid], axis=0)
    np.testing.assert_allclose(sigma, 1.0 / depth, rtol=1e-6)


def test_translucent_variant_keeps_reflectance_and_decay(parsed, material):
    """Rationale: a reader mixes base color and transmitted light by the factor."""
    plain, clear = parsed.materials[:2]
    transmission = clear.extensions["KHR_materials_diffuse_transmission"]
    volume = clear.extensions["KHR_materials_volume"]
    assert set(clear.extensions) - set(plain.extensions) <= set(parsed.extensionsUsed)
    names = [one["name"] for one in parsed.extensions["KHR_materials_variants"]["variants"]]
    assert names == ["neutral", "translucent"]
    factor = transmission["diffuseTransmissionFactor"]
    number = clear.pbrMetallicRoughness.baseColorTexture.index
    code = picture(parsed, number)[..., ::-1] / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    reflected = (1.0 - factor) * linear[material.valid]
    step = 0.5 / 255 * 2.4  # largest slope of the sRGB curve's inverse
    np.testing.assert_allclose(reflected, material.base_color[material.valid], atol=step)
    decay = -np.log(volume["attenuationColor"]) / (1000.0 * volume["attenuationDistance"])
    depth = np.median(material.translucency_mm[material.valid], axis=0)
    np.testing.assert_allclose(decay, 1.0 / depth, rtol=1e-6)
    assert volume["thicknessFactor"] == pytest.approx(np.ptp(material.mesh.vertices_mm[:, 2]) * MM)


def test_document_states_transmission_kept(folder, material):
    told = json.loads((folder / "glb.json").read_text())
    kept = np.array(told["transmission"]["kept_fraction"])
    assert ((kept > 0.0) & (kept <= 1.0)).all()
    depth = np.median(material.translucency_mm[material.valid], axis=0)
    np.testing.assert_allclose(told["transmission"]["translucency_mm"], depth, rtol=1e-9)
    assert "show it too bright" in told["variants"]["translucent"]


def test_skinrig_reader_recovers_mesh_in_mm(folder, material):
    read = blend_shapes.load(folder / "skin.glb")
    np.testing.assert_allclose(read.vertices_mm, material.mesh.vertices_mm, atol=1e-4)
    np.testing.assert_allclose(read.uv, material.mesh.uv, atol=1e-6)
    np.testing.assert_allclose(read.shapes["jawOpen"], material.shapes["jawOpen"], atol=1e-4)


def test_trimesh_reads_same_surface(folder, material):
    import trimesh

    data = io.BytesIO((folder / "skin.glb").read_bytes())
    read = trimesh.load(data, file_type="glb", force="mesh", process=False)
    own = trimesh.Trimesh(material.mesh.vertices_mm * MM, material.mesh.faces, process=False)
    assert read.area == pytest.approx(own.area, rel=1e-5)
    np.testing.assert_allclose(read.bounds, own.bounds, atol=1e-7)
    # trimesh turns v up again, as we have it
    np.testing.assert_allclose(read.visual.uv, material.mesh.uv, atol=1e-6)


def validator():
    """Return the folder of the npm package gltf-validator, None where it is not installed."""
    told = os.environ.get("GLTF_VALIDATOR")
    for place in filter(None, (told, Path(__file__).parents[5] / "node_modules/gltf-validator")):
        if (Path(place) / "package.json").is_file() and shutil.which("node"):
            return Path(place)
    return None


def validated(path):
    script = (
        "const v=require(process.argv[1]),fs=require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])))"
        ".then(r=>console.log(JSON.stringify(r)));"
    )
    done = subprocess.run(
        ["node", "-e", script, str(validator()), str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return json.loads(done.stdout)


@pytest.mark.skipif(validator() is None, reason="GLTF_VALIDATOR names no npm gltf-validator")
def test_khronos_validator_reports_no_issues(folder, tmp_path):
    report = validated(folder / "skin.glb")
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0
    unknown = [one["message"] for one in report["issues"]["messages"]]  # newer than the validator
    assert len(unknown) == 1
    assert "'KHR_materials_diffuse_transmission'" in unknown[0]
    assert report["info"]["totalVertexCount"] == 169
    blob = bytearray((folder / "skin.glb").read_bytes())
    place = blob.index(b'"type":"VEC4"')
    blob[place : place + 13] = b'"type":"VEC3"'  # tangents without their sign
    (tmp_path / "broken.glb").write_bytes(blob)
    assert validated(tmp_path / "broken.glb")["issues"]["numErrors"] > 0


def gltf_transform():
    """Return the folder of the npm packages @gltf-transform, None where they are not installed."""
    told = os.environ.get("GLTF_TRANSFORM")
    for place in filter(None, (told, Path(__file__).parents[5] / "node_modules/@gltf-transform")):
        if (Path(place) / "extensions/package.json").is_file() and shutil.which("node"):
            return Path(place)
    return None


@pytest.mark.skipif(gltf_transform() is None, reason="GLTF_TRANSFORM names no @gltf-transform")
def test_gltf_transform_reads_transmission(folder, material):
    script = (
        "const {NodeIO}=require(process.argv[1]+'/core'),"
        "{ALL_EXTENSIONS}=require(process.argv[1]+'/extensions');"
        "(async()=>{const d=await new NodeIO().registerExtensions(ALL_EXTENSIONS)"
        ".read(process.argv[2]);const m=d.getRoot().listMaterials()"
        ".find(m=>m.getName().endsWith('translucent'));"
        "const t=m.getExtension('KHR_materials_diffuse_transmission');"
        "const v=m.getExtension('KHR_materials_volume');"
        "console.log(JSON.stringify([t.getDiffuseTransmissionFactor(),"
        "t.getDiffuseTransmissionColorFactor(),v.getAttenuationDistance(),"
        "v.getAttenuationColor(),v.getThicknessFactor()]))})()"
    )
    argv = ["node", "-e", script, str(gltf_transform()), str(folder / "skin.glb")]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True)
    factor, color, distance, attenuation, thickness = json.loads(done.stdout)
    made = gltf.find_transmission(material)
    assert (factor, distance, thickness) == pytest.approx(
        (made.factor, made.attenuation_distance_m, made.thickness_m), rel=1e-6
    )
    np.testing.assert_allclose(color, made.color, rtol=1e-6)
    np.testing.assert_allclose(attenuation, made.attenuation_color, rtol=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"unit": "mm"}, {"normal_y": "dx"}, {"udim": "dot"}], ids=lambda one: next(iter(one))
)
def test_options_fixed_by_gltf_are_refused(simulated_face, tmp_path, wrong):
    with pytest.raises(UsageError, match="the only one of glTF"):
        gltf.write(simulated_face, tmp_path, ExportSettings(**wrong))


def test_mesh_without_shapes_reports_missing_targets(simulated_face, tmp_path):
    left_out = dict(gltf.write(simulated_face, tmp_path, ExportSettings()))
    assert "--mesh" in left_out["morph targets"]
    assert json.loads((tmp_path / "glb.json").read_text())["morph_targets"] == []
