"""Exports in Blender, by values. Needs a Python with bpy: this one, or that of BLENDER_PYTHON.

Blender runs as a process of its own; ``read_in_blender.py`` writes what it holds of a file.
"""

import ast
import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skinrig.drawing.png import srgb_curve
from skinrig.exporting.materials import blender, gltf, usd
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import ExportSettings

READER = Path(__file__).with_name("read_in_blender.py")
MM = 0.001
SIDE = 64


def python_of_blender():
    """Return an interpreter that has bpy, None where there is none."""
    told = os.environ.get("BLENDER_PYTHON")
    if told:
        return told
    return sys.executable if importlib.util.find_spec("bpy") else None


@pytest.fixture(scope="module")
def material(simulated_face, shapes_file):
    return Material.of(simulated_face, shapes_file)


def read(path, out, bake=SIDE):
    """Return arrays and facts that Blender holds of a file, turned into the rig frame."""
    if python_of_blender() is None:
        pytest.skip("no bpy: install it, or let BLENDER_PYTHON name a Python that has it")
    done = subprocess.run(
        [python_of_blender(), READER, path, out, str(bake)],
        capture_output=True,
        text=True,
        timeout=250,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(out) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    facts = json.loads(str(found.pop("facts")))
    for name in found:
        if name == "vertices" or name.startswith("shape:") or name == "baked":
            x, y, z = np.moveaxis(found[name], -1, 0)
            found[name] = np.stack([x, z, -y], -1)  # Blender's up is z
    return found, facts


@pytest.fixture(scope="module")
def in_blender(simulated_face, shapes_file, tmp_path_factory):
    """Return what Blender reads of a format, each exported and read once."""
    kept = {}

    def get(format_):
        if format_ not in kept:
            out = tmp_path_factory.mktemp(format_)
            if format_ == "glb":
                gltf.write(simulated_face, out, ExportSettings(mesh=shapes_file))
            else:
                pytest.importorskip("pxr")
                told = {"unit": "cm", "normal_y": "dx", "udim": "dot"} if "dx" in format_ else {}
                usd.write(simulated_face, out, ExportSettings(mesh=shapes_file, **told))
            kept[format_] = read(out / blender.SCRIPT_FILE, out / "read.npz")
        return kept[format_]

    return get


FORMATS = pytest.mark.parametrize("format_", ["glb", "usd", "usd in cm, dx"])


@FORMATS
def test_blender_keeps_measured_vertices_and_texture_coordinates(in_blender, material, format_):
    found, _ = in_blender(format_)
    np.testing.assert_allclose(found["vertices"], MM * material.mesh.vertices_mm, atol=2e-8)
    assert np.array_equal(found["faces"], material.mesh.faces)
    np.testing.assert_allclose(found["uv"], material.mesh.uv[material.mesh.faces], atol=1e-6)


@FORMATS
def test_blender_has_the_blend_shapes_as_shape_keys(in_blender, material, format_):
    found, facts = in_blender(format_)
    smile = "smile left" if format_ == "glb" else "smile_left"
    assert (facts["shapes"], facts["weights"]) == (["jawOpen", smile], [0.0, 0.0])
    for key, moved in zip(("jawOpen", smile), material.shapes.values(), strict=True):
        np.testing.assert_allclose(found[f"shape:{key}"], MM * moved, atol=2e-8)


@FORMATS
def test_blender_reads_base_color_as_srgb_others_data(in_blender, material, format_):
    found, facts = in_blender(format_)
    assert [facts[f"{n}_space"] for n in ("base_color", "roughness", "normal")] == [
        "sRGB",
        "Non-Color",
        "Non-Color",
    ]
    color = found["base_color"][..., :3]
    if format_ == "glb":  # 8 bits stay coded in Blender's memory
        np.testing.assert_allclose(color, srgb_curve(material.base_color), atol=0.51 / 255)
    else:
        np.testing.assert_allclose(color, material.base_color, atol=3e-5)
    channel = 1 if format_ == "glb" else 0
    np.testing.assert_allclose(
        found["roughness"][..., channel], material.surface.roughness, atol=0.51 / 255
    )
    assert facts["ior"] == pytest.approx(material.eta)


@FORMATS
def test_cycles_shading_normals_match_measured_normals(in_blender, material, format_):
    """Baked by Cycles, whose tangents are its own; a map read upside down would be 20 degrees off.

    8 bits in a .glb move a normal by up to 0.4 degrees, bilinear lookup and the bake the rest.
    """
    found, facts = in_blender(format_)
    assert facts["normal_frame"] == "TANGENT"
    baked = found["baked"] / np.linalg.norm(found["baked"], axis=-1, keepdims=True)
    on = found["baked_covered"] & material.valid
    assert on.mean() > 0.98

    def angle(normals):
        return np.degrees(np.arccos(np.clip((baked * normals).sum(-1), -1, 1)))[on]

    assert np.percentile(angle(material.normals_rig), 99) < (0.5 if format_ == "glb" else 0.2)
    flipped = np.einsum("hwk,hwkc->hwc", material.normals * [1, -1, 1], material.axes)
    assert np.median(angle(flipped / np.linalg.norm(flipped, axis=-1, keepdims=True))) > 5.0


@FORMATS
def test_script_sets_subsurface_scattering_in_meters(in_blender, material, format_):
    found, facts = in_blender(format_)
    assert (facts["subsurface_weight"], facts["method"]) == (1.0, "RANDOM_WALK")
    in_mm = facts["subsurface_scale"] / MM / (4.0 * math.pi)
    if format_ == "glb":
        radius = in_mm * np.array(facts["subsurface_radius"])
        np.testing.assert_allclose(radius, material.median_radius_mm(), rtol=1e-5)
    else:
        assert facts["radius_space"] == "Non-Color"
        on = material.covered
        radius = in_mm * found["radius"][..., :3]
        np.testing.assert_allclose(radius[on], material.radius_mm[on], rtol=1e-5)
        weight = found["specular"][..., 0]
        np.testing.assert_allclose(weight[on], material.specular_weight[on], atol=1e-6)


def test_gltf_subsurface_extras_become_property(in_blender, material):
    _, facts = in_blender("glb")
    told = facts["properties"]["subsurface"]
    np.testing.assert_allclose(told["mean_free_path_mm"], material.median_radius_mm(), rtol=1e-5)


def test_blender_without_script_shows_no_subsurface_light(simulated_face, shapes_file, tmp_path):
    """The reason for the script: an importer that fills this in makes it needless."""
    gltf.write(simulated_face, tmp_path, ExportSettings(mesh=shapes_file))
    _, facts = read(tmp_path / gltf.GLB_FILE, tmp_path / "read.npz", bake=0)
    assert facts["subsurface_weight"] == 0.0


def constants(script):
    """Return what a script sets at its top, without running it."""
    return {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(script).body
        if isinstance(node, ast.Assign) and node.targets[0].id.isupper()
    }


def test_script_names_file_and_radii_without_blender():
    script = blender.Import.from_channels("skin.glb", [0.2, 0.5, 0.1]).script()
    told = constants(script)
    assert told["CHANNELS"] == (0.4, 1.0, 0.2)
    assert told["RADIUS_M"] == pytest.approx(0.5e-3 * 4.0 * math.pi)
    assert 'import_scene.gltf(filepath=str(here / "skin.glb"))' in script
    named = blender.Import("skin.usdc", 1.0, None, (("Roughness", "textures/r.exr", 0.5),))
    assert constants(named.script())["TEXTURES"] == {"Roughness": ("textures/r.exr", 0.5)}
    assert "wm.usd_import" in named.script()


def test_blender_loads_a_texture_of_each_tile(simulated_face, patch, tmp_path):
    pytest.importorskip("pxr")
    mesh = patch.mesh()
    count = len(mesh.vertices_mm)
    np.savez(
        tmp_path / "head.npz",
        vertices_mm=np.concatenate([mesh.vertices_mm, mesh.vertices_mm * [1, 1, -1]]),
        faces=np.concatenate([mesh.faces, mesh.faces[:, ::-1] + count]),
        uv=np.concatenate([mesh.uv, mesh.uv + np.array([1.0, 0.0])]),
    )
    usd.write(simulated_face, tmp_path, ExportSettings(mesh=tmp_path / "head.npz", udim="dot"))
    found, facts = read(tmp_path / blender.SCRIPT_FILE, tmp_path / "read.npz", bake=0)
    for name in ("base_color", "roughness", "normal", "specular", "radius"):
        assert facts[f"{name}_tiles"] == [1001, 1002]
    assert (found["uv"][..., 0].min(), found["uv"][..., 0].max()) == (0.0, 2.0)
