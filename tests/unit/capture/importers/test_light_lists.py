"""Foreign pictures with their light lists become sessions, or an error that names the line."""

import json

import cv2
import numpy as np
import pytest
import tifffile

from capture.documents import InputError
from capture.importers import LightListError, import_light_list, light_lists
from capture.session import Session, verify


def directions(count):
    k = np.arange(count) + 0.5
    z = 1.0 - 0.4 * k / count
    phi = np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def sphere(lights, side=48):
    """Return linear images (N, side, side) of a matte ball, its normals and its mask."""
    y, x = np.mgrid[0:side, 0:side]
    u, v = (x - (side - 1) / 2) / (0.45 * side), ((side - 1) / 2 - y) / (0.45 * side)
    inside = u * u + v * v < 0.9
    n = np.stack([u, v, np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))], axis=-1)
    images = 0.8 * np.maximum(np.einsum("hwk,nk->nhw", n, lights), 0.0) * inside
    return images, n, inside


def write(folder, images, name="img{}.png", linear=True):
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        shown = image if linear else np.where(image > 0, image ** (1 / 2.2), 0)
        codes = np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)
        tint = np.stack([codes, codes, (0.9 * codes).astype(np.uint8)], axis=-1)
        cv2.imwrite(str(folder / name.format(number)), tint)


def write_lp(path, names, lights):
    rows = [
        f"{name} {x:.6f} {y:.6f} {z:.6f}" for name, (x, y, z) in zip(names, lights, strict=True)
    ]
    path.write_text("\n".join([str(len(rows)), *rows]) + "\n")


@pytest.fixture
def rti(tmp_path):
    lights = directions(12)
    images, n, inside = sphere(lights)
    write(tmp_path / "rti", images)
    order = np.random.default_rng(3).permutation(12)
    write_lp(tmp_path / "rti" / "a.lp", [f"C:\\old\\IMG{k}.PNG" for k in order], lights[order])
    cv2.imwrite(str(tmp_path / "rti" / "ball_mask.png"), inside.astype(np.uint8) * 255)
    return tmp_path / "rti", lights, n, inside


def test_lp_file_pairs_images_by_name_any_order(rti):
    folder, lights, _, _ = rti
    found = light_lists.find_light_list(folder)
    numbers = [int(p.stem[3:]) for p in found.images]
    assert sorted(numbers) == list(range(12))
    np.testing.assert_allclose(found.directions, lights[numbers], atol=1e-5)
    assert found.kind == "lp"


def test_unnamed_images_follow_natural_counting_order(tmp_path):
    images, _, _ = sphere(directions(12))
    write(tmp_path, images)
    rows = "\n".join(f"{x} {y} {z}" for x, y, z in directions(12))
    (tmp_path / "lights.txt").write_text("12\n" + rows)
    found = light_lists.find_light_list(tmp_path)
    assert [p.name for p in found.images][1:3] == ["img1.png", "img2.png"]
    np.testing.assert_allclose(found.directions, directions(12))


def test_imported_stack_is_sound_session_reporting_assumptions(rti, tmp_path):
    folder, _, _, inside = rti
    done = import_light_list(folder, out=tmp_path / "s")
    assert (done.frames, done.encoding, done.mask) == (12, "linear", "ball_mask.png")
    session = Session.open(tmp_path / "s")
    assert verify(tmp_path / "s").ok
    assert session.closed
    assert len(session.rig.lights) == 12
    mask = cv2.imdecode(np.frombuffer(session.attachment("mask.png"), np.uint8), 0)
    np.testing.assert_array_equal(mask > 127, inside)
    assert any("shading adds up" in text for text in done.assumed)


def test_display_values_are_decoded_when_light_then_adds(tmp_path):
    images, _, inside = sphere(directions(16))
    write(tmp_path / "p", images, linear=False)
    write_lp(tmp_path / "p" / "a.lp", [f"img{k}.png" for k in range(16)], directions(16))
    cv2.imwrite(str(tmp_path / "p" / "mask.png"), inside.astype(np.uint8) * 255)
    assert import_light_list(tmp_path / "p", out=tmp_path / "s").encoding == "sRGB"
    asked = import_light_list(tmp_path / "p", out=tmp_path / "t", encoding="linear")
    assert asked.encoding == "linear"
    with pytest.raises(LightListError, match="encoding"):
        import_light_list(tmp_path / "p", out=tmp_path / "u", encoding="log")


