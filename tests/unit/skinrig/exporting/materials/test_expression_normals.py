"""Wrinkles as variants of the materials of glTF and OpenUSD, against the normals of the smile."""

import dataclasses

import cv2
import numpy as np
import pytest

from model import store
from model.metrics import angular_error_rad
from model.skin import SkinMap
from skinrig.appearances.dynamic import WRINKLES, describe_parts
from skinrig.exporting.materials import gltf, usd
from skinrig.exporting.materials.expression_normals import expression_normals
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import ExportSettings
from skinrig.fitting.wrinkles import fit_wrinkles

WAVE_RAD = 0.2


@pytest.fixture(scope="module")
def smile(simulated_face):
    """Normals of the smile: the neutral ones, waved."""
    normals = simulated_face.maps["normals"]
    x = simulated_face.maps["position"].values[..., :1]
    waved = normals.values + WAVE_RAD * np.sin(x / 6.0) * np.array([1.0, 0.0, 0.0])
    return waved / np.linalg.norm(waved, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def moving(simulated_face, smile, tmp_path_factory):
    """The face with wrinkles, as a fused person has them."""
    folder = tmp_path_factory.mktemp("moving")
    old = simulated_face.maps["normals"]
    waved = {**simulated_face.maps, "normals": SkinMap(smile, "1", old.stderr, old.valid)}
    paths = []
    for state, maps in (("neutral", simulated_face.maps), ("smile", waved)):
        parameters = {**simulated_face.parameters, "state": state}
        one = dataclasses.replace(simulated_face, maps=maps, parameters=parameters)
        paths.append(store.write(folder / state, one))
    fit_wrinkles(paths, out=folder / "moving", size=64, mask_size=16)
    fitted = store.read(folder / "moving")
    part = describe_parts(fitted)[WRINKLES]
    return dataclasses.replace(
        simulated_face,
        maps={**simulated_face.maps, **fitted.maps},
        files={**simulated_face.files, **fitted.files},
        parameters={**simulated_face.parameters, "parts": {WRINKLES: part}},
    )


def test_variant_has_normals_of_the_smile(moving, smile):
    material = Material.of(moving)
    normals = expression_normals(moving, material)["smile"]
    inside = material.valid & (cv2.erode(material.valid.astype(np.uint8), np.ones((9, 9))) > 0)

    def error_rad(tangent):
        turned = np.einsum("hwk,hwck->hwc", tangent, np.swapaxes(material.axes, -1, -2))
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        return np.median(angular_error_rad(turned[inside], smile[inside]))

    assert error_rad(normals) < 0.2 * error_rad(material.normals)
    assert error_rad(material.normals) > 0.5 * WAVE_RAD
    assert expression_normals(moving, material).keys() == {"smile"}


def test_glb_switches_between_neutral_and_smile(moving, simulated_face, tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    left_out = gltf.write(moving, tmp_path, ExportSettings())
    assert "wrinkles of expressions" not in [what for what, _ in left_out]
    parsed = pygltflib.GLTF2().load(str(tmp_path / "skin.glb"))
    names = [one["name"] for one in parsed.extensions["KHR_materials_variants"]["variants"]]
    assert names == ["neutral", "translucent", "smile"]
    mappings = parsed.meshes[0].primitives[0].extensions["KHR_materials_variants"]["mappings"]
    used = [parsed.materials[one["material"]].normalTexture.index for one in mappings]
    assert [parsed.images[k].name for k in used] == ["normal", "normal", "normal, smile"]
    plain = gltf.encode_glb(Material.of(simulated_face), {})
    assert b"smile" not in plain


def test_usd_variant_set_changes_normal_map_alone(moving, tmp_path):
    pxr = pytest.importorskip("pxr.Usd")
    usd.write(moving, tmp_path, ExportSettings(unit="cm"))
    stage = pxr.Stage.Open(str(tmp_path / "skin.usdc"))
    chosen = stage.GetPrimAtPath("/Skin").GetVariantSets().GetVariantSet("expression")
    files = {}
    for name in chosen.GetVariantNames():
        assert chosen.SetVariantSelection(name)
        nodes = ("normal", "mtlx_normal", "base_color")
        prims = [stage.GetPrimAtPath(f"/Skin/Materials/Skin/{node}") for node in nodes]
        files[name] = [one.GetAttribute("inputs:file").Get().resolvedPath for one in prims]
        assert all(files[name])  # every file is there
    assert files["neutral"][:2] != files["smile"][:2]
    assert files["neutral"][2] == files["smile"][2]
    shown = [cv2.imread(files[name][0], cv2.IMREAD_UNCHANGED) for name in ("neutral", "smile")]
    assert np.abs(shown[0].astype(float) - shown[1]).max() > 0.1 * WAVE_RAD * 65535
