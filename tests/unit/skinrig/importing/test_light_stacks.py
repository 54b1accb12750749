"""Lights of folders: estimates under other exposures, and what is refused before any fit."""

import json

import cv2
import numpy as np
import pytest
import tifffile
from fixtures.faulty_stacks import SHAPES, dome, render, to_srgb

from capture.importers.light_tables import LightListError
from skinrig.cli import main
from skinrig.importing.light_stacks import find_lights


def write(folder, images):
    folder.mkdir()
    for number, image in enumerate(images.astype(np.float32)):
        tifffile.imwrite(folder / f"{number:02d}.tif", image)


def estimate(folder, **options):
    given = {"lights": "estimate", "mask": None, "encoding": "auto"} | options
    return find_lights(folder, **given)


def import_assumptions(argv, capsys):
    capsys.readouterr()
    assert main(argv) == 0
    return json.loads(capsys.readouterr().out)["assumed"]


def test_float_images_of_other_maxima_show_their_lights(tmp_path):
    """A full-bright and a dark image keep their level, although each file has its own maximum."""
    lights = dome(20, np.random.default_rng(2), 60)
    rng = np.random.default_rng(3)
    images, inside = render("ball", lights, rng, side=80, gloss=0.2, noise=0.005)
    full = images.sum(axis=0)
    write(tmp_path / "f", 37.0 * np.concatenate([images, [full, 0.004 * images[0]]]))
    cv2.imwrite(str(tmp_path / "f" / "mask.png"), inside.astype(np.uint8) * 255)
    found = estimate(tmp_path / "f")
    assert [file.name for file in found.lights.images] == [f"{k:02d}.tif" for k in range(20)]
    cosine = np.clip((found.lights.directions * lights).sum(axis=1), -1.0, 1.0)
    assert np.degrees(np.arccos(cosine)).mean() < 2.5
    assert any("21.tif is dark" in text for text in found.assumed)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_few_images_are_refused_before_any_fit(count, tmp_path):
    folder = tmp_path / "f"
    folder.mkdir()
    for number in range(count):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((40, 40), 50 + number, np.uint8))
    with pytest.raises(LightListError, match=r"got \d, expected 8 or more"):
        estimate(folder)


def test_thin_mask_is_refused(tmp_path):
    images = np.random.default_rng(0).uniform(0.2, 1.0, (8, 400, 400))
    write(tmp_path / "f", images)
    mask = np.zeros((400, 400), np.uint8)
    mask[:, 200] = 255
    cv2.imwrite(str(tmp_path / "f" / "mask.png"), mask)
    with pytest.raises(LightListError, match="thinner than a block"):
        estimate(tmp_path / "f")


def test_estimated_directions_have_no_positions(tmp_path, capsys):
    lights = dome(12, np.random.default_rng(2), 60)
    images, _ = render("ball", lights, np.random.default_rng(3), side=64, gloss=0.0, noise=0.0)
    write(tmp_path / "f", images)
    argv = ["import", "olat", str(tmp_path / "f"), "--lights", "estimate", "--mm-per-px", "0.1"]
    assert main([*argv, "--out", str(tmp_path / "s")]) == 3
    assert "none with estimated directions" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_unequal_count_stays_the_error_despite_odd_files(tmp_path):
    images = np.random.default_rng(0).uniform(0.2, 1.0, (5, 40, 40))
    write(tmp_path / "f", images)
    tifffile.imwrite(tmp_path / "f" / "99.tif", np.ones((30, 20), np.float32))
    (tmp_path / "f" / "lights.txt").write_text("\n".join(["0 0 1"] * 5))
    with pytest.raises(LightListError, match="does not fit the images") as raised:
        find_lights(tmp_path / "f", lights=None, mask=None, encoding="auto")
    assert raised.value.code == "SR-IMP-007"


@pytest.mark.parametrize(("encoding", "seed"), [("sRGB", 7001), ("sRGB", 7005), ("linear", 7005)])
def test_encoding_of_glossy_images_is_found(encoding, seed, tmp_path, capsys):
    """Highlights that a curve flattens do not make its values linear; none of it was asked for."""
    rng = np.random.default_rng(seed)
    lights = dome(12, rng, 60)
    images, inside = render(SHAPES[seed % 3], lights, rng, side=64, gloss=2.0, noise=0.005)
    folder = tmp_path / "f"
    folder.mkdir()
    for number, image in enumerate(images):
        shown = to_srgb(image) if encoding == "sRGB" else image
        cv2.imwrite(str(folder / f"{number:02d}.png"), np.rint(255 * shown).astype(np.uint8))
    cv2.imwrite(str(folder / "mask.png"), inside.astype(np.uint8) * 255)
    np.savetxt(folder / "lights.txt", lights)
    found = find_lights(folder, lights=None, mask=None, encoding="auto")
    assert found.encoding == encoding
    argv = ["import", "olat", str(folder), "--json"]
    assumed = "".join(import_assumptions([*argv, "--out", str(tmp_path / "s")], capsys))
    assert ("linear light, since shading adds up so" in assumed) == (encoding == "linear")
    assert "as asked" not in assumed
    asked = [*argv, "--encoding", "linear", "--out", str(tmp_path / "t")]
    assert "linear light, as asked" in "".join(import_assumptions(asked, capsys))


def test_image_that_list_lacks_is_named(tmp_path):
    images = np.random.default_rng(0).uniform(0.2, 1.0, (5, 40, 40))
    write(tmp_path / "f", images)
    rows = [f"{k:02d}.tif 0 0 1" for k in (0, 1, 3, 4)]
    (tmp_path / "f" / "a.lp").write_text("\n".join(["4", *rows]))
    found = find_lights(tmp_path / "f", lights=None, mask=None, encoding="auto")
    assert found.assumed == ("02.tif is not in a.lp, and was left out",)


def test_list_in_scene_frame_is_turned(tmp_path, capsys):
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # camera to scene
    lights = dome(6, np.random.default_rng(2), 60)
    images = np.random.default_rng(0).uniform(0.2, 1.0, (6, 40, 40))
    folder = tmp_path / "f"
    write(folder, images)
    np.savetxt(folder / "lights.txt", lights @ turn.T)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    frames = [{"file_path": "00", "transform_matrix": matrix.tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    camera = tmp_path / "transforms.json"
    found = find_lights(folder, lights=None, mask=None, encoding="auto", camera=camera)
    np.testing.assert_allclose(found.lights.directions, lights, atol=1e-9)
    assert "turned into the camera's" in found.assumed[-1]
    argv = ["import", "olat", str(folder), "--camera", str(camera), "--out", str(tmp_path / "s")]
    assert main(argv) == 0
    assert main([*argv, "--lights", "estimate"]) == 3
    assert "needs no camera" in capsys.readouterr().err
    argv[-1] = str(tmp_path / "near")
    assert main([*argv, "--mm-per-px", "0.1"]) == 3
    assert "got 0.1, expected none with a camera" in capsys.readouterr().err
    assert not (tmp_path / "near").exists()


def test_folders_of_cameras_state_what_to_do(tmp_path, capsys):
    for name in ("cam01", "cam02"):
        (tmp_path / "rig").mkdir(exist_ok=True)
        write(tmp_path / "rig" / name, np.ones((3, 8, 8)))
    assert main(["import", "olat", str(tmp_path / "rig"), "--out", str(tmp_path / "s")]) == 3
    assert "cam01 to cam02 look like cameras" in capsys.readouterr().err