def test_values_assumed_linear_equal_file_values(rti, tmp_path):
    folder, _, _, _ = rti
    import_light_list(folder, out=tmp_path / "s", encoding="linear")
    session = Session.open(tmp_path / "s")
    record = session.frames("olat")[0]
    frame = session.read(record)
    picture = light_lists.find_light_list(folder).images[0]
    green = cv2.imread(str(picture))[..., 1].astype(float) / 255
    np.testing.assert_allclose(frame.cfa[::2, 1::2] / frame.white, green, atol=2e-4)


def test_folders_of_other_habits_are_understood(tmp_path):
    lights = directions(5)
    images, _, _ = sphere(lights)
    write(tmp_path, images, name="{:03d}.png")
    (tmp_path / "filenames.txt").write_text("\n".join(f"{k:03d}.png" for k in (4, 3, 2, 1, 0)))
    rows = "\n".join(f"{x} {y} {z}" for x, y, z in lights[::-1])
    (tmp_path / "light_directions.txt").write_text(rows)
    (tmp_path / "light_intensities.txt").write_text("\n".join(["2 2 2"] * 5))
    found = light_lists.find_light_list(tmp_path)
    assert [p.stem for p in found.images] == ["004", "003", "002", "001", "000"]
    assert found.intensity is not None
    assert import_light_list(tmp_path, out=tmp_path / "out" / "s").frames == 5


def test_positions_are_kept_where_a_scale_is_given(rti, tmp_path):
    folder, lights, _, _ = rti
    write_lp(folder / "a.lp", [f"img{k}.png" for k in range(12)], 300.0 * lights)
    far = import_light_list(folder, out=tmp_path / "far")
    assert any("mm_per_px" in text for text in far.assumed)
    import_light_list(folder, out=tmp_path / "near", mm_per_px=0.5)
    rig = Session.open(tmp_path / "near").rig
    np.testing.assert_allclose(rig.lights[0].position_mm, 300.0 * lights[0], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("13\nimg0.png 0 0 1\n", "13, as in its first line"),
        ("1\nimg0.png 0 0\n", "three numbers"),
        ("1\nimg0.png 0 0 nan\n", "three numbers"),
        ("1\nimg0.png 0 0 0\n", "three numbers"),
        ("2\nimg0.png 0 0 1\nimg0.png 0 1 1\n", "twice"),
        ("1\nnowhere.png 0 0 1\n", "nowhere.png"),
        ("", "lines"),
        ("\0\0", "not a light list"),
    ],
)
def test_a_broken_list_is_refused_by_name(rti, tmp_path, text, expected):
    folder, _, _, _ = rti
    (folder / "a.lp").write_text(text)
    with pytest.raises(LightListError, match=expected):
        import_light_list(folder, out=tmp_path / "s")
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("name", ["a.lp", "lights.txt"])
@pytest.mark.parametrize(
    "row",
    [
        "img{}.png, 0,5, 0,3, 0,8",
        "img{}.png,0,5,0,3,0,8",
        "img{}.png;0,5;0,3;0,8;1,0",
        "img{}.png, 0.5, 0.3, 0.8, 1.0",
        "img{}.png 0,5 0,3 0,8 1,0",
        "img{}.png 0.5 0.3 0.8 1.0",
        "img{}.png 5 0.3 0.8 1.0",
    ],
)
def test_row_of_other_columns_is_refused(row, name, rti, tmp_path):
    folder, _, _, _ = rti
    (folder / "a.lp").unlink()
    (folder / name).write_text("\n".join(row.format(k) for k in range(12)))
    with pytest.raises(LightListError, match=r"name x y z|missing image"):
        import_light_list(folder, out=tmp_path / "s")


