"""Maps with units, ranges and frames, as the artist or the scientist finds them in the folder."""

import json

import cv2
import numpy as np
import OpenEXR
import pytest

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.exporting import maps
from skinrig.exporting.materials.tangents import FramedMesh, rotate_from_tangent
from skinrig.exporting.options import ExportError, ExportSettings


def read(path):
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        return channels["RGB" if "RGB" in channels else "Y"].pixels.copy()


@pytest.fixture
def picture(rng):
    """Maps on a camera's picture, not square, one pixel unknown."""
    shape = (6, 9)
    valid = np.ones(shape, bool)
    valid[0, 0] = False
    melanin = np.where(valid, rng.uniform(0.01, 0.4, shape), 0.0)
    blood = np.where(valid, rng.uniform(0.01, 0.2, shape), 0.0)
    normals = rng.standard_normal((*shape, 3))
    normals[..., 2] = np.abs(normals[..., 2]) + 1.0
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return SkinAppearance(
        {
            "melanin": SkinMap(melanin, MAP_UNITS["melanin"], 0.1 * melanin, valid),
            "hemoglobin": SkinMap(blood, MAP_UNITS["hemoglobin"], valid=valid),
            "normals": SkinMap(normals, "1", description="towards the camera"),
            "image": SkinMap(rng.uniform(0, 1, (*shape, 3)), "1", valid=valid),
            "diffuse": SkinMap(rng.uniform(0, 1, (*shape, 3)), "1", valid=valid),
        },
        "simulated",
        {"assumed": ["an even light"]},
        {"session": "abc"},
    )


def test_every_map_is_exported_with_values_and_record(picture, tmp_path):
    assert maps.write(picture, tmp_path, ExportSettings()) == []
    told = json.loads((tmp_path / "maps.json").read_text())
    for name, one in picture.maps.items():
        np.testing.assert_array_equal(read(tmp_path / f"exr/{name}.exr"), one.values)
        assert told["files"][f"exr/{name}.exr"]["unit"] == one.unit
    spaces = {name: told["files"][f"exr/{name}.exr"]["color_space"] for name in picture.maps}
    assert spaces["image"] == "linear sRGB"
    assert spaces["diffuse"].startswith("camera RGB")
    assert spaces["melanin"] == "data"
    assert (told["source"], told["assumed"]) == ("simulated", ["an even light"])
    assert told["inputs"] == {"session": "abc"}


def test_chromophore_pngs_share_range_for_every_subject(picture, tmp_path):
    maps.write(picture, tmp_path, ExportSettings(only=("melanin",)))
    told = json.loads((tmp_path / "maps.json").read_text())["files"]["png/melanin.png"]
    assert (told["low"], told["high"]) == (0.0, 0.5)
    codes = cv2.imread(str(tmp_path / "png/melanin.png"), cv2.IMREAD_UNCHANGED)
    decoded = 0.5 * codes / 65535.0
    np.testing.assert_allclose(decoded, picture.maps["melanin"].values, atol=0.51 * told["step"])


def test_chromophores_are_packed_melanin_red_hemoglobin_green(picture, tmp_path):
    maps.write(picture, tmp_path, ExportSettings())
    packed = read(tmp_path / "exr/chromophores.exr")
    np.testing.assert_array_equal(packed[..., 0], picture.maps["melanin"].values)
    np.testing.assert_array_equal(packed[..., 1], picture.maps["hemoglobin"].values)
    assert not packed[..., 2].any()
    codes = cv2.imread(str(tmp_path / "png/chromophores.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(
        codes[..., 1] / 65535.0 / 4.0, picture.maps["hemoglobin"].values, atol=1e-5
    )


def test_camera_normals_green_is_flipped_for_directx_only(picture, tmp_path):
    for word in ("gl", "dx"):
        (tmp_path / word).mkdir()
        maps.write(picture, tmp_path / word, ExportSettings(normal_y=word))
    up, down = (read(tmp_path / word / "exr/normals.exr") for word in ("gl", "dx"))
    np.testing.assert_array_equal(up * [1, -1, 1], down)
    told = json.loads((tmp_path / "dx/maps.json").read_text())
    assert told["normal_y"] == "-Y (DirectX)"
    assert "y down" in told["files"]["exr/normals.exr"]["what"]


def test_dome_normals_keep_rig_frame_adding_tangent_frame(simulated_face, patch, tmp_path):
    maps.write(simulated_face, tmp_path, ExportSettings(normal_y="dx"))
    world = simulated_face.maps["normals"].values
    np.testing.assert_array_equal(read(tmp_path / "exr/normals.exr"), world)
    tangent = read(tmp_path / "exr/normal_tangent.exr") * [1.0, -1.0, 1.0]
    axes, covered = FramedMesh.of(patch.mesh()).texel_frames(patch.side)
    back = rotate_from_tangent(tangent, axes)
    known = covered & simulated_face.maps["normals"].valid
    assert np.linalg.norm(back - world, axis=-1)[known].max() < 1e-5
    assert (tmp_path / "files/mesh.obj").read_bytes() == simulated_face.files["mesh.obj"]


def test_errors_and_masks_are_written_on_request(picture, tmp_path):
    maps.write(picture, tmp_path, ExportSettings(with_errors=True, only=("melanin",)))
    np.testing.assert_array_equal(
        read(tmp_path / "exr/melanin.stderr.exr"), picture.maps["melanin"].stderr
    )
    assert read(tmp_path / "exr/melanin.valid.exr")[0, :2].tolist() == [0.0, 1.0]


def test_missing_map_is_named_with_available_ones(picture, tmp_path):
    with pytest.raises(ExportError, match="got roughness, expected some of diffuse, hemoglobin"):
        maps.write(picture, tmp_path, ExportSettings(only=("roughness",)))
