"""Orientations of cameras from transforms.json and COLMAP turn lists into the camera's frame."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.importers.camera_poses import read_camera_axes
from capture.importers.light_tables import LightListError

IMAGES = [Path("01.png"), Path("02.png")]
TURN = Rotation.from_euler("xyz", (20.0, -35.0, 70.0), degrees=True)


def write_transforms(path, *turns, scale=1.0):
    frames = []
    for number, turn in enumerate(turns, start=1):
        matrix = np.eye(4)
        matrix[:3, :3] = scale * turn.as_matrix()
        frames.append({"file_path": f"./train/0{number}", "transform_matrix": matrix.tolist()})
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return path


def write_colmap(path, *turns):
    """COLMAP states scene to camera, whose y is down and z forward."""
    lines = ["# comment"]
    for number, turn in enumerate(turns, start=1):
        look = Rotation.from_euler("x", 180, degrees=True) * turn.inv()
        x, y, z, w = look.as_quat()
        lines += [f"{number} {w} {x} {y} {z} 0 0 5 1 0{number}.png", "" if number == 1 else "1 2 3"]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_both_files_give_the_same_axes(write, tmp_path):
    """Rows are the columns of camera to scene: right, up, away from the scene."""
    name = "transforms.json" if write is write_transforms else "images.txt"
    file = write(tmp_path / name, TURN, TURN)
    axes = read_camera_axes(file, IMAGES)
    np.testing.assert_allclose(axes, TURN.as_matrix().T, atol=1e-9)
    light = TURN.apply([0.0, 0.0, 1.0])  # behind the camera, in the scene's frame
    np.testing.assert_allclose(axes @ light, [0.0, 0.0, 1.0], atol=1e-9)
    write(tmp_path / name, TURN, TURN * Rotation.from_euler("y", 5, degrees=True))
    with pytest.raises(LightListError, match=r"01 and 02: got 5.0 degrees apart"):
        read_camera_axes(file, IMAGES)
    with pytest.raises(LightListError, match="names no image"):
        read_camera_axes(file, [Path("9.png")])


def test_equal_names_follow_their_folders(tmp_path):
    """Two cameras with equal names of images; without their folders, both would count."""
    frames = []
    for camera, turn in (("cam01", TURN), ("cam02", TURN.inv())):
        matrix = np.eye(4)
        matrix[:3, :3] = turn.as_matrix()
        frames.append({"file_path": f"{camera}/01.png", "transform_matrix": matrix.tolist()})
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"frames": frames}))
    for camera, turn in (("cam01", TURN), ("Cam02", TURN.inv())):
        axes = read_camera_axes(file, [tmp_path / camera / "01.tif"])
        np.testing.assert_allclose(axes, turn.as_matrix().T, atol=1e-9)
    with pytest.raises(LightListError, match=r"cam01/01 and cam02/01: got \d+.\d degrees apart"):
        read_camera_axes(file, [tmp_path / "other" / "01.tif"])


def test_blank_lines_of_colmap_matter_between_poses(tmp_path):
    """Long lines of points are not poses; poses without lines of points are refused."""
    file = write_colmap(tmp_path / "images.txt", TURN, TURN)
    text = file.read_text()
    for changed in (text.replace("1 2 3\n", "1 2 3 " * 4 + "\n"), text + "\n\n"):
        file.write_text(changed)
        axes = read_camera_axes(file, IMAGES)
        np.testing.assert_allclose(axes, TURN.as_matrix().T, atol=1e-9)
    file.write_text(text.replace("\n\n", "\n"))
    with pytest.raises(LightListError, match=r"(?s)lacks the lines of points.*got 2 0"):
        read_camera_axes(file, IMAGES)


def test_scale_of_scene_does_not_matter(tmp_path):
    file = write_transforms(tmp_path / "transforms.json", TURN, scale=2.5)
    axes = read_camera_axes(file, [Path("other.png")])
    np.testing.assert_allclose(axes, TURN.as_matrix().T, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "[]", "not a list of cameras"),
        ("a.json", '{"frames": [3]}', "frame 1"),
        ("a.json", '{"frames": [{"file_path": "a", "transform_matrix": [[1]]}]}', "4 x 4"),
        (
            "a.json",
            json.dumps({"frames": [{"file_path": "a", "transform_matrix": (-np.eye(4)).tolist()}]}),
            "rotation",
        ),
        (
            "a.json",
            f'{{"frames": [{{"file_path": "a", "transform_matrix": [[1{"0" * 400}]]}}]}}',
            "4 x 4",
        ),
        ("images.txt", "1 nan 0 0 0 0 0 0 1 a.png\n", "QW QX"),
        ("images.txt", "# nothing\n", "0"),
        ("images.bin", "", "model_converter"),
    ],
)
def test_other_files_are_refused(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(LightListError, match=message):
        read_camera_axes(tmp_path / name, IMAGES)