def test_invalid_light_list_input_is_refused_by_name(rti, tmp_path):
    folder, _, _, _ = rti
    with pytest.raises(LightListError, match="folder not found"):
        import_light_list(folder / "x", out=tmp_path / "s")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(LightListError, match="no images"):
        import_light_list(empty, out=tmp_path / "s")
    cv2.imwrite(str(folder / "ball_mask.png"), np.full((9, 9), 255, np.uint8))
    with pytest.raises(LightListError, match="9 x 9"):
        import_light_list(folder, out=tmp_path / "s")
    cv2.imwrite(str(folder / "ball_mask.png"), np.zeros((48, 48), np.uint8))
    with pytest.raises(LightListError, match="black"):
        import_light_list(folder, out=tmp_path / "s")
    (folder / "ball_mask.png").unlink()
    cv2.imwrite(str(folder / "img4.png"), np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(InputError, match=r"img4\.png"):
        import_light_list(folder, out=tmp_path / "s")
    (folder / "a.lp").unlink()
    with pytest.raises(LightListError, match="no light list"):
        import_light_list(folder, out=tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_chrome_ball_substitutes_for_light_list(test_data):
    folder = test_data / "photometric_stereo"
    listed = light_lists.find_light_list(folder / "buddha")
    ball = light_lists.find_light_list(folder / "buddha", lights=folder / "chrome")
    angle = np.degrees(np.arccos(np.clip((listed.directions * ball.directions).sum(1), -1, 1)))
    assert ball.kind == "chrome ball"
    assert angle.mean() < 3.5


def test_float_images_keep_their_ratios(tmp_path):
    """Each file has another maximum, and one is black; one white value serves all."""
    lights = directions(6)
    images, _, _ = sphere(lights)
    images *= np.array([1.0, 0.2, 3.0, 0.5, 0.0, 1.0])[:, None, None]
    folder = tmp_path / "f"
    folder.mkdir()
    for number, image in enumerate(images.astype(np.float32)):
        tifffile.imwrite(folder / f"{number}.tif", image)
    (folder / "lights.txt").write_text("\n".join(" ".join(map(str, row)) for row in lights))
    done = import_light_list(folder, out=tmp_path / "s")
    session = Session.open(done.path)
    frames = [session.read(record) for record in session.frames("olat")]
    values = np.array([frame.cfa.astype(float) - frame.black[0] for frame in frames])
    np.testing.assert_allclose(values / values.max(), images / images.max(), atol=2e-4)
    assert sum("values were divided by" in text for text in done.assumed) == 1


def test_intensities_apply_to_lists_of_every_form(tmp_path):
    lights = directions(6)
    images, _, _ = sphere(lights)
    write(tmp_path / "f", images)
    rows = np.arange(1.0, 19.0).reshape(6, 3)
    (tmp_path / "f" / "light_intensities.txt").write_text(
        "\n".join(" ".join(map(str, row)) for row in rows)
    )
    (tmp_path / "f" / "lights.json").write_text(json.dumps(lights.tolist()))
    found = light_lists.find_light_list(tmp_path / "f")
    np.testing.assert_array_equal(found.intensity, rows)


@pytest.mark.parametrize("name", ["lights.txt", "a.lp", "lights.json"])
def test_intensities_follow_rows_of_named_list(name, tmp_path):
    lights = directions(6)
    write(tmp_path / "f", sphere(lights)[0])
    order = [3, 1, 0, 5, 4, 2]
    names = [f"img{k}.png" for k in order]
    if name == "lights.json":
        listed = dict(zip(names, lights[order].tolist(), strict=True))
        (tmp_path / "f" / name).write_text(json.dumps(listed))
    else:
        write_lp(tmp_path / "f" / name, names, lights[order])
    rows = np.arange(1.0, 19.0).reshape(6, 3)
    strengths = tmp_path / "f" / "light_intensities.txt"
    np.savetxt(strengths, rows)
    found = light_lists.find_light_list(tmp_path / "f")
    assert [file.name for file in found.images] == names
    np.testing.assert_array_equal(found.intensity, rows)
    np.savetxt(strengths, rows[:5])
    with pytest.raises(LightListError, match="does not fit the lights"):
        light_lists.find_light_list(tmp_path / "f")


@pytest.mark.parametrize("suffix", [".tga", ".npy", ".pgm"])
def test_folders_of_other_formats_name_the_conversion(tmp_path, suffix):
    for number in range(4):
        (tmp_path / f"{number}{suffix}").write_bytes(b"\x93NUMPY")
    with pytest.raises(LightListError, match=r"4 \\?" + suffix) as caught:
        light_lists.find_light_list(tmp_path)
    assert "Convert it to TIFF or PNG" in str(caught.value)


def test_matlab_lights_name_formats_that_are_read(tmp_path):
    write(tmp_path / "f", sphere(directions(6))[0])
    (tmp_path / "light.mat").write_bytes(b"MATLAB 5.0 MAT-file\0\0")
    with pytest.raises(LightListError, match=r"as JSON or as \.npy"):
        light_lists.find_light_list(tmp_path / "f", lights=tmp_path / "light.mat")
